"""What the page of an event shows beyond its line: drifts over time, force-drift loops, energy, and the first mode over time."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from drivers.base import ACCELERATION, GROUND, SampleBlock
from monitor.core import Array, Skipped
from monitor.events import ground
from monitor.events.description import drift_accelerations, inertia_above
from monitor.events.ground import Ground, GroundState
from monitor.events.motion import integrated
from monitor.events.recognition import STEP_S
from monitor.events.record import Record, make_record, relative_motion
from monitor.events.site import Site
from monitor.signals import Conditioner, FrontEnd, alignment, conditioned

_STRETCH_PERIODS = 10.0
"""Periods of the first mode in a stretch of which its frequency and damping are told. [count; judgement: a few, of which the
standard deviation is stated]"""
_FEWEST_STRETCHES = 3
"""Fewest stretches before and after the strongest motion that are compared. [count; judgement]"""
_BAND_OF_FIRST = (0.5, 1.5)
"""Band about the first mode's frequency in which they are fitted. [ratio; judgement: other modes lie outside]"""
_TOLD_FREQUENCY = 0.02
"""Largest relative standard deviation of a frequency that is told. [ratio; judgement]"""


@dataclass(frozen=True, eq=False, slots=True)
class FirstMode:
    """Frequency and damping of the first mode during the event, stretch by stretch.

    In each stretch the motion of the mode obeys ``a = -(2 pi f)^2 q - 2 (2 pi f) zeta v``: `a` its absolute acceleration, `q` and
    `v` its displacement and velocity relative to the ground, so that what the ground does needs no model.
    """

    t_s: Annotated[Array, "k"]
    """Middle of each stretch, from the begin of the event."""
    hz: Annotated[Array, "k"]
    hz_std: Annotated[Array, "k"]
    damping: Annotated[Array, "k"]
    damping_std: Annotated[Array, "k"]
    level_m: Annotated[Array, "k"]
    """Largest relative displacement of the mode at the top in each stretch."""

    @property
    def change(self) -> tuple[float, float, float, float] | None:
        """Relative change of the frequency from before the strongest motion to after it, at like levels of motion.

        The frequency is fitted as a line over the level's logarithm, with a step, to the stretches of levels that there were on
        both sides.  None where there were fewer than three on one of them.  Then follow its standard deviation, and the lowest
        and the highest level compared, m.
        """
        strongest = int(self.level_m.argmax())
        after = np.arange(self.level_m.size) > strongest
        sides = self.level_m[~after], self.level_m[after]
        if min(side.size for side in sides) < _FEWEST_STRETCHES:
            return None
        low, high = max(side.min() for side in sides), min(side.max() for side in sides)
        used = (self.level_m >= low) & (self.level_m <= high)
        if min(int((used & after).sum()), int((used & ~after).sum())) < _FEWEST_STRETCHES:
            return None
        level = np.log(self.level_m[used])
        design = np.column_stack([np.ones(level.size), level - level.mean(), after[used]]) / self.hz_std[used, None]
        measured = self.hz[used] / self.hz_std[used]
        covariance = np.linalg.inv(design.T @ design)
        found = covariance @ design.T @ measured
        left = measured - design @ found
        # Stretches overlap by half: each tells half of what it would alone.
        spread = 2.0 * max(1.0, float(left @ left) / max(0.5 * measured.size - 3.0, 1.0))
        return float(found[2] / found[0]), float(np.sqrt(spread * covariance[2, 2]) / found[0]), float(low), float(high)


@dataclass(frozen=True, eq=False, slots=True)
class Review:
    """Motion of one event over time."""

    record: Record
    t_s: Annotated[Array, "samples"]
    """From the begin of the event."""
    drift_m: Annotated[Array, "samples n"]
    """Drift of each story above the corner; NaN where no sensors tell."""
    force_n: Annotated[Array, "samples n"] | None
    """Force of each story, above the corner; None without a measured ground or a sensor on every floor."""
    energy_j: Annotated[Array, "n"]
    """Energy dissipated in each story from begin to end; NaN where it is not known."""
    energy_per_ms_j: Annotated[Array, "n"]
    """Its change for a skew of 1 ms between force and drift."""
    channels: tuple[str, ...]
    lost: Annotated[Array, "c"]
    """Share of each channel's samples that are not finite, in the whole recording."""
    gaps: int
    """Gaps in the whole recording."""
    first_mode: FirstMode | None
    """None without a measured ground."""


