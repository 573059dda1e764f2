"""Wording of an effect in a report: a sentence with its size, and the measurement that separates it from other causes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import floor, isfinite, log10
from typing import ClassVar, Literal

from monitor.model.structures import Structure

ParameterEstimates = Mapping[str, Mapping[str, float]]
"""Map of a parameter's name to its ``value`` and standard deviation ``std``, in the parameter's unit, as in diagnosis.json."""

LawFamily = Literal["hardening", "softening", "asymmetric", "dissipating"]
"""What laws may have in common that data cannot tell apart: how the force depends on the level or the sign of the motion."""

_UNITS = (
    ("_n_s2_per_m2", "N s²/m²"),
    ("_n_s_per_m", "N s/m"),
    ("_n_per_m3", "N/m³"),
    ("_n_per_m", "N/m"),
    ("_m_s2", "m/s²"),
    ("_kg", "kg"),
    ("_hz", "Hz"),
    ("_m", "m"),
    ("_n", "N"),
    ("_s", "s"),
    ("seconds", "s"),
    ("per_degc", "1/K"),
    ("_deg", "°"),
)
"""Pairs of a parameter name's suffix and its unit; the first suffix that fits counts."""
_SIZED_STDS = 2.0
"""Smallest distance of a size from that of no effect at which a sentence states the size. [standard deviations; convention:
two sigma]"""
_MOST_PERCENT = 1000.0
"""Largest percentage that is written as a number. [percent; judgement]"""


def unit(parameter_name: str) -> str:
    """Return the unit that a parameter's name ends in; the empty string for a ratio.

    Examples
    --------
    >>> unit("k3_n_per_m3"), unit("damping_ratio")
    ('N/m³', '')
    """
    return next((text for suffix, text in _UNITS if parameter_name.endswith(suffix)), "")


def _without_unit(parameter_name: str) -> str:
    """Write a parameter's name in words, without the unit that it ends in."""
    suffix = next((s for s, _ in _UNITS if s.startswith("_") and parameter_name.endswith(s)), "")
    return parameter_name.removesuffix(suffix).replace("_", " ")


def interval(entry: Mapping[str, float], scale: float = 1.0, unit: str = "") -> str:
    """Write an estimate as its value plus or minus two standard deviations, with as many digits as these allow.

    Examples
    --------
    >>> interval({"value": 0.00213, "std": 1e-5}, 1e3, "mm")
    '2.130 ± 0.020 mm'
    """
    value, half = entry["value"] * scale, 2.0 * abs(entry["std"] * scale)
    unit = f" {unit}" if unit else ""
    if not isfinite(half) or half > 1e100 or half > 1e3 * abs(value) > 0.0:
        rough = f"{value:.2g}" if abs(value) < 10.0 or abs(value) >= 1e5 else f"{float(f'{value:.2g}'):.0f}"
        return f"about {rough}{unit} (hardly determined)"
    size = max(abs(value), half)
    tens = floor(log10(size)) if size > 0.0 else 0
    tens = tens if tens >= 5 or tens < -3 else 0
    value, half = value / 10.0**tens, half / 10.0**tens
    digits = min(1 - floor(log10(half)), 9) if half > 0.0 else 3
    shown = max(digits, 0)
    text = f"{round(value, digits):.{shown}f} ± {round(half, digits):.{shown}f}" if half > 0.0 else f"{value:.6g}"
    if tens:
        return f"({text})·10{str(tens).translate(str.maketrans('-0123456789', '⁻⁰¹²³⁴⁵⁶⁷⁸⁹'))}{unit}"
    return text + unit


