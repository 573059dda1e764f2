"""Diagnoses model errors of a structure from recordings, for `diagnose`, `evaluate` and the online diagnosis."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from drivers.base import SampleBlock
from monitor.config import Configuration
from monitor.core import BadInputError, OnProgress, Step, name_stories_in
from monitor.damage import Baseline, unit_questions
from monitor.diagnosis import (
    FAR,
    ClockDrift,
    Diagnosis,
    HeldOutGain,
    Score,
    StoryLaw,
    WitnessRecord,
    WitnessSensor,
    add_observed_causes,
    compare_witnesses,
    confirm_on_held_out,
    content,
    contradictions,
    correct_clock_drifts,
    ddi_effect,
    detectable_losses,
    diagnose as diagnose_spectra,
    fitted_model,
    healthy_prior,
    is_significant,
    model_to_plain,
    other_optima,
    parameter_cost,
    refit,
    score,
    state_clock_drifts,
    story_laws,
    withdraw_other_structure,
)
from monitor.inference import (
    ObservedSpectra,
    ParameterLayout,
    Segments,
    classify,
    gather,
    make_posterior,
    maximize_posterior,
)
from monitor.model import (
    CALIBRATION_EFFECTS,
    Condition,
    Context,
    Effect,
    Model,
    StructuralPrior,
    locations,
    place_index,
    prior_from_drawing,
)
from monitor.runs.recordings import OnWarning, Progress, file_names, read_blocks

_IGNORE_OVERFLOW = np.errstate(over="ignore", invalid="ignore")
"""Setting that ignores overflow: a trial step of a fit that overflows has no likelihood, and is rejected for that."""
NO_REFERENCE = "holds nothing for a diagnosis to start from; calibrate anew, on 70 s or more without a gap"
"""What is said of a baseline of too short recordings, or rebased on another drawing. [words]"""
_MAX_INITIAL_CAUSES = 8
"""Greatest number of causes that are present from the start: every sensor may have a gain error of its own."""


@dataclass(frozen=True, eq=False, slots=True)
class Finding:
    """Diagnosis with its held-out gain, its data, its models and the content of diagnosis.json."""

    diagnosis: Diagnosis
    gain: HeldOutGain
    content: dict[str, Any]
    segments: Segments
    """In the judged band."""
    laws: tuple[StoryLaw, ...]
    """Straight from the data; empty where they cannot be had."""
    updated: Model
    """Of the old form, refitted."""
    extended: Model
    """Refitted with the causes."""
    reference_degc: float | None
    """Temperature at which the models' stiffnesses are valid."""


def diagnose(
    paths: list[Path],
    config: Configuration,
    baseline: Baseline | None,
    on_warning: OnWarning,
    on_progress: OnProgress = lambda _: None,
) -> Finding:
    """Diagnose recordings against the baseline, or against the structure file without one.

    Raises MissingInputError or BadInputError if a recording cannot be used, or the baseline has no reference for a diagnosis.
    """
    record = WitnessRecord(config.front_end(), _witnesses(config))
    segments = _read(paths, config, on_warning, on_progress, record)
    return diagnose_gathered(segments, config, baseline, record, on_progress)


