"""Plans of a search: what it does otherwise where the input was measured, with one name for every difference."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from monitor.inference import DrivenPosterior, Posterior
from monitor.model import Effect, StructuralPrior

FAR = 40
"""Most iterations of a fit that begins far from its end: a first fit to driven motion, or to forces whose spectrum is
far from flat. [iterations; cost]"""
LONG = 15
"""Most iterations of a fit that is followed to its end. [iterations; cost]"""
ROUGHLY = 4
"""Iterations by which kinds of causes, and the ground's motion between its samples, are compared. [iterations; cost]"""
_ROUGHLY_AMBIENT = 5
"""Most iterations of a rough fit without a measured ground. [iterations; cost]"""
_PART_AMBIENT = 12
"""Most iterations of a fit to a part of a recording that begins at the fit to the whole. [iterations; cost]"""
_PART_DRIVEN = 25
"""The same where the ground motion is measured. [iterations; cost]"""
COARSE = 0.3
"""Expected gain of the next step at which a fit to driven motion ends. [nats; judgement: driven motion separates causes
by hundreds of nats]"""
_AMBIENT_TOLERANCE_NATS = 0.02
"""Expected gain of the next step at which a fit ends where the ground was not measured. [nats; judgement]"""
_FIRST_DAMPING = 0.05
"""Damping ratio at which the first fit to driven motion begins. [1; judgement]"""
_SECOND_DAMPING = 0.015
"""Damping ratio at which that fit goes on. [1; judgement]"""
_FREQUENCY_SHIFT = 0.05
"""Relative change of a frequency from which the form of the damping matters. [ratio; judgement]"""


@dataclass(frozen=True, slots=True)
class Plan:
    """What a search does otherwise in a recording of one kind."""

    tries: Callable[[type[Effect]], bool]
    """Whether a kind of effect is tried as a cause."""
    begins_with: Callable[[StructuralPrior], StructuralPrior]
    """What is known of the structure and its sensors when a search begins."""
    first_dampings: tuple[tuple[float, float], ...]
    """Damping ratios that are held in a fit before the first one, each with that at which the fit then goes on."""
    rough_steps: int
    """Most iterations of a rough fit."""
    full_steps: int
    """Most iterations of a fit that is followed to its end."""
    part_steps: int
    """Most iterations of a fit to a part of the recording from that to the whole."""
    tolerance: float
    """Expected gain of the next step at which a fit of a cause ends, nats."""
    knows_input: bool
    """Whether the input was measured.  A response separates kinds of causes, and stiffnesses from all else, so clearly that few
    need a closer look, and shows the damping of modes that have hardly moved.  Most of its lack of fit is in the segments' means,
    and the ratios of frequencies and their dependence on the level count too.  Elsewhere the misfit of spectra in bands shows
    all, the forces on the floors tell from which direction the structure is excited, and the steadiness of an amplitude tells a
    machine."""
    starts_anywhere: bool
    """Whether a fit may start from the prior or from the end of another, whose slopes hold beside a cause and rank causes.  The
    phases of a driven response lead to the optimum from nearby only, and differ so much between two fits that what a cause
    changes at its first size ranks better (docs/measured-frames.md)."""
    damping_shift: float
    """Relative change of a frequency from which the form of the damping matters."""


AMBIENT = Plan(
    tries=lambda kind: not kind.driven_only,
    begins_with=lambda prior: prior,
    first_dampings=(),
    rough_steps=_ROUGHLY_AMBIENT,
    full_steps=LONG,
    part_steps=_PART_AMBIENT,
    tolerance=_AMBIENT_TOLERANCE_NATS,
    knows_input=False,
    starts_anywhere=True,
    damping_shift=_FREQUENCY_SHIFT,
)
"""Of a recording whose input is not known."""

DRIVEN = Plan(
    # Another input would only compensate for errors of the response.
    tries=lambda kind: kind.family != "excitation" and not kind.stationary_only,
    begins_with=StructuralPrior.with_any_noise,
    first_dampings=((_FIRST_DAMPING, _SECOND_DAMPING),),
    rough_steps=ROUGHLY,
    full_steps=FAR,
    part_steps=_PART_DRIVEN,
    tolerance=COARSE,
    knows_input=True,
    starts_anywhere=False,
    damping_shift=0.0,
)
"""Of a recording with a measured input."""


def plan_of(posterior: Posterior) -> Plan:
    """Return the plan of a search by a posterior."""
    return DRIVEN if isinstance(posterior, DrivenPosterior) else AMBIENT
