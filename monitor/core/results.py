"""The nouns: frozen values that stages hand on and publishers publish.

Every field's doc gives its unit and shape; ``m`` modes, ``n`` stories, ``c`` channels.  Every estimate carries
its covariance, and "cannot say" is a value (`Skipped`).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


WHOLE = 0
"""Story number of the structure as a whole."""


class Level(StrEnum):
    """Alarm levels, in rising order."""

    NORMAL = "normal"
    ADVISORY = "advisory"
    WARNING = "warning"
    ALARM = "alarm"

    @property
    def rank(self) -> int:
        """0 for normal to 3 for alarm."""
        return _RANKS[self]


_RANKS = {level: rank for rank, level in enumerate(Level)}


class AlarmCondition(StrEnum):
    """What became of an alarm, by the state diagram of IEC 62682 (ISA-18.2)."""

    NORMAL = "normal"
    UNACKNOWLEDGED = "active, unacknowledged"
    ACKNOWLEDGED = "active, acknowledged"
    RETURNED_UNACKNOWLEDGED = "returned to normal, unacknowledged"
    LATCHED_UNACKNOWLEDGED = "latched, unacknowledged"
    LATCHED_ACKNOWLEDGED = "latched, acknowledged"
    SHELVED = "shelved"


GAP = "gap in the data"


@dataclass(frozen=True, slots=True)
class Skipped:
    """Nothing could be said about a window, and why."""

    reason: str

    @property
    def mend(self) -> str:
        """The reason, with what helps where something does."""
        if self.reason == GAP:
            return f"{GAP}; a shorter [processing] window_s loses less to each"
        return self.reason


@dataclass(frozen=True, eq=False, slots=True)
class Samples:
    """Conditioned samples, one common clock."""

    t_ns: int
    """UTC of the first sample."""
    rate_hz: float
    values: Array
    """Shape (n_samples, c), m/s^2."""


@dataclass(frozen=True, eq=False, slots=True)
class LagSums:
    """Lagged products of one window about its mean, as they come: sums over blocks of the raw samples."""

    products: Array
    """Shape (n_blocks, 2 i, c, c), (m/s^2)^2: ``sum_k y[k] y[k + tau]^T`` over the samples k of a block."""
    shifted: Array
    """Shape (n_blocks, 2 i, c): sums of the second factors, at lag 0 of the first ones as well."""
    mean: Array
    """Shape (c,), of the window, m/s^2."""
    counts: NDArray[np.int64]
    """Shape (n_blocks,): the number of products in each block."""
    head: Array
    """Shape (2 i - 1, c): the window's first samples about its mean, m/s^2."""
    tail: Array
    """Shape (2 i - 1, c): the window's last samples about its mean."""
    total: Array
    """Shape (2 i, c, c): sum of the blocks about the window's mean."""


@dataclass(frozen=True, eq=False, slots=True)
class Window:
    """One sliding window, ready for identification."""

    index: int
    t_end_ns: int
    """Exclusive end of the window, UTC."""
    window_s: float
    """Length of the data in the window."""
    rate_hz: float
    sums: LagSums
    first_block: int
    """Number of the first block of `sums` on the stream's grid."""
    segments: tuple[ComplexArray, ...]
    """Each of shape (n_bins, c): tapered Fourier transforms of half-overlapping segments, m/s^2/sqrt(Hz)."""
    segment_bin_hz: float
    """Spacing of the bins, which begin at 0 Hz."""
    first_segment: int
    """Number of the first segment on the stream's grid."""

    @property
    def rms_m_s2(self) -> float:
        """Response level: mean over channels of the RMS."""
        variance = self.sums.total[0].diagonal() / self.sums.counts.sum()
        return float(np.sqrt(variance).mean())


@dataclass(frozen=True, eq=False, slots=True)
class ModalEstimate:
    """Modes of one window in the order of the model's, whichever is lower now, with their joint covariance."""

    frequencies_hz: Array
    """Shape (m,)."""
    damping_ratio: Array
    """Shape (m,)."""
    shapes: ComplexArray
    """Shape (m, c); each with one component, the subspace estimate's largest, 1."""
    model_mode: NDArray[np.int64]
    """Shape (m,): which mode of the model (0 = lowest) each one was matched to."""
    deviations: Array
    """Shape (n_blocks, m, 2 + 2 c): first-order influence of each block of data on (ln f, damping ratio, Re shape,
    Im shape).  Their sum of squares is the covariance of the estimate; without blocks it is not known."""
    first: int
    """Number of the first deviation on the stream's grid: windows that overlap share what happened there."""
    order: int
    """State-space order that the estimate was taken from (a mode that it splits, from another)."""
    poles: Array
    """Shape (n_poles, 4): order, frequency in Hz, damping ratio, 1 if stable; the stabilisation diagram."""
    weight_factor: Array | None = None
    """Shape (n_rows, m, 2 + 2 c): rows whose squares sum to a covariance that weighs the updating; from the likelihood's
    information, so well conditioned.  None: weigh by the deviations' variances."""
    refined: bool = False
    """Whether this is the maximum-likelihood estimate rather than the subspace one."""

    @property
    def frequencies_std_hz(self) -> Array:
        """Shape (m,), Hz; not a number where it is not known."""
        return np.asarray(self.frequencies_hz * self._std(0))

    @property
    def damping_std(self) -> Array:
        """Shape (m,); not a number where it is not known."""
        return self._std(1)

    def _std(self, column: int) -> Array:
        if not len(self.deviations):
            return np.full(len(self.frequencies_hz), np.nan)
        return np.asarray(np.sqrt((self.deviations[:, :, column] ** 2).sum(axis=0)))

    def only(self, model_modes: frozenset[int]) -> ModalEstimate:
        """The estimate of these modes of the model (0 = lowest) alone."""
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


