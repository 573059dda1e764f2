"""What an effect of one's own is made of, and the error of wrong input."""

from __future__ import annotations

from monitor.core import UserError
from monitor.model import EFFECTS, Condition, Context, Effect, FittedSizes, Parameter

__all__ = ["Condition", "Context", "Effect", "FittedSizes", "Parameter", "UserError", "add_effect"]


def add_effect(effect: type[Effect]) -> None:
    """Add an effect to the catalogue, so that simulations know it by its name and diagnoses look for it.

    A class of the same name takes the place of the former one; docs/extend.md shows one.
    """
    EFFECTS[effect.name] = effect
