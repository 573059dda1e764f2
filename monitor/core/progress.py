"""How far a long command is: what it does, how much of it is done, and what it does then."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple


class Step(NamedTuple):
    """One step of a long command."""

    does: str
    """In words, as "updates the model"; empty where the command has no other step."""
    done: float = 0.0
    total: float = 0.0
    """Of what `done` counts; 0 where it is not known."""
    unit: str = ""
    """Of both, as "min of data"."""
    then: str = ""
    """What comes next, in words as of `does`."""


OnProgress = Callable[[Step], None]
"""Takes the step at which a command is, whenever it has come further."""
