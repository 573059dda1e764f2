"""The temperature channel: buffer of readings, thermal lags, and the mean temperature of a window."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
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
    """``[temperature]``: the temperature, and every other covariate, of a window."""

    patience_s: float = Field(default=60.0, ge=0)
    """A window's temperature is the mean over a stretch of the window's length that ends this much before the window.
    Temperatures that arrive up to this late, or in another order than the accelerations, then change no result."""
    max_age_s: float = Field(default=600.0, gt=0)
    """A window whose newest temperature is older than this has no temperature."""


@dataclass(frozen=True, eq=False, slots=True)
class TemperatureState:
    """Temperature readings that later windows may need."""

    t_ns: Annotated[NDArray[np.int64], "n"]
    """UTC, increasing."""
    lagged_degc: Annotated[Array, "n lags"]
    """The readings after each thermal lag of `LAGS_S`; the first column is as measured."""


def start() -> TemperatureState:
    """Return the state before the first reading."""
    return TemperatureState(np.zeros(0, np.int64), np.zeros((0, len(LAGS_S))))


def push(state: TemperatureState, block: SampleBlock, oldest_ns: int = 0) -> TemperatureState:
    """Add a block of readings: the mean of its channels after each thermal lag.

    Rows with an implausible or missing value in any channel are left out.  Readings before `oldest_ns` (UTC) are dropped: no
    later window needs them.

    Raises
    ------
    BadInputError
        If the unit is not degC.
    """
    if block.unit != "degC":
        raise BadInputError(f"{block.topic}: unit {block.unit!r}, expected 'degC'")
    degc = np.asarray(block.samples, dtype=np.float64)
    low, high = _PLAUSIBLE_DEGC
    good = np.asarray(((degc > low) & (degc < high)).all(axis=1) & bool(block.channels))  # NaN compares as false
    return _append(state, block, degc.mean(axis=1), good, oldest_ns)


def push_channel(
    state: TemperatureState, block: SampleBlock, channel: str | None, unit: str, oldest_ns: int = 0
) -> TemperatureState:
    """Add a block of readings of any covariate: one channel, or the mean of all, after each lag; missing values are left out.

    Raises
    ------
    BadInputError
        If the unit is another, or the block has no such channel.
    """
    if block.unit != unit:
        raise BadInputError(f"{block.topic}: unit {block.unit!r}, expected {unit!r}: correct [[covariates]]")
    if channel is not None and channel not in block.channels:
        raise BadInputError(f"{block.topic}: no channel {channel!r} among {', '.join(block.channels)}")
    columns = [block.channels.index(channel)] if channel is not None else list(range(len(block.channels)))
    values = np.asarray(block.samples, dtype=np.float64)[:, columns].mean(axis=1)
    return _append(state, block, values, np.isfinite(values), oldest_ns)


def _append(
    state: TemperatureState, block: SampleBlock, values: Array, good: NDArray[np.bool_], oldest_ns: int
) -> TemperatureState:
    """Append the good values of a block, one for each sample, after each lag."""
    t_ns = block.t_ns + np.round(np.arange(block.n_samples) / block.sample_rate_hz / _S_PER_NS).astype(np.int64)
    if state.t_ns.size and state.t_ns[-1] - block.t_ns > _CLOCK_JUMP_NS:
        state = start()  # the earlier clock was wrong: no window will need the readings that it stamped
    last_ns = int(state.t_ns[-1]) if state.t_ns.size else -_CLOCK_JUMP_NS
    y = state.lagged_degc[-1] if state.t_ns.size else None
    lags, times, rows = np.maximum(LAGS_S, _S_PER_NS), [], []
    # One reading at a time: the lag is recursive, and any division into blocks must give the same bits.
    for t, value in zip(t_ns[good].tolist(), values[good].tolist(), strict=True):
        if t // _SPACING_NS <= last_ns // _SPACING_NS:
            continue  # repeated, late, or closer than one reading per spacing
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
    """Return the longest time before a window's end from which its temperature is taken, ns."""
    return round((window_s + settings.patience_s + settings.max_age_s) / _S_PER_NS)


def window_temperature(
    state: TemperatureState, t_end_ns: int, window_s: float, settings: TemperatureSettings
) -> Temperature | None:
    """Average the readings that belong to the window that ends at `t_end_ns` (UTC), over its stretch (see `TemperatureSettings`).

    Where a slow channel has no reading in the stretch, the reading before it counts.  None if the newest one is too old.
    """
    if not state.t_ns.size:
        return None
    end_ns = t_end_ns - round(settings.patience_s / _S_PER_NS)
    begin, end = np.searchsorted(state.t_ns, [end_ns - round(window_s / _S_PER_NS), end_ns])
    if end == 0 or (end_ns - state.t_ns[end - 1]) * _S_PER_NS > settings.max_age_s:
        return None
    return Temperature(state.lagged_degc[min(begin, end - 1) : end].mean(axis=0))
