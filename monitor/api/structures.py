"""Structures: what a structure file says, as one object of the library."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from pydantic import ValidationError

from monitor.config import Configuration, configuration
from monitor.core import Array, BadConfigurationError, WrongUsageError, read_settings, settings_problems
from monitor.damage import Baseline, load_baseline
from monitor.model import InstrumentedModel


@dataclass(frozen=True, eq=False, slots=True)
class Structure:
    """A structural model with its sensors and settings, and where there is one, the healthy baseline."""

    config: Configuration
    """Everything that the structure file says; its form is not part of the promise of stability."""
    baseline: Baseline | None = None

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the channels, in the order of the columns of samples."""
        return self.config.channels

    @property
    def floors(self) -> tuple[int | str, ...]:
        """Floor (degree of freedom, from 1) of each channel; in a building its place in words."""
        return self.instrumented.floors

    @property
    def masses_kg(self) -> Annotated[Array, "n"]:
        """Mass of each floor."""
        return self.instrumented.model.structure.masses_kg

    @property
    def stiffness_n_per_m(self) -> Annotated[Array, "p"]:
        """Stiffnesses that are updated."""
        return self.instrumented.model.structure.stiffness_n_per_m

    @property
    def frequencies_hz(self) -> Annotated[Array, "n"]:
        """Natural frequencies of the model."""
        return self.instrumented.model.modes().frequencies_hz

    @property
    def shapes(self) -> Annotated[Array, "floors modes"]:
        """Mode shapes of the model, of unit modal mass."""
        return self.instrumented.model.modes().shapes

    @property
    def instrumented(self) -> InstrumentedModel:
        """Model with its sensors: the baseline's model, else that of the structure file."""
        drawn = self.config.instrumented()
        return drawn if self.baseline is None else drawn.with_model(self.baseline.model)


def structure(
    file: str | Path | Mapping[str, Any] | None = None,
    *,
    baseline: str | Path | None = None,
    masses_kg: Sequence[float] | Array | None = None,
    stiffness_n_per_m: Sequence[float] | Array | None = None,
    damping_ratio: float = 0.01,
    channels: Sequence[str] | None = None,
    floors: Sequence[int] | None = None,
) -> Structure:
    """Load a structure file, or build a shear frame from its masses and stiffnesses.

    Parameters
    ----------
    file
        Structure file (TOML), or its tables as a mapping; a site file will do.
    baseline
        Healthy baseline by the command ``calibrate``.
    masses_kg, stiffness_n_per_m
        Instead of a file: mass of each floor and stiffness of each story of a shear frame, from the top.
    channels, floors
        Its sensors: name and floor (1 = top) of each.  By default one a floor, ``a1`` to ``an``.

    Raises
    ------
    UserError
        The file cannot be read, its tables contradict themselves (every problem is listed), or it has no model.

    Examples
    --------
    >>> import shm_monitor as shm
    >>> frame = shm.structure(masses_kg=[1000.0, 1000.0], stiffness_n_per_m=[2e6, 2e6])
    >>> frame.frequencies_hz.round(3)
    array([ 4.399, 11.517])
    >>> frame.channels
    ('a1', 'a2')
    """
    if (file is None) == (masses_kg is None or stiffness_n_per_m is None):
        raise WrongUsageError("structure: give either a file, or masses_kg and stiffness_n_per_m of a shear frame")
    if isinstance(file, str | Path):
        config = configuration.load(Path(file))
    else:
        config = _validated(
            _tables(masses_kg, stiffness_n_per_m, damping_ratio, channels, floors) if file is None else file
        )
    if not config.has_model:
        named = f"{file}: " if isinstance(file, str | Path) else ""
        raise BadConfigurationError(
            f'{named}[structure] kind = "modal" has no masses and stiffnesses, which a Structure is made of; identify() takes '
            "samples without one"
        )
    if baseline is None:
        return Structure(config)
    return Structure(config, load_baseline(Path(baseline), config.instrumented(), config.updating))


def _tables(
    masses_kg: Sequence[float] | Array | None,
    stiffness_n_per_m: Sequence[float] | Array | None,
    damping_ratio: float,
    channels: Sequence[str] | None,
    floors: Sequence[int] | None,
) -> dict[str, Any]:
    """Write the tables of a shear frame."""
    masses, stiffness = (
        [] if given is None else [float(one) for one in given] for given in (masses_kg, stiffness_n_per_m)
    )
    on = list(range(1, len(masses) + 1)) if floors is None else [int(floor) for floor in floors]
    names = [f"a{j}" for j in range(1, len(on) + 1)] if channels is None else list(channels)
    if len(names) != len(on):
        raise WrongUsageError(f"structure: {len(names)} channels on {len(on)} floors; give one floor for each channel")
    return {
        "structure": {
            "kind": "shear_frame",
            "masses_kg": masses,
            "stiffness_n_per_m": stiffness,
            "damping_ratio": damping_ratio,
        },
        "sensors": [{"channel": name, "floor": floor} for name, floor in zip(names, on, strict=True)],
    }


def _validated(tables: Mapping[str, Any]) -> Configuration:
    """Check tables as those of a file."""
    try:
        return read_settings(Configuration, tables)
    except ValidationError as error:
        raise BadConfigurationError("\n".join(settings_problems(error))) from error