@_IGNORE_OVERFLOW
def diagnose_gathered(
    segments: Segments,
    config: Configuration,
    baseline: Baseline | None,
    record: WitnessRecord | None = None,
    on_progress: OnProgress = lambda _: None,
) -> Finding:
    """Diagnose segments of a recording against the baseline, or against the structure file without one.

    Witnesses of the structure file are compared where there is a `record` of them.  Raises BadInputError if the baseline has no
    reference for a diagnosis.
    """
    if baseline is not None and baseline.reference is None:
        raise BadInputError(f"the baseline {NO_REFERENCE}")
    prior = _drawing_prior(config) if baseline is None or baseline.reference is None else baseline.reference
    confirmed, gain = diagnose_segments(segments, prior, config, on_progress)
    on_progress(Step("puts the finding into words"))
    updated, extended = (fitted_model(confirmed.posterior, fit) for fit in (confirmed.null_fit, confirmed.final_fit))
    extended = updated if confirmed.verdict == "none" else extended
    compared = []
    if record is not None:
        posterior = confirmed.posterior
        context, condition = posterior.context, posterior.conditions[0]
        compared = compare_witnesses(record, _witnesses(config), updated, extended, context, condition)
    confirmed = confirmed.contradicted({name for witness in compared for name in witness.against})
    degc = prior.reference_degc
    if degc is None and segments.temperature.size:
        degc = float(segments.temperature[:, 1].mean())
    rows = refit(confirmed, config.drawn.tolerance(), config.story_names) if baseline is None else []
    detectable: list[float | None] = []
    if baseline is not None and confirmed.verdict == "none":
        detectable = detectable_losses(confirmed.posterior, confirmed.final_fit, config.diagnosis.margin)
    optima = other_optima(confirmed, config.story_names) if baseline is None else []
    laws = story_laws(confirmed)
    plain = content(confirmed, gain, config.model().effects, ddi_effect(confirmed), rows, detectable, optima, laws)
    plain |= {"model": model_to_plain(extended, degc), "since_calibration": baseline is not None}
    plain |= {"doubts": [] if baseline is None else [*baseline.doubts, *level_doubts(segments, baseline, confirmed)]}
    plain |= {"witness": [witness.to_plain() for witness in compared]}
    plain["says"] += contradictions(compared)
    plain = name_stories_in(plain, config.story_names)
    segments = confirmed.posterior.observed.segments
    return Finding(confirmed, gain, plain, segments, laws, updated, extended, degc)


@_IGNORE_OVERFLOW
def diagnose_segments(
    segments: Segments, prior: StructuralPrior, config: Configuration, on_progress: OnProgress = lambda _: None
) -> tuple[Diagnosis, HeldOutGain]:
    """Diagnose segments of data in the band that both they and the baseline can judge, and test the causes on held-out data.

    Causes that held-out data do not confirm are withdrawn; the gain is then zero.
    """
    segments, drifts = _mended(segments, config)
    segments = segments.within(prior.judged_hz)
    found = diagnose_spectra(classify(segments), prior, _context(segments, config), config.diagnosis, on_progress)
    on_progress(Step("tests the causes on held-out data", then="puts the finding into words"))
    confirmed, gain = confirm_on_held_out(segments, withdraw_other_structure(found))
    return state_clock_drifts(add_observed_causes(confirmed), drifts), gain


@_IGNORE_OVERFLOW
def learn_healthy_prior(
    segments: Segments, config: Configuration, on_progress: OnProgress = lambda _: None
) -> StructuralPrior:
    """Learn the reference of later diagnoses from healthy data, including the causes that are present from the start."""
    segments, _ = _mended(segments, config)
    observed, context, known = classify(segments), _context(segments, config), _drawing_prior(config)
    if segments.temperature.size:
        known = replace(known, reference_degc=float(segments.temperature[:, 1].mean()))
    found = _search_healthy(observed, known, context, config, on_progress)
    on_progress(Step("learns the reference of later diagnoses"))
    return _learn_beside_causes(found, observed, context, config)


def _search_healthy(
    observed: ObservedSpectra,
    known: StructuralPrior,
    context: Context,
    config: Configuration,
    on_progress: OnProgress,
) -> Diagnosis:
    """Search healthy data for the causes that are present from the start, and once more where there may be further ones."""
    wider = _with_site_effects(known, observed, context)
    most = config.diagnosis.max_causes
    more = config.diagnosis.model_copy(update={"max_causes": max(most, _MAX_INITIAL_CAUSES)})
    if wider is None:
        return diagnose_spectra(observed, known, context, more, on_progress)
    found = diagnose_spectra(observed, known, context, config.diagnosis, on_progress, wider=wider)
    known = found.posterior.prior
    is_cut_off = sum(not c.effect.repeatable for c in found.causes) >= most
    if found.verdict != "unexplained" and not is_cut_off:
        return found
    if known.mean.size < wider.mean.size and _gains_more_than_cost(wider, found):
        known = wider
    elif not is_cut_off:  # the search ended by itself, and would again
        return found
    return diagnose_spectra(observed, known, context, more, on_progress)


