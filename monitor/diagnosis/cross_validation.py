"""Gain of an extended model on data that it was not fitted to, by blocked cross-validation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Self

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri, stdtrit

from monitor.core import Array, parallel_map
from monitor.diagnosis.drawing_refit import withdraw_other_structure
from monitor.diagnosis.fold_refit import refit_form
from monitor.diagnosis.predictive_score import Score, csd_error, score
from monitor.diagnosis.repetition import find_repetition, state_repetition
from monitor.diagnosis.verdict import Diagnosis, Verdict
from monitor.inference import MapEstimate, Segments, classify
from monitor.model import Effect

_MAX_HELD_OUT_BLOCKS = 20
"""Most blocks into which a recording is divided. [count; cost]"""
_BLOCK_SEGMENTS = 3.0
"""Least length of a held-out block, in lengths of a segment: long enough that the level of excitation differs between
blocks. [segments; judgement]"""
_N_FOLDS = 4
"""Parts of a recording, each held out once. [count; cost]"""
_ORDINAL = {2: "second", 4: "fourth"}
_N_BOOTSTRAPS = 4000
"""Resamples of the blocks from which the interval of the gain is taken. [count; cost]"""
_LARGE_GAIN_NATS = 20.0
"""Held-out gain of a nonlinear law that chance does not give. [nats; judgement: a likelihood ratio of 5e8]"""


@dataclass(frozen=True, slots=True)
class HeldOutGain:
    """Scores of the old model form and of the extended one on data that neither was fitted to.

    Examples
    --------
    >>> round(HeldOutGain(before=-1.50, after=-1.25).value, 3)
    0.25
    """

    before: float = 0.0
    """Score of the old form, nats per sample instant."""
    after: float = 0.0
    """Score of the extended form, nats per sample instant."""
    ci95: tuple[float, float] = (0.0, 0.0)
    """95 % interval of their difference by block bootstrap, nats per sample instant."""
    nats: float = 0.0
    """Their difference, summed over all held-out data."""
    csd_error_before: float = 0.0
    """Relative squared error of the old form's cross-spectra, see `csd_error`."""
    csd_error_after: float = 0.0
    """Relative squared error of the extended form's cross-spectra."""
    csd_error_rises: bool = False
    """Whether the extended form's error is the larger one in every part of the recording that was held out."""
    heldout: str = "none: nothing was added to the model"
    """Which data were held out."""
    calibration: float = 0.0
    """Log density of what calibration learned at the extended form's fit, less that at the old form's, nats per sample
    instant; zero without a baseline."""

    @property
    def value(self) -> float:
        """Gain of the extended form, nats per sample instant."""
        return self.after - self.before

    @property
    def is_significant(self) -> bool:
        """Decide if the extended form predicts the held-out data and the calibration better than the old form.

        What calibration learned is data too.  An old form that explains a recording as well, but only by a change of what
        calibration learned, is the worse one by the density that it loses there.
        """
        return self.ci95[0] + self.calibration > 0.0

    @property
    def withheld(self) -> str:
        """Why there is no gain, in words; empty where it was measured."""
        return self.heldout.partition("none: ")[2]


