"""Band that a recording can judge: where the power of all channels at once falls, the forces that shake the structure end.

The decision is made from the recording alone, before any model is fitted, so all models are compared in the same band.

A structure under forces on its floors has bounds on how steeply its power may fall.  Beyond the last mode at f1 the power of
the acceleration falls as ``(1 - (f1/f)^2)^-2`` towards a constant.  Below the first mode it falls as the fourth power of the
frequency times the mirror image of that.  A fall of order m is one by ``2 m d(ln f)`` in ``ln S``, as of a filter with m poles.
A steeper fall, of every channel and for good, is no structure's: the forces end there, or a filter or the sensors' noise takes
over.  The second eigenvalue of the cross-spectra is such a power too.  It shows forces on all floors nearly without the peaks of
the modes, each of which moves in one direction only, and without what a single nonlinear law excites beyond the forces' end.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import median_filter

from monitor.core import Array
from monitor.inference.arrays import Transforms, mean_products
from monitor.inference.cross_spectra import Band
from monitor.signals import LEAKAGE_OFFSETS, overlap_correlation

_LEAST_ORDER_ABOVE = 4.0
"""Order of a fall towards high frequencies that is no structure's. [1; judgement: the tail of a mode falls with an order of
1.3 at most where an octave before lies wholly above what is beyond, and a first-order colour of the forces adds 1]"""
_LEAST_ORDER_BELOW = 8.0
"""The same towards low frequencies. [1; judgement: there a mode falls with an order of 5.3 at most, and a colour adds 1]"""
_NO_POWER = 1e-300
"""Stands for the power of a dead channel, so that it has a logarithm. [(m/s^2)^2/Hz; rounding]"""
_OCTAVE = float(np.log(2.0))
"""Range of frequencies, on the forces' side of a fall, that must lie wholly above what is beyond the fall. [1; definition: an
octave]"""
_FLAT = float(np.log(0.9))
"""Logarithm of the share of the forces' end up to which they are flat. [1; judgement: a multisine or a filter falls a little
before its end, by less than the steepest part shows]"""
_MEDIAN_BINS = 13
"""Bins over which the median is taken: the line of a machine, up to six bins wide, is narrower than half of that. [bins; Hann
taper]"""


def find_judged_band(transforms: Transforms, whole: Band) -> Band:
    """Find the part of a band in which forces shake the structure: where the power falls no more steeply than a structure's may.

    At the frequencies at which the forces begin and end the power has fallen by half; zero and infinity where it does not.
    """
    hz, transforms = whole.hz, np.asarray(transforms / np.sqrt(whole.gain)[:, None], dtype=complex)
    spectra = mean_products(transforms)
    second, power = np.linalg.eigvalsh(spectra)[:, -2:][:, :1], np.einsum("kaa->ka", spectra).real
    periodograms = np.abs(transforms) ** 2
    relative = np.median(periodograms.std(axis=0) / np.maximum(power, _NO_POWER))
    chance = float(relative * np.sqrt((1.0 + 2.0 * overlap_correlation()) / len(periodograms)))
    levels = [
        median_filter(np.log(np.maximum(p, _NO_POWER)), size=(_MEDIAN_BINS, 1), mode="nearest") for p in (second, power)
    ]
    u = np.log(hz)
    above = (_steepest_fall(u, level, chance, _LEAST_ORDER_ABOVE) for level in levels)
    below = (_steepest_fall(-u[::-1], level[::-1], chance, _LEAST_ORDER_BELOW) for level in levels)
    nowhere = np.inf, np.inf
    (end, flat_to), (begin, flat_from) = (next(filter(None, falls), nowhere) for falls in (above, below))
    leaked = 0.5 * float(np.abs(LEAKAGE_OFFSETS).max()) * (hz[1] - hz[0])
    first, past = np.searchsorted(hz, [np.exp(-flat_from) + leaked, np.exp(flat_to) - leaked])
    if past - first < 2:
        return whole
    return whole.part(slice(int(first), int(past)), (float(np.exp(-begin)), float(np.exp(end))))


def _steepest_fall(u: Array, level: Array, chance: float, least_order: float) -> tuple[float, float] | None:
    """Find the steepest fall of all channels from an octave to everything beyond; None where none reaches the least order.

    Returned are where the power has fallen by half, and up to where the forces are flat, with a fall of less than chance.

    The fall is taken for a Butterworth filter's, whose order and corner follow from the steepest part.  `u` are logarithms of the
    frequencies, ascending towards the fall, `level` logarithms of the power, and `chance` is its standard deviation by chance.
    """
    before = np.searchsorted(u, u - _OCTAVE)  # first bin of the octave that ends at each bin
    whole = np.flatnonzero(u - u[0] >= _OCTAVE)
    if not whole.size:
        return None
    least = np.stack([level[before[i] : i + 1].min(axis=0) for i in whole])
    most = np.maximum.accumulate(level[::-1], axis=0)[::-1]
    # The greatest of n normal values lies about sqrt(2 ln n) standard deviations from the mean.
    drop = (least[:, None] - most[None]).min(axis=-1) - 2.0 * chance * np.sqrt(2.0 * np.log(u.size))
    width = u[None] - u[whole, None]
    order = np.where(width > 0.0, drop / (2.0 * np.where(width > 0.0, width, 1.0)), -np.inf)
    i, b = np.unravel_index(int(order.argmax()), order.shape)
    m, a = float(order[i, b]), int(whole[i])
    if m < least_order:
        return None
    middle, plateau = 0.5 * (u[a] + u[b]), np.median(level[np.searchsorted(u, u[a] - _OCTAVE / 3.0) : a + 1], axis=0)
    fallen = float((plateau - 0.5 * (least[i] + most[b])).mean())
    lost = max(float(np.expm1(fallen)), 1.0)  # g = 1 / (1 + lost) at the middle
    half = middle - np.log(lost) / (2.0 * m)
    return half, half + min(_FLAT, np.log(chance) / (2.0 * m))
