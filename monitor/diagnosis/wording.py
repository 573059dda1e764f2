"""Wording of a diagnosis: each cause with its size and interval, the verdict, and what would separate rival causes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from monitor.diagnosis.stepwise_selection import Diagnosis
from monitor.model import FORMS, FittedSizes, ModelDiscrepancy, ParameterEstimates, StructuralPrior


def in_words(effect_name: str, location: str, parameters: ParameterEstimates, reference: StructuralPrior) -> str:
    """State an effect and its size in one sentence, without its full stop; intervals are two standard deviations.

    Parameters
    ----------
    effect_name, location, parameters
        As in diagnosis.json.
    reference : StructuralPrior
        The structure that "more" and "less" refer to.

    Raises
    ------
    KeyError
        If the effect is unknown or a parameter is missing.
    """
    source = "at calibration" if reference.basis.shape[0] else "the structure file says"
    return FORMS[effect_name].sentence(FittedSizes(location, parameters, reference.model.structure, source))


def separating_measurement(alternatives: Sequence[Mapping[str, Any]]) -> str | None:
    """State the measurement that would separate rival causes; return None where there are fewer than two of them.

    Parameters
    ----------
    alternatives : sequence of mappings
        With ``effect`` and ``location``, as in diagnosis.json.

    Examples
    --------
    >>> separating_measurement([{"effect": "added_mass", "location": f"floor {i}"} for i in (1, 2)])
    'a longer recording, or one more sensor between floor 1 and floor 2'
    """
    if len(alternatives) < 2:
        return None
    effects = list(dict.fromkeys(a["effect"] for a in alternatives))
    if len(effects) == 1:
        return "a longer recording, or one more sensor between " + " and ".join(a["location"] for a in alternatives)
    # All rivals but one need a measurement of their own; the effect with the most costly measurement states none.
    measurements = dict.fromkeys(FORMS[name].separating_measurement for name in effects)
    return "; ".join(filter(None, measurements)) or "a longer recording"


def contradicted(error: ModelDiscrepancy) -> str:
    """State in words, without a full stop, the bands in which the healthy data contradicted the model at calibration."""
    where = ", ".join(f"{low:.1f}-{high:.1f}" for low, high in error.doubtful_hz())
    return f"at {where} Hz no known effect explains the healthy data either, so what is seen there counts less"


def headline(diagnosis: Diagnosis, content: Mapping[str, Any]) -> str:
    """State the verdict in one plain sentence.

    Parameters
    ----------
    diagnosis : Diagnosis
        Its prior is the structure that "more" and "less" refer to.
    content : mapping
        diagnosis.json.
    """
    reference = diagnosis.posterior.prior
    causes = [in_words(c["effect"], c["location"], c["parameters"], reference) for c in content["causes"]]
    match content["verdict"]:
        case "none":
            if content["standing_misfit"] is not None:
                return "Nothing new: these data differ from the simulation no more than the healthy ones."
            return "Nothing wrong: the simulation explains these data."
        case "named":
            return _sentence("; and ".join(causes))
        case "ambiguous":
            rivals = "; or ".join(
                f"{in_words(a['effect'], a['location'], a['parameters'], reference)} ({100 * a['probability']:.0f} %)"
                for a in content["alternatives"]
            )
            certain = "; and ".join(causes)
            return _sentence((f"{certain}; besides, " if causes else "") + f"these data cannot tell which: {rivals}")
    worst = ""
    if diagnosis.left_over:
        where = diagnosis.left_over[0].where
        worst = (
            f" at {where.removeprefix('f = ')}"
            if where.startswith("f = ")
            else f" with what stood at calibration, {where},"
        )
    stated = f" Besides, {'; and '.join(causes)}." if causes else ""
    return f"Something is wrong{worst} that no known effect explains.{stated}"


def _sentence(text: str) -> str:
    """Capitalize a text and add a full stop."""
    return text[0].upper() + text[1:] + "."
