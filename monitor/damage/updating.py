"""Iterative model updating by penalty functions (paper, section 3, eqs 18-33).

The measured vector z holds, for each mode, its eigenvalue (or the eigenvalue's logarithm) and, if wanted, the
components of its shape relative to a gauge component, the channel by which the shape is normalized.  The parameters theta
are story stiffnesses and, for a baseline, floor masses.  Directions of theta that the data do not determine keep their
prior values, and are reported.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.linalg import lapack

from monitor.core import Array, ComplexArray, ModalEstimate, Settings
from monitor.damage.sensitivity import fox_kapoor
from monitor.identification import SelectionSettings
from monitor.model import Model, Modes

UNSEEN = 0.7
"""A parameter, or a direction, is not identified when the data leave more than this share of its prior standard
deviation. [ratio; judgement: half of the prior variance is left at 0.7]"""
_ROUNDED_TO_0 = 1e-9
"""Share of the largest below which an eigenvalue, as of a structure that would not stand, or a pivot is not told from zero.
[ratio; rounding]"""
_MIN_SHAPE_RATIO = 1e-6
"""A channel at which a shape has less than this share of its largest component cannot normalize the shape. [ratio;
rounding]"""
_MIN_REORDERING_MAC = SelectionSettings().min_model_mac
"""Modes are matched in another order than that of their frequencies when the mean of the modal assurance criterion rises by more
than this.  A mode that was matched at all so never leaves a model whose modes are in order."""

Penalty = Literal["least_squares", "weighted", "step", "initial", "minimum_norm"]


class UpdatingSettings(Settings):
    """``[updating]``: penalty, data and convergence of the model updating."""

    penalty: Penalty = "weighted"
    """least_squares: eqs 22-24; weighted: 25-27; step: 28-30; initial: 31-33; minimum_norm: 21."""
    use_shapes: bool = True
    """Use mode shapes besides frequencies.  Without them, as in the paper, most of the information is lost."""
    eigenvalue: Literal["log", "linear"] = "log"
    """Compare logarithms of eigenvalues (a scale error of the masses then cancels from changes), or eigenvalues as in the
    paper."""
    parameter_std: float = Field(default=0.2, gt=0)
    """Relative standard deviation for W_theta where no prior is given; the service gives the ranges of the structure file."""
    max_iterations: int = Field(default=50, ge=1)
    """Largest number of iterations; a window without convergence is skipped."""
    tolerance: float = Field(default=1e-7, gt=0)
    """Convergence when no parameter changes by more than this fraction."""


MODES_ALONE = UpdatingSettings()
"""What is measured where modes alone are judged: logarithms of eigenvalues, and shapes."""


@dataclass(frozen=True, eq=False, slots=True)
class Observation:
    """Measured vector z_m of eq. 27 with its weights, influences and modes."""

    z: Annotated[Array, "d"]
    """Eigenvalues (or logarithms), then shape components mode by mode."""
    weight: Annotated[Array, "d d"]
    """W of eq. 27, the inverse of a covariance or of its diagonal."""
    deviations: Annotated[Array, "blocks d"]
    """Influences whose squares sum to the covariance of z."""
    model_mode: tuple[int, ...]
    """Numbers of the modes in the model (0 = lowest), before an update reorders them (`counterparts`)."""
    gauges: tuple[int, ...]
    """Channel whose shape component is 1, for each mode; empty when shapes are not used."""
    log: bool


@dataclass(frozen=True, eq=False, slots=True)
class Update:
    """Outcome of the iteration; without convergence `converged` is false, and no error is raised."""

    model: Model
    parameters: Annotated[Array, "p"]
    gain: Annotated[Array, "p d"]
    """d parameters / d z at the solution."""
    sensitivity: Annotated[Array, "d p"]
    """S at the solution."""
    residual: Annotated[Array, "d"]
    """z_m - z."""
    converged: bool
    iterations: int
    """0 where a mode does not move at its gauge, or cannot be computed: the model is then unchanged."""
    history: Annotated[Array, "iterations+1 p"]
    """The initial values first."""
    identifiable: Annotated[Array, "p"]
    """Share of each parameter's prior variance that the data remove, 0 to 1."""
    unseen: Annotated[Array, "unseen p"]
    """Directions of relative change, of length 1, not identified by the data (`UNSEEN`)."""
    prior_left: Annotated[Array, "p p"]
    """Covariance of the parameters that remains from the prior at this gain."""


