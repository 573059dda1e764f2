"""Sequential test for a loss of stiffness: a window-limited likelihood ratio over stretches of one to eight readings.

Windows overlap, so a stretch of k readings is averaged from the latest k that share no data.  Without gaps that is the mean over
exactly k windows' lengths, with the variance of one window over k.  The errors of the baseline and of the covariates' law are
common to all windows.  Their mean covariance, an upper bound where the covariates moved, is added after averaging, so averaging
does not reduce it.  Large losses are detected in one window, small ones in eight.

References
----------
T. L. Lai, Sequential changepoint detection in quality control and dynamical systems, J. R. Statist. Soc. B 57 (1995) 613-658
(window-limited generalised likelihood ratio); D. Siegmund, E. S. Venkatraman, Ann. Statist. 23 (1995) 255-271.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass, replace
from math import exp
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from monitor.core import Array, Reading
from monitor.damage.common_change import LOCAL_LOSS_CREDIT, SIGNIFICANT_STDS, Beside, Expected
from monitor.damage.limits import as_normal, freedom_of_sum

STRETCHES = (1, 2, 4, 8)
"""Numbers of readings that share no data over which means are taken. [count; judgement: powers of two]"""
_STD_MEMORY_S = 8 * 3600.0
"""Time over which standard deviations are smoothed. One window's standard deviation rests on some forty segments, too
few for tails of six standard deviations. [s; judgement]"""
_WINDOW_FREEDOM = 30.0
"""Effective degrees of freedom of a window's own variance, of some forty segments that overlap by half. [count; simulation: its
standard deviation scatters by 13 %]"""
_STD_EXCESS = 1.2
"""A window's own standard deviation counts only beyond this many times the smoothed one. [ratio; simulation: a window's
standard deviation scatters by 10 to 15 %]"""
CHANCE_STDS = 4.0
"""Deviation that several stories and windows do not give by chance. [standard deviations; judgement]"""
SURE_STDS = 1.645
"""By how much an estimate must lie below a threshold for the true value to lie below it with 95 %. [standard deviations;
convention: quantile of 95 % of the normal distribution]"""
_COMPARABLE = 4.0
"""Largest ratio of the baseline's variances at which readings of other channels are averaged with the present one's. [ratio;
judgement: twice the standard deviation]"""


@dataclass(frozen=True, eq=False, slots=True)
class Smoothed:
    """Smoothed variance of the readings of other channels, for their return."""

    channels: tuple[int, ...]
    ln_variance: Annotated[Array, "n"]
    memory_s: float


@dataclass(frozen=True, eq=False, slots=True)
class History:
    """History of the h latest readings, as many as the longest stretch needs."""

    window_ns: int
    t_ns: Annotated[NDArray[np.int64], "h"]
    """Ends of the windows, UTC."""
    loss: Annotated[Array, "h n"]
    """NaN where a window does not show the part."""
    variance: Annotated[Array, "h n"]
    """Variance of the loss in each window, without the baseline's error."""
    common: Array
    """Covariance that a window has in common with the others, the baseline's and the covariates' law's: shape (h, n, n), or
    (h, n) where only its variances are kept."""
    ln_variance: Annotated[Array, "n"]
    """Smoothed logarithm of the variance."""
    memory_s: float
    """Time over which the variance has been smoothed so far."""
    channels: tuple[tuple[int, ...], ...] = ()
    """Channels of each of the h readings, as in `Reading.channels`; of all where none is stated."""
    before: Smoothed | None = None
    """Variance of the readings before the channels in use changed."""

    @property
    def spacing_ns(self) -> int:
        """Time from one reading to the next, as mostly; as if they shared no data where only one is known."""
        return int(np.median(np.diff(self.t_ns))) if self.t_ns.size > 1 else self.window_ns

    def channels_of(self, reading: int) -> tuple[int, ...]:
        """Return the channels of one of the readings."""
        return self.channels[reading] if self.channels else ()

    def of_parts(self, known: NDArray[np.intp]) -> History:
        """Select some of the parts (0 = first)."""
        shown = (
            self.loss[:, known],
            self.variance[:, known],
            self.common[:, known][:, :, known],
            self.ln_variance[known],
        )
        return replace(self, loss=shown[0], variance=shown[1], common=shown[2], ln_variance=shown[3])

    def left_by_others(self, expected: Expected, beside: Beside) -> History:
        """Take out of the latest variances what the other parts let expect; the losses stay as they were measured."""
        variance, common = expected.left_of_intact(np.exp(self.ln_variance), self.common.mean(axis=0), beside)
        return replace(self, ln_variance=np.log(variance), common=common[None])


