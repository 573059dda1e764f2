"""Modes as universal file: dataset 55 for each mode's mean shape, dataset 58 for the course of its frequency and damping."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from monitor.core import ComplexArray, import_extra

_ACCELERATION, _TIME, _FREQUENCY, _GENERAL = 12, 17, 18, 1
"""Specific data types of the format. [1; definition: universal dataset 58]"""


def write(rows: Iterable[Mapping[str, Any]], out: Path, channels: Sequence[str]) -> int:
    """Write the modes of the model, the mean over all rows of each, and return their number.

    The rows are those of the table `modes`, in order of time; channel k is node k, direction +x.  BadConfigurationError tells
    that the library pyuff is not installed.
    """
    pyuff = import_extra("pyuff", "a universal file (UFF)")
    courses: dict[int, list[Mapping[str, Any]]] = defaultdict(list)
    for row in rows:
        if row["mode"] is not None:
            courses[row["mode"]].append(row)
    sets: list[dict[str, Any]] = []
    for mode, course in sorted(courses.items()):
        sets += [_shape(pyuff, mode, course, channels), *_courses(pyuff, mode, course)]
    out.touch()
    if sets:
        pyuff.UFF(str(out)).write_sets(sets, "overwrite")
    return len(courses)


def mean_shape(shapes: Sequence[Annotated[ComplexArray, "channels"]]) -> Annotated[ComplexArray, "channels"]:
    """Average shapes of one mode, each scaled and turned to fit the first; not a number where a channel was always left out.

    Examples
    --------
    >>> mean_shape([np.array([1.0, 0.5j]), np.array([-2j, 1.0])])
    array([1.+0.j , 0.+0.5j])
    """
    first = shapes[0]
    fitted = []
    for shape in shapes:
        both = np.isfinite(shape) & np.isfinite(first)
        size = np.vdot(shape[both], shape[both])
        fitted.append(shape * (np.vdot(shape[both], first[both]) / size if size else np.nan))
    stacked = np.array(fitted)
    known = np.isfinite(stacked)
    with np.errstate(invalid="ignore"):
        mean: ComplexArray = np.where(known, stacked, 0.0).sum(axis=0) / known.sum(axis=0)
    return mean


def _shape(pyuff: Any, mode: int, course: Sequence[Mapping[str, Any]], channels: Sequence[str]) -> dict[str, Any]:
    """Return dataset 55 of a mode: the pole of its mean frequency and damping, and its mean shape."""
    shape = mean_shape([_complex(row) for row in course])
    frequency_hz = float(np.mean([row["frequency_hz"] for row in course]))
    damping = float(np.mean([row["damping_ratio"] for row in course]))
    omega = 2.0 * np.pi * frequency_hz
    nodes = [k for k in range(len(shape)) if np.isfinite(shape[k])]
    zero = np.zeros(len(nodes), dtype=complex)
    named = " ".join(f"{k + 1}={channels[k]}" for k in nodes if k < len(channels))
    data: dict[str, Any] = pyuff.prepare_55(
        id1=f"mode {mode}: {frequency_hz:.6g} Hz, damping ratio {damping:.4g}"[:80],
        id2=f"mean of {len(course)} windows"[:80],
        id3=_when(course[0]["t_end_ns"]),
        id4=f"nodes: {named}"[:80] if named else "NONE",
        id5="shm-monitor",
        model_type=1,
        analysis_type=3,  # complex modes of first order, with their poles
        data_ch=2,  # translations
        spec_data_type=_ACCELERATION,
        load_case=0,
        mode_n=mode,
        eig=complex(-damping * omega, omega * np.sqrt(max(0.0, 1.0 - damping**2))),
        modal_a=0j,
        modal_b=0j,
        node_nums=[k + 1 for k in nodes],
        r1=shape[nodes],
        r2=zero,
        r3=zero,
    )
    return data


def _courses(pyuff: Any, mode: int, course: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return dataset 58 of a mode's frequency and of its damping over time; none of a single window."""
    if len(course) < 2:
        return []
    begun_ns = course[0]["t_end_ns"]
    x = np.array([(row["t_end_ns"] - begun_ns) * 1e-9 for row in course])
    return [
        pyuff.prepare_58(
            id1=f"mode {mode}: {words}",
            id2="time: end of the window",
            id3=_when(begun_ns),
            func_type=0,
            rsp_node=mode,
            rsp_dir=0,
            ref_node=0,
            ref_dir=0,
            abscissa_spacing=0,
            abscissa_spec_data_type=_TIME,
            abscissa_axis_units_lab="s",
            ordinate_spec_data_type=kind,
            ordinate_axis_units_lab=unit,
            orddenom_spec_data_type=0,
            data=np.array([row[name] for row in course]),
            x=x,
        )
        for name, words, kind, unit in (
            ("frequency_hz", "frequency", _FREQUENCY, "Hz"),
            ("damping_ratio", "damping ratio", _GENERAL, "NONE"),
        )
    ]


def _complex(row: Mapping[str, Any]) -> ComplexArray:
    real, imaginary = (np.array(json.loads(row[name]), dtype=float) for name in ("shape_re", "shape_im"))
    shape: ComplexArray = real + 1j * imaginary
    return shape


def _when(t_ns: int) -> str:
    """Write a time as the format does, UTC."""
    return f"{datetime.fromtimestamp(t_ns // 10**9, UTC):%d-%b-%y %H:%M:%S}".upper()
