"""What `import` does with a file that ObsPy reads, without the process of its own in which it does so."""

from __future__ import annotations

import contextlib
from pathlib import Path
from unittest.mock import patch

from monitor.core import UserError
from monitor.runs.readers import seismic


def seismic_file(path: Path, kind: str) -> None:
    try:
        with patch("sys.unraisablehook"):  # ObsPy's own callback cannot decode what libmseed says of damage
            traces = seismic.read(path, 1 << 26, kind)
    except Exception:  # noqa: BLE001 - as that process does
        return
    with contextlib.suppress(UserError):
        seismic.join(path, *traces, 1 << 26, lambda _: None)
