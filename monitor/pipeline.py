"""Pipeline from a block of samples to an alarm: one function, `Pipeline.push`."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial
from math import ceil, floor
from typing import Annotated

import numpy as np

from drivers.base import ACCELERATION, GROUND, TEMPERATURE, SampleBlock
from monitor.config import Configuration
from monitor.core import (
    CLOCK,
    GAP,
    STILL,
    Array,
    BadInputError,
    Gap,
    LeftOutChannel,
    ModalEstimate,
    Samples,
    Skipped,
    Temperature,
    Window,
    WindowResult,
)
from monitor.damage import (
    LEVEL,
    AnyBaseline,
    Baseline,
    CovariateLaw,
    Memory,
    ModalBaseline,
    ModalStiffness,
    Quantities,
    Sighting,
    StoryStiffness,
    View,
    alarm,
    clock_error,
    judge,
    level_db,
    slow_learning,
)
from monitor.events import Event, EventState, GroundState, Site, ground, stage
from monitor.identification import KnownModes, tracking
from monitor.signals import (
    BesideState,
    Conditioner,
    FilterRun,
    Health,
    HealthState,
    KnownBlocks,
    StillState,
    WatchState,
    WindowGrid,
    WindowState,
    alignment,
    beside,
    channel_watch,
    conditioned,
    repeats,
    sensor_health,
    stillness,
    temperature,
    window_quality,
    windows as window,
)

_SET_BACK_S = 0.25
"""Step back of the clock from which the windows' times follow the clock, s."""
_MOST_VIEWS = 16
"""Sets of channels in use for which the healthy state is kept at hand. [count; cost]"""
Result = Samples | Gap | WindowResult | Health | Event


@dataclass(frozen=True, eq=False, slots=True)
class Run:
    """State of filters and windows for the samples since the last gap."""

    t0_ns: int
    """UTC of grid index 0, the stream's first sample, by the clock as it is set now.  Kept over gaps."""
    grid: WindowGrid
    filters: FilterRun
    window: WindowState

    @property
    def conditioner(self) -> Conditioner:
        """The filters' design."""
        return self.filters.conditioner


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
    still: StillState
    learning: slow_learning.LearningState | None = None
    """The covariates' law as it was learned on in service; None before the first judged window."""
    sightings: tuple[Sighting, ...] = ()
    """Modes of the latest windows, where modes alone are judged."""
    known: dict[str, KnownBlocks] = field(default_factory=dict)
    """Latest blocks of each topic, of which none is taken a second time."""
    beside: BesideState = field(default_factory=BesideState)
    """Health of the channels that enter no estimate."""


