"""The temperature channel: what each window felt."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydantic import Field

from drivers.base import SampleBlock
from monitor.core import Array, BadInputError, Settings, Temperature

LAGS_S = (0.0, *(float(round(120 * 2 ** (k / 2))) for k in range(13)))
"""Thermal lags that calibration tries: 0, then 2 min to 2 h in steps of a factor of the square root of two."""

_SPACING_NS = 1_000_000_000
"""Of channels that are faster, one sample in this time is kept. [ns; cost]"""
_MAX_READINGS = 100_000
"""Most readings that are kept. [samples; cost]"""
_PLAUSIBLE_DEGC = (-100.0, 200.0)
"""Range outside which a reading is no temperature. [degC; judgement: a broken sensor says -127, say]"""
_CLOCK_JUMP_NS = 86_400_000_000_000
"""Step back of the clock from which earlier readings are dropped. [ns; judgement: a day]"""
_S_PER_NS = 1e-9
"""Seconds of a nanosecond. [s/ns; definition]"""


class TemperatureSettings(Settings):
    """``[temperature]``: how windows are given a temperature, and when a dependence on it is believed."""

    patience_s: float = Field(default=60.0, ge=0)
    """A window's temperature is the mean over a stretch as long as it that ends this much earlier, so that samples which
    come up to this late, or in another order than the accelerations, change nothing."""
    max_age_s: float = Field(default=600.0, gt=0)
    """A window whose newest temperature is older than this has none."""
    min_range_k: float = Field(default=2.0, gt=0)
    """Least range of the healthy windows' temperatures from which a dependence is learned."""
    significance: float = Field(default=4.0, gt=0)
    """Standard deviations from which a dependence is believed (all stories jointly)."""
    unevenness: float = Field(default=0.2, gt=0)
    """Share by which the stories' coefficients are expected to differ from a common one (one standard deviation)."""
    extrapolation: float = Field(default=0.5, ge=0)
    """Standard deviation of the law outside the range seen, as a share of what it says beyond the range's end."""


@dataclass(frozen=True, eq=False, slots=True)
class TemperatureState:
    """Samples that windows still to come may need."""

    t_ns: np.ndarray
    """Shape (n,), int64, rising."""
    lagged_degc: Array
    """Shape (n, n_lags): after each of `LAGS_S`; the first column is as measured."""


def start() -> TemperatureState:
    """State before the first sample."""
    return TemperatureState(np.zeros(0, np.int64), np.zeros((0, len(LAGS_S))))


def push(state: TemperatureState, block: SampleBlock, oldest_ns: int = 0) -> TemperatureState:
    """Take a block in: the mean of its channels, rows with a sample that is no temperature left out.

    Parameters
    ----------
    oldest_ns : int
        No window to come reaches further back.

    Raises
    ------
    BadInputError
        If the unit is not degC.
    """
    if block.unit != "degC":
        raise BadInputError(f"{block.topic}: unit {block.unit!r}, expected 'degC'")
    degc = np.asarray(block.samples, dtype=np.float64)
    low, high = _PLAUSIBLE_DEGC
    good = ((degc > low) & (degc < high)).all(axis=1) & bool(block.channels)  # not NaN either
    t_ns = block.t_ns + np.round(np.arange(block.n_samples) / block.sample_rate_hz / _S_PER_NS).astype(np.int64)
    if state.t_ns.size and state.t_ns[-1] - block.t_ns > _CLOCK_JUMP_NS:
        state = start()  # the clock had been wrong: what it stamped will never be needed
    last_ns = int(state.t_ns[-1]) if state.t_ns.size else -_CLOCK_JUMP_NS
    y = state.lagged_degc[-1] if state.t_ns.size else None
    lags, times, rows = np.maximum(LAGS_S, _S_PER_NS), [], []
    # One by one: the lag is recursive, and any cut into blocks must give the same bits.
    for t, value in zip(t_ns[good].tolist(), degc[good].mean(axis=1).tolist(), strict=True):
        if t // _SPACING_NS <= last_ns // _SPACING_NS:
            continue  # repeated, late, or more than are needed
        y = np.full(lags.size, value) if y is None else value + (y - value) * np.exp((last_ns - t) * _S_PER_NS / lags)
        last_ns = t
        times.append(t)
        rows.append(y)
    if not times:
        return state
    first = max(int(np.searchsorted(state.t_ns, oldest_ns)), state.t_ns.size + len(times) - _MAX_READINGS, 0)
    return TemperatureState(
        np.concatenate([state.t_ns[first:], np.array(times, np.int64)]),
        np.concatenate([state.lagged_degc[first:], np.array(rows)]),
    )


def reach_ns(window_s: float, settings: TemperatureSettings) -> int:
    """How far before its end a window's temperature reaches back, at most."""
    return round((window_s + settings.patience_s + settings.max_age_s) / _S_PER_NS)


def window_temperature(
    state: TemperatureState, t_end_ns: int, window_s: float, settings: TemperatureSettings
) -> Temperature | None:
    """The temperature of the window that ends at `t_end_ns`; None if none is known.

    The mean of the samples of its stretch (see `TemperatureSettings.patience_s`) or, between the samples of a slow
    channel, the one before.
    """
    if not state.t_ns.size:
        return None
    end_ns = t_end_ns - round(settings.patience_s / _S_PER_NS)
    begin, end = np.searchsorted(state.t_ns, [end_ns - round(window_s / _S_PER_NS), end_ns])
    if end == 0 or (end_ns - state.t_ns[end - 1]) * _S_PER_NS > settings.max_age_s:
        return None
    return Temperature(state.lagged_degc[min(begin, end - 1) : end].mean(axis=0))
