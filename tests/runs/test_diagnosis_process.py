"""Diagnoses in the course of a replay: when they are asked for, and that their failure harms nothing."""

from __future__ import annotations

import json
import time
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from drivers.base import SampleBlock
from monitor.core import Level, Skipped, WindowResult
from monitor.diagnosis import Request, WatchSettings, trigger
from monitor.runs.diagnosis_process import DiagnosisQueue
from monitor.runs.recent_blocks import RecentBlocks
from tests.support.results import alarm, stiffness_estimate, window_result
from tests.support.samples import T0_NS, Cut

WINDOW_S = 100.0
S = 1_000_000_000


def window(t_s: float, level: Level = Level.NORMAL, misfit: float = 1.0) -> WindowResult:
    said = alarm(level, "story 2 lost 6 %" if level.rank else "")
    fit = stiffness_estimate(np.ones(3), misfit)
    return window_result(round(t_s), t_end_ns=round(t_s * S), window_s=WINDOW_S, stiffness=fit, alarm=said)


def requests(results: list[WindowResult], settings: WatchSettings | None = None) -> list[Request]:
    """What a run of windows asks for, its end included."""
    settings = settings or WatchSettings()
    state, out, t_ns = trigger.WatchState(), [], 0
    for result in results:
        state, request = trigger.step(state, result, settings, WINDOW_S)
        out.append(request)
        t_ns = result.t_end_ns
    out.append(trigger.finish(state, t_ns, settings, WINDOW_S))
    return [r for r in out if r is not None]


def run(*parts: tuple[int, int, Level], misfit: float = 1.0) -> list[WindowResult]:
    return [window(t, level, misfit) for first, last, level in parts for t in range(first, last, 10)]


NORMAL, ADVISORY, WARNING, ALARM = Level.NORMAL, Level.ADVISORY, Level.WARNING, Level.ALARM


def test_an_alarm_asks_once_when_a_windows_length_has_come_since() -> None:
    (request,) = requests(run((100, 300, NORMAL), (300, 500, WARNING), (500, 900, ALARM)))
    assert (request.from_ns, request.to_ns) == (300 * S, 400 * S)
    assert request.reason == "warning: story 2 lost 6 %"


def test_the_next_episode_asks_anew() -> None:
    episodes = run((100, 300, WARNING), (300, 600, NORMAL), (600, 800, WARNING))
    assert [r.from_ns for r in requests(episodes)] == [100 * S, 600 * S]


def test_an_advisory_asks_for_nothing() -> None:
    assert requests(run((100, 600, ADVISORY))) == []


def test_an_episode_that_ends_early_is_judged_on_a_windows_length() -> None:
    (request,) = requests(run((100, 300, NORMAL), (300, 330, WARNING)))
    assert (request.from_ns, request.to_ns) == (220 * S, 320 * S)


def test_stiffness_that_does_not_explain_the_change_asks_too() -> None:
    (request,) = requests(run((100, 600, NORMAL), misfit=20.0))
    assert request.from_ns == 200 * S
    assert requests(run((100, 600, NORMAL), misfit=3.0)) == []
    assert requests(run((100, 150, NORMAL), misfit=20.0)) == []  # not for a window's length


def test_skipped_windows_neither_end_nor_begin_an_episode() -> None:
    hole = replace(window(350.0), skipped=Skipped("a gap"), stiffness=None)
    (request,) = requests([*run((300, 350, WARNING)), hole, *run((360, 600, WARNING))])
    assert request.from_ns == 300 * S


def test_watching_may_be_switched_off() -> None:
    assert requests(run((100, 600, ALARM)), WatchSettings(diagnose=False)) == []


def test_recent_blocks_are_bounded_and_cut_by_time(cut: Cut) -> None:
    recent = RecentBlocks(longest_s=30.0)
    for block in cut(np.zeros((10_000, 3)), 100.0, [100]):
        recent.push(block)
    kept = recent.between(0, T0_NS + 1000 * S)
    assert len(kept) == 61  # and half a minute to spare
    assert [b.t_ns for b in recent.between(T0_NS + 80 * S, T0_NS + 82 * S)] == [T0_NS + 80 * S, T0_NS + 81 * S]


def test_what_is_kept_does_not_depend_on_how_samples_were_cut(cut: Cut) -> None:
    values = np.random.default_rng(1).standard_normal((10_000, 3))
    span = T0_NS + 83 * S + 5_000_000, T0_NS + 91 * S + 50_000_000
    kept = []
    for size in (1, 7, 100, 1000):
        recent = RecentBlocks(longest_s=30.0)
        for block in cut(values, 100.0, [size]):
            recent.push(block)
        blocks = recent.between(*span)
        assert blocks[0].t_ns == T0_NS + 83 * S + 10_000_000 and blocks[0].sequence == 8301
        kept.append(np.concatenate([b.samples for b in blocks]).tobytes())
    assert len(set(kept)) == 1 and len(kept[0]) == 804 * 3 * 4


@pytest.fixture
def structure(tmp_path: Path, frame_text: str) -> Path:
    path = tmp_path / "s.toml"
    path.write_text(frame_text)
    return path


def found(structure: Path, blocks: Iterable[SampleBlock], time_limit_s: float = 60.0) -> dict:
    folder = structure.parent / "findings"
    diagnoser = DiagnosisQueue(structure, None, folder, time_limit_s)
    try:
        diagnoser.submit(Request(1, 2, "why"), blocks)
        end_s = time.monotonic() + 2.0 * time_limit_s + 10.0
        (finding,) = diagnoser.wait(lambda: time.monotonic() > end_s)
    finally:
        diagnoser.close()
    assert json.loads((folder / "001.json").read_text()) == finding
    return finding


def test_a_diagnosis_that_fails_is_a_finding_that_says_so(structure: Path, cut: Cut) -> None:
    finding = found(structure, cut(np.ones((1000, 3)), 100.0))
    assert finding["verdict"] is None
    assert "10 s of usable data" in finding["error"]


def test_a_diagnosis_whose_data_cannot_be_read_is_a_finding_that_says_so(structure: Path, cut: Cut) -> None:
    """Without a finding the end of a run would wait for it without end."""

    def damaged() -> Iterator[SampleBlock]:
        yield from cut(np.ones((1000, 3)), 100.0)
        raise ValueError("no such block")

    finding = found(structure, damaged())
    assert finding["verdict"] is None and finding["error"] == "ValueError: no such block"


def test_a_diagnosis_that_takes_too_long_is_given_up(structure: Path, cut: Cut) -> None:
    finding = found(structure, cut(np.ones((1000, 3)), 100.0), time_limit_s=0.01)
    assert finding["verdict"] is None
    assert "longer than 0.01 s" in finding["error"]


def test_findings_of_an_earlier_run_are_removed(structure: Path) -> None:
    folder = structure.parent / "findings"
    folder.mkdir()
    (folder / "001.json").write_text("{}")
    DiagnosisQueue(structure, None, folder, 1.0).close()
    assert not list(folder.iterdir())