@dataclass(eq=False, slots=True)
class _Run:
    """Conditioned samples without a gap."""

    t_ns: int
    conditioner: Conditioner
    values: list[Array] = field(default_factory=list)
    n: int = 0
    """Samples before conditioning."""
    n_lost: Annotated[Array, "c"] = field(default_factory=lambda: np.zeros(0))
    """Those that are not finite."""


def review_event(
    blocks: Iterable[SampleBlock], front_end: FrontEnd, site: Site, begin_ns: int, end_ns: int, corner_hz: float
) -> Review | Skipped:
    """Compute what an event's recording shows, with the front end of the run that recognized it and the corner of its drifts."""
    runs, pieces = _conditioned(blocks, front_end)
    for run in runs:
        conditioner, rate_hz = run.conditioner, run.conditioner.rate_hz
        drop = round(STEP_S * rate_hz)  # within a step the filters, which begin at rest, settle
        values = np.concatenate(run.values)[drop:] if run.values else np.zeros((0, 1))
        t_ns = run.t_ns + round((drop / rate_hz - conditioner.delay_s) * 1e9)
        begin, end = (round((at - t_ns) * 1e-9 * rate_hz) for at in (begin_ns, end_ns))
        if 0 <= begin < len(values):
            strong = slice(begin, min(end, len(values)))
            values, kept = _cut_to_ground(values, t_ns, rate_hz, strong, pieces[0])
            record = make_record(values, t_ns, conditioner, pieces if kept else ((), None), strong, site)
            lost = np.sum([r.n_lost for r in runs], axis=0) / sum(r.n for r in runs)
            return _review(record, site, corner_hz, lost, len(runs) - 1)
    return Skipped("the event's recording does not hold it")


def _conditioned(
    blocks: Iterable[SampleBlock], front_end: FrontEnd
) -> tuple[list[_Run], tuple[Sequence[Ground], Conditioner | None]]:
    """Condition the samples of floors and ground as the pipeline does."""
    align, filters, runs = alignment.start(), None, list[_Run]()
    base, moved = GroundState(), list[Ground]()
    for block in blocks:
        if block.topic == GROUND:
            base, new = ground.step(base, block, front_end)
            moved += new
        if block.topic != ACCELERATION:
            continue
        align, pieces = front_end.align(align, block, keep_partial=True)
        for piece in pieces:
            filters, part = conditioned.step(filters, piece, front_end)
            if part.begins:
                runs.append(_Run(part.t0_ns, part.conditioner, n_lost=np.zeros(len(front_end.channels))))
            run = runs[-1]
            run.t_ns = part.t0_ns
            run.values.append(part.values)
            run.n += len(piece.values)
            run.n_lost = run.n_lost + (0 if piece.lost is None else piece.lost.sum(axis=0))
    return runs, (moved, base.conditioner)


def _cut_to_ground(
    values: Array, t_ns: int, rate_hz: float, strong: slice, moved: Sequence[Ground]
) -> tuple[Array, bool]:
    """Cut samples at the end of the ground's, which may end a little earlier; say whether these cover the strong motion."""
    if not moved:
        return values, False
    last_ns = max(g.t_ns + round((g.values.size - 1) / g.rate_hz * 1e9) for g in moved)
    n = min(len(values), int((last_ns - t_ns) * 1e-9 * rate_hz))
    return (values[:n], True) if n >= strong.stop else (values, False)


