"""Effects in words: what each means for whom must act, with its size and interval, and what would tell rivals apart."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import floor, isfinite, log10
from typing import Any

from monitor.diagnosis.stepwise_selection import Diagnosis
from monitor.model import ModelDiscrepancy, StructuralPrior

Values = Mapping[str, Mapping[str, float]]
"""Parameter name -> ``value`` and ``std``, as in diagnosis.json."""

_UNITS = (
    ("_n_s2_per_m2", "N s²/m²"),
    ("_n_s_per_m", "N s/m"),
    ("_n_per_m3", "N/m³"),
    ("_n_per_m", "N/m"),
    ("_m_s2", "m/s²"),
    ("_kg", "kg"),
    ("_hz", "Hz"),
    ("_m", "m"),
    ("_n", "N"),
    ("_s", "s"),
    ("seconds", "s"),
    ("per_degc", "1/K"),
)

_CHECKS = {
    "added_mass": "weigh what stands on the floors, or add a known mass and record again",
    "temperature_stiffness": "record the temperature along with the acceleration, through a warm and a cold spell",
    "cubic_stiffness": "record at a vibration level two or three times as high, with a displacement sensor across the story",
    "gap_contact": "read the story's drift with a displacement sensor: a stop lets one sign go less far than the other",
    "bilinear_stiffness": "push the story both ways with a known force: an open crack is softer one way",
    "coulomb_friction": "record at vibration levels a factor of three apart: friction loses weight as the level grows",
    "quadratic_damping": "record at vibration levels a factor of three apart: drag gains weight as the level grows",
    "story_damper": "record at vibration levels a factor of three apart: a viscous damper acts alike at all of them",
    "base_flexibility": "put an accelerometer on the ground or footing: a soft base lets the footing move",
    "joint_flexibility": "measure the rotation of a joint with an inclinometer or a gyroscope",
    "gravity_softening": "work out the weight above every story over its height: theory fixes the size of this effect",
    "attached_oscillator": "put an accelerometer on what hangs on the floor, or hold it and record again",
    "harmonic_excitation": "switch off the machines nearby and record again",
    "coloured_excitation": "record under another excitation, such as another wind or taps with a hammer",
    "base_excitation": "put an accelerometer on the ground",
    "sensor_gain": "put two sensors side by side on one floor, or turn the sensor over and read twice gravity",
    "sensor_polarity": "look at how the sensor is mounted, or tilt it and read gravity's sign",
    "channel_swap": "tap on one floor and see which channel answers first",
    "time_offset": "give all channels one pulse at once, or put two sensors side by side",
    "clock_rate": "compare the sampling clock with a second clock, or with a line of known frequency such as the mains",
    "sensor_clipping": "set the sensor to a wider range and record again",
    "sensor_noise": "record the sensor on a block that stands still",
}
"""For each rival but a change of stiffness, which is never asked for: see `separating_measurement`."""


def unit(parameter: str) -> str:
    """Unit of a parameter, from its name's suffix; empty where it is a ratio."""
    return next((text for suffix, text in _UNITS if parameter.endswith(suffix)), "")


def interval(entry: Mapping[str, float], scale: float = 1.0, unit: str = "") -> str:
    """A value with two standard deviations either side, as many digits as these allow."""
    value, half = entry["value"] * scale, 2.0 * abs(entry["std"] * scale)
    unit = f" {unit}" if unit else ""
    if not isfinite(half) or half > 1e100 or half > 1e3 * abs(value) > 0.0:
        rough = f"{value:.2g}" if abs(value) < 10.0 or abs(value) >= 1e5 else f"{float(f'{value:.2g}'):.0f}"
        return f"about {rough}{unit} (hardly determined)"
    size = max(abs(value), half)
    tens = floor(log10(size)) if size > 0.0 else 0
    tens = tens if tens >= 5 or tens < -3 else 0
    value, half = value / 10.0**tens, half / 10.0**tens
    digits = min(1 - floor(log10(half)), 9) if half > 0.0 else 3
    shown = max(digits, 0)
    text = f"{round(value, digits):.{shown}f} ± {round(half, digits):.{shown}f}" if half > 0.0 else f"{value:.6g}"
    if tens:
        return f"({text})·10{str(tens).translate(str.maketrans('-0123456789', '⁻⁰¹²³⁴⁵⁶⁷⁸⁹'))}{unit}"
    return text + unit


