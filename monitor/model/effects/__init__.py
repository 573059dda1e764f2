"""Catalogue of effects by name, the terms that a structure file leaves out.

Each effect has a file of its own.  `Model` and the simulation use the same objects.
"""

from __future__ import annotations

from collections import ChainMap
from collections.abc import Mapping

from monitor.model.effects.added_mass import AddedMass
from monitor.model.effects.ambient_forces import AmbientForces
from monitor.model.effects.attached_oscillator import AttachedOscillator
from monitor.model.effects.base import (
    Condition,
    Context,
    Effect,
    EffectError,
    ExtraMode,
    FittedModel,
    Law,
    LawKind,
    Line,
    Peak,
    System,
    locations,
    place_index,
)
from monitor.model.effects.base_excitation import BaseExcitation
from monitor.model.effects.base_flexibility import BaseFlexibility
from monitor.model.effects.bilinear_stiffness import BilinearStiffness
from monitor.model.effects.channel_swap import ChannelSwap
from monitor.model.effects.clock_rate import ClockRate
from monitor.model.effects.coloured_excitation import ColouredExcitation
from monitor.model.effects.coulomb_friction import CoulombFriction
from monitor.model.effects.cubic_stiffness import CubicStiffness
from monitor.model.effects.gap_contact import GapContact
from monitor.model.effects.gravity_softening import GravitySoftening
from monitor.model.effects.harmonic_excitation import HarmonicExcitation
from monitor.model.effects.hysteretic_slip import HystereticSlip
from monitor.model.effects.joint_flexibility import JointFlexibility
from monitor.model.effects.parameter import Parameter
from monitor.model.effects.quadratic_damping import QuadraticDamping
from monitor.model.effects.report_face import FittedSizes, LawFamily, ParameterEstimates, interval, unit
from monitor.model.effects.sensor_clipping import SensorClipping
from monitor.model.effects.sensor_gain import SensorGain
from monitor.model.effects.sensor_noise import SensorNoise
from monitor.model.effects.sensor_polarity import SensorPolarity
from monitor.model.effects.sensor_rotation import SensorRotation
from monitor.model.effects.stiffness_change import StiffnessChange
from monitor.model.effects.story_damper import StoryDamper
from monitor.model.effects.temperature_stiffness import TemperatureStiffness
from monitor.model.effects.time_offset import TimeOffset
from monitor.model.effects.unmodelled_mode import UnmodelledMode

EFFECTS: dict[str, type[Effect]] = {
    effect.name: effect
    for effect in (
        StiffnessChange,
        AddedMass,
        TemperatureStiffness,
        CubicStiffness,
        GapContact,
        BilinearStiffness,
        CoulombFriction,
        QuadraticDamping,
        StoryDamper,
        BaseFlexibility,
        JointFlexibility,
        GravitySoftening,
        AttachedOscillator,
        HarmonicExcitation,
        ColouredExcitation,
        BaseExcitation,
        SensorGain,
        SensorPolarity,
        ChannelSwap,
        SensorRotation,
        TimeOffset,
        ClockRate,
        SensorClipping,
        SensorNoise,
        UnmodelledMode,
        HystereticSlip,
    )
}
"""Catalogue of the effects that a diagnosis looks for."""
CALIBRATION_EFFECTS: dict[str, type[Effect]] = {AmbientForces.name: AmbientForces}
"""Effects that are properties of a site, which calibration alone looks for."""
FORMS: Mapping[str, type[Effect]] = ChainMap(EFFECTS, CALIBRATION_EFFECTS)
"""Effects that a file may state: the catalogue, with whatever is added to it, and those that calibration alone looks for."""

__all__ = [
    "CALIBRATION_EFFECTS",
    "EFFECTS",
    "FORMS",
    "Condition",
    "Context",
    "Effect",
    "EffectError",
    "ExtraMode",
    "FittedModel",
    "FittedSizes",
    "Law",
    "LawFamily",
    "LawKind",
    "Line",
    "Parameter",
    "ParameterEstimates",
    "Peak",
    "System",
    "interval",
    "locations",
    "parse_effect",
    "place_index",
    "story_damage",
    "unit",
]


def story_damage(story: int | str, loss: float) -> Effect:
    """Return the effect that takes a share of a story's stiffness (0.2 = 20 %) away; stories count from 1, or are a place.

    Raises EffectError if the story or the loss is impossible.
    """
    place = story if isinstance(story, str) else f"story {story}"
    return StiffnessChange.create(place, {"relative": -loss})


def parse_effect(text: str) -> Effect:
    """Parse an effect written as ``NAME:LOCATION:PARAM=VALUE,...``, the command line's form.

    Raises EffectError if name, place or parameters are not the effect's.

    Examples
    --------
    >>> from monitor.model import parse_effect
    >>> parse_effect("stiffness_change:story 2:relative=-0.2")
    StiffnessChange(location='story 2', relative=-0.2)
    """
    name, _, rest = text.partition(":")
    location, _, assignments = rest.partition(":")
    if name not in FORMS:
        raise EffectError(f"unknown effect {name!r}; known: {', '.join(sorted(FORMS))}")
    values: dict[str, float] = {}
    for assignment in filter(None, assignments.split(",")):
        key, _, value = assignment.partition("=")
        try:
            values[key.strip()] = float(value)
        except ValueError:
            raise EffectError(f"effect {text!r}: {assignment!r} is not PARAM=VALUE") from None
    return FORMS[name].create(location.strip(), values)
