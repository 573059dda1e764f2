"""Wording of a diagnosis: each cause with its size and interval, the verdict, and what would separate rival causes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from monitor.diagnosis.cross_validation import HeldOutGain
from monitor.diagnosis.drawing_refit import refit_headline
from monitor.diagnosis.lack_of_fit import LackOfFit
from monitor.diagnosis.verdict import Diagnosis, Doubt
from monitor.inference import Segments
from monitor.model import FORMS, FittedSizes, LawFamily, ModelDiscrepancy, ParameterEstimates, StructuralPrior

_MAX_RIVALS = 2
"""Rival causes that the headline states in full where there are more than one beyond them. [count; judgement]"""
_PLURALS = {"story": "stories", "floor": "floors", "channel": "channels"}
_DOUBTS: dict[Doubt, str] = {
    "not constant": "ranges of frequency or level, or other channels, disagree on it",
    "contradicted": "a sensor that entered no fit contradicts it",
}
_FAMILIES: dict[LawFamily, str] = {
    "hardening": "hardens with the level",
    "softening": "softens with the level",
    "asymmetric": "is softer one way than the other",
    "dissipating": "dissipates more energy than the model does",
}


def in_words(effect_name: str, location: str, parameters: ParameterEstimates, reference: StructuralPrior) -> str:
    """State an effect and its size in one sentence, without its full stop; intervals are two standard deviations.

    The parameters are as in diagnosis.json, and `reference` is the structure that "more" and "less" refer to.

    Raises
    ------
    KeyError
        If the effect is unknown or a parameter is missing.
    """
    return FORMS[effect_name].sentence(_sizes(location, parameters, reference))


def _sizes(location: str, parameters: ParameterEstimates, reference: StructuralPrior) -> FittedSizes:
    """Join place and parameters of an effect with the structure that its sentence compares them with."""
    source = "at calibration" if reference.is_baseline else "the structure file says"
    return FittedSizes(location, parameters, reference.model.structure, source)


def separating_measurement(alternatives: Sequence[Mapping[str, Any]]) -> str | None:
    """State the measurement that would separate rival causes; return None where there are fewer than two of them.

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


def band_in_words(segments: Segments, prior: StructuralPrior) -> list[str]:
    """State what part of the band of ``[processing]`` is not judged, and why, in sentences without their full stops."""
    band, whole, known = segments.band, segments.whole, prior.judged_hz or (0.0, np.inf)
    ends = (
        ("below", float(band.hz[0]), float(whole.hz[0]), band.forces_hz[0], "begins", known[0]),
        ("above", float(band.hz[-1]), float(whole.hz[-1]), band.forces_hz[1], "ends", known[1]),
    )
    out = []
    for side, limit, farthest, forced, verb, healthy in ends:
        if limit == farthest:
            continue
        why = (
            "the recording that the baseline was learned from could not be judged there"
            if abs(limit - healthy) < 0.5 * band.bin_hz
            else f"the power of all channels {verb} at {forced:.1f} Hz, more steeply than a structure's can: the forces "
            f"that shake it {verb.removesuffix('s')} there, or a filter or the sensors' noise takes over"
        )
        out.append(f"{side} {limit:.1f} Hz nothing is judged: {why}")
    return out


def law_family(alternatives: Sequence[Mapping[str, Any]]) -> LawFamily | None:
    """Name the family of laws that all rival causes belong to; None where there is none."""
    families = [FORMS[a["effect"]].law_families(a["parameters"]) for a in alternatives]
    return next((name for name in (families[0] if families else ()) if all(name in own for own in families)), None)


def class_in_words(alternatives: Sequence[Mapping[str, Any]], reference: StructuralPrior) -> str:
    """State what rival causes, most probable first, have in common in one sentence, without its full stop."""
    effects = list(dict.fromkeys(a["effect"] for a in alternatives))
    places = _one_of(alternatives)
    if len(effects) == 1 and places and _agree_in_sign(alternatives):
        return f"{in_words(effects[0], places, _mixture(alternatives), reference)}; which one cannot be told"
    family = law_family(alternatives)
    if family is not None and places:
        laws = " or ".join(dict.fromkeys(FORMS[name].noun for name in effects))
        return f"{places} {_FAMILIES[family]} ({laws})"
    shown = alternatives[: _MAX_RIVALS if len(alternatives) > _MAX_RIVALS + 1 else None]
    said = [in_words(a["effect"], a["location"], a["parameters"], reference) for a in shown]
    more = len(alternatives) - len(said)
    said += [f"one of {more} other causes is at work"] if more else []
    return f"these data cannot tell whether {', or '.join(said)}"


