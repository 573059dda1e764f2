"""Description of an event from its samples: drifts by the best that the sensors allow, and the site's limits."""

from __future__ import annotations

from itertools import compress
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from monitor.core import Array
from monitor.events.early_loss import early_loss
from monitor.events.event import Event
from monitor.events.expansion import expanded_drifts
from monitor.events.limits import judge
from monitor.events.motion import (
    floor_motion,
    instrumental_intensity,
    integrated,
    modal_frequencies,
    peak_drifts,
    response_spectrum,
    unknown_motion,
)
from monitor.events.record import Record, relative_motion
from monitor.events.site import Site

_UNRELATED = 1e-9
"""Share of a drift that a sensor must see to tell of it. [ratio; rounding]"""


def describe(
    record: Record,
    site: Site,
    *,
    id: str,
    revision: int | None,
    begin_ns: int,
    end_ns: int,
    before_hz: Annotated[Array, "m"],
    note: str = "",
    saturated: Annotated[NDArray[np.bool_], "c"] | None = None,
    cut: bool = False,
) -> Event:
    """Measure an event from its samples, and compare it with the limits.

    `saturated` channels reached the end of their range; of an event that is `cut` some motion is missing.
    """
    rate_hz, strong = record.rate_hz, record.strong
    drift, std, corner_hz, limits = story_drifts(record, site)
    live = ~record.still
    if saturated is None or not saturated.size:
        saturated = np.zeros(live.size, dtype=bool)
    cut_off, gone = tuple(compress(site.channels, saturated)), ", ".join(compress(site.channels, record.still))
    std = np.where(_made_of(saturated, record, site) | cut, np.nan, std)
    floors = tuple(
        floor_motion(name, record.floors[:, i], rate_hz, corner_hz, strong) if live[i] else unknown_motion(name)
        for i, name in enumerate(site.channels)
    )
    ground = None if record.ground is None else floor_motion("ground", record.ground, rate_hz, corner_hz, strong)
    intensity = None if ground is None else instrumental_intensity(ground.peak_m_s2, ground.peak_m_s)
    heights = np.full(len(site.drifts), np.nan) if site.heights_m is None else site.heights_m
    near_hz = np.where(np.isfinite(before_hz), before_hz, site.modes_hz)
    after = np.full(site.modes_hz.size, np.nan)
    loss, loss_std = np.full((2, site.n_stories), np.nan)
    notes = [note]
    if cut_off:
        notes.append(f"{', '.join(cut_off)} reached the end of the range: peaks and drifts made of it are lower bounds")
    if cut:
        notes.append("some of it is missing: peaks and drifts are lower bounds")
    if gone:
        notes.append(f"{gone} gave no motion, and nothing is told from it")
    notes.append(limits)
    if revision is not None:
        loss, loss_std, early = early_loss(record, site, near_hz)
        notes.append(early)
        if len(record.floors) - strong.stop > rate_hz / site.lowest_hz:
            after = modal_frequencies(record.floors[strong.stop :, live], site.shapes[:, live], near_hz, rate_hz)
    relative = relative_motion(record, site)
    return judge(
        Event(
            id=id,
            revision=revision,
            begin_ns=begin_ns,
            end_ns=end_ns,
            floors=floors,
            ground=ground,
            spectrum=None if record.ground is None else response_spectrum(record.ground, rate_hz),
            instrumental_intensity=intensity,
            corner_hz=corner_hz,
            drift_m=drift,
            drift_std_m=std,
            drift_ratio=drift / heights,
            before_hz=before_hz,
            during_hz=modal_frequencies(relative[strong][:, live], site.shapes[:, live], near_hz, rate_hz),
            after_hz=after,
            loss=loss,
            loss_std=loss_std,
            verdict=None,
            saturated=cut_off,
            cut=cut,
            drift_corner_m=corner_drifts(record, site, corner_hz),
            note="; ".join(filter(None, notes)),
        ),
        site,
    )