def observe(modes: ModalEstimate, settings: UpdatingSettings, gauges: tuple[int, ...] | None = None) -> Observation:
    """Form the measured vector z_m, its weights and its influences from identified modes.

    Of m modes at c channels there are m data without shapes, and m c with them.  Each shape is normalized by its gauge; by
    default that is the channel of its largest component.  For a change since a baseline the gauges must be the baseline's.
    """
    log = settings.eigenvalue == "log"
    omega_squared = (2.0 * np.pi * modes.frequencies_hz) ** 2
    if not settings.use_shapes:
        gauges = ()
    elif gauges is None:
        gauges = tuple(int(g) for g in np.abs(modes.shapes).argmax(axis=1))
    z = [np.log(omega_squared) if log else omega_squared]
    if gauges:
        free, at_gauge = _split_at_gauges(modes.shapes, gauges)
        z.append((modes.shapes / at_gauge[:, None]).real[free])
    scale = np.full(omega_squared.shape, 2.0) if log else 2.0 * omega_squared
    deviations = _propagate(modes, modes.deviations, scale, gauges)
    if modes.weight_factor is None:
        weight = np.diag(1.0 / (deviations**2).sum(axis=0))
    else:
        factor = _propagate(modes, modes.weight_factor, scale, gauges)
        weight = np.linalg.inv(factor.T @ factor)
    model_mode = tuple(int(i) for i in modes.model_mode)
    return Observation(np.concatenate(z), weight, deviations, model_mode, gauges, log)


def _propagate(
    modes: ModalEstimate, rows: Annotated[Array, "rows m 2c+2"], scale: Annotated[Array, "m"], gauges: tuple[int, ...]
) -> Annotated[Array, "rows d"]:
    """Propagate deviations of (ln f, damping, Re shape, Im shape) to z."""
    c = modes.shapes.shape[1]
    parts = [rows[:, :, 0] * scale]
    if gauges:
        free, at_gauge = _split_at_gauges(modes.shapes, gauges)
        d_shapes = rows[:, :, 2 : 2 + c] + 1j * rows[:, :, 2 + c :]
        shapes = modes.shapes / at_gauge[:, None]
        d_ratio = (d_shapes - shapes * d_shapes[:, ~free][:, :, None]) / at_gauge[:, None]
        parts.append(d_ratio.real[:, free])
    return np.concatenate(parts, axis=1)


def _split_at_gauges(shapes: Array | ComplexArray, gauges: tuple[int, ...]) -> tuple[NDArray[np.bool_], Any]:
    """Return the mask of the components that are in z (all but the gauges), and the values at the gauges."""
    free, gauge = gauge_masks(shapes.shape[1], gauges)
    return free, shapes[gauge]


