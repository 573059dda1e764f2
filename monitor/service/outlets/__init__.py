"""Publishers that leave this machine or its process, by the site file's tables; each is imported only when it is asked for."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol, cast

from pydantic import BaseModel, ValidationError

from monitor.config import Configuration
from monitor.core import BadConfigurationError, settings_problems
from monitor.service.outlets.base import Outlet as Outlet
from monitor.service.outlets.inbox import Inbox
from monitor.service.outlets.notify import Addresses, Notifier, NotifySettings, addresses


def make_outlets(path: Path, config: Configuration, *, dry: bool = False) -> tuple[Outlet, ...]:
    """The publishers that a site file asks for; with `dry` its tables are only checked.

    Raises
    ------
    BadConfigurationError
        One problem a line.
    """
    folder, name = path.resolve().parent, config.site_name
    state = folder / config.output.dir / "state"
    problems: list[str] = []
    makers = [
        _maker("zenoh", config.output.zenoh, _zenoh, folder, problems),
        _maker("metrics", config.output.metrics, _metrics, folder, problems),
    ]
    settings, to = _notify(config, folder, problems)
    if problems:
        raise BadConfigurationError("\n".join(f"{path}: {problem}" for problem in problems))
    if dry:
        return ()
    made = tuple(make(name) for make in makers if make is not None)
    return Inbox(state / "requests"), *made, Notifier(name, settings, to, state / "outbox.jsonl")


def change_outlets(path: Path, config: Configuration, outlets: Sequence[Outlet]) -> None:
    """Let those of a running monitor that can go on with the settings of a file that was read again.

    Raises
    ------
    BadConfigurationError
        One problem a line; nothing has changed then.
    """
    problems: list[str] = []
    settings, to = _notify(config, path.resolve().parent, problems)
    if problems:
        raise BadConfigurationError("\n".join(f"{path}: {problem}" for problem in problems))
    for outlet in outlets:
        if isinstance(outlet, Notifier):
            outlet.change(settings, to)


def _notify(config: Configuration, folder: Path, problems: list[str]) -> tuple[NotifySettings, Addresses]:
    try:
        settings = NotifySettings.model_validate(config.notify)
        return settings, addresses(settings, folder)
    except ValidationError as error:
        problems += settings_problems(error, "notify")
    except ValueError as error:
        problems += [f"notify.{line}" for line in str(error).split("\n")]
    return NotifySettings(), Addresses()


def _zenoh() -> tuple[Any, type[BaseModel]]:
    from monitor.service.outlets.zenoh import ZenohOut, ZenohOutSettings

    return ZenohOut, ZenohOutSettings


def _metrics() -> tuple[Any, type[BaseModel]]:
    from monitor.service.outlets.metrics import Metrics, MetricsSettings

    return Metrics, MetricsSettings


def _maker(
    name: str, table: Any, load: Callable[[], tuple[Any, type[BaseModel]]], folder: Path, problems: list[str]
) -> _Maker | None:
    """What makes the outlet of a table of ``[output]``, its library loaded only where the table is there."""
    if table is None:
        return None
    try:
        kind, settings_type = load()
        settings = settings_type.model_validate(table)
    except ImportError as error:
        problems.append(f"output.{name}: cannot be loaded: {error}")
    except ValidationError as error:
        problems += settings_problems(error, "output", name)
    else:
        return lambda site: cast(Outlet, kind(site, settings, folder))
    return None


class _Maker(Protocol):
    def __call__(self, name: str) -> Outlet: ...
