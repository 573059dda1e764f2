"""Outlets: publishers that send results out of the daemon's process, as the site file's tables ask.

The module of an outlet is imported only when the site file has its table.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from pydantic import BaseModel, ValidationError

from monitor.config import Configuration, security_check
from monitor.core import BadConfigurationError, missing_extra, read_settings, settings_problems
from monitor.service.outlets.base import Outlet as Outlet
from monitor.service.outlets.delivery_workers import Trial, send_test
from monitor.service.outlets.inbox import Inbox
from monitor.service.outlets.notify import Addresses, Notifier, NotifySettings, addresses
from monitor.service.threads import Chores

_log = logging.getLogger(__name__)


def make_outlets(
    path: Path, config: Configuration, *, dry: bool = False, keep: Callable[[], object] = lambda: None
) -> tuple[Outlet, ...]:
    """Create the outlets that a site file asks for; with `dry` only check its tables.

    `keep` has the copy of the output folder follow it, before a message leaves whose number is new.

    Raises
    ------
    BadConfigurationError
        A table is invalid; the message lists one problem a line.
    """
    folder, name = path.resolve().parent, config.site_name
    state = folder / config.output.dir / "state"
    problems: list[str] = []
    makers = [_maker(table, config, folder, problems) for table in ("zenoh", "mqtt", "metrics")]
    makers.append(_web(config, folder, problems))
    settings, to = _notify(config, folder, problems)
    _demand_none(path, problems)
    if to.left_out is not None:
        _log.warning(to.left_out)
    if dry:
        return ()
    inbox = Inbox(state / "requests", worker=Chores("requests"))
    optional = [make() for make in makers if make is not None]
    return (inbox, *optional, Notifier(name, settings, to, state / "outbox.jsonl", keep=keep, names=config.story_names))


def _demand_none(path: Path, problems: Sequence[str]) -> None:
    """Raise BadConfigurationError, with a line for each, where a site file has problems."""
    if problems:
        raise BadConfigurationError("\n".join(f"{path}: {problem}" for problem in problems))


def prepare_change(path: Path, config: Configuration, outlets: Sequence[Outlet]) -> Callable[[], None]:
    """Read what a reloaded site file names, and return the function that gives its settings to the outlets that support it.

    Raises
    ------
    BadConfigurationError
        The settings are invalid; the message lists one problem a line.
    """
    problems: list[str] = []
    settings, to = _notify(config, path.resolve().parent, problems)
    _demand_none(path, problems)

    def apply() -> None:
        for outlet in outlets:
            if isinstance(outlet, Notifier):
                outlet.change(settings, to)

    return apply


def send_test_messages(path: Path, config: Configuration) -> list[Trial]:
    """Send a test message to every address of ``[notify]``, and return the outcomes.

    Raises
    ------
    BadConfigurationError
        The table is invalid, or names no address.
    """
    problems: list[str] = []
    _, to = _notify(config, path.resolve().parent, problems)
    beats = [url for url in (to.heartbeat_url, to.heartbeat_blocked_url) if url is not None]
    if not problems and not to.urls and not beats:
        problems.append("notify: no address; give urls, url_file or heartbeat_url")
    _demand_none(path, problems)
    return send_test(to.urls, beats, config.site_name)


def _notify(config: Configuration, folder: Path, problems: list[str]) -> tuple[NotifySettings, Addresses]:
    """Validate the table ``[notify]`` and resolve its addresses; append what is wrong to `problems`."""
    try:
        settings = read_settings(NotifySettings, config.notify)
        return settings, addresses(settings, folder)
    except ValidationError as error:
        problems += settings_problems(error, "notify")
    except ValueError as error:
        problems += [f"notify.{line}" for line in str(error).split("\n")]
    return NotifySettings(), Addresses()


def _web(config: Configuration, folder: Path, problems: list[str]) -> Callable[[], Outlet] | None:
    """Return a function that creates the web page; None if none is wanted, or none can be made: told in `problems` or the log."""
    output, found = config.output, len(problems)
    if output.web_address is None:
        if output.web_token_file is not None:
            problems.append('output.web_token_file: without `web` there is no page; set web = "127.0.0.1:8080"')
        return None
    if (missing := missing_extra("web")) is not None:
        _log.warning("[output] web is left out: it %s", missing)
        return None
    from monitor.service.web.outlet import WebPage, read_token

    token = None
    if output.web_token_file is not None:
        try:
            token = read_token(folder / output.web_token_file)
        except ValueError as error:
            problems.append(f"output.web_token_file: {error}")
    elif not security_check.is_loopback(output.web_address[0]):
        problems.append(
            f"output.web: all who reach {output.web} could read without a token; set web_token_file, or listen at 127.0.0.1"
        )
    if len(problems) > found:
        return None
    return partial(WebPage, config.site_name, output.web_address, token, folder / output.dir)


def _maker(table: str, config: Configuration, folder: Path, problems: list[str]) -> Callable[[], Outlet] | None:
    """Return a function that creates the outlet of a table of ``[output]``; its library is loaded only if the table exists."""
    if (content := getattr(config.output, table)) is None:
        return None
    try:
        kind, settings_type = outlet_of(table)
        settings = read_settings(settings_type, content)
        password = getattr(settings, "password_file", None)
        if password is not None and not (folder / password).is_file():
            problems.append(f"output.{table}.password_file: {password}: no such file")
    except ImportError as error:
        problems.append(f"output.{table}: cannot be loaded: {error}")
    except ValidationError as error:
        problems += settings_problems(error, "output", table)
    else:
        return partial(kind, config.site_name, settings, folder)
    return None


def outlet_of(table: str) -> tuple[Callable[..., Outlet], type[BaseModel]]:
    """Import the outlet of a table of ``[output]``, and the class of its settings."""
    if table == "zenoh":
        from monitor.service.outlets.zenoh import ZenohOut, ZenohOutSettings

        return ZenohOut, ZenohOutSettings
    if table == "mqtt":
        from monitor.service.outlets.mqtt import MqttOut, MqttOutSettings

        return MqttOut, MqttOutSettings
    from monitor.service.outlets.metrics import Metrics, MetricsSettings

    return Metrics, MetricsSettings
