"""Results of the stages: frozen values that stages pass on and publishers publish.

The type of a field gives its shape, its doc the unit.  Every estimate has its covariance.  A window without an estimate is a
value too (`Skipped`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Annotated, ClassVar, Self

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


WHOLE = 0
"""Story number of the structure as a whole."""
_MOVED_STDS = 2.0
"""Change from which a feature has moved. [standard deviations; convention: 95 %]"""


class Level(StrEnum):
    """Alarm level, in increasing order."""

    NORMAL = "normal"
    ADVISORY = "advisory"
    WARNING = "warning"
    ALARM = "alarm"

    @property
    def rank(self) -> int:
        """Rank of the level, from 0 for normal to 3 for alarm."""
        return _RANKS[self]


_RANKS = {level: rank for rank, level in enumerate(Level)}


class AlarmCondition(StrEnum):
    """State of an alarm in the state diagram of IEC 62682 (ISA-18.2)."""

    NORMAL = "normal"
    UNACKNOWLEDGED = "active, unacknowledged"
    ACKNOWLEDGED = "active, acknowledged"
    RETURNED_UNACKNOWLEDGED = "returned to normal, unacknowledged"
    LATCHED_UNACKNOWLEDGED = "latched, unacknowledged"
    LATCHED_ACKNOWLEDGED = "latched, acknowledged"
    SHELVED = "shelved"


GAP = "gap in the data"
STILL = "no reading changes"
CLOCK = "the clock and the stated rate are at odds"
STRONG_MOTION = "strong motion, which is told as an event or was a short disturbance of all floors"


@dataclass(frozen=True, slots=True)
class Skipped:
    """Reason why a window has no result."""

    reason: str

    @property
    def mend(self) -> str:
        """The reason, with a remedy if there is one."""
        if self.reason == GAP:
            return f"{GAP}; a shorter [processing] window_s loses less to each"
        return self.reason


@dataclass(frozen=True, eq=False, slots=True)
class Samples:
    """Conditioned samples of all channels on one clock."""

    t_ns: int
    """UTC of the first sample."""
    rate_hz: float
    values: Annotated[Array, "samples c"]
    """m/s^2."""


@dataclass(frozen=True, eq=False, slots=True)
class LagSums:
    """Lag sums of one window: sums of lagged products over blocks of raw samples, and the terms that remove the mean."""

    products: Annotated[Array, "blocks 2i c c"]
    """``sum_k y[k] y[k + tau]^T`` over the samples k of a block, (m/s^2)^2."""
    shifted: Annotated[Array, "blocks 2i c"]
    """Sums of the second factors, m/s^2; at lag 0 these are the first factors as well."""
    mean: Annotated[Array, "c"]
    """Mean of the window, m/s^2."""
    counts: Annotated[NDArray[np.int64], "blocks"]
    """The number of products in each block."""
    head: Annotated[Array, "2i-1 c"]
    """The window's first samples about its mean, m/s^2."""
    tail: Annotated[Array, "2i-1 c"]
    """The window's last samples about its mean, m/s^2."""
    total: Annotated[Array, "2i c c"]
    """Sum of the blocks' lagged products about the window's mean, (m/s^2)^2."""

    def only(self, channels: tuple[int, ...]) -> LagSums:
        """Select some channels (0 = first): a sub-block of every sum, which no other channel reaches."""
        rows = list(channels)
        return replace(
            self,
            products=np.ascontiguousarray(self.products[:, :, rows][..., rows]),
            shifted=np.ascontiguousarray(self.shifted[..., rows]),
            mean=self.mean[rows],
            head=np.ascontiguousarray(self.head[:, rows]),
            tail=np.ascontiguousarray(self.tail[:, rows]),
            total=np.ascontiguousarray(self.total[:, rows][..., rows]),
        )


