"""The Rerun view: what is published can be read back, and its troubles stay its own."""

from __future__ import annotations

import contextlib
import logging
import socket
import tempfile
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import rerun as rr
from rerun.chunk import RrdReader
from scipy.signal import welch

from drivers.base import ClockHealth
from monitor.config import Configuration, configuration
from monitor.core import Gap, Level, Samples, WindowResult, parse_address
from monitor.damage import Assessment, LearnedRange, State
from monitor.model import Building, Drawing, Model, ShearFrame, simulate
from monitor.publish.viewer import layout, picture, scene as rerun_scene
from monitor.publish.viewer.mode_shapes import expand_shape
from monitor.publish.viewer.output import Output
from monitor.publish.viewer.publisher import RerunPublisher
from monitor.publish.viewer.scene import Scene, loss_colour, make_scene
from monitor.publish.viewer.spectra import predict_power
from monitor.publish.viewer.state import LAMP, StateDrawing, state_markdown
from monitor.publish.viewer.thinning import FULL_RATE_NS, FULL_RATE_WINDOWS, Thinning
from monitor.signals import Health, sensor_health
from tests.examples.beam import bridge
from tests.publish.event_pages import told as shaken_event
from tests.publish.viewer_results import SCENE, T0, window
from tests.support.results import damage_reading, modal_estimate
from tests.support.strangers import listening
from tests.support.waiting import until


def second(k: int, n: int = 100) -> Samples:
    return Samples(T0 + k * 10**9, 100.0, np.arange(3.0 * n).reshape(n, 3) + 1000 * k)


def read(file: Path) -> dict[str, dict[int, object]]:
    """For each entity its first column's value at each time; time 0 is static."""
    found: dict[str, dict[int, object]] = {}
    for chunk in RrdReader(file).stream():
        if chunk.entity_path.startswith("/__") or chunk.timeline_names == ["phase"]:
            continue
        batch = chunk.to_record_batch()
        names = [c for c in batch.schema.names if ":" in c]
        wanted = [c for c in names if c.endswith((":scalars", ":text", ":state", ":positions"))] or names
        assert chunk.is_static or chunk.timeline_names == ["time"], "only the data's own clock"
        times = [0] * len(batch) if chunk.is_static else batch["time"].cast("int64").to_pylist()
        if chunk.is_static:
            continue
        rows = found.setdefault(chunk.entity_path, {})
        rows.update(zip(times, batch[wanted[0]].to_pylist(), strict=True))
    return found


@contextlib.contextmanager
def viewed(file: Path, scene: Scene = SCENE) -> Iterator[RerunPublisher]:
    """A view to a file, all of which is drawn."""
    view = RerunPublisher(scene, file=file, serve=None, lossless=True)
    yield view
    view.close(60.0)
    assert view.failed is None


@pytest.fixture
def stuck(monkeypatch: pytest.MonkeyPatch) -> Iterator[threading.Event]:
    """A viewer that hangs until the event is set."""
    release = threading.Event()
    monkeypatch.setattr(picture.ResultDrawing, "draw", lambda self, item: release.wait(30))
    yield release
    release.set()


