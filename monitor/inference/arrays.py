"""Arrays that the modules of this package hand to one another."""

from typing import Annotated

import numpy as np

from monitor.core import ComplexArray

Spectra = Annotated[ComplexArray, "classes bins c c"]
"""One Hermitian matrix a class and bin: cross-spectra, (m/s^2)^2/Hz, or changes relative to them."""
Transforms = Annotated[ComplexArray, "segments bins c"]
"""Tapered transforms of the channels in every segment, m/s^2/sqrt(Hz)."""


def mean_products(transforms: Transforms) -> Annotated[ComplexArray, "bins c c"]:
    """Average the segments' cross-products."""
    return np.asarray(np.einsum("sfa,sfb->fab", transforms, transforms.conj()) / len(transforms))
