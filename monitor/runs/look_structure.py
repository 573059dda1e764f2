"""Proposal of a structure file from the modes of a quick look: a shear frame where the shapes are those of one, else matrices."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import ceil

import numpy as np

from monitor.core import Array, BadInputError, Skipped
from monitor.identification import SsiSettings
from monitor.model import Model, ShearFrame
from monitor.publish import LookedMode, LookedRecording
from monitor.signals import ProcessingSettings

_MASS_SPREAD = 0.2
"""Spread of the floors' masses about their mean that is taken for granted. [ratio; judgement: floors of one building]"""
_LEAST_EQUATION_STD = 0.01
"""Least standard deviation of an equation of motion, over the inertia of a floor. [ratio; judgement: no structure
is quite a shear frame]"""
_LEAST_FRAME_MAC = 0.9
"""Modal assurance criterion between every mode and its counterpart in the frame, from which it is taken. [1; judgement]"""
_MOST_FRAME_ERROR = 0.1
"""Relative error of a frame's frequency up to which it is taken. [ratio; judgement: calibrate fits the stiffness anyway]"""
_BEYOND = 4.0
"""Frequency of what the modes do not determine, over that of the highest mode. [1; judgement: beyond the band]"""
_SHARE_OF_DIRECTION = 0.8
"""Least share of a mode's motion, squared, by which it is of a direction. [ratio; judgement]"""
_CUTOFF_OVER_MODE = 1.4
"""Cutoff of the lowpass over the highest mode. [1; as `stabilization.advice`]"""
_WINDOWS = 4
"""Windows without common data that a recording should hold. [count; judgement]"""


def propose_structure(found: LookedRecording, mass_kg: float | None = None) -> str:
    """Write a structure file that fits the modes, what is doubtful about it as comments; `mass_kg` is that of the whole.

    Channels whose names end in x and in y are of two directions: a building is proposed where each direction is a shear frame,
    else the direction with the most modes alone.
    """
    if len(axes := _axes(found.channels)) > 1:
        return _propose_building(found, axes, mass_kg)
    sure = [mode for mode in found.modes if not mode.remark and _is_sure(mode)]
    if not sure:
        raise BadInputError(f"{', '.join(found.files)}: no mode to make a structure of; record longer, or more motion")
    first = sorted(sure, key=lambda mode: bool(mode.doubt))[
        : len(found.channels)
    ]  # the lowest, those with a number first
    modes = sorted(first, key=lambda mode: mode.frequency_hz)
    doubts = []
    if unsure := [f"{mode.frequency_hz:.4g}" for mode in found.modes if not mode.remark and not _is_sure(mode)]:
        doubts.append(
            f"Left out: {', '.join(unsure)} Hz, whose damping is not told from zero or which have no second opinion."
        )
    if mass_kg is None:
        doubts.append(
            "The masses are relative, 1 kg in all: modes do not tell masses. Relative stiffness losses are right all the same, "
            "N/m and drifts are not: give --mass-kg, or set masses_kg and scale stiffness_n_per_m by the same factor."
        )
    order = [int(k) for k in np.argsort(-np.abs(modes[0].shape.real))]
    total = 1.0 if mass_kg is None else mass_kg
    frame = fit_frame(modes, order, total)
    misfit = frame_misfit(frame, modes, order)
    if len(sure) > len(first):
        beyond = ", ".join(f"{mode.frequency_hz:.4g}" for mode in sure if not any(mode is one for one in modes))
        doubts.append(
            f"{len(sure)} modes for {len(first)} sensors: floors without a sensor, or motion in another direction. "
            + (
                f"Those at {beyond} Hz are not in it: more sensors would tell them. Until then windows show them beside the "
                "model's, which is no fault of floors, signs or units."
                if misfit is None
                else f"Floors {len(first) + 1} to {len(sure)} are no places: they hold what the sensors do not tell apart."
            )
        )
    modes = modes if misfit is None else sure
    damping = float(np.clip(np.mean([mode.damping_ratio for mode in modes[:2]]), 1e-4, 0.99))
    if misfit is None:
        doubts += [
            "A shear frame with one sensor a floor, the top one first. Floors are ordered by their motion in the lowest mode: "
            f"{', '.join(found.channels[k] for k in order)}. Check the order.",
            "Floors without a sensor are not in it: add them if there are some.",
        ]
        table = [
            'kind = "shear_frame"',
            f"masses_kg = {_numbers(frame.masses_kg)}",
            f"stiffness_n_per_m = {_numbers(frame.stiffness_n_per_m)}",
        ]
        if len(modes) < len(order):
            doubts.append(f"{len(modes)} modes for {len(order)} floors: single masses are little more than a guess.")
    else:
        order = list(range(len(found.channels)))
        doubts += [
            f"No shear frame: {misfit}. The matrices below have the measured modes, and what the modes do not tell lies "
            "beyond the band.",
            'Each "story" is the stiffness of one mode, no place: a loss tells which mode fell, not where. Draw the structure '
            "for more (docs/structures.md).",
        ]
        table = _matrices(modes, total)
    processing = _processing(found, modes)
    doubts += processing[1]
    doubts += [f"Of the recording: {doubt}" for doubt in found.doubts]
    lines = [f"# Proposed by `shm-monitor look` from {', '.join(found.files)}: it fits the modes, it is no drawing."]
    lines += [f"# - {doubt}" for doubt in doubts]
    lines += ["[structure]", *table, f"damping_ratio = {damping:.4g}"]
    for floor, channel in enumerate(order, start=1):
        lines += ["", "[[sensors]]", f"channel = {json.dumps(found.channels[channel])}", f"floor = {floor}"]
    lines += ["", *processing[0]]
    return "\n".join(lines) + "\n"


