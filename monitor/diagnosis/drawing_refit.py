"""Refit against the drawing: what fitting the stiffnesses and masses of the structure file to a recording changed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any

import numpy as np

from monitor.core import Array
from monitor.diagnosis.constancy import LinearFit
from monitor.diagnosis.lack_of_fit import find_other_structure
from monitor.diagnosis.verdict import Diagnosis
from monitor.model import interval

_INTERVAL_STDS = 2.0
"""Half width of the intervals. [standard deviations; convention: about 95 %]"""
_MAX_STATED = 3
"""Most parameters that the headline names; the list has them all. [count; judgement]"""


def refit(diagnosis: Diagnosis, tolerance: Annotated[Array, "p+n"], story_names: Sequence[str]) -> list[dict[str, Any]]:
    """Compare the stiffnesses and masses that were refitted without a baseline with those of the structure file.

    `tolerance` is the relative half width of the ranges that the structure file states for stiffnesses, then masses; NaN where it
    states none.  Return the key `refit` of diagnosis.json: a mapping for each stiffness, then each mass.  Without a stated
    tolerance `beyond_tolerance` means that the parameter differs from the drawing by more than its interval.  Empty where nothing
    can be said of the structure.
    """
    if _hides_structure(diagnosis):
        return []
    layout, fit = diagnosis.posterior.layout, diagnosis.final_fit
    both = np.r_[layout.stiffness, layout.masses]
    drawn = np.exp(diagnosis.posterior.prior.mean[both])
    ratio = np.exp(fit.x[both]) / drawn
    linear = LinearFit.of(diagnosis.posterior, fit)
    std = np.array([max(common.std for common in linear.common_sizes(j)) for j in both]) * ratio
    p = len(story_names)
    rows = []
    for j, (value, factor, error, limit) in enumerate(zip(drawn, ratio, std, tolerance, strict=True)):
        place, parameter = (f"story {j + 1}", "stiffness_n_per_m") if j < p else (f"floor {j - p + 1}", "mass_kg")
        relative = {"value": float(factor - 1.0), "std": float(error)}
        stated = bool(np.isfinite(limit))
        beyond = abs(factor - 1.0) - _INTERVAL_STDS * error > (limit if stated else 0.0)
        name = story_names[j] if j < p else place
        words = ("softer", "stiffer") if j < p else ("lighter", "heavier")
        rows.append(
            {
                "location": place,
                "parameter": parameter,
                "drawn": float(value),
                "refitted": float(value * factor),
                "std": float(value * error),
                "relative": relative["value"],
                "relative_std": relative["std"],
                "tolerance": float(limit) if stated else None,
                "beyond_tolerance": bool(beyond),
                "says": _in_words(name, relative, words),
            }
        )
    return rows


def other_optima(diagnosis: Diagnosis, story_names: Sequence[str]) -> list[dict[str, Any]]:
    """Describe other stiffnesses that explain the recording as well as those of `refit`: key `other_optima` of diagnosis.json.

    Each has a sentence without its full stop on where they differ most.  Empty where nothing can be said of the structure.
    """
    if _hides_structure(diagnosis):
        return []
    stiffness = diagnosis.posterior.layout.stiffness
    out = []
    for fit in diagnosis.other_optima:
        change = fit.x[stiffness] - diagnosis.final_fit.x[stiffness]
        j = int(np.abs(change).argmax())
        percent = 100.0 * float(np.expm1(abs(change[j])))
        says = f"{story_names[j]} {percent:.2g} % {'stiffer' if change[j] > 0 else 'softer'} would explain the data as well"
        out.append({"stiffness_n_per_m": np.exp(fit.x[stiffness]).tolist(), "says": says})
    return out


def withdraw_other_structure(diagnosis: Diagnosis) -> Diagnosis:
    """Withdraw the causes of an unexplained recording whose fit has led to another structure than that of the file."""
    if diagnosis.verdict != "unexplained":
        return diagnosis
    other = find_other_structure(diagnosis.posterior, diagnosis.final_fit, diagnosis.settings)
    return diagnosis if other is None else diagnosis.without_causes((other, *diagnosis.misfit))


def _hides_structure(diagnosis: Diagnosis) -> bool:
    """Decide if nothing can be said of the structure beside what is left over."""
    return any(m.hides_structure for m in diagnosis.left_over)


def _in_words(name: str, relative: dict[str, float], words: tuple[str, str]) -> str:
    """State the relative difference of a parameter from the drawing, without a full stop."""
    size, half = abs(relative["value"]), _INTERVAL_STDS * relative["std"]
    if size < half:
        return f"{name} is as drawn to within {100.0 * (size + half):.2g} %"
    change = interval({"value": size, "std": relative["std"]}, 100.0, "%")
    return f"{name} is {change} {words[relative['value'] > 0.0]} than drawn"


def refit_headline(rows: Sequence[dict[str, Any]]) -> str:
    """State the parameters beyond the drawing's tolerance, stiffnesses before masses, largest differences first; may be empty."""
    if not rows:
        return ""
    stated = [row for row in rows if row["tolerance"] is not None]
    beyond = [row for row in rows if row["beyond_tolerance"]]
    beyond.sort(key=lambda row: (row["parameter"] == "mass_kg", -abs(row["relative"])))
    if not beyond:
        return "Refitted, every stiffness and mass is " + (
            "within the drawing's tolerance." if stated else "as drawn, within its interval."
        )
    said = []
    for row in beyond[:_MAX_STATED]:
        limit = row["tolerance"]
        said.append(row["says"] + ("" if limit is None else f", beyond the stated tolerance of ± {100 * limit:.3g} %"))
    text = "; ".join(said)
    rest = len(beyond) - len(said)
    text += f"; and {rest} more differ" if rest else ""
    if not stated:
        text += " (the structure file states no tolerance)"
    return f"{text[:1].upper()}{text[1:]}."
