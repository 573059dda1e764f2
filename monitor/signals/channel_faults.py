"""Brief faults of single channels: spikes, steps of the offset, dropouts and bursts of noise, told from the structure's motion.

A structure moves all its sensors.  So a channel that measures helps to predict its neighbours, and one that is at fault spoils
their prediction.  Over short cells of time two linear predictions of the neighbours are compared by their log likelihood ratio:
with the channel's past samples, and without them.  Impacts and earthquakes move the neighbours too and are no faults.

References
----------
R. S. Tsay, D. Pena, A. E. Pankratz, Outliers in multivariate time series, Biometrika 87 (2000) 789-804.
C. W. J. Granger, Investigating causal relations by econometric models, Econometrica 37 (1969) 424-438.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from statistics import NormalDist
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray

from monitor.core import Array
from monitor.signals.flags import runs_of
from monitor.signals.neighbours import ASSUMED_NOISE, FILTER_LENGTH, MOST_PREDICTORS, NORMAL_MAD

CELL = 100
"""Length of a cell, in which a channel is either at fault or not. [samples after resampling; five times the order]"""
FALSE_RATE = 0.01
"""Probability that chance makes a fault in a recording without one. [1; convention]"""
_HIGHPASS = 0.02
"""Corner of the highpass that removes offsets and drift, over the rate. [ratio; the lower end of the compared band]"""
_ROWS_A_COLUMN = 10
"""Samples for each coefficient of a prediction, from which it is estimated. [ratio; judgement]"""
_CHUNK = 128
"""Cells that are predicted at a time. [cells; cost]"""

FaultKind = Literal["spike", "offset step", "dropout", "noise burst"]


@dataclass(frozen=True, eq=False, slots=True)
class RawFacts:
    """Properties of the source's samples in one cell that tell the kind of a fault."""

    mean: Annotated[Array, "c"]
    held: Annotated[Array, "c"]
    """Largest number of consecutive steps without a change."""
    isolated: Annotated[Array, "c"]
    """Largest step of one sample away from both its neighbours, m/s^2."""
    path: Annotated[Array, "c"]
    """Sum of the squared steps from sample to sample, (m/s^2)^2."""

    @classmethod
    def of(cls, samples: Annotated[Array, "n c"], before: Array) -> RawFacts:
        """Describe a cell's samples, m/s^2; `before` holds the two samples before them, if there are any."""
        step = np.diff(np.concatenate([before, samples]), axis=0)
        rise, fall = step[:-1], -step[1:]
        isolated = np.maximum(np.minimum(rise, fall), np.minimum(-rise, -fall)).max(axis=0, initial=0.0)
        held = np.array([_longest(row) for row in (step == 0.0).T], dtype=float)
        return cls(samples.mean(axis=0), held, isolated, (step**2).sum(axis=0))


@dataclass(frozen=True, slots=True)
class Fault:
    """Fault of one channel in consecutive cells of one run."""

    kind: FaultKind
    channel: int
    run: int
    first: int
    """First cell."""
    last: int
    """Last cell."""

    @property
    def begin(self) -> int:
        """First conditioned sample: what happens at the end of a cell shows in the next one."""
        return self.first * CELL - FILTER_LENGTH

    @property
    def end(self) -> int:
        """Conditioned sample just past the fault."""
        return (self.last + 1) * CELL


def _longest(flags: NDArray[np.bool_]) -> int:
    """Return the largest number of consecutive true values."""
    first, past = runs_of(flags)
    return int((past - first).max(initial=0))


