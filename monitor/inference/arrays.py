"""Arrays that the modules of this package hand to one another."""

from typing import Annotated

import numpy as np

from monitor.core import Array, ComplexArray

Spectrum = Annotated[ComplexArray, "bins c c"]
"""One Hermitian matrix a bin: cross-spectra, two-sided, (m/s^2)^2/Hz."""
Spectra = Annotated[ComplexArray, "classes bins c c"]
"""One Hermitian matrix a class and bin: cross-spectra, (m/s^2)^2/Hz, or changes relative to them."""
SpectraSlopes = Annotated[ComplexArray, "p classes bins c c"]
"""Slopes of the spectra by each of some coordinates."""
PackedSlopes = Annotated[Array, "p c*c bins"]
"""Slopes of one class's spectra, packed as real numbers (`system_slopes.packed`)."""
Transforms = Annotated[ComplexArray, "segments bins c"]
"""Tapered transforms of the channels in every segment, m/s^2/sqrt(Hz)."""
TransformSlopes = Annotated[ComplexArray, "p segments bins c"]
"""Slopes of the segments' means by each of some coordinates."""


def mean_products(transforms: Transforms) -> Spectrum:
    """Average the segments' cross-products."""
    return np.asarray(np.einsum("sfa,sfb->fab", transforms, transforms.conj()) / len(transforms))
