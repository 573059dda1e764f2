"""The one score for all causes: debiased Whittle likelihood of a recording's cross-spectra under a model.

Nuisances (stiffness and mass within what is known of them, damping, excitation, noise) compete with every effect.  What is
known of the structure, from its drawing or from its baseline, is a normal prior on the structural nuisances.

References
----------
P. Whittle, Arkiv foer Matematik 2 (1953) 423-434; A. M. Sykulski et al., The debiased Whittle likelihood, Biometrika 106
(2019) 251-266.  Statistical linearization: J. B. Roberts, P. D. Spanos, Random Vibration and Statistical Linearization (1990).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.linalg import block_diag

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
    """Whitened slopes, shape (classes * bins * c * c, p), each row weighed by the root of its information."""
    residual: Array
    """Whitened and weighed residual of the same rows."""

    @property
    def log_posterior(self) -> float:
        """Of the fit, up to a constant."""
        return self.log_likelihood + self.log_prior

    @property
    def n_effect(self) -> int:
        """Coordinates of the extra effects."""
        return sum(len(e.parameters) for e in self.effects)


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

    def spectra(self, x: Array, effects: Sequence[Effect], *, classes: Sequence[int] | None = None) -> ComplexArray:
        """Predicted cross-spectra of the classes, shape (classes, n_bins, c, c)."""
        effects = (*self.reference.effects(x), *effects)
        mass, stiffness, damping = self.matrices(x, effects)
        context = self.context_at(x)
        p = self.reference.mean.size
        n = mass.shape[0]
        force, level, noise = np.exp(x[p : p + n]), np.exp(x[p + n : p + n + self.n_classes]), self.noise(x)
        wanted = range(self.n_classes) if classes is None else classes
        ground = self.evidence.ground
        varied = ground is not None or any(e.conditional or e.lines() for e in effects)
        out = []
        shared: ComplexArray | None = None
        for k in wanted:
            if varied or shared is None:
                system = assemble(mass, stiffness, damping, effects, context, self.conditions[k])
                drive = None if ground is None else ground[k]
                e = Excitation(force * (level[k] if varied else 1.0), noise * (1.0 if varied else 0.0), drive)
                shared = cross_spectra(system, effects, e, self.evidence.band, context, self.conditions[k])
            if varied:
                out.append(shared)
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
        ll = self.log_likelihood(self.smooth(self.spectra(x, effects)))
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
            if self.evidence.ground is None
            else np.ones((self.n_classes, 1, 1, 1))
        )
        c = len(self.context.channels)
        diagonal = np.arange(c)
        noise = self.noise(x)
        noise_slope = np.zeros((c, *spectra.shape[1:]), dtype=complex)
        noise_slope[diagonal, :, diagonal, diagonal] = noise[:, None]
        out = np.empty((x.size, *spectra.shape), dtype=complex)
        first_noise = sum(self.reference.sizes[:3])
        for i in range(x.size):
            if first_noise <= i < first_noise + c:
                out[i] = noise_slope[i - first_noise]
            elif p + n <= i < p + n + self.n_classes:
                k = i - p - n
                out[i] = 0.0
                out[i, k] = out[p : p + n, k].sum(axis=0)  # all forces at once, but neither lines nor noise
            elif i == self.n_nuisance - 1:
                out[i] = noise_slope.sum(axis=0)
            else:
                h = 1e-5 if i < self.n_nuisance else 1e-4 * max(abs(x[i]), 1e-9)
                moved = x.copy()
                moved[i] += h
                if i < self.n_nuisance:
                    change = self.smooth(self.spectra(moved, effects, classes=[middle]))[0] - spectra[middle]
                    out[i] = change / h * scale
                else:
                    out[i] = (self.smooth(self.spectra(moved, placed(effects, moved[self.n_nuisance :]))) - spectra) / h
        return out

    def whitened(
        self, spectra: ComplexArray, slopes: ComplexArray, data: ComplexArray | None = None
    ) -> tuple[Array, Array]:
        """Slopes and residual as real rows of unit information, shapes (rows, p) and (rows,)."""
        data = self.data() if data is None else data
        root = np.sqrt(self.evidence.weight * self.evidence.counts[:, None] * self.widths())
        stacked = np.concatenate([slopes, (data - spectra)[None]])
        rows = whiten(spectra, stacked, root)
        return rows[:, :-1], rows[:, -1]


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
    data = problem.data()
    spectra = problem.smooth(problem.spectra(x, effects))
    ll, lp = problem.log_likelihood(spectra, data), problem.score(x, effects)[1]
    damping, converged = 1e-3, False
    rows, residual, normal = np.zeros((0, x.size)), np.zeros(0), np.eye(x.size)
    for _ in range(iterations):
        slopes = (
            _effect_slopes(problem, x, effects, spectra) if frozen is not None else problem.slopes(x, effects, spectra)
        )
        rows, residual = problem.whitened(spectra, slopes, data)
        if frozen is not None:
            rows = np.concatenate([frozen, rows], axis=1)
        mean, precision = problem.prior(x, effects)
        normal = rows.T @ rows + precision
        gradient = rows.T @ residual - precision @ (x - mean)
        scale = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
        accepted = False
        for _ in range(6):
            step = scale * np.linalg.solve(
                normal * scale[:, None] * scale + (damping + 1e-12) * np.eye(x.size), scale * gradient
            )
            moved = _limited(problem, x, step, effects)
            there = placed(effects, moved[problem.n_nuisance :])
            moved = np.concatenate([moved[: problem.n_nuisance], *[e.coordinates for e in there]])
            candidate = problem.smooth(problem.spectra(moved, there))
            new_ll = problem.log_likelihood(candidate, data)
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
        x, effects, spectra, ll, lp = moved, there, candidate, new_ll, new_lp
        damping *= 0.1
        if gain < tolerance:
            converged = True
            break
    covariance = inverse(normal)
    return Fit(x, effects, ll, lp, covariance, converged, rows, residual)


def _effect_slopes(problem: Problem, x: Array, effects: tuple[Effect, ...], spectra: ComplexArray) -> ComplexArray:
    out = []
    for i in range(problem.n_nuisance, x.size):
        h = 1e-4 * max(abs(x[i]), 1e-9)
        moved = x.copy()
        moved[i] += h
        out.append((problem.smooth(problem.spectra(moved, placed(effects, moved[problem.n_nuisance :]))) - spectra) / h)
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
