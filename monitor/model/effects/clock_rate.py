"""Error of the acquisition's sampling clock."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from typing_extensions import override

from monitor.core import Array
from monitor.model.effects.base import Effect, FittedSizes, Parameter

_QUARTZ = (0.99, 1e-4)
"""Share of sampling clocks that a quartz drives, and their error. [1; crystals of loggers are right to 100 parts in a million]"""
_OTHER = (0.01, 1e-2)
"""Share of others, as clocks that a program keeps or rates that were written down wrongly. [1; judgement: one in a hundred]"""


@dataclass(frozen=True)
class ClockRate(Effect):
    """Error of the sampling rate: samples are taken at nominal rate x (1 + relative) and recorded as at the nominal rate."""

    name = "clock_rate"
    family = "sensor"
    places = ("frame",)
    parameters = (Parameter("relative", -0.5, 1.0, absent=0.0),)
    signature = "every frequency by the same factor, shapes and damping ratios untouched"
    separating_measurement = (
        "compare the sampling clock with a second clock, or with a line of known frequency such as the mains"
    )
    start_sizes = ((1e-3,), (6e-3,), (-6e-3,), (1.5e-2,), (-1.5e-2,))

    relative: float

    @property
    @override
    def clock_factor(self) -> float:
        return 1.0 + self.relative

    @override
    def size_cost(self, covariance: Array) -> float:
        variance = float(covariance[0, 0])
        quartz, other = (
            np.log(share) + 0.5 * np.log(variance / total) - 0.5 * self.relative**2 / total
            for share, total in ((share, std**2 + variance) for share, std in (_QUARTZ, _OTHER))
        )
        return -float(np.logaddexp(quartz, other))

    @classmethod
    @override
    def sentence(cls, fitted: FittedSizes) -> str:
        trend = "faster" if fitted.value("relative") > 0 else "slower"
        says = f"the sampling clock runs <>{trend} than its nominal rate"
        return fitted.with_size("relative", says, fitted.percent("relative"))
