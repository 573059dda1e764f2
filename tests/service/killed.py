"""A daemon that ends as by kill -9."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from monitor.service import restart


@contextmanager
def killed() -> Iterator[pytest.MonkeyPatch]:
    """Its latest checkpoint is the last that it made on its way."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(restart.Checkpointer, "forget", lambda _: None)
        yield patch
