"""A tower whose frequencies follow the hours."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from monitor.identification import TrackSettings, tracking

TOWER = Path(__file__).parents[1] / "data" / "tower-modal" / "tower.npz"
HOUR_NS = 3_600_000_000_000
DAY_NS = 24 * HOUR_NS
SETTINGS = TrackSettings()


class Tower:
    """Three weeks of a mast, hour by hour: 2877 automatically identified modes, nobody's labels."""

    def __init__(self) -> None:
        with np.load(TOWER) as data:
            self.t_ns, self.temperature = data["t_ns"], data["temperature_c"]
            self.look, self.f = data["look"], data["frequency_hz"].astype(float)
            std, self.shape = data["std_hz"].astype(float), data["shape"].astype(float) @ [1, 1j]
        self.track = np.full(self.look.size, -1)
        self.births: list[int] = []
        self.deaths: list[int] = []
        state = tracking.TrackState()
        for k in np.unique(self.look):
            q = self.look == k
            seen = tracking.Observed(self.f[q], std[q], self.shape[q], 3600.0)
            state, tracked = tracking.step(state, seen, int(self.t_ns[k]), SETTINGS)
            self.track[q] = tracked.observed
            self.births += tracked.births
            self.deaths += tracked.deaths
        self.tracks = {t.number: t for t in state.tracks if t.number >= 0}

    def alike(self, low: float, high: float) -> list[np.ndarray]:
        """The band's two commonest shapes, and the observations that are like each (over all weeks, whenever)."""
        band = np.flatnonzero((self.f > low) & (self.f < high))
        shape = self.shape[band] / np.linalg.norm(self.shape[band], axis=1)[:, None]
        mac = np.abs(shape.conj() @ shape.T) ** 2
        first = (mac > 0.8).sum(axis=1).argmax()
        second = ((mac > 0.8).sum(axis=1) * (mac[first] < 0.5)).argmax()
        return [band[mac[seed] > 0.8] for seed in (first, second)]
