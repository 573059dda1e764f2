"""Score of a model by how well it predicts a recording.

The score is the tempered debiased Whittle log likelihood of the recording's segments.  The structure and its effects stay as
they are given.  Only the excitation is fitted: the white force on each floor, one level for each class of segments, and one
noise level common to all channels.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from monitor.core import Array, ComplexArray
from monitor.inference import ExcitationStart, Segments, classify, fit_excitation
from monitor.model import Context, Model


@dataclass(frozen=True, eq=False, slots=True)
class Score:
    """Score of one model on one recording."""

    nats: Annotated[Array, "segments"]
    """Tempered log likelihood of every segment."""
    samples: int
    """Number of sample instants, at the rate of the processing."""
    band_hz: tuple[float, float]
    """Lowest and highest frequency of the band in which the recording can be judged."""
    measured: Annotated[ComplexArray, "bins c c"]
    """Mean cross-spectra of the segments."""
    modelled: Annotated[ComplexArray, "bins c c"]
    """The model's cross-spectra, averaged over the classes as the segments are."""

    @property
    def csd_error(self) -> float:
        """Relative squared error of the modelled cross-spectra, see `csd_error`."""
        return csd_error(self.measured, self.modelled)

    @property
    def log_score_per_sample(self) -> float:
        """Log score in nats per sample instant, all channels together."""
        return float(self.nats.sum()) / self.samples


def score(
    segments: Segments,
    model: Model,
    context: Context,
    reference_degc: float | None = None,
    held: Annotated[NDArray[np.bool_], "segments"] | None = None,
    near: ExcitationStart | None = None,
) -> Score:
    """Score a model on a recording.

    Band, segments, classes and samples depend on the recording and on ``[processing]`` alone, so that the scores of two models
    may be subtracted.  Structure and effects of the model stay as they are; its structure takes the place of that of `context`,
    and its stiffnesses hold at `reference_degc`.  Of the segments those `held` count, by default all; levels and noise are fitted
    to the whole recording all the same.  From `near`, an excitation close to the recording's, the fit is quicker, and the score
    is the same within far less than a nat, unless `near` holds what was simulated with more care than `score` takes.

    References
    ----------
    A. Sykulski, S. Olhede, A. Guillaumin, J. Lilly, J. Early, The debiased Whittle likelihood, Biometrika 106 (2019) 251.
    """
    observed = classify(segments)
    held = np.ones(segments.t_s.size, dtype=bool) if held is None else held
    posterior, x = fit_excitation(observed, model, replace(context, structure=model.structure), reference_degc, near)
    scatter, mean = posterior.scatter(x, ()), posterior.mean(x, ())
    residual, counted = segments.values - mean, segments.values[held]
    measured = np.einsum("ska,skb->kab", counted, counted.conj()) / len(counted)
    share = np.array([np.count_nonzero(held[members]) for members in observed.members]) / len(counted)
    modelled = np.tensordot(share, scatter, axes=1)
    modelled = modelled + np.einsum("ska,skb->kab", mean[held], mean[held].conj()) / len(counted)
    # The sum over the segments is the log likelihood of the classes' mean spectra.
    nats = np.empty(held.size)
    for spectra, members in zip(scatter, observed.members, strict=True):
        _, log_det = np.linalg.slogdet(spectra)
        left = residual[members]
        form = np.einsum("ska,kab,skb->s", left.conj(), np.linalg.inv(spectra), left).real
        nats[members] = -observed.weight * (log_det.sum() + form)
    band_hz = float(segments.band.hz[0]), float(segments.band.hz[-1])
    # The segments overlap by half, so that each covers half of its samples.
    samples = round(0.5 * np.count_nonzero(held) * segments.resampled_hz / segments.band.bin_hz)
    return Score(nats[held], samples, band_hz, measured, modelled)


def csd_error(measured: Annotated[ComplexArray, "bins c c"], modelled: Annotated[ComplexArray, "bins c c"]) -> float:
    """Compute the squared Frobenius norm of measured less modelled cross-spectra, over all bins, over that of the measured ones.

    Examples
    --------
    >>> import numpy as np
    >>> csd_error(np.full((4, 1, 1), 2.0 + 0j), np.full((4, 1, 1), 1.0 + 0j))
    0.25
    """
    return float((np.abs(measured - modelled) ** 2).sum() / (np.abs(measured) ** 2).sum())
