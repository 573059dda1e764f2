"""The baseline as a JSON file."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import ConfigDict, Field, ValidationError

from monitor.core import (
    BadConfigurationError,
    BadInputError,
    MissingInputError,
    Settings,
    settings_problems,
    write_atomically,
)
from monitor.damage import covariates
from monitor.damage.baseline import Baseline
from monitor.damage.origin import Origin, number_differences, sensor_differences
from monitor.damage.updating import UpdatingSettings
from monitor.model import InstrumentedModel, Matrix, Positive, prior_file

FORMAT = 1
"""Counts changes of the file's meaning; files of another number are refused. [1; definition]"""
Index = Annotated[int, Field(ge=0)]
Vector = tuple[float, ...]


class _Strict(Settings):
    """Part of the file, validated strictly: JSON types are not converted."""

    model_config = ConfigDict(strict=True)


class _Axis(_Strict):
    """`covariate_law.Axis` in the file."""

    name: str
    unit: str
    knots: Vector
    slope_std: Vector
    lag: int
    lag_s: float
    reference: float
    range: tuple[float, float]


class _Common(_Strict):
    """`CommonChange` in the file."""

    square: Matrix
    windows: int
    lowest: tuple[Matrix, Matrix]


class Law(_Strict):
    """`CovariateLaw` in the file."""

    axes: tuple[_Axis, ...]
    centre: Vector
    spread: Matrix
    slopes: Matrix
    posterior: tuple[Matrix, ...]
    mixing: Matrix
    scatter: float
    common: _Common | None


class _Effect(_Strict):
    """Effect of `_Reference` in the file."""

    effect: str
    location: str
    parameters: dict[str, float]


class _StandingError(_Strict):
    """`reference.StandingError` in the file."""

    hz: Vector
    real: tuple[Matrix, ...]
    imaginary: tuple[Matrix, ...]
    variance: Vector


class _Reference(_Strict):
    """`StructuralPrior` in the file, as `prior_file` writes it."""

    effects: tuple[_Effect, ...]
    correction: Vector
    mean: Vector
    precision: Matrix
    basis: tuple[Matrix, ...]
    reference_degc: float | None
    error: _StandingError | None
    judged_hz: tuple[float, float] | None
    ln_forces: Vector | None


class _Origin(_Strict):
    """`Origin` in the file."""

    name: str
    kind: str
    masses_kg: tuple[Positive, ...]
    stiffness_n_per_m: tuple[Positive, ...]
    fingerprint: str
    unit: str
    rate_hz: float | None
    cutoff_hz: float | None


class _Content(_Strict):
    """Content of the file: `Baseline`, with the parameters of its model instead of the model."""

    format: int
    stiffness_n_per_m: tuple[Positive, ...]
    masses_kg: tuple[Positive, ...]
    covariance: Matrix
    z: Vector
    z_covariance: Matrix
    misfit: Vector
    frequencies_hz: Vector
    frequencies_std_hz: Vector
    damping_ratio: Vector
    model_mode: tuple[Index, ...]
    gauges: tuple[Index, ...]
    log: bool
    channels: tuple[str, ...]
    floors: tuple[int, ...]
    windows: int
    level_range_m_s2: tuple[float, float]
    reference_temperature_degc: float | None
    recordings: tuple[dict[str, str], ...]
    span_ns: tuple[int, int]
    clock_ratio: Positive
    law: Law | None
    drift_weights: Matrix | None
    motion: Matrix | None
    stiffness_correction_n_per_m: Matrix | None
    reference: _Reference | None
    origin: _Origin
    converged: bool


def _plain(value: Any) -> Any:
    """Convert an array to lists; return any other value as it is."""
    return value.tolist() if isinstance(value, np.ndarray) else value