class Pipeline:
    """Chain of the stages from samples to alarms; all times are those of the data.

    Without a baseline no alarm is announced.  The modes of the windows are numbered by those of `reference` where there is
    neither a model nor a baseline.
    """

    def __init__(
        self,
        config: Configuration,
        baseline: AnyBaseline | None = None,
        reference: KnownModes | None = None,
    ) -> None:
        self.config = config
        self.baseline = baseline
        self.front_end = config.front_end()
        self.quantities, self.site = _quantities(config, baseline, reference)
        self._views: dict[tuple[int, ...], View] = {}
        self.state = PipelineState(
            alignment.start(),
            None,
            self.quantities.start(config.processing.window_s),
            {table.name: temperature.start() for table in config.covariates},
            temperature.start(),
            tracking.TrackState(),
            HealthState(),
            EventState(),
            GroundState(),
            WatchState(),
            stillness.start(len(config.channels)),
        )

    def push(self, block: SampleBlock) -> list[Result]:
        """Process a block of samples and return all results that it completes, in order; none for one that came before.

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

    @property
    def level_weights(self) -> Annotated[Array, "c c"] | None:
        """How the level of motion is measured with all channels (`View.level_weights`)."""
        return self._view(tuple(range(len(self.config.channels)))).level_weights

    @property
    def law(self) -> CovariateLaw | None:
        """The covariates' law: as learned on in service, else as calibrated."""
        if self.state.learning is not None:
            return self.state.learning.law
        return None if self.baseline is None else self.baseline.law

    def finish(self) -> list[Event]:
        """Return what is known of events that the end of the data cuts."""
        state, told = stage.finish(self.state.events, self.site, partial(sensor_health.saturated, self.state.health))
        self.state = replace(self.state, events=state)
        return told

    def _advance(self, block: SampleBlock) -> list[Result]:
        """Process a block of samples as `push`, without restoring the state on an error."""
        before = self.state.known.get(block.topic, KnownBlocks())
        known = repeats.step(before, block)
        if known is None:
            if block.topic == ACCELERATION:
                align = self.state.align
                self.state = replace(self.state, align=replace(align, dropped=align.dropped + block.n_samples))
            return []
        known_blocks = {**self.state.known, block.topic: known}
        if block.topic != ACCELERATION:
            self.state = replace(self.state, known=known_blocks)
            self._store_beside(block)
            return []
        align = replace(self.state.align, late=0) if repeats.overlaps(before, block) else self.state.align
        align_state, pieces = self.front_end.align(align, block, keep_partial=True)
        others = beside.step(self.state.beside, block, self.front_end.channels, self.config.health)
        self.state = replace(self.state, align=align_state, beside=others, known=known_blocks)
        return [result for piece in pieces for result in self._take_in(piece)]

    def _take_in(self, piece: alignment.Piece) -> list[Result]:
        """Process consecutive samples of the structure: sensors, conditioned samples, events and windows, in order."""
        results: list[Result] = [] if piece.gap is None else [piece.gap]
        run = self.state.run
        if run is None or piece.gap is not None:
            self.front_end.check_rate(piece.rate_hz)
        filters, part = conditioned.step(None if run is None else run.filters, piece, self.front_end)
        values, lost = part.values, part.lost
        if run is None or part.begins:
            run = self._begin(piece, filters, run)
        elif piece.shift_ns:
            run = replace(run, t0_ns=run.t0_ns + piece.shift_ns)
        results += self._check_sensors(piece, self.state.align.dropped)
        first = run.window.start + run.window.n
        t_ns = run.t0_ns + round(first / run.grid.rate_hz * 1e9)
        results.append(Samples(t_ns, run.grid.rate_hz, values if lost is None else np.where(lost, np.nan, values)))
        window_state, windows = window.step(run.grid, run.window, values, run.t0_ns, lost)
        run = replace(run, filters=filters, window=window_state)
        self.state = replace(self.state, run=run)
        for item in windows:
            end_ns = item.t_end_ns if isinstance(item, Window) else item[1]
            end = round((end_ns - run.t0_ns) * 1e-9 * run.grid.rate_hz)
            results += self._watch(run, first, values[: max(end - first, 0)])
            values, first = values[max(end - first, 0) :], max(end, first)
            result = self._assess(item, run.conditioner.cutoff_hz) if isinstance(item, Window) else self._skip(*item)
            results.append(result)
            results += self._remember(result)
        return results + self._watch(run, first, values)

    def _store_beside(self, block: SampleBlock) -> None:
        """Store what is measured beside the structure's motion, for the windows and events that it may belong to."""
        if block.topic == TEMPERATURE:
            self._store_temperature(block)
        if block.topic == GROUND and self.config.events.enabled:
            self._keep_ground(block)
        self._store_covariates(block)

    def _watch(self, run: Run, first: int, values: Array) -> list[Event]:
        """Look for events in conditioned samples, of which the first has grid index `first`."""
        if not (self.config.events.enabled and len(values)):
            return []
        saturated = partial(sensor_health.saturated, self.state.health)
        state, told = stage.step(self.state.events, first, run.t0_ns, run.conditioner, values, self.site, saturated)
        self.state = replace(self.state, events=state)
        return told

    def _remember(self, result: WindowResult) -> list[Event]:
        """Keep what a window tells of the motion before and after events, and tell the lasting losses that are known now."""
        state, told = stage.window(self.state.events, result, self.site)
        if state is not self.state.events:
            self.state = replace(self.state, events=state)
        return told

    def _keep_ground(self, block: SampleBlock) -> None:
        """Keep the measured ground motion for the events that it may belong to."""
        state, pieces = ground.step(self.state.ground, block, self.front_end)
        found = self.state.events
        for piece in pieces:
            found = stage.keep_ground(found, piece, state.conditioner, self.config.events)
        self.state = replace(self.state, ground=state, events=found)

    def _begin(self, piece: alignment.Piece, filters: FilterRun, previous: Run | None) -> Run:
        """Begin a new run of samples: windows stay on the stream's grid."""
        conditioner = filters.conditioner
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
        begun = window.start(grid, len(self.front_end.channels), index=index, previous=last)
        return Run(t0_ns, grid, filters, begun)

    def _check_sensors(self, piece: alignment.Piece, dropped: int) -> list[Health]:
        """Update the health of the sensors, and return that of the spans that are complete."""
        c = self.config
        spans_s = max(c.processing.window_s, c.events.reach_s) + c.health.span_s
        state, found = sensor_health.step(self.state.health, piece, dropped, c.channels, c.health, spans_s)
        still = stillness.step(self.state.still, piece, self.front_end.step_s, c.processing.window_s)
        others, found = beside.tell(self.state.beside, found)
        self.state = replace(self.state, health=state, still=still, beside=others)
        return found

    def _rates_hz(self) -> tuple[float, float]:
        """Return the rate that the source states, and its rate by the timestamps, Hz."""
        align = self.state.align
        return align.rate_hz, align.rate_hz * align.clock.ratio

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

    def _assess(self, item: Window, cutoff_hz: float) -> WindowResult:
        """Process one complete window: identification, comparison with the reference, alarm."""
        c = self.config
        begin_ns = item.t_end_ns - round(item.window_s * 1e9)
        # Neither tells which channels are well, nor a dead logger the level of motion.
        saturated = partial(sensor_health.saturated, self.state.health)
        still = stillness.check(self.state.still, begin_ns, item.t_end_ns, saturated)
        strong = stage.skipped(self.state.events, item.t_end_ns, item.window_s, c.events)
        if still is not None and (
            strong is None or still.reason.startswith(STILL)
        ):  # an event may saturate all sensors
            return self._skip(item.index, item.t_end_ns, item.window_s, still)
        if strong is not None:
            return self._skip(item.index, item.t_end_ns, item.window_s, strong, item.rms_m_s2)
        in_use, left_out = self._choose_channels(item)
        if not in_use:
            # The level of motion is not known either.
            why = Skipped("; ".join(f"channel {gone.channel} {gone.reason}" for gone in left_out))
            return self._skip(item.index, item.t_end_ns, item.window_s, why, left_out=left_out)
        if left_out:
            item = item.only(in_use)
        view = self._view(in_use)

        covariates = self._covariates(item.t_end_ns, item, view.level_weights)

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
        modes = self.quantities.identify(item, cutoff_hz, view, c)
        if isinstance(modes, Skipped):
            return skip(modes, None, self._track_modes(None, item, view))
        memory = Memory(self.state.alarm, self.state.learning, self.state.sightings)
        spectra = None if c.has_model or left_out else item.cross_spectra
        judged = judge.step(self.quantities, memory, modes, covariates, view, item.t_end_ns, c, spectra)
        if isinstance(judged, Skipped):
            return skip(judged, modes, self._track_modes(modes, item, view))
        memory, said = judged
        self.state = replace(self.state, alarm=memory.alarm, learning=memory.learning, sightings=memory.sightings)
        degc, detectable, rates_hz = covariates.get("temperature"), said.detectable_loss, self._rates_hz()
        if detectable is not None and self.baseline is not None:
            shown_per_loss = self.quantities.parts.shown_per_loss
            detectable = detectable + clock_error(rates_hz, self.baseline.clock_ratio, shown_per_loss)
        return WindowResult(
            item.index,
            item.t_end_ns,
            item.window_s,
            view.array.spread(said.modes),
            said.stiffness,
            said.damage,
            said.alarm,
            None,
            item.rms_m_s2,
            None if degc is None else Temperature(degc),
            self._track_modes(said.modes, item, view),
            detectable,
            covariates,
            left_out,
            said.modal,
            None if left_out else item.sums.total[0] / item.sums.counts.sum(),
            None if self.baseline is not None else spectra,
            rates_hz,
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

    def _view(self, in_use: tuple[int, ...]) -> View:
        """Return what windows of some channels are judged with; the latest views are kept."""
        if in_use not in self._views:
            if len(self._views) == _MOST_VIEWS:
                self._views.pop(next(iter(self._views)))
            self._views[in_use] = self.quantities.view(in_use)
        return self._views[in_use]

    def _track_modes(self, modes: ModalEstimate | None, item: Window, view: View) -> tuple[int, ...]:
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
        stated, stamped = rates_hz = self._rates_hz()
        if skipped.reason == GAP and self.state.align.is_at_odds:
            skipped = Skipped(f"{CLOCK} ({stamped:.5g} Hz and {stated:g} Hz)")
        alarms, verdict = judge.hold(self.quantities, self.state.alarm, t_end_ns)
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
            rates_hz=rates_hz,
        )