def find_faults(runs: Sequence[Annotated[Array, "n c"]], facts: Sequence[Sequence[RawFacts]]) -> tuple[Fault, ...]:
    """Find the brief faults of single channels in a recording.

    A channel is at fault in a cell where its neighbours are predicted better without it, by more than the most that chance
    explains in the whole recording; where that is exceptional for this channel; and where its own innovation is larger than
    usual or it stands still: in a lull the sensors' noise alone makes a channel useless.

    `runs` are conditioned samples without a gap, m/s^2, `facts` those of the source's samples in every cell of each.  Faults are
    in order of channel and time; a single channel has none, for it has no neighbours.

    References
    ----------
    Tsay, Pena and Pankratz (2000): additive outliers and level shifts against innovative outliers.
    """
    if not runs or runs[0].shape[1] < 2:
        return ()
    smooth = [_highpassed(run) for run in runs]
    n_cells = [max(0, min(run.shape[0] // CELL, len(own)) - 1) for run, own in zip(runs, facts, strict=True)]
    total, c = sum(n_cells), runs[0].shape[1]
    groups = _groups(smooth)
    if total * CELL < _ROWS_A_COLUMN * (FILTER_LENGTH + 1) * max(len(g) for g in groups):
        return ()
    scores, flags = np.zeros((total, c)), np.zeros((total, c), dtype=bool)
    for channel, group in enumerate(groups):
        still = np.concatenate(
            [[f.path[channel] == 0.0 for f in own[1 : n + 1]] for own, n in zip(facts, n_cells, strict=True)]
        )
        own_runs = [run[:, group] for run in smooth]
        scores[:, channel], flags[:, channel] = _judge(own_runs, n_cells, still.astype(bool), total * c)
    # What one channel spoils, another's neighbours may seem to suffer from as well: the worst channel of a cell is named.
    flags &= scores >= np.where(flags, scores, -np.inf).max(axis=1, keepdims=True)
    return tuple(_events(flags, n_cells, facts))


def _highpassed(run: Array) -> Array:
    """Remove offset and drift of a run by a first-order highpass."""
    from scipy.signal import lfilter  # takes most of a second to load

    decay = np.exp(-2.0 * np.pi * _HIGHPASS)
    return np.asarray(lfilter([1.0, -1.0], [1.0, -decay], run - run[:1], axis=0), dtype=np.float32)


def _groups(runs: Sequence[Array]) -> list[list[int]]:
    """List for each channel itself and its neighbours, those with the largest correlation."""
    power = np.sum([np.einsum("ni,nj->ij", run, run, dtype=float) for run in runs], axis=0)
    scale = np.sqrt(np.maximum(np.diag(power), np.finfo(float).tiny))
    correlation = np.abs(power / np.outer(scale, scale))
    moves = np.flatnonzero(np.diag(power) > 0.0)
    out = []
    for i in range(power.shape[0]):
        others = [int(j) for j in moves[np.argsort(-correlation[i, moves], kind="stable")] if j != i]
        out.append([i, *others[:MOST_PREDICTORS]])
    return out


def _judge(
    runs: Sequence[Annotated[Array, "n g"]],
    n_cells: Sequence[int],
    still: Annotated[NDArray[np.bool_], "cells"],
    tests: int,
) -> tuple[Annotated[Array, "cells"], Annotated[NDArray[np.bool_], "cells"]]:
    """Judge the first of some channels in every cell by the prediction of the others: its score, and whether it is at fault.

    The score is the log likelihood ratio of the neighbours without and with the channel's past, nats.  The runs have no offsets;
    their first cells hold the filters' transient and are not counted in `n_cells`.  `tests` counts the cells of all channels.
    """
    total, g = sum(n_cells), runs[0].shape[1]
    if g < 2:
        return np.zeros(total), np.zeros(total, dtype=bool)
    power = np.concatenate([(z[:, :, :g] ** 2).sum(axis=1) for z in _regressors(runs, n_cells)])
    moves = np.median(power, axis=0) > np.finfo(np.float32).eps * power.max(axis=0)
    if not moves[0] or moves.sum() < 2:
        return np.zeros(total), np.zeros(total, dtype=bool)
    runs, power = [run[:, moves] for run in runs], power[:, moves]
    loud = (power / np.maximum(np.median(power, axis=0), np.finfo(float).tiny)).mean(axis=1)
    weight = 1.0 / np.maximum(loud, np.finfo(float).tiny)  # every cell counts alike, however strong the motion
    least = np.log(tests / FALSE_RATE)
    exceptional = NormalDist().inv_cdf(1.0 - FALSE_RATE / tests)
    at_fault = np.zeros(total, dtype=bool)
    for _ in range(2):  # once more without the cells that are found at fault
        innovations, without = _innovations(runs, n_cells, np.where(at_fault, 0.0, weight))
        score = 0.5 * CELL * np.log(innovations[:, 1:] / without).sum(axis=1)
        away = score - np.median(score)
        usual = max(NORMAL_MAD * float(np.median(np.abs(away))), np.finfo(float).tiny)
        own = innovations[:, 0]
        at_fault = (score > least) & (away > exceptional * usual) & (still | (own > np.median(own)))
    return score, at_fault


def _regressors(runs: Sequence[Array], n_cells: Sequence[int]) -> Iterator[Annotated[Array, "cells CELL regressors"]]:
    """Yield the samples of some cells beside those of the FILTER_LENGTH instants before, the present ones first."""
    for run, n in zip(runs, n_cells, strict=True):
        for first in range(1, n + 1, _CHUNK):
            cells = min(_CHUNK, n + 1 - first)
            begin, end = CELL * first, CELL * (first + cells)
            past = [run[begin - lag : end - lag].astype(float) for lag in range(FILTER_LENGTH + 1)]
            yield np.concatenate(past, axis=1).reshape(cells, CELL, -1)


def _innovations(
    runs: Sequence[Array], n_cells: Sequence[int], weight: Annotated[Array, "cells"]
) -> tuple[Annotated[Array, "cells g"], Annotated[Array, "cells neighbours"]]:
    """Compute the power of the innovations in every cell, with and without the past of the first channel.

    The former are those of all channels, the latter those of the neighbours by the neighbours' past alone.  The predictions are
    those of least squares over all cells (Yule and Walker), each cell with its weight.
    """
    g = runs[0].shape[1]
    columns = g * (FILTER_LENGTH + 1)
    normal, at = np.zeros((columns, columns)), 0
    for z in _regressors(runs, n_cells):
        rows = (z * np.sqrt(weight[at : at + len(z)])[:, None, None]).reshape(-1, columns)
        normal, at = normal + rows.T @ rows, at + len(z)
    ridge = np.tile(ASSUMED_NOISE * np.diag(normal)[:g], FILTER_LENGTH + 1)
    normal += np.diag(np.maximum(ridge, np.finfo(float).tiny))
    past = np.arange(g, columns)
    filters = np.zeros((columns, 2 * g - 1))
    filters[:g, :g] = np.eye(g)
    filters[1:g, g:] = np.eye(g - 1)
    for used, targets, into in (
        (past, np.arange(g), np.arange(g)),
        (past[past % g != 0], np.arange(1, g), np.arange(g, 2 * g - 1)),
    ):
        filters[np.ix_(used, into)] = -np.linalg.solve(normal[np.ix_(used, used)], normal[np.ix_(used, targets)])
    power = np.concatenate([((z @ filters) ** 2).sum(axis=1) for z in _regressors(runs, n_cells)])
    # Where nothing moves at all, there is nothing to compare.
    least = 1e-12 * np.median(power[:, :g], axis=0) + np.finfo(float).tiny
    return power[:, :g] + least, power[:, g:] + least[1:]


def _events(flags: NDArray[np.bool_], n_cells: Sequence[int], facts: Sequence[Sequence[RawFacts]]) -> Iterator[Fault]:
    """Yield the faults of consecutive flagged cells, with their kinds."""
    described = [own[: n + 2] for own, n in zip(facts, n_cells, strict=True)]
    starts = np.cumsum([0, *n_cells])
    for channel in range(flags.shape[1]):
        own = [flags[a:b, channel] for a, b in pairwise(starts)]
        usual = _Usual.of(channel, own, described)
        for run, flagged in enumerate(own):
            for first, past in zip(*runs_of(flagged), strict=True):
                cells = int(first) + 1, int(past)
                yield Fault(usual.kind(described[run], *cells), channel, run, *cells)


@dataclass(frozen=True, slots=True)
class _Usual:
    """Limits that all but a few of a channel's cells without a fault keep."""

    channel: int
    held: float
    isolated: float
    moved: float

    @classmethod
    def of(cls, channel: int, flags: Sequence[NDArray[np.bool_]], facts: Sequence[Sequence[RawFacts]]) -> _Usual:
        """Read the limits of a channel off the cells that are not flagged."""
        sound = [run[k + 1] for run, own in zip(facts, flags, strict=True) for k in np.flatnonzero(~own).tolist()]
        moved = [
            abs(run[k + 2].mean[channel] - run[k].mean[channel])
            for run, own in zip(facts, flags, strict=True)
            for k in np.flatnonzero(~own).tolist()
            if k + 2 < len(run)
        ]
        held, isolated = [f.held[channel] for f in sound], [f.isolated[channel] for f in sound]
        return cls(channel, *(float(np.quantile(x, 1.0 - FALSE_RATE)) if x else 0.0 for x in (held, isolated, moved)))

    def kind(self, facts: Sequence[RawFacts], first: int, last: int) -> FaultKind:
        """Tell the kind of the fault in some cells of a run."""
        i = self.channel
        cells = facts[first - 1 : last + 1]  # what happens at the end of a cell shows in the next one
        if max(f.held[i] for f in cells) > self.held:
            return "dropout"
        worst = max(cells, key=lambda f: float(f.isolated[i]))
        if worst.isolated[i] > self.isolated and 4.0 * worst.isolated[i] ** 2 > worst.path[i]:
            return "spike"  # most of the path is the two steps of one sample
        after = facts[min(last + 1, len(facts) - 1)].mean[i]
        return "offset step" if abs(after - facts[first - 1].mean[i]) > self.moved else "noise burst"
