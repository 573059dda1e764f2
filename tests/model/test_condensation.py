"""Massless degrees of freedom are condensed without changing a mode; a finite element model gives its own frequencies."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path

import numpy as np
import pytest
import scipy.linalg

from monitor.config import configuration
from monitor.model.structures import condense_massless
from tests.support.commands import ended
from tests.support.samples import Cli

ROOT = Path(__file__).parents[2]


def chain(springs: np.ndarray) -> np.ndarray:
    """Stiffness of a chain that stands on the ground at its end."""
    n = len(springs)
    stretch = np.eye(n) - np.eye(n, k=1)
    return stretch.T @ np.diag(springs) @ stretch


def test_modes_of_the_rest_are_those_of_vanishing_masses() -> None:
    springs = np.array([300.0, 500.0, 200.0, 700.0, 400.0])
    stiffness, mass = chain(springs), np.diag([2.0, 0.0, 1.5, 0.0, 3.0])
    slopes = np.array([chain(row) for row in np.eye(5)])
    m, k, dk, kept = condense_massless(mass, stiffness, slopes)
    assert kept.tolist() == [0, 2, 4]
    tiny = np.where(np.diag(mass) == 0.0, 1e-9, np.diag(mass))
    full = scipy.linalg.eigh(stiffness, np.diag(tiny), eigvals_only=True)[:3]
    np.testing.assert_allclose(scipy.linalg.eigh(k, m, eigvals_only=True), full, rtol=1e-6)
    step = 1e-5 * springs[1]
    moved = condense_massless(mass, stiffness + step * slopes[1])[1]
    np.testing.assert_allclose((moved - k) / step, dk[1], atol=1e-4 * np.abs(dk[1]).max())
    whole = condense_massless(np.eye(2), np.eye(2))
    assert whole[1].tolist() == np.eye(2).tolist() and whole[2].shape == (0, 2, 2)


@pytest.mark.parametrize(
    ("mass", "stiffness", "says"),
    [
        (np.zeros((2, 2)), np.eye(2), "no degree of freedom has mass"),
        (np.array([[1.0, 0.5], [0.5, 0.0]]), np.eye(2), "coupled by mass"),
        (np.diag([1.0, 0.0]), np.diag([1.0, 0.0]), "held by no stiffness"),
        (np.eye(2), np.eye(3), "do not fit"),
    ],
)
def test_what_cannot_be_condensed_is_said(mass: np.ndarray, stiffness: np.ndarray, says: str) -> None:
    with pytest.raises(ValueError, match=says):
        condense_massless(mass, stiffness)


@pytest.mark.system
def test_a_frame_of_opensees_has_the_frequencies_that_opensees_gives(tmp_path: Path, main: Cli) -> None:
    """In a process of its own: the program keeps its model in the library, and may fail to load there."""
    if importlib.util.find_spec("openseespy") is None:
        pytest.skip("openseespy is not installed")
    probe = ended(sys.executable, "-c", "import openseespy.opensees")
    if probe.returncode:
        pytest.skip(f"openseespy cannot be imported: {(probe.stderr.strip().splitlines() or ['it ends'])[-1]}")
    code = (
        "import json, sys; from pathlib import Path; from tests.examples.opensees_frame import write_structure; "
        "print('given', json.dumps(list(write_structure(Path(sys.argv[1])))))"
    )
    made = ended(sys.executable, "-c", code, tmp_path / "f.toml", cwd=ROOT)
    assert made.returncode == 0, made.stderr
    own_hz = json.loads(made.stdout.partition("given ")[2].splitlines()[0])
    model = configuration.load(tmp_path / "f.toml").model()
    found_hz = model.modes().frequencies_hz
    np.testing.assert_allclose(found_hz, own_hz, rtol=1e-6)
    assert found_hz[0] > 0.5
    done = main("check", tmp_path / "f.toml")
    assert done.returncode == 0 and "3 stiffnesses, 3 degrees of freedom" in done.stdout, done.stdout + done.stderr
