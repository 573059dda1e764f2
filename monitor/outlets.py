"""Publishers that leave this machine, by the site file's tables; each is imported only when it is asked for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from pydantic import ValidationError

from monitor.config import Configuration
from monitor.errors import BadConfigurationError
from monitor.results import Gap, WindowResult

if TYPE_CHECKING:
    from monitor.publish.requests import Request


class Outlet(Protocol):
    """Never waits, never raises; why nothing gets out is in `failed`."""

    @property
    def failed(self) -> str | None:
        """None while all is well."""

    def window(self, result: WindowResult, line: str) -> None:
        """A window's results, also as its line of results.jsonl."""

    def gap(self, gap: Gap) -> None:
        """Samples are missing."""

    def health(self, health: Mapping[str, Any]) -> None:
        """A line of health.jsonl."""

    def take_requests(self) -> Sequence[Request]:
        """What operators asked for since the last call."""

    def close(self, timeout_s: float) -> None:
        """Hand over what waits, no longer than that."""


def make_outlets(path: Path, config: Configuration, *, dry: bool = False) -> tuple[Outlet, ...]:
    """The publishers that a site file asks for; with `dry` its tables are only checked.

    Raises
    ------
    BadConfigurationError
        One problem a line.
    """
    table = config.output.zenoh
    if table is None:
        return ()
    try:
        from monitor.publish.zenoh_out import ZenohOut, ZenohOutSettings

        settings = ZenohOutSettings.model_validate(table)
    except ImportError as error:
        raise BadConfigurationError(f"{path}: output.zenoh: cannot be loaded: {error}") from error
    except ValidationError as error:
        lines = (f"{path}: output.zenoh.{'.'.join(map(str, p['loc']))}: {p['msg']}" for p in error.errors())
        raise BadConfigurationError("\n".join(lines)) from error
    name = config.site.name or config.structure.name or "site"
    return () if dry else (ZenohOut(name, settings, path.resolve().parent),)
