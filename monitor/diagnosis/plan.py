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
    starts_anywhere: bool
    """Whether a fit may start from the end of another.  The phases of a driven response lead to the optimum from nearby only."""
    keeps_slopes: bool
    """Whether a rough fit keeps the slopes without the cause; where motion is as informative as driven motion, a cause changes
    them at once."""
    ranks_by_slope: bool
    """Whether what a small size changes ranks causes, instead of the whole change at their first size.  The phases of a driven
    response differ much between two fits, so that whole changes rank better (docs/measured-frames.md)."""
    tries_beside_prior: bool
    """Whether effects are tried beside the prior's structure too, where the fit without them went far from it."""
    integrates_laws: bool
    """Whether nonlinear laws act on the predicted motion exactly; else they are linearized, and simulation corrects that."""
    separates_kinds: bool
    """Whether the recording separates kinds of causes, and stiffnesses from all else, so clearly that few need a closer look."""
    judges_by_bands: bool
    """Whether the misfit of spectra in bands shows all lack of fit.  A response shows more: most of the lack of fit is in the
    segments' means, and the ratios of frequencies and their dependence on the level count too."""
    shows_direction: bool
    """Whether the forces on the floors tell from which direction the structure is excited."""
    shows_damping: bool
    """Whether the damping is seen of modes that have hardly moved."""
    tells_tones: bool
    """Whether the steadiness of an amplitude tells a machine from random motion."""
    damping_shift: float
    """Relative change of a frequency from which the form of the damping matters."""


def _needs_no_input(kind: type[Effect]) -> bool:
    """Leave out what only a measured input shows."""
    return not kind.driven_only


def _is_beside_input(kind: type[Effect]) -> bool:
    """Leave out another input, which would only compensate for errors of the response, and what needs stationary motion."""
    return kind.family != "excitation" and not kind.stationary_only


AMBIENT = Plan(
    tries=_needs_no_input,
    begins_with=lambda prior: prior,
    first_dampings=(),
    rough_steps=_ROUGHLY_AMBIENT,
    full_steps=LONG,
    part_steps=_PART_AMBIENT,
    tolerance=_AMBIENT_TOLERANCE_NATS,
    starts_anywhere=True,
    keeps_slopes=True,
    ranks_by_slope=True,
    tries_beside_prior=True,
    integrates_laws=False,
    separates_kinds=False,
    judges_by_bands=True,
    shows_direction=True,
    shows_damping=False,
    tells_tones=True,
    damping_shift=_FREQUENCY_SHIFT,
)
"""Of a recording whose input is not known."""

DRIVEN = Plan(
    tries=_is_beside_input,
    begins_with=StructuralPrior.with_any_noise,
    first_dampings=((_FIRST_DAMPING, _SECOND_DAMPING),),
    rough_steps=ROUGHLY,
    full_steps=FAR,
    part_steps=_PART_DRIVEN,
    tolerance=COARSE,
    starts_anywhere=False,
    keeps_slopes=False,
    ranks_by_slope=False,
    tries_beside_prior=False,
    integrates_laws=True,
    separates_kinds=True,
    judges_by_bands=False,
    shows_direction=False,
    shows_damping=True,
    tells_tones=False,
    damping_shift=0.0,
)
"""Of a recording with a measured input."""


def plan_of(posterior: Posterior) -> Plan:
    """Return the plan of a search by a posterior."""
    return DRIVEN if isinstance(posterior, DrivenPosterior) else AMBIENT
