"""Reload of the site file while the daemon runs, limited to the settings that may then change."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from monitor.config import Configuration, configuration
from monitor.core import BadConfigurationError, UserError
from monitor.runs import Session, ledger
from monitor.service.outlets import Outlet, make_outlets, prepare_change
from monitor.service.request_handler import RequestHandler
from monitor.service.threads import Chores

_log = logging.getLogger(__name__)

CHANGEABLE = ("alarm", "watch", "notify")
"""Tables that may change: nothing that was estimated, recorded or opened depends on them."""
_FIXED_WATCH_KEYS = ("longest_s", "time_limit_s")
"""Keys of ``[watch]`` that may not change: since the start data are kept for the one, and diagnoses run under the other."""


class Reloading:
    """Settings of a running site, which are read again where that was asked for; `step` continues with those that were read."""

    def __init__(
        self, path: Path, settings: Configuration, out: Path, outlets: Sequence[Outlet], chores: Chores
    ) -> None:
        self._path, self.settings, self._out, self._outlets, self._chores = path, settings, out, outlets, chores
        self._requested = self._rereading = False
        self._reloaded: tuple[Configuration, Callable[[], None]] | None = None
        """Settings that were read, and what gives them to the outlets, which waits for no disk."""

    def ask(self) -> None:
        """Have the site file read again by a later `step`; a signal handler may call this."""
        self._requested = True

    def step(self, session: Session, requests: RequestHandler) -> None:
        """Have the file read, or continue with what was read."""
        if self._rereading:
            return
        if self._reloaded is not None:
            (self.settings, apply), self._reloaded = self._reloaded, None
            apply()
            session.reconfigure(self.settings)
        elif self._requested:
            self._requested, self._rereading = False, True
            self._chores.do("reload", partial(self._reread, requests))

    def _reread(self, requests: RequestHandler) -> None:
        try:
            self._read()
            requests.read_head()
        finally:
            self._rereading = False

    def _read(self) -> None:
        """Read the file, with what it names, and record a change in the ledger (in a thread that may wait for the disk).

        Where it cannot be used the reason is logged, and all goes on as before.
        """
        path = self._path
        try:
            new = changed(path, self.settings)
            # Prepared first, so that nothing of the change fails once the ledger has it.
            apply = prepare_change(path, new, self._outlets)
            if new != self.settings:
                make_outlets(path, new, dry=True)
                finding = {"says": "settings read again", "causes": []}
                ledger.append_entry(self._out / "results.jsonl", finding, {"site": path}, None)
        except UserError as error:
            _log.error("not reloaded, all goes on as before: %s", error)
        else:
            _log.warning("reloaded %s", path)
            self._reloaded = new, apply


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
