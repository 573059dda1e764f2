"""A recording, searched for causes once for all who look at the answer."""

from __future__ import annotations

from dataclasses import dataclass, replace

from drivers.base import ACCELERATION
from monitor.config import Configuration
from monitor.diagnosis import Diagnosis, DiagnosisSettings, HeldOutGain, content as content_of, diagnose
from monitor.diagnosis.initial_fit import fit_linearized
from monitor.diagnosis.score_test import fit_candidate
from monitor.diagnosis.verdict import Cause
from monitor.inference import Segments, classify, gather
from monitor.model import Context, Effect, parse_effect, prior_from_drawing, simulate
from monitor.runs import cut_into_blocks

CONFIG = Configuration.model_validate(
    {
        "structure": {
            "kind": "shear_frame",
            "masses_kg": [0.3253, 0.3514, 0.3129],
            "stiffness_n_per_m": [2909.4511, 1514.8507, 1897.6986],
        },
        "sensors": [{"channel": name, "floor": i} for i, name in enumerate(("a1", "a2 <b>&", "a3"), 1)],
    }
)

REFERENCE = prior_from_drawing(CONFIG.model(), 0.01 * CONFIG.instrumented().prior_std, 3)

GAIN = HeldOutGain(
    1.0,
    1.05,
    (0.04, 0.06),
    csd_error_before=0.2,
    csd_error_after=0.1,
    heldout="every block judged by the fit to the others",
)

LOSS = "stiffness_change:story 2:relative=-0.1"


@dataclass(frozen=True, eq=False)
class Case:
    diagnosis: Diagnosis
    segments: Segments

    @property
    def content(self):
        gain = GAIN if self.diagnosis.final_fit.effects else HeldOutGain()
        return content_of(self.diagnosis, gain, (), {"without": [], "with": []})


def recorded(*effects: Effect, rate_hz: float = 200.0) -> tuple[Segments, Context]:
    model = replace(CONFIG.model(), effects=effects)
    motion = simulate(model, duration_s=400.0, rate_hz=rate_hz, noise=0.05, level_spread=0.35, seed=5)
    context = Context(model.structure, CONFIG.channels, CONFIG.instrumented().sensor_matrix, rate_hz)
    samples = motion.floors
    segments = gather(
        cut_into_blocks(ACCELERATION, samples, CONFIG.channels, rate_hz, 10**18, 1000), CONFIG.front_end()
    )
    return segments, context


def stated(effect: Effect) -> Cause:
    """As a cause whose size is known well."""
    return Cause(effect, dict.fromkeys(effect.values(), 0.001))


def searched(truth: tuple[str, ...], tried: tuple[str, ...], verdict: str, *, causes: int = 0) -> Case:
    """A diagnosis whose candidates are given, so that the search's choice is not what is tested here."""
    segments, context = recorded(*(parse_effect(t) for t in truth))
    posterior, null = fit_linearized(classify(segments), REFERENCE, context)
    candidates = tuple(fit_candidate(posterior, null, parse_effect(t)) for t in tried)
    blank = diagnose(classify(segments), REFERENCE, context, DiagnosisSettings(worth=1e9))
    best = candidates[0]
    ambiguous = verdict == "ambiguous"
    return Case(
        replace(
            blank,
            verdict=verdict,
            causes=(stated(best.effect),) * causes,
            alternatives=tuple((c, 1.0 / len(candidates)) for c in candidates) if ambiguous else (),
            left_over=blank.misfit if verdict == "unexplained" else (),
            candidates=candidates,
            final_fit=best.fit if causes or ambiguous else blank.null_fit,
            posterior=posterior,
            rounds=(candidates,),
        ),
        segments,
    )
