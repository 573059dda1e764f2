"""How well a model predicts a recording, and what its extension gains on data that it was not fitted to.

A model's score is the tempered debiased Whittle log likelihood of the recording's segments.  Nothing of the structure is
refitted: the white force on each floor, one level for each class of segments, and one noise level common to all channels,
are.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri, stdtrit

from monitor.config import Configuration
from monitor.core import Array, ComplexArray, parallel_map
from monitor.diagnosis.stepwise_selection import Diagnosis
from monitor.inference import (
    Drive,
    ExcitationStart,
    MapEstimate,
    ObservedSpectra,
    Posterior,
    Segments,
    classify,
    fit_excitation,
    linearize,
    maximize_posterior,
    nearest_classes,
)
from monitor.model import Context, Effect, Model
from monitor.signals import Conditioner, common_step_s

_MAX_BLOCKS = 20
_BLOCK_SEGMENTS = 3.0
"""Least length of a held-out block, as lengths of a segment: long enough that levels of excitation differ between blocks."""
_FOLDS = 4
_ORDINAL = {2: "second", 4: "fourth"}
_BOOTSTRAPS = 4000
_SURE_NATS = 20.0
"""Held-out gain of a nonlinear law that chance does not make."""
_PART, _DRIVEN = 12, 25
"""Iterations of a fit to a part of a recording, and of driven motion, from the whole recording's."""


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
class HeldOutGain:
    """Scores of the old model form and of the extended one on data that neither was fitted to."""

    before: float = 0.0
    """Nats per sample instant."""
    after: float = 0.0
    ci95: tuple[float, float] = (0.0, 0.0)
    """Of their difference, by block bootstrap."""
    nats: float = 0.0
    """Their difference, summed over all held-out data."""
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
    near: ExcitationStart | None = None,
) -> Score:
    """Score a model on a recording.

    Band, segments, classes and samples depend on the recording and on ``[processing]`` alone, so that the scores of two
    models may be subtracted.

    Parameters
    ----------
    held : ndarray of bool, shape (n_segments,), optional
        The segments that count; levels and noise are those of the whole recording all the same.
    near : ExcitationStart, optional
        An excitation that is nearly this one: quicker.  The score is the same within far less than a nat, unless it brings
        along what was simulated with more care than is taken here.
    """
    evidence = classify(segments)
    held = np.ones(segments.t_s.size, dtype=bool) if held is None else held
    problem, x = fit_excitation(evidence, model, replace(context, structure=model.structure), reference_degc, near)
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


def _segment_nats(x: ComplexArray, evidence: ObservedSpectra, predicted: ComplexArray) -> Array:
    """Log likelihood of every segment under its class's spectra; their sum is that of the classes' means."""
    out = np.empty(x.shape[0])
    for spectra, members in zip(predicted, evidence.members, strict=True):
        _, log_det = np.linalg.slogdet(spectra)
        form = np.einsum("ska,kab,skb->s", x[members].conj(), np.linalg.inv(spectra), x[members]).real
        out[members] = -evidence.weight * (log_det.sum() + form)
    return out


