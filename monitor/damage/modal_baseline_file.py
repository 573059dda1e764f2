"""The healthy modes as a JSON file, and the choice between the kinds of baseline."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import ConfigDict, Field, ValidationError

from monitor.core import BadConfigurationError, BadInputError, Settings, settings_problems, write_atomically
from monitor.damage import covariates
from monitor.damage.baseline_file import Law, read_content
from monitor.damage.modal_baseline import ModalBaseline, ModalOrigin
from monitor.model import Matrix, Positive

MODAL_FORMAT = 1
"""Counts changes of the meaning of a file of modes; files of another number are refused. [1; definition]"""
MODAL = "modal"
"""Kind of the baseline in a file of modes. [name; definition]"""


class _Origin(Settings):
    """`ModalOrigin` in the file."""

    model_config = ConfigDict(strict=True)

    name: str
    unit: str
    rate_hz: Positive
    cutoff_hz: Positive


class _Content(Settings):
    """Content of the file: `ModalBaseline`."""

    model_config = ConfigDict(strict=True)

    kind: Literal["modal"]
    format: int
    frequencies_hz: Annotated[tuple[Positive, ...], Field(min_length=1)]
    frequencies_std_hz: tuple[float, ...]
    damping_ratio: tuple[float, ...]
    shapes: Matrix
    gauges: tuple[Annotated[int, Field(ge=0)], ...]
    covariance: Matrix
    shape_variance: Matrix
    channels: tuple[str, ...]
    windows: int
    level_range_m_s2: tuple[float, float]
    origin: _Origin
    reference_temperature_degc: float | None
    law: Law | None
    shape_law: Law | None
    motion: Matrix | None
    recordings: tuple[dict[str, str], ...]
    span_ns: tuple[int, int]
    clock_ratio: Positive


def save_modal_baseline(baseline: ModalBaseline, path: Path) -> None:
    """Write the healthy modes as JSON, atomically."""
    own = {
        "kind": MODAL,
        "format": MODAL_FORMAT,
        "law": covariates.to_plain(baseline.law),
        "shape_law": covariates.to_plain(baseline.shape_law),
        "origin": asdict(baseline.origin),
    }
    content: dict[str, Any] = {}
    for name in _Content.model_fields:
        value = own[name] if name in own else getattr(baseline, name)
        content[name] = value.tolist() if isinstance(value, np.ndarray) else value
    write_atomically(path, json.dumps(content, indent=1, allow_nan=False) + "\n")


def load_modal_baseline(path: Path, channels: tuple[str, ...], here: ModalOrigin) -> ModalBaseline:
    """Read the healthy modes and check that they are of these channels and samples.

    Raises
    ------
    MissingInputError
        If the file cannot be read.
    BadInputError
        If the file is no baseline or damaged.
    BadConfigurationError
        If the baseline is another structure's, or of another kind.
    """
    try:
        text, tree = read_content(path)
        if tree.get("kind") != MODAL:
            raise BadConfigurationError(
                f"{path}: the baseline is of a structure with a model, and here the modes alone are monitored; make one with "
                "'calibrate' and this structure file"
            )
        if tree["format"] != MODAL_FORMAT:
            raise BadInputError(f"{path}: baseline format {tree['format']!r}, expected {MODAL_FORMAT}; calibrate anew")
        content = _Content.model_validate_json(text)
        loaded = _build(content)
    except ValidationError as error:
        raise BadInputError(
            f"{path}: not a baseline file ({settings_problems(error)[0]}); make one with 'calibrate'"
        ) from error
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        raise BadInputError(f"{path}: not a baseline file ({error!r}); make one with 'calibrate'") from error
    there = loaded.origin
    says = [] if loaded.channels == channels else [f"its channels are {', '.join(loaded.channels)}"]
    says += [
        f"{what} is {a} there and {b} here"
        for what, a, b in (
            ("rate_hz", there.rate_hz, here.rate_hz),
            ("cutoff_hz", there.cutoff_hz, here.cutoff_hz),
            ("the unit", there.unit, here.unit),
        )
        if a != b
    ]
    if says:
        raise BadConfigurationError(
            f"{path}: the baseline is not of this structure: {'; '.join(says)}. Remedy: name this structure's own baseline, or "
            "make it with 'calibrate'"
        )
    if there.name and here.name and there.name != here.name:
        names = f"{there.name!r}, and this is {here.name!r}"
        return replace(
            loaded, doubts=(f"the baseline {path.name} is of {names}: calibrate anew if that is another structure",)
        )
    return loaded


def _build(c: _Content) -> ModalBaseline:
    """Build the baseline from a file's content.

    Raises
    ------
    ValueError, KeyError, TypeError
        If the parts of the content do not fit each other.
    """
    m, n = len(c.frequencies_hz), len(c.channels)
    shapes: dict[str, tuple[int, ...]] = dict.fromkeys(("frequencies_hz", "frequencies_std_hz", "damping_ratio"), (m,))
    shapes |= {"shapes": (m, n), "covariance": (m, m), "shape_variance": (m, n)}
    shapes |= {"motion": (n, n)} if c.motion is not None else {}
    arrays: dict[str, Any] = {name: np.array(getattr(c, name), dtype=float) for name in shapes}
    if any(arrays[name].shape != shape or not np.isfinite(arrays[name]).all() for name, shape in shapes.items()):
        raise ValueError("its modes are damaged")
    if len(c.gauges) != m or any(g >= n for g in c.gauges):
        raise ValueError("its gauges are damaged")
    return ModalBaseline(
        **arrays,
        gauges=c.gauges,
        channels=c.channels,
        windows=c.windows,
        level_range_m_s2=c.level_range_m_s2,
        origin=ModalOrigin(**c.origin.model_dump()),
        reference_temperature_degc=c.reference_temperature_degc,
        law=covariates.from_plain(None if c.law is None else c.law.model_dump(), m),
        shape_law=covariates.from_plain(None if c.shape_law is None else c.shape_law.model_dump(), m * (n - 1)),
        recordings=c.recordings,
        span_ns=c.span_ns,
        clock_ratio=c.clock_ratio,
    )