def save_baseline(baseline: Baseline, path: Path) -> None:
    """Write the baseline as JSON, atomically."""
    structure = baseline.model.structure
    own = {
        "format": FORMAT,
        "stiffness_n_per_m": structure.stiffness_n_per_m.tolist(),
        "masses_kg": structure.masses_kg.tolist(),
        "law": covariates.to_plain(baseline.law),
        "stiffness_correction_n_per_m": _plain(baseline.model.correction),
        "reference": prior_file.to_plain(baseline.reference),
        "origin": asdict(baseline.origin),
    }
    content = {name: own[name] if name in own else _plain(getattr(baseline, name)) for name in _Content.model_fields}
    write_atomically(path, json.dumps(content, indent=1, allow_nan=False) + "\n")


def read_content(path: Path) -> tuple[str, dict[str, Any]]:
    """Read the text of a baseline's file, of any kind, and the JSON object that it holds.

    Raises
    ------
    MissingInputError, BadInputError
        If the file cannot be read.
    ValueError, RecursionError
        If it holds no JSON.
    TypeError
        If it holds no object.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise BadInputError(f"{path}: not a baseline file (no UTF-8 text); make one with 'calibrate'") from error
    except OSError as error:
        raise MissingInputError(f"{path}: {error.strerror}") from error
    if path.suffix.casefold() == ".toml":
        raise BadInputError(
            f"{path}: a structure file, and no baseline: a baseline is the JSON file that 'calibrate --out' writes"
        )
    tree = json.loads(text)
    if not isinstance(tree, dict):
        raise TypeError("it is no JSON object")
    return text, tree


def load_baseline(
    path: Path, instrumented: InstrumentedModel, updating: UpdatingSettings, *, redrawn: bool = False
) -> Baseline:
    """Read a baseline and check that it belongs to this structure.

    Parameters
    ----------
    redrawn : bool
        Accept a changed drawing of the same structure, for `rebase_baseline`.

    Returns
    -------
    Baseline
        With the reasons in `doubts` why it may not be this structure's, or why losses against it are not to be trusted.

    Raises
    ------
    MissingInputError
        If the file cannot be read.
    BadInputError
        If the file is no baseline or damaged.
    BadConfigurationError
        If the baseline is another structure's.
    """
    try:
        text, tree = read_content(path)
        if "kind" in tree:
            raise BadConfigurationError(
                f"{path}: the baseline is of modes alone, and this structure has a model; make one with 'calibrate' and this "
                "structure file"
            )
        if (written := tree["format"]) != FORMAT:
            raise BadInputError(f"{path}: baseline format {written!r}, expected {FORMAT}; calibrate anew")
        content = _Content.model_validate_json(text)
        _demand_own(path, content, instrumented, updating, redrawn)
        loaded = _build(content, instrumented)
    except ValidationError as error:
        raise BadInputError(
            f"{path}: not a baseline file ({settings_problems(error)[0]}); make one with 'calibrate'"
        ) from error
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        raise BadInputError(f"{path}: not a baseline file ({error!r}); make one with 'calibrate'") from error
    if (problem := _damage(loaded)) is not None:
        raise BadInputError(f"{path}: the baseline's {problem} damaged; calibrate anew")
    doubts = _doubts(path, loaded.origin, Origin.of(instrumented))
    if not loaded.converged:
        doubts += (
            f"the updating of the baseline {path.name} did not converge: losses against it are not to be trusted; see what "
            "'calibrate' says",
        )
    return replace(loaded, doubts=doubts)


def _demand_own(
    path: Path, c: _Content, instrumented: InstrumentedModel, updating: UpdatingSettings, redrawn: bool
) -> None:
    """Refuse a baseline of another structure, of other sensors or of other samples.

    Raises
    ------
    BadConfigurationError
        With the differences in words, and the remedy.
    ValueError
        If the content is damaged.
    """
    here, there = Origin.of(instrumented), Origin(**c.origin.model_dump())
    numbers = len(c.masses_kg), len(c.stiffness_n_per_m)
    if (len(there.masses_kg), len(there.stiffness_n_per_m)) != numbers:
        raise ValueError("the numbers of masses and stiffnesses are not those of its origin")
    says = number_differences(*numbers, instrumented) + sensor_differences(c.channels, c.floors, instrumented)
    says += there.sampling_differences(here)
    if c.log != (updating.eigenvalue == "log") or bool(c.gauges) != updating.use_shapes:
        says.append("it was learned with another [updating] eigenvalue or use_shapes")
    mend = "name this structure's own baseline, or make it with 'calibrate'"
    if not says and not redrawn:
        says = there.drawing_differences(here)
        mend += f"; if the structure is the same and only its drawing was changed, use 'calibrate --rebase {path}'"
    if not says:
        return
    if there.is_named_otherwise(here):
        says.insert(0, f"it is of {there.name!r}, this is {here.name!r}")
    raise BadConfigurationError(f"{path}: the baseline is not of this structure: {'; '.join(says)}. Remedy: {mend}")


def _doubts(path: Path, there: Origin, here: Origin) -> tuple[str, ...]:
    """Say why a baseline may not be this structure's."""
    if there.is_named_otherwise(here):
        return (
            f"the baseline {path.name} is of {there.name!r}, and this is {here.name!r}, drawn alike: if it is the same "
            "structure, 'calibrate --rebase' notes the new name",
        )
    return ()


