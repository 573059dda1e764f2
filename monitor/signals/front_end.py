"""The front end: from blocks of a source's samples to the conditioned samples and the grid of windows and segments."""

from __future__ import annotations

from dataclasses import dataclass
from math import floor

from drivers.base import SampleBlock
from monitor.core import BadInputError
from monitor.signals import alignment
from monitor.signals.resampling import Conditioner
from monitor.signals.settings import ProcessingSettings
from monitor.signals.windows import WindowGrid, common_step_s

_MAX_DECIMATION = 1000
"""Largest ratio of the source's rate to `rate_hz` that is accepted; a larger one is taken for a wrong rate in the data.
[ratio; judgement]"""


@dataclass(frozen=True)
class FrontEnd:
    """Design of alignment, filter, resampling and grid, shared by the pipeline and the segments of a diagnosis.

    Examples
    --------
    >>> from monitor.signals import FrontEnd, ProcessingSettings
    >>> front_end = FrontEnd(("a1", "a2"), ProcessingSettings(window_s=40.0), segment_s=5.0, n_lags=50)
    >>> conditioner = front_end.conditioner(1000.0)
    >>> conditioner.rate_hz, conditioner.cutoff_hz
    (100.0, 40.0)
    >>> front_end.grid(conditioner).window_n
    4000
    """

    channels: tuple[str, ...]
    """Names of the channels, in the order of the columns."""
    processing: ProcessingSettings
    segment_s: float
    """Length of the tapered segments for spectra, s."""
    n_lags: int
    """Lags of the covariances that identification needs, in samples after resampling."""
    forces: tuple[tuple[str, int], ...] = ()
    """Channel of each measured force, and the degree of freedom on which it acts, counted from 1."""

    @property
    def step_s(self) -> float:
        """Largest time that divides window and hop, s."""
        return common_step_s(self.processing.window_s, self.processing.hop_s)

    def check_rate(self, rate_in_hz: float) -> None:
        """Refuse a source whose rate (Hz) leaves too few or implausibly many samples.

        Raises
        ------
        BadInputError
            If the common step of window and hop holds fewer samples than `n_lags`, or the rate is far above `rate_hz`.
        """
        rate_hz = self.processing.rate_hz
        if rate_in_hz > _MAX_DECIMATION * rate_hz:
            raise BadInputError(
                f"the source's {rate_in_hz:g} Hz are more than {_MAX_DECIMATION} times rate_hz = {rate_hz:g}"
            )
        n_step = floor(self.step_s * min(rate_in_hz, rate_hz) + 1e-9)
        if n_step < self.n_lags:
            raise BadInputError(
                f"the source's {rate_in_hz:g} Hz give {n_step} samples in the common step "
                f"of window_s and hop_s; {self.n_lags} (2 block_rows) are the least: set a longer hop_s"
            )

    def align(
        self, state: alignment.AlignState, block: SampleBlock, *, keep_partial: bool = False
    ) -> tuple[alignment.AlignState, list[alignment.Piece]]:
        """Order the channels of a block and cut it at gaps (`alignment.step`, whose errors it raises)."""
        return alignment.step(state, block, self.channels, keep_partial=keep_partial)

    def conditioner(self, rate_in_hz: float) -> Conditioner:
        """Design the lowpass and the resampler for a source of `rate_in_hz` (Hz)."""
        return Conditioner.design(rate_in_hz, self.processing.rate_hz, self.processing.cutoff_hz, self.step_s)

    def grid(self, conditioner: Conditioner, *, with_segments: bool = True) -> WindowGrid:
        """Design the grid of windows, with segments if wanted, for the output samples of `conditioner`."""
        p, segment_s = self.processing, self.segment_s if with_segments else 0.0
        return WindowGrid.design(
            conditioner.rate_hz, p.window_s, p.hop_s, self.n_lags, segment_s, conditioner.cutoff_hz
        )