@lru_cache(maxsize=64)
def gauge_masks(n_channels: int, gauges: tuple[int, ...]) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return the masks of the components that are not the gauge of their shape, and of those that are."""
    free = np.arange(n_channels) != np.array(gauges)[:, None]
    return free, ~free


def counterparts(modes: Modes, sensors: Annotated[Array, "c n"], observation: Observation) -> tuple[int, ...]:
    """Match the observed modes to a model's modes (0 = lowest): by frequency, or by shape where a change has altered the order.

    `sensors` is the sensor matrix, channels by floors.  In its original order the modes of the model, during updating, are
    those of `observation.model_mode`, by rank.
    """
    by_rank, observed = _rank_observation(observation, len(sensors))
    if not observation.gauges:
        return tuple(by_rank.tolist())
    from scipy.optimize import linear_sum_assignment  # takes a third of a second to load

    shapes = sensors @ modes.shapes
    power = (shapes**2).sum(axis=0)
    power = np.maximum(power, 1e-6 * power.max())  # a mode that no sensor observes matches no observed mode
    mac = (observed @ shapes) ** 2 / power
    mac[np.arange(by_rank.size), by_rank] += _MIN_REORDERING_MAC
    return tuple(linear_sum_assignment(mac, maximize=True)[1].tolist())


@lru_cache(maxsize=8)
def _rank_observation(observation: Observation, n_channels: int) -> tuple[NDArray[np.intp], Array]:
    """Return the model's modes by rank of the observed frequencies, and the observed shapes of unit norm."""
    m = len(observation.model_mode)
    by_rank = np.empty(m, dtype=np.intp)
    by_rank[observation.z[:m].argsort(kind="stable")] = sorted(observation.model_mode)
    observed = np.ones((m, n_channels))
    if observation.gauges:
        observed[gauge_masks(n_channels, observation.gauges)[0]] = observation.z[m:]
    return by_rank, observed / np.sqrt((observed**2).sum(axis=1, keepdims=True))


def predict(
    model: Model, sensors: Annotated[Array, "c n"], observation: Observation, with_masses: bool
) -> tuple[Annotated[Array, "d"], Annotated[Array, "d p"]]:
    """Predict z by the model's modes `observation.model_mode`, with the sensitivity S = dz / d theta (eqs 18-20).

    The parameters are the stiffnesses, then the masses if `with_masses`.  It raises numpy.linalg.LinAlgError if the model has no
    modes, or one of them does not move at its gauge.
    """
    return _predict_selected(_sensitive_modes(model, with_masses), sensors, observation)


def _sensitive_modes(model: Model, with_masses: bool) -> tuple[Modes, Array, Array]:
    """Compute a model's modes and their derivatives by the parameters (`fox_kapoor`)."""
    modes = model.modes()
    return modes, *fox_kapoor(modes, *_matrix_derivatives(model, with_masses))


_starting_modes = lru_cache(maxsize=4)(_sensitive_modes)
"""`_sensitive_modes`, cached for the models that updates start from: every window starts from the baseline's."""


def _predict_matched(
    found: tuple[Modes, Array, Array], sensors: Array, observation: Observation
) -> tuple[Array, Array]:
    """Predict as `predict`, by the model's modes that match the observed ones (`counterparts`)."""
    own = counterparts(found[0], sensors, observation)
    if own != observation.model_mode:
        observation = replace(observation, model_mode=own)
    return _predict_selected(found, sensors, observation)


def _predict_selected(
    found: tuple[Modes, Array, Array], sensors: Array, observation: Observation
) -> tuple[Array, Array]:
    """Predict as `predict`, from modes and derivatives computed before."""
    modes, d_lambda, d_shapes = found
    used = list(observation.model_mode)
    lam = np.maximum(modes.eigenvalues, _ROUNDED_TO_0 * modes.eigenvalues[-1])[used]
    z = [np.log(lam) if observation.log else lam]
    rows = [d_lambda[used] / lam[:, None] if observation.log else d_lambda[used]]
    if observation.gauges:
        shapes, d_at_sensors = (sensors @ modes.shapes[:, used]).T, sensors @ d_shapes[used]
        free, at_gauge = _split_at_gauges(shapes, observation.gauges)
        if (np.abs(at_gauge) <= _MIN_SHAPE_RATIO * np.abs(shapes).max(axis=1)).any():
            raise np.linalg.LinAlgError("a mode does not move at its gauge")
        ratio = shapes / at_gauge[:, None]
        d_ratio = (d_at_sensors - ratio[:, :, None] * d_at_sensors[~free][:, None]) / at_gauge[:, None, None]
        z.append(ratio[free])
        rows.append(d_ratio[free])
    return np.concatenate(z), np.concatenate(rows)


