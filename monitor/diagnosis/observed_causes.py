"""Causes that the samples show, where a response to measured ground motion cannot be searched for them."""

from __future__ import annotations

from dataclasses import replace

from monitor.diagnosis.plan import plan_of
from monitor.diagnosis.verdict import Cause, Diagnosis
from monitor.model import EFFECTS


def add_observed_causes(diagnosis: Diagnosis) -> Diagnosis:
    """Add the causes whose size the samples alone determine, as a channel's clipping, where the ground was measured.

    Such a motion is not stationary, so the search leaves out effects whose linearization needs that.  The segments in which a
    clipped channel reaches its limit are left out of the search too (`Segments.without_clipped`).
    """
    posterior, plan = diagnosis.posterior, plan_of(diagnosis.posterior)
    context, condition = posterior.context, posterior.conditions[0]
    known = {(e.name, e.location) for e in posterior.prior.model.effects}
    found = []
    for kind in (kind for kind in EFFECTS.values() if kind.stationary_only and not plan.tries(kind)):
        for place in (p for p in kind.places_in(context) if (kind.name, p) not in known):
            for start in kind.starts(place, context, condition)[:1]:
                coordinates, precision = start.known(context, condition)
                if (precision > 0.0).all():
                    found.append(Cause.of(start.at(coordinates), precision**-0.5))
    if not found:
        return diagnosis
    verdict = "named" if diagnosis.verdict == "none" else diagnosis.verdict
    return replace(diagnosis, verdict=verdict, causes=(*found, *diagnosis.causes))
