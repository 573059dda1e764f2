"""Base class of every effect: a place, parameters, and one law in the frequency domain and in the time domain.

In the frequency domain (the spectral face) an effect changes a linear model's matrices, excitation and sensors at a condition,
that is at a level of vibration and a temperature; the likelihood, the updating and the alarms use it.  In the time domain
(the time face) an effect is the exact law that the simulation integrates.  An effect overrides only the methods of what it
changes, and imports all that it needs for them from here.
"""

from __future__ import annotations

from abc import ABC
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from enum import IntEnum
from math import inf
from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray

from monitor.core import Array, ComplexArray
from monitor.model.effects.parameter import Parameter as Parameter
from monitor.model.effects.report_face import FittedSizes as FittedSizes, ReportFace
from monitor.model.structures import Structure as Structure
from monitor.model.structures.building import DIRECTIONS

_STORY_STD = 2.0
"""Relative standard deviation of a story's stiffness, over the RMS of the relative corrections that the drawing's form
needs: what a frame that is no shear frame blurs. [ratio; judgement]"""


class EffectError(ValueError):
    """Error in an effect's name, place or parameters; the message says which is wrong and what is allowed."""


@dataclass(frozen=True, eq=False, slots=True)
class Context:
    """Structure and sensors on which effects act."""

    structure: Structure
    channels: tuple[str, ...]
    sensors: Annotated[Array, "c n"]
    """Matrix that picks the channels out of the floors' motion."""
    rate_hz: float
    """Rate of the source's samples."""
    boxes: tuple[tuple[int, int], ...] = ()
    """Channels along x and along y, from 0, of each box that measures both at one place."""


def _none_degc(lag_s: float) -> float:
    """Return a temperature at its reference, K above it."""
    return 0.0


@dataclass(frozen=True, eq=False, slots=True)
class Condition:
    """Motion and temperature at which nonlinear laws are linearized: those of one level class of a recording."""

    drift_m: Annotated[Array, "n"]
    """RMS drift of every story."""
    drift_velocity_m_s: Annotated[Array, "n"]
    """RMS velocity of every story's drift."""
    floor_velocity_m_s: Annotated[Array, "n"]
    """RMS velocity of every floor."""
    channel_m_s2: Annotated[Array, "c"]
    """RMS of every channel's samples."""
    excess_degc: Callable[[float], float] = field(default=_none_degc)
    """Temperature above the reference after a first-order lag in s."""
    channel_peak_m_s2: Annotated[Array, "c"] = field(default_factory=lambda: np.full(1, np.inf))
    """Largest magnitude of every channel's samples in the whole recording."""
    channel_piled: Annotated[NDArray[np.bool_], "c"] = field(default_factory=lambda: np.zeros(1, dtype=bool))
    """Whether many of a channel's samples share its largest magnitude."""
    beyond: float = 1.0
    """Variance that the forces cause above the compared band, over that of white forces there, up to half the source's rate."""
    band_hz: float = np.inf
    """Upper end of the compared band."""
    ground: float = 1.0
    """Level of an unmeasured ground motion over that of the forces, relative to the whole recording."""


@dataclass(frozen=True, eq=False, slots=True)
class FittedModel:
    """Properties of a fitted model that determine the uncertainty of an effect's size by the form of its law."""

    structure: Structure
    """The structure at the fit, without effects."""
    condition: Condition
    """The level class in the middle of the recording's."""
    effects: tuple[Effect, ...]
    """All effects of the model, persistent ones first."""
    correction_rms: float
    """RMS of the relative stiffness corrections that the structure's form does not explain; 0 where there are none."""
    bin_hz: float
    """Spacing of the spectra's bins."""


@dataclass(frozen=True, eq=False, slots=True)
class CoupledMode:
    """Appended degree of freedom that is a mode of the structure, driven by a random force of its own."""

    index: int
    """Of its degree of freedom in the system."""
    shape: Annotated[Array, "c"]
    """Acceleration of every channel over that of the degree of freedom."""
    force_ratio: float
    """Density of its own force over the floors' mean."""
    arms: Annotated[Array, "n"]
    """Force on the degree of freedom by a force of 1 N on every floor."""


