"""Files of a diagnosis: diagnosis.json, and the structure file with the fitted model (docs/diagnosis.md)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import tomlkit
from scipy.special import logsumexp
from tomlkit.items import AoT

from monitor.core import Array, encode
from monitor.diagnosis import wording
from monitor.diagnosis.cross_validation import HeldOutGain
from monitor.diagnosis.score_test import Candidate
from monitor.diagnosis.story_forces import StoryLaw
from monitor.diagnosis.verdict import Cause, Diagnosis
from monitor.diagnosis.witness import NOT_DETERMINED
from monitor.inference import Segments
from monitor.model import FORMS, Building, Effect, LawFamily, Model, StructuralPrior


def content(
    diagnosis: Diagnosis,
    gain: HeldOutGain,
    known: Iterable[Effect],
    ddi_effect: Mapping[str, Any],
    refit: Sequence[Mapping[str, Any]] = (),
    detectable_loss: Sequence[float | None] = (),
    optima: Sequence[Mapping[str, Any]] = (),
    laws: Sequence[StoryLaw] = (),
) -> dict[str, Any]:
    """Collect the content of diagnosis.json.

    `known` are the effects that the structure file itself states, which are no finding of the calibration.  `ddi_effect`,
    `refit`, `detectable_loss`, `optima` and `laws` are as of `monitor.diagnosis.ddi_effect`, `refit`, `detectable_losses`,
    `other_optima` and `story_laws`; with a baseline nothing is refitted, and there are no other optima.
    """
    prior = diagnosis.posterior.prior
    e = prior.error
    causes = [_described(c, prior) for c in diagnosis.causes]
    alternatives = [_alternative(c, share, prior) for c, share in diagnosis.alternatives]
    family = wording.law_family(alternatives)
    stated = {(e.name, e.location) for e in known}
    out: dict[str, Any] = {
        "verdict": diagnosis.verdict,
        "cause": causes[0] if diagnosis.verdict == "named" else None,
        "causes": causes,
        "alternatives": alternatives,
        "family": family,
        "family_log_odds": None if family is None else _finite(_family_log_odds(diagnosis, family)),
        "also_fitted": [{**_described(c, prior), "doubt": c.doubt} for c in diagnosis.also_fitted],
        "separating_measurement": wording.separating_measurement(alternatives),
        "misfit": [{"where": m.where, "size": _finite(m.size), "says": m.says} for m in diagnosis.misfit],
        "gain": {
            "log_score_per_sample": {
                "before": gain.before,
                "after": gain.after,
                "gain": gain.value,
                "ci95": list(gain.ci95),
            },
            "csd_error": {"before": gain.csd_error_before, "after": gain.csd_error_after},
            "heldout": gain.heldout,
        },
        "standing": [c for c in standing_causes(prior) if (c["effect"], c["location"]) not in stated],
        "standing_misfit": None if e is None else {"bands_hz": e.doubtful_hz(), "says": wording.contradicted(e)},
        "tried": [
            {"effect": c.effect.name, "location": c.effect.location, "log_evidence_over_none": _finite(c.log_evidence)}
            for c in diagnosis.candidates
        ],
        "left_over": [{"where": m.where, "size": _finite(m.size), "says": m.says} for m in diagnosis.left_over],
        "band": _band(diagnosis.posterior.observed.segments, prior),
        "left_out": encode(diagnosis.posterior.observed.segments.left_out),
        "story_laws": [_story_law(law) for law in laws],
        "ddi_effect": dict(ddi_effect),
        "refit": list(refit),
        "other_optima": list(optima),
        "detectable_loss": list(detectable_loss),
    }
    return {**out, "says": wording.headline(diagnosis, gain, out)}


def _family_log_odds(diagnosis: Diagnosis, family: LawFamily) -> float:
    """Compute the log odds of the rivals, laws of one family, against all candidates of no such law and none, together."""

    def belongs(effect: Effect) -> bool:
        return family in type(effect).law_families({k: {"value": v, "std": 0.0} for k, v in effect.values().items()})

    others = [c.log_evidence for c in (diagnosis.rounds or ((),))[-1] if not belongs(c.effect)]
    return float(logsumexp([c.log_evidence for c, _ in diagnosis.alternatives]) - logsumexp([0.0, *others]))


def _band(segments: Segments, prior: StructuralPrior) -> dict[str, Any]:
    """Describe the band that was judged, within that of ``[processing]``."""
    judged_hz, processing_hz = ([float(f) for f in band.hz[[0, -1]]] for band in (segments.band, segments.whole))
    return {"judged_hz": judged_hz, "processing_hz": processing_hz, "says": wording.band_in_words(segments, prior)}


def _story_law(law: StoryLaw) -> dict[str, Any]:
    """Describe the law of a story as the data show it, at small and at large drifts."""
    numbers = {
        name: [_finite(float(v)) for v in getattr(law, name)]
        for name in (
            *("drift_m", "stiffness_n_per_m", "stiffness_std", "loss", "loss_std"),
            *("model_stiffness_n_per_m", "model_loss"),
        )
    }
    return {"location": f"story {law.story}", **numbers, "says": law.says}


def _described(cause: Cause, prior: StructuralPrior) -> dict[str, Any]:
    """Describe an effect; the shape of a mode stands apart from its parameters, its largest component 1."""
    effect = cause.effect
    sizes = {name: {"value": _finite(v), "std": _finite(cause.std[name])} for name, v in effect.values().items()}
    named = {p.name for p in type(effect).parameters}
    out: dict[str, Any] = {
        "effect": effect.name,
        "location": effect.location,
        "parameters": {name: size for name, size in sizes.items() if name in named},
        "says": wording.in_words(effect.name, effect.location, sizes, prior),
    }
    shape = [size for name, size in sizes.items() if name.startswith("shape_")]  # a coupled mode has more of its own
    if shape:
        largest = max((size["value"] for size in shape), key=abs)
        out["shape"] = [{"value": s["value"] / largest, "std": s["std"] / abs(largest)} for s in shape]
    return out


def _alternative(candidate: Candidate, probability: float, prior: StructuralPrior) -> dict[str, Any]:
    """Describe a rival cause with its probability, its parameters and a sentence."""
    effect = candidate.effect
    n = len(effect.parameters)
    variance = np.diag(candidate.fit.covariance)[candidate.fit.x.size - n :]
    cause = Cause.of(effect, np.sqrt(np.maximum(variance, 0.0)))
    return {**_described(cause, prior), "probability": probability}


def standing_causes(prior: StructuralPrior) -> list[dict[str, Any]]:
    """Describe the effects that calibration found, with the standard deviations of their parameters from the healthy data."""
    # Scaled by their own units: the precision of a law's size in N/m^3 is of the order of 1e-24, which would pass for zero.
    unit = np.maximum(np.diag(prior.precision), 1e-300) ** -0.5
    variance = unit**2 * np.diag(np.linalg.pinv(prior.precision * np.outer(unit, unit), hermitian=True))
    own = zip(prior.effects(prior.mean), prior.persistent_parts(np.sqrt(np.maximum(variance, 0.0))), strict=True)
    return [_described(Cause.of(effect, np.hypot(std, effect.form_std)), prior) for effect, std in own]


def _finite(value: float) -> float:
    """Clip a number to the finite range of JSON; a NaN becomes the largest number."""
    return float(np.clip(np.nan_to_num(value, nan=NOT_DETERMINED), -NOT_DETERMINED, NOT_DETERMINED))


def model_to_plain(model: Model, reference_degc: float | None) -> dict[str, Any]:
    """Convert a fitted model, whose stiffnesses hold at `reference_degc`, to plain lists and numbers for JSON."""
    return {
        "stiffness_n_per_m": _plain(model.structure.stiffness_n_per_m),
        "masses_kg": _plain(model.structure.masses_kg),
        "modal_damping_ratio": None if model.modal_damping is None else _plain(model.modal_damping),
        "stiffness_correction_n_per_m": None if model.correction is None else _plain(model.correction),
        "reference_temperature_degc": reference_degc,
        "effects": [{"effect": e.name, "location": e.location, "parameters": e.values()} for e in model.effects],
    }


def model_from_plain(content: Mapping[str, Any], drawn: Model) -> Model:
    """Build the fitted model from the content that `model_to_plain` returned, on the model of the structure file.

    Raises
    ------
    ValueError, KeyError, TypeError
        If the content is no model of this structure.
    """
    n, b, p = drawn.structure.n_dofs, drawn.structure.n_masses, drawn.structure.n_stories

    def array(name: str, *shape: int) -> Array | None:
        return None if content[name] is None else np.array(content[name], dtype=float).reshape(shape)

    stiffness, masses = array("stiffness_n_per_m", p), array("masses_kg", b)
    if stiffness is None or masses is None:
        raise ValueError("no stiffnesses or no masses")
    return replace(
        drawn.with_stiffness(stiffness).with_masses(masses),
        effects=tuple(FORMS[e["effect"]].create(e["location"], e["parameters"]) for e in content["effects"]),
        correction=array("stiffness_correction_n_per_m", n, n),
        modal_damping=array("modal_damping_ratio", n),
    )


def structure_text(text: str, model: Model, reference_degc: float | None = None) -> str:
    """Write a fitted model into the text of a structure file; all other tables and all comments stay as they are.

    The temperature at which the model's stiffnesses hold, `reference_degc`, is written where an effect depends on it.
    """
    document = tomlkit.parse(text)
    table: Any = document["structure"]
    structure = model.structure
    for key, values in structure.in_file().items():
        if isinstance(structure, Building):
            for storey, value in zip(document["storeys"], _plain(values), strict=True):
                storey[key] = value
        else:
            table[key] = _plain(values)
    if model.modal_damping is not None:
        table["modal_damping_ratio"] = _plain(model.modal_damping)
    if model.correction is not None and model.correction.any():
        table["stiffness_correction_n_per_m"] = _plain(model.correction)
    if reference_degc is not None and any(e.temperature_lag_s is not None for e in model.effects):
        table["reference_temperature_degc"] = float(f"{reference_degc:.6g}")
    return effects_text(tomlkit.dumps(document), model.effects)


def effects_text(text: str, effects: Iterable[Effect]) -> str:
    """Write effects into the text of a structure file.

    Parameters are set where the file states the effect already; other effects are added.  Two effects of a kind at one place add
    up, so each has an entry of its own.

    Examples
    --------
    >>> from monitor.model import FORMS
    >>> change = FORMS["stiffness_change"].create("story 1", {"relative": -0.1})
    >>> print(effects_text("", [change]).splitlines()[-1])
    parameters = {relative = -0.1}
    """
    document = tomlkit.parse(text)
    listed: Any = document.get("effects")
    if not isinstance(listed, AoT):
        document.pop("effects", None)
        listed = tomlkit.aot()
    stated = list(listed)
    for effect in effects:
        matches = [i for i, t in enumerate(stated) if (t["effect"], t["location"]) == (effect.name, effect.location)]
        if matches:
            entry = stated.pop(matches[0])
        else:
            entry = tomlkit.table()
            entry["effect"], entry["location"] = effect.name, effect.location
            listed.append(entry)
        parameters = tomlkit.inline_table()
        parameters.update({name: float(f"{value:.10g}") for name, value in effect.values().items()})
        entry["parameters"] = parameters
    if listed and "effects" not in document:
        document["effects"] = listed
    return tomlkit.dumps(document)


def _plain(values: Array) -> Any:
    """Round an array to ten significant digits, as lists nested like the array."""
    return [_plain(v) for v in values] if values.ndim else float(f"{float(values):.10g}")
