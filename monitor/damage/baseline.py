"""The healthy baseline: what later windows are compared with."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import ConfigDict, Field, ValidationError

from monitor.config import Configuration
from monitor.core import (
    Array,
    BadInputError,
    MissingInputError,
    ModalEstimate,
    Settings,
    Temperature,
    settings_problems,
    write_atomically,
)
from monitor.damage import temperature_compensation
from monitor.damage.observations import mean_observation
from monitor.damage.temperature_compensation import Dependence
from monitor.damage.updating import Observation, Update, counterparts, observe, predict, update
from monitor.model import Matrix, Model, Positive, StructuralPrior, prior_file

FORMAT = 1
Index = Annotated[int, Field(ge=0)]
Vector = tuple[float, ...]


@dataclass(frozen=True, eq=False, slots=True)
class Baseline:
    """Modes, updated model and standing misfit of the healthy structure."""

    model: Model
    """Updated to the healthy modes."""
    covariance: Array
    """Of stiffnesses, then masses, relative to their values, shape (p + n, p + n)."""
    z: Array
    """Measured vector of the healthy state, shape (n_data,) (see `updating.Observation`)."""
    z_covariance: Array
    """Shape (n_data, n_data)."""
    misfit: Array
    """z less the updated model's: the standing model error, which cancels from every change, shape (n_data,)."""
    model_mode: tuple[int, ...]
    """Which of `model`'s modes (0 = lowest) the healthy ones are, in the order of `z`."""
    gauges: tuple[int, ...]
    log: bool
    frequencies_hz: Array
    frequencies_std_hz: Array
    damping_ratio: Array
    channels: tuple[str, ...]
    floors: tuple[int, ...]
    """Floor of each channel."""
    windows: int
    level_range_m_s2: tuple[float, float]
    """Least and largest RMS of the windows, mean over channels."""
    reference_temperature_degc: float | None = None
    """Mean over the windows; None without a temperature channel."""
    temperature: Dependence | None = None
    """How the healthy stiffness follows the temperature; None where nothing could be learned."""
    recordings: tuple[dict[str, Any], ...] = field(default=())
    """Name and sha256 of every recording used."""
    span_ns: tuple[int, int] = (0, 0)
    """UTC of the healthy data's first sample and of their end."""
    reference: StructuralPrior | None = None
    """What a diagnosis starts from; None where the healthy data were too short for one."""

    def only(self, model_modes: tuple[int, ...]) -> Baseline:
        """The baseline of those modes of the model alone, for a window that does not show them all."""
        keep = [i for i, mode in enumerate(self.model_mode) if mode in model_modes]
        m, others = len(self.model_mode), len(self.channels) - 1
        if len(keep) == m:
            return self
        rows = keep + [m + i * others + s for i in keep for s in range(others) if self.gauges]
        return replace(
            self,
            z=self.z[rows],
            z_covariance=self.z_covariance[np.ix_(rows, rows)],
            misfit=self.misfit[rows],
            model_mode=tuple(self.model_mode[i] for i in keep),
            gauges=tuple(self.gauges[i] for i in keep if self.gauges),
            frequencies_hz=self.frequencies_hz[keep],
            frequencies_std_hz=self.frequencies_std_hz[keep],
            damping_ratio=self.damping_ratio[keep],
        )

    @property
    def model_form(self) -> float:
        """How far a change's pattern may be wrong, relative: twice the standing misfit of ln eigenvalues and shapes beyond
        its noise (joints of ratio 10 leave 2.6 %, and falsify a loss by 4 to 8 % of it)."""
        excess = float((self.misfit**2).mean() - np.diag(self.z_covariance).mean())
        return 2.0 * float(np.sqrt(max(excess, 0.0)))

    def target(self, observation: Observation) -> Observation:
        """The observation with the standing misfit taken out: what the baseline's model should predict."""
        return replace(observation, z=observation.z - self.misfit)


