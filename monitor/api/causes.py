"""Diagnoses of samples: what the structural model gets wrong, and why."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Any

from drivers.base import ACCELERATION, FORCE, GROUND, SampleBlock
from monitor.api.samples import checked
from monitor.api.structures import Structure
from monitor.core import Array, import_extra, single_blas_thread
from monitor.inference import gather
from monitor.runs import cut_into_blocks, diagnose as job


@dataclass(frozen=True, slots=True)
class Cause:
    """An effect at a place, with its sizes or its probability."""

    effect: str
    """Name of the effect, as in docs/effects.md."""
    location: str
    """``story 2``, ``floor 1``, ``channel a2``, ``base`` or ``frame``."""
    says: str
    """The same in words."""
    parameters: dict[str, tuple[float, float]]
    """Value and standard deviation of each parameter, whose name ends in its unit; empty for an alternative."""
    probability: float | None = None
    """Of an alternative; None for an accepted cause."""


@dataclass(frozen=True, eq=False, slots=True)
class Diagnosis:
    """What the simulation gets wrong."""

    verdict: str
    """``none``, ``named``, ``ambiguous`` or ``unexplained``."""
    says: str
    """The verdict in one sentence."""
    causes: tuple[Cause, ...]
    """Accepted causes, in order."""
    alternatives: tuple[Cause, ...]
    """Causes that these data cannot tell apart, where the verdict is ``ambiguous``."""
    gain: float
    """Gain on held-out data, nats a sample."""
    gain_ci95: tuple[float, float]
    """Its 95 % interval."""
    content: dict[str, Any]
    """Content of diagnosis.json, with everything else."""

    def __str__(self) -> str:
        told = [f"  {100 * (cause.probability or 0.0):.0f} %: {cause.says}" for cause in self.alternatives]
        return "\n".join([f"{self.verdict}: {self.says}", *told])

    def plot(self, axes: Any = None) -> Any:
        """Draw how much better each tried effect explains the data than none, and return the axes of matplotlib.

        Needs the extra ``plot``.
        """
        axes = import_extra("matplotlib.pyplot", "plot()").gca() if axes is None else axes
        tried = sorted(self.content["tried"], key=lambda row: row["log_evidence_over_none"])
        names = [f"{row['effect']}, {row['location']}" for row in tried]
        axes.barh(names, [row["log_evidence_over_none"] for row in tried])
        axes.set(xlabel="log evidence over none, nats")
        return axes


@single_blas_thread()
def diagnose(
    samples: Annotated[Any, "samples c"],
    rate_hz: float,
    structure: Structure,
    *,
    ground: Annotated[Any, "samples"] = None,
    force: Annotated[Any, "samples inputs"] = None,
) -> Diagnosis:
    """Find what the simulation of a structure gets wrong about samples, and why.

    Parameters
    ----------
    samples : array, m/s^2
        Accelerations without a gap, 70 s or more: the structure's channels in its order.
    structure
        With a baseline, what has changed since then; without one, what differs from the structure file.
    ground : array, m/s^2, optional
    force : array, N, optional
        Measured forces, in the order of the structure's inputs.

    Raises
    ------
    UserError
        The samples have another shape, are too short or are not finite.

    Examples
    --------
    >>> import shm_monitor as shm
    >>> frame = shm.structure(masses_kg=[1000.0, 1000.0], stiffness_n_per_m=[2e6, 2e6])
    >>> record = shm.simulate(frame, duration_s=80, rate_hz=100, effects=["sensor_polarity:channel a2"], seed=1)
    >>> found = shm.diagnose(record.samples, record.rate_hz, frame)
    >>> found.verdict, sorted(cause.says for cause in found.alternatives)[0]  # of two channels, which one cannot be told
    ('ambiguous', 'channel a1 is upside down: its sign is reversed')
    """
    config = structure.config
    streams = {ACCELERATION: (structure.channels, "m/s^2", checked(samples, rate_hz, structure.channels))}
    if ground is not None:
        streams[GROUND] = (("ground",), "m/s^2", checked(ground, rate_hz, ("ground",)))
    if force is not None:
        names = tuple(table.channel for table in config.inputs)
        streams[FORCE] = (names, "N", checked(force, rate_hz, names))
    segments = gather(_blocks(streams, rate_hz), config.front_end())
    content = job.diagnose_gathered(segments, config, structure.baseline).content
    gain = content["gain"]["log_score_per_sample"]
    return Diagnosis(
        verdict=content["verdict"],
        says=content["says"],
        causes=tuple(_cause(row) for row in content["causes"]),
        alternatives=tuple(_cause(row) for row in content["alternatives"]),
        gain=gain["gain"],
        gain_ci95=(gain["ci95"][0], gain["ci95"][1]),
        content=content,
    )


def _blocks(streams: dict[str, tuple[tuple[str, ...], str, Array]], rate_hz: float) -> Iterator[SampleBlock]:
    """Cut the streams into blocks of a second, those of the same second together."""
    cut = [
        cut_into_blocks(topic, values, channels, rate_hz, 0, max(1, round(rate_hz)), unit=unit)
        for topic, (channels, unit, values) in streams.items()
    ]
    for together in zip(*cut, strict=True):
        yield from together


def _cause(row: dict[str, Any]) -> Cause:
    """Read a cause or an alternative of diagnosis.json."""
    sizes = {name: (size["value"], size["std"]) for name, size in row.get("parameters", {}).items()}
    return Cause(row["effect"], row["location"], row.get("says", ""), sizes, row.get("probability"))