def _review(record: Record, site: Site, corner_hz: float, lost: Array, gaps: int) -> Review:
    """Compute drifts, forces, energy and the first mode from an event's samples."""
    n = len(site.drifts)
    rate_hz, strong = record.rate_hz, record.strong
    # Acceleration, velocity and displacement of the drifts.
    moved = np.full((3, len(record.floors), n), np.nan)
    if site.tells_drifts:
        told, accelerations = drift_accelerations(record, site)
        for times in range(3):
            moved[times][:, told] = integrated(accelerations, rate_hz, corner_hz, times)
    whole = np.linalg.matrix_rank(site.sensors) == site.sensors.shape[1] and not record.still.any()
    force, energy, per_ms, first = None, np.full(n, np.nan), np.full(n, np.nan), None
    if record.ground is not None and site.is_chain and whole:
        # The force on the lower floor: it acts against the drift.  The same filter as that of the drift, for the loop.
        force = -integrated(inertia_above(record, site), rate_hz, corner_hz, 0)
        energy = (force * moved[1])[strong].sum(axis=0) / rate_hz
        per_ms = 1e-3 * np.abs((force * moved[0])[strong].sum(axis=0)) / rate_hz
    if record.ground is not None and whole:
        first = _first_mode(record, site)
    t_s = (np.arange(len(record.floors)) - strong.start) / rate_hz
    return Review(record, t_s, moved[2], force, energy, per_ms, site.channels, lost, gaps, first)


def _first_mode(record: Record, site: Site) -> FirstMode | None:
    """Fit frequency and damping of the first mode in stretches of the motion; None where no stretch, or no mode, tells them."""
    assert record.ground is not None
    if not site.modes_hz.size:
        return None
    near_hz, rate_hz = float(site.modes_hz[0]), record.rate_hz
    relative = relative_motion(record, site)
    project = np.linalg.pinv(site.shapes)[:, 0] * site.shapes[0, np.abs(site.shapes[0]).argmax()]
    absolute = record.floors @ project
    columns = np.column_stack([absolute, relative @ project, relative @ project])
    a, v, q = (_band(columns[:, i], rate_hz, near_hz, times) for i, times in enumerate((0, 1, 2)))
    length = max(8, round(_STRETCH_PERIODS * rate_hz / near_hz))
    # Samples of motion in a band of this width that tell something new.
    independent = length / rate_hz * (_BAND_OF_FIRST[1] - _BAND_OF_FIRST[0]) * near_hz
    rows = []
    for first in range(0, len(a) - length + 1, length // 2):
        part = slice(first, first + length)
        known = np.column_stack([q[part], v[part]])
        normal = known.T @ known
        if np.linalg.matrix_rank(normal) < 2:
            continue
        x = np.linalg.solve(normal, -known.T @ a[part])
        left = a[part] + known @ x
        covariance = (
            np.linalg.inv(normal) * (left @ left) / max(2.0 * independent - 2.0, 1.0) * (length / (2.0 * independent))
        )
        if x[0] <= 0.0:
            continue
        w = np.sqrt(x[0])
        w_std, zeta_std = np.sqrt(covariance[0, 0]) / (2.0 * w), np.sqrt(covariance[1, 1]) / (2.0 * w)
        if w_std < _TOLD_FREQUENCY * w:
            middle_s = (first + 0.5 * length - record.strong.start) / rate_hz
            rows.append((middle_s, w, w_std, x[1] / (2.0 * w), zeta_std, np.abs(q[part]).max()))
    if not rows:
        return None
    t_s, w, w_std, zeta, zeta_std, level = np.array(rows).T
    return FirstMode(t_s, w / (2.0 * np.pi), w_std / (2.0 * np.pi), zeta, zeta_std, level)


def _band(motion: Annotated[Array, "n"], rate_hz: float, near_hz: float, times: int) -> Annotated[Array, "n"]:
    """Integrate a motion so many times within the band of the first mode, without phase."""
    n = motion.size
    hz = np.fft.rfftfreq(2 * n, 1.0 / rate_hz)
    low, high = (share * near_hz for share in _BAND_OF_FIRST)
    response = np.zeros(hz.size, dtype=complex)
    response[1:] = (2j * np.pi * hz[1:]) ** -times
    # Raised cosine flanks of half an octave, so that the band's edges do not ring.
    octaves = np.log2(np.maximum(hz, 1e-9))
    rise = np.clip((octaves - np.log2(low)) * 2.0 + 1.0, 0.0, 1.0)
    fall = np.clip((np.log2(high) - octaves) * 2.0 + 1.0, 0.0, 1.0)
    response *= 0.25 * (1.0 - np.cos(np.pi * rise)) * (1.0 - np.cos(np.pi * fall))
    return np.asarray(np.fft.irfft(np.fft.rfft(motion - motion.mean(), 2 * n) * response)[:n])
