"""Recordings as arrays."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import tzinfo
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from drivers.base import ACCELERATION, FORCE, GROUND, SampleBlock
from drivers.mcap_file import read_recordings
from monitor.core import Array, BadInputError, import_extra, read_by_user
from monitor.runs import Options, as_recordings

_LEAST_FILLED = 0.1
"""Least share of a recording's time that must hold samples to be laid out as one array. [ratio; judgement: memory]"""


@dataclass(frozen=True, eq=False, slots=True)
class Recording:
    """Samples of one recording on one clock."""

    samples: Annotated[Array, "samples c"]
    """Accelerations, m/s^2; NaN where samples are missing."""
    rate_hz: float
    channels: tuple[str, ...]
    start_ns: int
    """UTC of the first sample, ns since 1970."""
    ground: Annotated[Array, "samples"] | None = None
    """Measured ground acceleration, m/s^2; None where it was not measured."""
    force: Annotated[Array, "samples inputs"] | None = None
    """Measured forces, N; None where none was measured."""
    covariates: Mapping[str, Annotated[Array, "samples c"]] = field(default_factory=dict)
    """Other quantities at the rate of the accelerations, by their topics, as "wind", in the unit of the file; degC."""

    @property
    def duration_s(self) -> float:
        """Length."""
        return len(self.samples) / self.rate_hz

    def plot(self, axes: Any = None) -> Any:
        """Draw the channels over time; return the axes of matplotlib. Needs the extra ``plot``."""
        axes = import_extra("matplotlib.pyplot", "plot()").gca() if axes is None else axes
        axes.plot(np.arange(len(self.samples)) / self.rate_hz, self.samples, linewidth=0.5, label=self.channels)
        axes.set(xlabel="time, s", ylabel="acceleration, m/s$^2$")
        axes.legend(loc="upper right")
        return axes


def read(
    file: str | Path,
    *,
    unit: str | None = None,
    rate_hz: float | None = None,
    start_ns: int | None = None,
    zone: tzinfo | None = None,
    time: str | None = None,
    channels: dict[str, str] | None = None,
    covariates: dict[str, str] | None = None,
    ground: str | None = None,
    forces: dict[str, str] | None = None,
    scale: float | None = None,
    inventory: str | Path | None = None,
    dbc: str | Path | None = None,
    bus: str | None = None,
) -> Recording:
    """Read a recording (MCAP), or a file of any format that `import` reads, as arrays in SI units.

    All but `file` is of such files, and says what they do not.

    Parameters
    ----------
    unit
        Unit of columns whose file states none: m/s^2 (by default), g, mg, gal.
    rate_hz
        Rate of a file without times.
    start_ns
        UTC of the first sample, ns since 1970; by default what the file tells, or 0 where it tells nothing.
    zone
        Zone of times that state none; by default UTC.
    time
        Column of the times, where it is not found.
    channels, covariates, forces
        Name of a channel, of a quantity beside, of a force in N -> its column.
    ground
        Column of the base motion.
    scale, inventory
        m/s^2 of a count, or StationXML with the channels' sensitivities, where a file holds counts.
    dbc, bus
        Of a CAN log: the file with the layout of its frames, and one bus of several.

    Raises
    ------
    UserError
        The file does not exist, cannot be read, or is no recording.

    Warns
    -----
    UserWarning
        The file ends early, samples are missing, or clocks disagree.

    Examples
    --------
    >>> import tempfile, shm_monitor as shm
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     table = Path(folder, "a.csv")
    ...     _ = table.write_text("t,top [g]\\n0.00,0.1\\n0.01,0.2\\n0.02,0.1\\n")
    ...     record = shm.read(table, start_ns=0)
    >>> record.rate_hz, record.channels, record.samples[1].round(3)
    (100.0, ('top',), array([1.961]))
    """
    path, told = Path(file), list[str]()
    options = Options(
        unit=unit,
        rate_hz=rate_hz,
        start_ns=start_ns,
        unknown_start_ns=0,
        zone=zone,
        time=time,
        channels=channels,
        covariates=covariates,
        ground=ground,
        forces=forces,
        scale=scale,
        inventory=None if inventory is None else Path(inventory),
        dbc=None if dbc is None else Path(dbc),
        bus=bus,
    )
    try:
        with as_recordings([path], options, told.append, ask_unit=lambda _: "m/s^2") as (recording,):
            return _gathered(recording, told.append)
    finally:
        for message in told:
            warnings.warn(message, stacklevel=2)  # at the caller's line


def _gathered(path: Path, on_warning: Callable[[str], None]) -> Recording:
    """Read the blocks of a recording and lay them out on one grid."""
    of: dict[str, list[SampleBlock]] = {topic: [] for topic in (ACCELERATION, GROUND, FORCE)}
    with read_by_user():
        for block in read_recordings([path], None, on_warning=on_warning):
            of.setdefault(block.topic, []).append(block)
    first = of[ACCELERATION][0]
    samples = _laid_out(path, of.pop(ACCELERATION), first, None)
    ground, force = (_laid_out(path, of.pop(topic), first, len(samples)) for topic in (GROUND, FORCE))
    beside = {}
    for topic, blocks in of.items():
        if blocks[0].sample_rate_hz == first.sample_rate_hz:
            beside[topic.strip("/")] = _laid_out(path, blocks, first, len(samples))
        else:
            rates = f"{blocks[0].sample_rate_hz:g} Hz, and the accelerations {first.sample_rate_hz:g} Hz"
            on_warning(f"{path}: {topic} is left out: it has {rates}")
    return Recording(
        samples,
        first.sample_rate_hz,
        first.channels,
        first.t_ns,
        ground=ground[:, 0] if ground.size else None,
        force=force if force.size else None,
        covariates=beside,
    )


def _laid_out(path: Path, blocks: list[SampleBlock], first: SampleBlock, n: int | None) -> Annotated[Array, "n c"]:
    """Place the samples of blocks by their times on the grid of the block `first`; NaN where there are none."""
    if not blocks:
        return np.zeros((0, 0))
    rate_hz = first.sample_rate_hz
    if any(b.sample_rate_hz != rate_hz or b.channels != blocks[0].channels for b in blocks):
        raise BadInputError(f"{path}: rate or channels change within the recording; read its parts one by one")
    places = [round((block.t_ns - first.t_ns) * 1e-9 * rate_hz) for block in blocks]
    end = max(place + block.n_samples for place, block in zip(places, blocks, strict=True)) if n is None else n
    if sum(block.n_samples for block in blocks) < _LEAST_FILLED * end:
        raise BadInputError(f"{path}: gaps fill most of it; read its parts one by one")
    values = np.full((end, len(blocks[0].channels)), np.nan)
    for place, block in zip(places, blocks, strict=True):
        here = slice(max(place, 0), min(place + block.n_samples, end))
        values[here] = block.samples[here.start - place : here.stop - place]
    return values
