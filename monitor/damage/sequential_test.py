"""Sequential evidence for a loss of stiffness: a window-limited likelihood ratio over growing stretches of data.

Windows overlap, so a stretch of k window lengths is averaged from the k readings that share no data: the mean over exactly that
stretch, with the variance of one window over k.  What all windows share, the baseline's error, is added after averaging and
bounds what patience can gain.  Large losses show in one window, small ones in eight.

References
----------
T. L. Lai, Sequential changepoint detection in quality control and dynamical systems, J. R. Statist. Soc. B 57 (1995) 613-658
(window-limited generalised likelihood ratio); D. Siegmund, E. S. Venkatraman, Ann. Statist. 23 (1995) 255-271.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from monitor.core import Array, DamageReading

STRETCHES = (1, 2, 4, 8)
"""Lengths over which windows are averaged. [windows; judgement: powers of two]"""
_STD_MEMORY_S = 8 * 3600.0
"""Time over which standard deviations are smoothed. One window's standard deviation rests on some forty segments, too
few for tails of six standard deviations. [s; judgement]"""
_STD_EXCESS = 1.2
"""A window's own standard deviation counts only beyond this many times the smoothed one. [ratio; simulation: a window's
standard deviation scatters by 10 to 15 %]"""
LOCAL_LOSS_CREDIT = 1.0
"""A loss in one story needs this much less evidence than a uniform change, which is the rarer explanation. [standard
deviations; judgement]"""
_MAX_DISAGREEMENT = 4.0
"""Largest distance of a window from the mean of its stretch at which the windows agree. [standard deviations; not
recorded]"""
_SIGNIFICANT_STDS = 3.0
"""Size from which a change counts as significant. [standard deviations; convention: three sigma]"""


@dataclass(frozen=True, eq=False, slots=True)
class History:
    """The readings that the longest stretch needs, h of them."""

    window_ns: int
    t_ns: NDArray[np.int64]
    """Shape (h,): ends of the windows."""
    ddi: Array
    """Shape (h, n)."""
    variance: Array
    """Shape (h, n): of each window alone."""
    ln_variance: Array
    """Shape (n,): smoothed."""
    memory_s: float
    """Time smoothed over so far."""


@dataclass(frozen=True, eq=False, slots=True)
class SequentialStatistic:
    """What the windows up to now say of each story."""

    z: Array
    """Shape (n,): the strongest evidence, in standard deviations, that this story lost stiffness beyond what all share."""
    loss: Array
    """Shape (n,): mean over the longest stretch with which the newest window agrees."""
    std: Array
    """Shape (n,): of `loss`."""


def begin(n_stories: int, window_s: float) -> History:
    """Nothing seen yet."""
    none = np.zeros((0, n_stories))
    return History(round(window_s * 1e9), np.zeros(0, dtype=np.int64), none, none, np.zeros(n_stories), 0.0)


def look(history: History, reading: DamageReading, t_ns: int, model_form: float) -> tuple[History, SequentialStatistic]:
    """Take in one window's reading.

    Parameters
    ----------
    t_ns : int
        End of the window.  Readings that are missing are left out of the means.
    model_form : float
        Share of another story's loss that may show in a story (one standard deviation).
    """
    n = reading.ddi.size
    own = reading.ddi_covariance - reading.common_covariance + (1e-24 - reading.form_variance) * np.eye(n)
    model_form = max(model_form, reading.model_form)
    variance = own.diagonal()
    history = _remembered(history, reading.ddi, variance, t_ns)
    chain = _disjoint(history)
    age = (t_ns - history.t_ns[chain]) / history.window_ns
    counts = np.array([np.count_nonzero(age < stretch - 1e-6) for stretch in STRETCHES])
    ddi, variance = history.ddi[chain], history.variance[chain]
    means = np.cumsum(ddi, axis=0)[counts - 1] / counts[:, None]
    variances = np.cumsum(variance, axis=0)[counts - 1] / counts[:, None] ** 2
    scale = np.sqrt(variances / own.diagonal())
    covariance = own * scale[:, :, None] * scale[:, None, :] + reading.common_covariance
    z, std = statistic(means, covariance, model_form)
    agrees = np.abs(ddi[0] - means) <= _MAX_DISAGREEMENT * np.sqrt(
        variance[0] * (1.0 - 2.0 / counts[:, None]) + variances
    )
    agrees[0] = True
    longest = len(STRETCHES) - 1 - agrees[::-1].argmax(axis=0), np.arange(z.shape[1])
    return history, SequentialStatistic(np.where(agrees, z, -np.inf).max(axis=0), means[longest], std[longest])


def _remembered(history: History, ddi: Array, variance: Array, t_ns: int) -> History:
    """The history with a reading added and what no stretch needs any more dropped.

    The smoothed standard deviation counts, so that no lucky window looks more certain than it is, unless the window's own is
    clearly larger: conditions got worse, or the window lies across the onset of a change.
    """
    first, last = np.searchsorted(history.t_ns, (t_ns - max(STRETCHES) * history.window_ns + 1, t_ns))
    keep = slice(first, last)
    ln_variance, memory_s = np.log(variance), 0.0
    if history.t_ns.size:
        since_s = (t_ns - int(history.t_ns[-1])) * 1e-9
        step_s = float(np.clip(since_s, 1e-9, history.window_ns * 1e-9))
        memory_s = min(history.memory_s + step_s, _STD_MEMORY_S)
        ln_variance = history.ln_variance + (ln_variance - history.ln_variance) * step_s / (memory_s + step_s)
    return History(
        history.window_ns,
        np.append(history.t_ns[keep], t_ns),
        np.concatenate([history.ddi[keep], ddi[None]]),
        np.concatenate([history.variance[keep], np.maximum(variance / _STD_EXCESS**2, np.exp(ln_variance))[None]]),
        ln_variance,
        memory_s,
    )


def _disjoint(history: History) -> list[int]:
    """Indices of readings that share no data, newest first."""
    t_ns = history.t_ns.tolist()  # a few look-ups in a short list: bisect is faster than numpy's search
    chain = [len(t_ns) - 1]
    while i := bisect_right(t_ns, t_ns[chain[-1]] - history.window_ns + 1_000_000):
        chain.append(i - 1)
    return chain


def statistic(means: Array, covariance: Array, model_form: float) -> tuple[Array, Array]:
    """Evidence for a loss of each story, in standard deviations, and the standard deviation of its mean.

    Two explanations without that loss must both fail: that nothing changed, and that all stories changed alike, by what
    the others say.  The others' word is the mean of those that agree with the least change, so that a second
    damaged story does not hide the first.

    Parameters
    ----------
    means : ndarray, shape (k, n)
    covariance : ndarray, shape (k, n, n)

    Returns
    -------
    ndarray, shape (k, n), twice
    """
    from monitor.damage.kernels import evidence_of_loss  # compiled code takes a while to load

    return evidence_of_loss(means, covariance, model_form, _SIGNIFICANT_STDS, LOCAL_LOSS_CREDIT)


def shared_change(loss: Array, std: Array) -> float:
    """The part of a change that all stories share: the least one, where all changed significantly the same way, else 0.

    Weather, added mass, a slow clock and a loss in every story alike look the same in accelerations.
    """
    alike = np.abs(np.sign(loss).sum()) == loss.size and (np.abs(loss) > _SIGNIFICANT_STDS * std).all()
    return float(loss[np.abs(loss).argmin()]) if alike and loss.size else 0.0


def shared_by_others(loss: Array, std: Array) -> Array:
    """What all stories but one share, for each that one, shape (n,)."""
    n = loss.size
    if np.count_nonzero(np.abs(loss) > _SIGNIFICANT_STDS * std) < n - 1:
        return np.zeros(n)
    return np.array([shared_change(np.delete(loss, j), np.delete(std, j)) for j in range(n)])
