"""How well a model predicts a recording, and what its extension gains on data that it was not fitted to.

A model's score is the tempered debiased Whittle log likelihood of the recording's segments.  Nothing of the structure is
refitted: one level of equal white forces on all floors for each class of segments, and one noise level common to all
channels, are.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import ndtri, stdtrit

from monitor.condition import Conditioner
from monitor.config import Configuration
from monitor.diagnose import Diagnosis
from monitor.effects import Condition, Context, Effect
from monitor.evidence import Evidence, Segments, classify
from monitor.likelihood import Fit, Problem, fit
from monitor.model import Model
from monitor.reference import Reference, nominal
from monitor.results import Array, ComplexArray
from monitor.motion import conditions
from monitor.search import prepare
from monitor.window import common_step_s

_MAX_BLOCKS = 20
_BLOCK_SEGMENTS = 3.0
"""Least length of a held-out block, as lengths of a segment: long enough that levels of excitation differ between blocks."""
_FOLDS = 4
_ORDINAL = {2: "second", 4: "fourth"}
_BOOTSTRAPS = 4000
_DRIVEN = 25
"""Iterations of a fit to a part of driven motion, from the whole recording's."""
_LEVEL_STD = 5.0
_WORST = 1e30
"""Stands for no likelihood at all."""
_FORCED = 1e-3
"""With the ground measured: power that forces cause, as a share of what is seen, where the model is all wrong."""


@dataclass(frozen=True, eq=False, slots=True)
class Score:
    """How well one model predicts one recording."""

    nats: Array
    """Tempered log likelihood of every segment, shape (n_segments,)."""
    samples: int
    """Sample instants, at the rate of the processing."""
    measured: ComplexArray
    """Mean cross-spectra of the segments, shape (n_bins, c, c)."""
    modelled: ComplexArray
    """The model's."""

    @property
    def csd_error(self) -> float:
        """Squared Frobenius norm of measured less modelled over that of the measured, each summed over the band."""
        return _csd_error(self.measured, self.modelled)

    @property
    def log_score_per_sample(self) -> float:
        """Nats per sample instant, all channels together."""
        return float(self.nats.sum()) / self.samples


@dataclass(frozen=True, slots=True)
class Gain:
    """Scores of the old model form and of the extended one on data that neither was fitted to."""

    before: float = 0.0
    """Nats per sample instant."""
    after: float = 0.0
    ci95: tuple[float, float] = (0.0, 0.0)
    """Of their difference, by block bootstrap."""
    csd_error_before: float = 0.0
    csd_error_after: float = 0.0
    heldout: str = "none: nothing was added to the model"
    """Which data judged."""

    @property
    def value(self) -> float:
        """Nats per sample instant."""
        return self.after - self.before


def score(
    segments: Segments,
    model: Model,
    context: Context,
    config: Configuration,
    reference_degc: float | None = None,
    held: NDArray[np.bool_] | None = None,
) -> Score:
    """Score a model on a recording.

    Band, segments, classes and samples depend on the recording and on ``[processing]`` alone, so that the scores of two
    models may be subtracted.

    Parameters
    ----------
    held : ndarray of bool, shape (n_segments,), optional
        The segments that count; levels and noise are those of the whole recording all the same.
    """
    evidence = classify(segments)
    held = np.ones(segments.t_s.size, dtype=bool) if held is None else held
    problem, x = _excited(evidence, model, replace(context, structure=model.structure), reference_degc)
    predicted, mean = problem.scatter(x, ()), problem.mean(x, ())
    left = segments.values if mean is None else segments.values - mean
    seen = segments.values[held]
    measured = np.einsum("ska,skb->kab", seen, seen.conj()) / len(seen)
    share = np.array([np.count_nonzero(held[m]) for m in evidence.members]) / len(seen)
    modelled = np.tensordot(share, predicted, axes=1)
    if mean is not None:
        modelled = modelled + np.einsum("ska,skb->kab", mean[held], mean[held].conj()) / len(seen)
    nats = _segment_nats(left, evidence, predicted)[held]
    return Score(nats, _sample_instants(segments, held, config), measured, modelled)


