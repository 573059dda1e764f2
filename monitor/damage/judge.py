"""What a site's windows are judged by: the interface that a model's stiffness and the modes alone share."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from monitor.core import Alarm, Array, DamageReading, ModalEstimate, ModalReading, Skipped, StiffnessEstimate, Window
from monitor.damage.alarm import AlarmSettings, AlarmState
from monitor.damage.baseline import Baseline
from monitor.damage.covariate_law import CovariateLaw, Effect
from monitor.damage.covariates import CovariateSettings, beyond_words
from monitor.damage.modal_baseline import ModalBaseline
from monitor.damage.slow_learning import LearningState
from monitor.damage.updating import UpdatingSettings
from monitor.identification import RefinementSettings, SelectionSettings, SsiSettings, SubArray
from monitor.signals import ProcessingSettings

LEAST_SHARE = 0.5
"""Share of the modes looked for that must be found: without a model, of the baseline's; with a model and no baseline, of the
lowest required ones. [ratio; judgement]"""
_USELESS_LOSS = 0.5
"""Loss of a story's stiffness that a window must be able to show to be judged at all. [1; judgement: near collapse]"""


AnyBaseline = Baseline | ModalBaseline
"""Healthy state of a structure with a model, or of modes alone."""


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
    level_weights: Array | None
    """Shape (c, c): from the covariance of these channels' accelerations to the level of motion; None where it is not known."""


@dataclass(frozen=True, eq=False, slots=True)
class Memory:
    """State of the judging between windows."""

    alarm: AlarmState
    learning: LearningState | None
    """The covariates' law as it was learned on in service; None before the first judged window."""


@dataclass(frozen=True, eq=False, slots=True)
class Judged:
    """What the modes of a window say of the structure."""

    modes: ModalEstimate
    """The modes that were judged."""
    alarm: Alarm
    stiffness: StiffnessEstimate | None = None
    damage: DamageReading | None = None
    modal: ModalReading | None = None
    detectable_loss: Array | None = None
    """As in `WindowResult`."""


class Judge(Protocol):
    """Reference with which windows are compared, and the comparison; all results depend on its arguments alone."""

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

    def judge(
        self,
        memory: Memory,
        modes: ModalEstimate,
        covariates: Mapping[str, Array],
        view: View,
        t_end_ns: int,
        settings: JudgeSettings,
    ) -> tuple[Memory, Judged] | Skipped:
        """Compare a window's modes with the reference, and update the alarms."""
        ...

    def hold(self, state: AlarmState, t_ns: int) -> tuple[AlarmState, Alarm]:
        """Keep the alarms over a window that was not judged."""
        ...


def explained(
    law: CovariateLaw | None, covariates: Mapping[str, Array], alarm: AlarmSettings
) -> Effect | Skipped | None:
    """Predict what the covariates do to healthy stiffness.

    Returns
    -------
    Effect, Skipped or None
        `Skipped` where the law's uncertainty alone would hide the loss of half a story's stiffness; None without a law.
    """
    if law is None:
        return None
    effect = law.expected(covariates)
    hidden = alarm.significance * float(np.sqrt(effect.covariance.diagonal().max()))
    return Skipped(beyond_words(law, covariates)) if hidden > _USELESS_LOSS else effect


def hidden_words(
    law: CovariateLaw | None, effect: Effect | None, covariates: Mapping[str, Array], alarm: AlarmSettings
) -> str:
    """Say what lies beyond calibration where the law's uncertainty alone would hide the loss of an `alarm`."""
    if effect is None or law is None:
        return ""
    std = float(np.sqrt(effect.covariance.diagonal().max()))
    return beyond_words(law, covariates) if alarm.significance * std > alarm.alarm_loss else ""
