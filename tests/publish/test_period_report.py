"""The period report: its page is whole, by itself, says the run's figures, and stays light over months."""

from __future__ import annotations

import json
import re
import subprocess
from pathlib import Path

import numpy as np
import pytest

from monitor.core import BadInputError
from monitor.damage import Known
from monitor.publish.page.sheet import Sheet
from monitor.publish.reports.period_data import read_results
from monitor.publish.reports.period_report import read_period, write_period
from monitor.publish.results.event_lines import event_line, event_text
from tests.publish import event_pages
from tests.support.pages import Page, marks, numbers
from tests.support.period_lines import ALARM, HOP, SKIPPED, T0, json_lines, line_of
from tests.support.samples import Cli

DAY = 86400 * 10**9
WINDOWS = 90 * 144
AWAY = range(6_000, 6_720)


@pytest.fixture(scope="module")
def months(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ninety days as the daemon leaves them: away for five, blind for one, one alarm diagnosed and acknowledged."""
    folder = tmp_path_factory.mktemp("months") / "bridge-7 <b>&"
    (folder / "findings" / "one").mkdir(parents=True)
    json_lines(folder / "results.jsonl", [line_of(k) for k in range(WINDOWS) if k not in AWAY])
    alarm_ns = T0 + (ALARM[0] + 1) * HOP
    finding = {"id": "001", "t_ns": alarm_ns + HOP, "from_ns": alarm_ns - HOP, "reason": "warning: story 2 lost 8 %",
               "verdict": "named", "says": "story 2 is 8.0 % softer <than> before"}  # fmt: skip
    json_lines(folder / "findings" / "one" / "001.json", [finding])
    channel = {"rms_m_s2": 3.0, "peak_m_s2": 7.5, "spikes": 2, "repeated": 0.0, "clipped": 0.0, "noise_floor": 1e-4}
    health = [
        {
            "t_ns": T0 + d * DAY,
            "wall_ns": T0 + d * DAY,
            "stream": {"rate_hz": 100.0, "samples": 8_640_000, "gaps": 1, "lost_s": 864.0, "overlaps": 0},
            "channels": [{"channel": "a1", **channel}],
            "source": {"clocks": [{"node": "n1", "offset_s": 0.001 * d, "drift_ppm": 12.0}]},
        }
        for d in range(1, 91)
    ]
    json_lines(folder / "health.jsonl", health)
    when = np.datetime64(alarm_ns + 2 * HOP, "ns").astype("datetime64[s]")
    asked = {"when": f"{when}+00:00", "who": "ada", "what": "acknowledge alarm of story 2: seen on site"}
    json_lines(folder / "ledger.jsonl", [asked])
    limits = {"false_announcements_per_year": 0.5, "min_loss": 0.01, "alarm_loss": 0.1}
    (folder / "summary.json").write_text(json.dumps({"alarms": [], "thresholds": limits}))
    return folder


def test_a_building_is_shown_by_plan_and_elevation() -> None:
    names = [f"storey {j} (floor {j}), {way}" for way in ("along x", "along y") for j in (1, 2)]
    cells = [("normal", "0.1"), ("normal", "0.2"), ("alarm", "10.0"), ("not_judged", "not judged")]
    page = Sheet("house")
    page.section("Where")
    page.elevation("loss, %", names, cells, {})
    page.elevation("loss, %", ["story 1", "story 2"], cells[:2], {})  # of a frame there is none
    shown = Page(page.html())
    assert shown.tables == [
        [
            ["storey", "along x", "along y"],
            ["storey 2 (floor 2)", "0.2", "not judged"],
            ["storey 1 (floor 1)", "0.1", "10.0"],
        ]
    ]
    assert [given["class"] for tag, given in shown.tags if tag == "path"] == ["normal", "alarm"]


def parsed(path: Path) -> Page:
    return Page(path.read_text(encoding="utf-8"))


def drawn(folder: Path) -> Page:
    """The page of all that a folder holds."""
    write_period(folder / "r.html", read_period(folder, None, None))
    return parsed(folder / "r.html")


@pytest.fixture(scope="module")
def page(months: Path, tmp_path_factory: pytest.TempPathFactory) -> Page:
    out = tmp_path_factory.mktemp("page") / "report.html"
    write_period(out, read_period(months, None, None))
    assert out.stat().st_size < 1_000_000
    return parsed(out)


def test_the_figures_of_the_run_are_said(page: Page) -> None:
    said = page.words
    judged = WINDOWS - len(AWAY) - len(SKIPPED)
    for wanted in (
        f"{100 * judged / WINDOWS:.1f} %", "99.01 %", "Story 2 lost 8", "channel a3 was stuck",
        f"{len(SKIPPED)}", f"{len(AWAY)}", "acknowledge by ada", "story 2 is 8.0 % softer <than> before",
        "seen on site", "0.5 false announcements a year", "10 % is an alarm", "bridge-7 <b>&", "n1", "12",
    ):  # fmt: skip
        assert wanted in said, wanted
    assert not any(name.startswith(("#", "@")) for table in page.tables for name in table[0])


def test_the_range_learned_and_where_the_latest_value_lies_are_said(months: Path, tmp_path: Path) -> None:
    for name in ("results.jsonl", "summary.json"):
        (tmp_path / name).write_text((months / name).read_text())
    rows = [json.loads(raw) for raw in (tmp_path / "results.jsonl").read_text().splitlines()[-500:]]
    for row in rows:
        row["covariates"] = {"level": 4e-6 if row is rows[-1] else 1e-6, "temperature": 12.0, "wind": 3.0}
    json_lines(tmp_path / "results.jsonl", rows)
    learned = {
        "level": {"unit": "m", "low": 5e-7, "high": 2e-6},
        "temperature": {"unit": "degC", "low": -3.0, "high": 25.0},
    }
    summary = json.loads((months / "summary.json").read_text())
    (tmp_path / "summary.json").write_text(json.dumps({**summary, "covariates_learned": learned}))
    page = drawn(tmp_path)
    said = page.words
    assert "level m 5e-07 2e-06 1e-06 4e-06 4e-06 above it: stiffness is compared by extrapolation" in said
    assert "temperature degC -3 25 12 12 12 within it" in said
    assert "wind – – 3 3 3 not learned" in said.replace("wind  ", "wind ")
    assert page.chart("level, m")["marks"]


def test_curves_are_light_and_drawn_where_the_values_are(page: Page) -> None:
    """Every curve at most 2000 points, inside its frame, in the right place, broken where nothing was seen."""
    assert len(page.charts) == 9, "three stories, three modes, temperature, windows, goodness of fit"
    for chart in page.charts.values():
        for mark in marks(chart, "line"):
            for key in {"y", "low", "high"} & mark.keys():
                xy = np.column_stack([mark["x"], numbers(mark[key])])
                assert len(xy) <= 1000
                inside = (xy >= [chart["x"][0], chart["y"][0]]) & (xy <= [chart["x"][1], chart["y"][1]])
                assert np.all(inside | np.isnan(xy))
    lost = page.chart("story 2: stiffness lost")
    (line,) = marks(lost, "line", "after")
    y = numbers(line["y"])
    assert np.isnan(y).sum() == 2, "broken where the channel was stuck and where the monitor was away"
    high = np.array(line["x"])[y > 7.0]
    assert abs(high.min() - ALARM[0] / WINDOWS) < 0.002
    assert abs(high.max() - ALARM[-1] / WINDOWS) < 0.002
    assert len(marks(lost, "shade", "still")) == 1
    assert not marks(page.chart("story 1"), "shade")
    assert marks(lost, "line", "before dashed")[0]["y"] == [0.0, 0.0], "the baseline"
    assert marks(lost, "line", "limit dashed")[0]["y"] == [10.0, 10.0], "of an alarm"


def test_recordings_a_month_apart_share_the_chart_and_the_gap_is_shortened(tmp_path: Path, page: Page) -> None:
    """Forty windows, thirty days without, sixty windows: each stretch has its share of the width."""
    month = 30 * 144
    json_lines(tmp_path / "results.jsonl", [line_of(k) for k in (*range(40), *range(month, month + 60))])
    period = read_period(tmp_path, None, None)
    write_period(tmp_path / "r.html", period)
    short = parsed(tmp_path / "r.html")
    chart = short.chart("mode 1: frequency")
    (line,), (cut,) = marks(chart, "line", "after"), marks(chart, "shade", "cut")
    x, broken = np.array(line["x"]), np.flatnonzero(np.isnan(numbers(line["y"])))
    first, second = x[: broken[0]], x[broken[0] + 1 :]
    assert first.size >= 40
    assert second.size >= 60
    assert first[-1] < cut["x"][0] < cut["x"][1] < second[0]
    assert np.ptp(first) == pytest.approx(0.38, abs=0.03)
    assert np.ptp(second) == pytest.approx(0.56, abs=0.03)
    assert [time for ends in chart["stretches"] for time in ends[:2]] == pytest.approx(
        [T0 * 1e-9 + 600 * k for k in (0, 40, month, month + 60)]
    )
    assert "which the charts shorten (2026-01-01 06:40:00 to 2026-01-31 00:00:00)" in short.words
    assert "shorten" not in page.words, "five days of ninety stay as they are"
    grid = period.results.grid
    for k in (0, 39, month, month + 59):
        t_ns = T0 + (k + 1) * HOP
        assert grid.edges_ns[grid.at(t_ns)] < t_ns <= grid.edges_ns[grid.at(t_ns) + 1]


def test_modes_are_three_curves_at_their_frequencies_with_the_baseline_s(months: Path, tmp_path: Path) -> None:
    for name in ("results.jsonl", "summary.json"):
        (tmp_path / name).write_text((months / name).read_text())
    summary = json.loads((months / "summary.json").read_text()) | {"baseline_frequencies_hz": {"1": 2.6, "3": 11.0}}
    (tmp_path / "summary.json").write_text(json.dumps(summary))
    page = drawn(tmp_path)
    for i, (f, known) in enumerate(((2.5, 2.6), (7.25, None), (11.5, 11.0)), 1):
        chart = page.chart(f"mode {i}: frequency")
        assert np.nanmean(numbers(marks(chart, "line", "after")[0]["y"])) == pytest.approx(f, rel=0.02)
        levels = [m["y"] for m in marks(chart, "line", "before dashed")]
        assert levels == ([] if known is None else [[known, known]])
        assert chart["y"][0] < (known or f) < chart["y"][1]


def test_modes_of_windows_that_are_not_judged_are_drawn_and_the_model_s_keep_their_numbers(tmp_path: Path) -> None:
    """A model of four modes without the third, and torsion at 6.68 Hz; no window has a damage index."""
    rows = []
    for k in range(8):
        other = {"frequency_hz": 6.68, "frequency_std_hz": 0.01, "damping_ratio": 0.01, "mode_shape": [], "track": -1}
        figures = {"frequencies_hz": [1.23, 4.02, 7.6], "frequencies_std_hz": [0.01] * 3, "model_modes": [1, 2, 4]}
        rows.append(
            {**line_of(SKIPPED[0]), "window": k, "t_end_ns": T0 + (k + 1) * HOP, **figures, "other_modes": [other]}
        )
    json_lines(tmp_path / "results.jsonl", rows)
    found = read_results(tmp_path, None, None, Known((), True, 0.1, 5.0))
    assert sum(found.judged) == 0 and sum(found.refused) == 8
    curves = [(c.mode, c.latest, c.values) for c in found.common_modes()]
    assert curves == [(1, 1.23, 8), (2, 4.02, 8), (None, 6.68, 8), (4, 7.6, 8)]


def test_every_chart_has_its_unit_and_its_times(page: Page) -> None:
    for key, chart in page.charts.items():
        assert chart["x_title"] == "time, UTC"
        assert [round(t) for t in chart["stretches"][0][:2]] == [T0 // 10**9, T0 // 10**9 + WINDOWS * 600]
        assert re.search(r", (%|Hz|degC|N/m)|Goodness of fit|Windows", page.titles[key])


def test_the_page_says_in_this_order_the_state_what_to_do_where_how_much_and_whether_it_can_be_trusted(
    tmp_path: Path,
) -> None:
    json_lines(tmp_path / "results.jsonl", [line_of(k) for k in range(9_900, 10_150)])
    known = {"names": ["deck", "pier <b>", "foot"], "has_baseline": True, "alarm_loss": 0.1, "misfit": 5.0}
    (tmp_path / "summary.json").write_text(json.dumps({"known": known, "contact": "Ada Bell, +44 20"}))
    page = drawn(tmp_path)
    began = str(np.datetime64(T0 + (ALARM[0] + 1) * HOP, "ns").astype("datetime64[s]")).replace("T", " ")
    order = ("warning", f"since {began} UTC", "Data:", "What to do:", "Have pier <b> inspected", "Ada Bell, +44 20",
             "ack SITE.toml --story 2", "Where, and how much", "Can it be trusted", "Stiffness lost since", "Alarms")  # fmt: skip
    places = [page.words.index(words) for words in order]
    assert places == sorted(places)
    rows = page.table("state")
    assert [row[0] for row in rows] == ["pier <b>", "deck", "foot"], "the affected story first"
    assert rows[0][1] == "warning" and "±" in rows[0][2]


def seen(folder: Path, detectable: list[float | None] | None, known: dict[str, object], **figures: object) -> Page:
    """The page of twenty healthy windows, each with these figures."""
    json_lines(folder / "results.jsonl", [{**line_of(k), "detectable_loss": detectable, **figures} for k in range(20)])
    site = {"names": ["pier", "deck", "story 3"], "has_baseline": True, "alarm_loss": 0.1, "misfit": 5.0, **known}
    (folder / "summary.json").write_text(json.dumps({"known": site, "thresholds": {"alarm_loss": 0.1}}))
    return drawn(folder)


def test_a_story_s_chart_says_its_name_and_from_which_loss_on_it_is_seen(tmp_path: Path) -> None:
    page = seen(tmp_path, [0.012, 0.3, None], {})
    stories = ("pier", "deck", "story 3")
    said = [
        "a loss above 1.2 % would be seen",
        "only a loss above 30 % would be seen",
        "NOT SEEN: the modes say next to nothing of it",
    ]
    for story, words, kind in zip(stories, said, ("", "unseen", "unseen"), strict=True):
        assert words in page.note(f"{story}: ") and [row[-1] for row in page.table("state") if row[0] == story] == [
            words
        ]
        key = next(key for key, title in page.titles.items() if title.startswith(f"{story}: "))
        assert next(given["class"] for tag, given in page.tags if given.get("data-chart") == key) == kind
    assert page.state == "not_judged"
    assert [row[1] for row in page.table("state")] == ["normal", "not judged", "not judged"]


def test_green_is_only_where_every_story_would_have_been_seen(tmp_path: Path) -> None:
    page = seen(tmp_path, [0.012, 0.02, 0.03], {})
    assert page.state == "normal"
    assert "No loss above 3 % in any story." in page.words


def test_without_a_baseline_nothing_reads_as_an_all_clear(tmp_path: Path) -> None:
    said = (page := seen(tmp_path, None, {"has_baseline": False})).words
    assert page.state == "not_judged"
    assert "Without a baseline none can be raised." in said and "Stiffness lost against the structure file" in said
    assert "since the baseline" not in said and "0 alarms" not in said and "None." not in said


def test_a_period_is_cut_out_and_reads_alike(months: Path, tmp_path: Path) -> None:
    period = read_period(months, T0 + 10 * DAY, T0 + 20 * DAY)
    assert (period.course.windows, period.results.due, period.course.losses, period.findings) == (1440, 1440, (), [])
    assert period.quality.table["gaps"] == 10
    assert np.isclose(period.quality.table["availability"], 0.990099, atol=1e-6)
    write_period(tmp_path / "r.html", period)
    said = parsed(tmp_path / "r.html").words
    assert said.index("not judged") < said.index("Stiffness lost since the baseline"), (
        "results that do not say what would have been seen"
    )
    assert "Alarms None." in said
    assert "not judged" in said and "not recorded in these results" in said, (
        "lines of a version that noted no smallest loss"
    )


def test_windows_are_due_from_the_run_s_first_on_and_ends_count_to_the_nanosecond(tmp_path: Path, main: Cli) -> None:
    json_lines(tmp_path / "results.jsonl", [line_of(k) for k in range(10)])
    early = read_period(tmp_path, T0 - 365 * DAY, None)
    assert (early.course.windows, early.results.due) == (10, 10)
    for end, windows in (("00:49:59.999999", 4), ("00:50:00.4", 5)):
        done = main("report", tmp_path, "--out", tmp_path / "r.html", "--to", f"2026-01-01T{end}", "--json")
        assert (json.loads(done.stdout)["windows"], done.returncode) == (windows, 0)


def test_the_time_between_the_recordings_of_a_replay_is_not_due_and_that_of_a_daemon_is(tmp_path: Path) -> None:
    """Ten windows of three hops in each of two recordings, thirty days apart; lines stand where a window holds some data."""
    month = 30 * 144
    away = {**line_of(SKIPPED[0]), "skipped": "gap in the data", "window_s": 1800.0}
    rows = [{**line_of(k), "window_s": 1800.0} for k in (*range(2, 12), *range(month + 2, month + 12))]
    rows += [{**away, "window": k, "t_end_ns": T0 + (k + 1) * HOP} for k in (12, 13, month, month + 1)]
    json_lines(tmp_path / "results.jsonl", sorted(rows, key=lambda row: row["t_end_ns"]))
    channel = {"rms_m_s2": 3.0, "spikes": 0, "stuck_s": 0.0, "clipped_samples": 0}
    lost_s, came_s = (month - 12) * 600.0 + 6.0, 2 * 12 * 600.0 - 6.0
    quality = {"availability": came_s / (came_s + lost_s), "gaps": 2, "lost_s": lost_s, "overlaps": 0}
    summary = {"quality": {**quality, "channels": {"a1": channel}}, "window_s": 1800.0}
    recorded = [{"file": "r", "t_begin_ns": T0 + k * HOP, "t_end_ns": T0 + (k + 12) * HOP} for k in (0, month)]
    for told, due, gaps in (({}, month + 10, 2), ({"recorded": recorded}, 20, 1)):
        (tmp_path / "summary.json").write_text(json.dumps(summary | told))
        period = read_period(tmp_path, None, None)
        assert (sum(period.results.judged), period.results.due) == (20, due)
        assert period.quality is not None and period.quality.table["gaps"] == gaps
        write_period(tmp_path / "r.html", period)
    assert period.quality.table["lost_s"] == pytest.approx(6.0)
    assert period.quality.table["availability"] == pytest.approx(came_s / (came_s + 6.0))
    said = parsed(tmp_path / "r.html").words
    assert "of 20 windows due" in said and "the time between recordings apart" in said
    assert "the monitor did not run" not in said
    assert "windows that say nothing" not in said, "the four lines that hold some of the time between are not counted"
    for start, end, due in ((None, T0 + 100 * HOP, 10), (T0 + 100 * HOP, None, 10), (T0 + 5 * HOP, T0 + 99 * HOP, 7)):
        assert read_period(tmp_path, start, end).results.due == due
    with pytest.raises(BadInputError, match="no window ends within the period"):
        read_period(tmp_path, T0 + 13 * HOP, T0 + 99 * HOP)


def test_months_take_little_memory(months: Path) -> None:
    """What is kept does not grow with the period: as many bins for ninety days as for nine."""
    sizes = [read_period(months, T0, T0 + d * DAY).results.grid.n for d in (9, 90)]
    assert sizes == [1000, 1000]


def test_damaged_and_unfinished_lines_are_left_out_and_told(tmp_path: Path, main: Cli) -> None:
    good = [json.dumps(line_of(k)) for k in range(5)]
    (tmp_path / "results.jsonl").write_text("\n".join([*good, '{"t_end_ns": 1767228600000000001, oops', good[0][:90]]))
    done = main("report", tmp_path, "--out", tmp_path / "r.html", "--json", "--to", "2026-01-02")
    assert (done.returncode, json.loads(done.stdout)["windows"]) == (0, 5)
    assert "unreadable lines left out: 1" in done.stderr
    assert "No record of the sensors" in parsed(tmp_path / "r.html").words


def test_a_replay_shows_no_column_that_it_does_not_know_and_says_what_helps(tmp_path: Path) -> None:
    gap = {**line_of(4), "skipped": "gap in the data"}
    json_lines(tmp_path / "results.jsonl", [*(line_of(k) for k in range(4)), gap])
    channel = {"rms_m_s2": 3.0, "spikes": 0, "stuck_s": 0.0, "clipped_samples": 0}
    quality = {"availability": 1.0, "gaps": 1, "lost_s": 0.2, "overlaps": 0, "channels": {"a1": channel}}
    (tmp_path / "summary.json").write_text(json.dumps({"quality": quality}))
    page = drawn(tmp_path)
    heads = [name for table in page.tables for name in table[0]]
    assert "spikes" in heads and not any("peak" in h or "noise" in h for h in heads)
    assert "a shorter [processing] window_s" in page.words


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("ledger.jsonl", "{}"),
        ("ledger.jsonl", '{"when": "yesterday", "who": "ann", "what": "x"}'),
        ("health.jsonl", '{"t_ns": 1}'),
        ("summary.json", '{"alarms": [{}]}'),
        ("summary.json", '{"thresholds": {"alarm_loss": []}}'),
        ("findings/1.json", '{"t_ns": "x"}'),
    ],
)
def test_a_file_of_another_s_beside_the_results_is_named(
    tmp_path: Path, main: Cli, months: Path, name: str, text: str
) -> None:
    (tmp_path / "findings").mkdir()
    with (months / "results.jsonl").open() as lines:
        (tmp_path / "results.jsonl").write_text("".join(next(lines) for _ in range(20)))
    (tmp_path / name).write_text(text + "\n")
    done = main("report", tmp_path, "--out", tmp_path / "r.html")
    assert done.returncode == 65 and name.partition("/")[0] in done.stderr, done.stderr
    assert not (tmp_path / "r.html").exists()


@pytest.mark.parametrize(
    ("more", "code", "says"),
    [
        (("--from", "2027-01-01"), 65, "2026-01-01"),
        (("--from", "yesterday"), 2, "2026-12-31"),
        (("--from", "2026-02-01", "--to", "2026-01-01"), 2, "--from"),
    ],
)
def test_a_wrong_period_is_refused(
    months: Path, tmp_path: Path, main: Cli, more: tuple[str, ...], code: int, says: str
) -> None:
    done: subprocess.CompletedProcess[str] = main("report", months, "--out", tmp_path / "r.html", *more)
    assert done.returncode == code
    assert says in done.stderr
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "r.html").exists()


def test_a_folder_without_results_is_66_and_an_input_is_never_overwritten(
    months: Path, tmp_path: Path, main: Cli
) -> None:
    assert main("report", tmp_path, "--out", tmp_path / "r.html").returncode == 66
    before = (months / "summary.json").read_bytes()
    assert main("report", months, "--out", months / "summary.json").returncode != 0
    assert (months / "summary.json").read_bytes() == before


@pytest.mark.parametrize("acknowledged_by", ["", "Ada"])
def test_an_event_s_alarm_stands_in_the_report_as_in_the_status(
    tmp_path: Path, main: Cli, acknowledged_by: str
) -> None:
    event, _, _ = event_pages.told()
    rows = [{**line_of(k), "t_end_ns": event.begin_ns + (k - 5) * HOP} for k in range(20)]
    json_lines(tmp_path / "results.jsonl", rows)
    (tmp_path / "events.jsonl").write_text(json.dumps(event_line(event)) + '\n{"id": "cut by a cra')
    condition = "normal" if acknowledged_by else "returned to normal, unacknowledged"
    alarm = {"id": event.id, "condition": condition, "exceeded": ["go <and> look: story 3"], "by": acknowledged_by}
    (tmp_path / "summary.json").write_text(json.dumps({"event_alarms": [alarm]}))
    done = main("report", tmp_path, "--out", tmp_path / "r.html", "--json")
    said, text = json.loads(done.stdout), parsed(tmp_path / "r.html").words
    assert said["alarms"] == said["events"] == 1
    assert (said["state"] == "alarm") is not bool(acknowledged_by)
    assert (f"vent {event.id} exceeded a limit" in said["headline"]) is not bool(acknowledged_by)
    assert event_text(event) in text and "go <and> look: story 3" in text
    assert (f"by {acknowledged_by}" if acknowledged_by else "nobody yet") in text
    before = str(np.datetime64(event.begin_ns - HOP, "ns").astype("datetime64[s]"))
    done = main("report", tmp_path, "--out", tmp_path / "r.html", "--json", "--to", f"{before}Z")
    assert json.loads(done.stdout)["alarms"] == 0 and json.loads(done.stdout)["state"] != "alarm"
    after = str(np.datetime64(event.begin_ns + 2 * HOP, "ns").astype("datetime64[s]"))
    done = main("report", tmp_path, "--out", tmp_path / "r.html", "--json", "--from", f"{after}Z")
    assert json.loads(done.stdout)["alarms"] == int(not acknowledged_by)  # it stands