def test_a_file_holds_everything(tmp_path: Path) -> None:
    file = tmp_path / "live.rrd"
    view = RerunPublisher(SCENE, file=file, serve=None, lossless=True, queue_size=2)
    for k in range(12):
        view.samples(second(k, 37))  # neither whole seconds nor contiguous
    view.gap(Gap(T0 + 30 * 10**9, 2.0, "sequence jumped"))
    states = [State.NORMAL, State.NORMAL, State.ADVISORY, State.ALARM, State.ALARM, State.NORMAL]
    for k, state in enumerate(states):
        if k == 0 or state is not states[k - 1]:
            view.state(Assessment(state, f"Story 2 is {state}."))
        view.window(window(k), "")
    view.window(window(6, skipped="channel a3 was stuck"), "")
    assert not file.exists(), "named before it is complete"
    view.close(60.0)
    assert (view.failed, view.dropped) == (None, 0)
    assert [p.name for p in tmp_path.iterdir()] == ["live.rrd"]

    found = read(file)
    expected = {T0 + k * 10**9 + i * 10**7: [1000.0 * k + 3 * i + 1] for k in range(12) for i in range(37)}
    stream = found["/streams/a\\ 2"]
    assert np.isnan(stream.pop(T0 + 30 * 10**9)), "the gap breaks the line"
    assert stream == expected
    ends = [T0 + (400 + 10 * k) * 10**9 for k in range(7)]
    for entity in ("/ddi/story_2", "/stiffness/story_1", "/modes/frequency/1", "/modes/damping/3", "/status"):
        assert sorted(found[entity]) == ends, entity
    np.testing.assert_allclose(found["/ddi/story_2"][ends[0]], [8.0, 6.0, 10.0])
    std = 5.0 * 0.002  # four deviations of 0.001 in ln f
    np.testing.assert_allclose(found["/modes/frequency/1"][ends[0]], [5.0, 5 - 2 * std, 5 + 2 * std])
    np.testing.assert_allclose(found["/modes/damping/3"][ends[0]][0], 2.0)
    np.testing.assert_allclose(found["/modes/change/1"][ends[0]][0], 100 * (5.0 / 5.1 - 1.0))
    assert np.isnan(found["/modes/frequency/1"][ends[6]]).all(), "a mode that was found before, and now is not"
    assert not any(path.startswith("/modes/") and path.endswith("/2") for path in found), "a mode that was never found"
    assert np.isnan(found["/ddi/story_2"][ends[6]]).all(), "a skipped window leaves a hole"
    np.testing.assert_allclose(found["/stabilisation"][ends[0]], [[5, 10], [5, 20], [31, 20]])
    changes = [T0, ends[0], ends[2], ends[3], ends[5]]
    assert sorted(found["/state"]) == changes, "changes only"
    assert sorted(found["/events"]) == sorted([*changes[1:], ends[6], T0 + 30 * 10**9])
    assert found["/events"][ends[3]] == ["2026-03-01 10:07:10 UTC  ALARM: Story 2 is alarm."]
    assert "channel a3 was stuck" in found["/status"][ends[6]][0]
    assert "| 2 (left columns) | 8.0 ± 2.0 |" in found["/status"][ends[0]][0]
    assert {"/frame/stories", "/frame/modes", "/frame/modes/nodes", "/state/lamp"} <= set(found)
    assert len(RrdReader(file).blueprints()) >= 1


def told(file: Path) -> list[tuple[int, str, object]]:
    """Time, text and colour of the states in the order in which a reader of the file meets them."""
    texts, colours = [], {}
    for chunk in RrdReader(file).stream():
        if chunk.is_static or not chunk.entity_path.startswith("/state"):
            continue
        batch = chunk.to_record_batch()
        times = batch["time"].cast("int64").to_pylist()
        for name in batch.schema.names:
            if name.endswith("TextDocument:text"):
                texts += zip(times, (text[0] for text in batch[name].to_pylist() if text), strict=True)
            elif name.endswith("LineStrips2D:colors"):
                colours |= zip(times, batch[name].to_pylist(), strict=True)
    return [(t_ns, text, colours[t_ns]) for t_ns, text in texts]


def test_the_lamp_is_as_high_as_its_picture(tmp_path: Path) -> None:
    file = tmp_path / "live.rrd"
    with viewed(file) as view:
        view.samples(second(0))
    lamps = [c.to_record_batch() for c in RrdReader(file).stream() if c.entity_path == "/state/lamp"]
    radii = [r for batch in lamps for row in batch["LineStrips2D:radii"].to_pylist() for r in row]
    assert radii and {2.0 * r for r in radii} == {LAMP[1]}


def rgba(colour: tuple[int, int, int]) -> int:
    red, green, blue = colour
    return red << 24 | green << 16 | blue << 8 | 255


@pytest.mark.parametrize("state", State)
def test_each_state_is_shown_in_capitals_in_its_colour_with_headline_and_doubts(state: State, tmp_path: Path) -> None:
    file = tmp_path / "live.rrd"
    with viewed(file) as view:
        view.samples(second(0))
        view.state(Assessment(state, "The headline.", ("One doubt.", "Another.")))
        view.window(window(0), "")
    (begun, nothing, grey), (ended, text, colour) = told(file)
    assert (begun, grey) == (T0, [rgba(rerun_scene.GREY)])
    assert nothing.startswith("# NOT JUDGED\n") and "loading" in nothing
    assert (ended, text) == (
        window(0).t_end_ns,
        f"# {state.words.upper()}\n### The headline.\n\n- One doubt.\n- Another.",
    )
    green, red = [rgba(rerun_scene.GREEN)], [rgba(rerun_scene.RED)]
    assert ((colour == green), (colour == red)) == (state is State.NORMAL, state is State.ALARM)


