"""Learns the healthy baseline from recordings: of a structure with a model in one pass over them, of modes alone in two."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from drivers.base import SampleBlock
from drivers.mcap_file import recording_info
from monitor.config import Configuration
from monitor.core import (
    BadInputError,
    CrossSpectra,
    Gap,
    ModalEstimate,
    OnProgress,
    Step,
    WindowResult,
    sha256,
    together,
)
from monitor.damage import (
    AnyBaseline,
    Baseline,
    HealthyData,
    HealthySpectrum,
    ModalBaseline,
    Observation,
    Origin,
    Presence,
    Sighting,
    Update,
    learn_baseline,
    learn_modal_baseline,
    learn_presence,
    learn_spectrum,
    load_baseline,
    rebase_baseline,
    second_solutions,
)
from monitor.diagnosis import clock_drift_in_words, contradicted, correct_clock_drifts, standing_causes
from monitor.identification import KnownModes, tracking
from monitor.inference import Segments, gather
from monitor.model import FORMS, StructuralPrior
from monitor.pipeline import Pipeline
from monitor.runs import diagnose
from monitor.runs.baselines import modal_origin
from monitor.runs.recordings import OnWarning, Progress, evenly, file_names, push_block, read_blocks

_COMMON_MODE_SHARE = 0.9
"""Share of the windows in which a mode must be identified to belong to the baseline."""
_REQUIRED_MODE_SHARE = 0.5
"""The same for the modes of `[selection] required_modes`: windows without them are left out. [ratio; judgement]"""
_FOUND_SHARE = 0.5
"""Share of the looks in which a mode must be found by itself to become one that is looked for. [ratio; judgement: what is learned
is decided by the share of the windows in which it is found then]"""
_MAX_LEARNED_S = 40_000.0
"""Greatest length of the healthy data from which the reference of diagnoses is learned, s: 4000 segments of 20 s."""
_SHORT_RECORDINGS_BYTES = 40_000_000
_HOUR_NS = 3_600_000_000_000
_MOST_SPECTRA = 100
"""Most windows from which the shape of the spectrum is learned. [count; cost: each look at one takes milliseconds]"""
_LEARNS, _SEARCHES = "updates the model to the modes", "looks for what is so from the start"

Learned = TypeVar("Learned", Baseline, ModalBaseline)


def calibrate(
    paths: list[Path],
    config: Configuration,
    *,
    on_warning: OnWarning = lambda _: None,
    on_progress: OnProgress = lambda _: None,
) -> tuple[Baseline, Update]:
    """Learn the healthy baseline, and the reference of later diagnoses, from recordings; return it with its model updating.

    Raises MissingInputError or BadInputError if a recording cannot be used, or no window can be identified.
    """
    healthy = _Pass(paths, config, on_progress, Step("evaluates the windows", then=_LEARNS))
    segments = _gather_hourly(healthy.blocks(on_warning), config, _learned_share(paths, config))
    kept = healthy.kept(on_warning)
    on_progress(Step(_LEARNS, then=_SEARCHES))
    baseline, fit = learn_baseline(
        config.instrumented(),
        healthy.data_of(kept),
        updating=config.updating,
        compensation=config.compensation,
        drift_weights=healthy.pipeline.level_weights,
    )
    baseline = healthy.with_clock(baseline, on_warning)
    _warn_of_ambiguities(baseline, config, kept[-1], on_warning)
    if segments is None:
        on_warning("too short for a diagnosis to learn from; 'diagnose' will not take this baseline")
        return baseline, fit
    for drift in correct_clock_drifts(segments, config.diagnosis)[1]:
        on_warning(
            f"{clock_drift_in_words(drift, config.channels, segments.drive)}; mend it, or every diagnosis will say so"
        )
    reference = diagnose.learn_healthy_prior(segments, config, on_progress)
    _warn_of_sensors(reference, config, on_warning)
    if reference.error is not None:
        on_warning(contradicted(reference.error))
    return replace(baseline, reference=reference), fit


def calibrate_modes(
    paths: list[Path],
    config: Configuration,
    *,
    on_warning: OnWarning = lambda _: None,
    on_progress: OnProgress = lambda _: None,
) -> ModalBaseline:
    """Learn the healthy modes of a structure without a model from recordings.

    The first pass chooses the modes of each window by themselves, and takes those that come again and again.  The second finds
    these in each window, as every later window is evaluated, and learns from that (errors as of `calibrate`).
    """
    first = _Pass(paths, config, on_progress, Step("looks for the modes", then="evaluates the windows with them"))
    first.read(on_warning)
    first.require_window()
    reference = first.known_modes()
    if reference is None:
        because = f", the last because: {first.skipped}" if first.skipped else "; record for longer"
        raise BadInputError(f"{file_names(paths)}: no mode is found again and again{because}")
    on_second = Step("evaluates the windows with the modes found", then="learns the baseline")
    healthy = _Pass(paths, config, on_progress, on_second, reference)
    healthy.read(lambda _: None)
    kept = healthy.kept(on_warning)
    baseline = learn_modal_baseline(
        config.channels, modal_origin(config), healthy.data_of(kept), compensation=config.compensation
    )
    return healthy.with_clock(baseline, on_warning)


@dataclass(frozen=True, eq=False, slots=True)
class _Looked:
    """A window of all channels in which modes were looked for; those that are noted share no data."""

    t_ns: int
    """End of the window, UTC."""
    modes: ModalEstimate
    spectra: CrossSpectra | None


class _Pass:
    """A pass over healthy recordings: their windows, and what is learned from those that are kept."""

    def __init__(
        self,
        paths: list[Path],
        config: Configuration,
        on_progress: OnProgress,
        step: Step,
        reference: KnownModes | None = None,
    ) -> None:
        self.pipeline, self.skipped = Pipeline(config, reference=reference), ""
        self._paths, self._config = paths, config
        self._progress = Progress(on_progress, paths, config.topics, step)
        self._good, self._reasons, self._gaps_ns = list[WindowResult](), list[str](), list[int]()
        self._seen = list[_Looked]()

    def blocks(self, on_warning: OnWarning) -> Iterator[SampleBlock]:
        """Yield the blocks after the pipeline has evaluated them."""
        for block in read_blocks(self._paths, self._config, on_warning):
            self._progress.add(block)
            for result in push_block(self.pipeline, block, self._paths):
                if isinstance(result, Gap):
                    self._gaps_ns.append(result.t_ns)
                if isinstance(result, WindowResult):
                    self.skipped = self.skipped if result.skipped is None else result.skipped.mend
                    why = _why_not_learned(result)
                    self._note(result)
                    self._good.extend([] if why else [result])
                    self._reasons.extend([why] if why else [])
            yield block

    def _note(self, result: WindowResult) -> None:
        """Note a window of all channels in which modes were looked for, if it shares no data with those noted before."""
        window_ns = round(self._config.processing.window_s * 1e9)
        is_apart = not self._seen or result.t_end_ns - self._seen[-1].t_ns >= window_ns
        if result.modes is None or result.left_out or not is_apart:
            return
        self._seen.append(_Looked(result.t_end_ns, result.modes, result.spectra))

    def read(self, on_warning: OnWarning) -> None:
        """Evaluate all blocks."""
        for _ in self.blocks(on_warning):
            pass

    def require_window(self) -> None:
        """Refuse recordings without a window (BadInputError)."""
        self._progress.require_window(self.pipeline, len(self._good) + len(self._reasons), self._paths)

    def known_modes(self) -> KnownModes | None:
        """Take the tracked modes that come again and again, and how the windows showed them; None where there are none."""
        select, windows = self._config.selection, [w.modes for w in self._good if w.modes is not None]
        often = _common_tracks(self.pipeline.state.track, select.max_modes)
        if not often:
            return None
        spread = float(np.log(self._config.processing.cutoff_hz / select.min_frequency_hz))
        return KnownModes.of(often, windows, self._config.tracking, spread)

    def kept(self, on_warning: OnWarning) -> list[WindowResult]:
        """Select the windows that are learned from, with the modes in common to them; BadInputError if there are too few."""
        self.require_window()
        good, reasons = self._good, self._reasons
        if not good:
            raise BadInputError(
                f"{file_names(self._paths)}: no window could be identified, the last because: {reasons[-1]}"
            )
        if reasons:
            on_warning(f"{len(reasons)} of {len(good) + len(reasons)} windows were left out, the last: {reasons[-1]}")
        kept = with_common_modes(good, self._config.selection.required_modes)
        self._progress.require_periods([r.modes for r in kept if r.modes is not None], self._paths)
        _warn_of_missing_modes(good, kept, on_warning)
        return kept

    def data_of(self, kept: list[WindowResult]) -> HealthyData:
        """Collect what a baseline is learned from."""
        assert self._progress.first is not None
        return HealthyData(
            windows=[r.modes for r in kept if r.modes is not None],
            rms_m_s2=np.array([r.rms_m_s2 for r in kept]),
            recordings=tuple({"file": p.name, "sha256": sha256(p)} for p in self._paths),
            span_ns=(self._progress.first.t_ns, self.pipeline.state.align.t_next_ns()),
            covariates=[r.covariates for r in kept if r.modes is not None],
            units={"level": "dB", "temperature": "degC", **{t.name: t.unit for t in self._config.covariates}},
            t_ns=[r.t_end_ns for r in kept if r.modes is not None],
            records=self._records_of(r.t_end_ns for r in kept),
            window_s=self._config.processing.window_s,
            presence=None if self._config.has_model else self._presence(kept),
            spectrum=None if self._config.has_model else self._spectrum(),
            motion=[r.motion for r in kept if r.motion is not None],
        )

    def _presence(self, kept: list[WindowResult]) -> Presence:
        """Learn from all windows that share no data, those left out for lack of a mode too, how often each mode is found."""
        assert kept[0].modes is not None
        wanted = kept[0].modes.model_mode.tolist()
        band_hz = self._config.selection.min_frequency_hz, self._config.processing.cutoff_hz
        sightings = [Sighting.of(w.modes, wanted, w.t_ns) for w in self._seen]
        return learn_presence(sightings, self._records_of(w.t_ns for w in self._seen), len(wanted), band_hz)

    def _spectrum(self) -> HealthySpectrum | None:
        """Learn the shape of the spectrum from windows that share no data, of many as many as `_MOST_SPECTRA`."""
        seen = [w for w in self._seen if w.spectra is not None]
        seen = (
            [seen[k] for k in np.unique(np.linspace(0, len(seen) - 1, _MOST_SPECTRA).round().astype(int))]
            if seen
            else []
        )
        return learn_spectrum(
            [w.spectra for w in seen if w.spectra is not None], self._records_of(w.t_ns for w in seen)
        )

    def _records_of(self, ends_ns: Iterable[int]) -> list[int]:
        """Number the record, a stretch without gaps, of each window by its end."""
        return [int(k) for k in np.searchsorted(self._gaps_ns, list(ends_ns))]

    def with_clock(self, baseline: Learned, on_warning: OnWarning) -> Learned:
        """Note the clock of the healthy data in a baseline, and warn of it and of covariates that ran together."""
        _warn_of_clock(self.pipeline, on_warning)
        _warn_of_confounding(baseline, on_warning)
        return replace(baseline, clock_ratio=self.pipeline.state.align.clock.ratio)


def rebase(path: Path, config: Configuration) -> tuple[Baseline, tuple[str, ...], bool]:
    """Update a changed drawing to the healthy modes of a baseline's file, without recordings.

    Returned are the baseline with the changed drawing's updated model, what changed and what is left out, and whether the
    updating converged.

    Raises MissingInputError, BadInputError or BadConfigurationError if the file is no baseline, or one of other sensors, samples
    or numbers of masses and stiffnesses.
    """
    instrumented = config.instrumented()
    old, here = load_baseline(path, instrumented, config.updating, redrawn=True), Origin.of(instrumented)
    says = old.origin.drawing_differences(here)
    if old.origin.is_named_otherwise(here):
        says.insert(
            0, f"it was of {old.origin.name!r} and is of {here.name!r} now: right only if that is the same structure"
        )
    if old.origin.fingerprint == here.fingerprint:
        says.append("masses, stiffnesses and matrices are drawn as before: all else is kept")
        return replace(old, origin=here, doubts=()), tuple(says), old.converged
    new, fit = rebase_baseline(old, instrumented, config.updating)
    says.append(f"the updating to the healthy modes {'converged' if fit.converged else 'did NOT converge'}")
    says.append(
        f"the model's form leaves an error of {100 * new.model_form:.2g} % of a loss, {100 * old.model_form:.2g} % before"
    )
    if old.law is not None:
        says.append(
            "the dependence on level and temperature is kept: a change that all stories have alike does not depend on the drawing"
        )
    if old.reference is not None:
        says.append(
            "left out: what diagnoses start from, which was fitted to spectra with the old drawing; 'diagnose' needs a baseline "
            "calibrated anew from recordings"
        )
    return new, tuple(says), bool(fit.converged)


def _learned_share(paths: list[Path], config: Configuration) -> float:
    """Compute the share of every hour from which the reference is learned, so that memory stays bounded."""
    if sum(p.stat().st_size for p in paths) < _SHORT_RECORDINGS_BYTES:
        return 1.0
    seconds = sum(recording_info(p, topic_map=config.topics or None, evenly=evenly).duration_s for p in paths)
    return min(1.0, _MAX_LEARNED_S / seconds)


def _gather_hourly(blocks: Iterator[SampleBlock], config: Configuration, share: float) -> Segments | None:
    """Gather the segments in the first `share` of every hour; None if there are too few.

    All blocks are read, also those outside these segments.
    """
    refused: list[BadInputError] = []

    def beginnings_of_hours() -> Iterator[SampleBlock]:
        begun = 0
        try:
            for block in blocks:
                begun = begun or block.t_ns
                if (block.t_ns - begun) % _HOUR_NS < share * _HOUR_NS:
                    yield block
        except BadInputError as error:
            refused.append(error)
            raise

    try:
        return gather(beginnings_of_hours(), config.front_end())
    except BadInputError:
        if refused:
            raise
        return None


def _common_tracks(state: tracking.TrackState, most: int) -> list[tracking.Track]:
    """Take the tracked modes that were found in most looks, at most `most`, by frequency."""
    looks = max((t.hits + t.misses for t in state.tracks), default=0.0)
    often = sorted((t for t in state.tracks if t.hits >= _FOUND_SHARE * looks), key=lambda t: -t.hits)[:most]
    return sorted(often, key=lambda t: t.ln_f)


def _why_not_learned(result: WindowResult) -> str:
    """Say why nothing is learned from a window: it was skipped, or lacks a channel; empty otherwise."""
    if result.skipped is not None:
        return result.skipped.mend
    return "; ".join(f"channel {gone.channel} {gone.reason}" for gone in result.left_out)


def with_common_modes(windows: list[WindowResult], required: int) -> list[WindowResult]:
    """Select the modes that the windows have in common, and the windows with all these modes.

    The model's `required` lowest modes belong to them if `_REQUIRED_MODE_SHARE` of the windows have them, a higher one if
    `_COMMON_MODE_SHARE` of the windows with these have it.
    """
    lowest = _modes_in(windows, _REQUIRED_MODE_SHARE, range(required))
    windows = [w for w in windows if w.modes is not None and lowest <= set(w.modes.model_mode.tolist())]
    common = lowest | _modes_in(windows, _COMMON_MODE_SHARE)
    kept = [replace(w, modes=w.modes.only(common)) for w in windows if w.modes is not None]
    return [w for w in kept if w.modes is not None and w.modes.model_mode.size == len(common)]


def _modes_in(windows: list[WindowResult], share: float, among: range | None = None) -> frozenset[int]:
    """List the model's modes (0 = lowest) that at least a share of the windows has."""
    seen = Counter(int(k) for w in windows if w.modes is not None for k in w.modes.model_mode)
    return frozenset(k for k, n in seen.items() if n >= share * len(windows) and (among is None or k in among))