@dataclass(frozen=True, eq=False, slots=True)
class StiffnessEstimate:
    """Story stiffness updated to a window's modes."""

    stiffness_n_per_m: Array
    """Shape (n,)."""
    covariance: Array
    """Shape (n, n), (N/m)^2."""
    converged: bool
    iterations: int
    misfit: float
    """Goodness of fit of the change since the baseline: squared misfit over its expectation; 1 when stiffness explains it."""


@dataclass(frozen=True, eq=False, slots=True)
class DamageReading:
    """Relative stiffness loss of each story since the baseline (0.2 = 20 % lost)."""

    ddi: Array
    """Shape (n,): the direct parameter ratio, 1 - k / k_baseline."""
    ddi_covariance: Array
    """Shape (n, n); contains the baseline's own uncertainty."""
    ddi_sequential: Array
    """Shape (n,): read from the difference of the stiffness matrices in the paper's sequence."""
    loss_n_per_m: Array
    """Shape (n,): stiffness lost since the baseline."""
    common_covariance: Array = field(default_factory=lambda: np.zeros(()))
    """Shape (n, n): the part of `ddi_covariance` that all windows share, the baseline's own, which no averaging lessens."""
    model_form: float = 0.0
    """Share of the largest loss by which the model's standing misfit may falsify any story's, one standard deviation; it
    is in `ddi_covariance`, but says nothing against a story that lost nothing."""
    temperature_effect: Array | None = None
    """Shape (n,): relative change of stiffness that the temperature explains, already taken out of the index; None where
    no dependence is known."""
    unidentified: tuple[int, ...] = ()
    """Stories, from 1, of which the window's modes say next to nothing: their index is held by the prior alone."""

    @property
    def ddi_std(self) -> Array:
        """Shape (n,)."""
        return np.asarray(np.sqrt(np.diag(self.ddi_covariance)))

    @property
    def form_variance(self) -> float:
        """The part of every story's variance that the model's form adds, in proportion to the largest loss."""
        return float((self.model_form * np.abs(self.ddi).max(initial=0.0)) ** 2)


@dataclass(frozen=True, eq=False, slots=True)
class Temperature:
    """What a window felt."""

    lagged_degc: Array
    """Shape (n_lags,): mean over the window behind each of `temperature.LAGS_S`, degC; the first is as measured."""


@dataclass(frozen=True, slots=True)
class Alarm:
    """State of the alarm after a window."""

    level: Level
    stories: tuple[int, ...]
    """Story numbers from 1 at this level; empty for the whole structure or none."""
    reason: str
    active: dict[int, Level] = field(default_factory=dict)
    """Announced level of every story that is not normal; `WHOLE` stands for the structure as a whole."""
    conditions: dict[int, AlarmCondition] = field(default_factory=dict)
    """AlarmCondition of every alarm that is not normal, shelved ones among them."""


@dataclass(frozen=True, eq=False, slots=True)
class WindowResult:
    """Everything said about one window: a line of results.jsonl."""

    index: int
    t_end_ns: int
    window_s: float
    modes: ModalEstimate | None
    stiffness: StiffnessEstimate | None
    damage: DamageReading | None
    alarm: Alarm
    skipped: Skipped | None
    rms_m_s2: float | None = None
    """Response level, mean over channels; None for a window with a hole."""
    temperature: Temperature | None = None
    """None without a temperature channel, or where it is too old."""
    mode_tracks: tuple[int, ...] = ()
    """Identity over time of each of the modes, from 0; -1 for one not seen often enough yet."""
    detectable_loss: Array | None = None
    """Shape (n,): smallest sudden loss of each story that would be seen (`damage.detectable_loss`), infinite where none would;
    None without a baseline."""


@dataclass(frozen=True, slots=True)
class Gap:
    """Samples that never came, or a clock that jumped."""

    t_ns: int
    """UTC where the gap begins."""
    duration_s: float
    reason: str