def test_a_file_that_is_still_loading_shows_no_state_of_its_beginning(tmp_path: Path) -> None:
    """All that a reader meets before the last results says "not judged"."""
    file = tmp_path / "live.rrd"
    with viewed(file) as view:
        view.samples(second(0))
        for k in range(150):
            view.state(Assessment(State.NORMAL if k < 140 else State.ALARM, f"No loss above {1 + k} %."))
            view.window(window(k), "")
    order = [
        (chunk.entity_path, int(t))
        for chunk in RrdReader(file).stream()
        if not chunk.is_static and chunk.timeline_names == ["time"]
        for t in chunk.to_record_batch()["time"].cast("int64").to_pylist()
    ]
    state = [i for i, (path, t) in enumerate(order) if path == "/state" and t > T0]
    assert len(state) > 150 and min(state) > max(i for i, (path, _) in enumerate(order) if path == "/ddi/story_1")


def test_a_diagnosis_after_the_last_window_changes_the_state_that_is_shown(tmp_path: Path) -> None:
    file = tmp_path / "live.rrd"
    with viewed(file) as view:
        view.state(Assessment(State.ADVISORY, "Story 2 lost 3 %."))
        view.window(window(0), "")
        view.finding({"t_ns": T0, "verdict": "named", "says": "Channels a1 and a3 are swapped.", "reason": "misfit"})
        view.state(Assessment(State.DOUBTFUL, "Diagnosis 001: Channels a1 and a3 are swapped."))
    t_ns, text, _ = told(file)[-1]
    assert t_ns == window(0).t_end_ns and "# DOUBTFUL" in text and "swapped" in text
    assert "Cause named" in read(file)["/verdict"][T0][0]


@pytest.mark.parametrize(
    ("has_baseline", "detectable", "colours"),
    [
        (True, (0.02, 0.02, 0.02), "green amber green"),
        (True, (0.02, 0.02, np.inf), "green amber grey"),
        (True, None, "grey grey grey"),
        (False, None, "grey grey grey"),
    ],
)
def test_a_story_is_green_only_where_a_loss_would_have_been_seen(
    has_baseline: bool, detectable: tuple[float, ...] | None, colours: str, tmp_path: Path
) -> None:
    file = tmp_path / "live.rrd"
    with viewed(file, replace(SCENE, has_baseline=has_baseline)) as view:
        result = window(0)
        assert result.damage is not None
        damage = replace(result.damage, loss=np.array([0.0, 0.05, 0.0 if detectable == (0.02, 0.02, 0.02) else 0.4]))
        view.window(
            replace(result, damage=damage, detectable_loss=None if detectable is None else np.array(detectable)), ""
        )
    (chunk,) = [c for c in RrdReader(file).stream() if c.entity_path == "/frame/stories/labels"]
    batch = chunk.to_record_batch()
    ((*drawn,),) = batch[next(n for n in batch.schema.names if n.endswith(":colors"))].to_pylist()
    named = {"green": rerun_scene.GREEN, "amber": rerun_scene.AMBER, "grey": rerun_scene.GREY}
    assert drawn == [rgba(named[colour]) for colour in colours.split()]


def test_a_viewer_that_joins_late_sees_the_state_at_the_next_window() -> None:
    class Stream:
        def log(self, *args: object, **more: object) -> None: ...
        def send_columns(self, path: str, indexes: object, columns: object) -> None:
            sent.append(path)

    sent: list[str] = []
    drawing = StateDrawing(cast("rr.RecordingStream", Stream()), live=True)
    drawing.take(Assessment(State.ALARM, "Story 2 lost 12 %."))
    for k in range(3):
        drawing.draw(T0 + k)
        drawing.send()
    assert sent.count("/state/lamp") == 3
    drawing.take(Assessment(State.NOT_JUDGED, "No data since noon."))
    assert sent.count("/state/lamp") == 4, "at once: where the source is silent no window follows"


def test_the_block_size_does_not_matter(tmp_path: Path) -> None:
    streams = []
    whole = second(0, 2500)
    for n in (1, 700, 2500):
        view = RerunPublisher(SCENE, file=tmp_path / f"{n}.rrd", serve=None, lossless=True)
        buffer = np.empty((n, 3))
        for i in range(0, 2500, n):
            block = whole.values[i : i + n]
            buffer[: len(block)] = block
            view.samples(Samples(T0 + i * 10**7, 100.0, buffer[: len(block)]))  # the caller's buffer is used again
        view.close(60.0)
        streams.append(read(tmp_path / f"{n}.rrd")["/streams/a1"])
    assert streams[0] == streams[1] == streams[2]
    assert len(streams[0]) == 2500


