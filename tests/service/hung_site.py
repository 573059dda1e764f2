"""A daemon whose source hangs once it is told to end: ``python -m tests.service.hung_site SITE``."""

from __future__ import annotations

import sys
import threading
from pathlib import Path

from drivers.base import SampleBlock
from tests.support.site import Daemon, Scripted


class Hung(Scripted):
    """Gives no data, and does not close."""

    def read(self, timeout_s: float) -> SampleBlock | None:
        threading.Event().wait(timeout_s)
        return None

    def close(self) -> None:
        print("stopping", file=sys.stderr, flush=True)
        threading.Event().wait()


if __name__ == "__main__":
    Daemon(Path(sys.argv[1]), Hung([]), warm=lambda *_: None).run()
