"""Optional libraries: each belongs to an extra of the distribution, which a message names where it is absent."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from monitor.core.errors import BadConfigurationError


def load_extra(module: str, extra: str, purpose: str) -> Any:
    """Import the module of an optional library.

    Raises
    ------
    BadConfigurationError
        The library is not installed; the message names the extra that installs it.

    Examples
    --------
    >>> load_extra("no_such_module", "formats", "UFF")
    Traceback (most recent call last):
    ...
    monitor.core.errors.BadConfigurationError: UFF needs the extra formats: pip install 'shm-monitor[formats]'
    """
    try:
        return import_module(module)
    except ImportError as error:
        raise BadConfigurationError(f"{purpose} needs the extra {extra}: pip install 'shm-monitor[{extra}]'") from error