def _csd_error(measured: ComplexArray, modelled: ComplexArray) -> float:
    return float((np.abs(measured - modelled) ** 2).sum() / (np.abs(measured) ** 2).sum())


def _sample_instants(segments: Segments, held: NDArray[np.bool_], config: Configuration) -> int:
    """Sample instants, at the rate of the processing, that segments stand for: half of each, as they overlap by half."""
    p = config.processing
    rate_hz = Conditioner.design(segments.rate_hz, p.rate_hz, p.cutoff_hz, common_step_s(p.window_s, p.hop_s)).rate_hz
    return round(0.5 * np.count_nonzero(held) * rate_hz / segments.band.bin_hz)


def _segment_nats(x: ComplexArray, evidence: Evidence, predicted: ComplexArray) -> Array:
    """Log likelihood of every segment under its class's spectra; their sum is that of the classes' means."""
    out = np.empty(x.shape[0])
    for spectra, members in zip(predicted, evidence.members, strict=True):
        _, log_det = np.linalg.slogdet(spectra)
        form = np.einsum("ska,kab,skb->s", x[members].conj(), np.linalg.inv(spectra), x[members]).real
        out[members] = -evidence.weight * (log_det.sum() + form)
    return out


def _excited(evidence: Evidence, model: Model, context: Context, reference_degc: float | None) -> tuple[Problem, Array]:
    """The model's problem with levels and noise fitted, everything else as it is stated.

    Laws that depend on the level are made linear at the motion that the model itself shows, hence the repetition.
    """
    n, c = context.structure.n_dofs, len(context.channels)
    stories = context.structure.n_stories
    known = replace(nominal(model, np.ones(stories + n), c), reference_degc=reference_degc)
    first = known.mean.size - known.n_standing
    plain = replace(known, model=replace(model, effects=()), mean=known.mean[:first])
    unknown = Condition(np.ones(stories), np.ones(stories), np.ones(n), np.ones(c))
    problem = Problem(evidence, plain, context, (unknown,) * evidence.counts.size)
    x = _fit_levels(problem, _first_guess(problem))
    for _ in range(2 if model.effects else 0):
        excitation = x[problem.reference.mean.size :]
        problem = replace(problem, conditions=conditions(problem, x, ()), reference=known)
        x = _fit_levels(problem, np.concatenate([known.mean, excitation]))
    return problem, x


def _first_guess(problem: Problem) -> Array:
    """Levels from the medians over frequency of the channels' power, noise from its least."""
    e, c = problem.evidence, len(problem.context.channels)
    power = np.einsum("kfaa->kfa", e.spectra[:, :, :c, :c]).real
    noise = np.log(max(0.3 * float(np.quantile(power.mean(axis=(0, 2)), 0.02)), 1e-300))
    levels = np.zeros(problem.context.structure.n_dofs + problem.n_classes)
    x = np.concatenate([problem.reference.mean, levels, [noise - 10.0]])
    predicted = np.einsum("kfaa->kfa", problem.scatter(x, ())[:, :, :c, :c]).real
    level = np.log(np.median(power / predicted, axis=(1, 2)))
    x[-1] = noise
    if e.power is None:
        x[-problem.n_classes - 1 : -1] = level
    else:  # the level is the model's own error; what forces move beside the ground goes with it
        p = problem.reference.mean.size
        x[p:-1] = np.r_[np.full(problem.context.structure.n_dofs, level.mean()), np.zeros(problem.n_classes)]
        x[p : -problem.n_classes - 1] += np.log(_FORCED)
    return x


def _fit_driven(problem: Problem, x: Array) -> Array:
    """Most probable level of the forces, of the model's own error in every class, and noise, the rest of `x` kept.

    The forces stand for what the response lacks at its resonances, the error for what it lacks everywhere.
    """
    p, k = problem.reference.mean.size, problem.n_classes
    n = problem.context.structure.n_dofs
    moving = np.zeros((k + 2, x.size))
    moving[0, p : p + n] = 1.0
    moving[1:, p + n :] = np.eye(k + 1)
    data = problem.predict(x, ()).data  # levels move no mean

    def cost(by: Array) -> float:
        value = -problem.log_likelihood(problem.scatter(x + by @ moving, ()), data)
        return min(value + 0.5 * float(by @ by) / _LEVEL_STD**2, _WORST)

    return np.asarray(x + minimize(cost, np.zeros(k + 2), method="Powell", options={"xtol": 1e-3}).x @ moving)


