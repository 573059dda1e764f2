"""The shape of the spectrum of a window against those of healthy windows: a change that no mode's change need tell.

It is judged of every window of all channels, with one channel and with few seconds too.  Level and offset are divided out; the
limit holds the scatter between records, each of which is left out in turn.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from monitor.core import CrossSpectra, decode
from monitor.identification import Scatter, SpectralShape

_LEAST_RECORDS = 3
"""Fewest records, or windows of one record, from which a scatter is estimated. [count; definition: two beside one left out]"""


@dataclass(frozen=True, eq=False, slots=True)
class HealthySpectrum:
    """The shape of healthy windows' spectra, and its scatter."""

    shape: SpectralShape
    scatter: Scatter

    def chance(self, spectra: CrossSpectra) -> float:
        """Compute how often a healthy window's spectrum is as far from what was learned."""
        return self.scatter.chance(self.shape.describe_spectra(spectra))


def learn_spectrum(spectra: Sequence[CrossSpectra], records: Sequence[int]) -> HealthySpectrum | None:
    """Learn it of windows that share no data, each in one of the numbered records; None where there are too few."""
    if len(spectra) < _LEAST_RECORDS:
        return None
    shape = SpectralShape.of_spectra(spectra)
    described = np.array([shape.describe_spectra(one) for one in spectra])
    return HealthySpectrum(shape, Scatter.of(described, records if len(set(records)) >= _LEAST_RECORDS else None))


def read_spectrum(content: Any) -> HealthySpectrum | None:
    """Read it from a baseline's file, None where none was learned; ValueError if it is damaged."""
    return None if content is None else decode(HealthySpectrum, content, place="spectrum")
