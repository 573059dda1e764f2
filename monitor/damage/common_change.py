"""What the watched quantities do together without a known cause, separated from what one of them does alone.

Weather that no channel measures moves all stories, each by a share of its own.  How they move together is learned from healthy
windows as a covariance, and each story is then compared with what the others let expect of it: the conditional mean of a
Gaussian distribution, with the variance of a prediction by a regression.  The distribution may have any number of common
factors; that of the first may grow beyond anything learned.

Each healthy window enters with its distance from the mean of the two days after it.  The distances hold neither the healthy
stiffness nor a loss that grows over weeks.  Their noise is known from the windows; what exceeds it is the common change.  A
window far from those learned before counts less, as in an estimate by a multivariate t distribution.

How far each story went in healthy service is kept too.  Beyond that, as beyond the learned range of a covariate, each story may
follow by a share of its own (frost), and the variance of what the others let expect grows with the distance.

References
----------
K. V. Mardia, J. T. Kent, J. M. Bibby, Multivariate analysis (1979), section 3.2.4 (conditional distributions); N. R. Draper, H.
Smith, Applied regression analysis (1998), section 5.1 (variance of a prediction); G. Schwarz, Ann. Statist. 6 (1978) 461-464
(whether anything was learned); K. L. Lange, R. J. A. Little, J. M. G. Taylor, J. Am. Stat. Assoc. 84 (1989) 881-896 (weights).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from monitor.core import Array, Reading

JudgedReading = TypeVar("JudgedReading", bound=Reading)

EVERY_NS = 3_600_000_000_000
"""Time between two windows that are learned from: they share no data. [ns; judgement]"""
WAIT_NS = 48 * EVERY_NS
"""Time for which nothing must be announced after a window before it is learned from. [ns; judgement: longer than small losses of
1 percent take to be announced]"""
UNMEASURED = "unmeasured"
"""Name, among the covariates, of what all stories do together without a known cause. [name]"""
LOCAL_LOSS_CREDIT = 1.0
"""A loss in one story needs this much less evidence than a uniform change, which is the rarer explanation. [standard
deviations; judgement]"""
SIGNIFICANT_STDS = 3.0
"""Size from which a change counts as significant. [standard deviations; convention: three sigma]"""
_ANY_SIZE = 1.0
"""Standard deviation of a change of all stories alike, where one is found. [relative change; rounding: any value far above the
changes of healthy structures]"""


@dataclass(frozen=True, eq=False, slots=True)
class CommonChange:
    """Sums of healthy windows from which the covariance of common changes follows."""

    square: Annotated[Array, "n n"]
    """Weighted sum of the squared distances, in the columns of `CovariateLaw.mixing`, where one window's noise is
    1."""
    windows: int
    """Number of windows in the sum."""
    lowest: Annotated[Array, "2 n+2 n"]
    """Lowest values, over a stretch of two days, of the change of each quantity and of its negative: in the
    stretch that goes on, then in the n + 1 others that went lowest."""

    def add(self, distance: Array, change: Array) -> CommonChange:
        """Add a healthy window by its distance and by what the covariates leave of its change, shape (n,) each."""
        now, others = np.stack([change, -change]), self.lowest[:, 1:]
        if self.windows % (WAIT_NS // EVERY_NS):
            now = np.minimum(now, self.lowest[:, 0])
        else:  # another stretch begins
            others = np.sort(self.lowest, axis=1)[:, :-1]
        lowest = np.concatenate([now[:, None], others], axis=1)
        square = self.square + self._weight(distance) * np.outer(distance, distance)
        return CommonChange(square, self.windows + 1, lowest)

    def _weight(self, distance: Array) -> float:
        """Compute the weight of a window: that of a multivariate t distribution with a degree of freedom for each stretch.

        Two days around a loss that was not announced would otherwise outweigh weeks, and the loss would be learned as weather.
        """
        if self.stretches < self.wanted:
            return 1.0
        covariance = (self.square + np.eye(distance.size)) / (self.windows + 1)  # noise alone counts as one window more
        outlying = float(distance @ np.linalg.solve(covariance, distance))
        return (self.stretches + distance.size) / (self.stretches + outlying)

    @property
    def stretches(self) -> float:
        """Number of stretches of two days: their windows' weather is taken as one."""
        return self.windows * EVERY_NS / WAIT_NS

    @property
    def wanted(self) -> int:
        """Number of stretches from which a covariance of n quantities can be estimated at all."""
        return len(self.square) + 1

    def seen(self) -> Array:
        """Compute the least and greatest loss of each quantity that as many stretches reached as are wanted, shape (2, n).

        Fewer of them do not teach what the quantities do there.  A loss of 0, the baseline, is always among them.
        """
        low, minus_high = np.sort(self.lowest, axis=1)[:, self.wanted - 1]
        return np.asarray(-np.expm1(np.stack([-minus_high, low])))

    def words(self, mixing: Array) -> str:
        """Say for people if it is learned."""
        if self.learned(mixing, 0.0) is not None:
            return f"learned from {self.stretches:.3g} stretches of two days"
        if self.stretches < self.wanted:
            return f"not learned: {self.stretches:.3g} of {self.wanted} stretches of two days"
        return f"nothing beyond the noise of the windows, in {self.stretches:.3g} stretches of two days"

    def learned(self, mixing: Annotated[Array, "n n"], unevenness: float) -> Expected | None:
        """Estimate the covariance of common changes; `mixing` is `CovariateLaw.mixing`, `unevenness` as in `Expected`.

        It is None while too few windows are known, or noise alone explains them as well (Bayesian information criterion).
        """
        n = len(self.square)
        if n < 2 or self.stretches < self.wanted:
            return None
        size, directions = np.linalg.eigh(self.square / self.windows)
        excess = np.maximum(size - 1.0, 0.0)
        if not is_known(float((excess - np.log1p(excess)).sum()), n * (n + 1) // 2, self.stretches):
            return None
        root = mixing @ (directions * np.sqrt(excess))
        leading = root[:, -1] / np.linalg.norm(root[:, -1])
        return Expected(root @ root.T, leading, self.stretches, self.seen(), unevenness)


@dataclass(frozen=True, eq=False, slots=True)
class Expected:
    """How far the quantities change together, as learned."""

    covariance: Annotated[Array, "n n"]
    """Of the relative changes, without the noise of windows."""
    leading: Annotated[Array, "n"]
    """The direction that stands out most from the noise, of length 1.  How far it goes is taken as unknown: seasons go farther
    than what was learned."""
    stretches: float
    """Independent stretches that it was learned from."""
    seen: Annotated[Array, "2 n"]
    """Least and greatest loss of each quantity that was learned (`CommonChange.seen`)."""
    unevenness: float
    """Scatter of the quantities' shares beyond what was learned, about a common one, relative to its size."""

    def of(self, chosen: NDArray[np.intp]) -> Expected:
        """Return the same for some of the quantities (0 = first)."""
        return Expected(
            self.covariance[np.ix_(chosen, chosen)],
            self.leading[chosen],
            self.stretches,
            self.seen[:, chosen],
            self.unevenness,
        )

    def beside_others(
        self, loss: Annotated[Array, "n"], covariance: Annotated[Array, "n n"], *, either_side: bool = False
    ) -> Beside:
        """Compare the loss of each part with what those others let expect that are not lost themselves.

        Parts are set aside one by one, the most significant loss first; so are, where it explains more, a change of all parts
        alike, and its size is then taken as unknown.  `covariance` is that of the losses, without what is learned here; with
        `either_side` a gain counts as a loss does.
        """
        found = self.each_beside_others(loss[None], covariance[None], either_side=either_side)
        return Beside(found.loss[0], found.std[0], found.weights[0], found.inflation[0], found.beyond[0])

    def each_beside_others(
        self, losses: Annotated[Array, "k n"], covariances: Annotated[Array, "k n n"], *, either_side: bool = False
    ) -> Beside:
        """Compare each of k measurements, as `beside_others`; the arrays of the outcome have k before their other dimensions."""
        learned, total = self._covariances(covariances)
        found = self._compare(losses, learned, total)
        weights, inflation = found.weights, found.inflation
        # Mostly nothing is to be set aside, and one comparison of all does.
        most = (np.abs(found.z) if either_side else found.z).max(axis=-1)
        aside = (most >= SIGNIFICANT_STDS) | (found.z_alike > np.maximum(most + LOCAL_LOSS_CREDIT, SIGNIFICANT_STDS))
        for k in np.flatnonzero(aside).tolist():
            total[k], weights[k], inflation[k] = self._set_aside(
                losses[k], learned[k], total[k], found.of(k), either_side=either_side
            )
        beyond = self._beyond(losses, weights)
        std = np.sqrt(inflation * ((weights @ total) * weights).sum(axis=-1) + beyond)
        return Beside((weights @ losses[..., None])[..., 0], std, weights, inflation, beyond)

    def _covariances(self, own: Array) -> tuple[Array, Array]:
        """Add to covariances of losses, shape (..., n, n), what was learned; return that, and with what is of any size."""
        learned = own + self.covariance
        return learned, learned + _ANY_SIZE**2 * np.outer(self.leading, self.leading)

    def _beyond(self, losses: Array, weights: Array) -> Array:
        """Compute the variance of what others let expect of each story that lie beyond what was learned, shape (k, n).

        Each of them, and the story itself, may have gone there by a share of its own.  How far the story itself has gone does not
        count: a loss does not hide itself.
        """
        excess = losses - np.minimum(np.maximum(losses, self.seen[0]), self.seen[1])
        if not excess.any():  # as mostly
            return np.zeros_like(losses)
        parts = weights * (1.0 - np.eye(losses.shape[-1])) * excess[:, None, :]
        return np.asarray(self.unevenness**2 * (parts.sum(axis=-1) ** 2 + (parts**2).sum(axis=-1)))

    def _set_aside(
        self, loss: Array, learned: Array, total: Array, found: _Compared, *, either_side: bool
    ) -> tuple[Array, Array, Array]:
        """Set aside the parts that are lost themselves, and a change of all alike, and compare each part with the rest.

        `learned` and `total` are the covariance of the losses: as learned, and with what is of any size; `found` compares all
        parts.  Returned are the total with what else is of any size, and `weights` and `inflation` as in `Beside`.
        """
        n = loss.size
        kept, alike = tuple(range(n)), False
        known = {kept: found}

        def compared(chosen: tuple[int, ...]) -> _Compared:
            """Compare the chosen stories, each with the other chosen ones, once."""
            if chosen not in known:
                known[chosen] = self._compare_some(loss, learned, total, chosen)
            return known[chosen]

        while True:
            found = compared(kept)
            z = np.abs(found.z) if either_side else found.z
            best = int(z.argmax())
            if not alike and found.z_alike > max(float(z[best]) + LOCAL_LOSS_CREDIT, SIGNIFICANT_STDS):
                total, alike = total + _ANY_SIZE**2 * np.ones((n, n)), True
                known.clear()
            elif z[best] < SIGNIFICANT_STDS or len(kept) < 2:
                break
            else:
                kept = kept[:best] + kept[best + 1 :]
        weights, inflation = np.zeros((n, n)), np.ones(n)
        weights[np.ix_(kept, kept)], inflation[list(kept)] = found.weights, found.inflation
        for j in sorted(set(range(n)) - set(kept)):
            chosen = tuple(sorted((*kept, j)))
            found, row = compared(chosen), chosen.index(j)
            weights[j, chosen], inflation[j] = found.weights[row], found.inflation[row]
        if len(kept) == 1:  # the only one that is not lost: by the others, for want of better
            found, only = compared(tuple(range(n))), kept[0]
            weights[only], inflation[only] = found.weights[only], found.inflation[only]
        return total, weights, inflation

    def _compare_some(self, loss: Array, learned: Array, total: Array, chosen: tuple[int, ...]) -> _Compared:
        """Compare the chosen stories, each with the other chosen ones."""
        rows = np.array(chosen)
        square = rows[:, None], rows
        return self._compare(loss[None, rows], learned[square][None], total[square][None]).of(0)

    def _compare(self, losses: Array, learned: Array, total: Array) -> _Compared:
        """Compare stories, each with the others, in each of k measurements (`kernels.beside_each_other`)."""
        from monitor.damage.kernels import beside_each_other  # compiled code takes a while to load

        of_learned, of_total = (np.asarray(np.linalg.inv(m), dtype=float) for m in (learned, total))
        return _Compared(*beside_each_other(np.ascontiguousarray(losses), of_learned, of_total, self.stretches))

    def take_out(self, reading: JudgedReading, beside: Beside) -> JudgedReading:
        """Take out of a window's losses what the other parts let expect (`beside_others`)."""
        own, common = beside.left_of(
            np.stack([reading.covariance - reading.common_covariance, reading.common_covariance + self.covariance])
        )
        common += np.diag(beside.beyond)
        return reading.left_by_others(beside.loss, own + common, common, UNMEASURED)

    def left_of_intact(self, variance: Array, common: Array, beside: Beside) -> tuple[Array, Array]:
        """Compute the variances of windows' losses, shape (n,), and what they have in common, (n, n), once that is taken out.

        It is of a structure without loss: what changes from window to window by chance stays out of it, so that the simulation of
        the smallest detectable loss serves the next windows too.
        """
        inverse = np.linalg.inv(self._covariances(np.diag(variance) + common)[1])
        intact = inverse / inverse.diagonal()[:, None]  # weights, as in `Beside`
        left = replace(beside, weights=intact).left_of(common + self.covariance)
        left += np.diag(beside.beyond)
        return intact**2 @ variance, left


class _Compared(NamedTuple):
    """Comparison of n stories, each with the others."""

    z: Annotated[Array, "k n"]
    """z-score of each loss beyond what the others let expect."""
    weights: Annotated[Array, "k n n"]
    """That loss as a combination of the measured ones."""
    inflation: Annotated[Array, "k n"]
    """Factor of its variance, as in `Beside`."""
    z_alike: Annotated[Array, "k"]
    """Size of the z-score of a change of all alike."""

    def of(self, k: int) -> _Compared:
        """Return the comparison of one of several measurements."""
        return _Compared(self.z[k], self.weights[k], self.inflation[k], self.z_alike[k])


@dataclass(frozen=True, eq=False, slots=True)
class Beside:
    """Losses of n stories beyond what the others let expect."""

    loss: Annotated[Array, "n"]
    std: Annotated[Array, "n"]
    weights: Annotated[Array, "n n"]
    """`loss` as a combination of the measured losses."""
    inflation: Annotated[Array, "n"]
    """Factor of the variance, since what was learned holds the less, the further the others are from it."""
    beyond: Annotated[Array, "n"]
    """Variance, in `std`, that comes of others that lie beyond what was learned."""

    def beyond_words(self, most_std: float) -> str:
        """Say that the parts lie where a loss of one is hidden by what was not learned; empty where they do not.

        Up to a standard deviation of `most_std`, of what was not learned, nothing is hidden.
        """
        hidden = self.beyond.max() > most_std**2
        return "what the stories do together goes beyond anything learned" if hidden else ""

    def left_of(self, covariance: Array) -> Array:
        """Return what is left of a covariance of the measured losses, or of several, shape (..., n, n)."""
        inflation = np.sqrt(np.outer(self.inflation, self.inflation))
        return np.asarray(inflation * (self.weights @ covariance @ self.weights.T))


def is_known(divergence: float, unknowns: int, count: float) -> bool:
    """Decide by the Bayesian information criterion if data show a covariance that differs from none.

    `divergence` is twice the gain in ln likelihood of one observation, `unknowns` the number of values that were estimated.
    """
    return bool(count * divergence > unknowns * np.log(count))


def nothing_learned(n: int) -> CommonChange:
    """Return the sums of n quantities before the first window."""
    return CommonChange(np.zeros((n, n)), 0, np.zeros((2, n + 2, n)))


def distance(changes: Annotated[Array, "w n"], mixing: Annotated[Array, "n n"]) -> Annotated[Array, "n"]:
    """Compute the distance of a window from the mean of those after it, scaled to the noise of one window.

    `changes` are what the covariates leave of the windows' changes, two or more, the window first; `mixing` is
    `CovariateLaw.mixing`.
    """
    away = (changes[0] - changes[1:].mean(axis=0)) / np.sqrt(1.0 + 1.0 / (len(changes) - 1))
    return np.asarray(np.linalg.solve(mixing, away))


def learn_common(changes: Array, t_ns: NDArray[np.int64], mixing: Array) -> CommonChange:
    """Learn from healthy windows at their times (UTC, increasing) what the covariates leave of their changes, shape (w, n)."""
    hourly: list[int] = []
    for k, t in enumerate(t_ns.tolist()):
        if not hourly or t - int(t_ns[hourly[-1]]) >= EVERY_NS:
            hourly.append(k)
    t_ns, changes = t_ns[hourly], changes[hourly]
    learned = nothing_learned(changes.shape[1])
    for k, end in enumerate(np.searchsorted(t_ns, t_ns + WAIT_NS, side="right")):
        if int(t_ns[-1]) - int(t_ns[k]) < WAIT_NS:
            break
        if end - k > 1:
            learned = learned.add(distance(changes[k:end], mixing), changes[k])
    return learned
