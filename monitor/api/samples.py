"""Samples that a user gives: checked, and conditioned as the pipeline conditions them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any

import numpy as np

from monitor.core import Array, BadInputError, Window
from monitor.signals import Conditioner, FrontEnd, windows


def checked(samples: Any, rate_hz: float, channels: Sequence[str] | None = None) -> Annotated[Array, "samples c"]:
    """Return samples of that shape, all finite, and of a positive rate."""
    values = np.asarray(samples, dtype=np.float64)
    values = values[:, None] if values.ndim == 1 else values
    if values.ndim != 2 or (channels is not None and values.shape[1] != len(channels)):
        wanted = "c" if channels is None else f"{len(channels)} ({', '.join(channels)})"
        raise BadInputError(
            f"samples: shape {values.shape}, but (n_samples, {wanted}) is wanted: a column for each channel"
        )
    if not (np.isfinite(rate_hz) and rate_hz > 0):
        raise BadInputError(f"rate_hz: {rate_hz}: must be a positive number of Hz")
    bad = ~np.isfinite(values).all(axis=1)
    if bad.any():
        raise BadInputError(
            f"samples: {np.count_nonzero(bad)} of {len(values)} rows hold missing or infinite values, the first is row "
            f"{bad.argmax()}; cut them out, and use the longest piece that is left"
        )
    return values


def whole_window(
    front_end: FrontEnd, samples: Annotated[Array, "samples c"], rate_hz: float, *, with_segments: bool
) -> tuple[Window, Conditioner]:
    """Condition samples, m/s^2, into one window of the length that `front_end` states."""
    front_end.check_rate(rate_hz)
    conditioner = front_end.conditioner(rate_hz)
    n_channels = samples.shape[1]
    _, values = conditioner.step_block(conditioner.start(n_channels), samples)
    grid = front_end.grid(conditioner, with_segments=with_segments)
    _, found = windows.step(grid, windows.start(grid, n_channels, index=0), values, 0)
    if not found or not isinstance(found[0], Window):
        raise BadInputError(
            f"samples: {len(samples) / rate_hz:g} s are too short for a window of {front_end.processing.window_s:g} s"
        )
    return found[0], conditioner


def longest_window_s(samples: Array, rate_hz: float, hop_s: float, least_s: float = 0.0) -> float:
    """Return the longest window that samples fill: a whole number of hops, s, no shorter than `least_s`."""
    length_s, least_s = len(samples) / rate_hz, max(least_s, hop_s)
    if length_s < least_s * (1.0 - 1e-9):
        raise BadInputError(f"samples: {length_s:g} s are too short to state modes; {least_s:g} s are the least")
    hops = int(length_s / hop_s + 1e-9)
    return hops * hop_s
