"""The channel without which the model explains a recording: at fault in a way that no effect has, or alone in what it sees."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.special import fdtrc

from monitor.core import parallel_map
from monitor.diagnosis.lack_of_fit import LackOfFit, find_lack_of_fit, residual_bands
from monitor.diagnosis.settings import DiagnosisSettings
from monitor.inference import MapEstimate, Posterior, classify, maximize_posterior

_DROWNED = 1e8
"""Power of what stands for a channel that is left out, over its largest. [ratio; numerical]"""


def find_channel_at_fault(posterior: Posterior, fit: MapEstimate, settings: DiagnosisSettings) -> LackOfFit | None:
    """Find the channel without which a fit without causes leaves nothing over, and far less than without any other.

    A change of the structure shows in most channels, a fault of a channel, or a change that it alone sees, in that channel.
    """
    channels = posterior.context.channels
    if len(channels) < 2:
        return None
    left = parallel_map(lambda a: _left_by_others(posterior, fit, a, settings), range(len(channels)))
    squares, n, wrong = (np.array(of) for of in zip(*left, strict=True))
    channel = int(squares.argmin())
    ratio = np.delete(squares, channel).min() / squares[channel]
    if wrong[channel] or fdtrc(n[channel], n[channel], ratio) > settings.false_rate / (len(channels) - 1):
        return None
    name = channels[channel]
    says = (
        f"without channel {name} the model explains the recording: either the channel is at fault, in a way that no known effect "
        "has, or something changed that it alone sees; check its mounting, its cable and its logger, and the structure beside it"
    )
    size = max((m.size for m in find_lack_of_fit(posterior, fit, settings)), default=0.0)
    return LackOfFit(f"channel {name}", size, says, is_explained=True)


def _left_by_others(
    posterior: Posterior, fit: MapEstimate, channel: int, settings: DiagnosisSettings
) -> tuple[float, int, bool]:
    """Fit the model anew without a channel: sum of squares of the others' misfit, its number of terms, and whether it is one.

    The model's own errors, which are in the sums of all channels, cancel in their ratio.
    """
    others = without_channel(posterior, channel)
    refitted = maximize_posterior(others, fit.x, fit.effects)
    z = np.delete(np.delete(residual_bands(others, refitted)[0], channel, axis=1), channel, axis=2)
    return float((z**2).sum()), z.size, bool(find_lack_of_fit(others, refitted, settings))


def without_channel(posterior: Posterior, channel: int) -> Posterior:
    """Put noise of known power, which drowns whatever a channel measures, in its place."""
    e = posterior.observed
    values, rng = e.segments.values.copy(), np.random.default_rng(0)
    real, imaginary = rng.standard_normal((2, *values.shape[:2]))
    power = _DROWNED * float((np.abs(values[:, :, channel]) ** 2).max())
    values[:, :, channel] = np.sqrt(0.5 * power) * (real + 1j * imaginary)
    drift = np.zeros(values.shape[1:]) if e.drift is None else e.drift.copy()
    drift[:, channel] = power
    observed = classify(replace(e.segments, values=values, drift=drift), e.label)
    return replace(posterior, observed=replace(observed, drive=e.drive))