def learn(
    config: Configuration,
    windows: list[ModalEstimate],
    rms: Array,
    recordings: tuple[dict[str, Any], ...],
    span_ns: tuple[int, int] = (0, 0),
    temperatures: Sequence[Temperature | None] = (),
) -> tuple[Baseline, Update]:
    """The baseline from the windows of healthy recordings.

    Parameters
    ----------
    windows : list of ModalEstimate
        Overlapping windows share the influence of the data they share, so that the mean's covariance comes out right.
    rms : ndarray, shape (n_windows,)
        Response level of each window, m/s^2.
    temperatures : sequence of Temperature or None
        Of each window; empty without a temperature channel.

    Raises
    ------
    BadInputError
        If there is no window, or the model cannot be updated to them.
    """
    if not windows:
        raise BadInputError("no healthy window could be identified: nothing to learn a baseline from")
    settings = config.updating
    mean = mean_observation(windows, settings)
    sensors = config.sensor_matrix()
    fit = update(
        config.model(),
        sensors,
        mean,
        settings.model_copy(update={"penalty": "initial"}),
        prior_std=config.prior_std(),
        with_masses=True,
    )
    if fit.iterations == 0:
        raise BadInputError(
            "the structure file's model cannot be updated to the healthy modes: one of its modes stands still where the "
            "healthy one moves most; check floors and directions of the channels"
        )
    mean = replace(mean, model_mode=counterparts(fit.model.modes(), sensors, mean))
    predicted, _ = predict(fit.model, sensors, mean, with_masses=False)
    z_covariance = mean.deviations.T @ mean.deviations
    gain = fit.gain / fit.parameters[:, None]
    f = np.mean([m.frequencies_hz for m in windows], axis=0)
    baseline = Baseline(
        model=fit.model,
        covariance=gain @ z_covariance @ gain.T,
        z=mean.z,
        z_covariance=z_covariance,
        misfit=mean.z - predicted,
        model_mode=mean.model_mode,
        gauges=mean.gauges,
        log=mean.log,
        frequencies_hz=f,
        frequencies_std_hz=_frequency_std(f, z_covariance, mean.log),
        damping_ratio=np.mean([m.damping_ratio for m in windows], axis=0),
        channels=config.channels,
        floors=tuple(s.floor for s in config.sensors),
        windows=len(windows),
        level_range_m_s2=(float(rms.min()), float(rms.max())),
        recordings=recordings,
        span_ns=span_ns,
    )
    if any(t is not None for t in temperatures):
        baseline = _with_temperature(baseline, mean, windows, temperatures, config)
    return baseline, fit


def _with_temperature(
    baseline: Baseline,
    mean: Observation,
    windows: list[ModalEstimate],
    temperatures: Sequence[Temperature | None],
    config: Configuration,
) -> Baseline:
    """The baseline with what the windows' stiffness owes to the temperature, as `damage.step` would read it."""
    fit = update(baseline.model, config.sensor_matrix(), baseline.target(mean), config.updating)
    gain = fit.gain / fit.parameters[:, None]
    changes = []
    for m, felt in zip(windows, temperatures, strict=True):
        o = observe(m, config.updating, mean.gauges if config.updating.use_shapes else None)
        places = tuple((m.refined, m.first + b) for b in range(len(o.deviations)))
        changes.append(temperature_compensation.Change(gain @ (o.z - mean.z), o.deviations @ gain.T, places, felt))
    span_s = (baseline.span_ns[1] - baseline.span_ns[0]) * 1e-9
    known = [float(t.lagged_degc[0]) for t in temperatures if t is not None]
    return replace(
        baseline,
        reference_temperature_degc=float(np.mean(known)),
        temperature=temperature_compensation.learn(changes, span_s, config.temperature),
    )


def _frequency_std(f: Array, z_covariance: Array, log: bool) -> Array:
    std = np.sqrt(np.diag(z_covariance)[: f.size])
    return np.asarray(f * std / 2.0 if log else std / (8.0 * np.pi**2 * f))


class _Strict(Settings):
    """Part of the file: JSON's own types, nothing converted."""

    model_config = ConfigDict(strict=True)


class _Temperature(_Strict):
    """`Dependence`."""

    per_degc: Vector
    covariance: Matrix
    lag_s: float
    reference_degc: float
    range_degc: tuple[float, float]
    extrapolation: float


class _Effect(_Strict):
    """One of `_Reference`."""

    effect: str
    location: str
    parameters: dict[str, float]


class _StandingError(_Strict):
    """`reference.StandingError`."""

    hz: Vector
    real: tuple[Matrix, ...]
    imaginary: tuple[Matrix, ...]
    variance: Vector


class _Reference(_Strict):
    """`StructuralPrior`, as `reference_file` writes it."""

    effects: tuple[_Effect, ...]
    correction: Vector
    mean: Vector
    precision: Matrix
    basis: tuple[Matrix, ...]
    reference_degc: float | None
    error: _StandingError | None = None


