"""The healthy baseline: what later windows are compared with."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from monitor import dependence, reference_file
from monitor.config import Configuration
from monitor.dependence import Dependence
from monitor.errors import BadInputError, MissingInputError
from monitor.files import write_atomically
from monitor.model import Model
from monitor.observations import mean_observation
from monitor.reference import Reference
from monitor.results import Array, ModalEstimate, Temperature
from monitor.updating import Observation, Update, counterparts, observe, predict, update

FORMAT = 1


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
    reference: Reference | None = None
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
        changes.append(dependence.Change(gain @ (o.z - mean.z), o.deviations @ gain.T, places, felt))
    span_s = (baseline.span_ns[1] - baseline.span_ns[0]) * 1e-9
    known = [float(t.lagged_degc[0]) for t in temperatures if t is not None]
    return replace(
        baseline,
        reference_temperature_degc=float(np.mean(known)),
        temperature=dependence.learn(changes, span_s, config.temperature),
    )


def _frequency_std(f: Array, z_covariance: Array, log: bool) -> Array:
    std = np.sqrt(np.diag(z_covariance)[: f.size])
    return np.asarray(f * std / 2.0 if log else std / (8.0 * np.pi**2 * f))


_ARRAYS = (
    "covariance",
    "z",
    "z_covariance",
    "misfit",
    "frequencies_hz",
    "frequencies_std_hz",
    "damping_ratio",
)
_PLAIN = (
    "model_mode",
    "gauges",
    "log",
    "channels",
    "floors",
    "windows",
    "level_range_m_s2",
    "reference_temperature_degc",
    "recordings",
    "span_ns",
)


def save(baseline: Baseline, path: Path) -> None:
    """Write the baseline as JSON, atomically."""
    structure = baseline.model.structure
    content = {
        "format": FORMAT,
        "stiffness_n_per_m": structure.stiffness_n_per_m.tolist(),
        "masses_kg": structure.masses_kg.tolist(),
        **{name: getattr(baseline, name).tolist() for name in _ARRAYS},
        **{name: getattr(baseline, name) for name in _PLAIN},
        "temperature": dependence.to_plain(baseline.temperature),
        "stiffness_correction_n_per_m": None
        if baseline.model.correction is None
        else baseline.model.correction.tolist(),
        "reference": reference_file.to_plain(baseline.reference),
    }
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
        content = json.loads(text)
        if content["format"] != FORMAT:
            raise BadInputError(f"{path}: baseline format {content['format']!r}, expected {FORMAT}; calibrate anew")
        arrays: dict[str, Any] = {name: np.array(content[name], dtype=float) for name in _ARRAYS}
        stiffness, masses = (np.array(content[name], dtype=float) for name in ("stiffness_n_per_m", "masses_kg"))
        plain = {name: content[name] for name in _PLAIN}
        for name in ("model_mode", "gauges", "channels", "floors", "level_range_m_s2", "recordings", "span_ns"):
            plain[name] = tuple(plain[name])
        plain["temperature"] = dependence.from_plain(content.get("temperature"), stiffness.size)
        # As the calibration knew it: what a diagnosis wrote into the file since then stands in `misfit` already.
        correction = content.get("stiffness_correction_n_per_m")
        model = config.model()
        size = model.structure.n_dofs
        known = None if correction is None else np.array(correction, dtype=float).reshape(size, size)
        model = replace(model, correction=known)
        plain["reference"] = reference_file.from_plain(content.get("reference"), model, config.channels)
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        raise BadInputError(f"{path}: not a baseline file ({error!r}); make one with 'calibrate'") from error
    loaded = Baseline(model=model.with_stiffness(stiffness).with_masses(masses), **arrays, **plain)
    problem = _mismatch(loaded, config)
    if problem is not None:
        raise BadInputError(f"{path}: {problem}; calibrate with this structure file")
    return loaded


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
        value = getattr(b, name)
        if value.shape != shape or not np.isfinite(value).all():
            return f"the baseline's {name} is damaged"
    positive = np.concatenate([structure.masses_kg, structure.stiffness_n_per_m])
    if not (np.isfinite(positive).all() and positive.min() > 0):
        return "the baseline's masses and stiffnesses are damaged"
    if (
        any(not 0 <= i < n for i in b.model_mode)
        or any(not 0 <= g < c for g in b.gauges)
        or len(b.gauges) not in (0, m)
    ):
        return "the baseline's modes are damaged"
    return None