@dataclass(frozen=True, eq=False, slots=True)
class System:
    """Linear system: the structure's degrees of freedom first, then those that effects add."""

    mass: Annotated[Array, "N N"]
    """kg."""
    damping: Annotated[Array, "N N"]
    """N s/m."""
    stiffness: Annotated[Array, "N N"]
    """N/m."""
    coupled: tuple[CoupledMode, ...] = ()
    """Modes among the appended degrees of freedom; the others are masses that ride on the structure."""
    springs: Annotated[Array, "n n"] = field(default_factory=lambda: np.zeros((0, 0)))
    """Stiffness of the structure alone, N/m; by default `stiffness`, before effects append and add to it."""
    ground: Annotated[Array, "N"] = field(default_factory=lambda: np.zeros(0))
    """Displacement of the degrees of freedom with a ground that moves by one; ones by default."""

    def __post_init__(self) -> None:
        """Keep the stiffness of the structure alone."""
        if self.springs.size == 0:
            object.__setattr__(self, "springs", self.stiffness)
        if self.ground.size == 0:
            object.__setattr__(self, "ground", np.ones(self.mass.shape[0]))

    @property
    def inertia(self) -> Annotated[Array, "N"]:
        """Force on every degree of freedom by a ground that accelerates at -1 m/s^2, kg."""
        return np.asarray(self.mass @ self.rides)

    @property
    def rides(self) -> Annotated[Array, "N"]:
        """Acceleration of every degree of freedom at rest relative to the ground, by a unit of the ground's."""
        out = self.ground.copy()
        out[[mode.index for mode in self.coupled]] = 0.0
        return out

    def sensors(self, of_structure: Annotated[Array, "c n"]) -> Annotated[Array, "c N"]:
        """Extend the sensors' weights on the structure's degrees of freedom to all."""
        out = np.pad(of_structure, ((0, 0), (0, self.mass.shape[0] - of_structure.shape[1])))
        for mode in self.coupled:
            out[:, mode.index] = mode.shape
        return out

    def forced(self, n: int) -> Array:
        """Return the forces on all degrees of freedom by unit forces on the structure, then on each mode, (N, n + n_coupled)."""
        out = np.eye(self.mass.shape[0])[:, [*range(n), *(mode.index for mode in self.coupled)]]
        for mode in self.coupled:
            out[mode.index, :n] = mode.arms
        return out

    def enlarged(self, ground: float = 1.0) -> System:
        """Append a degree of freedom, as yet without mass, damping and stiffness, which moves with the ground by `ground`."""
        size = self.mass.shape[0]
        larger = np.zeros((3, size + 1, size + 1))
        larger[:, :size, :size] = self.mass, self.damping, self.stiffness
        moved = np.append(self.ground, ground)
        return replace(self, mass=larger[0], damping=larger[1], stiffness=larger[2], ground=moved)

    def plus(self, *, damping: Array | float = 0.0, stiffness: Array | float = 0.0) -> System:
        """Add terms to the matrices of the structure's degrees of freedom."""

        def padded(base: Array, term: Array | float) -> Array:
            out = base.copy()
            if not np.isscalar(term):
                n = np.asarray(term).shape[0]
                out[:n, :n] += term
            return out

        return replace(self, damping=padded(self.damping, damping), stiffness=padded(self.stiffness, stiffness))

    def state_matrix(self) -> Annotated[Array, "2N 2N"]:
        """Assemble the state matrix of displacements and velocities, 1/s."""
        size = self.mass.shape[0]
        inverse = np.linalg.inv(self.mass)
        return np.block([[np.zeros((size, size)), np.eye(size)], [-inverse @ self.stiffness, -inverse @ self.damping]])

    def decoupled(self) -> tuple[ComplexArray, Annotated[ComplexArray, "2N m"], Annotated[ComplexArray, "m N"]]:
        """Decouple the system into first-order equations ``dq/dt = pole q + drive @ forces``, one of each conjugate pair.

        Returned are poles (rad/s), shapes and drive; displacements and velocities are the real part of ``shapes @ q``.
        """
        inverse = np.linalg.inv(self.mass)
        poles, shapes = np.linalg.eig(self.state_matrix())
        drive = np.linalg.solve(shapes, np.vstack([np.zeros_like(inverse), inverse]).astype(complex))
        kept = poles.imag >= 0
        return poles[kept].astype(complex), shapes[:, kept] * np.where(poles.imag > 0, 2.0, 1.0)[kept], drive[kept]


@dataclass(frozen=True, slots=True)
class Line:
    """Harmonic force on a floor."""

    location: str
    """Place of the floor."""
    frequency_hz: float
    force_n: float
    """Amplitude of the force."""


