"""Reload of the site file while the daemon runs, limited to the settings that may then change."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from monitor.config import Configuration, configuration
from monitor.core import BadConfigurationError, UserError
from monitor.runs import ledger
from monitor.service.outlets import Outlet, make_outlets, prepare_change

_log = logging.getLogger(__name__)

CHANGEABLE = ("alarm", "watch", "notify")
"""Tables that may change: nothing that was estimated, recorded or opened depends on them."""
_FIXED_WATCH_KEYS = ("longest_s", "time_limit_s")
"""Keys of ``[watch]`` that may not change: since the start data are kept for the one, and diagnoses run under the other."""


@dataclass(frozen=True, slots=True)
class Reloaded:
    """Site file that was read again."""

    settings: Configuration
    """Settings to continue with."""
    apply: Callable[[], None]
    """Gives the running outlets their new settings; it waits for no disk."""


def reread(path: Path, running: Configuration, outlets: Sequence[Outlet], out: Path) -> Reloaded | None:
    """Read the site file again, with what it names, and record a change in the ledger (in a thread that may wait for the disk).

    None is returned if the file cannot be used, with the reason logged: all goes on as before.
    """
    try:
        new = changed(path, running)
        apply = prepare_change(path, new, outlets)  # so that nothing of the change fails once the ledger has it
        if new != running:
            make_outlets(path, new, dry=True)
            finding = {"says": "settings read again", "causes": []}
            ledger.append_entry(out / "results.jsonl", finding, {"site": path}, None)
    except UserError as error:
        _log.error("not reloaded, all goes on as before: %s", error)
        return None
    _log.warning("reloaded %s", path)
    return Reloaded(new, apply)


def changed(path: Path, running: Configuration) -> Configuration:
    """Load the site file and check that only settings changed that may change while the daemon runs.

    MissingInputError tells that the file cannot be read; BadConfigurationError that it is invalid, or that a table other than
    `CHANGEABLE` or a key of `_FIXED_WATCH_KEYS` changed.
    """
    new = configuration.load(path)
    names = [name for name in type(new).model_fields if getattr(new, name) != getattr(running, name)]
    fixed = [f"[{name}]" for name in names if name not in CHANGEABLE]
    fixed += [f"[watch] {key}" for key in _FIXED_WATCH_KEYS if getattr(new.watch, key) != getattr(running.watch, key)]
    if fixed:
        raise BadConfigurationError(
            f"{path}: {', '.join(fixed)} changed; restart for that, or put it back: "
            f"without a restart only {', '.join(f'[{name}]' for name in CHANGEABLE)} may change, "
            f"and of [watch] not {' and '.join(_FIXED_WATCH_KEYS)}"
        )
    return new
