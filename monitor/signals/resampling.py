"""Streaming lowpass and rational resampling: the same output, bit for bit, for any block size.

An eighth-order Chebyshev type I lowpass (0.05 dB ripple, the usual decimation design; paper, section 4) runs at the
source's rate.  A polyphase windowed-sinc interpolator then evaluates the filtered signal at the new instants.  The
interpolator is causal.  Its constant delay, like the filter's, is the same on every channel and does not affect modes.
A source slower than the wanted rate keeps its own rate.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from math import floor
from typing import Annotated

import numpy as np

from monitor.core import Array, ComplexArray
from monitor.signals.chebyshev import chebyshev_lowpass

_LOWPASS_ORDER = 8
"""Order of the Chebyshev lowpass. [1; paper, section 4]"""
_RIPPLE_DB = 0.05
"""Ripple of the lowpass in its passband. [dB; the usual decimation design]"""
_STOPBAND_DB = 90.0
"""Attenuation of the interpolator in its stopband. [dB; judgement]"""
_MAX_PHASES = 4096
"""Most phases of the interpolator. [count; exact to 1e-6 in the ratio of rates]"""


@dataclass(frozen=True, eq=False, slots=True)
class Conditioner:
    """Design of filter and resampler for one source rate.

    Examples
    --------
    >>> design = Conditioner.design(rate_in_hz=1000.0, rate_hz=100.0, cutoff_hz=40.0)
    >>> state, samples = design.step_block(design.start(n_channels=2), np.ones((5000, 2)))
    >>> samples.shape
    (500, 2)
    """

    rate_in_hz: float
    rate_hz: float
    """Rate after resampling, Hz: the wanted rate, or the source's if that is lower."""
    cutoff_hz: float
    sos: Annotated[Array, "sections 6"]
    """Second-order sections of the lowpass."""
    step: Fraction
    """Source samples per output sample, at least 1."""
    taps: Annotated[Array, "phases taps"]
    """Interpolation weights on the latest filtered samples, oldest first."""

    @classmethod
    @lru_cache(maxsize=16)  # a design is requested after every gap, and a stream may have hundreds of gaps a second
    def design(cls, rate_in_hz: float, rate_hz: float, cutoff_hz: float, step_s: float | None = None) -> Conditioner:
        """Design lowpass and resampler from `rate_in_hz` to `rate_hz` with the cutoff at `cutoff_hz`, all Hz.

        A source slower than `rate_hz` keeps its own rate or, with `step_s` (s), gets the next lower rate that has a whole
        number of samples in `step_s`.  A cutoff beyond 0.8 of the Nyquist frequency of the output rate is lowered to that
        value.  Rates are matched by a ratio of integers, exact to 1e-6.
        """
        out_hz = rate_hz
        if rate_in_hz < rate_hz:
            out_hz = rate_in_hz if step_s is None else floor(rate_in_hz * step_s + 1e-9) / step_s
        cutoff_hz = min(cutoff_hz, 0.4 * out_hz)
        sos = chebyshev_lowpass(_LOWPASS_ORDER, _RIPPLE_DB, cutoff_hz, rate_in_hz)
        step = 1 / Fraction(out_hz / rate_in_hz).limit_denominator(_MAX_PHASES)
        return cls(rate_in_hz, out_hz, cutoff_hz, sos, step, _interpolator(step, cutoff_hz / rate_in_hz))

    @property
    def delay_s(self) -> float:
        """Time by which slow motion is late after the lowpass, s: its group delay at 0 Hz."""
        return _delay_s(self)

    def response(self, hz: Annotated[Array, "n"]) -> Annotated[ComplexArray, "n"]:
        """Compute the lowpass's frequency response without its delay."""
        z = np.exp(-2j * np.pi * hz / self.rate_in_hz)[:, None] ** np.arange(3)
        sections = (z @ self.sos[:, :3].T) / (z @ self.sos[:, 3:].T)
        return np.asarray(sections.prod(axis=1) * np.exp(2j * np.pi * hz * self.delay_s))

    def start(self, n_channels: int) -> ConditionState:
        """Return the state at rest, before the first sample."""
        return ConditionState(
            filter_memory=np.zeros((self.sos.shape[0], 2, n_channels)),
            history=np.zeros((self.taps.shape[1] - 1, n_channels)),
            n_in=0,
            n_out=0,
        )

    def step_block(
        self, state: ConditionState, samples: Annotated[Array, "n c"]
    ) -> tuple[ConditionState, Annotated[Array, "out c"]]:
        """Filter and resample the next samples: output k, counted from the start, lies at source sample ``k * step``."""
        from monitor.signals.kernels import filtered, interpolate  # compiled code takes a while to load

        latest, memory = filtered(self.sos, np.ascontiguousarray(samples), state.filter_memory)
        n_in = state.n_in + samples.shape[0]
        p, q = self.step.numerator, self.step.denominator
        n_out = -(-n_in * q // p)  # all outputs k whose latest source sample, floor(k p / q), has arrived
        if q == 1:  # every output lies on a source sample: no interpolation
            output = np.ascontiguousarray(latest[state.n_out * p - state.n_in :: p])
            return ConditionState(memory, state.history, n_in, n_out), output
        extended = np.concatenate([state.history, latest])
        k = np.arange(state.n_out, n_out, dtype=np.int64)
        whole, phase = np.divmod(k * p, q)
        first = whole - state.n_in  # the oldest of the taps, as an index into `extended`
        output = interpolate(extended, first, phase, self.taps)
        history = extended[extended.shape[0] - (self.taps.shape[1] - 1) :]
        return ConditionState(memory, history, n_in, n_out), output


@lru_cache(maxsize=16)  # asked for with every block
def _delay_s(design: Conditioner) -> float:
    """Compute the group delay of a lowpass at 0 Hz, s."""
    b, a = design.sos[:, :3], design.sos[:, 3:]
    taps = np.arange(3)
    return float(((b @ taps) / b.sum(axis=1) - (a @ taps) / a.sum(axis=1)).sum()) / design.rate_in_hz


@dataclass(frozen=True, eq=False, slots=True)
class ConditionState:
    """State of filter and resampler between blocks."""

    filter_memory: Annotated[Array, "sections 2 c"]
    history: Annotated[Array, "taps c"]
    """The latest filtered samples, one less than the interpolator has taps."""
    n_in: int
    n_out: int


def _interpolator(step: Fraction, passband: float) -> Annotated[Array, "phases taps"]:
    """Design the Kaiser-windowed sinc weights of the interpolator.

    The signal ends at the lowpass's cutoff (`passband`, cycles per source sample), and its images begin at 1 - passband.
    The transition band lies between the two.
    """
    if step.denominator == 1:
        return np.ones((1, 1))
    edge = 1.15 * passband  # leaves room for the transition band of the lowpass
    transition = 2.0 * np.pi * (1.0 - 2.0 * edge)
    half = int(np.ceil(((_STOPBAND_DB - 8.0) / (2.285 * transition) + 1.0) / 2.0))
    beta = 0.1102 * (_STOPBAND_DB - 8.7)
    offsets = np.arange(2 * half)[None, :] - (half - 1 + np.arange(step.denominator)[:, None] / step.denominator)
    window = np.i0(beta * np.sqrt(np.clip(1.0 - (offsets / half) ** 2, 0.0, None))) / np.i0(beta)
    weights = np.sinc(offsets) * window
    return np.asarray(weights / weights.sum(axis=1, keepdims=True))
