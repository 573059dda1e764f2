"""Shear frames with a channel a1, a2, .. on floors 1, 2, ..: as settings and as the text of a structure file."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Mapping
from typing import Any

from monitor.config import Configuration


def settings_of(text: str) -> Configuration:
    """The settings of a structure file, or of a site file, of this text."""
    return Configuration.model_validate(tomllib.loads(text))


def configured(structure: Mapping[str, Any], floors: Iterable[int], **tables: object) -> Configuration:
    """A structure of any kind with sensors on some floors."""
    sensors = [{"channel": f"a{i}", "floor": i} for i in floors]
    return Configuration.model_validate({"structure": structure, "sensors": sensors, **tables})


def shear_frame(
    masses_kg: Iterable[float], stiffness_n_per_m: Iterable[float], floors: Iterable[int] | None = None, **tables: Any
) -> Configuration:
    """A frame with sensors on every floor unless some are named; `structure` has further keys of its table."""
    known = {"kind": "shear_frame", "masses_kg": list(masses_kg), "stiffness_n_per_m": list(stiffness_n_per_m)}
    structure = known | tables.pop("structure", {})
    return configured(structure, range(1, len(known["masses_kg"]) + 1) if floors is None else floors, **tables)


def shear_frame_text(masses_kg: Iterable[float], stiffness_n_per_m: Iterable[float], **keys: Any) -> str:
    """The same with sensors on every floor as the beginning of a structure file."""
    table = {"masses_kg": list(masses_kg), "stiffness_n_per_m": list(stiffness_n_per_m), **keys}
    structure = "".join(f"{key} = {value}\n" for key, value in table.items())
    sensors = "".join(f'[[sensors]]\nchannel = "a{i}"\nfloor = {i}\n' for i in range(1, len(table["masses_kg"]) + 1))
    return f'[structure]\nkind = "shear_frame"\n{structure}{sensors}'
