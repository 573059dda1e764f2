"""State of many structures over one Zenoh network: one query asks every monitor for the state of its structure.

The keys are documented in `docs/zenoh.md`: a monitor answers ``PREFIX/SITE/state`` and holds the liveliness token
``PREFIX/SITE/alive/monitor``.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import zenoh
from pydantic import Field, ValidationError

from drivers.base import SourceError
from drivers.zenoh_session import Key, SessionSettings, leave, open_session
from monitor.config import read_toml
from monitor.core import BadConfigurationError, MissingInputError, Settings, read_settings, settings_problems
from monitor.damage import Assessment, State, outdated
from monitor.service.status import ALARM, HEALTHY, TROUBLE, exit_code, last_event, read_assessment

_MOST_BYTES = 1 << 20
"""Largest accepted answer of one monitor."""
_MOST_TEXT = 500


class FleetSettings(SessionSettings):
    """``[fleet]`` of a fleet file: how to join the network, and which sites are expected."""

    prefix: Key = "shm"
    """Common prefix of the sites' keys."""
    sites: tuple[str, ...] = ()
    """Names of the expected sites; other sites are shown too."""
    silent_s: float = Field(default=60.0, gt=0)
    """Time without a health line after which a monitor counts as hung."""
    timeout_s: float = Field(default=5.0, gt=0, le=60)
    """Time for which answers are waited for."""


class _FleetFile(Settings):
    fleet: FleetSettings


@dataclass(frozen=True, slots=True)
class SiteStatus:
    """State of one structure as its monitor reports it."""

    site: str
    state: State
    """As the monitor says it; not judged where it is silent or not there."""
    headline: str
    doubts: tuple[str, ...] = ()
    """What else holds, as sentences."""
    troubles: tuple[str, ...] = ()
    """What of the monitor does not work."""
    stories: tuple[int, ...] = ()
    """Stories with an alarm; 0 is the structure as a whole."""
    ddi: float | None = None
    """Largest relative loss of stiffness of any story in the latest window; None if that was not judged."""
    ddi_std: float | None = None
    frequency_hz: float | None = None
    """Lowest natural frequency."""
    t_end_ns: int | None = None
    """End of the latest window, UTC, ns since 1970."""
    silent_s: float | None = None
    """Time since the monitor's latest health line."""
    availability: float | None = None
    """Share of the samples that came in the latest span of health."""
    event: str = ""
    """The last event: when, the verdict, and the largest drift; empty where there was none."""

    @property
    def says(self) -> str:
        """The headline, what of the monitor does not work, and the latest event."""
        event = [f"Last event {self.event}."] if self.event else []
        return " ".join([self.headline, *(f"{trouble}." for trouble in self.troubles), *event])[:_MOST_TEXT]

    @property
    def content(self) -> dict[str, Any]:
        """The keys that `fleet --json` prints."""
        return {**asdict(self), "says": self.says}


def load(path: Path) -> FleetSettings:
    """Load and validate the settings of a fleet file.

    Raises
    ------
    MissingInputError
        The file cannot be read.
    BadConfigurationError
        The settings are invalid; the message lists one problem a line.
    """
    try:
        return read_settings(_FleetFile, read_toml(path)).fleet
    except ValidationError as error:
        raise BadConfigurationError("\n".join(f"{path}: {problem}" for problem in settings_problems(error))) from error


class Fleet:
    """Session on the network of a fleet; a context manager.

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
        """Return the session itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Leave the network."""
        leave(self._session)

    def look(self) -> list[SiteStatus]:
        """Query the state of every site that is alive, answers or is expected: the gravest first, then by name."""
        s = self._settings
        alive = {self._site(str(r.ok.key_expr)) for r in self._alive() if r.ok is not None}
        answers: dict[str, bytes] = {}
        for reply in self._session.get(f"{s.prefix}/*/state", timeout=s.timeout_s, target=zenoh.QueryTarget.ALL):
            if reply.ok is not None and len(reply.ok.payload) <= _MOST_BYTES:
                answers[self._site(str(reply.ok.key_expr))] = reply.ok.payload.to_bytes()
        now_ns = time.time_ns()
        names = {*s.sites, *alive, *answers}
        found = [status(name, answers.get(name), name in alive, now_ns, s.silent_s) for name in names]
        return sorted(found, key=lambda site: (-site.state.rank, site.site))

    def _alive(self) -> Iterable[zenoh.Reply]:
        """Query the liveliness tokens of the monitors."""
        pattern = f"{self._settings.prefix}/*/alive/monitor"
        return self._session.liveliness().get(pattern, timeout=self._settings.timeout_s)

    def _site(self, key: str) -> str:
        """Return the site's name in a key."""
        return key[len(self._settings.prefix) + 1 :].partition("/")[0]


