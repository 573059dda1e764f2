"""Every state of the structure reads the same, word and headline, wherever it is shown."""

from __future__ import annotations

import html
import json
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from prometheus_client.core import Metric

from monitor.core import AlarmCondition, Level, WindowResult
from monitor.damage import Known, State
from monitor.publish import read_period, replay_text, to_json, write_period
from monitor.runs import Session
from monitor.service import ZenohOutSettings, fleet, outlets, status, text
from monitor.service.lease import FolderLease
from monitor.service.outlets.metrics import Metrics, MetricsSettings
from monitor.service.outlets.notices import Notice, NoticeSettings, Told, of_window
from monitor.service.outlets.zenoh import ZenohOut
from monitor.signals import Health, sensor_health
from tests.support.frames import settings_of
from tests.support.results import alarm, damage_reading, modal_estimate, stiffness_estimate, window_result
from tests.support.samples import CHANNELS, T0_NS, Cut

WINDOW_S, HOP_S, COUNT = 20.0, 5.0, 6
KNOWN = Known(("storey above", "middle storey", "storey below"), has_baseline=True, alarm_loss=0.1, misfit=5.0)
EXIT = {State.NORMAL: 0, State.ADVISORY: 10, State.WARNING: 10, State.ALARM: 10}
"""Exit codes of `status` and `fleet`; of the others 11."""


def window(index: int, state: State) -> WindowResult:
    """A window of three stories in that state: a loss of the middle story, a poor fit, or a story that is not seen."""
    lost = {State.ADVISORY: 0.05, State.WARNING: 0.06, State.ALARM: 0.123}.get(state, 0.0)
    active = {2: Level(state.value)} if lost else {}
    stiffness = np.array([2900.0, 1500.0, 1900.0])
    return window_result(
        index,
        t_end_ns=T0_NS + round((WINDOW_S + index * HOP_S) * 1e9),
        window_s=WINDOW_S,
        modes=modal_estimate([4.6, 13.1, 17.9], np.eye(3)),
        stiffness=stiffness_estimate(stiffness, misfit=31.0 if state is State.DOUBTFUL else 1.1),
        damage=damage_reading(np.array([0.0, lost, 0.0]), 1e-4 * np.eye(3), 1500.0),
        alarm=alarm(
            active.get(2, Level.NORMAL), active=active, conditions=dict.fromkeys(active, AlarmCondition.NORMAL)
        ),
        rms_m_s2=0.01,
        mode_tracks=(0, 1, 2),
        detectable_loss=np.array([0.021, 0.034, np.inf if state is State.NOT_JUDGED else 0.017]),
    )