def _fit_levels(problem: Problem, x: Array, iterations: int = 40) -> Array:
    """Most probable levels of the classes and noise, the rest of `x` kept: Fisher scoring with Levenberg-Marquardt steps."""
    if problem.evidence.drive is not None:
        return _fit_driven(problem, x)
    k, damping = problem.n_classes, 1e-3
    first = x[-k - 1 :].copy()
    data = problem.predict(x, ()).data  # levels move no mean

    def moved(by: Array) -> tuple[Array, ComplexArray, float]:
        at = x.copy()
        at[-k - 1 :] += by
        spectra = problem.scatter(at, ())
        prior = -0.5 * float(((at[-k - 1 :] - first) ** 2).sum()) / _LEVEL_STD**2
        return at, spectra, problem.log_likelihood(spectra, data) + prior

    x, spectra, value = moved(np.zeros(k + 1))
    for _ in range(iterations):
        h = 1e-5
        slopes = (
            np.stack([moved(np.r_[np.full(k, h), 0.0])[1] - spectra, moved(np.r_[np.zeros(k), h])[1] - spectra]) / h
        )
        rows, residual = problem.whitened(spectra, slopes, data)
        rows, residual = rows.reshape(k, -1, 2), residual.reshape(k, -1)
        normal = np.diag(np.r_[(rows[:, :, 0] ** 2).sum(axis=1), (rows[:, :, 1] ** 2).sum()])
        normal[:k, k] = normal[k, :k] = (rows[:, :, 0] * rows[:, :, 1]).sum(axis=1)
        normal += np.eye(k + 1) / _LEVEL_STD**2
        gradient = np.r_[(rows[:, :, 0] * residual).sum(axis=1), (rows[:, :, 1] * residual).sum()]
        gradient -= (x[-k - 1 :] - first) / _LEVEL_STD**2
        for _ in range(8):
            step = np.linalg.solve(normal + damping * np.diag(np.diag(normal)), gradient)
            there, its_spectra, its_value = moved(np.clip(step, -2.0, 2.0))
            if its_value >= value:
                break
            damping = max(10.0 * damping, 1e-2)
        else:
            break
        gained = its_value - value
        x, spectra, value, damping = there, its_spectra, its_value, 0.1 * damping
        if gained < 1e-3:
            break
    return x


