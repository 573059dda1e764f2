"""Stories between records: what healthy records differ by is in the baseline, and in the reading of each window."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from monitor.config import Configuration
from monitor.damage import Baseline, HealthyData, learn_baseline, load_baseline, save_baseline
from tests.support.frames import shear_frame
from tests.support.learned import results_of

SCATTER, WINDOW_S, RECORDS = 0.05, 20.0, 6


@pytest.fixture(scope="module")
def site() -> Configuration:
    processing = {"window_s": WINDOW_S, "hop_s": 10.0}
    stiffness = (2909.0, 1515.0, 1898.0)
    return shear_frame((0.33, 0.35, 0.31), stiffness, processing=processing, identification={"block_rows": 10})


def windows(site: Configuration, records: int, seed: int) -> list:
    """Two windows a record, in whose records each story's stiffness is another."""
    rng, out = np.random.default_rng(seed), []
    for k in range(records):
        model = site.model()
        factor = 1.0 + SCATTER * rng.standard_normal(3)
        changed = model.with_stiffness(model.structure.stiffness_n_per_m * factor)
        out.append([r for r in results_of(changed, site, None, seed + k, 45.0) if r.modes is not None][::2][:2])
    return out


@pytest.fixture(scope="module")
def healthy(site: Configuration) -> Baseline:
    records = windows(site, RECORDS, 1)
    return learned(site, records)


def learned(site: Configuration, records: list) -> Baseline:
    flat = [(k, r) for k, record in enumerate(records) for r in record if r.modes is not None]
    data = HealthyData(
        windows=[r.modes for _, r in flat],
        rms_m_s2=np.array([r.rms_m_s2 for _, r in flat]),
        covariates=[r.covariates for _, r in flat],
        units={"level": "dB"},
        t_ns=[r.t_end_ns + 10**12 * k for k, r in flat],
        records=[k for k, _ in flat],
        window_s=WINDOW_S,
    )
    return learn_baseline(site.instrumented(), data, updating=site.updating, compensation=site.compensation)[0]


def test_the_scatter_of_the_stories_between_records_is_learned(healthy: Baseline) -> None:
    assert healthy.scatter is not None
    assert healthy.scatter.records == RECORDS
    std = np.sqrt(healthy.scatter.beyond + healthy.scatter.stated)
    assert (std > 0.3 * SCATTER).all(), "five degrees of freedom tell a deviation by no better"
    assert (std < 3.0 * SCATTER).all()


def test_a_reading_states_it_as_common_to_all_windows_with_the_records_degrees_of_freedom(
    site: Configuration, healthy: Baseline
) -> None:
    assert healthy.scatter is not None
    (window, *_) = [r for r in results_of(healthy.model, site, healthy, 9, 45.0) if r.damage is not None]
    common = np.diag(window.damage.common_covariance)
    assert (common >= healthy.scatter.beyond).all()
    assert np.array_equal(window.damage.freedom, healthy.scatter.freedom)


def test_the_file_keeps_it(site: Configuration, healthy: Baseline, tmp_path: Path) -> None:
    save_baseline(healthy, tmp_path / "b.json")
    read = load_baseline(tmp_path / "b.json", site.instrumented(), site.updating)
    assert read.scatter is not None
    assert healthy.scatter is not None
    assert np.array_equal(read.scatter.beyond, healthy.scatter.beyond)


def test_stories_that_the_sensors_do_not_tell_apart_keep_what_the_drawing_knows(tmp_path: Path) -> None:
    """Three sensors and two modes for six stories: the windows' changes are finite, and no larger than the drawing allows."""
    processing = {"window_s": WINDOW_S, "hop_s": 10.0, "cutoff_hz": 10.0, "rate_hz": 40.0}
    six = shear_frame([0.33] * 6, [1900.0] * 6, [1, 3, 5], processing=processing, selection={"required_modes": 2})
    rng, records = np.random.default_rng(3), []
    for k in range(5):
        stiffness = six.model().structure.stiffness_n_per_m * (1.0 + 0.03 * rng.standard_normal(6))
        found = results_of(six.model().with_stiffness(stiffness), six, None, 40 + k, 65.0)
        records.append([r for r in found if r.modes is not None and r.modes.model_mode.tolist() == [0, 1]][::2])
    healthy = learned(six, records)
    assert healthy.scatter is not None
    assert (healthy.scatter.beyond < 0.2**2).all()
    save_baseline(healthy, tmp_path / "b.json")
