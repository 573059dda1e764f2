"""Pipeline from a block of samples to an alarm: one function, `Pipeline.push`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from math import ceil, floor, inf

import numpy as np

from drivers.base import ACCELERATION, GROUND, TEMPERATURE, SampleBlock
from monitor.config import Configuration
from monitor.core import (
    Alarm,
    Array,
    BadInputError,
    DamageReading,
    Gap,
    LeftOutChannel,
    Level,
    ModalEstimate,
    Samples,
    Skipped,
    StiffnessEstimate,
    Temperature,
    Window,
    WindowResult,
    name_stories,
)
from monitor.damage import (
    LEVEL,
    Baseline,
    CovariateLaw,
    Effect,
    alarm,
    beyond_words,
    damage_index,
    drift_weights,
    level_db,
    slow_learning,
    smallest_detectable_loss,
)
from monitor.events import Event, EventState, GroundState, Site, ground, stage
from monitor.identification import SubArray, expected_modes, identify, refine, tracking
from monitor.signals import (
    Conditioner,
    ConditionState,
    Health,
    HealthState,
    LostState,
    WatchState,
    WindowGrid,
    WindowState,
    alignment,
    channel_watch,
    lost_samples,
    sensor_health,
    temperature,
    window_quality,
)
from monitor.signals import windows as window

_SET_BACK_S = 0.25
"""Step back of the clock from which the windows' times follow the clock, s."""
_LEAST_SHARE = 0.5
"""Share of the lowest required modes that must be found for the model to be updated without a baseline. [ratio; judgement]"""
_MOST_VIEWS = 16
"""Sets of channels in use for which the healthy state is kept at hand. [count; cost]"""
_CHECK = "check floors, signs and units of the channels, and what 'check' says of the lags"
"""What to do where not even the lowest mode is found. [words]"""
_USELESS_LOSS = 0.5
"""Loss of a story's stiffness that a window must be able to show to be judged at all. [1; judgement: near collapse]"""

Result = Samples | Gap | WindowResult | Health | Event


@dataclass(frozen=True, eq=False, slots=True)
class Run:
    """State of filters and windows for the samples since the last gap."""

    t0_ns: int
    """UTC of grid index 0, the stream's first sample, by the clock as it is set now.  Kept over gaps."""
    grid: WindowGrid
    conditioner: Conditioner
    condition: ConditionState
    window: WindowState
    lost: LostState


@dataclass(frozen=True, eq=False, slots=True)
class PipelineState:
    """Complete state of the pipeline between blocks."""

    align: alignment.AlignState
    run: Run | None
    alarm: alarm.AlarmState
    covariates: dict[str, temperature.TemperatureState]
    """Readings of the covariates that the site file names."""
    temperature: temperature.TemperatureState
    track: tracking.TrackState
    health: HealthState
    events: EventState
    ground: GroundState
    watch: WatchState
    learning: slow_learning.LearningState | None = None
    """The covariates' law as it was learned on in service; None before the first judged window."""


@dataclass(frozen=True, slots=True)
class _View:
    """What a window is judged with: the channels in use, and the healthy state as these see it."""

    array: SubArray
    baseline: Baseline | None
    drift_weights: Array
    """Shape (c, c): from the covariance of these channels' accelerations to the level of motion."""