def test_a_hung_viewer_costs_drops_not_time(tmp_path: Path, stuck: threading.Event) -> None:
    view = RerunPublisher(SCENE, file=tmp_path / "live.rrd", serve=None, lossless=False, queue_size=4)
    began = time.monotonic()
    for k in range(50):
        view.window(window(k), "")
    assert time.monotonic() - began < 1.0
    assert 45 <= view.dropped <= 46  # four wait, and one may be in hand
    began = time.monotonic()
    view.close(0.3)
    assert time.monotonic() - began < 1.0
    assert view.failed == "not finished within 0.3 s"
    stuck.set()
    until(lambda: list(tmp_path.iterdir()) == [], "neither the name nor the partial file")


def test_lossless_waits_for_a_slow_viewer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[int] = []
    monkeypatch.setattr(picture.ResultDrawing, "draw", lambda self, item: (time.sleep(0.01), seen.append(item.index)))
    view = RerunPublisher(SCENE, file=tmp_path / "live.rrd", serve=None, lossless=True, queue_size=2)
    for k in range(40):
        view.window(window(k), "")
    view.close(30.0)
    assert (seen, view.dropped, view.failed) == (list(range(40)), 0, None)


@pytest.mark.parametrize("lossless", [True, False])
def test_a_failure_is_told_once_and_goes_no_further(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, lossless: bool
) -> None:
    file = tmp_path / "live.rrd"
    file.write_text("of an earlier run")

    def broken(self: object, item: object) -> None:
        raise ValueError("no such colour")

    monkeypatch.setattr(picture.ResultDrawing, "draw", broken)
    with caplog.at_level(logging.ERROR):
        view = RerunPublisher(SCENE, file=file, serve=None, lossless=lossless, queue_size=2)
        for k in range(50):
            view.window(window(k), "")
        view.close(30.0)
    assert view.failed == "ValueError: no such colour"
    assert len(caplog.records) == 1
    assert file.read_text() == "of an earlier run"
    assert [p.name for p in tmp_path.iterdir()] == ["live.rrd"]


def test_a_wrong_shape_is_a_failure_not_a_warning(tmp_path: Path) -> None:
    view = RerunPublisher(SCENE, file=tmp_path / "live.rrd", serve=None, lossless=True)
    view.samples(Samples(T0, 100.0, np.zeros((2000, 2))))  # three channels were promised
    view.close(30.0)
    assert view.failed is not None
    assert list(tmp_path.iterdir()) == []


def test_a_file_that_cannot_be_made(tmp_path: Path) -> None:
    view = RerunPublisher(SCENE, file=tmp_path / "nowhere" / "live.rrd", serve=None, lossless=True, queue_size=1)
    for k in range(5):
        view.window(window(k), "")
    view.close(30.0)
    assert view.failed is not None
    assert "No such file" in view.failed


def test_an_incomplete_file_never_takes_the_name(tmp_path: Path) -> None:
    output = Output("cut", tmp_path / "cut.rrd", None)
    output.stream.disconnect()
    part = tmp_path / "cut.rrd.part"
    part.write_bytes(part.read_bytes()[:-20])  # as on a full disk
    with pytest.raises(Exception, match=r"(?i)footer|rrd"):
        output.close(5.0)
    assert list(tmp_path.iterdir()) == []


def test_abort_leaves_nothing(tmp_path: Path) -> None:
    view = RerunPublisher(SCENE, file=tmp_path / "live.rrd", serve=None, lossless=True)
    view.window(window(0), "")
    view.abort()
    assert list(tmp_path.iterdir()) == []


def test_serves_over_ipv6_too() -> None:
    try:
        with socket.create_server(("::1", 0), family=socket.AF_INET6) as probe:
            port = probe.getsockname()[1]
    except OSError:
        pytest.skip("no IPv6 here")
    view = RerunPublisher(SCENE, file=None, serve=parse_address(f"[::1]:{port}"), lossless=False)
    view.window(window(0), "")

    def reached() -> bool:
        with contextlib.suppress(OSError), socket.create_connection(("::1", port), timeout=1.0):
            return True
        return False

    until(reached, "a connection", 20.0)
    view.close()
    assert not view.failed