@dataclass(frozen=True, eq=False, slots=True)
class CrossSpectra:
    """Cross-spectra of c channels of a stretch, or their mean over parts of it, in any unit."""

    power: Annotated[Array, "bins c"]
    """Of each channel, from the first bin above 0 Hz on."""
    cross: Annotated[ComplexArray, "bins pairs"]
    """Of each channel with those before it."""

    @classmethod
    def of(cls, transforms: Sequence[Annotated[ComplexArray, "bins c"]]) -> Self:
        """Average the cross-spectra of parts, given by their transforms."""
        i, j = np.tril_indices(transforms[0].shape[1], -1)
        power = np.mean([np.abs(x) ** 2 for x in transforms], axis=0)
        return cls(power, np.mean([x[:, i] * x[:, j].conj() for x in transforms], axis=0))

    def lowest(self, share: float) -> Self:
        """Select the lowest bins, scaled to unit power in each channel."""
        n = max(1, round(share * len(self.power)))
        i, j = np.tril_indices(self.power.shape[1], -1)
        size = np.maximum(self.power[:n].sum(axis=0), np.finfo(float).tiny)
        return type(self)(self.power[:n] / size, self.cross[:n] / (np.sqrt(size[i]) * np.sqrt(size[j])))


@dataclass(frozen=True, eq=False, slots=True)
class Window:
    """Data of one sliding window for identification."""

    index: int
    t_end_ns: int
    """Exclusive end of the window, UTC."""
    window_s: float
    """Length of the data in the window, s."""
    rate_hz: float
    sums: LagSums
    first_block: int
    """Number of the first block of `sums` on the stream's grid."""
    segments: tuple[Annotated[ComplexArray, "bins c"], ...]
    """Tapered Fourier transforms of half-overlapping segments, m/s^2/sqrt(Hz)."""
    segment_bin_hz: float
    """Spacing of the bins, which begin at 0 Hz, in Hz."""
    first_segment: int
    """Number of the first segment on the stream's grid."""
    lost: tuple[int, ...] = ()
    """Numbers of the channels (0 = first) that lost samples in the window: what `sums` and `segments` hold of them is made up."""

    def only(self, channels: tuple[int, ...]) -> Window:
        """Select some channels (0 = first): what the window would hold without the others."""
        rows = list(channels)
        return replace(
            self,
            sums=self.sums.only(channels),
            segments=tuple(np.ascontiguousarray(x[:, rows]) for x in self.segments),
            lost=tuple(k for k, channel in enumerate(channels) if channel in self.lost),
        )

    @property
    def cross_spectra(self) -> CrossSpectra | None:
        """Mean over the segments; None without any."""
        return CrossSpectra.of([x[1:] for x in self.segments]) if self.segments else None

    @property
    def rms_m_s2(self) -> float:
        """Response level: mean over channels of the RMS, m/s^2."""
        variance = self.sums.total[0].diagonal() / self.sums.counts.sum()
        return float(np.sqrt(np.maximum(variance, 0.0)).mean())  # of a constant channel: rounding errors of either sign


@dataclass(frozen=True, eq=False, slots=True)
class OtherMode:
    """Mode in the data that takes no part in the updating: the model has no counterpart for it."""

    frequency_hz: float
    frequency_std_hz: float
    """Standard deviation; NaN where not known."""
    damping_ratio: float
    shape: Annotated[ComplexArray, "c"]
    """The largest component is 1."""