class Lines(outlets.Outlet):
    """Keeps the lines of results.jsonl, and the notices that people would get."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.told, self.notices = Told(), list[Notice]()

    def window(self, result: WindowResult, line: str) -> None:
        self.lines.append(line)
        self.told, found = of_window(self.told, result, self.present, NoticeSettings(blind_s=WINDOW_S))
        self.notices += found


class Site(Session):
    """A session that knows a baseline and needs none."""

    _known = property(lambda self: KNOWN)  # type: ignore[assignment]


@pytest.mark.parametrize("state", list(State))
def test_a_state_reads_the_same_at_every_outlet(
    state: State, tmp_path: Path, frame_text: str, cut: Cut, monkeypatch: pytest.MonkeyPatch
) -> None:
    lines, metrics = Lines(), Metrics("bench", MetricsSettings())
    out = ZenohOut("bench", ZenohOutSettings(connect=("tcp/127.0.0.1:9",), connect_timeout_s=0.1))
    site = Site(settings_of(frame_text), None, (lines, metrics, out), None, tmp_path / "findings")
    try:
        channels = tuple(sensor_health.ChannelHealth(name, 0.0, 0.01, 0.05, 0, 0.0, 0.0, 1e-6) for name in CHANNELS)
        results: list[WindowResult | Health] = [window(index, state) for index in range(COUNT)]
        results.append(Health(T0_NS, T0_NS + 10**10, 100.0, 1000, 1.0, 0, 0.0, 0, channels))
        monkeypatch.setattr(site.pipeline, "push", lambda block: results)
        site.push(cut(np.zeros((1, 3)), 100.0)[0])
        answer = out.answer()
    finally:
        out.close(0.0)
    said = site.present
    assert said.state is state
    if state is State.NORMAL:
        assert said.headline == "No loss above 3.4 % in any story."

    (tmp_path / "results.jsonl").write_text("\n".join(lines.lines) + "\n")
    summary = json.loads(to_json(site.content(1.0)))
    (tmp_path / "summary.json").write_text(to_json(summary))
    assert {key: summary[key] for key in ("state", "headline", "doubts")} == said.content
    assert f"{state.words}: {said.headline}" in replay_text(summary).splitlines()

    write_period(tmp_path / "report.html", read_period(tmp_path, None, None))
    report = html.unescape((tmp_path / "report.html").read_text())
    assert f">{state.words}</span><h1>{said.headline}</h1>" in report

    (tmp_path / "state").mkdir()
    health = {"wall_ns": time.time_ns(), "source": {"connected": True}, "recorder": None, "failed": {}}
    (tmp_path / "health.jsonl").write_text(json.dumps(health) + "\n")
    lease = FolderLease(tmp_path)
    lease.acquire()
    running = status.look(tmp_path)
    lease.release()
    assert {key: running[key] for key in said.content} == said.content
    assert (running["monitor"], running["exit_code"]) == ("running", EXIT.get(state, 11))
    assert status.tell(running).splitlines()[0] == f"state     {state.words.upper()}: {said.headline}"

    gauges: list[Metric] = [family for family in metrics.collect() if family.name == "shm_state"]
    assert [s.labels for s in gauges[0].samples if s.value] == [{"state": state.value}]

    answered = json.loads(answer)
    assert {key: answered[key] for key in said.content} == said.content
    health = {"wall_ns": time.time_ns(), "source": {"connected": True}, "recorder": None, "failed": {}}
    shown = fleet.status("bench", json.dumps(answered | {"health": health}).encode(), True, time.time_ns(), 60.0)
    silent = fleet.status("bench", answer.encode(), True, time.time_ns(), 60.0)
    assert silent.state is (State.NOT_JUDGED if state is State.NORMAL else state), "no green without a word of health"
    assert (shown.state, shown.headline, shown.doubts) == (said.state, said.headline, said.doubts)
    assert state.words in text([shown]) and said.headline in text([shown])
    assert fleet.code([shown]) == EXIT.get(state, 11)

    announced = [notice for notice in lines.notices if not notice.good]
    assert [n.title.startswith(state.words) for n in announced] == [True] * (state is not State.NORMAL)
    assert all(n.text.splitlines() == [said.headline, *said.doubts] for n in announced)


def test_a_monitor_that_does_not_run_says_no_normal(tmp_path: Path) -> None:
    (tmp_path / "state").mkdir()
    for state, wanted in ((State.NORMAL, State.NOT_JUDGED), (State.ALARM, State.ALARM)):
        content = {"state": state.value, "headline": "The latest headline.", "doubts": []}
        (tmp_path / "summary.json").write_text(json.dumps(content))
        (tmp_path / "results.jsonl").write_text(json.dumps({"t_end_ns": T0_NS, "skipped": None}) + "\n")
        ended = status.look(tmp_path)
        assert (ended["state"], ended["monitor"], ended["exit_code"]) == (wanted.value, "not running", 12)
        rows = status.tell(ended)
        assert "The monitor does not run" in rows and "he latest headline, as of 2026-01-01 00:00 UTC." in rows


def test_an_alarm_that_a_restart_kept_stands_before_the_first_window(tmp_path: Path, frame_text: str) -> None:
    site = Site(settings_of(frame_text), None, (), None, tmp_path / "findings")

    def kept(level: Level) -> None:
        site.alter_alarm(
            lambda alarm: replace(
                alarm, stories=(alarm.stories[0], replace(alarm.stories[1], level=level), *alarm.stories[2:])
            )
        )

    assert site.present.state is State.NOT_JUDGED
    kept(Level.ALARM)
    assert site.present.state is State.ALARM and "alarm of middle storey stands from before" in site.present.headline
    window_s = site.config.processing.window_s
    assert f"No window of data yet; the first takes {window_s:g} s of data." in site.present.doubts