@pytest.mark.skipif(not Path("/proc/net/tcp").exists(), reason="needs Linux's /proc/net/tcp")
def test_serves_only_where_told_and_stops() -> None:
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    view = RerunPublisher(SCENE, file=None, serve=("127.0.0.1", port), lossless=False)
    view.window(window(0), "")
    until(lambda: listening(port), "a server", 20.0)
    assert listening(port) == {"0100007F"}
    view.close(20.0)
    assert view.failed is None
    assert not listening(port)


def test_a_taken_port_is_a_failure() -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        view = RerunPublisher(SCENE, file=None, serve=("127.0.0.1", port), lossless=False)
        view.close(20.0)
    assert view.failed is not None
    assert f"127.0.0.1:{port}" in view.failed


def test_colours_of_a_story() -> None:
    assert loss_colour(0.0, 0.1) == loss_colour(-0.2, 0.1) == rerun_scene.GREEN
    assert loss_colour(0.05, 0.1) == rerun_scene.AMBER
    assert loss_colour(0.1, 0.1) == loss_colour(0.5, 0.1) == rerun_scene.RED
    assert loss_colour(None, 0.1) == rerun_scene.GREY


# --- can I trust it, what does it do now ---


FRAME = Model(ShearFrame(np.array([0.3253, 0.3514, 0.3129]), np.array([2909.45, 1514.85, 1897.7]), 0.01))


def test_sensors_clocks_and_verdicts_are_shown(tmp_path: Path) -> None:
    file = tmp_path / "live.rrd"
    with viewed(file) as view:
        channels = tuple(
            sensor_health.ChannelHealth(c, 0.0, 1.0 + i, 3.0, 0, 0.0, 0.25, 1e-4) for i, c in enumerate(SCENE.channels)
        )
        view.health(Health(T0, T0 + 10**10, 100.0, 990, 0.99, 1, 0.1, 0, channels))
        view.clocks(T0 + 10**10, [ClockHealth("node 7", 0.002, 12.0, 1.0, 0)])
        view.finding({"t_ns": T0 + 10**10, "verdict": "ambiguous", "says": "story 1 or 2", "reason": "warning",
                      "separating_measurement": "push each"})  # fmt: skip
        view.window(window(0), "")
    found = read(file)
    at = T0 + 10**10
    assert found["/quality/availability"][at] == [99.0]
    assert found["/quality/rms/a\\ 2"][at] == [2.0]
    assert found["/quality/clipped/a1"][at] == [25.0]
    assert found["/clock/node\\ 7"][at] == [2.0]
    text = found["/verdict"][at][0]
    assert all(words in text for words in ("ambiguous", "story 1 or 2", "push each"))
    assert found["/trust/misfit/line"][window(0).t_end_ns] == [1.5]


def test_an_event_stands_in_the_log_and_its_drifts_on_the_timeline(tmp_path: Path) -> None:
    event, _, _ = shaken_event()
    with viewed(tmp_path / "r.rrd") as view:
        view.event(event, "")
    content = read(tmp_path / "r.rrd")
    for j in range(3):
        assert content[f"/drift/story_{j + 1}"] == {event.end_ns: [pytest.approx(1e3 * event.drift_m[j])]}
    ((text,),) = [content["/events"][event.end_ns]]
    assert "strong motion (measured)" in text and event.id in text


def test_a_covariate_is_shown_beside_the_range_that_was_learned(tmp_path: Path) -> None:
    scene = replace(SCENE, learned={"level": LearnedRange("m", 1e-6, 3e-6)})
    with viewed(tmp_path / "live.rrd", scene) as view:
        storm = replace(window(0), covariates={"level": np.array([-100.0]), "wind": np.array([20.0])})
        view.window(storm, "")
    found = {path: at[storm.t_end_ns] for path, at in read(tmp_path / "live.rrd").items() if "covariate" in path}
    assert {path.rsplit("/", 1)[1]: value for path, value in found.items()} == {
        "value": [pytest.approx(1e-5)], "low": [1e-6], "high": [3e-6],
    }  # fmt: skip
    assert "/trust/covariate/level" in _origins(_tabs(scene)[1])


