"""Stiffness updated to modes, and its change since the structure file or the baseline."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np

from monitor.api.modes import Modes, sub_array
from monitor.api.structures import Structure
from monitor.core import Array, BadInputError, import_extra, single_blas_thread
from monitor.damage import damage_index


@dataclass(frozen=True, eq=False, slots=True)
class Updated:
    """Stiffness of each story by the measured modes, p of them, with its covariance, and its loss."""

    stiffness_n_per_m: Annotated[Array, "p"]
    covariance: Annotated[Array, "p p"]
    """Of the stiffnesses, (N/m)^2."""
    loss: Annotated[Array, "p"]
    """Relative loss since the baseline, or without one the difference from the structure file; 0.2 = 20 % lost."""
    loss_covariance: Annotated[Array, "p p"]
    """It contains the baseline's."""
    names: tuple[str, ...]
    unidentified: tuple[int, ...]
    """Stories (from 1) of which the modes say next to nothing."""
    misfit: float
    """Goodness of fit: near 1 where a change of stiffness explains the modes; 1 without a baseline."""
    converged: bool
    """False where the structure cannot follow the modes; the stiffnesses then mean nothing."""
    since_baseline: bool
    """Whether the loss refers to a baseline."""

    @property
    def stiffness_std(self) -> Annotated[Array, "p"]:
        """Standard deviations of the stiffnesses, N/m."""
        return np.asarray(np.sqrt(self.covariance.diagonal()))

    @property
    def loss_std(self) -> Annotated[Array, "p"]:
        """Standard deviations of the losses."""
        return np.asarray(np.sqrt(self.loss_covariance.diagonal()))

    def __str__(self) -> str:
        rows = zip(self.names, self.stiffness_n_per_m, self.stiffness_std, self.loss, self.loss_std, strict=True)
        lines = [
            f"{name}: {k:.5g} ± {2 * s:.2g} N/m, {-100 * loss:+.2f} ± {200 * e:.2f} % since the "
            f"{'baseline' if self.since_baseline else 'structure file'}"
            for name, k, s, loss, e in rows
        ]
        return "\n".join(lines if self.converged else ["the updating did not converge", *lines])

    def plot(self, axes: Any = None) -> Any:
        """Draw the loss of each story with intervals of two standard deviations, and return the axes of matplotlib.

        Needs the extra ``plot``.
        """
        axes = import_extra("matplotlib.pyplot", "plot()").gca() if axes is None else axes
        places = np.arange(len(self.names))
        axes.errorbar(100 * self.loss, places, xerr=200 * self.loss_std, fmt="o", capsize=4)
        axes.axvline(0.0, color="0.7", linewidth=1)
        axes.set_yticks(places, self.names)
        axes.invert_yaxis()
        axes.set(xlabel=f"loss since the {'baseline' if self.since_baseline else 'structure file'}, %")
        return axes


@single_blas_thread()
def update(modes: Modes, structure: Structure) -> Updated:
    """Update the stiffnesses of a structure to identified modes.

    What temperature and level explain is not taken out: that takes a monitor over time, as ``replay``.

    Parameters
    ----------
    modes
        Modes that `identify` found with this structure.
    structure
        With a baseline the loss is the change since then; without one it is the difference from the structure file, which is
        never exact.

    Raises
    ------
    UserError
        There is no mode to update to, the modes were identified without the structure, or some of the baseline's are missing.

    Examples
    --------
    >>> import shm_monitor as shm
    >>> frame = shm.structure(masses_kg=[1000.0, 1000.0], stiffness_n_per_m=[2e6, 2e6])
    >>> record = shm.simulate(frame, duration_s=400, rate_hz=100, damage={1: 0.2}, seed=1)
    >>> updated = shm.update(shm.identify(record.samples, record.rate_hz, frame), frame)
    >>> bool(abs(updated.loss[0] - 0.2) < 3 * updated.loss_std[0])
    True
    """
    found = modes.estimate
    if found is None or not len(modes):
        raise BadInputError(f"update: no mode to update to: {'; '.join(modes.missing)}")
    if modes.model_mode is None:
        raise BadInputError("update: these modes are nobody's counterparts; give the structure to identify() too")
    if not len(found.deviations):
        raise BadInputError("update: the modes have no uncertainty; set uncertainty = true in [identification]")
    config, baseline = structure.config, structure.baseline
    wanted = tuple(int(k) for k in found.model_mode)
    healthy = None if baseline is None else baseline.only(wanted)
    if healthy is not None and healthy.model_mode != wanted:
        raise BadInputError(
            "update: the modes are not the baseline's; give the structure with its baseline to identify()"
        )
    site = structure.instrumented
    estimate, reading = damage_index.step(
        found,
        site.model,
        healthy,
        sub_array(structure).sensors,
        config.updating,
        None,
        config.instrumented().stiffness_prior_std,
    )
    return Updated(
        estimate.stiffness_n_per_m,
        estimate.covariance,
        reading.ddi,
        reading.covariance,
        config.story_names,
        reading.unidentified,
        estimate.misfit,
        estimate.converged,
        baseline is not None,
    )