def _magnitude(entry: Mapping[str, float], scale: float, unit: str) -> str:
    return interval({"value": abs(entry["value"]), "std": entry["std"]}, scale, unit)


def _percent(entry: Mapping[str, float]) -> str:
    """The magnitude of a share."""
    return _magnitude(entry, 100.0, "%")


def in_words(effect_name: str, location: str, parameters: Values, reference: StructuralPrior) -> str:
    """One sentence, without its full stop, on an effect and its size; intervals are two standard deviations.

    Parameters
    ----------
    effect_name, location, parameters
        As in diagnosis.json.
    reference : StructuralPrior
        What "more" and "less" refer to.

    Raises
    ------
    KeyError
        If the effect is unknown or a parameter is missing.
    """
    p = {name: interval(entry, 1.0, unit(name)) for name, entry in parameters.items()}
    value = {name: entry["value"] for name, entry in parameters.items()}
    since = "at calibration" if reference.basis.shape[0] else "the structure file says"
    which = location.partition(" ")[2]
    masses, stiffness = reference.model.structure.masses_kg, reference.model.structure.stiffness_n_per_m
    of_floor = ""
    if location.startswith("floor") and "mass_kg" in value:
        of_floor = f" ({100.0 * value['mass_kg'] / masses[int(which) - 1]:.1f} % of the floor's mass)"
    everywhere = location == "frame"
    match effect_name:
        case "stiffness_change":
            change = "softer" if value["relative"] < 0 else "stiffer"
            subject = "all stories are" if everywhere else f"{location} is"
            return f"{subject} {_percent(parameters['relative'])} {change} than {since}"
        case "added_mass" if everywhere:
            return f"all floors are {_percent(parameters['relative'])} heavier than {since}"
        case "added_mass":
            return f"{location} carries {p['mass_kg']} more than {since}{of_floor}"
        case "temperature_stiffness":
            trend = "loses" if value["per_degc"] < 0 else "gains"
            late = f", {p['lag_s']} late" if value["lag_s"] > 0 else ""
            return f"the frame {trend} {_percent(parameters['per_degc'])} of its stiffness per K of warming{late}"
        case "cubic_stiffness":
            trend = "softens" if value["k3_n_per_m3"] < 0 else "hardens"
            return f"{location} {trend} as its drift grows: cubic stiffness {p['k3_n_per_m3']}"
        case "gap_contact":
            sign = "positive" if value["gap_m"] > 0 else "negative"
            gap = interval({**parameters["gap_m"], "value": abs(value["gap_m"])}, 1e3, "mm")
            return f"{location} meets a stop after {gap} of {sign} drift, worth {p['contact_stiffness_n_per_m']}"
        case "bilinear_stiffness":
            return f"{location} is {_percent(parameters['relative_drop'])} softer for positive drift than for negative"
        case "coulomb_friction":
            return f"{location} rubs: dry friction of {p['friction_force_n']}"
        case "quadratic_damping":
            return f"{location} feels a drag that grows as its velocity squared, {p['coefficient_n_s2_per_m2']}"
        case "story_damper":
            return f"{location} has {p['damping_n_s_per_m']} more damping than {since}"
        case "base_flexibility":
            lost = 100.0 * stiffness[-1] / (stiffness[-1] + value["stiffness_n_per_m"])
            text = f"the base gives way like a spring of {p['stiffness_n_per_m']}"
            return f"{text}, which takes {lost:.1f} % from the lowest story"
        case "joint_flexibility":
            return f"the joints rotate: girders are {p['girder_to_column_ratio']} times as stiff as columns"
        case "gravity_softening":
            return (
                f"weight softens the stories by {p['factor']} times weight over height (theory: 1.2, clamped columns)"
            )
        case "attached_oscillator":
            swings = f"swings by itself at {p['frequency_hz']} with {_percent(parameters['damping_ratio'])} damping"
            return f"something of {p['mass_kg']}{of_floor} on {location} {swings}"
        case "harmonic_excitation":
            return f"a machine drives {location} at {p['frequency_hz']} with {p['force_n']}"
        case "coloured_excitation":
            return f"the excitation is not white: its power falls off above {p['corner_hz']}"
        case "ambient_forces":
            alike = parameters["common_share"]
            together = f", and {_percent(alike)} of it pushes all floors at once" * (
                alike["value"] > 2.0 * alike["std"]
            )
            return f"the excitation is not white, but of a smooth spectrum{together}"
        case "base_excitation":
            return f"the ground moves: it causes {_percent(parameters['share'])} of the acceleration's variance"
        case "sensor_gain":
            trend = "too much" if value["gain"] > 1 else "too little"
            excess = {"value": value["gain"] - 1.0, "std": parameters["gain"]["std"]}
            return f"{location} reads {_percent(excess)} {trend}"
        case "sensor_polarity":
            return f"{location} is upside down: its sign is reversed"
        case "channel_swap":
            return f"channels {which.replace(',', ' and ')} are swapped"
        case "time_offset":
            trend = "late" if value["seconds"] > 0 else "early"
            return f"{location} comes {_magnitude(parameters['seconds'], 1e3, 'ms')} {trend}"
        case "clock_rate":
            trend = "faster" if value["relative"] > 0 else "slower"
            return f"the sampling clock runs {_percent(parameters['relative'])} {trend} than its nominal rate"
        case "sensor_clipping":
            return f"{location} is cut off at ± {p['limit_m_s2']}"
        case "sensor_noise":
            return f"{location} has {p['rms_m_s2']} RMS of noise beyond what all channels have"
    raise KeyError(effect_name)


