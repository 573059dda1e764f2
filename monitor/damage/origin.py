"""Whose a baseline is: the structure as drawn, its sensors, and the samples from which the baseline was learned."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from hashlib import sha256
from typing import Annotated, Self

import numpy as np

from monitor.core import Array
from monitor.model import InstrumentedModel

_DIGITS = 1e9
"""Matrices that differ by less than their largest entry over this number have one fingerprint. [ratio; rounding]"""
MODAL = "modal"
"""Kind of a structure without a model. [name; definition]"""
MOST_LISTED = 3
"""Most items of one kind that a message lists. [1; judgement]"""


@dataclass(frozen=True, slots=True)
class Origin:
    """The structure as drawn and the samples from which a baseline was learned."""

    name: str
    kind: str
    masses_kg: tuple[Annotated[float, 0.0], ...]
    """As drawn."""
    stiffness_n_per_m: tuple[Annotated[float, 0.0], ...]
    """As drawn, one for each story."""
    fingerprint: str
    """Of the drawn mass matrix, stiffness matrix and its derivatives (`matrices_fingerprint`)."""
    unit: str
    """Of the samples."""
    rate_hz: float | None
    """Sample rate after resampling."""
    cutoff_hz: float | None

    @classmethod
    def of(cls, instrumented: InstrumentedModel) -> Self:
        """Describe the structure of a structure file."""
        drawn = instrumented.model.structure
        return cls(
            name=instrumented.name,
            kind=instrumented.kind,
            masses_kg=tuple(drawn.masses_kg.tolist()),
            stiffness_n_per_m=tuple(drawn.stiffness_n_per_m.tolist()),
            fingerprint=matrices_fingerprint(
                drawn.mass_matrix(), drawn.stiffness_matrix(), drawn.stiffness_derivatives()
            ),
            unit="m/s^2",
            rate_hz=instrumented.rate_hz,
            cutoff_hz=instrumented.cutoff_hz,
        )

    @classmethod
    def of_modes(cls, name: str, rate_hz: float, cutoff_hz: float) -> Self:
        """Describe a structure of which nothing is drawn."""
        return cls(name, MODAL, (), (), "", "m/s^2", rate_hz, cutoff_hz)

    def is_named_otherwise(self, here: Origin) -> bool:
        """Tell whether both structures have names, which differ."""
        return bool(self.name and here.name) and self.name != here.name

    def sampling_differences(self, here: Origin) -> list[str]:
        """List the differences of the samples, as sentences about what is there, in the baseline, and here."""
        pairs = [
            ("rate_hz", self.rate_hz, here.rate_hz),
            ("cutoff_hz", self.cutoff_hz, here.cutoff_hz),
            ("the unit", self.unit, here.unit),
        ]
        return [f"{what} is {there} there and {now} here" for what, there, now in pairs if there != now]

    def drawing_differences(self, here: Origin) -> list[str]:
        """List the differences of the drawing; both have the same numbers of masses and stiffnesses."""
        if self.kind == here.kind and self.fingerprint == here.fingerprint:
            return []
        says = [] if self.kind == here.kind else [f"it is a {self.kind} there and a {here.kind} here"]
        says += _value_differences("floor {} weighs {} kg there and {} kg here", self.masses_kg, here.masses_kg)
        says += _value_differences(
            "story {} is drawn with {} N/m there and {} N/m here", self.stiffness_n_per_m, here.stiffness_n_per_m
        )
        return says or ["its matrices differ, although the masses and the stiffnesses are alike"]


def matrices_fingerprint(*matrices: Array) -> str:
    """Compute a checksum of matrices to nine digits, so that the rounding of their assembly does not change it.

    Examples
    --------
    >>> import numpy as np
    >>> matrices_fingerprint(np.eye(2)) == matrices_fingerprint(np.eye(2) + 1e-14)
    True
    >>> matrices_fingerprint(np.eye(2)) == matrices_fingerprint(1.001 * np.eye(2))
    False
    """
    checksum = sha256()
    for matrix in matrices:
        largest = float(np.abs(matrix).max())
        checksum.update(f"{matrix.shape} {largest:.9g}".encode())
        checksum.update(np.rint(matrix / largest * _DIGITS).astype("<i8").tobytes())
    return checksum.hexdigest()


def sensor_differences(channels: tuple[str, ...], floors: tuple[int | str, ...], here: InstrumentedModel) -> list[str]:
    """List the differences between a baseline's sensors and those here."""
    there, now = dict(zip(channels, floors, strict=True)), dict(zip(here.channels, here.floors, strict=True))
    says = [f"channel {c} (floor {floor}) is there and not here" for c, floor in there.items() if c not in now]
    says += [f"channel {c} (floor {floor}) is here and not there" for c, floor in now.items() if c not in there]
    says += [
        f"channel {c} is on floor {floor} there and on floor {now[c]} here"
        for c, floor in there.items()
        if floor != now.get(c, floor)
    ]
    if not says and channels != here.channels:
        says = [f"the channels stand in the order {', '.join(channels)} there and {', '.join(here.channels)} here"]
    return says


def number_differences(n_masses: int, n_stiffnesses: int, here: InstrumentedModel) -> list[str]:
    """Compare the numbers of masses and of stories."""
    b, p = here.model.structure.n_masses, here.model.structure.n_stories
    if (n_masses, n_stiffnesses) == (b, p):
        return []
    return [f"it has {n_masses} masses and {n_stiffnesses} stiffnesses there, {b} and {p} here"]


def _value_differences(sentence: str, there: Sequence[float], here: Sequence[float]) -> list[str]:
    """Put unequal values into a sentence each, at most `MOST_LISTED`, with as many digits as tell them apart."""
    unequal = [(i, a, b) for i, (a, b) in enumerate(zip(there, here, strict=True), start=1) if a != b]
    says = []
    for i, a, b in unequal[:MOST_LISTED]:
        digits = next((d for d in (4, 6, 9) if f"{a:.{d}g}" != f"{b:.{d}g}"), 17)
        says.append(sentence.format(i, f"{a:.{digits}g}", f"{b:.{digits}g}"))
    more = len(unequal) - len(says)
    return [*says, f"{more} more of these differ"] if more else says