def _learn_beside_causes(
    found: Diagnosis, observed: ObservedSpectra, context: Context, config: Configuration
) -> StructuralPrior:
    """Learn the reference with those causes of a search of healthy data that keep a plausible size beside each other.

    Independent of the verdict: an effect that describes the healthy data is no change later.  Of effects that no data
    distinguish, either will do.  What a steady clock does to all frequencies alike is part of the stiffness that is learned.
    """
    known, condition = found.posterior.prior, found.posterior.conditions[0]
    causes = tuple(effect for effect in found.final_fit.effects if effect.clock_factor == 1.0)
    layout, x, n_known = found.posterior.layout, found.final_fit.x, len(known.model.effects)
    sizes = [*known.persistent_parts(x[layout.structure]), *(effect.coordinates for effect in causes)]
    while True:
        same_laws = _same_laws_in_other_stories(causes, context)
        wider = _with_persistent_effects(known, (*causes, *same_laws), context, condition, n_guessed=len(same_laws))
        persistent = np.concatenate([[], *sizes, *(effect.coordinates for effect in same_laws)])
        start = np.concatenate([x[: layout.persistent.start], persistent, x[layout.excitation]])
        learnt, x = healthy_prior.learn_prior(observed, wider, context, config.diagnosis, start)
        layout = ParameterLayout.of(wider, observed.counts.size)
        is_kept = [
            is_significant(e, std) and (e.nonlinear or e.is_plausible(observed.band.hz))
            for e, std in zip(learnt.model.effects, learnt.standing_std, strict=True)
        ]
        stays = [True] * n_known + is_kept[n_known : n_known + len(causes)]
        kept = tuple(e for e, own in zip(causes, stays[n_known:], strict=True) if own)
        if kept == causes:
            return learnt.with_daily_persistent().with_known_lines()
        causes = kept  # the others are not significant next to these, or mean another effect now
        parts = wider.persistent_parts(x[layout.structure])[: len(stays)]
        sizes = [size for size, own in zip(parts, stays, strict=True) if own]


def _mended(segments: Segments, config: Configuration) -> tuple[Segments, tuple[ClockDrift, ...]]:
    """Mend what the samples alone show to be wrong: drifting clocks, and, where the search cannot model them, clipped samples."""
    whole = segments.without_clipped() if segments.drive.inputs else segments
    return correct_clock_drifts(whole, config.diagnosis)


def _with_site_effects(known: StructuralPrior, observed: ObservedSpectra, context: Context) -> StructuralPrior | None:
    """Add the effects that only a calibration searches for; return None where there is none to add, or an input was measured."""
    condition, stated = make_posterior(observed, known, context).conditions[0], {e.name for e in known.model.effects}
    effects = tuple(
        kind.starts(place, context, condition)[0]
        for name, kind in CALIBRATION_EFFECTS.items()
        if name not in stated
        for place in kind.places_in(context)
    )
    if observed.drive.inputs or not effects:
        return None
    return _with_persistent_effects(known, effects, context, condition)


def _same_laws_in_other_stories(causes: tuple[Effect, ...], context: Context) -> tuple[Effect, ...]:
    """Create nonlinear laws like those found, for every story without one, scaled by the story's stiffness.

    A mechanism that acts in one story also acts in the others, although healthy data do not show it.
    """
    stiffness, out = context.structure.stiffness_n_per_m, {(e.name, e.location): e for e in causes}
    for law in (e for e in causes if e.nonlinear and e.family == "structure" and e.location.startswith("stor")):
        if all(p.weighty for p in law.parameters):
            for place in locations("story", context):
                j = place_index(place, context.structure)
                if not context.structure.single_springs()[j]:
                    continue
                other = replace(law, location=place)
                size = law.coordinates * stiffness[j] / stiffness[law.index(context.structure)]
                out.setdefault((law.name, place), other.at(size))
    return tuple(out.values())[len(causes) :]


def evaluate(
    paths: list[Path], config: Configuration, on_warning: OnWarning, on_progress: OnProgress = lambda _: None
) -> Score:
    """Score the prediction of recordings by the structure file's model.

    Raises MissingInputError or BadInputError if a recording cannot be used.
    """
    segments = _read(paths, config, on_warning, on_progress)
    degc = config.drawn.reference_temperature_degc
    return score(segments, config.model(), _context(segments, config), degc)