def _axes(channels: Sequence[str]) -> dict[str, list[int]]:
    """Group the channels (0 = first) by the direction that their names end in; nothing where some end otherwise."""
    ends = [name[-1:].lower() for name in channels]
    groups = {axis: [k for k, end in enumerate(ends) if end == axis] for axis in "xyz"}
    own = {axis: those for axis, those in groups.items() if those}
    return own if sum(map(len, own.values())) == len(channels) and not own.keys().isdisjoint("xy") else {}


def _along(found: LookedRecording, those: Sequence[int]) -> LookedRecording:
    """Reduce a look to some channels and to the modes whose motion is theirs."""
    modes = []
    for mode in found.modes:
        own = mode.shape[list(those)]
        largest = own[np.abs(own).argmax()]
        if (np.abs(own) ** 2).sum() >= _SHARE_OF_DIRECTION * (np.abs(mode.shape) ** 2).sum():
            modes.append(replace(mode, shape=own / largest, shape_std=mode.shape_std[list(those)] / abs(largest)))
    return replace(found, channels=tuple(found.channels[k] for k in those), modes=tuple(modes))


def _propose_building(found: LookedRecording, axes: Mapping[str, list[int]], mass_kg: float | None) -> str:
    """Write a building where each direction is a shear frame on the same floors, else one direction alone."""
    ways = {axis: _along(found, axes[axis]) for axis in "xy" if axis in axes}
    fitted = {axis: _fitted_frame(way, 1.0 if mass_kg is None else mass_kg) for axis, way in ways.items()}
    best = max(ways, key=lambda axis: len(ways[axis].modes))
    orders = [None if fit is None else (axis, fit[1]) for axis, fit in fitted.items()]
    floors = [None if known is None else [ways[known[0]].channels[k][:-1] for k in known[1]] for known in orders]
    (x, y) = fitted.get("x"), fitted.get("y")
    if x is None or y is None or floors[0] != floors[1] or len(floors[0] or ()) < len(axes["x"]):
        left = ", ".join(name for k, name in enumerate(found.channels) if k not in axes[best])
        text = propose_structure(ways[best], mass_kg)
        head, _, rest = text.partition("\n")
        return (
            f"{head}\n# - Along {best} alone: the directions are no shear frames on the same floors, or one has too few modes. "
            f"Left out: {left}. Draw a building for both (docs/structures.md).\n{rest}"
        )
    names, modes = floors[0] or [], [m for way in ways.values() for m in way.modes if not m.remark and _is_sure(m)]
    modes.sort(key=lambda mode: mode.frequency_hz)
    settings, doubts = _processing(found, modes)
    masses = 0.5 * (x[0].masses_kg + y[0].masses_kg)
    lines = [f"# Proposed by `shm-monitor look` from {', '.join(found.files)}: it fits the modes, it is no drawing."]
    says = [
        "Two shear frames on the same floors, one along x and one along y, from the names of the channels. Floors are ordered by "
        f"their motion in the lowest modes, the top one first: {', '.join(names)}. Check the order.",
        "The plan is a guess, and so are the places of the sensors, in its middle: state plan_m, and position_m of each sensor; "
        "then torsion is told.",
        *doubts,
    ]
    if mass_kg is None:
        says.append("The masses are relative, 1 kg in all: give --mass-kg for N/m and drifts.")
    says += [f"Of the recording: {doubt}" for doubt in found.doubts]
    lines += [f"# - {one}" for one in says]
    damping = float(np.clip(np.mean([mode.damping_ratio for mode in modes[:2]]), 1e-4, 0.99))
    lines += ["[structure]", 'kind = "building"', f"damping_ratio = {damping:.4g}"]
    for j in reversed(range(len(names))):
        lines += ["", "[[storeys]]", f"mass_kg = {masses[j]:.6g}", "plan_m = [10.0, 10.0]"]
        lines += [
            f"stiffness_{axis}_n_per_m = {frame.stiffness_n_per_m[j]:.6g}" for axis, (frame, _) in (("x", x), ("y", y))
        ]
    for axis, those in axes.items():
        for name in (found.channels[k] for k in those):
            floor = len(names) - names.index(name[:-1]) if name[:-1] in names else 1
            lines += ["", "[[sensors]]", f"channel = {json.dumps(name)}", f"floor = {floor}", f'axis = "{axis}"']
    return "\n".join([*lines, "", *settings]) + "\n"