def _one_of(alternatives: Sequence[Mapping[str, Any]]) -> str:
    """Write the places of rival causes as one: ``story 1``, ``one of floors 1, 4``; empty where they are of several kinds."""
    places = sorted({a["location"] for a in alternatives})
    kinds = {place.partition(" ")[0] for place in places}
    if len(places) == 1:
        return str(places[0])
    if len(kinds) > 1 or not kinds <= set(_PLURALS) or any("," in place for place in places):
        return ""
    names = [place.partition(" ")[2] for place in places]
    names.sort(key=lambda name: (len(name), name))  # so that floor 10 follows floor 9
    return f"one of {_PLURALS[kinds.pop()]} {', '.join(names)}"


def _agree_in_sign(alternatives: Sequence[Mapping[str, Any]]) -> bool:
    """Decide if every parameter of rivals of one effect has the same sign, so that one sentence fits all."""
    values = [[entry["value"] for entry in a["parameters"].values()] for a in alternatives]
    return all(np.ptp(np.sign(column)) == 0.0 for column in zip(*values, strict=True))


def _mixture(alternatives: Sequence[Mapping[str, Any]]) -> ParameterEstimates:
    """Compute mean and standard deviation of each parameter over rivals of one effect, weighted by their probabilities."""
    weight = np.array([a["probability"] for a in alternatives])
    weight = weight / weight.sum()
    out = {}
    for name in alternatives[0]["parameters"]:
        value, std = (np.array([a["parameters"][name][key] for a in alternatives]) for key in ("value", "std"))
        mean = float(weight @ value)
        spread = float(np.sqrt(weight @ (value - mean) ** 2))
        out[name] = {"value": mean, "std": float(np.hypot(spread, (weight @ std)))}
    return out


def headline(diagnosis: Diagnosis, gain: HeldOutGain, content: Mapping[str, Any]) -> str:
    """State in few plain sentences what was refitted, what was found, and why no gain can be had; `content` is diagnosis.json."""
    optima = "; or ".join(o["says"] for o in content["other_optima"])
    parts = [refit_headline(content["refit"]), _sentence(optima) if optima else ""]
    parts += [_verdict_in_words(diagnosis, gain, content), _also_fitted_in_words(content, diagnosis.posterior.prior)]
    return " ".join(filter(None, parts))


def _verdict_in_words(diagnosis: Diagnosis, gain: HeldOutGain, content: Mapping[str, Any]) -> str:
    reference = diagnosis.posterior.prior
    causes = _causes_in_words(content["causes"], reference)
    match content["verdict"]:
        case "none":
            if not reference.is_baseline:
                return "The refitted model explains these data; without a baseline nothing is said of damage."
            return f"Nothing new beside the healthy data{_smallest_loss(content['detectable_loss'])}."
        case "named":
            return _sentence(causes + _without_causes(content, reference)) + _limits_of_gain(gain)
        case "ambiguous":
            rivals = class_in_words(content["alternatives"], reference)
            return _sentence((f"{causes}; besides, " if causes else "") + rivals) + _limits_of_gain(gain)
    return _unexplained_in_words(diagnosis.left_over, gain, causes)


def _unexplained_in_words(left_over: Sequence[LackOfFit], gain: HeldOutGain, causes: str) -> str:
    """State what the causes, in words, leave over."""
    explained = "".join(f"{_sentence(m.says)} " for m in left_over if m.is_explained)
    unexplained = [m.where for m in left_over if not m.is_explained]
    if explained and not unexplained:
        return (explained + (_sentence(f"besides, {causes}") if causes else "")).rstrip()
    worst = unexplained[0] if unexplained else ""
    if worst:
        band = worst.removeprefix("f = ")
        worst = f" at {band}" if band != worst else f" with what stood at calibration, {band},"
    said = f"{explained}Something is wrong{worst} that no known effect explains."
    if gain.is_significant:
        return f"{said} Besides, {causes}." if causes else said
    changed = any(m.changes for m in left_over)
    if not causes or not (changed or gain.withheld):
        return said
    why = gain.withheld or "the motion changed within the recording"
    return f"{said} Besides, {causes} (no gain on held-out data: {why})."


