"""Effects by name: what a structure file leaves out.  One file each; `Model` and the simulator use the same objects."""

from __future__ import annotations

from monitor.effects.base import Effect, EffectError
from monitor.effects.joint_flexibility import JointFlexibility
from monitor.effects.stiffness_change import StiffnessChange

EFFECTS: dict[str, type[Effect]] = {
    "stiffness_change": StiffnessChange,
    "joint_flexibility": JointFlexibility,
}

__all__ = ["EFFECTS", "Effect", "EffectError", "JointFlexibility", "StiffnessChange", "parse_effect"]


def parse_effect(text: str) -> Effect:
    """The effect written as ``NAME:LOCATION:PARAM=VALUE,...`` (the command line's form).

    Raises
    ------
    EffectError
        If name, place or parameters are not the effect's.
    """
    name, _, rest = text.partition(":")
    location, _, assignments = rest.partition(":")
    if name not in EFFECTS:
        raise EffectError(f"unknown effect {name!r}; known: {', '.join(sorted(EFFECTS))}")
    values: dict[str, float] = {}
    for assignment in filter(None, assignments.split(",")):
        key, _, value = assignment.partition("=")
        try:
            values[key.strip()] = float(value)
        except ValueError:
            raise EffectError(f"effect {text!r}: {assignment!r} is not PARAM=VALUE") from None
    return EFFECTS[name].create(location.strip(), values)
