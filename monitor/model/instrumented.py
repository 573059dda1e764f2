"""A model with its sensors: the information on a site that an estimator needs beside the recorded data."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from monitor.core import Array
from monitor.model.effects import Context
from monitor.model.model import Model


@dataclass(frozen=True, eq=False, slots=True)
class InstrumentedModel:
    """A model, the sensors on its floors, and the prior standard deviations of its parameters.

    Examples
    --------
    >>> import numpy as np
    >>> from monitor.model import InstrumentedModel, Model, ShearFrame
    >>> frame = Model(ShearFrame(np.ones(3), np.full(3, 1000.0), 0.01))
    >>> site = InstrumentedModel(frame, channels=("roof", "first"), floors=(1, 3), prior_std=np.full(6, 0.1))
    >>> site.sensor_matrix
    array([[1., 0., 0.],
           [0., 0., 1.]])
    >>> site.context(rate_hz=200.0).channels
    ('roof', 'first')
    """

    model: Model
    channels: tuple[str, ...]
    """Names of the accelerometers."""
    floors: tuple[int | str, ...]
    """Floor (degree of freedom, counted from 1) of each channel; or its place in words, with `rows`."""
    prior_std: Annotated[Array, "p+b"]
    """Relative standard deviations of the stiffnesses, then of the masses."""
    name: str = ""
    kind: str = ""
    """Kind of the structure, as in its file."""
    rate_hz: float | None = None
    """Sample rate after resampling; None where no samples are meant."""
    cutoff_hz: float | None = None
    """Cutoff of the lowpass before resampling."""
    rows: Annotated[Array, "c n"] | None = None
    """What each channel sees of the degrees of freedom; None: the one of its floor."""
    boxes: tuple[tuple[int, int], ...] = ()
    """Channels along x and along y, from 0, of each box that measures both at one place."""

    @property
    def sensor_matrix(self) -> Annotated[Array, "c n"]:
        """Matrix that picks the channels out of the floors' motion."""
        if self.rows is not None:
            return self.rows
        matrix = np.zeros((len(self.floors), self.model.structure.n_dofs))
        matrix[np.arange(len(self.floors)), np.array(self.floors, dtype=int) - 1] = 1.0
        return matrix

    @property
    def stiffness_prior_std(self) -> Annotated[Array, "p"]:
        """Relative standard deviations of the stiffnesses alone."""
        return self.prior_std[: self.model.structure.n_stories]

    def hidden_stiffnesses(self) -> tuple[int, ...]:
        """List the stiffnesses, from 1, that strain in no mode which a sensor sees: of another direction that nothing couples."""
        shapes, rounded = self.model.modes().shapes, float(np.sqrt(np.finfo(float).eps))
        moved, strained = np.abs(self.sensor_matrix @ shapes), np.abs(self.model.structure.drift_matrix() @ shapes)
        seen = moved.max(axis=0) > rounded * moved.max()
        told = strained[:, seen].max(axis=1, initial=0.0) > rounded * strained.max(axis=1)
        return tuple(int(j) + 1 for j in np.flatnonzero(~told))

    def with_model(self, model: Model) -> InstrumentedModel:
        """Return the same sensors on another model of the structure."""
        return replace(self, model=model)

    def context(self, rate_hz: float) -> Context:
        """Make the context in which effects act, for samples at `rate_hz` (Hz)."""
        return Context(self.model.structure, self.channels, self.sensor_matrix, rate_hz, self.boxes)
