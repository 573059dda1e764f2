"""Errors of reading recordings, told as errors of the user's input."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from drivers.base import RecordingError, RecordingMissingError
from monitor.core.errors import BadInputError, MissingInputError


@contextmanager
def read_by_user(before: str = "") -> Iterator[None]:
    """Raise `MissingInputError` or `BadInputError` where a recording that the user named cannot be read; `before` precedes it."""
    try:
        yield
    except RecordingMissingError as error:
        raise MissingInputError(f"{before}{error}") from error
    except RecordingError as error:
        raise BadInputError(f"{before}{error}") from error