@dataclass(frozen=True, eq=False, slots=True)
class ExtraMode:
    """Mode of the structure beside those of its matrices, driven by a random force of its own."""

    frequency_hz: float
    damping_ratio: float
    shape: Annotated[Array, "c"]
    """Acceleration of every channel by a unit force on the mode far above its frequency, 1/kg."""


@dataclass(frozen=True, eq=False, slots=True)
class Peak:
    """Frequency at which a recording's spectra show more power than a model's."""

    hz: float
    amplitude: Annotated[Array, "c"]
    """Amplitude of the motion in excess, with its sign between channels, m/s^2/sqrt(Hz)."""


class LawKind(IntEnum):
    """Kind of the function phi in `monitor.model.integration`, with its two parameters in brackets."""

    CUBIC = 0
    """(k3, drift at which the factor on the cubic force is one half)"""
    CONTACT = 1
    """(gap, stiffness added beyond the gap)"""
    FRICTION = 2
    """(force, velocity that regularizes the sign of the velocity)"""
    QUADRATIC = 3
    """(coefficient, unused)"""
    SLIP = 4
    """(force at which the element slips, drift at which it would slip without rounding); its force depends on the past"""


@dataclass(frozen=True, eq=False, slots=True)
class Law:
    """Exact nonlinear force ``-direction * phi(direction . x, direction . v)`` on the structure's degrees of freedom.

    `kind` selects phi in `monitor.model.integration`, where one function is compiled for all kinds.
    """

    kind: LawKind
    direction: Annotated[Array, "n"]
    """Row that picks a story's drift or a floor's motion."""
    parameters: tuple[float, float]