def _fitted_frame(found: LookedRecording, mass_kg: float) -> tuple[ShearFrame, list[int]] | None:
    """Fit a frame to the modes of one direction, with the order of its floors; None where it does not fit."""
    sure = [mode for mode in found.modes if not mode.remark and _is_sure(mode)][: len(found.channels)]
    if not sure:
        return None
    modes = sorted(sure, key=lambda mode: mode.frequency_hz)
    order = [int(k) for k in np.argsort(-np.abs(modes[0].shape.real))]
    frame = fit_frame(modes, order, mass_kg)
    return None if frame_misfit(frame, modes, order) else (frame, order)


def _is_sure(mode: LookedMode) -> bool:
    """Check that a mode has a second opinion, and a damping ratio that is told from zero with a confidence of 95 %."""
    return not isinstance(mode.second, Skipped) and mode.damping_ratio > 2.0 * mode.damping_std


def fit_frame(modes: Sequence[LookedMode], order: Sequence[int], mass_kg: float) -> ShearFrame:
    """Fit masses and stiffnesses of a shear frame to the modes, by the equations of motion.

    Above each story the inertia of the floors is the story's force: both are linear in masses and stiffnesses.
    """
    from scipy.optimize import nnls  # takes a third of a second to load

    n = len(order)
    rows, right = [], []
    scale = (2.0 * np.pi * modes[-1].frequency_hz) ** 2
    for mode in modes:
        shape = mode.shape.real[list(order)]
        drift = shape - np.append(shape[1:], 0.0)
        std = max(_LEAST_EQUATION_STD, float(np.sqrt((mode.shape_std**2).mean())))
        omega2 = (2.0 * np.pi * mode.frequency_hz) ** 2
        for j in range(n):
            row = np.zeros(2 * n)
            row[: j + 1] = shape[: j + 1]
            row[n + j] = -drift[j] * scale / omega2
            rows.append(row / std)
            right.append(0.0)
    for j in range(n):
        rows.append(np.eye(2 * n)[j] / _MASS_SPREAD)
        right.append(1.0 / _MASS_SPREAD)
    x, _ = nnls(np.array(rows), np.array(right))
    masses, stiffness = np.maximum(x[:n], 1e-3), np.maximum(x[n:], 1e-6) * scale
    factor = mass_kg / masses.sum()
    return ShearFrame(masses * factor, stiffness * factor, modes[0].damping_ratio)


def frame_misfit(frame: ShearFrame, modes: Sequence[LookedMode], order: Sequence[int]) -> str | None:
    """Say why a fitted frame is not taken; None where it fits the modes."""
    own = Model(frame).modes()
    for number, mode in enumerate(modes, start=1):
        nearest = int(np.abs(np.log(own.frequencies_hz / mode.frequency_hz)).argmin())
        f, shape, a = float(own.frequencies_hz[nearest]), own.shapes[:, nearest], mode.shape[list(order)]
        mac = abs(shape @ a) ** 2 / ((shape @ shape) * np.vdot(a, a).real)
        if nearest != number - 1 or abs(f / mode.frequency_hz - 1.0) > _MOST_FRAME_ERROR or mac < _LEAST_FRAME_MAC:
            return f"the fitted one has {f:.4g} Hz where mode {number} has {mode.frequency_hz:.4g} Hz, MAC {mac:.2f}"
    return None