def update(
    model: Model,
    sensors: Annotated[Array, "c n"],
    observation: Observation,
    settings: UpdatingSettings,
    *,
    prior_std: Annotated[Array, "p"] | None = None,
    with_masses: bool = False,
) -> Update:
    """Update the model's parameters to an observation by iterating eq. 23, 27, 30 or 33 from their present values.

    Parameters
    ----------
    sensors : ndarray
        Sensor matrix: channels by floors.
    prior_std : ndarray, optional
        Relative standard deviations for W_theta; by default `settings.parameter_std` for all.  If they are given, penalty
        ``weighted`` is replaced by ``initial`` where the data do not identify a direction, which is otherwise undetermined.
    with_masses : bool
        Update the floor masses, kg, too, which follow the stiffnesses, N/m.  Only the prior determines their scale, so this
        requires penalty ``initial``.
    """
    structure = model.structure
    initial = np.concatenate([structure.stiffness_n_per_m, structure.masses_kg][: 2 if with_masses else 1])
    relative = np.full(initial.size, settings.parameter_std) if prior_std is None else prior_std
    try:
        return _iterate(model, sensors, observation, settings, initial, relative, prior_std is not None, with_masses)
    except np.linalg.LinAlgError:
        no_gain = np.zeros((initial.size, observation.z.size))
        return Update(
            model=model,
            parameters=initial,
            gain=no_gain,
            sensitivity=no_gain.T,
            residual=np.zeros(observation.z.size),
            converged=False,
            iterations=0,
            history=initial[None],
            identifiable=np.zeros(initial.size),
            unseen=np.eye(initial.size),
            prior_left=np.diag((relative * initial) ** 2),
        )


def _iterate(
    model: Model,
    sensors: Array,
    observation: Observation,
    settings: UpdatingSettings,
    initial: Array,
    relative: Array,
    use_prior: bool,
    with_masses: bool,
) -> Update:
    """Run the iteration of `update` from the parameters `initial`; it raises numpy.linalg.LinAlgError as `predict`.

    With `use_prior`, directions that the data do not identify keep the prior of relative standard deviations `relative`.
    """
    theta, history = initial.copy(), [initial]
    w_theta = 1.0 / (relative * initial) ** 2
    converged, penalty = False, settings.penalty
    z, sensitivity = _predict_matched(_starting_modes(model, with_masses), sensors, observation)
    if penalty == "weighted" and use_prior:
        least = np.linalg.eigvalsh(_information(sensitivity, observation.weight, initial, relative))[0]
        penalty = "initial" if 1.0 / np.sqrt(1.0 + max(least, 0.0)) > UNSEEN else penalty

    def objective(z: Array, parameters: Array) -> float:
        """Evaluate the objective J of eqs 25 and 31."""
        error, change = observation.z - z, parameters - initial
        prior_term = float(change @ (w_theta * change)) if penalty == "initial" else 0.0
        return float(error @ observation.weight @ error) + prior_term

    # With as many parameters as data every residual can vanish, and the iteration without step control is the paper's.
    overdetermined = observation.z.size > theta.size or penalty == "initial"
    for _ in range(settings.max_iterations):
        gain = _gain(sensitivity, observation.weight, w_theta, penalty)
        step = gain @ (observation.z - z)
        if penalty == "initial":  # eq. 33 penalizes the distance from the initial values, eq. 30 only the step
            step -= _prior_pull(sensitivity, observation.weight, w_theta) @ (theta - initial)
        # A step is shortened so that no parameter decreases by more than half: a stiffness must not become negative.
        step /= max(1.0, float(np.max(-2.0 * step / theta)))
        if np.abs(step / theta).max() < settings.tolerance:  # z is linear in so small a step
            converged, theta, z = True, theta + step, z + sensitivity @ step
            model = _with_parameters(model, theta, with_masses)
            history.append(theta)
            break
        now, shortened = objective(z, theta), 0
        while True:
            model = _with_parameters(model, theta + step, with_masses)
            z, sensitivity = _predict_matched(_sensitive_modes(model, with_masses), sensors, observation)
            better = objective(z, theta + step) <= now
            if better or not overdetermined or shortened == 6:
                break
            step, shortened = 0.5 * step, shortened + 1  # the linearized step overshot: the model has a wrong form
        theta = theta + step
        history.append(theta)
    gain = _gain(sensitivity, observation.weight, w_theta, penalty)
    identifiable, unseen = _identifiability(sensitivity, observation.weight, initial, relative)
    left = (np.eye(theta.size) - gain @ sensitivity) * (relative * initial)
    return Update(
        model=model,
        parameters=theta,
        gain=gain,
        sensitivity=sensitivity,
        residual=observation.z - z,
        converged=converged,
        iterations=len(history) - 1,
        history=np.array(history),
        identifiable=identifiable,
        unseen=unseen,
        prior_left=left @ left.T,
    )