@dataclass(frozen=True)
class Effect(ReportFace, ABC):
    """Effect: a term that the drawing leaves out.

    A subclass adds one float field for each parameter, in the order of `parameters`.
    """

    family: ClassVar[Literal["structure", "excitation", "sensor"]]
    places: ClassVar[tuple[str, ...]]
    """Allowed kinds of place: ``story``, ``floor``, ``channel``, ``channels`` (a pair), ``base``, ``frame``."""
    whole_floor: ClassVar[bool] = False
    """Whether a floor is meant as a whole, and not its motion one way."""
    parameters: ClassVar[tuple[Parameter, ...]]
    conditional: ClassVar[bool] = False
    """Whether the effect in the frequency domain depends on the condition."""
    nonlinear: ClassVar[bool] = False
    """Whether the effect in the frequency domain is a linearization; simulation then refines its parameters."""
    proportional: ClassVar[bool] = True
    """Whether twice the amplitude makes about twice the change, so that a score test can estimate the amplitude."""
    is_narrow: ClassVar[bool] = False
    """Whether the effect adds power about one frequency alone."""
    repeatable: ClassVar[bool] = False
    """Whether several of this effect may act at one place, as modes do."""
    order: ClassVar[int] = 1
    """Power of the amplitude with which the spectra change."""
    amplitude_powers: ClassVar[tuple[float, ...]] = ()
    """Exponent of each parameter of a story's nonlinear law: at a times the drift the law acts as one with parameters a^power
    times as large."""
    daily: ClassVar[tuple[float, ...]] = ()
    """Standard deviation of each coordinate's change from day to day, in the coordinate's units, of a persistent effect."""
    stationary_only: ClassVar[bool] = False
    """Whether the linearization needs a stationary, normal motion, which that of an earthquake is not."""
    driven_only: ClassVar[bool] = False
    """Whether the search tries the effect only where an input was measured."""
    is_stiffness_loss: ClassVar[bool] = False
    """Whether the effect is a change of stories' stiffness, which the damage index measures, and no other cause of its change."""
    colour_title: ClassVar[str] = ""
    """Title of the curve of `colour` that a report draws in place of the parameters that are `drawn`; empty for no curve."""
    form_uncertainty: ClassVar[tuple[float, ...]] = ()
    """Relative standard deviation of each parameter that the law's form leaves open, whatever the data; empty for none."""
    start_sizes: ClassVar[tuple[tuple[float, ...], ...]] = ((),)
    """Parameters at each start of a fit; those that are left out have their defaults."""

    location: str
    """Place of the effect: ``story 2``, ``floor 1``, ``channel a2``, ``base``, ``frame``; of a building also ``storey 2 y``."""

    # --- identity -------------------------------------------------------------------------------------------

    @classmethod
    def create(cls, location: str, parameters: Mapping[str, float]) -> Effect:
        """Create the effect at `location` with the given parameters.

        Raises EffectError if the place is not one of `places` or the parameters are not exactly the effect's.
        """
        if _kind(location) not in cls.places:
            forms = {"story": "story N", "floor": "floor N", "channel": "channel NAME", "channels": "channel NAME,NAME"}
            allowed = ", ".join(forms.get(p, p) for p in cls.places)
            raise EffectError(f"{cls.name}: no place {location!r}; allowed: {allowed}")
        wanted = [p.name for p in cls.parameters]
        if set(parameters) != set(wanted):
            said = f"{cls.name}: needs exactly {', '.join(wanted) or 'no parameters'}"
            unknown = [name for name in parameters if name not in wanted]
            raise EffectError(f"{said}; there is no {', '.join(unknown)}" if unknown else said)
        for p in cls.parameters:
            value = parameters[p.name]
            if not p.allows(value):
                lower = f", {'at least' if p.closed else 'above'} {p.low:g}" if p.low > -inf else ""
                upper = f", below {p.high:g}" if p.high < inf else ""
                raise EffectError(f"{cls.name}: {p.name} = {value:g} must be finite{lower}{upper}")
        return cls(location, **parameters)

    @classmethod
    def places_in(cls, context: Context) -> tuple[str, ...]:
        """List every place that the effect may have in a structure with its sensors."""
        of_floors = {"floor": context.structure.mass_places} if cls.whole_floor else {}
        return tuple(place for kind in cls.places for place in of_floors.get(kind) or locations(kind, context))

    def values(self) -> dict[str, float]:
        """Return the parameters by name."""
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name != "location"}

    @property
    def coordinates(self) -> Annotated[Array, "p"]:
        """Parameters in the coordinates of estimation."""
        values = self.values()
        return np.array([p.coordinate(values[p.name]) for p in self.parameters])

    @property
    def units(self) -> Annotated[Array, "p"]:
        """Units of the coordinates: one for a logarithm, else the coordinate's present magnitude."""
        sizes = zip(self.parameters, np.abs(self.coordinates), strict=True)
        return np.array([1.0 if p.scale == "log" else max(size, p.least) for p, size in sizes])

    @property
    def form_std(self) -> Annotated[Array, "p"]:
        """Standard deviation of the coordinates by `form_uncertainty`."""
        return np.asarray(np.abs(self.coordinates) * np.array(self.form_uncertainty or (0.0,) * len(self.parameters)))

    @property
    def pattern_std(self) -> Annotated[Array, "p"]:
        """Prior standard deviation of coordinates that form a pattern; NaN for those of unknown order."""
        return np.full(len(self.parameters), np.nan)

    def size_cost(self, covariance: Annotated[Array, "p p"]) -> float | None:
        """Compute what a prior of the sizes costs in log evidence at a fit of this covariance, nats; None where there is none."""
        return None

    def form_std_in(self, fitted: FittedModel) -> Annotated[Array, "p"]:
        """Return the standard deviation of the coordinates that the model's form leaves open in a fit.

        The coordinates are those of estimation, in the parameters' units. By default `form_std`, whatever the fit.
        """
        return self.form_std

    def is_plausible(self, band_hz: Array) -> bool:
        """Check that a fit of this size means this effect, and not another one that it imitates; frequencies are those compared.

        By default no parameter is at a limit of what is physically possible: a fit that ends there imitates something else.
        """
        return not any(p.is_limit(v) for p, v in zip(self.parameters, self.values().values(), strict=True))

    @property
    def is_softening(self) -> bool:
        """Whether the law weakens with the amplitude, so that a fit to its linearization may differ much from the exact law."""
        return False

    @property
    def temperature_lag_s(self) -> float | None:
        """Lag behind the temperature that the effect depends on, s; None where it depends on no temperature."""
        return None

    @property
    def column_to_girder(self) -> float:
        """Stiffness of a column over that of a girder, which the effect adds to the joints' flexibility; 0 for none."""
        return 0.0

    def at(self, coordinates: Array) -> Self:
        """Return the effect with other coordinates, limited to the parameters' bounds."""
        values = {p.name: p.value(float(x)) for p, x in zip(self.parameters, coordinates, strict=True)}
        return type(self)(self.location, **values)

    def known(self, context: Context, condition: Condition) -> tuple[Annotated[Array, "p"], Annotated[Array, "p"]]:
        """Return the prior mean and precision of the coordinates, which may use what the recording shows beside its spectra."""
        return self.coordinates, np.zeros(len(self.parameters))

    def mirrored(self) -> Effect | None:
        """Return the law with left and right exchanged, which has the same spectra; None where that is the same law."""
        return None

    def index(self, structure: Structure) -> int:
        """Return the index of the story or floor, from 0; ValueError for other kinds of place."""
        return place_index(self.location, structure)

    def direction(self, structure: Structure) -> Annotated[Array, "n"]:
        """Return the row that picks the story's drift or the floor's motion out of the floors' motion."""
        rows = np.eye(structure.n_dofs) if self.location.startswith("floor") else structure.drift_matrix()
        return np.asarray(rows[self.index(structure)])

    def pattern(self, structure: Structure) -> Annotated[Array, "n n"]:
        """Assemble the matrix of a unit spring or damper at the effect's place."""
        direction = self.direction(structure)
        return np.outer(direction, direction)

    def channel_indices(self, context: Context) -> tuple[int, ...]:
        """Return the indices of the named channels in the structure file's order."""
        return tuple(context.channels.index(name) for name in self.location.partition(" ")[2].split(","))

    def check(self, structure: Structure, channels: tuple[str, ...]) -> None:
        """Check that the structure has the effect's place.

        Raises EffectError if the structure has no such story, floor or channel, or the story has no drift along which to act.
        """
        kind, _, which = self.location.partition(" ")
        counts = {
            "story": (structure.story_places, "stories"),
            "storey": (structure.story_places, "storeys"),
            "floor": (structure.mass_places if self.whole_floor else structure.floor_places, "floors"),
        }
        if kind in counts and self.location not in counts[kind][0]:
            there, what = counts[kind]
            named = "" if there[0] in ("story 1", "floor 1") else f", {there[0]} to {there[-1]}"
            raise EffectError(f"{self.name}: {self.location!r} does not exist; {len(there)} {what}{named}")
        if (
            kind in ("story", "storey")
            and not self.is_stiffness_loss
            and not structure.single_springs()[self.index(structure)]
        ):
            raise EffectError(f"{self.name}: {self.location} is not a single spring, so it has no drift to act along")
        if kind == "channel":
            for name in which.split(","):
                if name not in channels:
                    raise EffectError(f"{self.name}: no channel {name!r}; the structure file has {', '.join(channels)}")

    # --- frequency domain (spectral face) --------------------------------------------------------------------------------------

    def altered(self, structure: Structure) -> Structure:
        """Return the structure with this effect on its members; the matrices of all effects follow from that structure."""
        return structure

    def structural(self, mass: Array, stiffness: Array, structure: Structure) -> tuple[Array, Array]:
        """Add this effect to the mass and stiffness matrices (kg, N/m), from which the structure's damping follows."""
        return mass, stiffness

    def extend(self, system: System, context: Context, condition: Condition) -> System:
        """Add to the system what does not enter the structure's own damping: dampers, degrees of freedom, linearized laws."""
        return system

    def colour(self, hz: Array) -> Array | float:
        """Return the factor on the power density of the floors' forces at frequencies `hz`."""
        return 1.0

    @property
    def common_force(self) -> float:
        """Share of each floor's force, in power, that acts on all floors at once."""
        return 0.0

    @property
    def ground_share(self) -> float:
        """Share of the acceleration's variance that comes from a common ground motion."""
        return 0.0

    def lines(self) -> tuple[Line, ...]:
        """Return the harmonic forces of the effect."""
        return ()

    def extra_modes(self, context: Context) -> tuple[ExtraMode, ...]:
        """Return the modes of the structure that the effect adds to those of the matrices."""
        return ()

    def coupled(self, context: Context) -> Effect | None:
        """Return the effect with a coupling to the floors, which is zero at first; None where it has none to add."""
        return None

    def is_coupled(self, context: Context) -> bool:
        """Check if the effect is a mode that the model lacks and that is coupled to the floors."""
        return self.repeatable and self.coupled(context) is None

    def reversed_coupling(self) -> Effect:
        """Return a coupled effect with the signs of its coupling reversed; any other as it is."""
        return self

    def uncoupled(self, resonance: ExtraMode) -> Effect:
        """Return a coupled effect as one without coupling that has the given frequency, damping and shape; any other as it is."""
        return self

    def response(self, hz: Array, context: Context, condition: Condition) -> Annotated[ComplexArray, "hz c c"] | None:
        """Return the acquisition's frequency response to the true channels, one or one a frequency; None for no change."""
        return None

    def noise_variance(self, context: Context, condition: Condition) -> Array | float:
        """Return the variance of the white noise at the source's rate that is added to each channel, (m/s^2)^2."""
        return 0.0

    @property
    def clock_factor(self) -> float:
        """True rate over nominal rate."""
        return 1.0

    @property
    def acts_on_system_alone(self) -> bool:
        """Whether the effect, if it adds no extra modes, changes the system alone: neither its forces nor what is recorded."""
        others = ("colour", "common_force", "ground_share", "lines", "response", "noise_variance", "clock_factor")
        return all(getattr(type(self), name) is getattr(Effect, name) for name in others)

    @property
    def keeps_structure(self) -> bool:
        """Whether the effect leaves the structure's own matrices as they are, so that only `extend` changes the system."""
        return all(getattr(type(self), name) is getattr(Effect, name) for name in ("altered", "structural"))

    @property
    def scales_with_level(self) -> bool:
        """Whether what the effect changes, if it does not depend on the condition, is in proportion to the forces' level."""
        return all(getattr(type(self), name) is getattr(Effect, name) for name in ("lines", "noise_variance"))

    # --- time domain (time face) ------------------------------------------------------------------------------------------

    def laws(self, structure: Structure) -> tuple[Law, ...]:
        """Return the exact nonlinear forces of the effect."""
        return ()

    def stiffness_factor(self, excess_degc: Array, rate_hz: float) -> Array | None:
        """Compute the factor on the stiffness matrix at every sample from its excess temperature, K; None for no change."""
        return None

    def drive(self, forces: Annotated[Array, "samples n"], rate_hz: float) -> Array:
        """Apply this effect to the floors' forces, N; `monitor.model.driven` adds its `lines`."""
        return forces

    def measure(self, samples: Array, rate_hz: float, context: Context, rng: np.random.Generator) -> Array:
        """Apply the acquisition's part of this effect to true samples."""
        return samples

    # --- search ---------------------------------------------------------------------------------------------

    @classmethod
    def starts(cls, location: str, context: Context, condition: Condition) -> tuple[Effect, ...]:
        """Return starting points of a fit of the effect at a place: small sizes, one for each shape that must be tried.

        Both signs of a size share one starting point.  By default `start_sizes`, whatever the structure and its motion.
        """
        names = [p.name for p in cls.parameters]
        return tuple(cls(location, **dict(zip(names, sizes, strict=False))) for sizes in cls.start_sizes)

    @classmethod
    def at_peak(cls, location: str, peak: Peak, context: Context, condition: Condition) -> Effect | None:
        """Return a small size of the effect at a peak of the recording that the model lacks.

        The result is None where the effect has no frequency.
        """
        return None


