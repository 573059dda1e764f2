"""Import with options and all else given by name alike."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any

from drivers.mcap_file import RecordingInfo
from monitor.runs.readers import Limits, Options, import_files

_OPTIONS = {field.name for field in fields(Options)}
_LIMITS = {field.name for field in fields(Limits)}


def imported(files: list[Path], out: Path, **named: Any) -> RecordingInfo:
    """Import files; `named` are fields of `Options` and `Limits`, and arguments of `import_files`."""
    options = Options(**{name: value for name, value in named.items() if name in _OPTIONS})
    limits = Limits(**{name: value for name, value in named.items() if name in _LIMITS})
    rest = {name: value for name, value in named.items() if name not in _OPTIONS | _LIMITS}
    return import_files(files, out, options, limits=limits, **rest)
