"""The smallest loss of stiffness that the alarm would have seen: what "no alarm" is worth.

A loss of one story appears suddenly.  It is seen if that story's alarm reaches `warning` within a stated time: by the mean of
readings of which at least two share no data.  The loss that is
seen with a stated probability follows from the covariance of a window's damage index and from the alarm's own rules, by a
simulation of the errors of the windows.
"""

from __future__ import annotations

from functools import lru_cache
from math import ceil, sqrt
from typing import Annotated

import numpy as np

from monitor.core import Array, Reading
from monitor.damage.alarm import AlarmSettings
from monitor.damage.common_change import LOCAL_LOSS_CREDIT
from monitor.damage.limits import Scores, as_student, freedom_of_sum
from monitor.damage.sequential_test import STRETCHES, History, freedoms

PROBABILITY = 0.9
"""Probability with which the smallest detectable loss is seen. [1; convention: a90 of inspection reliability, MIL-HDBK-1823A]"""
WITHIN_S = 3600.0
"""Time after a sudden loss within which it is to be seen. [s; definition: holds the longest stretch, eight windows of 400 s]"""
_CONFIRMING = STRETCHES[1:]
"""Stretches of at least two readings. [count; definition]"""
_TRIALS = 500
"""Simulated series of windows. [count; cost: the share seen errs by 1.3 percent]"""
_LOOKS_A_WINDOW = 20
"""Looks simulated in a window's length. [count; cost: errors of windows a twentieth apart are correlated by 0.95]"""
_LN_STEP = 0.1
"""Step to which the logarithms of standard deviations are rounded, so that one simulation serves many windows. [1; cost: half of
it is below the scatter of a window's own deviation, 0.13]"""
_LN_COMMON_STEP = 0.3
"""The same for what windows have in common, which follows the covariates. [1; cost: half of it is 15 percent of a deviation]"""
_KNOWN = 1e4
"""Degrees of freedom beyond which a variance counts as known. [count; cost: a limit of 6 is then higher by 0.1 percent]"""
_CORRELATION_STEP = 0.2
"""The same for correlations. [1; cost]"""


def clock_error(rates_hz: tuple[float, float] | None, calibration: float, shown_per_loss: float = 1.0) -> float:
    """Compute the relative error of a stiffness, or of what is shown for it (`Reading.shown_per_loss`), from the source's clock.

    `rates_hz` are the rate that the source states and its rate by the timestamps; `calibration` is the healthy data's rate by
    their timestamps over the stated one: an error that both have cancels.

    Examples
    --------
    >>> round(clock_error((100.0, 98.0), 1.0), 6)
    0.04
    """
    if rates_hz is None:
        return 0.0
    return 2.0 * shown_per_loss * abs(rates_hz[1] / rates_hz[0] / calibration - 1.0)