@dataclass(frozen=True, eq=False, slots=True)
class FittedSizes:
    """Place and estimated parameters of one effect, with the structure that its sentence compares them with."""

    location: str
    """As in diagnosis.json: ``story 2``, ``floor 1``, ``channel a2``, ``base``, ``frame``; or as ``one of floors 1, 4``."""
    parameters: ParameterEstimates
    structure: Structure
    """The structure that "more" and "less" refer to."""
    source: str
    """Source of that structure, as a clause: ``the structure file says`` or ``at calibration``."""

    @property
    def place_name(self) -> str:
        """The location without the kind of place: ``2`` of ``story 2``, ``a1,a3`` of ``channel a1,a3``."""
        return self.location.partition(" ")[2]

    def value(self, name: str) -> float:
        """Return the estimate of a parameter, in its own unit."""
        return self.parameters[name]["value"]

    def std(self, name: str) -> float:
        """Return the standard deviation of a parameter, in its own unit."""
        return self.parameters[name]["std"]

    def interval(self, name: str) -> str:
        """Write a parameter with its sign, its interval and its unit."""
        return interval(self.parameters[name], 1.0, unit(name))

    def magnitude(self, name: str, scale: float, unit: str, *, above: float = 0.0) -> str:
        """Write the absolute difference of a parameter from `above`, with its interval, in another unit."""
        return interval({"value": abs(self.value(name) - above), "std": self.std(name)}, scale, unit)

    def percent(self, name: str, *, above: float = 0.0) -> str:
        """Write the absolute difference of a ratio from `above`, with its interval, in percent."""
        if 100.0 * abs(self.value(name) - above) > _MOST_PERCENT:
            return f"more than {_MOST_PERCENT:.0f} %"
        return self.magnitude(name, 100.0, "%", above=above)

    def is_sized(self, name: str, *, above: float = 0.0) -> bool:
        """Decide if a parameter differs from `above` by more than chance, so that a sentence may state its size."""
        return abs(self.value(name) - above) >= _SIZED_STDS * self.std(name)

    def sized(self, name: str, text: str, unsized: str = ", too little to be sized", *, above: float = 0.0) -> str:
        """Return `text`, which states a parameter's size, where `is_sized`, and `unsized` elsewhere."""
        return text if self.is_sized(name, above=above) else unsized

    def with_size(self, name: str, sentence: str, size: str, *, by: str = "by ", above: float = 0.0) -> str:
        """Put the size into a sentence, in place of <>, where `is_sized`; elsewhere say at its end that it is too little."""
        if self.is_sized(name, above=above):
            return sentence.replace("<>", f"{size} ")
        return f"{sentence.replace('<>', '')}, {by}too little to be sized"

    def share_of_floor_mass(self, name: str) -> str:
        """Write a mass as a share of the mass of the floor at `location`, in brackets and with a space before them.

        Empty where the location is not one floor.
        """
        if not self.location.startswith("floor "):
            return ""
        share = 100.0 * self.value(name) / self.structure.masses_kg[int(self.place_name.partition(" ")[0]) - 1]
        return f" ({share:.1f} % of the floor's mass)"


class ReportFace:
    """Wording of an effect in a report."""

    name: ClassVar[str]
    signature: ClassVar[str]
    """Sign of the effect in the accelerations, in one sentence."""
    separating_measurement: ClassVar[str] = ""
    """Measurement that separates this effect from other causes; empty where no measurement is ever asked for."""
    noun: ClassVar[str] = ""
    """The effect as a thing, with its article, for an answer that holds for a family of laws: ``a stop``."""
    families: ClassVar[tuple[LawFamily, ...]] = ()
    """Families of laws that the effect belongs to, whatever its sizes; most effects belong to none."""

    @classmethod
    def law_families(cls, parameters: ParameterEstimates) -> tuple[LawFamily, ...]:
        """List the families of laws that the effect belongs to at these sizes."""
        return cls.families

    @classmethod
    def sentence(cls, fitted: FittedSizes) -> str:
        """Say in one sentence, without its full stop, where the effect is and how large.

        Raises KeyError if a parameter is missing.
        """
        sizes = (f"{_without_unit(p)} {fitted.interval(p)}" for p in fitted.parameters if fitted.is_sized(p))
        return ", ".join([f"{cls.name.replace('_', ' ')} at {fitted.location}", *sizes])

    @classmethod
    def sentence_of_several(cls, fitted: Sequence[FittedSizes]) -> str:
        """Say in one sentence, without its full stop, where several of a repeatable effect are and how large."""
        return "; and ".join(cls.sentence(one) for one in fitted)