def _matrices(modes: Sequence[LookedMode], mass_kg: float) -> list[str]:
    """Write matrices whose modes at the sensors are the measured ones, and what the modes do not tell lies beyond the band.

    The matrices are those of the system equivalent reduction expansion process (SEREP): with the shapes as columns of P,
    completed to a basis, M = P^-T P^-1 and K = M P diag(omega^2) P^T M.  So each stiffness moves the frequency of its mode and no
    shape, also where floors have no sensor and the shapes at the others are not orthogonal
    (O'Callahan, Avitabile, Riemer, Proc. IMAC VII, 1989).
    """
    shapes = np.array([mode.shape.real / np.linalg.norm(mode.shape.real) for mode in modes]).T
    c, m = shapes.shape
    left, _, right = np.linalg.svd(shapes)
    # Completed by what is orthogonal to them: where modes are more than sensors, by rows that no sensor sees.
    basis, n = (
        np.concatenate([shapes, left[:, m:]], axis=1) if m < c else np.concatenate([shapes, right[c:]]),
        max(c, m),
    )
    inverse = np.linalg.inv(basis)
    mass = inverse.T @ inverse
    mass *= mass_kg / mass.sum()
    scale = np.einsum("ar,ab,br->r", basis, mass, basis)  # modal masses
    omega2 = (2.0 * np.pi * np.array([mode.frequency_hz for mode in modes])) ** 2
    each = np.einsum("ar,br->rab", mass @ basis, mass @ basis) / scale[:, None, None] ** 2
    modal = scale[:m] * omega2
    stiffness = np.einsum("r,rab->ab", modal, each[:m])
    if m < n:
        stiffness += _BEYOND**2 * omega2.max() * np.einsum("r,rab->ab", scale[m:], each[m:])
    derivatives = ", ".join(_matrix(one) for one in each[:m])
    return [
        'kind = "matrices"',
        f"mass_matrix = {_matrix(mass)}",
        f"stiffness_matrix = {_matrix(stiffness)}",
        f"stiffness_n_per_m = {_numbers(modal)}",
        f"stiffness_derivatives = [{derivatives}]",
        f"story_names = {json.dumps([f'mode {k}' for k in range(1, len(modes) + 1)])}",
    ]


def _processing(found: LookedRecording, modes: Sequence[LookedMode]) -> tuple[list[str], list[str]]:
    """Write the settings that suit the modes, and what is doubtful about them."""
    lowest, highest = modes[0].frequency_hz, modes[-1].frequency_hz
    rate = min(found.rate_hz, 5.0 * ceil(_CUTOFF_OVER_MODE * highest / 0.4 / 5.0))
    rows = SsiSettings().block_rows
    if 2 * rows / rate * lowest < 1.0:
        rows = min(200, ceil(0.5 * rate / lowest))
    usual = ProcessingSettings()
    hop_s = max(usual.hop_s, ceil(2 * rows / rate / 5.0) * 5.0)
    window_s = min(usual.window_s, found.duration_s / _WINDOWS)
    window_s = max(2.0, window_s // hop_s) * hop_s
    doubts = []
    if window_s < usual.window_s:
        doubts.append(f"Windows of {window_s:g} s, since the recording is short; longer ones see smaller changes.")
    lines = [
        "[processing]",
        f"rate_hz = {rate:.6g}",
        f"cutoff_hz = {0.4 * rate:.6g}",
        f"window_s = {window_s:.6g}",
        f"hop_s = {hop_s:.6g}",
    ]
    if rows != SsiSettings().block_rows:
        lines += ["", "[identification]", f"block_rows = {rows}"]
    return lines, doubts


def _numbers(values: Array) -> str:
    return "[" + ", ".join(f"{value:.6g}" for value in values) + "]"


def _matrix(values: Array) -> str:
    return "[" + ", ".join("[" + ", ".join(f"{value:.9g}" for value in row) + "]" for row in values) + "]"