class _Content(_Strict):
    """The file: `Baseline` with its model taken apart."""

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
    temperature: _Temperature | None = None
    stiffness_correction_n_per_m: Matrix | None = None
    reference: _Reference | None = None


def _plain(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.ndarray) else value


def save(baseline: Baseline, path: Path) -> None:
    """Write the baseline as JSON, atomically."""
    structure = baseline.model.structure
    own = {
        "format": FORMAT,
        "stiffness_n_per_m": structure.stiffness_n_per_m.tolist(),
        "masses_kg": structure.masses_kg.tolist(),
        "temperature": temperature_compensation.to_plain(baseline.temperature),
        "stiffness_correction_n_per_m": _plain(baseline.model.correction),
        "reference": prior_file.to_plain(baseline.reference),
    }
    content = {name: own[name] if name in own else _plain(getattr(baseline, name)) for name in _Content.model_fields}
    write_atomically(path, json.dumps(content, indent=1, allow_nan=False) + "\n")


def load(path: Path, config: Configuration) -> Baseline:
    """Read a baseline and check that it belongs to this structure.

    Raises
    ------
    MissingInputError, BadInputError
    """
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise BadInputError(f"{path}: not a baseline file (no UTF-8 text); make one with 'calibrate'") from error
    except OSError as error:
        raise MissingInputError(f"{path}: {error.strerror}") from error
    try:
        if (written := json.loads(text)["format"]) != FORMAT:
            raise BadInputError(f"{path}: baseline format {written!r}, expected {FORMAT}; calibrate anew")
        content = _Content.model_validate_json(text)
        loaded = _built(content, config)
    except ValidationError as error:
        raise BadInputError(
            f"{path}: not a baseline file ({settings_problems(error)[0]}); make one with 'calibrate'"
        ) from error
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        raise BadInputError(f"{path}: not a baseline file ({error!r}); make one with 'calibrate'") from error
    problem = _mismatch(loaded, config)
    if problem is not None:
        raise BadInputError(f"{path}: {problem}; calibrate with this structure file")
    return loaded


def _built(c: _Content, config: Configuration) -> Baseline:
    """The baseline of a file's content.

    Raises
    ------
    ValueError, KeyError, TypeError
        If its parts do not fit each other or the structure.
    """
    model = config.model()
    size = model.structure.n_dofs
    # As the calibration knew it: what a diagnosis wrote into the file since then stands in `misfit` already.
    known = c.stiffness_correction_n_per_m
    model = replace(model, correction=None if known is None else np.array(known).reshape(size, size))
    temperature = None if c.temperature is None else c.temperature.model_dump()
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
        temperature=temperature_compensation.from_plain(temperature, len(c.stiffness_n_per_m)),
        recordings=c.recordings,
        span_ns=c.span_ns,
        reference=prior_file.from_plain(reference, model, config.channels),
    )


def _mismatch(b: Baseline, config: Configuration) -> str | None:
    """Why a baseline does not belong to a configuration, or None."""
    drawn, structure = config.structure.structure(), b.model.structure
    n, p, m, c = drawn.n_dofs, drawn.n_stories, len(b.model_mode), len(b.channels)
    floors = tuple(s.floor for s in config.sensors)
    if structure.masses_kg.shape != (n,) or structure.stiffness_n_per_m.shape != (p,):
        return f"the baseline has {structure.stiffness_n_per_m.size} stories, the structure file {p}"
    if (b.channels, b.floors) != (config.channels, floors):
        return f"the baseline's channels are {', '.join(map(str, b.channels))} on floors {b.floors}, not the structure file's"
    if b.log != (config.updating.eigenvalue == "log") or bool(b.gauges) != config.updating.use_shapes:
        return "the baseline was learned with another [updating] eigenvalue or use_shapes"
    n_data = m + len(b.gauges) * (c - 1)
    shapes = {"covariance": (p + n, p + n), "z": (n_data,), "z_covariance": (n_data, n_data), "misfit": (n_data,)}
    shapes |= {name: (m,) for name in ("frequencies_hz", "frequencies_std_hz", "damping_ratio")}
    for name, shape in shapes.items():
        if getattr(b, name).shape != shape:
            return f"the baseline's {name} is damaged"
    if (
        any(i >= n for i in b.model_mode)
        or len(set(b.model_mode)) != m
        or any(g >= c for g in b.gauges)
        or len(b.gauges) not in (0, m)
    ):
        return "the baseline's modes are damaged"
    return None