def _warn_of_missing_modes(windows: list[WindowResult], kept: list[WindowResult], on_warning: OnWarning) -> None:
    """Warn of modes of the model that the baseline lacks, and of windows left out for lack of its modes."""
    why = {mode: text for w in windows if w.modes is not None for mode, text in w.modes.missing}
    has = {int(mode) for w in kept[:1] if w.modes is not None for mode in w.modes.model_mode}
    for mode, text in sorted(why.items()):
        if mode not in has:
            on_warning(f"{text}; the baseline goes without this mode")
    if len(kept) < len(windows):
        on_warning(
            f"{len(windows) - len(kept)} of {len(windows)} windows were left out: they lack a mode of the others"
        )


def _warn_of_clock(pipeline: Pipeline, on_warning: OnWarning) -> None:
    """Warn of a rate that the timestamps contradict: what is learned is right for a source with the same error."""
    align = pipeline.state.align
    if align.is_at_odds:
        on_warning(
            f"the samples come at {align.rate_hz * align.clock.ratio:.6g} Hz by their timestamps, at {align.rate_hz:g} Hz as "
            "the recording states; the stated rate is used"
        )


def _warn_of_confounding(baseline: AnyBaseline, on_warning: OnWarning) -> None:
    """Warn of covariates that ran together, so that their effects are not told apart."""
    for one, other, r in () if baseline.law is None else baseline.law.confounded():
        on_warning(
            f"{one} and {other} ran together at calibration (their effects have a correlation of {r:+.2f}): which of them "
            "moves the stiffness is not known; longer healthy data would tell"
        )