@dataclass(frozen=True, eq=False, slots=True)
class ModalEstimate:
    """Modes of one window, in the order of the model's modes (not by their present frequency), with their joint covariance."""

    frequencies_hz: Annotated[Array, "m"]
    damping_ratio: Annotated[Array, "m"]
    shapes: Annotated[ComplexArray, "m c"]
    """The component that is largest in the subspace estimate is 1, that of a channel left out is NaN."""
    model_mode: Annotated[NDArray[np.int64], "m"]
    """Number of the model's mode (0 = lowest) that each mode was matched to."""
    deviations: Annotated[Array, "blocks m columns"]
    """First-order influence of each block of data on (ln f, damping ratio, Re shape, Im shape), 2 + 2 c columns.
    The sum of their squares is the covariance of the estimate; without blocks the covariance is not known."""
    first: int
    """Number of the first deviation on the stream's grid; overlapping windows share the deviations of common data."""
    order: int
    """State-space order of the estimate (a mode that is split at this order is taken from another)."""
    poles: Annotated[Array, "poles 4"]
    """Order, frequency in Hz, damping ratio, 1 if stable; the stabilisation diagram."""
    weight_factor: Annotated[Array, "rows m columns"] | None = None
    """Rows whose squares sum to the covariance for the weights of the updating.  It is the inverse of the likelihood's
    information and well conditioned.  None: weigh by the deviations' variances."""
    refined: bool = False
    """True for the maximum-likelihood estimate, False for the subspace estimate."""
    others: tuple[OtherMode, ...] = ()
    """Modes in the data beside these, by frequency."""
    missing: tuple[tuple[int, str], ...] = ()
    """Number (0 = lowest) of each of the model's modes that was looked for and has no counterpart here, and why."""

    @property
    def frequencies_std_hz(self) -> Array:
        """Standard deviations of the frequencies, Hz; NaN where not known."""
        return np.asarray(self.frequencies_hz * self._std(0))

    @property
    def damping_std(self) -> Array:
        """Standard deviations of the damping ratios; NaN where not known."""
        return self._std(1)

    def _std(self, column: int) -> Array:
        """Compute the standard deviations of one column of the deviations."""
        if not len(self.deviations):
            return np.full(len(self.frequencies_hz), np.nan)
        return np.asarray(np.sqrt((self.deviations[:, :, column] ** 2).sum(axis=0)))

    def only(self, model_modes: frozenset[int]) -> ModalEstimate:
        """Select the estimates of some modes of the model (0 = lowest)."""
        rows = [row for row, mode in enumerate(self.model_mode) if mode in model_modes]
        return replace(
            self,
            frequencies_hz=self.frequencies_hz[rows],
            damping_ratio=self.damping_ratio[rows],
            shapes=self.shapes[rows],
            model_mode=self.model_mode[rows],
            deviations=self.deviations[:, rows],
            weight_factor=None if self.weight_factor is None else self.weight_factor[:, rows],
        )

    def at_channels(self, channels: tuple[int, ...], n_channels: int) -> ModalEstimate:
        """Place the estimates of some channels (0 = first) among all `n_channels`; the others are NaN."""
        if len(channels) == n_channels:
            return self
        shapes = np.full((len(self.shapes), n_channels), np.nan, dtype=complex)
        shapes[:, list(channels)] = self.shapes
        columns = [0, 1, *(2 + k for k in channels), *(2 + n_channels + k for k in channels)]

        def spread(rows: Array) -> Array:
            out = np.full((*rows.shape[:2], 2 + 2 * n_channels), np.nan)
            out[:, :, columns] = rows
            return out

        others = []
        for mode in self.others:
            shape = np.full(n_channels, np.nan, dtype=complex)
            shape[list(channels)] = mode.shape
            others.append(replace(mode, shape=shape))
        return replace(
            self,
            shapes=shapes,
            deviations=spread(self.deviations),
            weight_factor=None if self.weight_factor is None else spread(self.weight_factor),
            others=tuple(others),
        )

    def set_aside(self, model_mode: int, why: str) -> ModalEstimate:
        """Move the counterpart of one of the model's modes to `others`, and note why the model's mode has none."""
        row = self.model_mode.tolist().index(model_mode)
        f, std, damping = self.frequencies_hz[row], self.frequencies_std_hz[row], self.damping_ratio[row]
        aside = OtherMode(float(f), float(std), float(damping), self.shapes[row])
        return replace(
            self.only(frozenset(self.model_mode.tolist()) - {model_mode}),
            others=tuple(sorted((*self.others, aside), key=lambda mode: mode.frequency_hz)),
            missing=tuple(sorted((*self.missing, (model_mode, why)))),
        )


