"""The parts whose stiffness is judged, in words: a structure's stories, or its modes where there is no model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from typing_extensions import override

from monitor.core import Alarm, ModalReading, Reading, storey_of

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

    def size(self, part: int, change: float, std: float) -> str:
        """Write the size of a part's loss, or change, with two standard deviations."""
        return f"{100 * change:.1f} ± {200 * std:.1f} %"

    def changed(self, part: int, alone: float, loss: float, std: float) -> str:
        """Say how a part changed, by its loss beyond what all have in common (`alone`) and as a whole."""
        return f"{self.name(part)} lost {self.size(part, alone, std)} (mean of the latest windows)"

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
    def size(self, part: int, change: float, std: float) -> str:
        return super(ModesAndShapes, self).size(part, abs(change), std)

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


@dataclass(frozen=True, slots=True)
class Features(Parts):
    """Features without waveforms, then what only all of them together show."""

    features: tuple[str, ...]
    relative: tuple[bool, ...]
    """Whether the change of each is told relative to its size."""

    part: ClassVar[str] = "feature"
    every: ClassVar[str] = "every feature"
    loss: ClassVar[str] = "change"
    unchanged: ClassVar[str] = "no significant change"
    since: ClassVar[str] = "changed beyond what the covariates explain: "
    are_places: ClassVar[bool] = False

    @override
    def name(self, part: int) -> str:
        return (*self.features, TOGETHER)[part - 1]

    @override
    def size(self, part: int, change: float, std: float) -> str:
        scale, unit = (100.0, " %") if self.relative[part - 1] else (1.0, "")
        digits = 2 if unit else max(0, 2 - int(np.floor(np.log10(max(abs(change), std, 1e-9)))))
        return f"{scale * change:+.{digits}f} ± {2.0 * scale * std:.{digits}f}{unit}"

    @override
    def changed(self, part: int, alone: float, loss: float, std: float) -> str:
        return self.name(part) if part > len(self.features) else f"{self.name(part)} {self.size(part, -loss, std)}"


SPECTRUM = "the spectrum"
"""The part, after modes and shapes, of what changed and is no mode's change of frequency or shape. [name]"""
TOGETHER = "the features together"
"""The part, after the features, of what none of them shows by itself. [name]"""
ALONE = {SPECTRUM: "; no mode's change tells how", TOGETHER: "; none by itself as much"}
"""Parts that change by no size, and what is said of them where nothing else changed. [words]"""
STORIES = Parts()
"""The stories of a structure with a model. [none; definition]"""


def located(alarm: Alarm, names: Sequence[str]) -> Alarm:
    """Tell a building's storeys and their directions in place of the parts' numbers, by the parts' names; else as it is."""
    if not names or storey_of(names[0]) is None:
        return alarm
    places = [place for j in alarm.stories if (place := storey_of(names[j - 1])) is not None]
    return replace(alarm, stories=tuple(n for n, _ in places), directions=tuple(d for _, d in places))


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