def separating_measurement(alternatives: Sequence[Mapping[str, Any]]) -> str | None:
    """What to measure to tell alternatives apart, None where there is nothing to tell apart.

    Parameters
    ----------
    alternatives
        With ``effect`` and ``location``, as in diagnosis.json.
    """
    if len(alternatives) < 2:
        return None
    effects = list(dict.fromkeys(a["effect"] for a in alternatives))
    if len(effects) == 1:
        return "a longer recording, or one more sensor between " + " and ".join(a["location"] for a in alternatives)
    # All rivals but one need a check of their own, and a static test is the dearest.
    checks = [_CHECKS[e] for e in effects if e != "stiffness_change"]
    return "; ".join(dict.fromkeys(checks))


def contradicted(error: ModelDiscrepancy) -> str:
    """What calibration left unexplained, without a full stop."""
    where = ", ".join(f"{low:.1f}-{high:.1f}" for low, high in error.doubtful_hz())
    return f"at {where} Hz no known effect explains the healthy data either, so what is seen there counts less"


def headline(diagnosis: Diagnosis, content: Mapping[str, Any]) -> str:
    """The verdict in one plain sentence.

    Parameters
    ----------
    content : mapping
        diagnosis.json.
    """
    reference = diagnosis.problem.prior
    told = [in_words(c["effect"], c["location"], c["parameters"], reference) for c in content["causes"]]
    match content["verdict"]:
        case "none":
            if content["standing_misfit"] is not None:
                return "Nothing new: these data differ from the simulation no more than the healthy ones."
            return "Nothing wrong: the simulation explains these data."
        case "named":
            return _sentence("; and ".join(told))
        case "ambiguous":
            rivals = "; or ".join(
                f"{in_words(a['effect'], a['location'], a['parameters'], reference)} ({100 * a['probability']:.0f} %)"
                for a in content["alternatives"]
            )
            certain = "; and ".join(told)
            return _sentence((f"{certain}; besides, " if told else "") + f"these data cannot tell which: {rivals}")
    worst = ""
    if diagnosis.left_over:
        where = diagnosis.left_over[0].where
        worst = (
            f" at {where.removeprefix('f = ')}"
            if where.startswith("f = ")
            else f" with what stood at calibration, {where},"
        )
    known = f" Besides, {'; and '.join(told)}." if told else ""
    return f"Something is wrong{worst} that no known effect explains.{known}"


def _sentence(text: str) -> str:
    return text[0].upper() + text[1:] + "."
