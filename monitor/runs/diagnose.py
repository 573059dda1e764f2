"""What a simulation gets wrong, from recordings: the work behind `diagnose`, `evaluate` and the online diagnosis."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from drivers.base import SampleBlock
from monitor.config import Configuration
from monitor.core import BadInputError
from monitor.damage import Baseline
from monitor.diagnosis import (
    FAR,
    Diagnosis,
    HeldOutGain,
    Score,
    content,
    ddi_effect,
    fitted_model,
    healthy_prior,
    heldout_gain,
    is_significant,
    model_to_plain,
    parameter_cost,
    require_gain,
    score,
)
from monitor.diagnosis import diagnose as diagnose_spectra
from monitor.inference import Segments, classify, gather, maximize_posterior
from monitor.model import (
    CALIBRATION_EFFECTS,
    Condition,
    Context,
    Effect,
    Model,
    StructuralPrior,
    locations,
    prior_from_drawing,
)
from monitor.runs.recordings import OnProgress, OnWarning, Progress, file_names, read_blocks

_TRIALS = np.errstate(over="ignore", invalid="ignore")
"""A fit's trial step that overflows has no likelihood, and is refused for that."""

_STANDING = 8
"""Causes at most that stand from the start: every sensor may have a gain of its own."""


@dataclass(frozen=True, eq=False, slots=True)
class Finding:
    """A diagnosis with all that is published of it."""

    diagnosis: Diagnosis
    gain: HeldOutGain
    content: dict[str, Any]
    """diagnosis.json."""
    segments: Segments
    updated: Model
    """The old model form, refitted."""
    extended: Model
    """With the causes."""
    reference_degc: float | None
    """Temperature at which the models' stiffnesses hold."""


@_TRIALS
def diagnose(
    paths: list[Path],
    config: Configuration,
    baseline: Baseline | None,
    on_warning: OnWarning,
    on_progress: OnProgress = lambda _: None,
) -> Finding:
    """Diagnose recordings against the baseline, or against the structure file without one.

    Raises
    ------
    MissingInputError, BadInputError
    """
    segments = _read(paths, config, on_warning, on_progress)
    if baseline is not None and baseline.reference is None:
        raise BadInputError(
            "the baseline holds nothing for a diagnosis to start from; calibrate anew, on 70 s or more without a gap"
        )
    prior = _drawing_prior(config) if baseline is None or baseline.reference is None else baseline.reference
    settled, gain = diagnose_segments(segments, prior, config)
    updated, extended = (fitted_model(settled.posterior, fit) for fit in (settled.null_fit, settled.final_fit))
    degc = prior.reference_degc
    if degc is None and segments.temperature.size:
        degc = float(segments.temperature[:, 1].mean())
    plain = content(settled, gain, config.model().effects, ddi_effect(settled))
    plain |= {"model": model_to_plain(extended, degc), "since_calibration": baseline is not None}
    return Finding(settled, gain, plain, segments, updated, extended, degc)


@_TRIALS
def diagnose_segments(
    segments: Segments, prior: StructuralPrior, config: Configuration
) -> tuple[Diagnosis, HeldOutGain]:
    """The diagnosis as it stands before held-out data, and its gain there."""
    found = diagnose_spectra(classify(segments), prior, _context(segments, config), config.diagnosis)
    gain = heldout_gain(segments, found)
    settled = require_gain(found, gain)
    return settled, gain if settled is found else HeldOutGain()


@_TRIALS
def learn_healthy_prior(segments: Segments, config: Configuration) -> StructuralPrior:
    """What healthy data say of the structure: the reference of later diagnoses, with what is wrong from the start."""
    observed, context, known = classify(segments), _context(segments, config), _drawing_prior(config)
    if segments.temperature.size:
        known = replace(known, reference_degc=float(segments.temperature[:, 1].mean()))
    found = diagnose_spectra(observed, known, context, config.diagnosis)
    most = config.diagnosis.max_causes
    if found.verdict == "unexplained" or len(found.causes) >= most:  # there may be more
        condition = found.posterior.conditions[0]
        site = _site_effects(known, context, condition)
        ambient = _with_persistent_effects(known, site, context, condition)
        shaped = observed.drive is None and bool(site) and _gains_more_than_cost(ambient, found)
        if shaped or len(found.rounds) >= most:  # else the search had ended by itself, and would again
            known = ambient if shaped else known
            more = config.diagnosis.model_copy(update={"max_causes": max(most, _STANDING)})
            found = diagnose_spectra(observed, known, context, more)
    # Whatever the verdict: what describes the healthy data is no news later, and of what no data tell apart either does.
    causes, condition = found.final_fit.effects, found.posterior.conditions[0]
    while True:
        alike = _same_laws_elsewhere(causes, context)
        wider = _with_persistent_effects(known, (*causes, *alike), context, condition, n_guessed=len(alike))
        learnt = healthy_prior.learn_prior(observed, wider, context, config.diagnosis)[0]
        stays = [
            is_significant(e, std) for e, std in zip(learnt.effects(learnt.mean), learnt.standing_std, strict=True)
        ]
        found_stays = stays[len(known.model.effects) :][: len(causes)]
        kept = tuple(e for e, own in zip(causes, found_stays, strict=True) if own)
        if kept == causes:
            return learnt.with_daily_standing().with_known_lines()
        causes = kept  # beside the rest, the others are nothing