def _warn_of_sensors(reference: StructuralPrior, config: Configuration, on_warning: OnWarning) -> None:
    """Warn of errors of the acquisition that the healthy data show and the structure file does not state."""
    stated = {(effect.name, effect.location) for effect in config.model().effects}
    for cause in standing_causes(reference):
        if FORMS[cause["effect"]].family == "sensor" and (cause["effect"], cause["location"]) not in stated:
            on_warning(f"{cause['says']}; the baseline takes that for healthy: mend it and calibrate anew")


def _warn_of_ambiguities(baseline: Baseline, config: Configuration, last: WindowResult, on_warning: OnWarning) -> None:
    """Warn of stories without influence on the modes, and of other stiffnesses that explain the same frequencies."""
    unidentified = last.damage.unidentified if last.damage is not None else ()
    if unidentified:
        names = together([config.story_names[j - 1] for j in unidentified], config.story_names)
        on_warning(
            f"the modes say next to nothing about {names}: damage there cannot be judged; more sensors or more modes would help"
        )
    if config.updating.use_shapes:
        return
    z = baseline.z - baseline.misfit
    target = Observation(z, np.eye(z.size), np.zeros((1, z.size)), baseline.model_mode, (), baseline.log)
    for other in second_solutions(baseline.model, config.instrumented().sensor_matrix, target, config.updating):
        on_warning(
            f"the same frequencies also follow from stiffnesses {', '.join(f'{k:.1f}' for k in other)} N/m: frequencies "
            "alone cannot tell which is true; set use_shapes = true under [updating]"
        )