def heldout_gain(segments: Segments, diagnosis: Diagnosis, config: Configuration) -> HeldOutGain:
    """Gain of a diagnosis's extended model over the old form, each judged on blocks that it was not fitted to.

    The recording is cut into contiguous blocks; both forms are judged by `score` on every fourth of them, fitted to the
    others, four times over (every second one where the recording is short).  A segment
    that straddles a border belongs to none.
    """
    effects = diagnosis.final.effects
    if not effects:
        return HeldOutGain()
    block, n_blocks, block_s = _blocks(segments)
    folds = min(_FOLDS, n_blocks)
    if any(np.count_nonzero((block >= 0) & (block % folds == fold)) < 2 for fold in range(folds)):
        return HeldOutGain(heldout="none: the recording is too short to hold any of it out")
    context, reference = diagnosis.problem.context, diagnosis.problem.prior
    nats, samples = np.zeros((2, n_blocks)), np.zeros(n_blocks)
    spectra = np.zeros((2, 2, *segments.values.shape[1:], segments.values.shape[2]), dtype=complex)

    def scores(held: NDArray[np.bool_]) -> list[Score]:
        """Of both forms, fitted to what is not held out."""
        others = classify(segments.part((block >= 0) & ~held))
        # Weighed as the whole recording, so that what was known before pulls these fits no more than the published one.
        others = replace(
            others,
            counts=others.counts * segments.t_s.size / others.counts.sum(),
            drive=_as_moved(others.drive, diagnosis),
        )
        return [
            score(segments, form, context, config, reference.reference_degc, held, near)
            for form, near in _forms(others, effects, diagnosis)
        ]

    parts = [(block >= 0) & (block % folds == fold) for fold in range(folds)]
    for held, judged in zip(parts, parallel_map(scores, parts), strict=True):
        for i, one in enumerate(judged):
            nats[i] += np.bincount(block[held], one.nats, n_blocks)
            spectra[i] += np.count_nonzero(held) * np.stack([one.measured, one.modelled])
        samples += np.bincount(block[held], minlength=n_blocks) * (judged[0].samples / np.count_nonzero(held))
    total = samples.sum()
    drawn = np.random.default_rng(0).integers(0, n_blocks, (_BOOTSTRAPS, n_blocks))
    gains = (nats[1] - nats[0])[drawn].sum(axis=1) / np.maximum(samples[drawn].sum(axis=1), 1.0)
    value = (nats[1] - nats[0]).sum() / total
    low, high = value + _widening(n_blocks) * (np.quantile(gains, [0.025, 0.975]) - value)
    return HeldOutGain(
        before=float(nats[0].sum() / total),
        after=float(nats[1].sum() / total),
        ci95=(float(low), float(high)),
        nats=float((nats[1] - nats[0]).sum()),
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
    evidence: ObservedSpectra, effects: tuple[Effect, ...], whole: Diagnosis
) -> list[tuple[Model, ExcitationStart]]:
    """The old model form and the extended one, fitted, each with its excitation.

    From the whole recording's fits, which lie near: a response's phases lead back from nearby only, and all else comes quicker.
    What simulation adds to a linearized law is that of the whole recording, too: a matter of the law, not of what was measured.
    It is simulated anew where both forms have laws, which must be judged alike, and where classes are not of level alone.
    """
    n_classes = evidence.counts.size
    problem = whole.problem.part(evidence, nearest_classes(whole.problem.n_classes, n_classes))
    p, n = problem.prior.mean.size, whole.problem.n_nuisance
    by_level = not (evidence.by_temperature or whole.problem.observed.by_temperature)
    shared = by_level and not any(e.nonlinear for e in problem.prior.model.effects)

    def fitted(x: Array, effects: tuple[Effect, ...]) -> tuple[Model, ExcitationStart]:
        x = np.concatenate([x[:p], ExcitationStart.at(whole.problem, x).of(n_classes).vector, x[n:]])
        here = problem
        if evidence.drive is None and any(e.conditional for e in (*problem.prior.effects(x), *effects)):
            here = replace(problem, conditions=linearize(replace(problem, offset=None), x, effects))
        at = maximize_posterior(here, x, effects, iterations=_DRIVEN if evidence.drive is not None else _PART)
        return fitted_model(here, at), ExcitationStart.at(here, at.x, here.beyond(at.x, at.effects) if shared else None)

    return [fitted(whole.null.x, whole.null.effects), fitted(whole.final.x, effects)]


def _as_moved(drive: Drive | None, diagnosis: Diagnosis) -> Drive | None:
    """The ground as the diagnosis found it to move between its samples."""
    whole = diagnosis.problem.observed.drive
    return None if drive is None or whole is None else replace(drive, between=whole.between)


def fitted_model(problem: Posterior, at: MapEstimate) -> Model:
    """The model at a fit, with the standing effects and those that were found."""
    effects = (*problem.prior.effects(at.x), *at.effects)
    model, damping = problem.model(at.x, effects), problem.system(at.x, effects).damping
    modes = model.modes()
    modal = np.einsum("ai,ab,bi->i", modes.shapes, damping, modes.shapes)
    return replace(model, modal_damping=modal / (2.0 * np.sqrt(np.maximum(modes.eigenvalues, 1e-12))))


def require_gain(diagnosis: Diagnosis, gain: HeldOutGain) -> Diagnosis:
    """A named cause stands only if it gains on held-out data beyond doubt; else nothing is named.

    A law that only loud blocks show gains in few of them, which a bootstrap of blocks cannot tell from none: there the sum
    counts.  Of what is stated beside something unexplained, which blurs the interval too, the sum must not be a loss.
    """
    loud = any(cause.effect.nonlinear for cause in diagnosis.causes) and gain.nats > _SURE_NATS
    match diagnosis.verdict:
        case "named":
            stands = gain.ci95[0] > 0.0 or loud
        case "unexplained":
            stands = not diagnosis.causes or gain.value >= 0.0
        case _:
            return diagnosis
    if stands:
        return diagnosis
    return replace(
        diagnosis,
        verdict="unexplained" if diagnosis.misfit else "none",
        causes=(),
        left_over=diagnosis.misfit,
        final=diagnosis.null,
    )
