"""The page of an event: all that the engineer signs is on it, by the line and the recording."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rerun.chunk import RrdReader

from drivers.mcap_file import recording_info
from monitor.core import BadInputError, MissingInputError, WrongUsageError
from monitor.events import Event, EventSettings
from monitor.publish import EventPage, Publisher, event_line, read_event, to_json
from monitor.runs import EventRecordings, Session, page_of, read_event_line, write_event_motion, write_event_page
from monitor.service import status
from tests.events.shaken import blocks, configuration
from tests.publish.event_pages import LIMITS, page, told
from tests.support.pages import marks
from tests.support.samples import Cli
from tests.support.short_quake import shaken


def test_the_page_has_the_verdict_the_limits_and_every_chart() -> None:
    event, site, seen = told()
    shown = page(event, site, seen)
    assert shown.state == "alarm" and "limit exceeded" in shown.head
    assert "EXCEEDED" in shown.words and "inspect <this> story" in shown.words
    assert "the interval holds it" in shown.words  # the lasting loss, which forty seconds tell to a few percent
    titles = (
        "a1: acceleration",
        "ground: acceleration",
        "story 3 from the top: drift",
        "story 3 from the top: force",
        "drift ratio",
        "First mode",
    )
    assert all(shown.chart(title)["marks"] for title in titles if title != "drift ratio")
    assert len(marks(shown.chart("Largest drift ratio"), "shade", "used")) == 3
    assert [m["x"][0] for m in marks(shown.chart("Largest drift ratio"), "line", "limit dashed")] == [0.05]
    assert all(words in shown.words for words in ("Pseudo-acceleration", "UNOFFICIAL", "date and signature"))
    assert "the revision after ambient motion tells it far more closely" in shown.words
    stories = [given.get("class") for tag, given in shown.tags if tag == "b"]
    assert stories.count("beyond") == int((event.drift_ratio > 0.0005).sum()) > 0


def test_the_curves_are_those_of_the_recording() -> None:
    event, site, seen = told()
    shown = page(event, site, seen)
    (line,), (strong,) = (marks(shown.chart("story 1 from the top: drift"), what) for what in ("line", "shade"))
    assert max(np.abs(line["y"])) == pytest.approx(1e3 * np.abs(seen.drift_m[:, 0]).max(), rel=1e-4)
    at = seen.t_s[[seen.record.strong.start, seen.record.strong.stop - 1]]
    assert strong["x"] == pytest.approx(at, abs=0.01)
    (loop,) = marks(shown.chart("story 3 from the top: force"), "line")
    assert max(loop["y"]) == pytest.approx(seen.force_n[seen.record.strong, 2].max(), rel=1e-3)


def test_the_motion_is_drawn_about_its_mean_at_rest_also_where_it_began_before_the_recording() -> None:
    event, site, seen = told()
    n = seen.record.strong.start
    begun = replace(
        seen.record, floors=seen.record.floors[n:] + 0.7, ground=None, strong=slice(0, seen.record.strong.stop - n)
    )
    cut = replace(seen, record=begun, t_s=seen.t_s[n:], drift_m=seen.drift_m[n:], force_n=None, first_mode=None)
    for record, shown in ((begun, page(replace(event, cut=True), site, cut)), (seen.record, page(event, site, seen))):
        (line,) = marks(shown.chart("a1: acceleration"), "line")
        after = np.array(line["y"])[np.array(line["x"]) > line["x"][0] + record.strong.stop / record.rate_hz]
        assert abs(after.mean()) < 0.02 * np.abs(record.floors[:, 0] - record.floors[-1, 0]).max()


def test_a_sensor_at_the_end_of_its_range_makes_bounds_of_what_the_page_shows() -> None:
    event, site, seen = told()
    says = "possibly exceeded: go"
    std = np.array([np.nan, *event.drift_std_m[1:]])
    bound = replace(event, saturated=("a1",), drift_std_m=std, verdict=says, exceeded=(f"{says} (story 1)",))
    settings = EventSettings.model_validate({"limits": [{"drift_ratio": 0.5, "says": "go"}]})
    html = page(bound, replace(site, settings=settings), seen).words
    assert all(words in html for words in ("limit possibly exceeded", "POSSIBLY EXCEEDED", "a1 (at least)"))
    assert f"drift at least {1e3 * bound.drift_m[0]:.3g} mm" in html
    told_in_status = [status.last_event(event_line(e)) for e in (bound, event)]
    assert ["at least" in text for text in told_in_status] == [True, False]


def test_an_event_that_the_data_cut_is_as_long_and_as_intense_at_least() -> None:
    event, site, seen = told()
    std, intensity = np.full(event.drift_std_m.size, np.nan), event.instrumental_intensity
    shown = page(replace(event, cut=True, drift_std_m=std, verdict=None, exceeded=()), site, seen)
    assert intensity is not None
    seconds = f"{(event.end_ns - event.begin_ns) * 1e-9:.0f} s"
    assert shown.headline.startswith(f"Strong motion of at least {seconds}. ")
    assert f"≥ {seconds}" in shown.words and f"≥ {intensity:.1f}" in shown.words
    assert page(event, site, seen).headline.startswith(f"Strong motion of {seconds}. ")


def test_a_revised_event_shows_its_lasting_loss_with_its_interval() -> None:
    event, site, seen = told()
    revised = replace(event, revision=1, loss=np.array([0.0, 0.1234, 0.0]), loss_std=np.full(3, 0.005))
    assert "12.3 ± 1.0" in page(revised, site, seen).words and "revised" in page(revised, site, seen).words


def test_a_drift_stands_with_two_standard_deviations_and_one_that_is_not_known_is_a_dash() -> None:
    event, site, seen = told()
    drifts = replace(event, drift_m=np.array([0.0123, np.nan, 0.0045]), drift_std_m=np.array([5e-4, np.nan, 2e-4]))
    html = page(replace(drifts, drift_m=np.array([0.01234, np.nan, 0.0045])), site, seen).words
    assert all(words in html for words in ("drift 12.3 mm", "drift not known", "drift 4.5 mm"))
    rows = page(drifts, site, seen).table("largest drift, mm")
    assert [row[1] for row in rows] == ["12.3 ± 1.0", "–", "4.50 ± 0.40"]


def test_without_recording_the_page_keeps_the_numbers_and_says_why_it_has_no_curves() -> None:
    event, _, _ = told()
    shown = page(event, None, None)
    assert "The samples are not kept." in shown.words and "a1: acceleration" not in shown.titles.values()
    assert f"{event.floors[0].peak_m_s2:.3g}" in shown.words
    assert "unknown" in [given.get("class") for tag, given in shown.tags if tag == "b"]


def test_nothing_known_is_told_as_not_known() -> None:
    event, site, _ = told()
    nan = np.full(3, np.nan)
    nothing = replace(
        event, drift_m=nan, drift_std_m=nan, drift_ratio=nan, exceeded=(), verdict=None, ground=None, spectrum=None
    )
    html = page(nothing, site, None).words
    assert "no limit judged" in html and "No drift is known." in html and "The ground was not measured." in html


def of_building(*, axes: int) -> Event:
    """An event of a building of two storeys that sways along x and y, or along one of them alone."""
    event, _, _ = told()
    drift, n = np.array([0.001, 0.002, 0.003, 0.004])[: 2 * axes], 6 if axes == 2 else 2
    loss = np.full(n, np.nan)
    corner = np.array([0.005, 0.006])
    lists = {"drift_m": drift, "drift_std_m": 0.1 * drift, "drift_ratio": drift / 3.0, "drift_corner_m": corner}
    return replace(event, exceeded=(), verdict=None, loss=loss, loss_std=loss, **lists)


def test_drifts_of_a_building_are_told_by_storey_and_direction_and_at_its_corners() -> None:
    event = of_building(axes=2)
    shown = page(event, None, None)
    assert "largest drift 4.00 ± 0.80 mm in storey 2, along y" in shown.headline
    elevation = shown.table("at a corner")
    assert elevation == [["storey 2", "2", "4", "6"], ["storey 1", "1", "3", "5"]], "the uppermost storey first"
    assert [row[0] for row in shown.table("largest drift, mm")][1:3] == ["storey 2, along x", "storey 1, along y"]
    bars = marks(shown.chart("Largest drift, mm, over the height in stories, along y"), "shade", "used")
    assert [(bar["x"][1], bar["y"]) for bar in bars] == [(3.0, [0.0, 1.0]), (4.0, [1.0, 2.0])]
    assert "in storey 2." in page(of_building(axes=1), None, None).headline


def test_the_motion_of_a_building_is_refused(tmp_path: Path) -> None:
    _, site, seen = told()
    with pytest.raises(MissingInputError, match="not drawn of a building"):
        write_event_motion(EventPage("house", of_building(axes=2), None, None, site, seen), tmp_path / "motion.rrd")


def test_an_event_is_read_from_its_line() -> None:
    event, _, _ = told()
    line = json.loads(to_json(event_line(event, "events/x.mcap")))
    assert event_line(read_event(line), "events/x.mcap") == line


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Event]:
    """A folder of results with one event, its line and its recording."""
    out = tmp_path_factory.mktemp("house")
    config = configuration(events={"limits": LIMITS, "post_s": 15.0, "merge_s": 5.0})
    session = Session(config, None, (), None, out / "findings", recordings=EventRecordings(out, config.events))
    events = [r for b in blocks(shaken()) for r in session.push(b) if isinstance(r, Event) and r.revision == 0]
    (event,) = events
    (out / "events.jsonl").write_text(to_json(event_line(event, f"events/{event.id}.mcap")) + "\n{cut")
    return out, event


def test_the_page_is_made_of_the_folder_alone(folder: tuple[Path, Event]) -> None:
    out, event = folder
    for wanted in (event.id, "last"):
        place = page_of(out, wanted)
        assert write_event_page(out, read_event_line(out, wanted), place).id == event.id
        html = place.read_text()
        assert (
            "story 3 from the top: force" in html
            and "inspect &lt;this&gt; story" in html
            and "0 s before the event" not in html
        )


def test_the_page_is_titled_by_the_structure_not_by_the_folder(tmp_path: Path) -> None:
    config = configuration(events={"post_s": 15.0, "merge_s": 5.0})
    named = config.model_copy(update={"site": config.site.model_copy(update={"name": "town hall"})})
    for name, wanted in ((named, "town hall"), (config, config.structure.name or "plain")):
        out = tmp_path / wanted.replace("town hall", "a-folder") / "plain"
        recordings = EventRecordings(out, name.events)
        (out / "events").mkdir(parents=True)
        session = Session(name, None, (), None, out / "findings", recordings=recordings)
        events = [r for b in blocks(shaken()) for r in session.push(b) if isinstance(r, Event) and r.revision == 0]
        (out / "events.jsonl").write_text(to_json(event_line(events[0], f"events/{events[0].id}.mcap")) + "\n")
        write_event_page(out, read_event_line(out, "last"), out / "page.html")
        assert f"<title>{wanted}: event" in (out / "page.html").read_text()


def test_the_command_writes_the_page_beside_the_recording(folder: tuple[Path, Event], main: Cli) -> None:
    out, event = folder
    done = main("report", out, "--event", "last", "--json")
    assert done.returncode == 0, done.stderr
    told_of = json.loads(done.stdout)
    assert (told_of["id"], told_of["verdict"]) == (event.id, "inspect <this> story")
    assert Path(told_of["report"]) == page_of(out, event.id) and page_of(out, event.id).exists()
    wrong = main("report", out, "--event", "yesterday")
    assert (wrong.returncode, event.id in wrong.stderr, "Traceback" in wrong.stderr) == (2, True, False)


def test_the_recording_reaches_from_before_the_event_to_after_it(folder: tuple[Path, Event]) -> None:
    out, event = folder
    info = recording_info(out / "events" / f"{event.id}.mcap")
    assert info.t_start_ns <= event.begin_ns - 29 * 10**9
    assert info.t_start_ns + info.duration_s * 1e9 >= event.end_ns + 14 * 10**9


def test_an_unknown_event_is_told_with_those_that_there_are(folder: tuple[Path, Event], tmp_path: Path) -> None:
    out, event = folder
    with pytest.raises(WrongUsageError, match=event.id):
        read_event_line(out, "yesterday")
    with pytest.raises(MissingInputError, match=r"events\.jsonl"):
        read_event_line(tmp_path, "last")
    (tmp_path / "events.jsonl").write_text("")
    with pytest.raises(MissingInputError, match="no event"):
        read_event_line(tmp_path, "last")


def test_a_damaged_recording_is_named_and_a_missing_one_told(folder: tuple[Path, Event], tmp_path: Path) -> None:
    out, event = folder
    line = read_event_line(out, "last")
    write_event_page(tmp_path, line, tmp_path / "x.html")
    assert "is not there" in (tmp_path / "x.html").read_text()
    (tmp_path / "events").mkdir()
    (tmp_path / "events" / f"{event.id}.mcap").write_bytes(b"\x89MCAP0\r\n" + b"nonsense" * 9)
    with pytest.raises(BadInputError, match=event.id):
        write_event_page(tmp_path, line, tmp_path / "y.html")
    assert not (tmp_path / "y.html").exists()


def test_where_the_budget_is_full_the_line_and_peaks_are_kept_and_it_is_told(tmp_path: Path) -> None:
    config = configuration(events={"post_s": 15.0, "merge_s": 5.0, "keep_gb": 1e-9})
    (tmp_path / "events").mkdir()
    (tmp_path / "events" / "earlier.mcap").write_bytes(b"0123")
    got = list[tuple[Event, str]]()

    class Kept(Publisher):
        def event(self, event: Event, line: str) -> None:
            got.append((event, line))

    recordings = EventRecordings(tmp_path, config.events)
    session = Session(config, None, (Kept(),), None, tmp_path / "findings", recordings=recordings)
    for block in blocks(shaken()):
        session.push(block)
    line = json.loads(got[-1][1])
    assert line["revision"] == 0 and line["recording"] is None and "keep_gb is full" in line["note"]
    assert min(line["peak_acceleration_m_s2"].values()) > 0.5 and len(list((tmp_path / "events").iterdir())) == 1


def test_the_motion_is_drawn_in_time_with_the_drifts(tmp_path: Path) -> None:
    event, site, seen = told()
    file = tmp_path / "motion.rrd"
    write_event_motion(EventPage("house", event, "events/x.mcap", "ab" * 32, site, seen), file)
    strips, times, drawn = list[np.ndarray](), list[int](), list[float]()
    for chunk in RrdReader(file).stream():
        batch = chunk.to_record_batch()
        columns = dict(zip(batch.schema.names, batch.columns, strict=True))
        if chunk.entity_path == "/frame/moving":
            times += columns["event"].cast("int64").to_pylist()
            strips += [np.array(row) for row in columns["LineStrips3D:strips"].to_pylist()]
        elif chunk.entity_path == r"/drift/story\ 1\ from\ the\ top" and "event" in columns:
            drawn += [row[0] for row in columns["Scalars:scalars"].to_pylist()]
    shown = np.isin(np.round(seen.t_s * 1e9).astype(np.int64), times)
    assert shown.sum() == len(times) > 100
    np.testing.assert_allclose(drawn, 1e3 * seen.drift_m[shown, 0])
    # The first column's top moves by the sum of all drifts, the largest of all floors' by 0.15 of the height.
    top = np.array([points[0, 0, 0] for points in strips])
    moved, of_floors = seen.drift_m[shown].sum(axis=1), np.cumsum(seen.drift_m[shown][:, ::-1], axis=1)
    np.testing.assert_allclose(top, 0.15 * moved / np.abs(of_floors).max(), atol=1e-6)


def test_motion_is_asked_for_of_an_event_that_has_samples(
    folder: tuple[Path, Event], main: Cli, tmp_path: Path
) -> None:
    out, _ = folder
    file = tmp_path / "motion.rrd"
    done = main("report", out, "--event", "last", "--motion", file, "--json")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["motion"] == str(file) and file.exists()
    (tmp_path / "events.jsonl").write_text((out / "events.jsonl").read_text())
    (tmp_path / "results.jsonl").touch()
    arguments = (
        ("report", tmp_path, "--event", "last", "--motion", tmp_path / "none.rrd"),
        ("report", out, "--motion", file),
    )
    for command, code, says in zip(arguments, (66, 2), ("is not there", "--event"), strict=True):
        wrong = main(*command)
        assert (wrong.returncode, says in wrong.stderr, "Traceback" in wrong.stderr) == (code, True, False), (
            wrong.stderr
        )
    assert not (tmp_path / "none.rrd").exists()
