"""Optional libraries: which extra of the distribution holds each, and the one line that names it where it is not installed."""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from typing import Any

from monitor.core.errors import UserError

EXTRAS = {
    "viewer": ("rerun", "rerun_cli"),
    "archive": ("dask", "distributed", "pyarrow"),
    "notify": ("apprise",),
    "mqtt": ("paho",),
    "web": ("starlette",),
    "formats": ("h5py", "nptdms", "pyuff", "python_calamine"),
    "mdf": ("asammdf",),
    "seismic": ("obspy",),
    "plot": ("matplotlib",),
    "s3": ("s3fs", "botocore"),
}
"""Name of an extra -> the modules that it adds, as `[project.optional-dependencies]` of pyproject.toml."""
_EXTRA_OF = {module: extra for extra, modules in EXTRAS.items() for module in modules}


class MissingExtraError(UserError):
    """Use of an optional library that is not installed; the message names the extra that adds it."""

    exit_code = 78


def missing_extra(extra: str) -> str | None:
    """Return the line that names an extra which is not installed; None if it is.

    Examples
    --------
    >>> missing_extra("viewer") is None  # Rerun is installed here
    True
    """
    if all(map(_is_installed, EXTRAS[extra])):
        return None
    return f"needs the extra {extra}: pip install 'shm-monitor[{extra}]'"


def require_extra(extra: str, what: str) -> None:
    """Require that an extra is installed; the message of MissingExtraError begins with `what` (a file, a command, a key)."""
    if (line := missing_extra(extra)) is not None:
        raise MissingExtraError(f"{what} {line}")


def import_extra(module: str, what: str) -> Any:
    """Import an optional module, such as ``pyarrow.parquet``; raise MissingExtraError as `require_extra`."""
    require_extra(_EXTRA_OF[module.partition(".")[0]], what)
    return import_module(module)


def _is_installed(module: str) -> bool:
    try:
        return find_spec(module) is not None
    except ValueError:  # a module without a specification, as a test may put in place
        return True
