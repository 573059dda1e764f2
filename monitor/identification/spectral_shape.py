"""Spectral shape of stretches of data, whatever their level, and the tests of whether it changed.

What is learned of stretches (`SpectralShape.of`) is an autoregressive model of each channel, in bands that are each a quarter of
the one before, as far as a stretch resolves them: a structure's modes may lie in a small part of what its sensors sample.  A
stretch is described against it by the scores of the models' coefficients, and by the correlations between the channels'
prediction errors.  Level and offset are divided out.  The features of Gaussian stationary motion scatter by about 1, each for
itself; what scatters more between real stretches is estimated from them (`permute`, `Scatter`), shrunk towards that form where
stretches are few.

References
----------
P. Whittle, The analysis of multiple stationary time series, J. R. Statist. Soc. B 15 (1953) 125-139; H. Sohn, C. R. Farrar,
Damage diagnosis using time series analysis of vibration signals, Smart Materials and Structures 10 (2001) 446-451; O. Ledoit, M.
Wolf, A well-conditioned estimator for large-dimensional covariance matrices, Journal of Multivariate Analysis 88 (2004) 365-411;
G. E. P. Box, Some theorems on quadratic forms applied in the study of analysis of variance problems, Annals of Mathematical
Statistics 25 (1954) 290-302; B. Phipson, G. K. Smyth, Permutation p-values should never be zero, Statistical Applications in
Genetics and Molecular Biology 9 (2010) 39; Y. Chen, A. Wiesel, Y. C. Eldar, A. O. Hero, Shrinkage algorithms for MMSE covariance
estimation, IEEE Transactions on Signal Processing 58 (2010) 5016-5029.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, islice
from math import comb
from typing import Annotated, Self

import numpy as np
from numpy.typing import NDArray

from monitor.core import Array, ComplexArray

_BAND_RATIO = 4
"""Width of a band over that of the next lower one. [1; cost: as the bands of `look`]"""
_LEAST_BINS = 50
"""Fewest bins of a band in a stretch. [count; simulation: five for each of the ten coefficients that a few modes take]"""
_BINS_PER_LAG = 5
"""Bins of a stretch for each coefficient of its model, at least. [count; convention: ten samples a coefficient]"""
_MOST_LAGS = 64
"""Most coefficients of a channel's model. [count; cost]"""
_TAPERED = 0.1
"""Share of a stretch over which it is faded in and out. [1; convention]"""
_LEAST_NOISE = 1e-9
"""Variance of the noise added to a channel's, over the channel's. [1; rounding]"""
_DOUBT = 0.05
"""Probability that T2 scatters less than is taken for sure. [1; convention]"""
MOST_LABELS = 2000
"""Most ways to permute the labels; where there are no more, all are taken. [count; cost: 5 % within half a percent]"""


