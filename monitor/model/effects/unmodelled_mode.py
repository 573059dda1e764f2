"""Mode of the structure that its model does not have: torsion, the other direction, or a part that the drawing leaves out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import inf, isfinite, pi
from typing import Annotated, Self

import numpy as np
from typing_extensions import override

from monitor.core import Array
from monitor.model.effects.base import Condition, Context, CoupledMode, Effect, EffectError, ExtraMode, Peak, System
from monitor.model.effects.parameter import Parameter
from monitor.model.effects.report_face import FittedSizes
from monitor.model.structures import Structure

_MODE_DAMPING_LN_STD = 0.8
"""Standard deviation of the logarithm of the mode's damping ratio about the structure's. [1; judgement: a factor of two, as
of an attached oscillator]"""
_BEYOND_BAND = 1.0 / 0.9
"""Highest frequency of a mode, over the band's end. [ratio; the lowpass's cutoff, of which the band ends at 0.9: the foot of a
peak beyond the band lies in it]"""
_MAX_MODE_DAMPING = 0.15
"""Damping ratio from which a peak is no mode of a structure. [1; as of the poles that identification accepts as modes]"""
_DAILY_FREQUENCY = 0.02
"""Relative change of the mode's frequency from calibration that needs no cause. [ratio; judgement: a loss that the model
describes moves this mode too, by up to half the lost share of a story's stiffness]"""
_DAILY_DAMPING = 0.3
"""The same of its damping ratio. [ratio; judgement]"""
_ECCENTRICITY_RADII = 0.3
"""Prior standard deviation of the distance between the centres of mass and of stiffness, over a floor's radius of gyration.
[1; EN 1998-1, 4.2.3.2: a building is regular in plan up to 0.30 torsional radii]"""
_LN_FORCE_STD = 2.0
"""Prior standard deviation of the logarithm of the density of the mode's own force, over the floors'. [1; judgement]"""
_DAILY_FORCE = 4.0
"""Change of the mode's force from calibration that needs no cause: of the logarithm of its density, and of a shape that the force
scales. [1; judgement: another direction of the wind, a factor of five to seven in amplitude]"""
_DAILY_COUPLED_SHAPE = 0.05
"""Relative change of a coupled mode's shape from calibration that needs no cause; its force is a parameter of its own. [ratio;
judgement: as of the damping of the model's own modes]"""
_DAILY_RADII = 0.012
"""Change of that distance from calibration that needs no cause, over the radius. [1; judgement: people and goods are a twelfth of
the mass; a fifth of them on one side moves the centre of mass by 0.5 % of a square plan's width]"""
_SHAPE, _ECCENTRICITY, _ARM = "shape_", "eccentricity_", "force_arm_"
_START = 0.1
"""Start of the shape's largest component, over the reciprocal of the mean floor mass. [ratio; judgement]"""