@dataclass(frozen=True, eq=False, slots=True)
class SequentialStatistic:
    """Test statistic of each part that a window shows."""

    parts: tuple[int, ...]
    """Their numbers (0 = first)."""
    z: Annotated[Array, "n"]
    """Largest z-score over the stretches, for a loss of this part beyond a change common to all parts.

    It is the standard normal score that is exceeded by chance as rarely, whatever the degrees of freedom of its deviation."""
    lasting: Annotated[Array, "n"]
    """The same over the stretches of at least two readings that share no data."""
    loss: Annotated[Array, "n"]
    """Mean loss over the longest stretch with which the newest window agrees."""
    std: Annotated[Array, "n"]
    """Of `loss`."""
    freedom: Annotated[Array, "n"]
    """Effective degrees of freedom of `std`."""
    own: Annotated[Array, "n"]
    """The share of `loss` beyond what all parts have in common."""
    own_std: Annotated[Array, "n"]
    stretch: Annotated[NDArray[np.intp], "n"]
    """Number of readings in that stretch."""


@dataclass(frozen=True, eq=False, slots=True)
class Averages:
    """Means over the k stretches that end with the newest reading."""

    means: Annotated[Array, "k n"]
    """0 where the newest reading does not show the part."""
    variances: Annotated[Array, "k n"]
    """Their own variances, without what readings have in common."""
    common: Array
    """Shape (k, n, n) or (k, n), as `History.common`: mean of what the readings have in common."""
    agrees: Annotated[NDArray[np.bool_], "k n"]
    """Whether the newest reading agrees with the mean."""
    counts: Annotated[NDArray[np.intp], "k n"]
    """Number of readings in the mean."""

    def of_parts(self, known: NDArray[np.intp]) -> Averages:
        """Select some of the parts (0 = first)."""
        common = self.common[:, known][:, :, known]
        shown = self.agrees[:, known], self.counts[:, known]
        return Averages(self.means[:, known], self.variances[:, known], common, *shown)

    def best(self, z: Annotated[Array, "k n"]) -> tuple[Annotated[Array, "n"], Annotated[Array, "n"]]:
        """Return the largest score of each part over the stretches, and over those of at least two readings."""
        z = np.where(self.agrees, z, -np.inf)
        return z.max(axis=0), np.where(self.counts > 1, z, -np.inf).max(axis=0)

    def longest(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Return the index, into (k, n), of the longest stretch of each part with which the newest reading agrees."""
        return len(self.agrees) - 1 - self.agrees[::-1].argmax(axis=0), np.arange(self.agrees.shape[1])


def begin(n_stories: int, window_s: float, *, variances_only: bool = False) -> History:
    """Return the empty history of n parts for windows of `window_s` seconds.

    With `variances_only`, of what windows have in common the variances alone are kept.
    """
    none = np.zeros((0, n_stories))
    shared = none if variances_only else np.zeros((0, n_stories, n_stories))
    t_ns = np.zeros(0, dtype=np.int64)
    return History(round(window_s * 1e9), t_ns, none, none, shared, np.zeros(n_stories), 0.0)


def look(
    history: History, reading: Reading, t_ns: int, model_form: float, expected: Expected | None = None
) -> tuple[History, SequentialStatistic]:
    """Update the test statistic by one window's reading; `t_ns` is the UTC of the window's end.

    Missing readings are left out of the means.  `model_form` is the share of another part's loss that may appear in a part
    (one standard deviation).  `expected` is what parts do together without a known cause, where it was learned, which is of
    stories alone: a window shows them all, and a rise is no loss.  Without it, what they have in common is a change of all
    alike.
    """
    n, own = reading.loss.size, _unbiased(reading) * reading.own_covariance
    model_form = max(model_form, reading.model_form)
    common = np.broadcast_to(reading.common_covariance, (n, n))
    history, over = average(history, reading.loss, own.diagonal(), common, reading.channels, t_ns)
    freedom = _freedom(history, over, reading)
    known = np.flatnonzero(np.isfinite(reading.loss))
    if known.size < n:
        over, own, freedom = over.of_parts(known), own[np.ix_(known, known)], freedom[:, known]
    covariance = _covariance_of(over, own)
    z, std = statistic(over.means, covariance, model_form)
    if reading.either_side:
        z = np.maximum(z, statistic(-over.means, covariance, model_form)[0])
    longest = over.longest()
    loss, loss_std = over.means[longest], std[longest]
    if expected is None:
        beyond, beyond_std = loss - shared_by_others(loss, loss_std), loss_std
    else:
        z, losses, stds = _beside_others(over.means, covariance, model_form, expected)
        beyond, beyond_std = losses[longest], stds[longest]
    best, lasting = over.best(as_normal(z, freedom))
    return history, SequentialStatistic(
        tuple(known.tolist()),
        best,
        lasting,
        loss,
        loss_std,
        freedom[longest],
        beyond,
        beyond_std,
        over.counts[longest],
    )


def look_at_shapes(history: History, reading: Reading, t_ns: int) -> tuple[History, SequentialStatistic]:
    """Update the test statistic of the shapes' components, each by itself and to either side."""
    common = np.nan_to_num(reading.shape_common_variance)
    own = _unbiased(reading) * (reading.shape_variance - common)
    history, over = average(history, reading.shape.ravel(), own.ravel(), common.ravel(), reading.channels, t_ns)
    std = np.sqrt(over.variances + over.common)
    freedom = _freedom(history, over, reading)
    best, lasting = over.best(as_normal(np.abs(over.means) / np.maximum(std, 1e-12), freedom))
    longest = over.longest()
    size = over.means[longest], std[longest]
    parts = tuple(range(best.size))
    return history, SequentialStatistic(parts, best, lasting, *size, freedom[longest], *size, over.counts[longest])


def _unbiased(reading: Reading) -> float:
    """Return the factor that makes the mean logarithm of estimated variances that of the true one (of chi-square: -1/freedom)."""
    return exp(1.0 / _WINDOW_FREEDOM) if reading.own_freedom is None else 1.0


def _freedom(history: History, over: Averages, reading: Reading) -> Annotated[Array, "k n"]:
    """Compute the effective degrees of freedom of the means' variances; of shapes, each component has those of its mode."""
    components = over.means.shape[1] // reading.loss.size
    common = over.common if over.common.ndim == 2 else np.diagonal(over.common, axis1=1, axis2=2)
    each = (np.repeat(f, components) for f in freedoms(history, reading))
    return freedom_of_sum((over.variances, common), tuple(each))


def freedoms(history: History, reading: Reading) -> tuple[Annotated[Array, "q"], Annotated[Array, "q"]]:
    """Return the degrees of freedom of the smoothed own variances, and of what is common, of each part."""
    windows = 1.0 + history.memory_s * 1e9 / history.window_ns  # whose variances are smoothed
    own = _WINDOW_FREEDOM * windows if reading.own_freedom is None else reading.own_freedom
    n = reading.loss.size
    return np.broadcast_to(own, n), np.broadcast_to(reading.freedom, n)


def _beside_others(
    means: Array, covariance: Array, model_form: float, expected: Expected
) -> tuple[Array, Array, Array]:
    """Compute the z-scores of losses beyond what the other parts let expect, the losses and their deviations."""
    found = expected.each_beside_others(means, covariance)
    sizes = np.abs(found.loss)
    others = np.where(np.eye(sizes.shape[1], dtype=bool), 0.0, sizes[:, None, :]).max(axis=2)
    stds = np.hypot(found.std, model_form * others)
    return found.loss / stds, found.loss, stds


def average(
    history: History,
    values: Annotated[Array, "n"],
    variance: Annotated[Array, "n"],
    common: Array,
    channels: tuple[int, ...],
    t_ns: int,
) -> tuple[History, Averages]:
    """Append a reading of n parts and average the readings over all stretches that end with it.

    `values` and `variance` are NaN for a part that the window does not show, `common` is as one item of `History.common`.
    `channels` are those that the reading rests on (empty: all), `t_ns` is the UTC of the window's end.
    """
    history = _append(_of_channels(history, channels), values, variance, common, channels, t_ns)
    chain = _comparable(history, _disjoint(history.t_ns, history.window_ns), common)
    last = np.minimum(STRETCHES, len(chain)) - 1
    shown = np.isfinite(history.loss[chain])
    counts = np.maximum(np.cumsum(shown, axis=0)[last], 1)
    means = np.cumsum(np.where(shown, history.loss[chain], 0.0), axis=0)[last] / counts
    variances = np.cumsum(np.where(shown, history.variance[chain], 0.0), axis=0)[last] / counts**2
    readings = (last + 1).reshape(-1, *[1] * common.ndim)
    shared = np.cumsum(history.common[chain], axis=0)[last] / readings
    newest, own = np.where(shown[0], history.loss[-1], 0.0), np.where(shown[0], history.variance[-1], 0.0)
    agrees = np.abs(newest - means) <= CHANCE_STDS * np.sqrt(own * (1.0 - 2.0 / counts) + variances)
    agrees[0] = True
    return history, Averages(means, variances, shared, agrees, counts)


def _covariance_of(over: Averages, own: Annotated[Array, "n n"]) -> Annotated[Array, "k n n"]:
    """Compute the covariance of the means: correlated as `own`, that of one reading, and what is common."""
    scale = np.sqrt(over.variances / own.diagonal())
    return np.asarray(own * scale[:, :, None] * scale[:, None, :] + over.common)


def _of_channels(history: History, channels: tuple[int, ...]) -> History:
    """Take up the smoothed variance of readings of these channels: other channels have another variance."""
    if not history.t_ns.size or history.channels_of(-1) == channels:
        return history
    left = Smoothed(history.channels_of(-1), history.ln_variance, history.memory_s)
    if history.before is not None and history.before.channels == channels:
        return replace(history, ln_variance=history.before.ln_variance, memory_s=history.before.memory_s, before=left)
    return replace(history, memory_s=0.0, before=left)


def _comparable(history: History, chain: list[int], common: Array) -> list[int]:
    """Leave out of a chain the readings of channels that saw far less of a story than the newest reading's."""
    newest, largest = history.channels_of(-1), _COMPARABLE * _diagonal(common)
    return [
        i for i in chain if history.channels_of(i) == newest or bool((_diagonal(history.common[i]) <= largest).all())
    ]


def _diagonal(common: Array) -> Array:
    """Return the variances of what is common, which may be kept alone."""
    return common if common.ndim == 1 else common.diagonal()


def _append(
    history: History, values: Array, variance: Array, common: Array, channels: tuple[int, ...], t_ns: int
) -> History:
    """Append a reading, and drop readings that no stretch needs any more.

    The smoothed standard deviation is used, because a window's own may be too small by chance.  The window's own is used where
    it is clearly larger: conditions got worse, or the window lies across the onset of a change.
    """
    known = np.append(history.t_ns[: np.searchsorted(history.t_ns, t_ns)], t_ns)  # the clock may have been set back
    needed = _disjoint(known, history.window_ns)[max(STRETCHES) - 1 :]
    keep = slice(needed[0] if needed else 0, known.size - 1)
    ln_variance, memory_s = np.log(variance), 0.0
    n_before = history.t_ns.size
    is_new = history.before is not None and history.memory_s == 0.0  # the first reading of these channels
    before = history.channels or ((),) * n_before
    if n_before and not is_new:
        since_s = (t_ns - int(history.t_ns[-1])) * 1e-9
        step_s = float(np.clip(since_s, 1e-9, history.window_ns * 1e-9))
        memory_s = min(history.memory_s + step_s, _STD_MEMORY_S)
        smooth = history.ln_variance + (ln_variance - history.ln_variance) * step_s / (memory_s + step_s)
        # What a window does not show keeps its variance, and what was not shown before begins with this one.
        kept = np.where(np.isnan(ln_variance), history.ln_variance, ln_variance)
        ln_variance = np.where(np.isnan(smooth), kept, smooth)
    return History(
        history.window_ns,
        known[keep.start :],
        np.concatenate([history.loss[keep], values[None]]),
        np.concatenate([history.variance[keep], np.maximum(variance / _STD_EXCESS**2, np.exp(ln_variance))[None]]),
        np.concatenate([history.common[keep], common[None]]),
        ln_variance,
        memory_s,
        (*before[keep], channels),
        history.before,
    )


def _disjoint(t_ns: NDArray[np.int64], window_ns: int) -> list[int]:
    """List the indices of readings that share no data, newest first."""
    times = t_ns.tolist()  # a few look-ups in a short list: bisect is faster than numpy's search
    chain = [len(times) - 1]
    while i := bisect_right(times, times[chain[-1]] - window_ns + 1_000_000):
        chain.append(i - 1)
    return chain


def statistic(
    means: Annotated[Array, "k n"], covariance: Annotated[Array, "k n n"], model_form: float
) -> tuple[Annotated[Array, "k n"], Annotated[Array, "k n"]]:
    """Compute the z-score of each part's loss, and the standard deviation of its mean over each of k stretches.

    The z-score is the smaller one against two null hypotheses: that nothing changed, and that all parts changed alike.  The
    common change is estimated from the other parts, as the mean of those that agree with the smallest change.  A second damaged
    part therefore does not mask the first.  `model_form` is as in `look`.
    """
    from monitor.damage.kernels import evidence_of_loss  # compiled code takes a while to load

    return evidence_of_loss(means, covariance, model_form, SIGNIFICANT_STDS, LOCAL_LOSS_CREDIT, SURE_STDS)


def shared_change(loss: Annotated[Array, "n"], std: Annotated[Array, "n"]) -> float:
    """Return the part of a change that is common to all parts.

    It is the smallest change in magnitude where all parts changed significantly in the same direction, else 0.  Weather, added
    mass, a slow clock and an equal loss in every story have the same effect on accelerations.

    Examples
    --------
    >>> shared_change(np.array([0.05, 0.08]), np.array([0.01, 0.01]))
    0.05
    """
    alike = np.abs(np.sign(loss).sum()) == loss.size and (np.abs(loss) > SIGNIFICANT_STDS * std).all()
    return float(loss[np.abs(loss).argmin()]) if alike and loss.size else 0.0


def shared_by_others(loss: Annotated[Array, "n"], std: Annotated[Array, "n"]) -> Annotated[Array, "n"]:
    """Return for each part the change common to all other parts (`shared_change`)."""
    n = loss.size
    if np.count_nonzero(np.abs(loss) > SIGNIFICANT_STDS * std) < n - 1:
        return np.zeros(n)
    return np.array([shared_change(np.delete(loss, j), np.delete(std, j)) for j in range(n)])