class Pipeline:
    """Chain of the stages from samples to alarms; all times are those of the data.

    Parameters
    ----------
    config : Configuration
    baseline : Baseline, optional
        Without a baseline, modes and stiffness are compared with the structure file's, and no alarm is announced: the
        structure file is never exact, so a difference from it is no change.
    """

    def __init__(self, config: Configuration, baseline: Baseline | None = None) -> None:
        self.config = config
        self.baseline = baseline
        self.front_end = config.front_end()
        nominal = config.instrumented()
        instrumented = nominal if baseline is None else replace(nominal, model=baseline.model)
        self.reference = instrumented.model
        self.reference_modes = self.reference.modes()
        self.sensors = instrumented.sensor_matrix
        self.acquisition = tuple(e for e in nominal.model.effects if e.family == "sensor")
        self.context = instrumented.context(config.processing.rate_hz)
        self.prior_std = instrumented.stiffness_prior_std
        self.site = Site.of(instrumented, config.story_names, config.processing.window_s, config.events)
        stored = None if baseline is None else baseline.drift_weights
        cutoff_hz = config.processing.cutoff_hz
        self.drawing = nominal.model
        self.drift_weights = drift_weights(self.drawing, self.sensors, cutoff_hz) if stored is None else stored
        names = config.identification.reference_channels or config.channels
        self.past = tuple(config.channels.index(name) for name in names)
        self._views: dict[tuple[int, ...], _View] = {}
        alarms = alarm.start(self.reference.structure.n_stories, config.processing.window_s)
        self.state = PipelineState(
            alignment.start(),
            None,
            alarms,
            {table.name: temperature.start() for table in config.covariates},
            temperature.start(),
            tracking.TrackState(),
            HealthState(),
            EventState(),
            GroundState(),
            WatchState(),
        )

    def push(self, block: SampleBlock) -> list[Result]:
        """Process a block of samples and return all results that it completes, in order.

        Raises
        ------
        BadInputError
            If a channel of the structure file is missing, the unit is wrong, or the rate too low.  The state is then
            unchanged, as without the block.
        """
        before = self.state
        try:
            return self._advance(block)
        except BadInputError:
            self.state = before
            raise

    def finish(self) -> list[Event]:
        """Return what is known of events that the end of the data cuts."""
        state, told = stage.finish(self.state.events, self.site)
        self.state = replace(self.state, events=state)
        return told

    def _advance(self, block: SampleBlock) -> list[Result]:
        """Process a block of samples as `push`, without restoring the state on an error."""
        if block.topic == TEMPERATURE:
            self._store_temperature(block)
        if block.topic == GROUND and self.config.events.enabled:
            self._keep_ground(block)
        if block.topic != ACCELERATION:
            self._store_covariates(block)
            return []
        align_state, pieces = self.front_end.align(self.state.align, block, keep_partial=True)
        self.state = replace(self.state, align=align_state)
        results: list[Result] = []
        for piece in pieces:
            run = self.state.run
            if piece.gap is not None:
                results.append(piece.gap)
            if run is None or piece.gap is not None:
                run = self._begin(piece, run)
            elif piece.shift_ns:
                run = replace(run, t0_ns=run.t0_ns + piece.shift_ns)
            results += self._check_sensors(piece, align_state.dropped)
            lost_state, finite, lost = lost_samples.step(run.lost, piece, run.conditioner, run.condition)
            condition, values = run.conditioner.step_block(run.condition, finite)
            first = run.window.start + run.window.n
            t_ns = run.t0_ns + round(first / run.grid.rate_hz * 1e9)
            results.append(Samples(t_ns, run.grid.rate_hz, values if lost is None else np.where(lost, np.nan, values)))
            window_state, windows = window.step(run.grid, run.window, values, run.t0_ns, lost)
            run = replace(run, condition=condition, window=window_state, lost=lost_state)
            self.state = replace(self.state, run=run)
            for item in windows:
                end_ns = item.t_end_ns if isinstance(item, Window) else item[1]
                end = round((end_ns - run.t0_ns) * 1e-9 * run.grid.rate_hz)
                results += self._watch(run, first, values[: max(end - first, 0)])
                values, first = values[max(end - first, 0) :], max(end, first)
                result = (
                    self._assess(item, run.conditioner.cutoff_hz) if isinstance(item, Window) else self._skip(*item)
                )
                results.append(result)
                results += self._remember(result)
            results += self._watch(run, first, values)
        return results

    def _watch(self, run: Run, first: int, values: Array) -> list[Event]:
        """Look for events in conditioned samples, of which the first has grid index `first`."""
        if not (self.config.events.enabled and len(values)):
            return []
        state, told = stage.step(self.state.events, first, run.t0_ns, run.conditioner, values, self.site)
        self.state = replace(self.state, events=state)
        return told

    def _remember(self, result: WindowResult) -> list[Event]:
        """Keep what a window tells of the motion before and after events, and tell the lasting losses that are known now."""
        state, told = stage.window(self.state.events, result, self.site)
        self.state = replace(self.state, events=state)
        return told

    def _keep_ground(self, block: SampleBlock) -> None:
        """Keep the measured ground motion for the events that it may belong to."""
        state, pieces = ground.step(self.state.ground, block, self.front_end)
        found = self.state.events
        for piece in pieces:
            found = stage.keep_ground(found, piece, state.conditioner, self.config.events)
        self.state = replace(self.state, ground=state, events=found)

    def _begin(self, piece: alignment.Piece, previous: Run | None) -> Run:
        """Begin a new run of samples: filters start at rest, windows stay on the stream's grid."""
        n_channels = len(self.front_end.channels)
        self.front_end.check_rate(piece.rate_hz)
        conditioner = self.front_end.conditioner(piece.rate_hz)
        rate_hz = conditioner.rate_hz
        if previous is not None and rate_hz == previous.grid.rate_hz:
            grid = previous.grid
        else:
            grid = self.front_end.grid(conditioner, with_segments=self.config.refinement.enabled)
        t0_ns, index, last = piece.t_ns, 0, None
        if previous is not None:
            t0_ns, last = previous.t0_ns, _convert_rate(previous.window, rate_hz / previous.grid.rate_hz)
            end = last.start + last.n
            # Without rounding first, a start that lies on the grid could move by one sample.
            index = ceil(round((piece.t_ns - t0_ns) * 1e-9 * rate_hz, 6))
            if (end - index) / rate_hz >= _SET_BACK_S:  # the grid continues, and its times follow the clock
                t0_ns = piece.t_ns - round(end / rate_hz * 1e9)
            index = max(index, end)
        begun = window.start(grid, n_channels, index=index, previous=last)
        return Run(t0_ns, grid, conditioner, conditioner.start(n_channels), begun, lost_samples.start(n_channels))

    def _check_sensors(self, piece: alignment.Piece, dropped: int) -> list[Health]:
        """Update the health of the sensors, and return that of the spans that are complete."""
        c = self.config
        spans_s = c.processing.window_s + c.health.span_s
        state, found = sensor_health.step(self.state.health, piece, dropped, c.channels, c.health, spans_s)
        self.state = replace(self.state, health=state)
        return found

    def _store_temperature(self, block: SampleBlock) -> None:
        """Store the temperatures that later windows may need."""
        state = temperature.push(self.state.temperature, block, self._oldest_ns())
        self.state = replace(self.state, temperature=state)

    def _store_covariates(self, block: SampleBlock) -> None:
        """Store the readings of the covariates that this topic carries, for later windows."""
        for table in self.config.covariates:
            if table.topic == block.topic:
                before = self.state.covariates
                state = temperature.push_channel(
                    before[table.name], block, table.channel, table.unit, self._oldest_ns()
                )
                self.state = replace(self.state, covariates={**before, table.name: state})

    def _oldest_ns(self) -> int:
        """Return the time (UTC, ns) before which no later window needs a covariate."""
        c, align = self.config, self.state.align
        reach_ns = temperature.reach_ns(c.processing.window_s, c.temperature)
        return align.t_next_ns() - reach_ns if align.n_run else 0

    def _covariates(self, t_end_ns: int, item: Window | None = None, weights: Array | None = None) -> dict[str, Array]:
        """Return the lagged values of the covariates that are known of the window that ends at `t_end_ns` (UTC).

        The level of motion is that of the window `item`, by the weights of its channels; it is not known without them.
        """
        c = self.config
        known: dict[str, Array] = {}
        for name, state in {"temperature": self.state.temperature, **self.state.covariates}.items():
            mean = temperature.window_temperature(state, t_end_ns, c.processing.window_s, c.temperature)
            if mean is not None:
                known[name] = mean.lagged_degc
        if item is not None and weights is not None:
            covariance = item.sums.total[0] / item.sums.counts.sum()
            known[LEVEL] = np.array([level_db(weights, covariance)])
        return known

    @property
    def law(self) -> CovariateLaw | None:
        """The covariates' law: as calibrated, and as learned on in service."""
        if self.state.learning is not None:
            return self.state.learning.law
        return None if self.baseline is None else self.baseline.law

    def _learn(self, reading: DamageReading, covariates: dict[str, Array], t_end_ns: int, normal: bool) -> None:
        """Learn the covariates' law on from healthy service."""
        settings = self.config.compensation
        if self.law is None or not settings.learn_in_service:
            return
        state = self.state.learning or slow_learning.start(self.law, t_end_ns)
        # The index has what the law explains taken out; it is put back.
        change = np.log1p(-np.minimum(reading.ddi, 1.0 - 1e-6)) + sum(reading.covariate_effect.values(), np.zeros(1))
        state = slow_learning.step(state, covariates, change, t_end_ns, settings.unevenness, normal=normal)
        self.state = replace(self.state, learning=state)

    def _effect(self, covariates: dict[str, Array]) -> Effect | Skipped | None:
        """Predict what the covariates do to the healthy stiffness.

        Returns
        -------
        Effect, Skipped or None
            `Skipped` where the law's uncertainty alone would hide the loss of half a story's stiffness; None without a law.
        """
        if self.law is None:
            return None
        effect = self.law.expected(covariates)
        hidden = self.config.alarm.significance * float(np.sqrt(effect.covariance.diagonal().max()))
        return Skipped(beyond_words(self.law, covariates)) if hidden > _USELESS_LOSS else effect

    def _beyond(self, effect: Effect | None, covariates: dict[str, Array]) -> str:
        """Say what lies beyond calibration where the law's uncertainty alone would hide the loss of an `alarm`."""
        if effect is None or self.law is None:
            return ""
        limits, std = self.config.alarm, float(np.sqrt(effect.covariance.diagonal().max()))
        return beyond_words(self.law, covariates) if limits.significance * std > limits.alarm_loss else ""

    def _assess(self, item: Window, cutoff_hz: float) -> WindowResult:
        """Process one complete window: identification, updating, damage index, alarm."""
        c = self.config
        strong = stage.skipped(self.state.events, item.t_end_ns, item.window_s, c.events)
        if strong is not None:  # nor does it tell which channels are well
            return self._skip(item.index, item.t_end_ns, item.window_s, strong, item.rms_m_s2)
        in_use, left_out = self._choose_channels(item)
        if not in_use:
            # The level of motion is not known either.
            why = Skipped("; ".join(f"channel {gone.channel} {gone.reason}" for gone in left_out))
            return self._skip(item.index, item.t_end_ns, item.window_s, why, left_out=left_out)
        if left_out:
            item = item.only(in_use)
        view = self._view(in_use)

        covariates = self._covariates(item.t_end_ns, item, view.drift_weights)

        def skip(reason: Skipped, found: ModalEstimate | None = None, tracks: tuple[int, ...] = ()) -> WindowResult:
            """Skip the window, with the modes found in it."""
            if left_out:
                reason = Skipped(f"{reason.reason}; left out: {', '.join(gone.channel for gone in left_out)}")
            found = None if found is None else view.array.spread(found)
            skipped = self._skip(
                item.index, item.t_end_ns, item.window_s, reason, item.rms_m_s2, found, tracks, left_out
            )
            return replace(skipped, covariates=covariates)

        skipped = window_quality.check(item.sums, item.rate_hz, cutoff_hz, c.quality)
        if skipped is not None:
            return skip(skipped)
        modes = self._identify(item, cutoff_hz, view)
        judged = modes if isinstance(modes, Skipped) else self._update(modes, covariates, view)
        if isinstance(judged, Skipped):
            found = None if isinstance(modes, Skipped) else modes
            return skip(judged, found, self._track_modes(found, item, view))
        modes, stiffness, reading = judged
        if left_out:
            reading = replace(reading, channels=in_use)
        tracks = self._track_modes(modes, item, view)
        degc = covariates.get("temperature")
        detectable = None
        if self.baseline is None:
            verdict = Alarm(Level.NORMAL, (), "no baseline: a difference from the structure file is no change")
        else:
            alarms, verdict = alarm.step(self.state.alarm, reading, item.t_end_ns, c.alarm)
            verdict = replace(verdict, reason=name_stories(verdict.reason, c.story_names))
            self.state = replace(self.state, alarm=alarms)
            self._learn(reading, covariates, item.t_end_ns, verdict.level is Level.NORMAL)
            detectable = smallest_detectable_loss(reading, alarms.history, c.processing.hop_s, c.alarm)
        return WindowResult(
            item.index,
            item.t_end_ns,
            item.window_s,
            view.array.spread(modes),
            stiffness,
            reading,
            verdict,
            None,
            item.rms_m_s2,
            None if degc is None else Temperature(degc),
            tracks,
            detectable,
            covariates,
            left_out,
        )

    def _choose_channels(self, item: Window) -> tuple[tuple[int, ...], tuple[LeftOutChannel, ...]]:
        """Choose the channels that a window is judged with, and note why the others are left out."""
        c = self.config
        begin_ns = item.t_end_ns - round(item.window_s * 1e9)
        unhealthy = sensor_health.check(self.state.health, begin_ns, item.t_end_ns, c.health)
        found = channel_watch.find_faults(item, unhealthy, c.channels, c.health)
        state, in_use, left_out = channel_watch.step(self.state.watch, found, c.channels, item.t_end_ns, item.window_s)
        self.state = replace(self.state, watch=state)
        return in_use, left_out

    def _view(self, in_use: tuple[int, ...]) -> _View:
        """Return what windows of some channels are judged with; the latest views are kept."""
        if in_use not in self._views:
            if len(self._views) == _MOST_VIEWS:
                self._views.pop(next(iter(self._views)))
            array = SubArray.of(in_use, self.past, self.sensors, self.acquisition, self.context)
            healthy = None if self.baseline is None else self.baseline.seen_by(array.places)
            weights = self.drift_weights
            if len(in_use) < len(self.config.channels):
                weights = drift_weights(self.drawing, self.sensors[list(in_use)], self.config.processing.cutoff_hz)
            self._views[in_use] = _View(array, healthy, weights)
        return self._views[in_use]

    def _identify(self, item: Window, cutoff_hz: float, view: _View) -> ModalEstimate | Skipped:
        """Identify the modes of a window of the channels in use, and remove the stated sensor effects from them."""
        c = self.config
        wanted = (
            expected_modes(self.reference_modes, cutoff_hz, c.selection)
            if self.baseline is None
            else self.baseline.model_mode
        )
        refiner = partial(refine, item, settings=c.refinement)
        modes = identify(
            item,
            view.array.past,
            self.reference_modes,
            view.array.shown,
            c.identification,
            c.selection,
            wanted,
            cutoff_hz,
            refiner,
        )
        return modes if isinstance(modes, Skipped) else view.array.correct(modes)

    def _update(
        self, modes: ModalEstimate, covariates: dict[str, Array], view: _View
    ) -> tuple[ModalEstimate, StiffnessEstimate, DamageReading] | Skipped:
        """Update the stiffness to a window's modes and compare it with the baseline's.

        With a baseline, a mode that is missing or that the model cannot follow may be the change itself, and the window is not
        judged.  Without one the modes that the model can follow are enough.

        Returns
        -------
        ModalEstimate
            The modes that the stiffness was updated to.
        StiffnessEstimate
        DamageReading
        """
        c, baseline = self.config, view.baseline
        missing = self._missing(modes)
        if missing:
            required = () if baseline is None else baseline.model_mode
            fewer = min(required.index(mode) for mode in missing) if required else 0
            mend = f"set [selection] required_modes = {fewer}, or calibrate anew" if fewer else _CHECK
            return Skipped(f"{'; '.join(missing.values())}; {mend}")
        if not len(modes.deviations):
            return Skipped("the modes' uncertainty is not asked for, so nothing is judged")
        identified = tuple(int(k) for k in modes.model_mode)
        healthy = None if baseline is None else baseline.only(identified)
        if healthy is not None and healthy.model_mode != identified:
            return Skipped("modes are not the baseline's")
        effect = self._effect(covariates)
        if isinstance(effect, Skipped):
            return effect

        def step(modes: ModalEstimate) -> tuple[StiffnessEstimate, DamageReading]:
            """Update the stiffness to modes."""
            return damage_index.step(
                modes, self.reference, healthy, view.array.sensors, c.updating, effect, self.prior_std
            )

        stiffness, reading = step(modes)
        while not stiffness.converged:
            # Of the modes without each of which the updating converges, that is set aside whose absence leaves the least misfit.
            less = [modes.set_aside(k, self._unfitting(k, modes)) for k in modes.model_mode.tolist()]
            less = [] if baseline is not None else [fewer for fewer in less if not self._missing(fewer)]
            fits = [step(fewer) for fewer in less]
            left = [float(fit.mode_misfit.sum()) if fit.converged else inf for fit, _ in fits]
            if min(left, default=inf) == inf:
                worst = int(modes.model_mode[stiffness.mode_misfit.argmax()])
                mend = f"calibrate with [selection] max_modes = {worst}, or a lower [processing] cutoff_hz"
                return Skipped(f"{self._unfitting(worst, modes)}; {mend if worst else _CHECK}")
            best = left.index(min(left))
            modes, (stiffness, reading) = less[best], fits[best]
        return modes, stiffness, replace(reading, beyond=self._beyond(effect, covariates))

    def _missing(self, modes: ModalEstimate) -> dict[int, str]:
        """Return the missing modes (0 = lowest) without which a window is not judged, and why they are missing.

        With a baseline these are its lowest `required_modes`; without one, half of the model's lowest are enough.
        """
        n = self.config.selection.required_modes
        if self.baseline is not None:
            return {mode: why for mode, why in modes.missing if mode in self.baseline.model_mode[:n]}
        missing = {mode: why for mode, why in modes.missing if mode < n}
        found = int(np.count_nonzero(modes.model_mode < n))
        return missing if found < _LEAST_SHARE * (found + len(missing)) or not modes.model_mode.size else {}

    def _unfitting(self, mode: int, modes: ModalEstimate) -> str:
        """State that the model cannot follow the counterpart of its `mode` (0 = lowest)."""
        measured_hz = modes.frequencies_hz[modes.model_mode.tolist().index(mode)]
        there = f"{self.reference_modes.frequencies_hz[mode]:.3g} Hz by the model, {measured_hz:.3g} Hz in the data"
        return f"model updating did not converge with mode {mode + 1} ({there}): another direction, or torsion?"

    def _track_modes(self, modes: ModalEstimate | None, item: Window, view: _View) -> tuple[int, ...]:
        """Assign the modes of a window to tracks and return their numbers; a window without modes counts as a look too."""
        observed = tracking.observed(None if modes is None else view.array.spread(modes), item.window_s)
        state, tracked = tracking.step(self.state.track, observed, item.t_end_ns, self.config.tracking)
        self.state = replace(self.state, track=state)
        return tuple(int(number) for number in tracked.observed)

    def _skip(
        self,
        index: int,
        t_end_ns: int,
        data_s: float,
        skipped: Skipped,
        rms: float | None = None,
        modes: ModalEstimate | None = None,
        tracks: tuple[int, ...] = (),
        left_out: tuple[LeftOutChannel, ...] = (),
    ) -> WindowResult:
        """Return the result of a window without damage index: the alarm is unchanged."""
        alarms, verdict = alarm.hold(self.state.alarm, t_end_ns)
        verdict = replace(verdict, reason=name_stories(verdict.reason, self.config.story_names))
        self.state = replace(self.state, alarm=alarms)
        covariates = self._covariates(t_end_ns)
        degc = None if "temperature" not in covariates else Temperature(covariates["temperature"])
        return WindowResult(
            index,
            t_end_ns,
            data_s,
            modes,
            None,
            None,
            verdict,
            skipped,
            rms,
            degc,
            tracks,
            covariates=covariates,
            left_out=left_out,
        )


def _convert_rate(state: WindowState, ratio: float) -> WindowState:
    """Convert the extent of the runs to samples of another rate (`ratio` of new to old); at the same rate nothing changes."""
    if ratio == 1.0:
        return state
    start, end = floor(state.start * ratio), ceil((state.start + state.n) * ratio)
    past = tuple((floor(a * ratio), ceil(b * ratio), round(n * ratio)) for a, b, n in state.past_runs)
    return replace(state, start=start, n=end - start, past_runs=past)