def code(statuses: Sequence[SiteStatus]) -> int:
    """Return the exit code for all sites, as `monitor.service.status` does for one: no site at all is not well."""
    codes = {exit_code(s.state, s.troubles) for s in statuses} or {TROUBLE}
    return next(c for c in (ALARM, TROUBLE, HEALTHY) if c in codes)


def status(site: str, answer: bytes | None, alive: bool, now_ns: int, silent_s: float) -> SiteStatus:
    """Read the state of a site from its monitor's answer, JSON, or None if there was none; an answer of any content is accepted.

    A monitor that is `alive` holds its liveliness token.  `now_ns`, UTC, ns since 1970, counts only for a monitor that does
    not say how long it has been silent; after `silent_s` without a health line it counts as hung.
    """
    if answer is None:
        says = "is there, but does not answer" if alive else "is not there"
        return SiteStatus(site, State.NOT_JUDGED, f"The monitor {says}.")
    try:
        decoded = json.loads(answer)
        return _parse_status(site, decoded, now_ns, silent_s)
    except (ValueError, TypeError, AttributeError, KeyError, IndexError, OverflowError, OSError, RecursionError):
        return SiteStatus(site, State.NOT_JUDGED, "The monitor's answer cannot be understood.")


def _parse_status(site: str, answer: Mapping[str, Any], now_ns: int, silent_s: float) -> SiteStatus:
    """Read a site's state from the decoded answer of its monitor."""
    result, alarm, health = answer.get("results") or {}, answer.get("alarm") or {}, answer.get("health") or {}
    quiet_s = _quiet_s(answer, now_ns)
    said: Assessment = read_assessment(answer)
    if quiet_s is None and said.state is State.NORMAL:
        said = outdated(said, "the monitor has sent no health line", result.get("t_end_ns"))
    elif quiet_s is not None and quiet_s > silent_s:
        said = outdated(said, f"the monitor is silent for {quiet_s:.0f} s", result.get("t_end_ns"))
    losses = [(float(d), float(s)) for d, s in zip(result.get("ddi") or (), result.get("ddi_std") or (), strict=True)]
    ddi, ddi_std = max(losses, default=(None, None))
    return SiteStatus(
        site=site,
        state=said.state,
        headline=said.headline,
        doubts=said.doubts,
        troubles=tuple(_troubles(health)),
        stories=() if result.get("frequency_change") is not None else tuple(int(j) for j in alarm.get("active", {})),
        ddi=ddi,
        ddi_std=ddi_std,
        frequency_hz=_number((result.get("frequencies_hz") or [None])[0]),
        t_end_ns=result.get("t_end_ns") and int(result["t_end_ns"]),
        silent_s=quiet_s,
        availability=_number((health.get("stream") or {}).get("availability")),
        event=last_event(answer.get("event"))[:_MOST_TEXT],
    )


def _quiet_s(answer: Mapping[str, Any], now_ns: int) -> float | None:
    """Return the time since the monitor's latest line of health, s; None if it has sent none."""
    age_s, health = _number(answer.get("silent_s")), answer.get("health") or {}
    if age_s is not None and not age_s >= 0.0:
        raise ValueError("an age that is none")
    if not health:
        return None
    return (now_ns - int(health["wall_ns"])) * 1e-9 if age_s is None else age_s  # the latter by the monitor's own clock


def _number(value: Any) -> float | None:
    return None if value is None else float(value)


def _troubles(health: Mapping[str, Any]) -> list[str]:
    """List what of a monitor does not work: no data, blocked outputs."""
    troubles = []
    source = health.get("source", {})
    if source and not source.get("connected", True) and not source.get("ended"):
        troubles.append(f"source: {source.get('says') or 'away'}")
    return troubles + [f"{name}: {why}" for name, why in health.get("failed", {}).items() if why]
