"""What is judged of a structure, and what judging needs to know of it.

Judging knows only the vector of losses (`core.Reading`).  What reads it from a window's modes, against those of the baseline,
satisfies `Quantities`: the stiffness of the stories by a model (`story_stiffness`), or that of the modes (`modal_stiffness`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, ClassVar, Protocol

import numpy as np

from monitor.core import Array, CrossSpectra, ModalEstimate, Reading, Skipped, StiffnessEstimate, Window
from monitor.damage.alarm import AlarmSettings, AlarmState
from monitor.damage.baseline import AnyBaseline
from monitor.damage.covariate_law import CovariateLaw, Effect
from monitor.damage.covariates import CovariateSettings, beyond_words
from monitor.damage.limits import Scores
from monitor.damage.parts import Parts
from monitor.damage.presence import Beside, Sighting
from monitor.damage.updating import UpdatingSettings
from monitor.identification import RefinementSettings, SelectionSettings, SsiSettings, SubArray
from monitor.signals import ProcessingSettings

LEAST_SHARE = 0.5
"""Share of the modes looked for that must be found: without a model, of the baseline's; with a model and no baseline, of the
lowest required ones. [ratio; judgement]"""

_USELESS_LOSS = 0.5
"""Loss of a story's stiffness that a window must be able to show to be judged at all. [1; judgement: near collapse]"""

UNCERTAIN = Skipped("the modes' uncertainty is not asked for, so nothing is judged")
"""Why a window of modes without uncertainty is not judged. [words]"""
Covariates = Mapping[str, Array]
"""Lagged values of each covariate that is known of a window."""


class JudgeSettings(Protocol):
    """Settings that judging needs, as a site's configuration has them."""

    processing: ProcessingSettings
    identification: SsiSettings
    selection: SelectionSettings
    refinement: RefinementSettings
    updating: UpdatingSettings
    compensation: CovariateSettings
    alarm: AlarmSettings


@dataclass(frozen=True, eq=False, slots=True)
class View:
    """The channels that a window is judged with."""

    array: SubArray
    level_weights: Annotated[Array, "c c"] | None
    """From the covariance of these channels' accelerations to the level of motion; None where it is not known."""


@dataclass(frozen=True, eq=False, slots=True)
class Found:
    """What the modes of a window say of the quantities."""

    modes: ModalEstimate
    """The modes that were used."""
    reading: Reading | None
    """None where there is nothing to compare with."""
    stiffness: StiffnessEstimate | None = None


class Quantities(Protocol):
    """What is judged; all that it says depends on its arguments, and those it was made with, alone."""

    without_baseline: ClassVar[str]
    """Why no alarm is announced without a baseline."""

    @property
    def baseline(self) -> AnyBaseline | None:
        """The healthy state; without one nothing is announced.  Its `law` is that of this vector: the judge learns it on."""
        ...

    @property
    def parts(self) -> Parts:
        """The parts of the vector, in words."""
        ...

    @property
    def names(self) -> tuple[str, ...]:
        """What people call each story; empty where none is named."""
        ...

    def start(self, window_s: float) -> AlarmState:
        """Return the state of the alarms before the first window."""
        ...

    def view(self, channels: tuple[int, ...]) -> View:
        """Return what windows of some channels (0 = first) are judged with."""
        ...

    def identify(
        self, window: Window, cutoff_hz: float, view: View, settings: JudgeSettings
    ) -> ModalEstimate | Skipped:
        """Identify the modes of a window of the channels in use."""
        ...

    def beside(
        self,
        sightings: tuple[Sighting, ...],
        modes: ModalEstimate,
        spectra: CrossSpectra | None,
        covariates: Covariates,
        view: View,
        t_end_ns: int,
        settings: JudgeSettings,
    ) -> tuple[tuple[Sighting, ...], Beside | None]:
        """Return the latest windows' modes with this one's, and what they and the spectra say; None where nothing does."""
        ...

    def lacking(self, modes: ModalEstimate, view: View, select: SelectionSettings) -> Skipped | None:
        """Say why a window's modes are not enough to be judged; None where they are."""
        ...

    def read(
        self, modes: ModalEstimate, view: View, effect: Effect | None, covariates: Covariates, settings: JudgeSettings
    ) -> Found | Skipped:
        """Compare a window's modes with the baseline's, less the `effect` of the covariates."""
        ...


def explained(law: CovariateLaw | None, covariates: Covariates, settings: JudgeSettings) -> Effect | Skipped | None:
    """Predict what the covariates do to healthy stiffness; None without a law.

    It is `Skipped` where the law's uncertainty alone would hide the loss of half a part's stiffness.
    """
    if law is None:
        return None
    effect, p = law.expected(covariates), settings.processing
    hidden = float(np.sqrt(effect.covariance.diagonal().max()))
    hidden *= settings.alarm.limit(Scores(0, len(law.slopes)), p.window_s, p.hop_s)
    return Skipped(beyond_words(law, covariates)) if hidden > _USELESS_LOSS else effect