@dataclass(frozen=True, eq=False, slots=True)
class HeldOut:
    """A recording in contiguous blocks, parts of which are held out in turn, and how a diagnosis's extended form predicts them.

    A form is scored on every fourth block, fitted to the others, four times over (every second one where the recording is short).

    References
    ----------
    D. Roberts et al., Cross-validation strategies for data with temporal, spatial, hierarchical, or phylogenetic structure,
    Ecography 40 (2017) 913 (blocks in place of single samples).
    """

    segments: Segments
    diagnosis: Diagnosis
    block: Annotated[NDArray[np.intp], "segments"]
    """Block of every segment, -1 for one that straddles a border."""
    n_blocks: int
    length_s: float
    extended: list[Score] = field(default_factory=list)
    """Scores of the extended form on each part; none without causes, or where the recording is too short."""

    @classmethod
    def of(cls, segments: Segments, diagnosis: Diagnosis) -> Self:
        """Divide a recording, and score the extended form."""
        half = 0.5 / segments.band.bin_hz
        start, end = segments.t_s.min() - half, segments.t_s.max() + half
        n = int(min(_MAX_HELD_OUT_BLOCKS, (end - start) / (2.0 * half * _BLOCK_SEGMENTS)))
        n = _N_FOLDS * (n // _N_FOLDS) or 2
        length = (end - start) / n
        first = np.floor((segments.t_s - half - start) / length + 1e-9).astype(int)
        last = np.floor((segments.t_s + half - start) / length - 1e-9).astype(int)
        divided = cls(segments, diagnosis, np.where(first == last, first, -1), n, float(length))
        form = diagnosis.final_fit
        return replace(divided, extended=divided.score(form) if form.effects else [])

    @property
    def n_parts(self) -> int:
        """Number of fits by which every block is held out once."""
        return min(_N_FOLDS, self.n_blocks)

    @property
    def parts(self) -> list[Annotated[NDArray[np.bool_], "segments"]]:
        """Masks of the segments that are held out together; none where the recording is too short."""
        n = self.n_parts
        parts = [(self.block >= 0) & (self.block % n == i) for i in range(n)]
        return [] if any(np.count_nonzero(held) < 2 for held in parts) else parts

    def score(self, form: MapEstimate) -> list[Score]:
        """Score a form on each part, fitted to the others."""
        posterior, segments = self.diagnosis.posterior, self.segments

        def scored(held: NDArray[np.bool_]) -> Score:
            others = (self.block >= 0) & ~held
            label = posterior.observed.label[others]
            part = classify(segments.part(others), label)
            # Weighted as the whole recording, so that the prior affects these fits no more than the published one.
            part = replace(part, counts=part.counts * segments.t_s.size / part.counts.sum())
            model, excitation = refit_form(part, self.diagnosis, form, np.unique(label))
            return score(segments, model, posterior.context, posterior.prior.reference_degc, held, excitation)

        return parallel_map(scored, self.parts)

    def gain_over(self, form: MapEstimate) -> HeldOutGain:
        """Measure the gain over a form without some of the effects, fitted to the whole recording.

        A text stands in place of numbers where nothing was added to the model, or the recording is too short.
        """
        if not self.diagnosis.final_fit.effects:
            return HeldOutGain()
        if not self.extended:
            return HeldOutGain(heldout="none: the recording is too short to hold any of it out")
        n = self.n_blocks
        nats, samples, spectra = np.zeros((2, n)), np.zeros(n), []
        for held, *of_both in zip(self.parts, self.score(form), self.extended, strict=True):
            of_held, n_held = self.block[held], np.count_nonzero(held)
            for i, form_score in enumerate(of_both):
                nats[i] += np.bincount(of_held, form_score.nats, n)
            spectra.append([n_held * np.stack([one.measured, one.modelled]) for one in of_both])
            samples += np.bincount(of_held, minlength=n) * (of_both[0].samples / n_held)
        gains, whole, total = nats[1] - nats[0], np.sum(spectra, axis=0), samples.sum()
        blocks = (
            f"{n} contiguous blocks of {self.length_s:.0f} s, every {_ORDINAL[self.n_parts]} by a fit to the others"
        )
        return HeldOutGain(
            before=float(nats[0].sum() / total),
            after=float(nats[1].sum() / total),
            ci95=_bootstrap_interval(gains, samples),
            nats=float(gains.sum()),
            csd_error_before=csd_error(*whole[0]),
            csd_error_after=csd_error(*whole[1]),
            csd_error_rises=all(csd_error(*after) > csd_error(*before) for before, after in spectra),
            heldout=blocks,
            calibration=calibration_nats(self.diagnosis, form) / float(total),
        )


def calibration_nats(diagnosis: Diagnosis, without: MapEstimate) -> float:
    """Compute the log density of what calibration learned at the final fit, less that at the other form's; see `HeldOutGain`."""
    posterior = diagnosis.posterior
    prior, structure = posterior.prior, posterior.layout.structure
    if not prior.is_baseline:
        return 0.0
    return prior.log_density(diagnosis.final_fit.x[structure]) - prior.log_density(without.x[structure])


def _bootstrap_interval(gains: Annotated[Array, "blocks"], samples: Annotated[Array, "blocks"]) -> tuple[float, float]:
    """Bootstrap the 95 % interval of the gain per sample instant, resampling whole blocks.

    References
    ----------
    B. Efron, R. Tibshirani, An Introduction to the Bootstrap (1993), chapter 13 (percentile interval).
    """
    n = gains.size
    drawn = np.random.default_rng(0).integers(0, n, (_N_BOOTSTRAPS, n))
    means = gains[drawn].sum(axis=1) / np.maximum(samples[drawn].sum(axis=1), 1.0)
    value = gains.sum() / samples.sum()
    # From few blocks the interval is too narrow.  That from two is their range, which is no 95 % interval.
    widening = 1.0 if n < _N_FOLDS else float(stdtrit(n - 1, 0.975) / ndtri(0.975) * np.sqrt(n / (n - 1)))
    low, high = value + widening * (np.quantile(means, [0.025, 0.975]) - value)
    return float(low), float(high)


def confirm_on_held_out(segments: Segments, diagnosis: Diagnosis) -> tuple[Diagnosis, HeldOutGain]:
    """Withdraw the causes that do not gain on held-out data, the last found first.

    Those that remain must gain over the model without the last of them, without the last two, and so on, and without any.  A
    false last cause may hide behind the gain of true ones, or predict so badly that their gain is lost with it.  In a recording
    that repeats itself nothing can be held out, and no cause is confirmed.  Return the diagnosis with the causes that held-out
    data confirm, and the gain of these together, zero if all are withdrawn.
    """
    if (period_s := find_repetition(segments)) is not None:
        return state_repetition(diagnosis, period_s), HeldOutGain(
            heldout=f"none: the recording repeats itself every {period_s:.3g} s"
        )
    shorter = [diagnosis]
    while len(effects := shorter[-1].final_fit.effects) > 1 and not effects[-1].repeatable:
        shorter.append(withdraw_other_structure(shorter[-1].without_last_cause()))
    for n_withdrawn, found in enumerate(shorter):
        scored, forms = HeldOut.of(segments, found), [rest.final_fit for rest in shorter[n_withdrawn + 1 :]]
        added = [found.final_fit.effects[len(form.effects) :] for form in forms]
        if all(confirms(found, a, scored.gain_over(form)) for a, form in zip(added, forms, strict=True)):
            gain = scored.gain_over(found.null_fit)
            if confirms(found, found.final_fit.effects, gain):
                return found, gain if found.verdict != "none" else HeldOutGain()
    return without_any_cause(diagnosis), HeldOutGain()


def confirms(diagnosis: Diagnosis, effects: Sequence[Effect], gain: HeldOutGain) -> bool:
    """Decide if those effects of a diagnosis that were added gain on held-out data.

    Of an ambiguous answer the most probable alternative must gain.  Where no data can be held out, the effects stay.

    A law that only loud blocks show gains in few of them, which a bootstrap of blocks cannot tell from none.  For a nonlinear
    law a large summed gain is therefore enough.  Where causes are stated beside something unexplained, which widens the
    interval too, the summed gain must not be a loss.
    """
    if not effects or gain.withheld:
        return True
    if diagnosis.verdict == "unexplained":
        return not diagnosis.causes or gain.value >= 0.0
    confirmed_by_sum = any(effect.nonlinear for effect in effects) and gain.nats > _LARGE_GAIN_NATS
    return gain.is_significant or confirmed_by_sum


def without_any_cause(diagnosis: Diagnosis) -> Diagnosis:
    """Withdraw all causes."""
    verdict: Verdict = "unexplained" if diagnosis.misfit else "none"
    return replace(diagnosis.without_causes(diagnosis.misfit), verdict=verdict)