def _quantities(
    config: Configuration, baseline: AnyBaseline | None, reference: KnownModes | None
) -> tuple[Quantities, Site]:
    """Make what is judged of a site, by a model or by the modes alone, and what its events are described with."""
    past = tuple(config.channels.index(name) for name in config.identification.reference_channels)
    window_s, events = config.processing.window_s, config.events
    if config.has_model:
        assert not isinstance(baseline, ModalBaseline)
        stories = StoryStiffness(config.instrumented(), baseline, past, config.story_names)
        return stories, Site.of(stories.instrumented, config.story_names, window_s, events)
    assert not isinstance(baseline, Baseline)
    modes = ModalStiffness(config.channels, baseline, past, reference)
    lowest_hz = config.selection.min_frequency_hz
    return modes, Site.of_channels(config.channels, modes.reference, lowest_hz, window_s, events)


def _convert_rate(state: WindowState, ratio: float) -> WindowState:
    """Convert the extent of the runs to samples of another rate (`ratio` of new to old); at the same rate nothing changes."""
    if ratio == 1.0:
        return state
    start, end = floor(state.start * ratio), ceil((state.start + state.n) * ratio)
    past = tuple((floor(a * ratio), ceil(b * ratio), round(n * ratio)) for a, b, n in state.past_runs)
    return replace(state, start=start, n=end - start, past_runs=past)
