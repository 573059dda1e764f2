"""Base of all settings: frozen, unknown keys refused, every problem reported."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, ValidationError


class Settings(BaseModel):
    """Settings of one stage stand beside the stage; `monitor.config.configuration` reads them from TOML."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


def settings_problems(error: ValidationError, *place: str) -> list[str]:
    """One line a problem, with where it lies below `place`; without the values, which may be secret."""
    lines = []
    for problem in error.errors():
        loc = (*place, *problem["loc"])
        if problem["type"].startswith("union_tag"):
            loc = (*loc, "kind")
        elif loc[:1] == ("structure",):  # pydantic also names the table that its `kind` chose
            loc = (*loc[:1], *loc[2:])
        where = ".".join(map(str, loc))
        message = problem["msg"].removeprefix("Value error, ")
        lines += [f"{where}: {part}" if where else part for part in message.split("\n")]
    return lines
