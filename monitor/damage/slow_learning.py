"""Covariates' law, learned on in healthy service: slopes and common changes, never the healthy stiffness.

One window an hour waits for two days; if nothing was announced meanwhile, it is learned from.  A change of stiffness that is no
covariate's, such as a loss that grows slowly, is estimated beside the slopes as a random walk and left out of the law.  So a
trend in time is not taken for a slope, even where the season runs with it: the slopes follow from what moves with the
covariates within days.

References
----------
M. West, J. Harrison, Bayesian forecasting and dynamic models (1997), chapters 4 and 9 (regression with a random-walk level).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from monitor.core import Array
from monitor.damage.common_change import EVERY_NS, WAIT_NS, CommonChange, distance
from monitor.damage.covariate_law import Axis, CovariateLaw, stories_prior

_DRIFT = 0.01 / np.sqrt(30.0 * 86_400.0)
"""Random walk of a story's stiffness that is no covariate's. [1/sqrt(s); judgement: one percent in a month]"""


@dataclass(frozen=True, eq=False, slots=True)
class LearningState:
    """Law as it is now, and the windows that wait."""

    law: CovariateLaw
    drift: Annotated[Array, "n"]
    """Change that is no covariate's, in the columns of `CovariateLaw.mixing`."""
    joint: Annotated[Array, "n k+1 k+1"]
    """Covariance of the slopes and the drift for each column of the mixing."""
    learned_ns: int
    """Time of the last window that was learned from, UTC."""
    t_ns: Annotated[NDArray[np.int64], "w"]
    """Windows that wait, UTC."""
    values: Annotated[Array, "w axes"]
    """Their covariates, each at its lag."""
    changes: Annotated[Array, "w n"]
    """Their changes of the logarithm of stiffness since the baseline."""


def start(law: CovariateLaw, t_ns: int) -> LearningState:
    """Return the state at the first window, at `t_ns` (UTC): the law as calibrated, and no drift."""
    n, k = law.slopes.shape
    joint = np.zeros((n, k + 1, k + 1))
    joint[:, :k, :k] = law.posterior
    none = np.zeros(0, dtype=np.int64)
    return LearningState(law, np.zeros(n), joint, t_ns, none, np.zeros((0, len(law.axes))), np.zeros((0, n)))


def step(
    state: LearningState,
    covariates: Mapping[str, Array],
    change: Annotated[Array, "n"],
    t_ns: int,
    unevenness: float,
    *,
    normal: bool,
) -> LearningState:
    """Take a window, and learn from those that have waited long enough.

    `change` is the change of the logarithm of each quantity since the baseline; nothing is taken out of it.  `t_ns` is the UTC
    of the window's end, `unevenness` the scatter of the quantities' drift about a common one, relative to its size.  If anything
    is announced (not `normal`), the windows that wait are dropped, for it may have begun with them.
    """
    if not normal:
        return replace(state, t_ns=state.t_ns[:0], values=state.values[:0], changes=state.changes[:0])
    taken = [covariates[a.name][a.lag] if a.name in covariates else np.nan for a in state.law.axes]
    last_ns = int(state.t_ns[-1]) if state.t_ns.size else state.learned_ns
    if t_ns - last_ns >= EVERY_NS and np.isfinite(taken).all():
        state = replace(
            state,
            t_ns=np.append(state.t_ns, t_ns),
            values=np.vstack([state.values, taken]),
            changes=np.vstack([state.changes, change]),
        )
    while state.t_ns.size and t_ns - int(state.t_ns[0]) >= WAIT_NS:
        state = _learn(state, unevenness)
    return state


def _learn(state: LearningState, unevenness: float) -> LearningState:
    """Update slopes and drift by the first window that waits (a Kalman filter for each column of the mixing)."""
    law, (n, k) = state.law, state.law.slopes.shape
    basis = [a.basis(np.array([v]))[0] for a, v in zip(law.axes, state.values[0], strict=True)]
    away = np.append(np.concatenate(basis) - law.centre, 1.0)
    inverse = np.linalg.inv(law.mixing)
    measured = inverse @ state.changes[0]
    since_s = max(int(state.t_ns[0]) - state.learned_ns, 0) * 1e-9
    walk = np.diag(inverse @ stories_prior(n, unevenness) @ inverse.T) * _DRIFT**2 * since_s
    mean = np.column_stack([inverse @ law.slopes, state.drift])
    joint = state.joint.copy()
    joint[:, k, k] += walk
    toward = joint @ away
    gain = toward / (toward @ away + law.scatter)[:, None]
    mean = mean + gain * (measured - mean @ away)[:, None]
    joint = joint - gain[:, :, None] * toward[:, None, :]
    joint = 0.5 * (joint + joint.transpose(0, 2, 1))
    axes = tuple(_wider(a, float(v)) for a, v in zip(law.axes, state.values[0], strict=True))
    law = replace(
        law, axes=axes, slopes=law.mixing @ mean[:, :k], posterior=joint[:, :k, :k].copy(), common=_common_change(state)
    )
    return LearningState(
        law, mean[:, k], joint, int(state.t_ns[0]), state.t_ns[1:], state.values[1:], state.changes[1:]
    )


def _common_change(state: LearningState) -> CommonChange | None:
    """Learn from the first window that waits, beside those after it, what the quantities do together."""
    law = state.law
    if law.common is None or len(state.changes) < 2:
        return law.common
    left = state.changes - law.at(state.values)
    return law.common.add(distance(left, law.mixing), left[0])


def _wider(axis: Axis, value: float) -> Axis:
    """Extend the learned range of a covariate to a value."""
    return replace(axis, range=(min(axis.range[0], value), max(axis.range[1], value)))
