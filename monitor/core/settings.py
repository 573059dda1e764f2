"""Base class of all settings: frozen, unknown keys refused, every problem reported; and the strict reading of TOML tables."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

_Model = TypeVar("_Model", bound=BaseModel)

_DATE = "a date or time"
"""Key that stands for a date of TOML, which JSON does not have. [words]"""
_NUMBERS = {"float_type": "a number", "int_type": "a whole number"}
"""Kinds of problems of pydantic where a number is wanted, and what is wanted. [names]"""
_WANTED = _NUMBERS | {
    "string_type": "text in quotation marks",
    "bool_type": "true or false",
    "path_type": "text in quotation marks",
    "tuple_type": "an array",
    "list_type": "an array",
    "dict_type": "a table",
    "model_type": "a table",
    "model_attributes_type": "a table",
}
"""Kinds of problems of pydantic where a value has another type than wanted, and what is wanted. [names]"""


class Settings(BaseModel):
    """Base class of the settings of a stage, which are defined beside it; `monitor.config.configuration` reads them from TOML."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


def read_settings(kind: type[_Model], table: Mapping[str, Any]) -> _Model:
    """Validate a table of a TOML file in pydantic's strict mode: a value of another type than the key's is refused.

    pydantic reads the table as JSON: its strict mode then takes an array for a tuple and text for a path, which TOML, as JSON,
    cannot tell apart.  Arrays and numbers of NumPy are taken as well.  Raises ValidationError if the table is invalid;
    `settings_problems` puts it into words.
    """

    def as_json(value: Any) -> Any:
        """Return numbers of NumPy as those of Python, and a date as a table, so that no key takes it."""
        return value.tolist() if hasattr(value, "tolist") else {_DATE: str(value)}

    return kind.model_validate_json(json.dumps(table, default=as_json), strict=True)


def settings_problems(error: ValidationError, *place: str) -> list[str]:
    """List the problems of a validation, one line each, with the key below `place`.

    Values may be secret: only one that reads as a number, where a number is wanted, is shown.
    """
    lines = []
    for problem in error.errors():
        loc = (*place, *problem["loc"])
        if problem["type"].startswith("union_tag"):
            loc = (*loc, "kind")
        elif loc[:1] == ("structure",):  # pydantic also names the table that `kind` selected
            loc = (*loc[:1], *loc[2:])
        where = ".".join(map(str, loc))
        message = problem["msg"].removeprefix("Value error, ")
        if problem["type"] in _WANTED:
            message = _wrong_type(problem["type"], problem["input"], where)
        lines += [f"{where}: {part}" if where else part for part in message.split("\n")]
    return lines


def _wrong_type(kind: str, value: Any, where: str) -> str:
    """Say what a key wants, by the kind of the problem, and what it was given."""
    wanted, remedy = _WANTED[kind], ""
    if wanted == "an array" and isinstance(value, dict):
        remedy = f"; one of several tables begins with [[{where}]]"
    elif wanted == "a table" and isinstance(value, list):
        remedy = f"; a single table begins with [{where}]"
    given = _type_in_words(value)
    if kind in _NUMBERS and _reads_as_number(value):
        given = f'the text "{value}"' if isinstance(value, str) else f"{given}, {value}"
        remedy = "; leave out the quotation marks" if isinstance(value, str) else remedy
    return f"must be {wanted}, and is {given}{remedy}"


def _type_in_words(value: Any) -> str:
    """Name the type of a value as TOML has it."""
    if isinstance(value, dict):
        return _DATE if value.keys() == {_DATE} else "a table"
    names = {bool: "true or false", int: "a whole number", float: "a number", str: "text", list: "an array"}
    return names.get(type(value), type(value).__name__)


def _reads_as_number(value: Any) -> bool:
    """Return whether a value is a number, or text that TOML without quotation marks would read as one."""
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        return False
    try:
        float(value)
    except ValueError:
        return False
    return True
