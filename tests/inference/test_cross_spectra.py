"""Cross-spectra at the edge of what a search may try."""

from __future__ import annotations

import numpy as np

from monitor.inference.cross_spectra import ground_density
from monitor.model import Condition, Context, Model, ShearFrame
from monitor.model.simulation import linear_system


def test_the_grounds_density_is_found_where_one_story_has_next_to_no_stiffness() -> None:
    """As in a trial step: the channels' shares of the ground then differ by many powers of ten."""
    frame = Model(ShearFrame(np.full(3, 0.15), np.array([400.0, 4e-7, 400.0]), 0.01))
    context = Context(frame.structure, ("a1", "a2", "a3"), np.eye(3), 100.0)
    condition = Condition(np.ones(3), np.ones(3), np.ones(3), np.ones(3), beyond=1e-3)
    force = np.array([2.4e-5, 6e-10, 2.2e-9])
    density = ground_density(0.999, linear_system(frame), force, (), context, condition)
    assert np.isfinite(density)
    assert density > 0.0
