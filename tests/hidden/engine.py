"""The engine as a stranger uses it: a drawing, a healthy recording, a recording; an answer in the contract's words."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from drivers.base import SampleBlock
from monitor.config import Configuration
from monitor.diagnosis import Diagnosis
from monitor.inference import gather
from monitor.model import StructuralPrior, prior_from_drawing
from monitor.runs import diagnose


@dataclass(frozen=True, eq=False)
class Baseline:
    """What calibration keeps."""

    config: Configuration
    reference: StructuralPrior

    def persistent(self) -> list[str]:
        """Effects that were there from the start, with their places."""
        return [f"{effect.name} {effect.location}" for effect in self.reference.model.effects]


def calibrate(drawing: str, blocks: Iterable[SampleBlock]) -> Baseline:
    """Learn the healthy structure."""
    config = Configuration.model_validate(tomllib.loads(drawing))
    return Baseline(config, diagnose.learn_healthy_prior(gather(blocks, config.front_end()), config))


def uncalibrated(drawing: str) -> Baseline:
    """The drawing alone, for a diagnosis without a baseline."""
    config = Configuration.model_validate(tomllib.loads(drawing))
    prior_std = config.instrumented().prior_std
    return Baseline(config, prior_from_drawing(config.model(), prior_std, len(config.channels)))


def answer(baseline: Baseline, blocks: Iterable[SampleBlock]) -> dict[str, Any]:
    """What `diagnosis.json` says."""
    segments = gather(blocks, baseline.config.front_end())
    d, gain = diagnose.diagnose_segments(segments, baseline.reference, baseline.config)
    return {
        "verdict": d.verdict,
        "causes": _causes(d),
        "alternatives": [
            {"effect": c.effect.name, "location": c.effect.location, "probability": float(p)} for c, p in d.alternatives
        ],
        "nats": (gain.after - gain.before) * segments.samples,
        "persistent": baseline.persistent(),
        "band_hz": [round(float(f), 2) for f in segments.band.hz[[0, -1]]],
        "left_over": [[m.where, round(float(m.size), 1)] for m in d.left_over[:3]],
        "stories": _stories(d),
    }


def _stories(d: Diagnosis) -> list[dict[str, float]]:
    """Fitted over drawn stiffness of every story, and its standard deviation; empty with a baseline."""
    if d.posterior.prior.is_baseline:
        return []
    these = d.posterior.layout.stiffness
    ratio = np.exp(d.final_fit.x[these] - d.posterior.prior.mean[these])
    std = ratio * np.sqrt(np.diag(d.final_fit.covariance)[these])
    return [{"value": float(r), "std": float(s)} for r, s in zip(ratio, std, strict=True)]


def _causes(d: Diagnosis) -> list[dict[str, Any]]:
    return [
        {
            "effect": c.effect.name,
            "location": c.effect.location,
            "parameters": {
                name: {"value": float(value), "std": float(np.nan_to_num(c.std.get(name, 0.0), posinf=1e300))}
                for name, value in c.effect.values().items()
            },
        }
        for c in d.causes
    ]