def level_doubts(segments: Segments, baseline: Baseline, found: Diagnosis) -> list[str]:
    """Ask whether the unit is right where the motion is far from that at calibration; else doubt a change seen at another level.

    The baseline's windows hold more than the band and less than the source's samples, so that neither is found by the band alone.
    """
    in_band = float(np.sqrt(2.0 * segments.whole.bin_hz * segments.power.sum(axis=0)).mean())
    questions = unit_questions(float(segments.rms.mean()), in_band, baseline.level_range_m_s2)
    loudest = baseline.level_range_m_s2[1]
    said = [c.effect for c in found.causes] + [c.effect for c, _ in found.alternatives]
    if questions or in_band <= loudest or not any(effect.family == "structure" for effect in said):
        return questions
    return [
        f"the motion is {in_band / loudest:.3g} times as strong as the strongest at calibration: a stiffness or a damping that "
        "depends on the level cannot be told from one that has changed"
    ]


def _witnesses(config: Configuration) -> tuple[WitnessSensor, ...]:
    return tuple(
        WitnessSensor(s.channel, s.quantity, s.axis, s.floor, s.mounted)
        for s in config.witnesses
        if s.axis is not None and s.floor is not None
    )


def _read(
    paths: list[Path],
    config: Configuration,
    on_warning: OnWarning,
    on_progress: OnProgress,
    record: WitnessRecord | None = None,
) -> Segments:
    """Read the recordings into segments, and into `record` what the witnesses recorded; errors name the recordings."""
    progress = Progress(
        on_progress, paths, config.topics, Step("reads the recordings", then="fits the model without causes")
    )

    def count_blocks() -> Iterator[SampleBlock]:
        for block in read_blocks(paths, config, on_warning):
            progress.add(block)
            if record is not None:
                record.add(block)
            yield block

    try:
        return gather(count_blocks(), config.front_end())
    except BadInputError as error:
        message = str(error)
        raise BadInputError(message if str(paths[0]) in message else f"{file_names(paths)}: {message}") from error


def _context(segments: Segments, config: Configuration) -> Context:
    """Return the context of effects at the sample rate of the segments."""
    return config.instrumented().context(segments.rate_hz)


def _drawing_prior(config: Configuration) -> StructuralPrior:
    """Build the prior of the structure from the structure file."""
    known = prior_from_drawing(config.model(), config.instrumented().prior_std, len(config.channels))
    return replace(known, reference_degc=config.drawn.reference_temperature_degc)


def _gains_more_than_cost(wider: StructuralPrior, found: Diagnosis) -> bool:
    """Test whether a wider reference, refitted with the causes found, gains more log posterior than its parameters cost."""
    posterior, fit = found.posterior, found.final_fit
    structure = posterior.layout.structure
    x = posterior.layout.with_structure(fit.x, np.concatenate([fit.x[structure], wider.mean[structure.stop :]]))
    refitted = maximize_posterior(replace(posterior, prior=wider), x, fit.effects, iterations=FAR)
    return (
        refitted.log_posterior - fit.log_posterior - parameter_cost(posterior, wider.mean.size - structure.stop)
        > found.settings.margin
    )


def _with_persistent_effects(
    known: StructuralPrior, effects: tuple[Effect, ...], context: Context, condition: Condition, *, n_guessed: int = 0
) -> StructuralPrior:
    """Add effects, whose sizes the healthy data will determine, to the reference.

    The prior of the last `n_guessed` effects has their coordinates as mean and as standard deviation: the size may be zero or
    twice as large.
    """
    priors = [e.known(context, condition) for e in effects[: len(effects) - n_guessed]]
    priors += [(e.coordinates, e.coordinates**-2.0) for e in effects[len(effects) - n_guessed :]]
    prior_precision = np.concatenate([[], *[precision for _, precision in priors]])
    coordinates = np.concatenate([[], *[e.coordinates for e in effects]])
    coordinates = np.where(prior_precision > 0.0, np.concatenate([[], *[mean for mean, _ in priors]]), coordinates)
    precision = block_diag(known.precision, np.diag(prior_precision))
    model = replace(known.model, effects=(*known.model.effects, *effects))
    return replace(known, model=model, mean=np.concatenate([known.mean, coordinates]), precision=precision)