@dataclass(frozen=True, eq=False, slots=True)
class StiffnessEstimate:
    """Story stiffnesses updated to a window's modes."""

    stiffness_n_per_m: Annotated[Array, "n"]
    covariance: Annotated[Array, "n n"]
    """(N/m)^2."""
    converged: bool
    iterations: int
    misfit: float
    """Goodness of fit of the change since the baseline: squared misfit over its expectation; about 1 when stiffness explains the
    change, and 1 without a baseline."""
    mode_misfit: Annotated[Array, "m"] = field(default_factory=lambda: np.zeros(0))
    """Squared misfit of each mode's frequency and shape, over their variances; zeros where the updating could not begin."""


@dataclass(frozen=True, eq=False, slots=True)
class Reading:
    """What is judged of a window: relative loss of each part since the baseline (0.2 = 20 % lost), of whatever is judged of it.

    It is the loss of stiffness for stories and for modes, whose stiffness is the square of the frequency; another kind of
    quantity has a reading of its own, of its own loss.  What the covariates explain is taken out.
    """

    either_side: ClassVar[bool] = False
    """Whether a rise is a change as a loss is."""
    shown_per_loss: ClassVar[float] = 1.0
    """Size that people are told, over `loss`: of a mode, the change of its frequency."""

    loss: Annotated[Array, "q"]
    """NaN for a part that the window does not show."""
    covariance: Annotated[Array, "q q"]
    """Of `loss`, with that of the baseline and of the covariates' law."""
    common_covariance: Annotated[Array, "q q"] = field(default_factory=lambda: np.zeros(()))
    """The part of it that all windows have in common; averaging does not reduce it."""
    freedom: Annotated[Array, "q"] | float = np.inf
    """Effective degrees of freedom of `common_covariance`, of each part or of all."""
    own_freedom: Annotated[Array, "q"] | float | None = None
    """The same of the rest of `covariance`, where it was learned once for all windows; None where each window estimates it."""
    model_form: float = 0.0
    """Error of any part's loss from the systematic misfit of the model, as a share of the largest loss (one standard
    deviation).  It is contained in `covariance`, but is no evidence against a part without loss."""
    covariate_effect: dict[str, Annotated[Array, "q"]] = field(default_factory=dict)
    """For each known covariate: change explained by it, as `ln_stiffness`, removed from the loss."""
    beyond: str = ""
    """What lies beyond calibration, in words, where what is not known of the covariates would hide the loss of an `alarm`."""
    unidentified: tuple[int, ...] = ()
    """Parts, from 1, that the window's modes hardly determine: their loss is determined by the prior alone."""
    channels: tuple[int, ...] = ()
    """Channels (0 = first) that the reading rests on; empty: all."""
    shape: Annotated[Array, "m c"] = field(default_factory=lambda: np.zeros((0, 0)))
    """Change of the real parts of the modes' shapes, 1 at the largest component of the healthy shape, where it is NaN; without
    rows where shapes are not judged by themselves."""
    shape_variance: Annotated[Array, "m c"] = field(default_factory=lambda: np.zeros((0, 0)))
    """With that of the baseline and of the covariates' law."""
    shape_common_variance: Annotated[Array, "m c"] = field(default_factory=lambda: np.zeros((0, 0)))
    """The part of it that windows share."""

    @property
    def own_covariance(self) -> Annotated[Array, "q q"]:
        """Covariance of this window alone: without what windows have in common and the error of the model's form."""
        form = (self.model_form * np.abs(self.loss).max(initial=0.0)) ** 2 if self.model_form else 0.0
        return np.asarray(self.covariance - self.common_covariance + (1e-24 - form) * np.eye(self.loss.size))

    @property
    def ln_stiffness(self) -> Annotated[Array, "q"]:
        """Change since the baseline of the logarithm of what is judged, as stiffness: what the covariates' law predicts."""
        return np.log1p(-np.minimum(self.loss, 1.0 - 1e-6))

    def left_by_others(self, loss: Array, covariance: Array, common: Array, name: str) -> Self:
        """Return the loss that is left beyond what the other parts let expect, which is `name` among the covariates."""
        taken = {**self.covariate_effect, name: loss - self.loss}
        return replace(self, loss=loss, covariance=covariance, common_covariance=common, covariate_effect=taken)


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class DamageReading(Reading):
    """Damage detection index of each story: the relative loss of its stiffness, ``1 - k / k_baseline``."""

    ddi_sequential: Annotated[Array, "n"]
    """Index from the difference of the stiffness matrices, in the paper's sequence."""
    loss_n_per_m: Annotated[Array, "n"]
    """Stiffness lost since the baseline."""
    temperature_effect: Annotated[Array, "n"] | None = None
    """Relative change of stiffness explained by the temperature, removed from the index; None where no dependence is known."""

    @property
    def ddi(self) -> Annotated[Array, "n"]:
        """The index."""
        return self.loss

    @property
    def ddi_std(self) -> Annotated[Array, "n"]:
        """Standard deviations of the index."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @override
    def left_by_others(self, loss: Array, covariance: Array, common: Array, name: str) -> Self:
        shift = self.loss - loss
        # Plain super() fails in the copy of the class that `slots=True` makes.
        left = super(DamageReading, self).left_by_others(loss, covariance, common, name)
        lost = self.loss_n_per_m * (1.0 - shift / np.where(self.loss == 0.0, 1.0, self.loss))
        return replace(left, ddi_sequential=self.ddi_sequential - shift, loss_n_per_m=lost)


@dataclass(frozen=True, eq=False, slots=True)
class ModalReading(Reading):
    """Change of each mode since the baseline; NaN for what the window does not show.

    A mode's loss is the fall of the logarithm of its stiffness, the square of the frequency.
    """

    either_side: ClassVar[bool] = True
    shown_per_loss: ClassVar[float] = 0.5

    spectrum: float = np.nan
    """Score (standard normal) of what changed and is no mode's change: modes that are missing, or that were never there."""

    @property
    @override
    def ln_stiffness(self) -> Annotated[Array, "m"]:
        return -self.loss

    @property
    def ln_frequency(self) -> Annotated[Array, "m"]:
        """Change of the logarithm of each frequency."""
        return -self.shown_per_loss * self.loss

    @property
    def ln_frequency_std(self) -> Annotated[Array, "m"]:
        """Its standard deviation."""
        return np.asarray(self.shown_per_loss * np.sqrt(np.diag(self.covariance)))

    @property
    def ln_frequency_effect(self) -> dict[str, Annotated[Array, "m"]]:
        """Change of the logarithm of the frequency that each known covariate explains."""
        return {name: self.shown_per_loss * part for name, part in self.covariate_effect.items()}

    def largest_shape_change(self) -> tuple[Annotated[Array, "m"], Annotated[Array, "m"]]:
        """Return the most significant change of each shape and its standard deviation; NaN where none is known."""
        z = np.abs(self.shape) / np.sqrt(self.shape_variance)
        rows, best = np.arange(len(z)), np.where(np.isfinite(z), z, -1.0).argmax(axis=1)
        return self.shape[rows, best], np.sqrt(self.shape_variance[rows, best])


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class FeatureReading(Reading):
    """Change of each feature since the healthy time, by the mean of late readings that tells most; NaN for one without any.

    A feature's loss is the fall of its logarithm or, where it is not of one sign, of itself.
    """

    either_side: ClassVar[bool] = True

    names: tuple[str, ...]
    sigma: Annotated[Array, "q"]
    """What the covariates leave of this reading, over the standard deviation of that in healthy ones; NaN where missing."""
    years: float
    """How long a healthy structure takes to show as much; 0 where nothing was judged."""

    @property
    def change(self) -> Annotated[Array, "q"]:
        """Change of each feature."""
        return -self.loss

    @property
    def change_std(self) -> Annotated[Array, "q"]:
        """Its standard deviation."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @property
    def z(self) -> Annotated[Array, "q"]:
        """Size of each change over its standard deviation; 0 where there is none."""
        return np.nan_to_num(np.abs(self.change / self.change_std))

    @property
    def moved(self) -> tuple[int, ...]:
        """Numbers, from 0, of the features that moved, or of the one that did most; the farthest first."""
        least = min(float(self.z.max()), _MOVED_STDS)
        return tuple(j for j in np.argsort(-self.z, kind="stable").tolist() if self.z[j] >= least)

    def told(self, alarm: Alarm) -> list[str]:
        """Name the features that an alarm tells of, the farthest moved first: those at its level, or that moved together."""
        at = {j - 1 for j, level in alarm.active.items() if level is alarm.level}
        own = sorted(at - {len(self.names)}, key=lambda j: -self.z[j])
        return [self.names[j] for j in (own or self.moved if at else ())]


@dataclass(frozen=True, eq=False, slots=True)
class Temperature:
    """Temperature of a window."""

    lagged_degc: Annotated[Array, "lags"]
    """Mean over the window after each thermal lag of `temperature.LAGS_S`, degC; the first is as measured."""


@dataclass(frozen=True, slots=True)
class Alarm:
    """State of the alarm after a window."""

    level: Level
    stories: tuple[int, ...]
    """Story numbers from 1 at this level, of a building those of its storeys; empty if only the structure as a whole, or no
    story, is at it."""
    reason: str
    active: dict[int, Level] = field(default_factory=dict)
    """Announced level of every story that is not normal; the key of the structure as a whole is `WHOLE`.  Without a model the
    numbers are those of the modes' frequencies, then of their shapes, then of the spectrum (`damage.modal_parts`), or those of
    the features, then of all together."""
    conditions: dict[int, AlarmCondition] = field(default_factory=dict)
    """Condition of every alarm that is not normal, including shelved alarms."""
    directions: tuple[str, ...] | None = None
    """Direction of each of `stories` of a building; None elsewhere."""


@dataclass(frozen=True, eq=False, slots=True)
class WindowResult:
    """All results of one window: a line of results.jsonl."""

    index: int
    t_end_ns: int
    window_s: float
    modes: ModalEstimate | None
    stiffness: StiffnessEstimate | None
    damage: DamageReading | None
    alarm: Alarm
    skipped: Skipped | None
    rms_m_s2: float | None = None
    """Response level, m/s^2, mean over channels; None for a window with a gap, or in which no reading changed for a while."""
    temperature: Temperature | None = None
    """Temperature of the window; None without a temperature channel, or where the newest reading is too old."""
    mode_tracks: tuple[int, ...] = ()
    """Number of the track of each mode, then of each of `modes.others`, from 0; -1 for a mode not observed often enough yet."""
    detectable_loss: Annotated[Array, "n"] | None = None
    """Smallest sudden loss of each story that would be seen (`damage.detectable_loss`), and what the source's clock leaves open;
    by modes alone it is the change of each frequency; infinite where none would be seen; None without a baseline."""
    covariates: dict[str, Array] = field(default_factory=dict)
    """Mean of each known covariate over the window after each thermal lag of `temperature.LAGS_S`, in its unit; the level of
    motion has one value, in dB of 1 m of RMS drift."""
    left_out: tuple[LeftOutChannel, ...] = ()
    """Channels of which the window makes no use; their components of `modes.shapes` are NaN."""
    modal: ModalReading | None = None
    """Change of the modes, where they are all that is judged."""
    motion: Annotated[Array, "c c"] | None = None
    """Covariance of the accelerations, (m/s^2)^2; None where not all channels were judged."""
    spectra: CrossSpectra | None = None
    """Of a window of modes alone without a baseline, for calibration."""
    rates_hz: tuple[float, float] | None = None
    """Rate that the source states, and its rate by the timestamps, Hz."""
    features: FeatureReading | None = None
    """Change of the features, where these are judged."""


@dataclass(frozen=True, slots=True)
class LeftOutChannel:
    """Channel that is left out of a window, or of windows until it has been well for long enough."""

    channel: str
    reason: str
    """What is wrong with it, as a clause whose subject is the channel, such as "does not move"."""
    since_ns: int
    """End of the first window without it, UTC."""


@dataclass(frozen=True, slots=True)
class Gap:
    """Gap in the stream: missing samples, or a jump of the clock."""

    t_ns: int
    """UTC where the gap begins."""
    duration_s: float
    reason: str