def smallest_detectable_loss(reading: Reading, history: History, settings: AlarmSettings, tests: Scores) -> Array:
    """Compute the smallest sudden loss of each part that the alarm sees with `PROBABILITY` within `WITHIN_S`, as it is shown.

    Where readings come seldom, it is within the time of as many as the longest stretch needs.  Where fewer data were judged in
    that time, because windows were skipped or the run is young, only these count.  It is infinite where no loss can be confirmed:
    too few windows, or modes that say next to nothing of the part.  `history` is the alarm's after the window of `reading`;
    `tests` is what is tested of one.
    """
    loss = np.full(reading.loss.size, np.inf)
    known = np.flatnonzero(np.isfinite(reading.loss))
    seen = history if known.size == loss.size else history.of_parts(known)
    common = seen.common.mean(axis=0)  # of the windows' conditions since the longest stretch began
    own_std = np.exp(0.5 * seen.ln_variance)
    window_s, spacing_s = history.window_ns * 1e-9, history.spacing_ns * 1e-9
    common_std = np.sqrt(np.maximum(np.diag(common), 1e-24))
    loss[known] = reading.shown_per_loss * _simulated(
        _steps(own_std, _LN_STEP),
        _steps(common_std, _LN_COMMON_STEP),
        _correlation(common),
        tuple(_steps(np.minimum(f[known], _KNOWN), _LN_COMMON_STEP) for f in freedoms(history, reading)),
        round(max(spacing_s / window_s, 1.0 / _LOOKS_A_WINDOW), 6),
        _readings_after(history),
        max(int((WITHIN_S + 1e-6) // window_s), max(STRETCHES)),
        round(settings.limit(tests, window_s, spacing_s), 3),
        max(settings.model_form, reading.model_form),
        settings.min_loss,
    )
    loss[[j - 1 for j in reading.unidentified]] = np.inf
    return loss


def _readings_after(history: History) -> int:
    """Estimate the number of readings that share no data within the time after a loss, from those that the alarm remembers."""
    window_ns, t_ns = history.window_ns, history.t_ns
    judged_ns = int(np.minimum(np.diff(t_ns), window_ns).sum()) + window_ns
    share = judged_ns / (int(t_ns[-1] - t_ns[0]) + window_ns)
    within_ns = max(WITHIN_S * 1e9, max(STRETCHES) * max(window_ns, history.spacing_ns))
    begun_ns = history.memory_s * 1e9 + window_ns  # judged since the first window began
    return int((min(begun_ns, within_ns * share) + 1e3) // window_ns)


def _steps(std: Array, step: float) -> tuple[int, ...]:
    """Round the logarithms of standard deviations."""
    return tuple(int(v) for v in np.rint(np.log(std) / step))


def _correlation(covariance: Array) -> tuple[int, ...]:
    """Round the correlations of a covariance, row by row."""
    std = np.sqrt(np.maximum(np.diag(covariance), 1e-24))
    return tuple(int(v) for v in np.rint(covariance / np.outer(std, std) / _CORRELATION_STEP).ravel())


def _nearest(correlation: tuple[int, ...], n: int) -> Annotated[Array, "n n"]:
    """Make the nearest correlation matrix of rounded correlations."""
    values, vectors = np.linalg.eigh(np.clip(np.reshape(correlation, (n, n)) * _CORRELATION_STEP, -1.0, 1.0))
    rho = (vectors * np.maximum(values, 1e-6)) @ vectors.T
    return np.asarray(rho / np.sqrt(np.outer(np.diag(rho), np.diag(rho))))


@lru_cache(maxsize=8192)  # 16 for each of 500 sites in a process, of less than 1 kB each
def _simulated(
    own_steps: tuple[int, ...],
    common_steps: tuple[int, ...],
    correlation: tuple[int, ...],
    freedom_steps: tuple[tuple[int, ...], ...],
    hop: float,
    windows: int,
    most_windows: int,
    limit: float,
    model_form: float,
    min_loss: float,
) -> Array:
    """Simulate windows' errors and find the loss of each part that is seen in a share `PROBABILITY` of trials.

    A window's own errors are correlated between parts as the baseline's are: both come from modes of the same structure.

    `hop` is the time between looks, `windows` the length of the data after the loss and `most_windows` that of a run that is not
    young, all in window lengths.  The errors are as large as they are stated; `limit` is raised by the degrees of freedom of what
    is stated.
    """
    from monitor.damage.kernels import seen_by_most  # compiled code takes a while to load

    n = len(own_steps)
    apart = max(1, round(1.0 / hop))  # looks in a window
    looks = np.arange(1, windows * apart + 1)
    if windows < 2:
        return np.full(n, np.inf)
    own_std, common_std = np.exp(_LN_STEP * np.array(own_steps)), np.exp(_LN_COMMON_STEP * np.array(common_steps))
    rho = _nearest(correlation, n)
    own, common = rho * np.outer(own_std, own_std), rho * np.outer(common_std, common_std)
    of_stretches = own / np.reshape(_CONFIRMING, (-1, 1, 1)) + common
    own_freedom, common_freedom = np.exp(_LN_COMMON_STEP * np.array(freedom_steps))
    parts = own_std**2 / np.reshape(_CONFIRMING, (-1, 1)), np.broadcast_to(common_std**2, (len(_CONFIRMING), n))
    least = as_student(limit, freedom_of_sum(parts, (own_freedom, common_freedom)))
    against_none, contrast, leak, square = _significant(of_stretches, least, model_form)
    total, white = _draws((max(STRETCHES) + most_windows) * apart, n)
    lengths = np.array(_CONFIRMING) * apart
    # The errors' increment from look to look is that of a window times the root of the looks in it.
    root = np.linalg.cholesky(rho)
    of_error = sqrt(apart) * own_std[:, None] * root / lengths[:, None, None]
    off = common_std * (white @ root.T)
    return seen_by_most(
        total,
        1 + max(STRETCHES) * apart,
        lengths,
        np.maximum(lengths[:, None] / looks, 1.0),
        of_error,
        off,
        contrast @ of_error,
        off @ contrast.transpose(0, 2, 1),
        np.maximum(against_none, min_loss),
        leak,
        square,
        _TRIALS - ceil(PROBABILITY * _TRIALS),
    )


@lru_cache(maxsize=4)  # sites with other numbers of stories; 4 MB each for three
def _draws(length: int, n: int) -> tuple[Annotated[Array, "trials n length+1"], Annotated[Array, "trials n"]]:
    """Draw standard normal errors of each trial: sums of increments, and common ones."""
    rng = np.random.default_rng(0)
    total = np.zeros((_TRIALS, n, 1 + length))
    np.cumsum(rng.standard_normal((_TRIALS, length, n)).transpose(0, 2, 1), axis=2, out=total[:, :, 1:])
    return total, rng.standard_normal((_TRIALS, n))


def _significant(
    covariance: Annotated[Array, "s n n"], limit: Annotated[Array, "s n"], model_form: float
) -> tuple[Annotated[Array, "s n"], Annotated[Array, "s n n"], Annotated[Array, "s n"], Annotated[Array, "s n"]]:
    """Compute what a loss of each part alone must reach so that the alarm's statistic reaches `limit` over each stretch.

    `covariance` is that of each stretch's mean.  Returned are against_none, contrast, leak and square as `kernels.seen_by_most`
    takes them, but for the least loss that is announced.
    """
    n, variance = covariance.shape[-1], np.diagonal(covariance, axis1=1, axis2=2)
    against_none = limit * np.sqrt(variance)
    if n == 1:
        return against_none, np.zeros_like(covariance), np.ones_like(variance), np.zeros_like(variance)
    # Against "all stories changed alike": the loss of the others may be this story's, by the model's form.
    others = (1.0 - np.eye(n)) / variance[:, None, :]
    contrast = np.eye(n) - others / others.sum(axis=2, keepdims=True)
    threshold = limit - LOCAL_LOSS_CREDIT
    square = threshold**2 * ((contrast @ covariance) * contrast).sum(axis=2)
    leak = 1.0 - threshold**2 * model_form**2 * ((contrast**2).sum(axis=2) - 1.0)
    return against_none, contrast, leak, square