def _site_effects(known: StructuralPrior, context: Context, condition: Condition) -> tuple[Effect, ...]:
    """Return the effects that calibration alone looks for and the structure file does not state, at their first sizes."""
    stated = {effect.name for effect in known.model.effects}
    return tuple(
        kind.starts(place, context, condition)[0]
        for name, kind in CALIBRATION_EFFECTS.items()
        if name not in stated
        for kind_of_place in kind.places
        for place in locations(kind_of_place, context)
    )


def _same_laws_elsewhere(causes: tuple[Effect, ...], context: Context) -> tuple[Effect, ...]:
    """Laws like those that were found, in proportion to the stiffness of every story where none was: what bends one story bends
    the others, though healthy data do not show it."""
    stiffness, out = context.structure.stiffness_n_per_m, {(e.name, e.location): e for e in causes}
    for law in (e for e in causes if e.nonlinear and e.family == "structure" and e.location.startswith("story")):
        if all(p.weighty for p in law.parameters):
            for place in locations("story", context):
                there = replace(law, location=place)
                size = law.coordinates * stiffness[there.index] / stiffness[law.index]
                out.setdefault((law.name, place), there.at(size))
    return tuple(out.values())[len(causes) :]


def evaluate(
    paths: list[Path], config: Configuration, on_warning: OnWarning, on_progress: OnProgress = lambda _: None
) -> Score:
    """How well the structure file's model predicts recordings.

    Raises
    ------
    MissingInputError, BadInputError
    """
    segments = _read(paths, config, on_warning, on_progress)
    degc = config.structure.reference_temperature_degc
    return score(segments, config.model(), _context(segments, config), degc)


def _read(paths: list[Path], config: Configuration, on_warning: OnWarning, on_progress: OnProgress) -> Segments:
    progress = Progress(on_progress)

    def passing() -> Iterator[SampleBlock]:
        for block in read_blocks(paths, config, on_warning):
            progress.add(block)
            yield block

    try:
        return gather(passing(), config.front_end())
    except BadInputError as error:
        told = str(error)
        raise BadInputError(told if str(paths[0]) in told else f"{file_names(paths)}: {told}") from error


def _context(segments: Segments, config: Configuration) -> Context:
    return config.instrumented().context(segments.rate_hz)


def _drawing_prior(config: Configuration) -> StructuralPrior:
    known = prior_from_drawing(config.model(), config.instrumented().prior_std, len(config.channels))
    return replace(known, reference_degc=config.structure.reference_temperature_degc)


def _gains_more_than_cost(wider: StructuralPrior, found: Diagnosis) -> bool:
    """Whether what a wider reference leaves to the data explains more than what it costs, beside what was found."""
    posterior, fit = found.posterior, found.final_fit
    structure = posterior.layout.structure
    x = posterior.layout.with_structure(fit.x, np.concatenate([fit.x[structure], wider.mean[structure.stop :]]))
    there = maximize_posterior(replace(posterior, prior=wider), x, fit.effects, iterations=FAR)
    return (
        there.log_posterior - fit.log_posterior - parameter_cost(posterior, wider.mean.size - structure.stop)
        > found.settings.margin
    )


def _with_persistent_effects(
    known: StructuralPrior, effects: tuple[Effect, ...], context: Context, condition: Condition, *, n_guessed: int = 0
) -> StructuralPrior:
    """The reference with effects whose sizes healthy data are yet to tell; those of the last may be nothing or twice as large."""
    beforehand = [e.known(context, condition) for e in effects[: len(effects) - n_guessed]]
    beforehand += [(e.coordinates, e.coordinates**-2.0) for e in effects[len(effects) - n_guessed :]]
    told = np.concatenate([[], *[precision for _, precision in beforehand]])
    coordinates = np.concatenate([[], *[e.coordinates for e in effects]])
    coordinates = np.where(told > 0.0, np.concatenate([[], *[mean for mean, _ in beforehand]]), coordinates)
    precision = block_diag(known.precision, np.diag(told))
    model = replace(known.model, effects=(*known.model.effects, *effects))
    return replace(known, model=model, mean=np.concatenate([known.mean, coordinates]), precision=precision)