def _information(sensitivity: Array, weight: Array, initial: Array, relative: Array) -> Annotated[Array, "p p"]:
    """Compute the data's information matrix for parameters in units of their prior standard deviations.

    In these units the prior's information is the identity.
    """
    scaled = sensitivity * (relative * initial)
    return np.asarray(scaled.T @ weight @ scaled)


def _identifiability(sensitivity: Array, weight: Array, initial: Array, relative: Array) -> tuple[Array, Array]:
    """Compute `Update.identifiable` and `Update.unseen` from the data's information.

    The data's information has eigenvalues g along its eigenvectors; the posterior variance is 1 / (1 + g) of the prior's.
    """
    g, directions = np.linalg.eigh(_information(sensitivity, weight, initial, relative))
    share = 1.0 / (1.0 + np.maximum(g, 0.0))
    unseen = (directions[:, np.sqrt(share) > UNSEEN] * relative[:, None]).T
    return 1.0 - directions**2 @ share, unseen / np.linalg.norm(unseen, axis=1, keepdims=True)


def _gain(sensitivity: Array, weight: Array, w_theta: Array, penalty: Penalty) -> Annotated[Array, "p d"]:
    """Compute the gain that turns z_m - z into a step of theta (eqs 21, 23, 27, 30, 33)."""
    if penalty in ("least_squares", "minimum_norm"):
        return np.asarray(np.linalg.pinv(sensitivity))  # eq. 23; with too few data, the shortest step (eq. 21)
    weighted = sensitivity.T @ weight
    normal = weighted @ sensitivity
    if penalty in ("step", "initial"):
        normal = normal + np.diag(w_theta)
    return _solve_scaled(normal, weighted)


def _prior_pull(sensitivity: Array, weight: Array, w_theta: Array) -> Annotated[Array, "p p"]:
    """Compute the matrix of the prior's term in the step of eq. 33."""
    return _solve_scaled(sensitivity.T @ weight @ sensitivity + np.diag(w_theta), np.diag(w_theta))


def _solve_scaled(normal: Array, right: Array) -> Array:
    """Solve the normal equations after scaling their diagonal to one (stiffness and mass differ by 1e4).

    The solution is by Cholesky if no pivot is too small, else the least-squares solution of minimum norm.
    """
    diagonal = normal.diagonal()
    scale = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))  # zero: a parameter that no datum shows
    scaled, wanted = normal * scale[:, None] * scale, scale[:, None] * right
    factor, solution, failed = lapack.dposv(scaled, wanted)
    if failed or factor.diagonal().min() ** 2 < _ROUNDED_TO_0:
        solution = np.linalg.lstsq(scaled, wanted, rcond=1e-13)[0]
    return np.asarray(scale[:, None] * solution)


def _matrix_derivatives(model: Model, with_masses: bool) -> tuple[Array, Array | None]:
    """Return the derivatives of stiffness and mass matrix by the parameters."""
    d_k = model.stiffness_derivatives()
    if not with_masses:
        return d_k, None
    d_m = model.structure.mass_derivatives()
    return np.concatenate([d_k, np.zeros_like(d_m)]), np.concatenate([np.zeros_like(d_k), d_m])


def _with_parameters(model: Model, theta: Array, with_masses: bool) -> Model:
    """Return the model with the parameters theta: stiffnesses, then masses if `with_masses`."""
    p = model.structure.n_stories
    updated = model.with_stiffness(theta[:p])
    return updated.with_masses(theta[p:]) if with_masses else updated
