"""Modes alone on records as measured ones are: they differ, last seconds, have one channel, and lack a mode now and then."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from monitor.core import GAP, BadInputError, Level, WindowResult
from monitor.damage import (
    Course,
    Known,
    ModalBaseline,
    State,
    assess,
    follow,
    load_modal_baseline,
    modal_parts,
    save_baseline,
)
from monitor.pipeline import Pipeline
from monitor.publish import facts_of_line, to_json, window_line
from monitor.runs.baselines import modal_origin
from tests.support.scattered import Scattered, calibrated, site, watched

TRAIN = Scattered((120.0, 310.0), damping=0.02, rate_hz=1000.0, scatter=0.12, damping_scatter=0.3, quiet=0.1)
"""A suspension: records of 8 s with one channel, whose frequencies differ by 6 % from record to record."""
TRAIN_SITE = site(1, 8.0, 2.0, TRAIN.rate_hz)
FALLEN = (0.0, -0.25)


@pytest.fixture(scope="module")
def train() -> ModalBaseline:
    return calibrated(TRAIN.records(15, 8.0, 1), TRAIN_SITE, TRAIN.rate_hz)


def seen(baseline: ModalBaseline, seed: int, n: int, change: tuple[float, ...] = ()) -> list[WindowResult]:
    """Windows of records, one after the other."""
    records = TRAIN.records(n, 8.0, seed, change)
    windows = [w for record in watched(Pipeline(TRAIN_SITE, baseline), records, TRAIN.rate_hz) for w in record]
    return [w for w in windows if w.skipped is None or not w.skipped.reason.startswith(GAP)]


def test_the_baseline_states_how_far_its_records_differ(train: ModalBaseline) -> None:
    spread = np.sqrt(train.scatter.beyond[:2] + train.scatter.stated[:2])
    assert (spread > 0.5 * TRAIN.scatter).all(), "of ln stiffness"
    assert (spread < 2.0 * TRAIN.scatter).all()
    own = 0.5 * np.sqrt(train.scatter.stated[:2] / 15) * train.frequencies_hz
    assert (train.frequencies_std_hz > 5.0 * own).all(), "the mean of what windows state of themselves is no interval"
    assert (train.scatter.freedom <= 28.0).all(), "two modes, fifteen records"


def test_healthy_records_are_not_announced_and_changed_ones_are_confirmed_and_told_without_a_size(
    train: ModalBaseline,
) -> None:
    assert {w.alarm.level for w in seen(train, 2, 10)} == {Level.NORMAL}
    changed = seen(train, 3, 6, FALLEN)
    assert changed[-1].alarm.level is Level.WARNING
    assert all(w.modal is not None for w in changed)
    alone = next(w for w in changed if w.alarm.active == {5: Level.WARNING})
    assert alone.alarm.reason == (
        "changed since the baseline: the shape of the spectrum changed; no mode's change tells how"
    )
    line = json.loads(to_json(window_line(alone)))
    assert line["alarm"]["changed"] == ["the spectrum"]
    facts = facts_of_line(line)
    assert facts.losses == {5: (line["spectrum_score"], 1.0, None)}
    known = Known(modal_parts(2), True, 0.1, 5.0, (0.0, 10.0), n_modes=2)
    state = assess(follow(Course(), facts, known), known)
    assert state.state is State.WARNING
    assert "the spectrum changed, warning since" in state.headline
    assert state.headline.endswith("no mode's change tells how.")
    assert "%" not in state.headline, "what cannot be matched has no size"


def test_records_as_long_as_a_window_and_its_hop_are_judged_and_nothing_is_said_twice(train: ModalBaseline) -> None:
    config = site(1, 8.0, 8.0, TRAIN.rate_hz)
    pipeline = Pipeline(config, calibrated(TRAIN.records(15, 8.0, 1), config, TRAIN.rate_hz))
    windows = [w for record in watched(pipeline, TRAIN.records(6, 8.0, 3, FALLEN), TRAIN.rate_hz) for w in record]
    assert [w.skipped for w in windows] == [None] * 6
    assert windows[-1].alarm.level is Level.WARNING
    said = [part for w in windows for part in w.alarm.reason.replace("; ", ", ").split(", ")]
    assert all(w.alarm.reason.count(part) == 1 for w in windows for part in said if part in w.alarm.reason)


def test_the_baselines_file_holds_scatter_rates_and_spectrum(train: ModalBaseline, tmp_path: Path) -> None:
    save_baseline(train, tmp_path / "b.json")
    read = load_modal_baseline(tmp_path / "b.json", train.channels, modal_origin(TRAIN_SITE))
    assert np.array_equal(read.scatter.freedom, train.scatter.freedom)
    assert read.presence.windows == train.presence.windows
    assert read.spectrum is not None
    assert train.spectrum is not None
    assert read.spectrum.scatter.replayed_t2 == train.spectrum.scatter.replayed_t2
    text = (tmp_path / "b.json").read_text().replace('"scatter": {\n  "stated"', '"scatters": {\n  "stated"')
    (tmp_path / "old.json").write_text(text)
    with pytest.raises(BadInputError, match=r"old\.json: .*scatter.*calibrate"):
        load_modal_baseline(tmp_path / "old.json", train.channels, modal_origin(TRAIN_SITE))


ONE = Scattered((2.0, 5.5, 9.0), damping=0.012, rate_hz=50.0, scatter=0.01, quiet=0.15)
ONE_SITE = site(1, 60.0, 30.0, ONE.rate_hz)


def test_a_window_with_one_mode_is_judged_by_that_mode_and_one_without_any_by_the_rates_of_calibration() -> None:
    baseline = calibrated(ONE.records(10, 120.0, 1), ONE_SITE, ONE.rate_hz)
    only = Scattered(ONE.frequencies_hz[:1], damping=ONE.damping, rate_hz=ONE.rate_hz)
    other = Scattered((16.0,), damping=ONE.damping, rate_hz=ONE.rate_hz)
    for structure, n_modes in ((only, 1), (other, 0)):
        (windows,) = watched(Pipeline(ONE_SITE, baseline), structure.records(1, 240.0, 2), ONE.rate_hz)
        judged = [w for w in windows if w.skipped is None]
        assert len(judged) == 7
        for w in judged:
            assert w.modal is not None
            assert np.isfinite(w.modal.loss).sum() == n_modes
            assert np.isfinite(w.modal.spectrum)
