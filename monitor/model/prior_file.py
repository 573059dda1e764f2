"""Conversion of a diagnosis's reference, the prior of the healthy structure, to and from its part of the baseline file."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np
from scipy.linalg import block_diag

from monitor.core import Array, decode, encode
from monitor.model.effects import FORMS
from monitor.model.model import Model
from monitor.model.prior import ModelDiscrepancy, StructuralPrior, as_stated


@dataclass(frozen=True, eq=False, slots=True)
class _Effect:
    """A persistent effect."""

    effect: str
    location: str
    parameters: dict[str, float]


@dataclass(frozen=True, eq=False, slots=True)
class _Error:
    """`ModelDiscrepancy`, real and imaginary part apart."""

    hz: Annotated[Array, "m"]
    real: Annotated[Array, "m c c"]
    imaginary: Annotated[Array, "m c c"]
    variance: Annotated[Array, "m"]


@dataclass(frozen=True, eq=False, slots=True)
class _Content:
    """`StructuralPrior` without the structure itself and what its file states, which come from the structure file."""

    effects: tuple[_Effect, ...]
    correction: Annotated[Array, "b"]
    mean: Annotated[Array, "x"]
    precision: Annotated[Array, "x x"]
    basis: Annotated[Array, "b n n"]
    reference_degc: float | None
    error: _Error | None
    judged_hz: tuple[float, float] | None
    ln_forces: Annotated[Array, "n"] | None


def prior_content(prior: StructuralPrior | None) -> dict[str, Any] | None:
    """Convert a prior to JSON content."""
    if prior is None:
        return None
    e = prior.error
    content = _Content(
        effects=tuple(_Effect(one.name, one.location, one.values()) for one in prior.effects(prior.mean)),
        correction=prior.parts(prior.mean)[4],
        mean=prior.mean,
        precision=prior.precision,
        basis=prior.basis,
        reference_degc=prior.reference_degc,
        error=None if e is None else _Error(e.hz, e.relative.real, e.relative.imag, e.variance),
        judged_hz=prior.judged_hz,
        ln_forces=prior.ln_forces,
    )
    return dict(encode(content))


def read_prior(content: Any, model: Model, channels: tuple[str, ...]) -> StructuralPrior | None:
    """Read a prior from JSON content, on the structure file's model.

    Effects that the structure file states now and the calibration did not know, as after a finding was accepted, are added as
    stated.  Raises ValueError, KeyError or TypeError if the content is not a prior of this structure.
    """
    if content is None:
        return None
    n, b, p = model.structure.n_dofs, model.structure.n_masses, model.structure.n_stories
    c = decode(_Content, content, place="reference", n=n, c=len(channels))
    effects = tuple(FORMS[e.effect].create(e.location, e.parameters) for e in c.effects)
    size = p + b + n + len(channels) + c.basis.shape[0] + sum(len(e.parameters) for e in effects)
    if c.mean.size != size:
        raise ValueError(f"reference.mean: {c.mean.size} values, {size} are expected")
    with np.errstate(over="ignore", under="ignore"):
        sizes = np.exp(c.mean[: p + b])
    if not (np.isfinite(sizes) & (sizes > 0.0)).all():
        raise ValueError("the reference holds stiffnesses or masses that are not finite, above zero")
    healthy = model.with_stiffness(sizes[:p]).with_masses(sizes[p:])
    for effect in effects:
        effect.check(healthy.structure, channels)
    known = {(e.name, e.location) for e in effects}
    added = tuple(e for e in model.effects if (e.name, e.location) not in known)
    more = np.concatenate([[], *[e.coordinates for e in added]])
    return StructuralPrior(
        model=replace(model, effects=effects + added),
        mean=np.concatenate([c.mean, more]),
        precision=block_diag(c.precision, np.diag(as_stated(added))) if more.size else c.precision,
        basis=c.basis,
        reference_degc=c.reference_degc,
        error=None if c.error is None else _read_error(c.error),
        judged_hz=c.judged_hz,
        ln_forces=c.ln_forces,
    ).with_known_lines()


def _read_error(content: _Error) -> ModelDiscrepancy:
    """Build the model error and check it."""
    if content.hz.size < 2 or not (np.diff(content.hz) > 0.0).all() or (content.variance < 0.0).any():
        raise ValueError("reference.error: its bands or variances are damaged")
    return ModelDiscrepancy(content.hz, content.real + 1j * content.imaginary, content.variance)