def test_the_models_spectrum_lies_on_a_simulated_one() -> None:
    """Same peaks, same relative size of the channels, within the scatter of forty segments."""
    scene = replace(SCENE, model=FRAME)
    motion = simulate(FRAME, duration_s=800.0, rate_hz=100.0, noise=0.0, seed=3)
    hz, power = welch(motion.floors, 100.0, nperseg=2000, axis=0)
    band = (hz > 2) & (hz < 30)
    quiet = replace(window(0), modes=None, stiffness=None)
    model = predict_power(scene, quiet, hz[band])
    ratio = np.log(power[band] / model)
    assert np.std(ratio.mean(axis=0)) < 0.1
    assert np.std(ratio) < 0.4
    softer = predict_power(
        scene,
        replace(
            quiet, stiffness=replace(window(0).stiffness, stiffness_n_per_m=FRAME.structure.stiffness_n_per_m * 0.81)
        ),
        hz[band],
    )
    peaks = [hz[band][spectrum[:, 0][hz[band] < 8].argmax()] for spectrum in (model, softer)]
    assert peaks[1] / peaks[0] == pytest.approx(0.9, abs=0.02)


def test_spectra_are_drawn_with_the_models(tmp_path: Path) -> None:
    file = tmp_path / "live.rrd"
    with viewed(file, replace(SCENE, model=FRAME)) as view:
        rng = np.random.default_rng(0)
        for k in range(60):
            view.samples(Samples(T0 + k * 10**9, 100.0, rng.normal(size=(100, 3))))
        for k in range(8):
            view.window(replace(window(k), t_end_ns=T0 + (60 + 30 * k) * 10**9), "")
    chunks = [c for c in RrdReader(file).stream() if c.entity_path in ("/spectra/measured", "/spectra/model")]
    assert sum(c.num_rows for c in chunks) == 4, "both, twice in 210 s"


def test_before_a_diagnosis_the_view_says_that_there_was_none(tmp_path: Path) -> None:
    with viewed(tmp_path / "live.rrd") as view:
        view.window(window(0), "")
        view.window(window(1), "")
    verdicts = read(tmp_path / "live.rrd")["/verdict"]
    assert list(verdicts) == [window(0).t_end_ns], "nothing before the data begin"
    assert "No diagnosis" in verdicts[window(0).t_end_ns][0]


def test_mode_shapes_move_on_a_timeline_of_their_own(tmp_path: Path) -> None:
    file = tmp_path / "live.rrd"
    with viewed(file) as view:
        view.window(window(0), "")
    moving = [
        c for c in RrdReader(file).stream() if c.timeline_names == ["phase"] and c.entity_path == "/frame/modes/nodes"
    ]
    column = next(n for n in moving[0].to_record_batch().schema.names if n.endswith(":positions"))
    steps = np.array([p for c in moving for p in c.to_record_batch()[column].to_pylist()])
    assert len(steps) == 24
    top = steps[:, 0, 0]
    still = SCENE.plan.offset(0)[0]
    np.testing.assert_allclose(top - still, 0.15 * np.cos(2 * np.pi * np.arange(24) / 24), atol=1e-5)


def test_a_long_history_grows_slowly_and_keeps_what_matters() -> None:
    thin = Thinning()
    quiet, loud = window(0), window(0, Level.ALARM)
    results = (
        replace(loud if k == 77_777 else quiet, index=k, t_end_ns=quiet.t_end_ns + k * 10**10) for k in range(100_000)
    )
    kept = [result.index for result in results if thin.window(result)]
    assert kept[:FULL_RATE_WINDOWS] == list(range(FULL_RATE_WINDOWS))
    assert {77_777, 77_778} <= set(kept)
    assert len(kept) < 8 * FULL_RATE_WINDOWS
    values = np.random.default_rng(1).normal(size=(1000, 2))
    t_ns = T0 + np.arange(1000) * 10**7
    assert thin.samples(t_ns, values)[1] is values
    times, few = thin.samples(t_ns + FULL_RATE_NS, values)
    assert few.shape == (4, 2)
    assert np.all(np.diff(times) > 0)
    np.testing.assert_array_equal([few.min(axis=0), few.max(axis=0)], [values.min(axis=0), values.max(axis=0)])


# --- any structure is drawn ---


def chunk_rows(file: Path, path: str, component: str) -> list[np.ndarray]:
    """Rows of a component of an entity on the timeline ``time``."""
    out = []
    for c in RrdReader(file).stream():
        if c.entity_path == path and not c.is_static and c.timeline_names == ["time"]:
            batch = c.to_record_batch()
            names = [n for n in batch.schema.names if n.endswith(component)]
            out += [np.array(row) for name in names for row in batch[name].to_pylist()]
    return out


