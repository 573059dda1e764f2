"""What of a site file may change while the daemon runs."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

from monitor.config import Configuration, configuration
from monitor.core import BadConfigurationError, UserError
from monitor.runs import ledger
from monitor.service.outlets import Outlet, change_outlets

_log = logging.getLogger(__name__)

CHANGEABLE = ("alarm", "watch", "notify")
"""Tables on which nothing depends that was estimated, recorded or opened."""
_LASTING = ("longest_s", "time_limit_s")
"""Keys of ``[watch]`` that do not follow: so much data is kept since the start, and diagnoses run by that limit."""


def reread(path: Path, running: Configuration, outlets: Sequence[Outlet], out: Path) -> Configuration:
    """The configuration to go on with: the site file as it is now, or the running one where that cannot be; never raises.

    Outlets are told, and a change is noted in the ledger in `out`.
    """
    try:
        new = changed(path, running)
        if new != running:
            change_outlets(path, new, outlets)
            ledger.append_entry(
                out / "results.jsonl", {"says": "settings read again", "causes": []}, {"site": path}, None
            )
    except UserError as error:
        _log.error("not reloaded, all goes on as before: %s", error)
        return running
    _log.warning("reloaded %s", path)
    return new


def changed(path: Path, running: Configuration) -> Configuration:
    """The site file as it is now.

    Raises
    ------
    MissingInputError, BadConfigurationError
        It cannot be used, or something else than `CHANGEABLE`, or one of `_LASTING`, is not as it was.
    """
    new = configuration.load(path)
    names = [name for name in type(new).model_fields if getattr(new, name) != getattr(running, name)]
    fixed = [f"[{name}]" for name in names if name not in CHANGEABLE]
    fixed += [f"[watch] {key}" for key in _LASTING if getattr(new.watch, key) != getattr(running.watch, key)]
    if fixed:
        raise BadConfigurationError(
            f"{path}: {', '.join(fixed)} changed; restart for that, or put it back: "
            f"without a restart only {', '.join(f'[{name}]' for name in CHANGEABLE)} may change, "
            f"and of [watch] not {' and '.join(_LASTING)}"
        )
    return new
