"""The data's way from a block of samples to an alarm: one function, `Pipeline.push`."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil

from drivers.base import ACCELERATION, SampleBlock
from monitor import alarm, align, damage, quality, window
from monitor.baseline import Baseline
from monitor.condition import Conditioner, ConditionState
from monitor.config import Configuration
from monitor.errors import BadInputError
from monitor.poles import identify
from monitor.results import Alarm, Gap, Level, Samples, Skipped, Window, WindowResult
from monitor.window import WindowGrid, WindowState

Result = Samples | Gap | WindowResult


@dataclass(frozen=True, eq=False, slots=True)
class PipelineState:
    """All that the next block needs of those before; nothing else remembers anything."""

    align: align.AlignState | None
    conditioner: Conditioner | None
    condition: ConditionState | None
    window: WindowState | None
    t0_ns: int
    """UTC of the stream's first sample: grid index 0."""
    stories: tuple[alarm.StoryState, ...]


class Pipeline:
    """Wires the stages; time is the data's.

    Parameters
    ----------
    config : Configuration
    baseline : Baseline, optional
        Without one, modes and stiffness are compared with the structure file's, and nothing is ever announced: a
        drawing is never the truth, so a difference from it is no change.
    """

    def __init__(self, config: Configuration, baseline: Baseline | None = None) -> None:
        self.config = config
        self.baseline = baseline
        self.reference = config.model() if baseline is None else baseline.model
        self.reference_modes = self.reference.modes()
        self.sensors = config.sensor_matrix()
        names = config.identification.reference_channels or config.channels
        self.past = tuple(config.channels.index(name) for name in names)
        self.grid: WindowGrid | None = None
        n_stories = self.reference.structure.n_stories
        self.state = PipelineState(None, None, None, None, 0, alarm.start(n_stories))

    def push(self, block: SampleBlock) -> list[Result]:
        """Everything that a block brings about, in order.

        Raises
        ------
        BadInputError
            If a channel of the structure file is missing or the unit is wrong.
        """
        if block.topic != ACCELERATION:
            return []
        results: list[Result] = []
        align_state, pieces = align.step(self.state.align, block, self.config.channels)
        self._advance(align=align_state)
        for piece in pieces:
            if piece.gap is not None:
                results.append(piece.gap)
            if piece.gap is not None or self.state.conditioner is None:
                self._begin_run(piece)
            samples = self._condition(piece)
            results.append(samples)
            results += self._window(samples)
        return results

    def _advance(self, **changes: object) -> None:
        fields = {name: getattr(self.state, name) for name in PipelineState.__slots__}
        self.state = PipelineState(**{**fields, **changes})

    def _begin_run(self, piece: align.Piece) -> None:
        """A new run of samples: filters start at rest, windows on the same grid."""
        p, previous = self.config.processing, self.state.window
        conditioner = Conditioner.design(piece.rate_hz, p.rate_hz, p.cutoff_hz)
        if self.grid is None:
            n_lags = 2 * self.config.identification.block_rows
            self.grid = WindowGrid.design(conditioner.rate_hz, p.window_s, p.hop_s, n_lags)
            self._advance(t0_ns=piece.t_ns)
        elif conditioner.rate_hz != self.grid.rate_hz:
            raise BadInputError(
                f"the source's rate changed to {piece.rate_hz:g} Hz, below the {self.grid.rate_hz:g} Hz of the windows; "
                "replay the parts on their own"
            )
        index = ceil(round((piece.t_ns - self.state.t0_ns) * 1e-9 * self.grid.rate_hz, 6))
        if previous is not None:
            index = max(index, previous.start + previous.n)
        n_channels = len(self.config.channels)
        self._advance(
            conditioner=conditioner,
            condition=conditioner.start(n_channels),
            window=window.start(self.grid, n_channels, index=index, previous=previous),
        )

    def _condition(self, piece: align.Piece) -> Samples:
        conditioner, state = self.state.conditioner, self.state.condition
        assert conditioner is not None and state is not None and self.grid is not None and self.state.window is not None
        state, values = conditioner.step_block(state, piece.values)
        first = self.state.window.start + self.state.window.n
        self._advance(condition=state)
        t_ns = self.state.t0_ns + round(first / self.grid.rate_hz * 1e9)
        return Samples(t_ns, conditioner.rate_hz, values)

    def _window(self, samples: Samples) -> list[Result]:
        assert self.grid is not None and self.state.window is not None
        state, windows = window.step(self.grid, self.state.window, samples.values, self.state.t0_ns)
        self._advance(window=state)
        results: list[Result] = []
        for item in windows:
            if isinstance(item, Window):
                results.append(self._judge(item))
            else:
                index, t_end_ns, data_s, skipped = item
                results.append(self._skip(index, t_end_ns, data_s, skipped))
        return results

    def _judge(self, item: Window) -> WindowResult:
        """One whole window: identification, updating, damage, alarm."""
        c = self.config
        assert self.state.conditioner is not None

        def skip(reason: Skipped) -> WindowResult:
            return self._skip(item.index, item.t_end_ns, item.window_s, reason, item.rms_m_s2)

        skipped = quality.check(item.sums, item.rate_hz, self.state.conditioner.cutoff_hz, c.channels, c.quality)
        if skipped is not None:
            return skip(skipped)
        modes = identify(item, self.past, self.reference_modes, self.sensors, c.identification, c.selection)
        if isinstance(modes, Skipped):
            return skip(modes)
        if self.baseline is not None and tuple(modes.model_mode) != self.baseline.model_mode:
            return skip(Skipped("modes are not the baseline's"))
        stiffness, reading = damage.step(modes, self.reference, self.baseline, self.sensors, c.updating)
        if not stiffness.converged:
            return skip(Skipped("model updating did not converge"))
        if self.baseline is None:
            verdict = Alarm(Level.NORMAL, (), "no baseline: a difference from the structure file is no change")
        else:
            stories, verdict = alarm.step(self.state.stories, reading, item.t_end_ns, c.alarm)
            self._advance(stories=stories)
        return WindowResult(
            item.index, item.t_end_ns, item.window_s, modes, stiffness, reading, verdict, None, item.rms_m_s2
        )

    def _skip(
        self, index: int, t_end_ns: int, data_s: float, skipped: Skipped, rms: float | None = None
    ) -> WindowResult:
        """Nothing can be said: the alarm stays as it was."""
        verdict = alarm.hold(self.state.stories)
        return WindowResult(index, t_end_ns, data_s, None, None, None, verdict, skipped, rms)

