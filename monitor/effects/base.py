"""What every effect is: a place, parameters, and how it changes the structure's matrices."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, fields
from math import inf
from typing import ClassVar, Self

from monitor.results import Array
from monitor.structures import ShearFrame


class EffectError(ValueError):
    """Name, place or parameters of an effect are wrong; the message says which and what is allowed."""


@dataclass(frozen=True)
class Effect(ABC):
    """A term that the drawing leaves out.  Subclasses add one float field a parameter, with its unit in the name."""

    name: ClassVar[str]
    places: ClassVar[tuple[str, ...]]
    """Kinds of place: ``story``, ``floor``, ``frame``."""

    minimum: ClassVar[Mapping[str, float]]
    """What each parameter must exceed to be physically possible."""

    location: str
    """As in the contract: ``story 2``, ``floor 1``, ``frame``."""

    @classmethod
    def create(cls, location: str, parameters: Mapping[str, float]) -> Self:
        """The effect at `location`.

        Raises
        ------
        EffectError
            If the place is not one of `places` or the parameters are not exactly the effect's.
        """
        kind, _, number = location.partition(" ")
        whole = location == "frame"
        if kind not in cls.places or not (whole or (kind != "frame" and number.isdigit() and int(number) > 0)):
            allowed = ", ".join(p if p == "frame" else f"{p} N" for p in cls.places)
            raise EffectError(f"{cls.name}: no place {location!r}; allowed: {allowed}")
        wanted = {f.name for f in fields(cls)} - {"location"}
        if set(parameters) != wanted:
            raise EffectError(f"{cls.name}: needs exactly {', '.join(sorted(wanted)) or 'no parameters'}")
        for name, value in parameters.items():
            if not cls.minimum[name] < value < inf:
                raise EffectError(f"{cls.name}: {name} = {value:g} must be finite and above {cls.minimum[name]:g}")
        return cls(location, **parameters)

    @property
    def index(self) -> int:
        """Place as an index from 0.  Meaningless for ``frame``."""
        return int(self.location.partition(" ")[2]) - 1

    def check(self, structure: ShearFrame) -> None:
        """Raises EffectError if the structure has no such place."""
        if not self.location.startswith("frame") and self.index >= structure.n_stories:
            raise EffectError(f"{self.name}: {self.location!r} does not exist; {structure.n_stories} stories")

    @abstractmethod
    def stiffness_matrix(self, stiffness: Array, structure: ShearFrame) -> Array:
        """The stiffness matrix with this effect in place of `stiffness`, shape (n, n), N/m."""