def story_drifts(record: Record, site: Site) -> tuple[Annotated[Array, "n"], Annotated[Array, "n"], float, str]:
    """Compute the largest dynamic drift of each story and its standard deviation, m, the corner in Hz, and a note.

    Where sensors move as both floors of a story, their accelerations are integrated.  For a story that they do not enclose, as
    the lowest one without a measured ground, the drift follows from the inertia of the floors above over the story's stiffness,
    if every floor has a sensor; its standard deviation is the most by which the same estimate is wrong in another story.  Where a
    floor has no sensor and the ground is measured, model and ground tell what the sensors do not (`expansion`).
    """
    live = ~record.still
    n, sensors = len(site.drifts), site.sensors[live]
    drift, std, corner_hz = np.full(n, np.nan), np.full(n, np.nan), float(record.corners_hz[0])
    if not site.tells_drifts:
        known = (
            "the structure's stiffnesses are no stories" if n else "nothing is known of the structure but its channels"
        )
        return drift, std, corner_hz, f"no drifts: {known}"
    told, accelerations = drift_accelerations(record, site)
    rest = ~told
    if told.any():
        drift[told], std[told], corner_hz = peak_drifts(accelerations, record.rate_hz, record.corners_hz, record.strong)
    note = f"drifts are dynamic, above {corner_hz:.2g} Hz: a permanent one is not seen"
    if told.all():
        return drift, std, corner_hz, note
    if record.ground is not None and live.all() and site.damping.size and site.is_chain:
        # The file states the sensors; one that fails in the motion may do so where the structure does.
        drift[rest], std[rest] = (values[rest] for values in expanded_drifts(record, site))
        gone = ", ".join(compress(site.names, rest))
        limits = f"without a sensor on every floor the model and the ground tell those of {gone}"
    elif np.linalg.matrix_rank(sensors) < sensors.shape[1]:
        limits = "without a sensor on every floor, or without a measured ground, some are not known"
    elif not told.any():
        limits = "without a measured ground the drift of the one story is not known"
    else:
        by_inertia = _drifts_by_inertia(record, site)
        moved = told & (drift != 0.0)
        error = np.abs(by_inertia[moved] / drift[moved] - 1.0).max() if moved.any() else np.nan
        drift[rest], std[rest] = by_inertia[rest], error * by_inertia[rest]
        limits = "without a measured ground the lowest story's follows from its stiffness"
    return drift, std, corner_hz, f"{note}; {limits}"


def corner_drifts(record: Record, site: Site, corner_hz: float) -> Annotated[Array, "n"]:
    """Compute the largest drift of each storey at the corners of its plan, m; NaN where no sensors tell, else empty."""
    if not site.corners.size:
        return np.zeros(0)
    told, weights = _weights(record, site, site.corners)
    accelerations = relative_motion(record, site)[:, ~record.still] @ weights
    moved = integrated(accelerations, record.rate_hz, corner_hz, 2)[record.strong].reshape(-1, len(told) // 8, 4, 2)
    largest = np.sqrt((moved**2).sum(axis=3)).max(axis=(0, 2))
    return np.asarray(np.where(told.reshape(-1, 8).all(axis=1), largest, np.nan))


def drift_accelerations(
    record: Record, site: Site
) -> tuple[Annotated[NDArray[np.bool_], "n"], Annotated[Array, "samples told"]]:
    """Find the stories both floors of which sensors move as, and compute the accelerations of these stories' drifts, m/s^2."""
    told, weights = _weights(record, site, site.drifts)
    return told, relative_motion(record, site)[:, ~record.still] @ weights[:, told]


def _weights(
    record: Record, site: Site, drifts: Annotated[Array, "n floors"]
) -> tuple[Annotated[NDArray[np.bool_], "n"], Annotated[Array, "c n"]]:
    """Find the drifts that sensors tell, and the weights on the live channels that give them."""
    sensors, rides = site.sensors[~record.still], site.rides[~record.still]
    # Without a ground they must not move with it.
    weights, *_ = np.linalg.lstsq(sensors.T, drifts.T, rcond=None)
    exact = np.abs(sensors.T @ weights - drifts.T).max(axis=0) < _UNRELATED
    rigid = np.abs(rides @ weights) < _UNRELATED
    return np.asarray(exact & (rigid | (record.ground is not None))), np.asarray(weights)


def _made_of(
    channels: Annotated[NDArray[np.bool_], "c"], record: Record, site: Site
) -> Annotated[NDArray[np.bool_], "n"]:
    """Find the stories whose drift some of the channels enter: by the model all of them enter every drift."""
    told, weights = _weights(record, site, site.drifts)
    entering = np.abs(weights[channels[~record.still]]).max(axis=0, initial=0.0) > _UNRELATED
    return np.asarray(np.where(told, entering, channels.any()))


def inertia_above(record: Record, site: Site) -> Annotated[Array, "samples n"]:
    """Compute the inertia of all floors above each story, N, by their absolute accelerations.

    Every floor must have a sensor.  The force of a story, which includes that of its damper, holds up this inertia.
    """
    quiet = record.floors[: max(record.strong.start, 1)].mean(axis=0)
    floors = np.linalg.lstsq(site.sensors, (record.floors - quiet).T, rcond=None)[0]
    return np.asarray((site.story_forces @ floors).T)


def _drifts_by_inertia(record: Record, site: Site) -> Annotated[Array, "n"]:
    """Compute the largest drift of each story as the inertia of all floors above over its stiffness, m."""
    largest = np.abs(inertia_above(record, site)[record.strong]).max(axis=0)
    return np.asarray(largest / site.stiffness_n_per_m[: largest.size])