def blurred_by_form(effect: Effect, fitted: FittedModel, girders: float = 0.0) -> Annotated[Array, "p"]:
    """Return the standard deviation of a size that is relative to a story's stiffness, which the frame's form leaves uncertain.

    `girders` is the relative standard deviation that girders which may have changed with the columns cause.
    """
    size = np.abs(effect.coordinates)
    return np.asarray(np.hypot(effect.form_std, size * np.hypot(_STORY_STD * fitted.correction_rms, girders)))


def place_index(location: str, structure: Structure) -> int:
    """Return the index, from 0, of a story, of a floor that moves one way or of a floor as a whole; ValueError for none."""
    for places in (structure.story_places, structure.floor_places, structure.mass_places):
        if location in places:
            return places.index(location)
    raise ValueError(f"the structure has no {location}")


def _kind(location: str) -> str:
    """Return the kind of place that a location names, or the empty string."""
    kind, _, which = location.partition(" ")
    if kind in ("frame", "base") and not which:
        return kind
    if kind in ("story", "storey", "floor"):
        number, _, direction = which.partition(" ")
        if number.isdecimal() and int(number) > 0 and direction in ("", *DIRECTIONS):
            return "floor" if kind == "floor" else "story"
    if kind == "channel" and which:
        names = which.split(",")
        return {1: "channel", 2: "channels"}.get(len(names), "") if all(names) else ""
    return ""


def locations(kind: str, context: Context) -> tuple[str, ...]:
    """List every place of a kind: ``story``, ``floor``, ``channel``, ``channels``, ``base`` or ``frame``."""
    if kind in ("frame", "base"):
        return (kind,)
    structure = context.structure
    if kind in ("story", "floor"):
        return structure.story_places if kind == "story" else structure.floor_places
    names = context.channels
    if kind == "channel":
        return tuple(f"channel {name}" for name in names)
    return tuple(f"channel {a},{b}" for i, a in enumerate(names) for b in names[i + 1 :])