def _build(c: _Content, instrumented: InstrumentedModel) -> Baseline:
    """Build the baseline from a file's content.

    Raises
    ------
    ValueError, KeyError, TypeError
        If the parts of the content do not fit each other or the structure.
    """
    model = instrumented.model
    size = model.structure.n_dofs
    # The correction known at calibration: a correction that a diagnosis added later is contained in `misfit` already.
    known = c.stiffness_correction_n_per_m
    model = replace(model, correction=None if known is None else np.array(known).reshape(size, size))
    law = None if c.law is None else c.law.model_dump()
    reference = None if c.reference is None else c.reference.model_dump()
    return Baseline(
        model=model.with_stiffness(np.array(c.stiffness_n_per_m)).with_masses(np.array(c.masses_kg)),
        covariance=np.array(c.covariance),
        z=np.array(c.z),
        z_covariance=np.array(c.z_covariance),
        misfit=np.array(c.misfit),
        model_mode=c.model_mode,
        gauges=c.gauges,
        log=c.log,
        frequencies_hz=np.array(c.frequencies_hz),
        frequencies_std_hz=np.array(c.frequencies_std_hz),
        damping_ratio=np.array(c.damping_ratio),
        channels=c.channels,
        floors=c.floors,
        windows=c.windows,
        level_range_m_s2=c.level_range_m_s2,
        reference_temperature_degc=c.reference_temperature_degc,
        law=covariates.from_plain(law, len(c.stiffness_n_per_m)),
        drift_weights=None if c.drift_weights is None else np.array(c.drift_weights),
        motion=None if c.motion is None else np.array(c.motion),
        recordings=c.recordings,
        span_ns=c.span_ns,
        clock_ratio=c.clock_ratio,
        reference=prior_file.from_plain(reference, model, instrumented.channels),
        origin=Origin(**c.origin.model_dump()),
        converged=c.converged,
    )


def _damage(b: Baseline) -> str | None:
    """Name the part of a baseline that does not fit the others, with its verb; None if all fit."""
    n, p, m, c = b.model.structure.n_dofs, b.model.structure.n_stories, len(b.model_mode), len(b.channels)
    n_data = m + len(b.gauges) * (c - 1)
    shapes = {"covariance": (p + n, p + n), "z": (n_data,), "z_covariance": (n_data, n_data), "misfit": (n_data,)}
    shapes |= {name: (m,) for name in ("frequencies_hz", "frequencies_std_hz", "damping_ratio")}
    shapes |= {"motion": (c, c)} if b.motion is not None else {}
    for name, shape in shapes.items():
        if getattr(b, name).shape != shape:
            return f"{name} is"
    if (
        any(i >= n for i in b.model_mode)
        or len(set(b.model_mode)) != m
        or any(g >= c for g in b.gauges)
        or len(b.gauges) not in (0, m)
    ):
        return "modes are"
    return None
