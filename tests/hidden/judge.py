"""Compares an answer with what was sealed."""

from __future__ import annotations

from typing import Any

UNIFORM = frozenset({("stiffness_change", "frame"), ("added_mass", "frame"), ("clock_rate", "frame")})
NONLINEAR = frozenset(
    {"cubic_stiffness", "gap_contact", "bilinear_stiffness", "coulomb_friction", "quadratic_damping", "hysteretic_slip"}
)
STRUCTURAL = NONLINEAR | {
    "stiffness_change", "added_mass", "temperature_stiffness", "story_damper", "base_flexibility", "joint_flexibility",
    "gravity_softening", "attached_oscillator", "unmodelled_mode",
}  # fmt: skip
"""What is said of the structure; the others are said of forces and sensors."""
REFIT = "refit"
"""Stands for the name of an effect where the stiffness of a story is compared."""
_NEAR = 0.02
"""Of the frequency of a true mode."""
_ABSENT = {("sensor_gain", "gain"): 1.0}
_LEAST = {"lag_s": 600.0}
"""Sizes below which an error counts relative to this."""

FAULT = "fault"
"""Stands for the name of an effect where a channel is said to be at fault in a way that no effect has."""

Key = tuple[str, str]


def key(item: dict[str, Any]) -> Key:
    """Effect and place."""
    return item["effect"], item["location"]


def tie(sealed: dict[str, Any], hidden: dict[str, Any]) -> frozenset[Key]:
    """Answers that no data can tell from this one; empty where it must be named."""
    weather_unseen = sealed["name"] == "warm_day"
    if key(hidden) in UNIFORM or (weather_unseen and hidden["effect"] == "temperature_stiffness"):
        return UNIFORM
    base = frozenset({("stiffness_change", sealed.get("lowest", "story 3")), ("base_flexibility", "base")})
    loss = hidden["parameters"].get("relative", -1.0) < 0.0
    return base if key(hidden) in base and loss else frozenset()


def outcome(sealed: dict[str, Any], answer: dict[str, Any]) -> str:
    """One word: ``right``, or what went wrong.

    ``among``: the truth is one of alternatives that the data could tell apart; ``certain``: a tie was named; ``part``: one of
    two; ``extra``: the truth and something more; ``place``: right effect, wrong place; ``wrong``: something else is
    named or listed, or a channel is held at fault that is not; ``missed``: none; ``unexplained``; ``crashed``; ``close``:
    outside the catalogue, but the neighbour is named.  Beside an artefact only what is said of the structure counts.  Without
    a baseline a mode that the structure file lacks may be named, and nothing else.
    """
    kind = sealed["kind"]
    if kind == "artefact":
        answer, kind = _of_structure(answer), "single" if sealed["hidden"] else "clean"
    verdict = answer["verdict"]
    found = [key(c) for c in answer["causes"]]
    offered = {key(a) for a in answer["alternatives"]}
    truth = [key(h) for h in sealed["hidden"]]
    if verdict == "crashed":
        return verdict
    if sealed["kind"] != "artefact" and blamed(answer) - set(truth):
        return "wrong"
    if kind == "clean":
        return {"none": "right", "named": "wrong"}.get(verdict, verdict)
    if kind == "uncalibrated":
        return "wrong" if false_causes(sealed, answer) else "unexplained" if verdict == "unexplained" else "right"
    if kind == "outside":
        if verdict in ("named", "ambiguous") and set(found) | offered <= set(truth):
            return "close"
        return {"unexplained": "right", "none": "missed", "named": "wrong"}.get(verdict, verdict)
    if verdict == "none":
        return "missed"
    if verdict == "unexplained":
        return "unexplained"
    ties = tie(sealed, sealed["hidden"][0]) if kind == "single" else frozenset()
    if verdict == "ambiguous":
        return _ambiguous(truth, found, offered, ties)
    if ties:
        return "certain" if set(found) <= ties | set(truth) else "wrong"
    if set(found) == set(truth):
        return "right"
    if set(truth) < set(found):
        return "extra"
    if found and set(found) < set(truth):
        return "part"
    return "place" if {e for e, _ in found} == {e for e, _ in truth} else "wrong"


