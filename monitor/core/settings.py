"""Base class of all settings: frozen, unknown keys refused, every problem reported."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, ValidationError


class Settings(BaseModel):
    """Base class of the settings of a stage, which are defined beside it; `monitor.config.configuration` reads them from TOML."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


def settings_problems(error: ValidationError, *place: str) -> list[str]:
    """List the problems of a validation, one line each, with the key below `place`; values may be secret and are left out."""
    lines = []
    for problem in error.errors():
        loc = (*place, *problem["loc"])
        if problem["type"].startswith("union_tag"):
            loc = (*loc, "kind")
        elif loc[:1] == ("structure",):  # pydantic also names the table that `kind` selected
            loc = (*loc[:1], *loc[2:])
        where = ".".join(map(str, loc))
        message = problem["msg"].removeprefix("Value error, ")
        lines += [f"{where}: {part}" if where else part for part in message.split("\n")]
    return lines
