"""Conversion of a diagnosis's reference, the prior of the healthy structure, to and from its part of the baseline file."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from monitor.model.effects import FORMS
from monitor.model.model import Model
from monitor.model.prior import ModelDiscrepancy, StructuralPrior, as_stated


def to_plain(reference: StructuralPrior | None) -> dict[str, Any] | None:
    """Convert a reference to JSON content.

    The structure itself and what its file states are not part of the content: they come from the structure file.
    """
    if reference is None:
        return None
    return {
        "effects": [
            {"effect": e.name, "location": e.location, "parameters": e.values()}
            for e in reference.effects(reference.mean)
        ],
        "correction": reference.parts(reference.mean)[4].tolist(),
        "mean": reference.mean.tolist(),
        "precision": reference.precision.tolist(),
        "basis": reference.basis.tolist(),
        "reference_degc": reference.reference_degc,
        "error": None if reference.error is None else _error_to_plain(reference.error),
        "judged_hz": reference.judged_hz,
        "ln_forces": None if reference.ln_forces is None else reference.ln_forces.tolist(),
    }


def from_plain(content: dict[str, Any] | None, model: Model, channels: tuple[str, ...]) -> StructuralPrior | None:
    """Read a reference from JSON content, on the structure file's model.

    Effects that the structure file states now and the calibration did not know, as after a finding was accepted, are added as
    stated.

    Raises
    ------
    ValueError, KeyError, TypeError
        If the content is not a reference of this structure.
    """
    if content is None:
        return None
    n, p = model.structure.n_dofs, model.structure.n_stories
    mean, precision = (np.array(content[name], dtype=float) for name in ("mean", "precision"))
    basis = np.array(content["basis"], dtype=float).reshape(-1, n, n)
    first = p + 2 * n + len(channels) + basis.shape[0]
    effects = tuple(FORMS[e["effect"]].create(e["location"], e["parameters"]) for e in content["effects"])
    size = first + sum(len(e.parameters) for e in effects)
    degc, forces = content["reference_degc"], content["ln_forces"]
    ln_forces = None if forces is None else np.array(forces, dtype=float)
    if ln_forces is not None and (ln_forces.shape != (n,) or not np.isfinite(ln_forces).all()):
        raise ValueError(f"the reference's forces are not {n} finite numbers")
    if mean.shape != (size,) or precision.shape != (size, size):
        raise ValueError(f"the reference has shapes {mean.shape} and {precision.shape}, not ({size},)")
    if not (np.isfinite(mean).all() and np.isfinite(precision).all() and np.isfinite(basis).all()):
        raise ValueError("the reference holds numbers that are not finite")
    with np.errstate(over="ignore", under="ignore"):
        sizes = np.exp(mean[: p + n])
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
        mean=np.concatenate([mean, more]),
        precision=block_diag(precision, np.diag(as_stated(added))) if more.size else precision,
        basis=basis,
        reference_degc=None if degc is None else float(degc),
        error=None if content["error"] is None else _error_from_plain(content["error"], len(channels)),
        judged_hz=None if content["judged_hz"] is None else tuple(content["judged_hz"]),
        ln_forces=ln_forces,
    ).with_known_lines()


def _error_to_plain(error: ModelDiscrepancy) -> dict[str, Any]:
    """Convert the model error to JSON content."""
    e = error.relative
    return {
        "hz": error.hz.tolist(),
        "real": e.real.tolist(),
        "imaginary": e.imag.tolist(),
        "variance": error.variance.tolist(),
    }


def _error_from_plain(content: dict[str, Any], n_channels: int) -> ModelDiscrepancy:
    """Read the model error from JSON content and check it."""
    hz, real, imaginary, variance = (
        np.array(content[name], dtype=float) for name in ("hz", "real", "imaginary", "variance")
    )
    shape = (hz.size, n_channels, n_channels)
    if (
        hz.size < 2
        or not (np.diff(hz) > 0.0).all()
        or (real.shape, imaginary.shape, variance.shape) != (shape, shape, hz.shape)
    ):
        raise ValueError("the reference's standing error has the wrong shape")
    if not all(np.isfinite(values).all() for values in (hz, real, imaginary, variance)) or (variance < 0.0).any():
        raise ValueError("the reference's standing error holds numbers that are none")
    return ModelDiscrepancy(hz, real + 1j * imaginary, variance)