def bridge_scene() -> tuple[Scene, Configuration]:
    """A bridge of 30 m: 5 sensors, 12 degrees of freedom of which 7 are rotations, 6 elements."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "bridge.toml"
        bridge(file)
        config = configuration.load(file)
    return make_scene(config, None), config


def bridge_window(config: Configuration) -> WindowResult:
    """The first three modes as the five sensors show them, and no damage."""
    modes = config.model().modes()
    found = modal_estimate(modes.frequencies_hz[:3], modes.shapes[:5, :3].T, deviations=np.full((4, 3, 12), 0.001))
    return replace(window(0), modes=found, stiffness=None, damage=damage_reading(np.zeros(6), 1e-4 * np.eye(6)))


def test_a_bridge_is_drawn_as_a_bridge_and_its_rotations_are_no_sway(tmp_path: Path) -> None:
    scene, config = bridge_scene()
    assert scene.n_modes == 3, "those below the highest frequency, not as many as stiffnesses"
    file = tmp_path / "live.rrd"
    with viewed(file, scene) as view:
        view.window(bridge_window(config), "")
    (members,) = chunk_rows(file, "/frame/stories", ":strips")
    np.testing.assert_allclose(members[:, :, 0], [[i / 6, (i + 1) / 6] for i in range(6)], atol=1e-6)
    assert not members[:, :, 1:].any(), "flat, from bearing to bearing"
    (nodes,) = chunk_rows(file, "/frame/modes/nodes", ":positions")
    assert nodes.shape == (15, 3), "five moving nodes a mode"
    for k in range(3):
        shape = nodes[5 * k : 5 * k + 5] - scene.plan.points[1:6] - scene.plan.offset(k)
        sine = np.sin((k + 1) * np.pi * np.arange(1, 6) / 6)
        np.testing.assert_allclose(np.abs(shape[:, 2]), 0.15 * np.abs(sine) / np.abs(sine).max(), atol=1e-3)
        np.testing.assert_allclose(shape[:, :2], 0.0, atol=1e-6)


def test_a_degree_of_freedom_without_sensor_moves_as_the_model_says() -> None:
    modes = bridge_scene()[1].model().modes()
    for k in range(3):
        full = modes.shapes[:, k]
        seen = np.array([0, 2, 3])
        np.testing.assert_allclose(
            expand_shape(-3.0 * full[seen] + 0j, full, np.eye(full.size)[seen]), -3.0 * full, rtol=1e-9
        )


def test_without_nodes_matrices_are_a_list_of_their_stiffnesses(tmp_path: Path) -> None:
    scene, config = bridge_scene()
    listed = replace(scene, drawing=config.structure.drawing())
    file = tmp_path / "live.rrd"
    with viewed(file, listed) as view:
        view.window(bridge_window(config), "")
    (bars,) = chunk_rows(file, "/frame/stories", ":strips")
    assert np.all(np.diff(bars[:, 0, 2]) < 0) and np.ptp(bars[:, 0, 0]) == 0, "one below the other"
    assert not chunk_rows(file, "/frame/modes/nodes", ":positions"), "no motion of a form that nobody knows"


def building_scene(n: int) -> Scene:
    """A building of `n` storeys with a sensor for each degree of freedom."""
    stiffness, plan = np.full(3 * n, 2000.0), np.tile([20.0, 12.0], (n, 1))
    tower = Building(np.full(n, 1e5), stiffness, 0.01, plan, np.zeros((n, 2)))
    names = [f"storey {j} (here), {way}" for way in ("along x", "along y", "in torsion") for j in range(1, n + 1)]
    drawing = Drawing.of_building(tower, np.full(n, 3.5))
    channels = tuple(f"c{i}" for i in range(3 * n))
    return replace(
        SCENE, channels=channels, sensors=np.eye(3 * n), drawing=drawing, story_names=tuple(names), n_modes=5
    )


@pytest.mark.parametrize("n", [3, 12, 30])
def test_a_building_has_an_elevation_for_each_direction_whose_labels_lie_apart(n: int, tmp_path: Path) -> None:
    scene, ddi, seen = building_scene(n), np.zeros(3 * n), np.full(3 * n, 0.02)
    ddi[n + 1], seen[-1] = 0.2, 1.0  # storey 2 along y; of the uppermost storey's torsion nothing is known
    damage = damage_reading(ddi, np.eye(3 * n) * 0.004**2)
    file = tmp_path / "live.rrd"
    with viewed(file, scene) as view:
        view.window(replace(window(0), modes=None, stiffness=None, damage=damage, detectable_loss=seen), "")
    places = chunk_rows(file, "/frame/stories/labels", ":positions")[0]
    batches = {c.entity_path: c.to_record_batch() for c in RrdReader(file).stream()}
    labels, heads = (
        batches[f"/frame/{path}"]["Points3D:labels"].to_pylist()[0] for path in ("stories/labels", "nodes")
    )
    assert (labels[n + 1], labels[-1]) == ("20.0 ± 0.8 %", "" if n > 13 else "not seen")
    assert heads[:4] == ["along x", "along y", "in torsion", "storey 1"] and len(heads) <= 3 + 13
    told = [p for p, text in zip(places, labels, strict=True) if text]
    apart = np.abs(np.subtract.outer(*[np.array(told)[:, 2]] * 2)) + 9.0 * np.abs(
        np.subtract.outer(*[np.array(told)[:, 0]] * 2)
    )
    assert len(told) == (1 if n > 13 else 3 * n) and (apart + np.eye(len(told))).min() > 0.07
    assert all(places[j, 0] < places[n + j, 0] < places[2 * n + j, 0] < scene.plan.points[0, 0] for j in range(n))
    assert np.isnan(read(file)[f"/ddi/story_{3 * n}"][window(0).t_end_ns]).all(), "the prior alone is no curve"


def test_each_direction_of_a_building_has_its_curves_and_the_mode_shapes_a_view_of_their_own() -> None:
    scene = building_scene(4)
    plots = {name: paths for page in _tabs(scene) for name, paths in _contents(page)}
    assert plots["along y"] == [f"/drift/story_{j}" for j in range(5, 9)] + ["/drift/alarm_loss"]
    assert "- /frame/modes/**" in plots["Stiffness lost, %"]
    columns = np.array([scene.plan.offset(k) for k in range(5)])
    assert len({x for x, *_ in columns[:4].tolist()}) == 4 and columns[4, 2] < columns[0, 2]


def _contents(view: Any) -> list[tuple[str, list[str]]]:
    """Name and contents of all views below one."""
    parts = getattr(view, "contents", [])
    if isinstance(parts, str) or all(isinstance(part, str) for part in parts):
        return [(str(view.name), [parts] if isinstance(parts, str) else list(parts))]
    return [found for part in parts for found in _contents(part)]


@pytest.mark.parametrize("n", [1, 3, 8])
def test_every_mode_has_an_axis_of_its_own(n: int) -> None:
    origins = _origins(_tabs(replace(SCENE, n_modes=n))[0])
    assert [o for o in origins if o.startswith("/modes/frequency")] == [
        f"/modes/frequency/{i}" for i in range(1, n + 1)
    ]


def _tabs(scene: Scene) -> list[Any]:
    return list(layout.blueprint(scene, page=1).root_container.contents)


def _origins(view: object) -> list[str]:
    """Origins of all views below one."""
    found = [str(view.origin)] if getattr(view, "origin", None) else []
    return found + [o for part in getattr(view, "contents", []) if not isinstance(part, str) for o in _origins(part)]


@pytest.mark.parametrize("names", [(), SCENE.story_names])
def test_every_part_of_a_page_has_its_share_of_it(names: tuple[str, ...]) -> None:
    def containers(view: Any) -> list[Any]:
        parts = [part for part in getattr(view, "contents", []) if not isinstance(part, str)]
        return [view, *(c for part in parts for c in containers(part))] if parts else []

    pages = [c for page in _tabs(replace(SCENE, story_names=names)) for c in containers(page)]
    shared = [(c, shares) for c in pages for shares in (c.row_shares, c.column_shares) if shares]
    assert len(shared) >= 6 and [len(c.contents) for c, _ in shared] == [len(shares) for _, shares in shared]


def test_colours_do_not_repeat_within_a_dozen() -> None:
    assert len(set(rerun_scene.SERIES)) == len(rerun_scene.SERIES) == 12


def test_the_page_of_trust_says_the_state_and_whether_something_makes_it_doubtful() -> None:
    trust = _tabs(SCENE)[1]
    shown = trust.contents[0].contents[0].contents
    assert [view.origin for view in shown] == ["/state", "/verdict"]
    sure, doubtful = (Assessment(State.ALARM, "Story 2 lost 11 %.", doubts) for doubts in ((), ("A gap.",)))
    assert "Nothing makes this doubtful." in state_markdown(sure)
    assert state_markdown(doubtful).endswith("- A gap.")
    assert "Nothing makes" not in state_markdown(Assessment(State.NOT_JUDGED, "No baseline."))
