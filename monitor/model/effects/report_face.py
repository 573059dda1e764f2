"""Wording of an effect in a report: a sentence with its size, and the measurement that separates it from other causes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import floor, isfinite, log10
from typing import ClassVar

from monitor.model.structures import Structure

ParameterEstimates = Mapping[str, Mapping[str, float]]
"""Map of a parameter's name to its ``value`` and standard deviation ``std``, in the parameter's unit, as in diagnosis.json."""

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
)
"""Pairs of a parameter name's suffix and its unit; the first suffix that fits counts."""


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

    Parameters
    ----------
    entry : mapping
        ``value`` and ``std`` of the estimate.
    scale : float
        Factor from the estimate's unit to `unit`.
    unit : str
        Unit to write behind the numbers.

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
    """As in diagnosis.json: ``story 2``, ``floor 1``, ``channel a2``, ``base``, ``frame``."""
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
        return self.magnitude(name, 100.0, "%", above=above)

    def share_of_floor_mass(self, name: str) -> str:
        """Write a mass as a share of the mass of the floor at `location`, in brackets and with a space before them."""
        share = 100.0 * self.value(name) / self.structure.masses_kg[int(self.place_name) - 1]
        return f" ({share:.1f} % of the floor's mass)"


class ReportFace:
    """Wording of an effect in a report."""

    name: ClassVar[str]
    signature: ClassVar[str]
    """Sign of the effect in the accelerations, in one sentence."""
    separating_measurement: ClassVar[str] = ""
    """Measurement that separates this effect from other causes; empty where no measurement is ever asked for."""

    @classmethod
    def sentence(cls, fitted: FittedSizes) -> str:
        """Say in one sentence, without its full stop, where the effect is and how large.

        Raises
        ------
        KeyError
            If a parameter is missing.
        """
        sizes = (f"{_without_unit(parameter)} {fitted.interval(parameter)}" for parameter in fitted.parameters)
        return ", ".join([f"{cls.name.replace('_', ' ')} at {fitted.location}", *sizes])