def _causes_in_words(causes: Sequence[Mapping[str, Any]], reference: StructuralPrior) -> str:
    """State all causes in one sentence, without its full stop; several modes that the model lacks are listed together."""
    several = [c for c in causes if FORMS[c["effect"]].repeatable]
    said = [c["says"] for c in causes if len(several) < 2 or c not in several]
    if len(several) > 1:
        sizes = [_sizes(c["location"], c["parameters"], reference) for c in several]
        said.append(FORMS[several[0]["effect"]].sentence_of_several(sizes))
    return "; and ".join(said)


def _also_fitted_in_words(content: Mapping[str, Any], reference: StructuralPrior) -> str:
    """State what was fitted beside the causes and why it is none; empty where there is nothing."""
    fitted = [c for c in content["also_fitted"] if c["doubt"] == "no news"]
    if not fitted:
        return ""
    said = _causes_in_words(fitted, reference)
    return _sentence(f"also fitted, no news beside modes that the model lacks or that calibration did not see: {said}")


def not_relied_on(content: Mapping[str, Any]) -> list[str]:
    """State what was fitted and is not to be relied on, a sentence without its full stop each, to stand below the headline."""
    doubted = [(c["says"], _DOUBTS[c["doubt"]]) for c in content["also_fitted"] if c["doubt"] in _DOUBTS]
    return [f"also fitted, not to be relied on, for {why}: {says}" for says, why in doubted]


def _limits_of_gain(gain: HeldOutGain) -> str:
    """State why the interval of the held-out gain does not exclude zero, or what the extended model predicts worse."""
    if gain.withheld:
        return f" No gain on held-out data can be had: {gain.withheld}."
    if gain.is_significant and gain.ci95[0] <= 0.0:
        return (
            " The gain on held-out data is not significant alone; but without a cause what calibration learned would have "
            "to have changed."
        )
    if gain.ci95[0] <= 0.0:
        return (
            f" Only loud stretches show it: their gain on held-out data is {gain.nats:.0f} nats, though the interval of "
            "the mean gain includes zero."
        )
    if gain.csd_error_rises:
        errors = f"{csd_error_in_words(gain.csd_error_before)} -> {csd_error_in_words(gain.csd_error_after)}"
        return (
            f" Held-out data are more probable with this, but the error of their cross-spectra is larger ({errors}): the "
            "form of what was added is not yet right."
        )
    if gain.csd_error_after > 1.0:
        return (
            " The model's form is not yet right: it predicts the cross-spectra of held-out data with an error of "
            f"{csd_error_in_words(gain.csd_error_after)}, so that sizes may be wrong by more than their intervals."
        )
    return ""


def _without_causes(content: Mapping[str, Any], reference: StructuralPrior) -> str:
    """State what remains of a change since the baseline with a sensor's fault taken out; empty where none was found alone."""
    left, effects = content["ddi_effect"].get("with") or [], [FORMS[c["effect"]] for c in content["causes"]]
    is_sensors = any(effect.family == "sensor" for effect in effects)
    if not left or not is_sensors or not reference.is_baseline or any(e.is_stiffness_loss for e in effects):
        return ""
    them = "it" if len(content["causes"]) == 1 else "them"
    return f"; with {them} taken out no story changed by more than {100.0 * max(abs(v) for v in left):.1f} %"


def _smallest_loss(detectable: Sequence[float | None]) -> str:
    """State the smallest loss that a diagnosis would have found in any story; empty where it is not known."""
    if not detectable:
        return ""
    unseen = [f"story {j}" for j, loss in enumerate(detectable, 1) if loss is None]
    seen = [loss for loss in detectable if loss is not None]
    notes = [f"no loss above {100.0 * max(seen):.2g} % in any {'other ' * bool(unseen)}story"] if seen else []
    notes += [f"a loss in {', '.join(unseen)} would not have been found"] if unseen else []
    return ": " + "; ".join(notes) + (" (smallest that would have been found)" if seen else "")


def csd_error_in_words(error: float) -> str:
    """State the relative squared error of cross-spectra: in percent, or beyond that as a multiple of the measured power.

    Examples
    --------
    >>> csd_error_in_words(0.123), csd_error_in_words(4225.0)
    ('12.3 %', '65 times the measured power, worse than no prediction')
    """
    if error <= 1.0:
        return f"{100.0 * error:.1f} %"
    return f"{np.sqrt(error):.3g} times the measured power, worse than no prediction"


def _sentence(text: str) -> str:
    return text[0].upper() + text[1:] + "."
