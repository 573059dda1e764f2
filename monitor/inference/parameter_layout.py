"""Layout of the groups of parameters in the vector that a fit estimates."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import accumulate, pairwise

import numpy as np

from monitor.core import Array
from monitor.model import StructuralPrior


@dataclass(frozen=True, slots=True)
class ParameterLayout:
    """Slices of the parameter vector ``x = [structure | forces | levels | noise | effects]``.

    All fields but `noise`, an index, are slices, so that ``x[layout.forces]`` reads a group and ``x[layout.forces] = value``
    sets one.  The groups are in the order of the fields.  All parameters before the extra effects are nuisance parameters.

    Examples
    --------
    A frame of two stories, with two sensors and a recording in three classes of level:

    >>> import numpy as np
    >>> from monitor.model import Model, ShearFrame, prior_from_drawing
    >>> frame = Model(ShearFrame(np.full(2, 100.0), np.full(2, 1e6), damping_ratio=0.01))
    >>> layout = ParameterLayout.of(prior_from_drawing(frame, np.full(4, 0.1), n_channels=2), n_classes=3)
    >>> layout.masses, layout.forces, layout.levels, layout.noise, layout.effects
    (slice(2, 4, None), slice(8, 10, None), slice(10, 13, None), 13, slice(14, None, None))
    """

    stiffness: slice
    """ln stiffness of every story (or stiffness parameter), N/m."""
    masses: slice
    """ln mass of every floor (or mass parameter), kg."""
    damping: slice
    """ln damping ratio of every mode."""
    channel_noise: slice
    """ln noise density of every channel over the common one."""
    correction: slice
    """Stiffness correction in the modes' coordinates."""
    persistent: slice
    """Coordinates of the effects that the model had before the recording."""
    forces: slice
    """ln density of the white force on every degree of freedom, N^2/Hz."""
    levels: slice
    """ln level of every class: of its forces or, with a measured ground, of the model's own error as a share of the power."""
    noise: int
    """Index of the ln noise density common to all channels, (m/s^2)^2/Hz."""

    @classmethod
    def of(cls, prior: StructuralPrior, n_classes: int = 0) -> ParameterLayout:
        """Lay out the parameters of a structural prior and of a recording in `n_classes` classes."""
        sizes = (*prior.sizes, prior.n_persistent, prior.model.structure.n_dofs, n_classes)
        ends = list(accumulate(sizes, initial=0))
        slices = [slice(first, last) for first, last in pairwise(ends)]
        stiffness, masses, damping, channel_noise, correction, persistent, forces, levels = slices
        return cls(stiffness, masses, damping, channel_noise, correction, persistent, forces, levels, noise=levels.stop)

    @property
    def structure(self) -> slice:
        """Slice of the parameters of the structural prior: all before the forces."""
        return slice(0, self.forces.start)

    @property
    def excitation(self) -> slice:
        """Slice of forces, levels and noise."""
        return slice(self.forces.start, self.noise + 1)

    @property
    def nuisances(self) -> slice:
        """Slice of the nuisance parameters: all before the extra effects."""
        return slice(0, self.noise + 1)

    @property
    def effects(self) -> slice:
        """Slice of the coordinates of the extra effects."""
        return slice(self.noise + 1, None)

    @property
    def n_nuisance(self) -> int:
        """Number of parameters before those of the extra effects."""
        return self.noise + 1

    def with_structure(self, x: Array, structure: Array) -> Array:
        """Replace the structural parameters of a vector by others, whose number may differ."""
        return np.concatenate([structure, x[self.forces.start :]])
