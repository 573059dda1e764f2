"""The one score for all causes: debiased Whittle likelihood of a recording's cross-spectra under a model.

Nuisances (stiffness and mass within what is known of them, damping, excitation, noise) compete with every effect.  What is
known of the structure, from its drawing or from its baseline, is a normal prior on the structural nuisances.

References
----------
P. Whittle, Arkiv foer Matematik 2 (1953) 423-434; A. M. Sykulski et al., The debiased Whittle likelihood, Biometrika 106
(2019) 251-266.  Statistical linearization: J. B. Roberts, P. D. Spanos, Random Vibration and Statistical Linearization (1990).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.linalg import block_diag

from monitor import driven
from monitor.effects import Condition, Context, Effect
from monitor.evidence import Evidence
from monitor.model import Model
from monitor.prediction import Excitation, assemble, cross_spectra
from monitor.reference import Reference
from monitor.results import Array, ComplexArray
from monitor.wishart import log_wishart, whiten

_FORCE_STD, _LEVEL_STD, _NOISE_STD = 1.0, 5.0, 3.0
"""Prior of the logarithm of the floors' forces about their mean, of the classes' levels, of the common noise."""


@dataclass(frozen=True, eq=False, slots=True)
class Fit:
    """A model fitted to evidence."""

    x: Array
    """Structural nuisances, excitation, then the extra effects' coordinates."""
    effects: tuple[Effect, ...]
    """The extra effects."""
    log_likelihood: float
    """Tempered for correlated bins and segments, nats; without the prior."""
    log_prior: float
    covariance: Array
    """Of x."""
    converged: bool
    jacobian: Array
    """Whitened slopes, each row weighed by the root of its information, shape (rows, p): classes * bins * c * c rows of
    the spectra, then those of the segments' means where the ground was measured."""
    residual: Array
    """Whitened and weighed residual of the spectra's rows."""
    mean_residual: Array
    """That of the means' rows."""

    @property
    def log_posterior(self) -> float:
        """Of the fit, up to a constant."""
        return self.log_likelihood + self.log_prior

    @property
    def n_effect(self) -> int:
        """Coordinates of the extra effects."""
        return sum(len(e.parameters) for e in self.effects)


@dataclass(frozen=True, eq=False, slots=True)
class Prediction:
    """What parameters say of the segments, beside what was measured.

    Without a measured ground all is chance.  With one, the segments' means are its response, `spectra` are those of what
    is left, and so are `data`, which therefore depend on the parameters.
    """

    spectra: ComplexArray
    """Shape (classes, bins, c, c)."""
    data: ComplexArray
    left: ComplexArray | None = None
    """Segments less their means, shape (n_segments, n_bins, c)."""