def heldout_gain(segments: Segments, diagnosis: Diagnosis, config: Configuration) -> Gain:
    """Gain of a diagnosis's extended model over the old form, each judged on blocks that it was not fitted to.

    The recording is cut into contiguous blocks; both forms are judged by `score` on every fourth of them, fitted to the
    others, four times over (every second one where the recording is short).  A segment
    that straddles a border belongs to none.
    """
    effects = diagnosis.final.effects
    if not effects:
        return Gain()
    block, n_blocks, block_s = _blocks(segments)
    folds = min(_FOLDS, n_blocks)
    if any(np.count_nonzero((block >= 0) & (block % folds == fold)) < 2 for fold in range(folds)):
        return Gain(heldout="none: the recording is too short to hold any of it out")
    context, reference = diagnosis.problem.context, diagnosis.problem.reference
    nats, samples = np.zeros((2, n_blocks)), np.zeros(n_blocks)
    spectra = np.zeros((2, 2, *segments.values.shape[1:], segments.values.shape[2]), dtype=complex)
    for fold in range(folds):
        held = (block >= 0) & (block % folds == fold)
        others = classify(segments.part((block >= 0) & ~held))
        # Weighed as the whole recording, so that what was known before pulls these fits no more than the published one.
        others = replace(others, counts=others.counts * segments.t_s.size / others.counts.sum())
        for i, model in enumerate(_forms(others, reference, context, effects, diagnosis)):
            judged = score(segments, model, context, config, reference.reference_degc, held)
            nats[i] += np.bincount(block[held], judged.nats, n_blocks)
            spectra[i] += np.count_nonzero(held) * np.stack([judged.measured, judged.modelled])
        samples += np.bincount(block[held], minlength=n_blocks) * (judged.samples / np.count_nonzero(held))
    total = samples.sum()
    drawn = np.random.default_rng(0).integers(0, n_blocks, (_BOOTSTRAPS, n_blocks))
    gains = (nats[1] - nats[0])[drawn].sum(axis=1) / np.maximum(samples[drawn].sum(axis=1), 1.0)
    value = (nats[1] - nats[0]).sum() / total
    low, high = value + _widening(n_blocks) * (np.quantile(gains, [0.025, 0.975]) - value)
    return Gain(
        before=float(nats[0].sum() / total),
        after=float(nats[1].sum() / total),
        ci95=(float(low), float(high)),
        csd_error_before=_csd_error(*spectra[0]),
        csd_error_after=_csd_error(*spectra[1]),
        heldout=f"{n_blocks} contiguous blocks of {block_s:.0f} s, every {_ORDINAL[folds]} by a fit to the others",
    )


def _widening(n_blocks: int) -> float:
    """What a bootstrap of few blocks lacks: Student's t over the normal, and the root of n / (n - 1).

    Of two blocks the interval is their range, which is no 95 % of anything.
    """
    if n_blocks < _FOLDS:
        return 1.0
    return float(stdtrit(n_blocks - 1, 0.975) / ndtri(0.975) * np.sqrt(n_blocks / (n_blocks - 1)))


def _blocks(segments: Segments) -> tuple[NDArray[np.intp], int, float]:
    """Block of every segment (-1 for one that straddles a border), how many there are, and their length in s."""
    half = 0.5 / segments.band.bin_hz
    start, end = segments.t_s.min() - half, segments.t_s.max() + half
    n = int(min(_MAX_BLOCKS, (end - start) / (2.0 * half * _BLOCK_SEGMENTS)))
    n = _FOLDS * (n // _FOLDS) or 2
    length = (end - start) / n
    first, last = (
        np.floor((segments.t_s + d - start) / length + e).astype(int) for d, e in ((-half, 1e-9), (half, -1e-9))
    )
    return np.where(first == last, first, -1), n, float(length)


def _forms(
    evidence: Evidence, reference: Reference, context: Context, effects: tuple[Effect, ...], whole: Diagnosis
) -> tuple[Model, Model]:
    """The old model form and the extended one, fitted."""
    if evidence.drive is not None:  # a response's phases lead back from nearby only: from the whole recording's fits
        problem = replace(whole.problem, evidence=evidence, reference=reference)
        null = fit(problem, whole.null.x, whole.null.effects, iterations=_DRIVEN)
        return fitted_model(problem, null), fitted_model(problem, fit(problem, whole.final.x, effects, iterations=_DRIVEN))
    problem, null = prepare(evidence, reference, context)
    at = fit(problem, null.x, effects)
    problem = replace(problem, conditions=conditions(problem, at.x, at.effects))  # the motion that the causes leave
    return fitted_model(problem, null), fitted_model(problem, fit(problem, at.x, at.effects))


def fitted_model(problem: Problem, at: Fit) -> Model:
    """The model at a fit, with the standing effects and those that were found."""
    return problem.model(at.x, (*problem.reference.effects(at.x), *at.effects))


def demand_gain(diagnosis: Diagnosis, gain: Gain) -> Diagnosis:
    """A named cause stands only if it gains on held-out data beyond doubt; else nothing is named."""
    if diagnosis.verdict != "named" or gain.ci95[0] > 0.0:
        return diagnosis
    return replace(
        diagnosis,
        verdict="unexplained" if diagnosis.misfit else "none",
        causes=(),
        left_over=diagnosis.misfit,
        final=diagnosis.null,
    )
