"""Structural health monitoring in a notebook: read, identify, update, diagnose and simulate; docs/library.md.

The names of `__all__`, their arguments and the fields of their results stay within a major version; everything below `monitor`
and `drivers` may change at any time.
"""

from typing import Any

import monitor.api as _api
from monitor import __version__ as __version__

__all__ = list(_api.__all__)


def __getattr__(name: str) -> Any:
    """Load a name when it is first asked for."""
    if name not in __all__:
        raise AttributeError(f"module 'shm_monitor' has no attribute {name!r}; it has {', '.join(__all__)}")
    return getattr(_api, name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