def blamed(answer: dict[str, Any]) -> set[Key]:
    """The channels that are said to be at fault in a way that no effect has."""
    return {(FAULT, where) for where, _ in answer.get("left_over", ()) if where.startswith("channel ")}


def _ambiguous(truth: list[Key], found: list[Key], offered: set[Key], ties: frozenset[Key]) -> str:
    if ties:
        known = set(truth) if set(truth) <= ties else set(ties)
        return "right" if known & offered and not set(found) - known - ties else "wrong"
    if set(truth) <= set(found) | offered and not set(found) - set(truth):
        return "among"
    if set(truth) <= set(found):
        return "extra"
    return "wrong"


def _of_structure(answer: dict[str, Any]) -> dict[str, Any]:
    """The part of an answer that is said of the structure."""
    causes, alternatives = ([x for x in answer[k] if x["effect"] in STRUCTURAL] for k in ("causes", "alternatives"))
    verdict = "ambiguous" if alternatives else "named" if causes else "none"
    verdict = "crashed" if answer["verdict"] == "crashed" else verdict
    return {**answer, "verdict": verdict, "causes": causes, "alternatives": alternatives}


def _is_true_mode(sealed: dict[str, Any], cause: dict[str, Any]) -> bool:
    """Whether this is a mode of the structure that its file lacks; alternatives state no frequency."""
    if key(cause) != ("unmodelled_mode", "frame"):
        return False
    if "parameters" not in cause:
        return bool(sealed["modes_hz"])
    hz = cause["parameters"]["frequency_hz"]["value"]
    return any(abs(hz / true - 1.0) <= _NEAR for true in sealed["modes_hz"])


def false_causes(sealed: dict[str, Any], answer: dict[str, Any]) -> list[Key]:
    """Causes that are stated and are not so (nor their ties); without a baseline those that are listed, too."""
    if sealed["kind"] == "uncalibrated":
        return [key(c) for c in answer["causes"] + answer["alternatives"] if not _is_true_mode(sealed, c)]
    if sealed["kind"] == "artefact":
        answer = _of_structure(answer)
    allowed = {key(h) for h in sealed["hidden"]}
    for h in sealed["hidden"]:
        allowed |= tie(sealed, h)
    return [key(c) for c in answer["causes"] if key(c) not in allowed]


def sizes(sealed: dict[str, Any], answer: dict[str, Any]) -> list[dict[str, Any]]:
    """Every parameter of every cause that was found at its place: relative error, relative std, whether both hold.

    Without a baseline also the stiffness of every story, over the drawn one.
    """
    found = {key(c): c["parameters"] for c in answer["causes"]}
    rows = []
    for h in sealed["hidden"]:
        for name, true in h["parameters"].items() if key(h) in found else ():
            size = max(abs(true - _ABSENT.get((h["effect"], name), 0.0)), _LEAST.get(name, 0.0))
            rows.append(_size(h["effect"], name, true, found[key(h)][name], size))
    if answer["verdict"] in ("none", "named", "ambiguous"):
        pairs = zip(sealed.get("stories", ()), answer.get("stories", ()), strict=False)  # none with a baseline
        rows += [_size(REFIT, "story", true, fitted, true) for true, fitted in pairs]
    return rows


def _size(effect: str, parameter: str, true: float, found: dict[str, Any], size: float) -> dict[str, Any]:
    """One row: what was found beside the truth, in parts of `size`."""
    value, std = float(found["value"]), float(found["std"])
    error, relative = (value - true) / size, std / size
    allowed = max(0.10 if effect in NONLINEAR else 0.05, 2.0 * relative)
    return {
        "effect": effect,
        "parameter": parameter,
        "true": true,
        "value": value,
        "error": error,
        "std": relative,
        "right": abs(error) <= allowed,
        "covered": abs(error) <= 1.96 * relative,
    }
