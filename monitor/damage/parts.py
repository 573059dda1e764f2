"""The parts whose stiffness is judged, in words: a structure's stories, or its modes where there is no model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from typing_extensions import override

from monitor.core import ModalReading, Reading

_CAUSES = "(weather, mass, clock or stiffness)"
"""What all parts may have changed alike by. [words]"""


@dataclass(frozen=True, slots=True)
class Parts:
    """What alarms are about, by their numbers from 1, and how a change of it is told: the stories of a structure with a model."""

    shown_per_loss: ClassVar[float] = Reading.shown_per_loss
    part: ClassVar[str] = "story"
    every: ClassVar[str] = "every story"
    loss: ClassVar[str] = "loss"
    """What is looked for, with its article left out."""
    unchanged: ClassVar[str] = "no significant loss"
    since: ClassVar[str] = ""
    """What the reason of an alarm begins with."""
    are_places: ClassVar[bool] = True
    """Whether a part is a place in the structure."""

    def name(self, part: int) -> str:
        """Name a part."""
        return f"story {part}"

    def changed(self, part: int, alone: float, loss: float, std: float) -> str:
        """Say how a part changed, by its loss beyond what all have in common (`alone`) and as a whole."""
        return f"{self.name(part)} lost {100 * alone:.1f} ± {200 * std:.1f} % (mean of the latest windows)"

    def shape_changed(self, mode: int, change: float, std: float, channel: int) -> str:
        """Say how a mode's shape changed, most of all at a channel (0 = first)."""
        return change_words(f"the shape of mode {mode}", change, std)

    def alike(self, loss: float) -> tuple[str, str]:
        """Say what all parts lost alike: as an alarm, and beside others."""
        lost = f"all stories lost {100 * loss:.1f} % alike {_CAUSES}"
        return lost, f"all stories changed alike, stiffness by {-100 * loss:+.1f} % {_CAUSES}"


@dataclass(frozen=True, slots=True)
class ModesAndShapes(Parts):
    """The modes of a structure without a model, then their shapes."""

    n_modes: int
    channels: tuple[str, ...] = ()

    shown_per_loss: ClassVar[float] = ModalReading.shown_per_loss
    part: ClassVar[str] = "mode"
    every: ClassVar[str] = "every mode"
    loss: ClassVar[str] = "change of frequency"
    unchanged: ClassVar[str] = "no significant change"
    since: ClassVar[str] = "changed since the baseline: "
    are_places: ClassVar[bool] = False

    @override
    def name(self, part: int) -> str:
        return modal_parts(self.n_modes)[part - 1]

    @override
    def changed(self, part: int, alone: float, loss: float, std: float) -> str:
        return change_words(self.name(part), -self.shown_per_loss * loss, self.shown_per_loss * std)

    @override
    def shape_changed(self, mode: int, change: float, std: float, channel: int) -> str:
        # Plain super() fails in the copy of the class that `slots=True` makes.
        words = super(ModesAndShapes, self).shape_changed(mode, change, std, channel)
        return f"{words} of its largest component at {self.channels[channel]}"

    @override
    def alike(self, loss: float) -> tuple[str, str]:
        verb = "fell" if loss > 0.0 else "rose"
        says = f"all modes {verb} by {100 * self.shown_per_loss * abs(loss):.1f} % alike {_CAUSES}"
        return says, says


ALONE = "; no mode's change tells how"
"""What is said of the spectrum where nothing else changed. [words]"""
SPECTRUM = "the spectrum"
"""The part, after modes and shapes, of what changed and is no mode's change of frequency or shape. [name]"""
STORIES = Parts()
"""The stories of a structure with a model. [none; definition]"""


def modal_parts(n_modes: int) -> tuple[str, ...]:
    """Name what the alarms are about, by their numbers from 1: the modes' frequencies, their shapes, and what is beside them.

    Examples
    --------
    >>> modal_parts(2)
    ('mode 1', 'mode 2', 'the shape of mode 1', 'the shape of mode 2', 'the spectrum')
    """
    modes = [f"mode {i}" for i in range(1, n_modes + 1)]
    return (*modes, *(f"the shape of {mode}" for mode in modes), SPECTRUM)


def change_words(part: str, change: float, std: float) -> str:
    """Say how a part changed, with two standard deviations; that of the spectrum has no size.

    Examples
    --------
    >>> change_words("mode 2", -0.013, 0.001)
    'mode 2 fell by 1.3 ± 0.2 %'
    """
    if part == SPECTRUM:
        return "the spectrum changed"
    verb = "changed" if part.startswith("the shape") else "fell" if change < 0.0 else "rose"
    return f"{part} {verb} by {100 * abs(change):.1f} ± {200 * std:.1f} %"