@dataclass(frozen=True, eq=False, slots=True)
class Problem:
    """Evidence, what is known before it, and where effects act."""

    evidence: Evidence
    reference: Reference
    context: Context
    conditions: tuple[Condition, ...]
    """One a class."""
    offset: ComplexArray | None = None
    """What simulation adds to the spectra of a linearized law, shape (classes, n_bins, c, c)."""
    pins: Mapping[tuple[str, str], tuple[Array, Array]] = field(default_factory=dict)
    """Mean and precision of the coordinates of effects, by name and place, whose offset was simulated at that mean."""
    exact_slopes: bool = False
    """Whether slopes of a response to a measured ground are the exact laws' by the nuisances too; else the linearized ones'."""
    smoothing: Array | None = None
    """Averages bins into coarse ones, shape (n_coarse, n_bins), for a start from far away."""

    @property
    def n_classes(self) -> int:
        """Classes of level and temperature."""
        return int(self.evidence.counts.size)

    @property
    def n_nuisance(self) -> int:
        """Length of the vector before the extra effects' coordinates."""
        return int(self.reference.mean.size) + self.context.structure.n_dofs + self.n_classes + 1

    def widths(self) -> Array:
        """Bins in each (coarse) bin."""
        n = self.evidence.band.n_bins
        return np.ones(n) if self.smoothing is None else 1.0 / (self.smoothing**2).sum(axis=1)

    def data(self) -> ComplexArray:
        """Measured cross-spectra, (classes, bins, c, c)."""
        return self.smooth(self.evidence.spectra)

    def smooth(self, spectra: ComplexArray) -> ComplexArray:
        """Average bins, the third axis from the end."""
        if self.smoothing is None:
            return spectra
        return np.asarray(np.moveaxis(np.tensordot(self.smoothing, spectra, axes=(1, -3)), 0, -3))

    # --- prediction -----------------------------------------------------------------------------------------

    def predict(self, x: Array, effects: Sequence[Effect]) -> Prediction:
        """The segments' (smoothed) spectra about their means."""
        spectra, mean = self.smooth(self.scatter(x, effects)), self.mean(x, effects)
        if mean is None:
            return Prediction(spectra, self.data())
        left = self.evidence.segments.values - mean
        return Prediction(spectra, self.smooth(driven.products(left, self.evidence.members)), left)

    def mean(self, x: Array, effects: Sequence[Effect], *, exact: bool = True) -> ComplexArray | None:
        """The response of the segments to a measured ground, shape (n_segments, n_bins, c); None without one.

        That of the exact laws; or of the linearized ones, which is quicker and good enough for slopes.
        """
        e = self.evidence
        if e.drive is None:
            return None
        effects = (*self.reference.effects(x), *effects)
        matrices, context = self.matrices(x, effects), self.context_at(x)
        bent = [effect for effect in effects if effect.nonlinear and effect.family == "structure"]
        if bent and exact:
            system = assemble(*matrices, [f for f in effects if f not in bent], context, self.conditions[0])
            return driven.exact_response(e.drive, system, effects, e.band, context, self.conditions[0])
        out = np.zeros_like(e.segments.values)
        if not any(effect.conditional for effect in effects):
            system = assemble(*matrices, effects, context, self.conditions[0])
            out[:] = driven.response(e.drive, system, effects, e.band, context, self.conditions[0])
        else:
            for members, condition in zip(e.members, self.conditions, strict=True):
                system = assemble(*matrices, effects, context, condition)
                out[members] = driven.response(e.drive.part(members), system, effects, e.band, context, condition)
        return out

    def spectra(self, x: Array, effects: Sequence[Effect]) -> ComplexArray:
        """Predicted cross-spectra of the classes, shape (classes, n_bins, c, c)."""
        mean = self.mean(x, effects)
        scatter = self.scatter(x, effects)
        return scatter if mean is None else scatter + driven.products(mean, self.evidence.members)

    def scatter(self, x: Array, effects: Sequence[Effect], *, classes: Sequence[int] | None = None) -> ComplexArray:
        """Predicted cross-spectra of the segments about their means, shape (classes, n_bins, c, c).

        Where the ground was measured, a class's level scales the forces and the model's own error, a share of the measured
        power that is independent between channels; the ground's sensor is as noisy as the others.
        """
        effects = (*self.reference.effects(x), *effects)
        mass, stiffness, damping = self.matrices(x, effects)
        context = self.context_at(x)
        p = self.reference.mean.size
        n = mass.shape[0]
        force, level, noise = np.exp(x[p : p + n]), np.exp(x[p + n : p + n + self.n_classes]), self.noise(x)
        wanted = range(self.n_classes) if classes is None else classes
        ground = self.evidence.power
        varied = ground is not None or any(e.conditional or e.lines() for e in effects)
        out = []
        shared: ComplexArray | None = None
        for k in wanted:
            if varied or shared is None:
                system = assemble(mass, stiffness, damping, effects, context, self.conditions[k])
                e = Excitation(
                    force * (level[k] if varied else 1.0),
                    noise * (1.0 if varied else 0.0),
                    0.0 if ground is None else float(noise.mean()),
                )
                shared = cross_spectra(system, effects, e, self.evidence.band, context, self.conditions[k])
            if varied:
                out.append(shared if ground is None else shared + level[k] * _diagonal(ground))
            else:
                out.append(self._scaled(shared, level[k], noise, effects))
        stacked = np.stack(out)
        return stacked if self.offset is None else stacked + self.offset[list(wanted)]

    def _scaled(self, unit: ComplexArray, level: float, noise: Array, effects: Sequence[Effect]) -> ComplexArray:
        """Another class's spectra where only the level differs: everything but the noise scales."""
        extra = sum((e.noise_variance(self.context, self.conditions[0]) for e in effects), np.zeros(noise.size))
        extra = np.asarray(extra) / self.context.rate_hz
        diagonal = np.arange(noise.size)
        gain = self.evidence.band.gain[:, None]
        out = unit.copy()
        out[:, diagonal, diagonal] -= extra * gain
        out *= level
        out[:, diagonal, diagonal] += (noise + extra) * gain
        return out

    def matrices(self, x: Array, effects: Sequence[Effect]) -> tuple[Array, Array, Array]:
        """Mass, stiffness and modal damping ratios at a vector of nuisances."""
        return (*self.model(x, effects).structural_matrices(), np.exp(self.reference.parts(x)[2]))

    def context_at(self, x: Array) -> Context:
        """Where effects act, with the structure at a vector of nuisances: relative sizes refer to it."""
        return replace(self.context, structure=self.model(x, ()).structure)

    def model(self, x: Array, effects: Sequence[Effect]) -> Model:
        """The model at a vector of nuisances; `effects` are all of its effects."""
        ln_k, ln_m, ln_damping, _, correction, _ = self.reference.parts(x)
        base = self.reference.model
        # The scale of all masses and stiffnesses cannot be seen; the correction shares it.
        scale = np.exp((ln_m - self.reference.parts(self.reference.mean)[1]).mean())
        change = scale * np.tensordot(correction, self.reference.basis, axes=1) if correction.size else None
        if base.correction is not None:
            change = base.correction if change is None else base.correction + change
        model = base.with_stiffness(np.exp(ln_k)).with_masses(np.exp(ln_m))
        return replace(model, effects=tuple(effects), correction=change, modal_damping=np.exp(ln_damping))

    def noise(self, x: Array) -> Array:
        """Noise density of every channel."""
        return np.asarray(np.exp(x[self.n_nuisance - 1] + self.reference.parts(x)[3]))

    # --- score ----------------------------------------------------------------------------------------------

    def prior(self, x: Array, effects: Sequence[Effect]) -> tuple[Array, Array]:
        """Mean and precision of the nuisances, given the forces' mean level, and of the effects' coordinates."""
        middle = self.conditions[self.n_classes // 2]
        told = [e.known(self.context, middle) for e in effects]
        known = [
            self.pins.get((e.name, e.location), (mean, np.diag(precision)))
            for e, (mean, precision) in zip(effects, told, strict=True)
        ]
        n = self.context.structure.n_dofs
        centred = np.eye(n) - 1.0 / n
        precision = block_diag(
            self.reference.precision,
            centred / _FORCE_STD**2 + np.full((n, n), 1.0 / n) / _LEVEL_STD**2,
            np.eye(self.n_classes) / _LEVEL_STD**2,
            np.eye(1) / _NOISE_STD**2,
            *[precision for _, precision in known],
        )
        p = self.reference.mean.size
        mean = np.concatenate(
            [
                self.reference.mean,
                np.full(n, x[p : p + n].mean()),
                np.zeros(self.n_classes),
                [x[self.n_nuisance - 1]],
                *[m for m, _ in known],
            ]
        )
        return mean, precision

    def log_likelihood(self, spectra: ComplexArray, data: ComplexArray | None = None) -> float:
        """Tempered Whittle log likelihood, nats; -inf where a spectrum is not positive definite."""
        data = self.data() if data is None else data
        each = log_wishart(spectra, data)
        total = (each * self.widths()).sum(axis=1) @ self.evidence.counts * self.evidence.weight
        return float(total) if np.isfinite(total) else -np.inf

    def level_of(self, spectra: ComplexArray, data: ComplexArray) -> Array:
        """Factor by which each class's spectra fit the data best, shape (classes,)."""
        white = np.linalg.solve(spectra, data)
        return np.asarray(np.einsum("kfaa->k", white).real / (white.shape[1] * white.shape[2]))

    def score(self, x: Array, effects: tuple[Effect, ...]) -> tuple[float, float]:
        """Log likelihood and log prior at a point."""
        here = self.predict(x, effects)
        ll = self.log_likelihood(here.spectra, here.data)
        mean, precision = self.prior(x, effects)
        return ll, -0.5 * float((x - mean) @ precision @ (x - mean))

    def slopes(self, x: Array, effects: tuple[Effect, ...], spectra: ComplexArray) -> ComplexArray:
        """Derivatives of the (smoothed) spectra, shape (p, classes, bins, c, c), by finite differences.

        Those of the nuisances are taken at the middle class and scaled by level: they only weigh the residual.
        """
        middle = self.n_classes // 2
        p, n = self.reference.mean.size, self.context.structure.n_dofs
        level = np.exp(x[p + n : p + n + self.n_classes])
        scale = (
            (level / level[middle])[:, None, None, None]
            if self.evidence.power is None
            else np.ones((self.n_classes, 1, 1, 1))
        )
        c = len(self.context.channels)
        diagonal = np.arange(c)
        noise = self.noise(x)
        noise_slope = np.zeros((c, *spectra.shape[1:]), dtype=complex)
        noise_slope[diagonal, :, diagonal, diagonal] = noise[:, None]
        out = np.empty((x.size, *spectra.shape), dtype=complex)
        alone = self.evidence.power is None  # else the ground's noise moves the floors too
        first_noise = sum(self.reference.sizes[:3])
        for i in range(x.size):
            if alone and first_noise <= i < first_noise + c:
                out[i] = noise_slope[i - first_noise]
            elif not alone and p <= i < p + n:
                out[i] = (
                    0.0  # forces beside a measured ground stay small: they would excuse a wrong response at its peaks
                )
            elif p + n <= i < p + n + self.n_classes:
                k = i - p - n
                out[i] = 0.0
                out[i, k] = out[p : p + n, k].sum(axis=0)  # all forces at once, but neither lines nor noise
                if self.evidence.power is not None:
                    out[i, k] += self.smooth(level[k] * _diagonal(self.evidence.power))
            elif alone and i == self.n_nuisance - 1:
                out[i] = noise_slope.sum(axis=0)
            else:
                h = _step(x, i, self.n_nuisance, effects)
                moved = x.copy()
                moved[i] += h
                if i < self.n_nuisance:
                    change = self.smooth(self.scatter(moved, effects, classes=[middle]))[0] - spectra[middle]
                    out[i] = change / h * scale
                else:
                    out[i] = (self.smooth(self.scatter(moved, placed(effects, moved[self.n_nuisance :]))) - spectra) / h
        return out

    def mean_slopes(self, x: Array, effects: tuple[Effect, ...], wanted: Iterable[int]) -> ComplexArray:
        """Derivatives of the segments' means by the wanted coordinates, shape (n_wanted, n_segments, n_bins, c)."""
        mean, linear = self.mean(x, effects), self.mean(x, effects, exact=False)
        assert mean is not None
        assert linear is not None
        k, m, d, noise, _ = self.reference.sizes
        p = self.reference.mean.size
        still = {*range(k + m + d, k + m + d + noise), *range(p, self.n_nuisance)}  # noise and forces move no mean
        out = []
        for i in wanted:
            moved = x.copy()
            h = _step(x, i, self.n_nuisance, effects)
            moved[i] += h
            own = i >= self.n_nuisance or self.exact_slopes
            there = None if i in still else self.mean(moved, placed(effects, moved[self.n_nuisance :]), exact=own)
            out.append(np.zeros_like(mean) if there is None else (there - (mean if own else linear)) / h)
        return np.array(out, dtype=complex).reshape(-1, *mean.shape)

    def mean_rows(self, here: Prediction, slopes: ComplexArray) -> tuple[Array, Array]:
        """As `whitened`, for the segments' means; no rows without a measured ground."""
        if here.left is None:
            return np.zeros((0, len(slopes))), np.zeros(0)
        e = self.evidence
        weight = e.weight * e.counts / [m.size for m in e.members]
        rows = driven.mean_rows(here.spectra, np.concatenate([slopes, here.left[None]]), e.members, weight)
        return rows[:, :-1], rows[:, -1]

    def jacobian(
        self, x: Array, effects: tuple[Effect, ...], here: Prediction, first: int = 0
    ) -> tuple[Array, Array, Array]:
        """Whitened slopes by the coordinates from `first` on, and the residuals of the spectra's and of the means' rows."""
        slopes = _effect_slopes(self, x, effects, here.spectra) if first else self.slopes(x, effects, here.spectra)
        rows, residual = self.whitened(here.spectra, slopes, here.data)
        moving = () if here.left is None else range(first, x.size)
        mean_slopes = (
            self.mean_slopes(x, effects, moving) if moving else np.zeros((len(slopes), 0, 0, 0), dtype=complex)
        )
        mean_rows, mean_residual = self.mean_rows(here, mean_slopes)
        return np.concatenate([rows, mean_rows]), residual, mean_residual

    def whitened(
        self, spectra: ComplexArray, slopes: ComplexArray, data: ComplexArray | None = None
    ) -> tuple[Array, Array]:
        """Slopes and residual as real rows of unit information, shapes (rows, p) and (rows,)."""
        data = self.data() if data is None else data
        root = np.sqrt(self.evidence.weight * self.evidence.counts[:, None] * self.widths())
        stacked = np.concatenate([slopes, (data - spectra)[None]])
        rows = whiten(spectra, stacked, root)
        return rows[:, :-1], rows[:, -1]


def _step(x: Array, i: int, n_nuisance: int, effects: Sequence[Effect]) -> float:
    """Finite difference for coordinate i."""
    if i < n_nuisance:
        return 1e-5
    least = [p.least for e in effects for p in e.parameters]
    return float(1e-4 * max(abs(x[i]), least[i - n_nuisance]))


def _diagonal(power: Array) -> Array:
    """Diagonal matrices, shape (n_bins, c, c)."""
    return power[:, :, None] * np.eye(power.shape[1])


def placed(effects: Sequence[Effect], coordinates: Array) -> tuple[Effect, ...]:
    """Effects at a joint vector of coordinates."""
    out = []
    for e in effects:
        out.append(e.at(coordinates[: len(e.parameters)]))
        coordinates = coordinates[len(e.parameters) :]
    return tuple(out)


def fit(
    problem: Problem,
    x: Array,
    effects: tuple[Effect, ...] = (),
    *,
    iterations: int = 12,
    tolerance: float = 0.02,
    frozen: Array | None = None,
) -> Fit:
    """Most probable parameters near `x` by Fisher scoring with Levenberg-Marquardt steps.

    Parameters
    ----------
    x : ndarray
        Nuisances; the effects' coordinates are taken from `effects`.
    tolerance : float
        Converged when a step promises less gain than this, nats.
    frozen : ndarray, optional
        Whitened slopes of the nuisances, shape (rows, n_nuisance), taken as they are: quicker, for a ranking.
    """
    x = np.concatenate([x[: problem.n_nuisance], *[e.coordinates for e in effects]])
    here = problem.predict(x, effects)
    ll, lp = problem.log_likelihood(here.spectra, here.data), problem.score(x, effects)[1]
    damping, converged = 1e-3, False
    rows, residual, mean_residual, normal = np.zeros((0, x.size)), np.zeros(0), np.zeros(0), np.eye(x.size)
    for _ in range(iterations if np.isfinite(ll) else 0):  # a law that runs away at its start leads nowhere
        rows, residual, mean_residual = problem.jacobian(
            x, effects, here, first=0 if frozen is None else problem.n_nuisance
        )
        if frozen is not None:
            rows = np.concatenate([frozen, rows], axis=1)
        mean, precision = problem.prior(x, effects)
        normal = rows.T @ rows + precision
        gradient = rows.T @ np.concatenate([residual, mean_residual]) - precision @ (x - mean)
        scale = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
        accepted = False
        for _ in range(6):
            step = scale * np.linalg.solve(
                normal * scale[:, None] * scale + (damping + 1e-12) * np.eye(x.size), scale * gradient
            )
            moved = _limited(problem, x, step, effects)
            there = placed(effects, moved[problem.n_nuisance :])
            moved = np.concatenate([moved[: problem.n_nuisance], *[e.coordinates for e in there]])
            candidate = problem.predict(moved, there)
            new_ll = problem.log_likelihood(candidate.spectra, candidate.data)
            m, q = problem.prior(moved, there)
            new_lp = -0.5 * float((moved - m) @ q @ (moved - m))
            if new_ll + new_lp > ll + lp - 1e-9:
                accepted = True
                break
            damping = max(10.0 * damping, 1e-2)
        if not accepted:
            converged = float(gradient @ step) < 10.0 * tolerance
            break
        gain = new_ll + new_lp - ll - lp
        x, effects, here, ll, lp = moved, there, candidate, new_ll, new_lp
        damping *= 0.1
        if gain < tolerance:
            converged = True
            break
    covariance = inverse(normal)
    return Fit(x, effects, ll, lp, covariance, converged, rows, residual, mean_residual)


def _effect_slopes(problem: Problem, x: Array, effects: tuple[Effect, ...], spectra: ComplexArray) -> ComplexArray:
    out = []
    for i in range(problem.n_nuisance, x.size):
        h = _step(x, i, problem.n_nuisance, effects)
        moved = x.copy()
        moved[i] += h
        out.append((problem.smooth(problem.scatter(moved, placed(effects, moved[problem.n_nuisance :]))) - spectra) / h)
    return np.array(out).reshape(-1, *spectra.shape)


def _limited(problem: Problem, x: Array, step: Array, effects: Sequence[Effect]) -> Array:
    """A step bounded so that a bad start cannot run away."""
    bound = np.full(x.size, np.inf)
    k, m, d, c, _ = problem.reference.sizes
    p = problem.reference.mean.size
    bound[: k + m] = 0.1
    bound[k + m : k + m + d + c] = 1.0
    bound[k + m + d + c : p] = 0.1
    bound[p : problem.n_nuisance] = 2.0
    logarithms = [p.scale == "log" for e in effects for p in e.parameters]
    bound[problem.n_nuisance :] = np.where(logarithms, 0.5, np.inf)
    return np.asarray(x + np.clip(step, -bound, bound))


def inverse(normal: Array) -> Array:
    """Inverse of a normal matrix whose parameters have different units; directions without information get none."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    return np.asarray(scale[:, None] * np.linalg.pinv(normal * scale[:, None] * scale, hermitian=True) * scale)