@dataclass(frozen=True, eq=False, slots=True)
class _Band:
    """Models of c channels with p coefficients in the lowest part of the spectrum."""

    share: float
    """Of the frequencies up to half the rate."""
    coefficients: Annotated[Array, "c p"]
    whitening: Annotated[Array, "c p p"]
    """Inverse Cholesky factors of the correlations over the lags."""

    @classmethod
    def of(cls, transforms: Sequence[ComplexArray], share: float) -> Self:
        """Fit the models to stretches, each with the same weight; their order is that of the least BIC."""
        parts = [_lowest(x, share) for x in transforms]
        most = min(_MOST_LAGS, min(map(len, parts)) // _BINS_PER_LAG)
        lags = np.mean([_correlations(part, most) for part in parts], axis=0)
        samples = sum(2 * len(part) for part in parts)
        ln_errors = np.array([_prediction_errors(row) for row in lags])
        order = 1 + int((samples * ln_errors + np.log(samples) * np.arange(1, most + 1)).sum(axis=0).argmin())
        steps = np.abs(np.subtract.outer(np.arange(order), np.arange(order)))
        matrices = lags[:, steps] + _LEAST_NOISE * np.eye(order)
        return cls(
            share,
            np.linalg.solve(matrices, lags[:, 1 : order + 1, None])[:, :, 0],
            np.linalg.inv(np.linalg.cholesky(matrices)),
        )

    def describe(self, transform: ComplexArray) -> Annotated[Array, "features"]:
        """Describe a stretch: scores channel by channel, then correlations of the channels' prediction errors."""
        x = _lowest(transform, self.share)
        n, order = len(x), self.coefficients.shape[1]
        filters = np.concatenate([np.ones((x.shape[1], 1)), -self.coefficients], axis=1)
        errors = x * np.fft.rfft(filters, 2 * n).T[1:]
        errors /= np.maximum(np.sqrt((np.abs(errors) ** 2).sum(axis=0)), _LEAST_NOISE)
        scores = np.array([_correlation(e * y.conj(), order)[1:] for e, y in zip(errors.T, x.T, strict=True)])
        white = np.einsum("cij,cj->ci", self.whitening, scores)
        i, j = np.tril_indices(x.shape[1], -1)
        between = (errors.T @ errors.conj()).real[i, j]
        limit = 1.0 - _LEAST_NOISE  # of channels that are copies
        between = np.arctanh(np.clip(between, -limit, limit))
        return np.asarray(np.sqrt(2.0 * n) * np.concatenate([white.ravel(), between]))


@dataclass(frozen=True, eq=False, slots=True)
class SpectralShape:
    """The spectral shape of stretches of one state or more, against which each of them, and others, are described.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> healthy = [rng.standard_normal((800, 1)) for _ in range(12)]
    >>> shape = SpectralShape.of(healthy)
    >>> scatter = Scatter.of(np.array([shape.describe(stretch) for stretch in healthy]))
    >>> smoothed = np.apply_along_axis(np.convolve, 0, rng.standard_normal((800, 1)), [1.0, 0.5], "same")
    >>> scatter.chance(shape.describe(rng.standard_normal((800, 1)))) > 0.01 > scatter.chance(shape.describe(smoothed))
    True
    """

    bands: tuple[_Band, ...]

    @classmethod
    def of(cls, stretches: Sequence[Annotated[Array, "n c"]]) -> Self:
        """Learn it of stretches at one rate; the bands are those that the shortest one resolves, at least one."""
        transforms = [_transform(stretch) for stretch in stretches]
        bins, share, shares = min(map(len, transforms)), 1.0, [1.0]
        while bins * share / _BAND_RATIO >= _LEAST_BINS:
            share /= _BAND_RATIO
            shares.append(share)
        return cls(tuple(_Band.of(transforms, share) for share in shares))

    def describe_bands(self, stretch: Annotated[Array, "n c"]) -> list[Annotated[Array, "features"]]:
        """Describe a stretch, band by band, in features that scatter by about 1."""
        transform = _transform(stretch)
        return [band.describe(transform) for band in self.bands]

    def describe(self, stretch: Annotated[Array, "n c"]) -> Annotated[Array, "features"]:
        """Describe a stretch by the features of all bands."""
        return np.concatenate(self.describe_bands(stretch))


def _transform(stretch: Annotated[Array, "n c"]) -> Annotated[ComplexArray, "bins c"]:
    """Transform a stretch without its straight line, faded in and out, from the first bin above 0 Hz on."""
    n = len(stretch)
    t = np.linspace(-1.0, 1.0, n)[:, None]
    centred = stretch - stretch.mean(axis=0)
    centred = centred - t * (t * centred).sum(axis=0) / (t**2).sum()
    edge = np.minimum(1.0, np.minimum(np.arange(n), np.arange(n)[::-1]) / max(1.0, _TAPERED * n))
    return np.asarray(np.fft.rfft(centred * np.sin(0.5 * np.pi * edge)[:, None], axis=0)[1 : n // 2 + 1])


def _lowest(transform: ComplexArray, share: float) -> Annotated[ComplexArray, "bins c"]:
    """Select the lowest bins, of unit power in each channel."""
    x = transform[: max(1, round(share * len(transform)))]
    return np.asarray(x / np.maximum(np.sqrt((np.abs(x) ** 2).sum(axis=0)), np.finfo(float).tiny))


def _correlation(cross: Annotated[ComplexArray, "bins"], most: int) -> Annotated[Array, "1+most"]:
    """Compute the correlation over lags of 0 to `most` samples from a cross-spectrum above 0 Hz of unit power."""
    n = len(cross)
    return np.asarray(np.fft.irfft(np.concatenate([[0.0], cross[:-1], 2.0 * cross[-1:].real]), 2 * n)[: most + 1] * n)


def _correlations(x: Annotated[ComplexArray, "bins c"], most: int) -> Annotated[Array, "c 1+most"]:
    """Compute the autocorrelations of channels."""
    return np.array([_correlation(np.abs(column) ** 2 + 0j, most) for column in x.T])


def _prediction_errors(lags: Annotated[Array, "1+most"]) -> Annotated[Array, "most"]:
    """Compute ln of the prediction error's variance of the models of 1, 2 ... coefficients (Levinson's recursion)."""
    error, a, out = lags[0] * (1.0 + _LEAST_NOISE) + np.finfo(float).tiny, np.zeros(0), []
    for k in range(1, len(lags)):
        reflection = (lags[k] - a @ lags[k - 1 : 0 : -1]) / error
        a = np.append(a - reflection * a[::-1], reflection)
        error *= max(1.0 - reflection**2, _LEAST_NOISE)
        out.append(np.log(error))
    return np.array(out)


def _whiten(
    rows: Annotated[Array, "... m p"], dof: int, deviation: Annotated[Array, "... p"], features: int
) -> Annotated[Array, "... p"]:
    """Divide a deviation by the scatter of centred rows, whose squared length is then T2.

    The covariance is shrunk towards a multiple of the identity, as by Ledoit and Wolf, with the share that is best where rows are
    Gaussian (Chen and others): it needs no fourth moments, which few rows do not show.  `features` counts the coordinates, of
    which those that no row has may be left out.
    """
    _, singular, axes = np.linalg.svd(rows, full_matrices=False)
    values = singular**2 / dof
    trace, squares = values.sum(axis=-1), (values**2).sum(axis=-1)
    departure = (dof + 1.0 - 2.0 / features) * np.maximum(squares - trace**2 / features, 1e-12 * trace**2)
    share = ((1.0 - 2.0 / features) * squares + trace**2) / np.maximum(departure, np.finfo(float).tiny)
    share = np.clip(share, _LEAST_NOISE, 1.0)[..., None]
    floor = share * np.maximum(trace / features, np.finfo(float).tiny)[..., None]
    within = (axes @ deviation[..., None])[..., 0]
    turned = within / np.sqrt(floor + (1.0 - share) * values) - within / np.sqrt(floor)
    return np.asarray(deviation / np.sqrt(floor) + (turned[..., None, :] @ axes)[..., 0, :])


def least_chance(n_first: int, n_second: int) -> float:
    """Compute the least p-value that permuted labels of two groups of stretches can give.

    Examples
    --------
    >>> round(least_chance(4, 4), 3)
    0.029
    """
    alike = 2 if n_first == n_second else 1  # the two groups exchanged are as far apart
    return alike / comb(n_first + n_second, n_first)


def permute(parts: Sequence[Annotated[Array, "n features"]], n_first: int, seed: int = 0) -> float:
    """Compute how often chance tells the first stretches from the others as well, by two-sample T2 with permuted labels.

    `parts` are descriptions of the same stretches (`describe_bands`).  What counts is the largest of their distances, each
    measured by its mean and scatter over all permutations.  The level is exact for stretches that are exchangeable.
    """
    n = len(parts[0])
    labels = _labels(n, n_first, seed)
    distances = np.array([_distances(part, labels) for part in parts])
    spread = np.maximum(distances.std(axis=1, keepdims=True), np.finfo(float).tiny)
    largest = ((distances - distances.mean(axis=1, keepdims=True)) / spread).max(axis=0)
    chance = float((largest >= largest[0] - 1e-9 * (1.0 + abs(largest[0]))).mean())
    return max(chance, least_chance(n_first, n - n_first))


def _labels(n: int, n_first: int, seed: int) -> Annotated[NDArray[np.bool_], "labels n"]:
    """List which stretches are called the first; the true ones come first."""
    if comb(n, n_first) <= MOST_LABELS:
        chosen = [list(one) for one in islice(combinations(range(n), n_first), MOST_LABELS)]
    else:
        rng = np.random.default_rng(seed)
        chosen = [list(range(n_first)), *(rng.permutation(n)[:n_first].tolist() for _ in range(MOST_LABELS - 1))]
    out = np.zeros((len(chosen), n), dtype=bool)
    for row, one in zip(out, chosen, strict=True):
        row[one] = True
    return out


def _distances(
    rows: Annotated[Array, "n p"], labels: Annotated[NDArray[np.bool_], "labels n"]
) -> Annotated[Array, "labels"]:
    """Compute ln T2 between the groups of each labelling."""
    centred = rows - rows.mean(axis=0)
    u, singular, _ = np.linalg.svd(centred, full_matrices=False)
    turned = u * singular  # the same distances in as many coordinates as stretches
    a, b = (one / one.sum(axis=1, keepdims=True) for one in (labels, ~labels))
    means = a @ turned, b @ turned
    within = turned - np.where(labels[:, :, None], *(mean[:, None] for mean in means))
    t2 = (_whiten(within, max(1, len(rows) - 2), means[1] - means[0], rows.shape[1]) ** 2).sum(axis=1)
    return np.asarray(np.log(np.maximum(t2, np.finfo(float).tiny)))


@dataclass(frozen=True, eq=False, slots=True)
class Scatter:
    """Scatter of descriptions of one state: of m stretches, records or days, and what a further one must exceed."""

    rows: Annotated[Array, "m p"]
    """Less their mean."""
    mean: Annotated[Array, "p"]
    replayed_t2: float
    """Mean T2 of each description by the scatter of the others, or of other records: that of a further one."""
    dof: float
    """Degrees of freedom of a T2: directions, as many as vary alike, over which the descriptions scatter; fewer where T2 surely
    scatters more than that."""
    replayed_dof: float
    """Degrees of freedom of `replayed_t2`: as many for each record but one."""

    @classmethod
    def of(cls, descriptions: Annotated[Array, "m p"], records: Sequence[int] | None = None) -> Self:
        """Learn it; of three descriptions or more, or from three records or more where their numbers are given.

        Descriptions of one record are then left out together: what makes records differ is in the limit.
        """
        from scipy.special import chdtri  # takes a while to load

        m, p = descriptions.shape
        number = np.arange(m) if records is None else np.asarray(records)
        mean = descriptions.mean(axis=0)
        replayed = []
        for own in np.unique(number):
            others = descriptions[number != own]
            left = others - others.mean(axis=0)
            deviations = (descriptions[number == own] - others.mean(axis=0)) / np.sqrt(1.0 + 1.0 / len(others))
            replayed += [_whiten(left, len(others) - 1, deviation, p) for deviation in deviations]
        products = np.array(replayed) @ np.transpose(replayed)
        size = float(np.trace(products)) / m
        alike = float((products[~np.eye(m, dtype=bool)] ** 2).mean())
        surely = float(np.diag(products).var()) * m / chdtri(m - 1.0, _DOUBT)
        dof = max(1.0, size**2 / max(alike, 0.5 * surely, np.finfo(float).tiny))
        return cls(descriptions - mean, mean, size, dof, (len(np.unique(number)) - 1) * dof)

    def t2(self, deviation: Annotated[Array, "p"]) -> float:
        """Compute T2 of a deviation that scatters as one description about the state's true mean."""
        return float((_whiten(self.rows, len(self.rows) - 1, deviation, deviation.size) ** 2).sum())

    def chance(self, description: Annotated[Array, "p"], other: Annotated[Array, "p"] | None = None) -> float:
        """Compute how often chance gives as large a T2: of a description against what was learned, or of two against each other.

        T2 over its mean in the replay follows F with `dof` and `replayed_dof` degrees of freedom (Box).
        """
        from scipy.special import fdtrc  # takes a while to load

        m = len(self.rows)
        less, variance = (self.mean, 1.0 + 1.0 / m) if other is None else (other, 2.0)
        ratio = self.t2((description - less) / np.sqrt(variance)) / max(self.replayed_t2, np.finfo(float).tiny)
        return float(fdtrc(self.dof, self.replayed_dof, ratio))