@dataclass(frozen=True)
class UnmodelledMode(Effect):
    """Mode of the structure beside those of the model, driven by forces of its own.

    The channels move by ``shape h(f) g`` in addition to the model's motion, where h is the accelerance of an oscillator of one
    kilogram and g a random force of the floors' mean force density.

    A mode of torsion of an eccentric building is coupled to the floors.  It is a degree of freedom q of the floors' mean mass m.
    Where q moves by 1, the stories are strained as if floor j had moved by ``eccentricity_j``: by the distance of its centre of
    mass from the centre of stiffness times its rotation in the mode.  So the stiffness between q and the floors is the floors'
    stiffness matrix times the eccentricities; a loss of stiffness weakens it too.  A force on floor j acts on q by
    ``force_arm_j`` of itself: by its distance from the floor's centre of mass times the floor's rotation.  The channels move by
    ``m shape`` times the acceleration of q, and the density of g is `force_ratio` times the floors'.
    """

    name = "unmodelled_mode"
    family = "structure"
    order = 2
    is_narrow = True
    repeatable = True
    stationary_only = True
    places = ("frame",)
    parameters = (
        Parameter("frequency_hz", 0.0, inf, "log"),
        Parameter("damping_ratio", 0.0, 1.0, "log"),
    )
    """Parameters of the class; an instance adds one for every channel, `shape_1` and so on, and a coupled one `force_ratio` and
    two for every floor, `eccentricity_1` and so on, then `force_arm_1` and so on."""
    signature = (
        "one peak more, as wide as the structure's own, of another shape, with normal kurtosis; the model's modes stay"
    )
    separating_measurement = "put an accelerometer across the measured direction, and two at opposite edges of a floor"
    start_sizes = ()  # only a peak of the recording's spectra tells a shape to start from

    frequency_hz: float
    damping_ratio: float
    shape: tuple[float, ...] = ()
    """Acceleration of every channel by a unit force on the mode, 1/kg; empty: alike on all channels, over the total mass."""
    force_ratio: float = 1.0
    """Density of the mode's own force over the floors' mean."""
    eccentricity: tuple[float, ...] = ()
    """Of every floor; empty for a mode that is not coupled."""
    force_arm: tuple[float, ...] = ()
    """Of every floor; by default zero for a mode that is coupled."""

    def __post_init__(self) -> None:
        """Add the parameters of the shape and the eccentricities to those of the class, and their changes from day to day."""
        if not self.force_arm:
            object.__setattr__(self, "force_arm", (0.0,) * len(self.eccentricity))
        nothing = None if self.eccentricity else 0.0  # the size of a coupled mode is in its eccentricities too
        of_channels = tuple(Parameter(f"{_SHAPE}{i + 1}", -inf, inf, absent=nothing) for i in range(len(self.shape)))
        of_floors = tuple(
            Parameter(f"{prefix}{j + 1}", -inf, inf, least=1.0)
            for prefix in (_ECCENTRICITY, _ARM)
            for j in range(len(self.eccentricity))
        )
        # The forces on the mode change from day to day.  They scale the shape where the mode is not coupled.
        daily = (
            _DAILY_FREQUENCY,
            _DAILY_DAMPING,
            *(_DAILY_COUPLED_SHAPE if of_floors else _DAILY_FORCE,) * len(self.shape),
        )
        if of_floors:
            of_floors = (Parameter("force_ratio", 0.0, inf, "log"), *of_floors)
            daily = (*daily, _DAILY_FORCE, *(_DAILY_RADII * self._mean_rotation,) * (len(of_floors) - 1))
        object.__setattr__(self, "parameters", (*type(self).parameters, *of_channels, *of_floors))
        object.__setattr__(self, "daily", daily)

    @classmethod
    def create(cls, location: str, parameters: Mapping[str, float]) -> Effect:
        """The shape, `shape_1` and so on, the eccentricities and the forces' arms may be left out."""
        listed = {}
        for prefix, what in ((_SHAPE, "channel"), (_ECCENTRICITY, "floor"), (_ARM, "floor")):
            own = {name: value for name, value in parameters.items() if name.startswith(prefix)}
            wanted = [f"{prefix}{i + 1}" for i in range(len(own))]
            if set(own) != set(wanted):
                raise EffectError(f"{cls.name}: needs {', '.join(wanted)}, one for every {what}")
            for name, value in own.items():
                if not isfinite(value):
                    raise EffectError(f"{cls.name}: {name} = {value:g} must be finite")
            listed[prefix] = tuple(own[name] for name in wanted)
        force_ratio = parameters.get("force_ratio", 1.0) if listed[_ECCENTRICITY] else 1.0
        if not (isfinite(force_ratio) and force_ratio > 0.0):
            raise EffectError(f"{cls.name}: force_ratio = {force_ratio:g} must be finite, above 0")
        n, arms = len(listed[_ECCENTRICITY]), listed[_ARM]
        if arms and len(arms) != n:
            raise EffectError(f"{cls.name}: {len(arms)} arms of the forces for {n} eccentricities")
        more = (_SHAPE, _ECCENTRICITY, _ARM, *(["force_ratio"] if listed[_ECCENTRICITY] else []))
        bare = super().create(location, {n: value for n, value in parameters.items() if not n.startswith(tuple(more))})
        hz, ratio = bare.values().values()
        return cls(location, hz, ratio, listed[_SHAPE], force_ratio, listed[_ECCENTRICITY], arms)

    @override
    def values(self) -> dict[str, float]:
        own = {"frequency_hz": self.frequency_hz, "damping_ratio": self.damping_ratio}
        own |= {f"{_SHAPE}{i + 1}": component for i, component in enumerate(self.shape)}
        if self.eccentricity:
            own["force_ratio"] = self.force_ratio
        own |= {f"{_ECCENTRICITY}{j + 1}": component for j, component in enumerate(self.eccentricity)}
        return own | {f"{_ARM}{j + 1}": component for j, component in enumerate(self.force_arm)}

    @property
    def units(self) -> Array:
        """All components of the shape have the unit of the largest."""
        out = np.ones(len(self.parameters))
        out[self._of_shape] = max(np.abs(self.shape), default=1.0) or 1.0
        return out

    @property
    def pattern_std(self) -> Array:
        """The damping ratio is about the structure's.

        The shape's components are of the order of their RMS; the largest stands for the size.
        """
        out = np.full(len(self.parameters), np.nan)
        out[1] = _MODE_DAMPING_LN_STD
        if self.shape:
            out[self._of_shape] = np.sqrt(np.mean(np.square(self.shape)))
            out[2 + int(np.abs(self.shape).argmax())] = np.nan
        if self.eccentricity:
            out[self._of_shape.stop :] = _ECCENTRICITY_RADII * self._mean_rotation
            out[self._of_shape.stop] = _LN_FORCE_STD
        return out

    @property
    def _mean_rotation(self) -> float:
        """Quadratic mean of the rotations of n equal floors by a motion of 1, over the reciprocal of their radius of gyration."""
        return float(len(self.eccentricity) ** -0.5)

    @property
    def _of_shape(self) -> slice:
        """Slice of the shape's coordinates."""
        return slice(2, 2 + len(self.shape))

    @override
    def at(self, coordinates: Array) -> Self:
        values = [p.value(float(x)) for p, x in zip(self.parameters, coordinates, strict=True)]
        hz, ratio, *rest = values
        shape, rest = rest[: len(self.shape)], rest[len(self.shape) :]
        force_ratio, *of_floors = rest or [1.0]
        n = len(self.eccentricity)
        return replace(
            self,
            frequency_hz=hz,
            damping_ratio=ratio,
            shape=tuple(shape),
            force_ratio=force_ratio,
            eccentricity=tuple(of_floors[:n]),
            force_arm=tuple(of_floors[n:]),
        )

    @override
    def coupled(self, context: Context) -> Self | None:
        if self.eccentricity:
            return None
        shape = tuple(self._shape_on(context).tolist())
        return replace(self, shape=shape, eccentricity=(0.0,) * context.structure.n_dofs)

    @override
    def reversed_coupling(self) -> Self:
        eccentricity, arms = (tuple(-e for e in of_floors) for of_floors in (self.eccentricity, self.force_arm))
        return replace(self, eccentricity=eccentricity, force_arm=arms)

    @override
    def uncoupled(self, resonance: ExtraMode) -> Self:
        return type(self)(
            self.location, resonance.frequency_hz, resonance.damping_ratio, tuple(resonance.shape.tolist())
        )

    def extend(self, system: System, context: Context, condition: Condition) -> System:
        """Only a coupled mode is a degree of freedom of the system."""
        if not self.eccentricity:
            return system
        mean, size, n = float(context.structure.masses_kg.mean()), system.mass.shape[0], len(self.eccentricity)
        own, link = self._springs(context.structure, system.springs)
        larger = system.enlarged()
        mass, damping, stiffness = larger.mass, larger.damping, larger.stiffness
        mass[size, size], damping[size, size] = mean, 2.0 * self.damping_ratio * np.sqrt(own * mean)
        stiffness[size, size] = own
        stiffness[:n, size] = stiffness[size, :n] = link
        mode = CoupledMode(size, mean * np.array(self.shape), self.force_ratio, np.array(self.force_arm))
        return replace(larger, coupled=(*system.coupled, mode))

    def _springs(self, structure: Structure, stiffness: Array) -> tuple[float, Annotated[Array, "n"]]:
        """Return the stiffness of a coupled mode's degree of freedom, N/m, and that between it and every floor."""
        own = float(structure.masses_kg.mean()) * (2.0 * pi * self.frequency_hz) ** 2
        return own, stiffness @ np.array(self.eccentricity)

    @override
    def extra_modes(self, context: Context) -> tuple[ExtraMode, ...]:
        if self.eccentricity:
            return ()
        return (ExtraMode(self.frequency_hz, self.damping_ratio, self._shape_on(context)),)

    def _shape_on(self, context: Context) -> Annotated[Array, "c"]:
        """Return the shape on the channels, 1/kg."""
        if self.shape:
            return np.array(self.shape)
        return np.full(len(context.channels), 1.0 / float(context.structure.masses_kg.sum()))

    @override
    def check(self, structure: Structure, channels: tuple[str, ...]) -> None:
        super().check(structure, channels)
        if self.shape and len(self.shape) != len(channels):
            raise EffectError(f"{self.name}: {len(self.shape)} components of the shape for {len(channels)} channels")
        if self.eccentricity and not self.shape:
            raise EffectError(
                f"{self.name}: a coupled mode needs its shape, {_SHAPE}1 and so on, one for every channel"
            )
        if self.eccentricity and len(self.eccentricity) != structure.n_dofs:
            raise EffectError(f"{self.name}: {len(self.eccentricity)} eccentricities for {structure.n_dofs} floors")
        if self.eccentricity:
            own, link = self._springs(structure, structure.stiffness_matrix())
            if own <= link @ np.array(self.eccentricity):
                raise EffectError(f"{self.name}: the eccentricities are so large that the structure is unstable")

    def known(self, context: Context, condition: Condition) -> tuple[Array, Array]:
        """The damping ratio is that of the structure, within a factor of two."""
        mean, precision = self.coordinates, np.zeros(len(self.parameters))
        mean[1], precision[1] = np.log(context.structure.damping_ratio), _MODE_DAMPING_LN_STD**-2
        if self.eccentricity:
            first = self._of_shape.stop
            mean[first:], precision[first:] = 0.0, (_ECCENTRICITY_RADII * self._mean_rotation) ** -2
            precision[first] = _LN_FORCE_STD**-2
        return mean, precision

    def is_plausible(self, band_hz: Array) -> bool:
        """The peak reaches into the band, and the damping ratio is below the limit."""
        in_band = band_hz[0] <= self.frequency_hz <= _BEYOND_BAND * band_hz[-1]
        return bool(in_band and self.damping_ratio < _MAX_MODE_DAMPING)

    @classmethod
    @override
    def at_peak(cls, location: str, peak: Peak, context: Context, condition: Condition) -> Self:
        largest = _START / float(context.structure.masses_kg.mean())
        shape = largest * peak.amplitude / np.abs(peak.amplitude).max()
        return cls(location, peak.hz, context.structure.damping_ratio, tuple(shape.tolist()))

    @classmethod
    @override
    def sentence(cls, fitted: FittedSizes) -> str:
        damping = fitted.sized("damping_ratio", f" with {fitted.percent('damping_ratio')} damping", "")
        return (
            f"the structure has a mode at {fitted.interval('frequency_hz')}{damping} that the model lacks: "
            "torsion, the other direction or a local mode"
        )

    @classmethod
    @override
    def sentence_of_several(cls, fitted: Sequence[FittedSizes]) -> str:
        hz = sorted(one.value("frequency_hz") for one in fitted)
        listed = ", ".join(f"{f:.4g}" for f in hz[:-1]) + f" and {hz[-1]:.4g}"
        return (
            f"the structure has modes at {listed} Hz that the model lacks: torsion, the other direction or local modes"
        )
