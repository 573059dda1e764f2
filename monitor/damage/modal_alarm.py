"""Alarms of modes alone: changes of frequencies and of shapes to either side, by the stages of `alarm` and `sequential_test`.

The size of a change of frequency is that of the modal stiffness, twice as large, so that the thresholds of ``[alarm]`` mean the
same as with a model.  As there, a mode is announced for what it changed beyond the change that all modes have in common, and a
common change is an advisory of the whole.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np

from monitor.core import WHOLE, Alarm, Array, ModalReading
from monitor.damage import alarm, sequential_test
from monitor.damage.alarm import AlarmSettings, AlarmState, StoryState
from monitor.damage.detectable_loss import detectable_change


def modal_parts(n_modes: int) -> tuple[str, ...]:
    """Name what the alarms are about, by their numbers from 1: the modes' frequencies, then their shapes.

    Examples
    --------
    >>> modal_parts(2)
    ('mode 1', 'mode 2', 'the shape of mode 1', 'the shape of mode 2')
    """
    modes = [f"mode {i}" for i in range(1, n_modes + 1)]
    return (*modes, *(f"the shape of {mode}" for mode in modes))


def change_words(part: str, change: float, std: float) -> str:
    """Say how a part changed, with two standard deviations.

    Examples
    --------
    >>> change_words("mode 2", -0.013, 0.001)
    'mode 2 fell by 1.3 ± 0.2 %'
    """
    verb = "changed" if part.startswith("the shape") else "fell" if change < 0.0 else "rose"
    return f"{part} {verb} by {100 * abs(change):.1f} ± {200 * std:.1f} %"


def start(n_modes: int, n_channels: int, window_s: float) -> AlarmState:
    """Return the state before the first window."""
    frequencies = sequential_test.begin(n_modes, window_s)
    shapes = sequential_test.begin(n_modes * n_channels, window_s, variances_only=True)
    return AlarmState((StoryState(),) * (2 * n_modes + 1), frequencies, shapes)


def step(
    state: AlarmState, reading: ModalReading, t_ns: int, settings: AlarmSettings, channels: tuple[str, ...]
) -> tuple[AlarmState, Alarm]:
    """Update the alarms by one window's reading; `t_ns` is the UTC of the window's end.

    A mode or a channel that the window does not show leaves its alarm as it is.  As in `alarm.step`, a window beyond calibration
    ends no announcement.
    """
    assert state.shapes is not None
    m = reading.ln_frequency.size
    frequencies, evidence = _of_frequencies(state, reading, t_ns, settings)
    shapes, over = sequential_test.average(
        state.shapes,
        reading.shape.ravel(),
        (reading.shape_variance - reading.shape_common_variance).ravel(),
        np.nan_to_num(reading.shape_common_variance).ravel(),
        reading.channels,
        t_ns,
    )
    seen = sequential_test.lone_statistic(over)
    parts, updated, words = modal_parts(m), list(state.stories), dict[int, str]()
    known = np.flatnonzero(np.isfinite(reading.ln_frequency)).tolist()
    for k, j in enumerate(known):
        size, std = float(evidence.loss[k]), float(evidence.std[k])
        updated[j] = alarm.update_alarm(
            state.stories[j], abs(float(evidence.own[k])), float(evidence.z[k]), std, t_ns, settings
        )
        words[j + 1] = change_words(parts[j], -0.5 * size, 0.5 * std)
    for j in known:
        rows = slice(j * len(channels), (j + 1) * len(channels))
        best = int(seen.z[rows].argmax())
        size, std = float(seen.loss[rows][best]), float(seen.std[rows][best])
        before, z = state.stories[m + j], float(seen.z[rows][best])
        updated[m + j] = alarm.update_alarm(before, abs(size), z, std, t_ns, _warning_only(settings))
        words[m + j + 1] = f"{change_words(parts[m + j], size, std)} of its largest component at {channels[best]}"
    shared = sequential_test.shared_change(evidence.loss, evidence.std)
    std = float(evidence.std.max())
    whole = abs(shared), abs(shared) / std, std
    updated[-1] = alarm.update_alarm(state.stories[-1], *whole, t_ns, alarm.advisory_only(settings))
    verb = "fell" if shared > 0.0 else "rose"
    alike = f"all modes {verb} by {50 * abs(shared):.1f} % alike (weather, mass, clock or stiffness)"
    words[WHOLE] = alike
    if reading.beyond:
        updated = [alarm.unless_fallen(s, now) for s, now in zip(state.stories, updated, strict=True)]
    state = AlarmState(tuple(alarm.end_shelving(s, t_ns) for s in updated), frequencies, shapes)
    return state, told(state, words, alike if shared else "", reading.beyond)


def told(state: AlarmState, words: dict[int, str], otherwise: str, beyond: str = "") -> Alarm:
    """Combine the alarms to the announced level with its reason; no story is named."""
    says = alarm.summarize(state.stories, words, otherwise, modal_parts(len(state.stories) // 2))
    reason = f"changed since the baseline: {says.reason}" if says.active and words else says.reason
    reason = reason.replace("no significant loss", "no significant change")
    return replace(says, stories=(), reason=f"{reason}; {beyond}" if beyond else reason)


def hold(state: AlarmState, t_ns: int) -> tuple[AlarmState, Alarm]:
    """Keep the alarms over a skipped window."""
    state, says = alarm.hold(state, t_ns, modal_parts(len(state.stories) // 2))
    return state, replace(says, stories=())


def detectable(state: AlarmState, reading: ModalReading, hop_s: float, settings: AlarmSettings) -> Array:
    """Compute the smallest sudden change of each frequency that the alarm sees, shape (m,), relative; infinite where none."""
    known = np.flatnonzero(np.isfinite(reading.ln_frequency))
    h = state.history
    shown = replace(h, ddi=h.ddi[:, known], common=h.common[:, known][:, :, known], ln_variance=h.ln_variance[known])
    out = np.full(reading.ln_frequency.size, np.inf)
    out[known] = 0.5 * detectable_change(shown, hop_s, settings)
    return out


def _of_frequencies(
    state: AlarmState, reading: ModalReading, t_ns: int, settings: AlarmSettings
) -> tuple[sequential_test.History, sequential_test.SequentialStatistic]:
    """Update the test statistic of the frequencies that the window shows: losses of modal stiffness."""
    own = 4.0 * (reading.covariance - reading.common_covariance)
    common = 4.0 * reading.common_covariance
    values = -2.0 * reading.ln_frequency
    history, over = sequential_test.average(state.history, values, own.diagonal(), common, reading.channels, t_ns)
    known = np.flatnonzero(np.isfinite(values))
    shown = replace(
        over,
        means=over.means[:, known],
        variances=over.variances[:, known],
        common=over.common[:, known][:, :, known],
        agrees=over.agrees[:, known],
    )
    return history, sequential_test.change_statistic(shown, own[np.ix_(known, known)], settings.model_form)


@lru_cache(maxsize=8)
def _warning_only(settings: AlarmSettings) -> AlarmSettings:
    """Return the settings for shapes, whose change has no size that could be compared with a loss: never above warning."""
    return settings.model_copy(update={"alarm_loss": np.inf})
