"""Many structures over one Zenoh network: what each monitor says of its own, asked with one query.

Keys are those of `docs/zenoh.md`: a monitor answers ``PREFIX/SITE/state`` and holds the token ``PREFIX/SITE/alive/monitor``.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import zenoh
from pydantic import Field, ValidationError

from drivers.base import SourceError
from drivers.zenoh_session import Key, SessionSettings, leave, open_session
from monitor.config import read_toml
from monitor.core import BadConfigurationError, MissingInputError, Settings, settings_problems

_MOST_BYTES = 1 << 20
"""Of one monitor's answer."""
WELL, ALARM, TROUBLE = "normal", "alarm", "trouble"


class FleetSettings(SessionSettings):
    """``[fleet]`` of a fleet file: how to join the network, and who ought to be there."""

    prefix: Key = "shm"
    """Where the sites' keys begin."""
    sites: tuple[str, ...] = ()
    """Names that must be there; others are shown too."""
    silent_s: float = Field(default=60.0, gt=0)
    """Time without a word of health after which a monitor counts as hung."""
    timeout_s: float = Field(default=5.0, gt=0, le=60)
    """How long answers are waited for."""


class _FleetFile(Settings):
    fleet: FleetSettings


@dataclass(frozen=True, slots=True)
class SiteStatus:
    """One structure as its monitor sees it."""

    site: str
    state: str
    """``normal``, ``advisory``, ``warning``, ``alarm``, or ``trouble`` where that cannot be relied on."""
    says: str
    """Why; empty when all is well."""
    stories: tuple[int, ...] = ()
    """Of the alarm; 0 is the structure as a whole."""
    ddi: float | None = None
    """Largest relative loss of stiffness of any story, in the latest window that was judged."""
    ddi_std: float | None = None
    frequency_hz: float | None = None
    """The lowest."""
    t_end_ns: int | None = None
    """UTC, end of the latest window."""
    silent_s: float | None = None
    """Since the monitor's latest line of health."""


def load(path: Path) -> FleetSettings:
    """A fleet file.

    Raises
    ------
    MissingInputError, BadConfigurationError
    """
    try:
        return _FleetFile.model_validate(read_toml(path)).fleet
    except ValidationError as error:
        raise BadConfigurationError("\n".join(f"{path}: {problem}" for problem in settings_problems(error))) from error


class Fleet:
    """A session on the fleet's network; a context manager.

    Raises
    ------
    MissingInputError
        The network cannot be joined.
    """

    def __init__(self, settings: FleetSettings, folder: Path) -> None:
        self._settings = settings
        try:
            self._session: zenoh.Session = open_session(settings, folder)
        except SourceError as error:
            raise MissingInputError(str(error)) from error

    def __enter__(self) -> Fleet:
        """Itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Leave the network."""
        leave(self._session)

    def look(self) -> list[SiteStatus]:
        """Every site that is there or ought to be, by name."""
        s = self._settings
        alive = {self._site(str(r.ok.key_expr)) for r in self._alive() if r.ok is not None}
        answers: dict[str, bytes] = {}
        for reply in self._session.get(f"{s.prefix}/*/state", timeout=s.timeout_s, target=zenoh.QueryTarget.ALL):
            if reply.ok is not None and len(reply.ok.payload) <= _MOST_BYTES:
                answers[self._site(str(reply.ok.key_expr))] = reply.ok.payload.to_bytes()
        now_ns = time.time_ns()
        names = sorted({*s.sites, *alive, *answers})
        return [status(name, answers.get(name), name in alive, now_ns, s.silent_s) for name in names]

    def _alive(self) -> Iterable[zenoh.Reply]:
        pattern = f"{self._settings.prefix}/*/alive/monitor"
        return self._session.liveliness().get(pattern, timeout=self._settings.timeout_s)

    def _site(self, key: str) -> str:
        return key[len(self._settings.prefix) + 1 :].partition("/")[0]


def status(site: str, answer: bytes | None, alive: bool, now_ns: int, silent_s: float) -> SiteStatus:
    """What an answer, or none, says of a site; whatever it holds."""
    if answer is None:
        says = "there, but does not answer" if alive else "not there"
        return SiteStatus(site, TROUBLE, says)
    try:
        told = json.loads(answer)
        return _understood(site, told, now_ns, silent_s)
    except (ValueError, TypeError, AttributeError, KeyError, IndexError):
        return SiteStatus(site, TROUBLE, "its answer cannot be understood")


def _understood(site: str, told: Mapping[str, Any], now_ns: int, silent_s: float) -> SiteStatus:
    result, alarm, health = told.get("results") or {}, told.get("alarm") or {}, told.get("health") or {}
    quiet_s = (now_ns - int(health["wall_ns"])) * 1e-9 if health else None
    level = str(alarm.get("level", WELL))
    troubles = _troubles(result, health, quiet_s, silent_s)
    losses = [(float(d), float(s)) for d, s in zip(result.get("ddi") or (), result.get("ddi_std") or (), strict=True)]
    ddi, ddi_std = max(losses, default=(None, None))
    frequencies = result.get("frequencies_hz") or [None]
    return SiteStatus(
        site=site,
        state=TROUBLE if troubles and level == WELL else level,
        says="; ".join([*([str(alarm.get("reason", ""))] if level != WELL else []), *troubles])[:500],
        stories=tuple(int(story) for story in alarm.get("active", {})),
        ddi=ddi,
        ddi_std=ddi_std,
        frequency_hz=None if frequencies[0] is None else float(frequencies[0]),
        t_end_ns=result.get("t_end_ns") and int(result["t_end_ns"]),
        silent_s=quiet_s,
    )


def _troubles(
    result: Mapping[str, Any], health: Mapping[str, Any], quiet_s: float | None, silent_s: float
) -> list[str]:
    """What keeps a monitor from doing its work."""
    troubles = []
    if quiet_s is not None and quiet_s > silent_s:
        troubles.append(f"silent for {quiet_s:.0f} s")
    source = health.get("source", {})
    if source and not source.get("connected", True):
        troubles.append(f"no data: {source.get('detail') or source.get('error') or 'the source is away'}")
    troubles += [f"{name}: {why}" for name, why in health.get("failed", {}).items() if why]
    if result.get("skipped"):
        troubles.append(f"nothing judged: {result['skipped']}")
    return troubles
