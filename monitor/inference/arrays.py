"""Arrays that the modules of this package hand to one another."""

from typing import Annotated

from monitor.core import ComplexArray

Spectra = Annotated[ComplexArray, "classes bins c c"]
"""One Hermitian matrix a class and bin: cross-spectra, (m/s^2)^2/Hz, or changes relative to them."""
Transforms = Annotated[ComplexArray, "segments bins c"]
"""Tapered transforms of the channels in every segment, m/s^2/sqrt(Hz)."""
