"""Comparison of two recordings, or of two folders of results: whether they differ by more than chance allows, and in what.

Both sides are cut into equal blocks, longer than ten decay times of the lowest mode, so that what one block holds is not what is
left of the motion in another.  Whether they differ is one test, by permuted labels of the blocks, of the distance between their
spectral shapes (of folders: between their modes and damage indices).  In what they differ is told by intervals from the scatter
of what is found when one block after the other is left out.  What records of one state do from day to day, no block of two
records shows: healthy records of other days show it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from monitor.core import Array, BadInputError, OnProgress, Step
from monitor.identification import Scatter, least_chance, permute
from monitor.runs.compare_sides import (
    Mode,
    Recorded,
    Results,
    Side,
    describe_recordings,
    describe_results,
    match,
)
from monitor.runs.look import in_columns, mac
from monitor.runs.readers import Options, are_recordings
from monitor.runs.recordings import OnWarning

_FALSE_RATE = 0.05
"""Probability that two of one state are told to differ; and, of what differs, that chance makes any one thing
significant. [1; convention]"""
_DECAYS = 10.0
"""Length of a block, in decay times of the lowest mode, at least. [1; definition: e^-10 of a block's motion reaches the next]"""
_BLOCKS = next(n for n in range(2, 99) if least_chance(n, n) <= _FALSE_RATE)
"""Blocks into which the shorter side is cut. [count; definition: the fewest whose permutations reach the rate, so that each holds
as much as it can of what drifts within a record]"""
_LEAST_HEALTHY = 3
"""Healthy records from which their scatter is known. [count; definition: one is left out, and two have a scatter]"""


@dataclass(frozen=True, eq=False, slots=True)
class _Answer:
    """Whether the sides differ."""

    chance: float | None
    """How often equals differ as much; None where that cannot be said."""
    reason: str = ""
    """Why it cannot."""

    @property
    def differs(self) -> bool | None:
        return None if self.chance is None else self.chance <= _FALSE_RATE


@dataclass(frozen=True, eq=False, slots=True)
class _Cut:
    """A side, and what is found of it without each of its blocks."""

    side: Side
    left_out: list[dict[int, Mode]]
    """Modes by the number of the same mode of the whole, one entry a block that is left out."""


def compare(
    first: Path,
    second: Path,
    options: Options = Options(),  # noqa: B008 - frozen
    *,
    healthy: Sequence[Path] = (),
    on_warning: OnWarning = lambda _: None,
    on_progress: OnProgress = lambda _: None,
) -> dict[str, Any]:
    """Compare two recordings, or files that `import` reads by `options`, or two folders of results.

    `healthy` are more of the same kind, from other days of one state.

    The content names both, and holds the answer `differs` (None where it cannot be said: `cannot_say`), the tests of what
    differs with their z-scores and the limits of a significant one, and the modes of one side alone.  Raises BadInputError or
    MissingInputError if one cannot be used, or if one is a recording and another a folder.
    """
    paths = [first, second, *healthy]
    if len({path.is_dir() for path in paths}) > 1:
        raise BadInputError(f"{', '.join(map(str, paths))}: compare two recordings, or two folders of results")
    if first.is_dir() and (given := options.given()):
        raise BadInputError(f"{first}: is a folder of results: leave {', '.join(given)} out")
    ready = {path: are_recordings([path]) for path in paths if not path.is_dir()}
    of_files = {
        path: Options() if is_ready and not all(ready.values()) else options for path, is_ready in ready.items()
    }
    sides: list[Side] = [
        Results.read(path)
        if path.is_dir()
        else Recorded.read(path, of_files[path], on_warning, partial(_tell_of, path, on_progress))
        for path in paths
    ]
    for path, side in zip(paths[1:], sides[1:], strict=True):
        if side.channels != sides[0].channels:
            raise BadInputError(
                f"{first} has the channels {', '.join(sides[0].channels)}, {path} has {', '.join(side.channels)}: compare what "
                "the same sensors measured"
            )
    block_s = _block_s(sides)
    blocks = [side.cut(block_s) for side in sides]
    matches = [match(sides[0].modes, side.modes) for side in sides[1:]]
    pairs = matches[0]
    answer = _answer(sides, blocks, matches, block_s)
    tests, levels = _tests(sides, blocks, matches)
    dof = len(healthy) - 1 if healthy else len(blocks[0]) + len(blocks[1]) - 2
    limit, level_limit = _limit(tests, dof), _limit(levels, dof)
    for test in tests:
        test["significant"] = bool(answer.differs and abs(test["z"]) > limit)
    for test in levels:
        test["significant"] = bool(answer.differs is not None and abs(test["z"]) > level_limit)
    content = {
        "a": sides[0].name,
        "b": sides[1].name,
        "healthy": [side.name for side in sides[2:]],
        "differs": answer.differs,
        "chance": answer.chance,
        "rate": _FALSE_RATE,
        "cannot_say": answer.reason,
        "blocks": {"length_s": block_s, "a": len(blocks[0]), "b": len(blocks[1])},
        "tests": tests + levels,
        "limit": limit,
        "level_limit": level_limit,
        "only_in_a_hz": [mode.frequency_hz for i, mode in enumerate(sides[0].modes) if i not in pairs],
        "only_in_b_hz": [mode.frequency_hz for j, mode in enumerate(sides[1].modes) if j not in pairs.values()],
        "without_modes": [side.without_modes for side in sides[:2] if side.without_modes],
        "significant": sum(test["significant"] for test in tests + levels),
    }
    return content | {"answer": _sentence(content)}


def _tests(
    sides: Sequence[Side], blocks: Sequence[list[Any]], matches: Sequence[dict[int, int]]
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Test what A and B both have: modes and damage indices, and levels."""
    a, b = (_Cut(side, side.left_out(own)) for side, own in zip(sides[:2], blocks[:2], strict=True))
    between = partial(_between, matches[1:], sides[2:])
    tests = [
        one
        for number, (i, j) in enumerate(sorted(matches[0].items()), start=1)
        for one in _mode_tests(f"mode {number}: ", a, b, i, j, between)
    ]
    if not all(blocks):
        return tests, []
    tests += _value_tests("index", "", *(side.indices(own) for side, own in zip(sides, blocks, strict=True)))
    return tests, _value_tests("level", "dB", *(side.powers(own) for side, own in zip(sides, blocks, strict=True)))


def _tell_of(path: Path, on_progress: OnProgress, step: Step) -> None:
    """Tell a step with the name of its side."""
    on_progress(step._replace(does=f"{path.name}: {step.does}"))


def _block_s(sides: Sequence[Side]) -> float:
    """Choose the length of the blocks: the longest of which each side holds enough.

    Where blocks are permuted it is no less than ten decay times of the lowest mode, the longer one of A and B.  Beside healthy
    records each record counts as a whole.
    """

    def longest(lengths_s: Sequence[float]) -> float:
        lengths = (length / k for length in lengths_s for k in range(1, _BLOCKS + 1))
        return max(s for s in lengths if sum(int(length / s + 1e-9) for length in lengths_s) >= _BLOCKS)

    decay_s = max(side.decay_s for side in sides) if len(sides) == 2 else 0.0
    return max(_DECAYS * decay_s, min(longest(side.lengths_s) for side in sides))


def _thinned(blocks: Sequence[Any], most: int) -> list[Any]:
    """Take so many blocks at most, evenly."""
    return [blocks[k * len(blocks) // most] for k in range(most)] if len(blocks) > most else list(blocks)


def _describe(sides: Sequence[Any], blocks: Sequence[Any], matches: Sequence[dict[int, int]]) -> list[Array]:
    """Describe all blocks, side by side."""
    if isinstance(sides[0], Recorded):
        return describe_recordings(sides, blocks)
    chosen = [i for i in range(len(sides[0].modes)) if all(i in one for one in matches)]
    return describe_results(sides, blocks, [chosen, *([one[i] for i in chosen] for one in matches)])


def _answer(
    sides: Sequence[Side], blocks: Sequence[Sequence[Any]], matches: Sequence[dict[int, int]], block_s: float
) -> _Answer:
    """Answer whether A and B differ, by the scatter between their blocks or, where there are healthy records, between those."""
    counts = [len(own) for own in blocks]
    n_healthy = len(blocks) - 2
    enough = 1 if n_healthy else _BLOCKS
    if min(counts) < 1 or (not n_healthy and least_chance(*counts) > _FALSE_RATE):
        return _Answer(
            None,
            f"{' and '.join(map(str, counts))} blocks of {block_s:.3g} s are too few for {100.0 * _FALSE_RATE:g} %; record "
            f"{enough * block_s:.3g} s or more of each",
        )
    if 0 < n_healthy < _LEAST_HEALTHY:
        return _Answer(None, f"{n_healthy} healthy records show no scatter; give {_LEAST_HEALTHY} or more")
    # As many of each record beside healthy ones; else of the longer side no more than still add to the answer.
    most = min(counts) if n_healthy else 2 * _BLOCKS
    parts = _describe(sides, [_thinned(own, most) for own in blocks], matches)
    if not parts:
        return _Answer(None, "no mode is found on both sides")
    if not n_healthy:
        return _Answer(permute(parts, min(counts[0], most)))
    means = np.concatenate(parts, axis=1).reshape(len(sides), most, -1).mean(axis=1) * np.sqrt(most)
    return _Answer(Scatter.of(means[2:]).chance(means[1], means[0]))


def _std(left_out: Annotated[Array, "k"]) -> float:
    """Compute the standard deviation of an estimate from those without one block each (jackknife)."""
    k = len(left_out)
    return float(np.sqrt((k - 1.0) * left_out.var())) if k > 1 else float("nan")


def _between(matches: Sequence[dict[int, int]], sides: Sequence[Side], i: int, value: Callable[[Mode], float]) -> float:
    """Compute the standard deviation of a value of A's mode i between the healthy sides; 0 where fewer than two have it."""
    found = [value(side.modes[one[i]]) for one, side in zip(matches, sides, strict=True) if i in one]
    return float(np.std(found, ddof=1)) if len(found) > 1 else 0.0


def _test(
    kind: str, name: str, unit: str, a: tuple[float, float], b: tuple[float, float], between: float
) -> dict[str, Any]:
    """Form the record of a test of two values with their standard deviations, or with that of one value between records."""
    change, std = b[0] - a[0], max(float(np.hypot(a[1], b[1])), np.sqrt(2.0) * between, 1e-300)
    relative = change / a[0] if kind in ("frequency", "damping") else None
    return {
        "kind": kind,
        "what": name,
        "unit": unit,
        "a": a[0],
        "b": b[0],
        "change": change,
        "change_std": std,
        "relative": relative,
        "z": change / std,
    }


def _mode_tests(
    name: str, a: _Cut, b: _Cut, i: int, j: int, between: Callable[[int, Callable[[Mode], float]], float]
) -> list[dict[str, Any]]:
    """Test frequency, damping and shape of mode i of A, which is mode j of B; nothing that has no interval."""
    gauge = int(np.abs(a.side.modes[i].shape).argmax())  # all shapes are scaled at the same channel
    free = [k for k in range(len(a.side.modes[i].shape)) if k != gauge]

    def told(kind: str, what: str, unit: str, value: Callable[[Mode], float]) -> dict[str, Any]:
        sides = [
            (value(cut.side.modes[k]), _std(np.array([value(one[k]) for one in cut.left_out if k in one])))
            for cut, k in ((a, i), (b, j))
        ]
        return _test(kind, name + what, unit, sides[0], sides[1], between(i, value))

    out = [
        told("frequency", "frequency", "Hz", lambda mode: mode.frequency_hz),
        told("damping", "damping ratio", "", lambda mode: mode.damping_ratio),
    ]
    components = [told("shape", "shape (MAC)", "", partial(_component, k, gauge)) for k in free]
    if components:
        most = max(components, key=lambda test: abs(test["z"]) if np.isfinite(test["z"]) else -1.0)
        likeness = mac(a.side.modes[i].shape, b.side.modes[j].shape)
        out.append(
            most | {"a": 1.0, "b": likeness, "change": likeness - 1.0, "change_std": None, "of": len(components)}
        )
    return [test for test in out if np.isfinite(test["z"])]


def _component(channel: int, gauge: int, mode: Mode) -> float:
    """Compute a component of a mode's shape, whose component at the gauge is 1."""
    return float((mode.shape[channel] / mode.shape[gauge]).real)


def _value_tests(
    kind: str, unit: str, a: dict[str, Array], b: dict[str, Array], *healthy: dict[str, Array]
) -> list[dict[str, Any]]:
    """Test values that each block has, by the scatter between blocks or healthy sides; levels, which are powers, in dB."""

    def mean(values: Array) -> float:
        return float(10.0 * np.log10(values.mean())) if kind == "level" else float(values.mean())

    def of(values: Array) -> tuple[float, float]:
        left_out = [mean(np.delete(values, k)) for k in range(len(values))] if len(values) > 1 else []
        return mean(values), _std(np.array(left_out))

    tests = []
    for name in (name for name in a if name in b):
        others = [mean(one[name]) for one in healthy if name in one]
        between = float(np.std(others, ddof=1)) if len(others) > 1 else 0.0
        tests.append(_test(kind, name, unit, of(a[name]), of(b[name]), between))
    return [test for test in tests if np.isfinite(test["z"])]


def _limit(tests: Sequence[dict[str, Any]], dof: int) -> float:
    """Compute the z-score that any one of the tests exceeds by chance at the stated rate (Student's t, Bonferroni)."""
    from scipy.special import stdtrit  # takes a while to load

    count = max(1, sum(test.get("of", 1) for test in tests))
    return float(stdtrit(max(1, dof), 1.0 - _FALSE_RATE / (2.0 * count)))


def _sentence(content: dict[str, Any]) -> str:
    """Say the answer in one sentence."""
    beyond = "the scatter between the healthy records" if content["healthy"] else "the scatter within the records"
    if content["differs"] is None:
        return f"cannot say whether they differ: {content['cannot_say']}"
    chance = (
        f"of equals {100.0 * content['chance']:.2g} % differ as much, at most {100.0 * content['rate']:g} % are told to"
    )
    if not content["differs"]:
        return f"no difference beyond {beyond} ({chance})"
    moved = [test["what"] for test in content["tests"] if test["significant"] and test["kind"] != "level"]
    what = ", ".join(moved) or "the spectrum's shape changed; no mode's change tells how"
    return f"they differ beyond {beyond} ({chance}): {what}"


def in_words(content: dict[str, Any]) -> str:
    """Write the result of `compare` for a terminal: the answer last."""
    rows = [["", "A", "B", "B - A", "z", ""]]
    for test in content["tests"]:
        if test["kind"] == "level" and not test["significant"]:
            continue
        change = f"{100.0 * test['relative']:+.2f} %" if test["relative"] is not None else f"{test['change']:+.3g}"
        unit = f", {test['unit']}" if test["unit"] else ""
        said = "beyond chance" if test["significant"] else ""
        rows.append(
            [f"{test['what']}{unit}", f"{test['a']:.5g}", f"{test['b']:.5g}", change, f"{test['z']:+.1f}", said]
        )
    lines = [f"A: {content['a']}", f"B: {content['b']}", *in_columns(rows)]
    for side in ("a", "b"):
        if content[f"only_in_{side}_hz"]:
            found = ", ".join(f"{f:.4g} Hz" for f in content[f"only_in_{side}_hz"])
            lines.append(f"only in {side.upper()}: modes at {found}")
    lines += [f"no modes: {reason}" for reason in content["without_modes"]]
    blocks = content["blocks"]
    lines.append(
        f"{blocks['a']} and {blocks['b']} blocks of {blocks['length_s']:.3g} s; beyond chance is |z| > {content['limit']:.1f}, "
        f"of levels {content['level_limit']:.1f}. Levels follow the excitation and are no part of the answer; temperature "
        "moves frequencies."
    )
    return "\n".join([*lines, content["answer"]])
