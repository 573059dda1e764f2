"""Comparison of two recordings, or of two folders of results: what differs by more than chance allows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import NormalDist
from typing import Annotated, Any

import numpy as np

from monitor.core import Array, BadInputError, ComplexArray, MissingInputError, OnProgress, Step, os_errors_of
from monitor.identification import SelectionSettings
from monitor.publish import LookedRecording, read_line, read_lines
from monitor.runs.look import in_columns, look, mac
from monitor.runs.readers import Options, are_recordings
from monitor.runs.recordings import OnWarning
from monitor.signals import overlap_correlation

_FALSE_RATE = 0.05
"""Probability that chance makes a difference significant in a comparison of equals, all its tests together. [1; convention]"""
_LEAST_LOOKS = 4.0
"""Windows without common data from which their scatter is taken for the uncertainty. [count; judgement]"""
_RESULTS = "results.jsonl"
"""File of a folder of results. [name; definition]"""
_OF_MODES = ("frequencies_hz", "frequencies_std_hz", "damping_ratio", "damping_std", "mode_shapes")
"""Keys of a line that have an entry a mode. [names; contract of results.jsonl]"""


@dataclass(frozen=True, eq=False, slots=True)
class _Mode:
    """Mode of one side."""

    frequency_hz: float
    frequency_std_hz: float
    damping_ratio: float
    damping_std: float
    shape: Annotated[ComplexArray, "c"]
    shape_std: Annotated[Array, "c"] | None
    """None where not known."""


@dataclass(frozen=True, eq=False, slots=True)
class _Side:
    """What is compared of one recording or folder."""

    name: str
    channels: tuple[str, ...]
    """Empty where the results do not name them."""
    modes: tuple[_Mode, ...]
    levels: dict[str, tuple[float, float]]
    """RMS in dB of 1 m/s^2, with its standard deviation, of each channel and band."""
    index: dict[str, tuple[float, float]]
    """Damage index of each story, with its standard deviation."""


def compare(
    first: Path,
    second: Path,
    options: Options = Options(),  # noqa: B008 - frozen
    *,
    on_warning: OnWarning = lambda _: None,
    on_progress: OnProgress = lambda _: None,
) -> dict[str, Any]:
    """Compare two recordings, or files that `import` reads by `options`, or two folders of results.

    The content names both, and holds the tests with their z-scores, the modes of one side alone, and the limit of a significant
    z-score (Bonferroni).  Raises BadInputError or MissingInputError if one cannot be used, or if one is a recording and the
    other a folder.
    """
    if first.is_dir() != second.is_dir():
        raise BadInputError(f"{first} and {second}: compare two recordings, or two folders of results")
    if first.is_dir():
        if given := options.given():
            raise BadInputError(f"{first}: is a folder of results: leave {', '.join(given)} out")
        sides = [_of_results(path) for path in (first, second)]
    else:
        ready = {path: are_recordings([path]) for path in (first, second)}
        sides = []
        for path in (first, second):
            of_file = Options() if ready[path] and not all(ready.values()) else options
            tell = partial(_tell_of, path, on_progress)
            sides.append(_of_recording(path, look([path], of_file, on_warning=on_warning, on_progress=tell)))
    a, b = sides
    if a.channels != b.channels:
        raise BadInputError(
            f"{first} has the channels {', '.join(a.channels)}, {second} has {', '.join(b.channels)}: compare what the same "
            "sensors measured"
        )
    pairs, only_a, only_b = _match(a.modes, b.modes)
    tests = [one for number, (i, j) in enumerate(pairs, start=1) for one in _mode_tests(number, a.modes[i], b.modes[j])]
    for kind, unit, of_a, of_b in (("level", "dB", a.levels, b.levels), ("index", "", a.index, b.index)):
        tests += [
            _test(kind, name, unit, of_a[name], of_b[name])
            for name in of_a
            if name in of_b and np.isfinite([*of_a[name], *of_b[name]]).all()
        ]
    limit = NormalDist().inv_cdf(1.0 - _FALSE_RATE / (2.0 * max(1, len(tests))))
    for test in tests:
        test["significant"] = bool(abs(test["z"]) > limit)
    return {
        "a": a.name,
        "b": b.name,
        "tests": tests,
        "limit": limit,
        "only_in_a_hz": [a.modes[i].frequency_hz for i in only_a],
        "only_in_b_hz": [b.modes[j].frequency_hz for j in only_b],
        "significant": sum(test["significant"] for test in tests),
    }


def _tell_of(path: Path, on_progress: OnProgress, step: Step) -> None:
    """Tell a step with the name of its side."""
    on_progress(step._replace(does=f"{path.name}: {step.does}"))


def in_words(content: dict[str, Any]) -> str:
    """Write the result of `compare` for a terminal."""
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
    lines.append(
        f"{content['significant']} of {len(content['tests'])} differ beyond chance: |z| > {content['limit']:.1f}, at which "
        f"{100 * _FALSE_RATE:g} % of comparisons of equals show any difference. Levels follow the excitation; temperature moves "
        "frequencies."
    )
    return "\n".join(lines)


def _test(kind: str, name: str, unit: str, a: tuple[float, float], b: tuple[float, float]) -> dict[str, Any]:
    """Form the record of a test of two values with their standard deviations."""
    change, std = b[0] - a[0], max(float(np.hypot(a[1], b[1])), 1e-300)
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


def _mode_tests(number: int, a: _Mode, b: _Mode) -> list[dict[str, Any]]:
    """Test frequency, damping and shape of a mode."""
    out = []
    f = (a.frequency_hz, a.frequency_std_hz), (b.frequency_hz, b.frequency_std_hz)
    d = (a.damping_ratio, a.damping_std), (b.damping_ratio, b.damping_std)
    if np.isfinite(f).all():
        out.append(_test("frequency", f"mode {number}: frequency", "Hz", *f))
    if np.isfinite(d).all():
        out.append(_test("damping", f"mode {number}: damping ratio", "", *d))
    if a.shape_std is None or b.shape_std is None or len(a.shape) < 2:
        return out
    from scipy.special import gammaincc, ndtri  # takes a while to load

    gauge = int(np.abs(a.shape).argmax())  # both are scaled at the same channel
    scaled = b.shape / b.shape[gauge]
    b_std = b.shape_std / abs(b.shape[gauge])
    variance = a.shape_std**2 + b_std**2 + (scaled.real * b_std[gauge]) ** 2
    free = np.arange(len(a.shape)) != gauge
    chi2 = float((((scaled.real - a.shape.real) ** 2)[free] / np.maximum(variance[free], 1e-300)).sum())
    chance = float(gammaincc(0.5 * free.sum(), 0.5 * chi2))
    test = _test("shape", f"mode {number}: shape (MAC)", "", (1.0, 0.0), (mac(a.shape, b.shape), 0.0))
    return [*out, test | {"change_std": None, "z": float(-ndtri(max(0.5 * chance, 1e-300)))}]


def _match(a: Sequence[_Mode], b: Sequence[_Mode]) -> tuple[list[tuple[int, int]], list[int], list[int]]:
    """Match the modes of two sides by frequency and shape; return pairs, and what is on one side alone."""
    from scipy.optimize import linear_sum_assignment  # takes a third of a second to load

    select, impossible = SelectionSettings(), 1e3
    cost = np.full((len(a), len(b)), impossible)
    for i, one in enumerate(a):
        for j, other in enumerate(b):
            distance = abs(np.log(other.frequency_hz / one.frequency_hz)) / np.log(select.max_frequency_ratio)
            likeness = mac(one.shape, other.shape)
            if distance <= 1.0 and likeness >= select.min_model_mac:
                cost[i, j] = distance + (1.0 - likeness)
    pairs = [(int(i), int(j)) for i, j in zip(*linear_sum_assignment(cost), strict=True) if cost[i, j] < impossible]
    return (
        pairs,
        [i for i in range(len(a)) if i not in {p[0] for p in pairs}],
        [j for j in range(len(b)) if j not in {p[1] for p in pairs}],
    )


def _of_recording(path: Path, found: LookedRecording) -> _Side:
    modes = tuple(
        _Mode(m.frequency_hz, m.frequency_std_hz, m.damping_ratio, m.damping_std, m.shape, m.shape_std)
        for m in found.modes
        if not m.remark
    )
    return _Side(str(path), found.channels, modes, _levels(found), {})


def _levels(found: LookedRecording) -> dict[str, tuple[float, float]]:
    """Compute the level of each channel in each octave, with the standard deviation of its mean over the recording."""
    out = {}
    step = float(found.hz[1])
    centres = 2.0 ** np.arange(np.floor(np.log2(4.0 * step)), np.log2(found.hz[-1]))
    columns = len(found.spectrogram)
    averaged = found.n_segments / columns  # half-overlapping segments in a column
    for low in centres:
        inside = (found.hz >= low) & (found.hz < 2.0 * low)
        if not inside.any() or 2.0 * low > found.hz[-1]:
            continue
        power = found.spectrogram[:, inside].sum(axis=1) * step
        for k, name in enumerate(found.channels):
            mean = float(power[:, k].mean())
            if mean <= 0.0 or columns < 2:
                continue
            inflate = 1.0 + 2.0 * overlap_correlation() / averaged
            std = float(power[:, k].std(ddof=1)) * np.sqrt(inflate / columns) / mean
            out[f"{name}: level, {low:g} to {2.0 * low:g} Hz"] = (10.0 * np.log10(mean), 10.0 / np.log(10.0) * std)
    return out


def _of_results(folder: Path) -> _Side:
    """Collect what is compared of a folder of results (errors as `compare`)."""
    judged = _windows_with_modes(folder / _RESULTS)
    stretch_s = (judged[-1]["t_end_ns"] - judged[0]["t_end_ns"]) * 1e-9 + judged[0]["window_s"]
    mean = partial(_mean, stretch_s / judged[0]["window_s"], len(judged))
    numbers = [line.get("model_modes") or list(range(len(line["frequencies_hz"]))) for line in judged]
    modes = []
    for number in sorted({number for own in numbers for number in own}):
        rows = [(line, own.index(number)) for line, own in zip(judged, numbers, strict=True) if number in own]
        of = {key: [line[key][k] for line, k in rows] for key in _OF_MODES}
        f, d = mean(of["frequencies_hz"], of["frequencies_std_hz"]), mean(of["damping_ratio"], of["damping_std"])
        modes.append(_Mode(*f, *d, _mean_shape(of["mode_shapes"]), None))
    told = [line for line in judged if line.get("ddi")]
    index = {
        f"story {j + 1}: damage index": mean([line["ddi"][j] for line in told], [line["ddi_std"][j] for line in told])
        for j in range(max((len(line["ddi"]) for line in told), default=0))
    }
    decibels = [20.0 * np.log10(x) for line in judged if (x := line.get("rms_m_s2"))]
    levels = {"level": mean(decibels, [float(np.std(decibels))] * len(decibels))} if decibels else {}
    return _Side(str(folder), (), tuple(modes), levels, index)


def _windows_with_modes(path: Path) -> list[dict[str, Any]]:
    """Read the windows of results.jsonl that have modes, one at least."""
    if not path.is_file():
        raise MissingInputError(f"{path}: does not exist; a folder of results is made by replay or run")
    judged = []
    with os_errors_of(path):
        for number, text in enumerate(read_lines(path), start=1):
            try:
                line = read_line(text)
            except ValueError as error:
                raise BadInputError(f"{path}: line {number}: {error}") from error
            judged += [line] if line.get("frequencies_hz") else []
    if not judged:
        raise BadInputError(f"{path}: no window has modes")
    return judged


def _mean(looks: float, of: int, values: Sequence[float | None], stds: Sequence[float | None]) -> tuple[float, float]:
    """Average windows that share data, with the standard deviation of the mean; `of` windows are `looks` without common data."""
    v = np.array([x for x in values if x is not None], dtype=float)
    s = np.array([x for x in stds if x is not None], dtype=float)
    if not v.size:
        return float("nan"), float("nan")
    own = looks * v.size / of
    one = float(v.std(ddof=1)) if own >= _LEAST_LOOKS else float(s.mean()) if s.size else float("nan")
    return float(v.mean()), one / np.sqrt(max(own, 1.0))


def _mean_shape(shapes: Sequence[Sequence[Any]]) -> ComplexArray:
    """Average shapes of several windows, [re, im] of each channel; a channel that is left out in any of them counts as 0."""
    parsed = []
    for shape in shapes:
        x = np.array([0j if one is None or None in one else complex(*one) for one in shape])
        parsed.append(x / max(float(np.linalg.norm(x)), 1e-300))
    reference = parsed[0]
    turned = [x * np.exp(-1j * np.angle(np.vdot(reference, x))) for x in parsed]
    return np.asarray(np.mean(turned, axis=0))
