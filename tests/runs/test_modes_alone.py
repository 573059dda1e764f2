"""A structure without a model: its modes are learned, followed and compared, from the recording to the report."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from drivers.base import SampleBlock
from drivers.mcap_file import McapWriter
from monitor.config import Configuration, configuration
from monitor.core import BadConfigurationError, BadInputError, Level, Samples, WindowResult
from monitor.damage import ModalBaseline, load_baseline, load_modal_baseline, save_baseline
from monitor.model import simulate
from monitor.pipeline import Pipeline
from monitor.publish import facts_of_line, replay_text, to_json, window_line
from monitor.runs import load_healthy
from monitor.runs.baselines import modal_origin
from monitor.runs.calibrate import calibrate_modes
from tests.service.checkpoint import restored
from tests.support.samples import CHANNELS, FRAME, T0_NS, Cli, Cut

RATE_HZ, WINDOW_S = 128.0, 20
SENSORS = "".join(f'\n[[sensors]]\nchannel = "{name}"\n' for name in CHANNELS)
SITE = f"""
[structure]
kind = "modal"
{SENSORS}
[processing]
window_s = {WINDOW_S}
hop_s = 5.0

[identification]
block_rows = 10

[temperature]
patience_s = 0.0
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("modal")
    (path / "site.toml").write_text(SITE)
    (path / "frame.toml").write_text(FRAME)
    return path


@pytest.fixture(scope="module")
def site(folder: Path) -> Configuration:
    return configuration.load(folder / "site.toml")


def motion(folder: Path, seconds: int, seed: int, loss: tuple[float, ...] = (0.0, 0.0, 0.0)) -> np.ndarray:
    """Ambient motion of the frame, with losses of its stories, after five seconds of its beginning."""
    model = configuration.load(folder / "frame.toml").model()
    model = model.with_stiffness(model.structure.stiffness_n_per_m * (1.0 - np.array(loss)))
    return simulate(model, duration_s=seconds + 5.0, rate_hz=RATE_HZ, noise=0.03, seed=seed).floors[
        round(5 * RATE_HZ) :
    ]


def write(path: Path, blocks: list[SampleBlock]) -> Path:
    writer = McapWriter(path)
    for block in blocks:
        writer.write(block)
    writer.close()
    return path


@pytest.fixture(scope="module")
def healthy(folder: Path, site: Configuration, cut: Cut) -> ModalBaseline:
    """The modes of six windows, as read back from the file."""
    recording = write(folder / "healthy.mcap", cut(motion(folder, 6 * WINDOW_S, 1), RATE_HZ, [128]))
    save_baseline(calibrate_modes([recording], site), folder / "b.json")
    read = load_healthy(folder / "b.json", site)
    assert isinstance(read, ModalBaseline)
    return read


def windows(pipeline: Pipeline, blocks: list[SampleBlock]) -> list[WindowResult]:
    return [r for block in blocks for r in pipeline.push(block) if isinstance(r, WindowResult)]


def test_calibration_finds_the_modes_and_their_shapes_without_being_told_how_many(
    folder: Path, healthy: ModalBaseline
) -> None:
    modes = configuration.load(folder / "frame.toml").model().modes()
    assert np.abs(healthy.frequencies_hz / modes.frequencies_hz - 1.0).max() < 0.01
    assert (np.abs(healthy.frequencies_hz - modes.frequencies_hz) < 5.0 * healthy.frequencies_std_hz).all()
    true = (modes.shapes / modes.shapes[list(healthy.gauges), range(3)]).T
    assert np.abs(healthy.shapes - true).max() < 0.05
    assert [axis.name for axis in healthy.law.axes] == ["level"]


def test_a_lost_tenth_of_a_story_is_announced_by_modes_and_never_by_a_story(
    folder: Path, site: Configuration, healthy: ModalBaseline, cut: Cut
) -> None:
    pipeline = Pipeline(site, healthy)
    before = windows(pipeline, cut(motion(folder, 120, 2), RATE_HZ, [128]))
    assert {r.alarm.level for r in before} == {Level.NORMAL}
    after = windows(pipeline, cut(motion(folder, 240, 3, (0.0, 0.1, 0.0)), RATE_HZ, [128], first=round(120 * RATE_HZ)))
    assert after[-1].alarm.level.rank >= Level.WARNING.rank
    assert after[-1].alarm.stories == ()
    assert after[-1].alarm.reason.startswith("changed since the baseline: ")
    assert "story" not in after[-1].alarm.reason
    assert (after[-1].modal.ln_frequency < 0.0).all()
    line = json.loads(to_json(window_line(after[-1])))
    nothing = ("ddi", "ddi_std", "stiffness_n_per_m", "stiffness_std", "loss_n_per_m", "misfit")
    assert all(line[key] is None for key in nothing)
    assert line["alarm"]["stories"] == []
    assert line["alarm"]["changed"]
    told = facts_of_line(line)
    assert told.active == after[-1].alarm.active
    assert told.modal


def test_results_do_not_depend_on_the_size_of_blocks_nor_on_a_restart(
    folder: Path, site: Configuration, healthy: ModalBaseline, cut: Cut
) -> None:
    floors = motion(folder, 60, 4, (0.0, 0.3, 0.0))
    floors[2000:2100, 1] = np.nan  # a channel is left out of some windows
    whole = [to_json(window_line(r)) for r in windows(Pipeline(site, healthy), cut(floors, RATE_HZ, [7680]))]
    pieces = [to_json(window_line(r)) for r in windows(Pipeline(site, healthy), cut(floors, RATE_HZ, [1, 77, 500]))]
    assert len(whole) == 9
    assert pieces == whole
    first, blocks = Pipeline(site, healthy), cut(floors, RATE_HZ, [128])
    head = windows(first, blocks[:40])
    second = Pipeline(site, healthy)
    second.state = restored(first.state)
    assert [to_json(window_line(r)) for r in [*head, *windows(second, blocks[40:])]] == whole
    assert any(r.left_out and r.skipped is None for r in [*head, *windows(first, blocks[40:])])


def test_without_a_baseline_modes_are_shown_and_nothing_is_compared(
    folder: Path, site: Configuration, cut: Cut
) -> None:
    results = windows(Pipeline(site), cut(motion(folder, 25, 5), RATE_HZ, [128]))
    for result in results:
        assert result.skipped is None
        assert result.modes.model_mode.tolist() == [0, 1, 2]
        assert result.modal is None
        assert result.alarm.reason.startswith("no baseline")


@pytest.mark.engine
def test_a_change_with_temperature_is_taken_out_once_it_is_learned(folder: Path, site: Configuration, cut: Cut) -> None:
    """The frame softens by 0.4 % a kelvin, between 10 and 20 degC, and once learned, 20 degC is no change."""

    def blocks(degc: list[float], seed: int, begin_s: int = 0) -> list[SampleBlock]:
        out = []
        for k, t in enumerate(degc):
            loss = 0.004 * (t - 10.0)
            floors = motion(folder, 2 * WINDOW_S, seed + k, (loss, loss, 0.5 * loss))
            at = begin_s + 2 * WINDOW_S * k
            t_ns = T0_NS + at * 10**9
            out.append(
                SampleBlock("/temperature", t_ns, at, 1.0, ("t",), "degC", np.full((2 * WINDOW_S, 1), t, np.float32))
            )
            out += cut(floors, RATE_HZ, [128], first=round(at * RATE_HZ))
        return out

    recording = write(folder / "warm.mcap", blocks([10.0, 20.0] * 5, 100))
    learned = calibrate_modes([recording], site)
    over, _ = learned.law.over_range("temperature")
    assert (over < -0.02).all()
    blind = replace(learned, law=None, shape_law=None)
    warm = blocks([20.0] * 6, 200)
    compensated, raw = (windows(Pipeline(site, one), warm)[-1].modal for one in (learned, blind))
    assert np.abs(compensated.ln_frequency).max() < 0.5 * np.abs(raw.ln_frequency).max()
    assert {r.alarm.level for r in windows(Pipeline(site, learned), warm)} == {Level.NORMAL}
    assert "temperature" in compensated.covariate_effect


def test_motion_twice_as_strong_and_of_another_colour_is_no_change(
    folder: Path, site: Configuration, healthy: ModalBaseline, cut: Cut
) -> None:
    results = windows(Pipeline(site, healthy), cut(2.0 * motion(folder, 100, 6), RATE_HZ, [128]))
    assert {r.alarm.level for r in results} == {Level.NORMAL}


@pytest.mark.parametrize("dead", [0, 1, 2])
def test_a_dead_channel_leaves_the_level_of_motion_as_it_is(
    folder: Path, site: Configuration, healthy: ModalBaseline, cut: Cut, dead: int
) -> None:
    """A level read from fewer channels as if there were fewer modes is a storm or a calm that never was."""
    floors = motion(folder, 240, 8)
    lacking = floors.copy()
    lacking[:, dead] = np.nan
    whole, some = (windows(Pipeline(site, healthy), cut(x, RATE_HZ, [128])) for x in (floors, lacking))
    assert all([gone.channel for gone in r.left_out] == [CHANNELS[dead]] for r in some)
    level, of_some = (np.mean([r.covariates["level"][0] for r in results]) for results in (whole, some))
    assert abs(of_some - level) < 1.0


def test_a_baseline_with_a_damaged_motion_is_refused(folder: Path, site: Configuration, healthy: ModalBaseline) -> None:
    tree, path = json.loads((folder / "b.json").read_text()), folder / "other.json"
    assert np.shape(tree["motion"]) == (len(CHANNELS),) * 2
    path.write_text(json.dumps(tree | {"motion": [[1.0]]}))
    with pytest.raises(BadInputError, match="motion: 1 values along c, 3 are expected"):
        load_modal_baseline(path, CHANNELS, modal_origin(site))


@pytest.mark.engine
@pytest.mark.parametrize("dead", [0, 2])
def test_softening_by_motion_is_taken_out_with_a_dead_channel_too(
    folder: Path, site: Configuration, cut: Cut, dead: int
) -> None:
    """The frame softens by 6 % from half to twice the motion; once learned, neither is a change, with fewer channels either."""

    def blocks(factors: list[float], seed: int) -> list[SampleBlock]:
        out = []
        for k, factor in enumerate(factors):
            loss = 0.03 * (1.0 + np.log2(factor))
            floors = factor * motion(folder, 2 * WINDOW_S, seed + k, (loss,) * 3)
            out += cut(floors, RATE_HZ, [128], first=round(2 * WINDOW_S * k * RATE_HZ))
        return out

    learned = calibrate_modes([write(folder / "levels.mcap", blocks([0.5, 1.0, 2.0] * 5, 300))], site)
    for factor in (0.5, 2.0):
        now = blocks([factor] * 6, 400)
        for block in now:
            block.samples[:, dead] = np.nan
        results = windows(Pipeline(site, learned), now)
        assert {r.alarm.level for r in results} == {Level.NORMAL}
        left = np.array([r.modal.ln_frequency for r in results if r.modal is not None])
        assert len(left) == len(results)
        assert np.abs(left.mean(axis=0)).max() < 0.004


def test_strong_motion_is_an_event_with_peaks_and_without_drifts(
    folder: Path, site: Configuration, healthy: ModalBaseline, cut: Cut
) -> None:
    floors = motion(folder, 200, 7)
    floors[round(120 * RATE_HZ) : round(130 * RATE_HZ)] *= 30.0
    pipeline = Pipeline(site, healthy)
    told = [r for block in cut(floors, RATE_HZ, [128]) for r in pipeline.push(block) if not isinstance(r, Samples)]
    events = [r for r in told if getattr(r, "revision", None) == 0]
    assert len(events) == 1
    assert [f.channel for f in events[0].floors] == list(CHANNELS)
    assert all(f.peak_m_s2 > 0.0 for f in events[0].floors)
    assert events[0].drift_m.size == 0
    assert events[0].during_hz.size == 3
    assert "nothing is known of the structure but its channels" in events[0].note
    assert any(isinstance(r, WindowResult) and r.skipped is not None for r in told)


def test_a_baseline_of_another_kind_or_other_channels_is_refused(
    folder: Path, site: Configuration, healthy: ModalBaseline
) -> None:
    frame = configuration.load(folder / "frame.toml")
    with pytest.raises(BadConfigurationError, match="of modes alone"):
        load_baseline(folder / "b.json", frame.instrumented(), frame.updating)
    with pytest.raises(BadConfigurationError, match="its channels are a1, a2, a3"):
        load_modal_baseline(folder / "b.json", ("a1", "a2"), modal_origin(site))
    with pytest.raises(BadConfigurationError, match=r"rate_hz is 100\.0 there and 50\.0 here"):
        load_modal_baseline(folder / "b.json", CHANNELS, replace(modal_origin(site), rate_hz=50.0))
    tree = json.loads((folder / "b.json").read_text())
    (folder / "model.json").write_text(json.dumps({k: v for k, v in tree.items() if k != "kind"}))
    with pytest.raises(BadConfigurationError, match="with a model"):
        load_modal_baseline(folder / "model.json", CHANNELS, modal_origin(site))
    together = {"square": np.eye(3).tolist(), "windows": 9, "lowest": np.zeros((2, 5, 3)).tolist()}
    damages = (
        {"shapes": [[1.0]]},
        {"gauges": [9, 9, 9]},
        {"frequencies_hz": []},
        {"law": {"axes": []}},
        {"law": tree["law"] | {"common": together}},
    )
    for damage in damages:
        (folder / "damaged.json").write_text(json.dumps(tree | damage))
        with pytest.raises(BadInputError, match="not a baseline file"):
            load_modal_baseline(folder / "damaged.json", CHANNELS, modal_origin(site))


def test_what_needs_a_model_is_refused_in_the_file_and_by_the_commands(
    folder: Path, main: Cli, healthy: ModalBaseline
) -> None:
    (folder / "wrong.toml").write_text(
        SITE.replace('channel = "a1"', 'channel = "a1"\nfloor = 1')
        + '[alarm]\nunwatched = [1]\n\n[[inputs]]\nchannel = "f"\nfloor = 1\n'
    )
    refused = main("check", folder / "wrong.toml")
    assert refused.returncode == 78
    assert all(part in refused.stderr for part in ("sensors.0.floor", "inputs: 'f'", "alarm.unwatched"))
    recording = folder / "healthy.mcap"
    for command in (
        ("diagnose", recording, "--structure", folder / "site.toml", "--out", folder / "diagnosis"),
        ("evaluate", recording, "--structure", folder / "site.toml"),
        ("simulate", "--structure", folder / "site.toml", "--out", folder / "no.mcap"),
    ):
        said = main(*command)
        assert said.returncode == 78, command
        assert f'{folder / "site.toml"}: structure.kind: "modal" has no model' in said.stderr
        assert said.stderr.count("\n") <= 3


@pytest.mark.system
def test_the_commands_from_check_to_report(folder: Path, main: Cli, healthy: ModalBaseline, cut: Cut) -> None:
    floors = np.concatenate([motion(folder, 60, 8), motion(folder, 120, 9, (0.0, 0.0, 0.2))])
    write(folder / "run.mcap", cut(floors, RATE_HZ, [128]))

    def told(*arguments: object) -> dict:
        done = main(*arguments, "--json", cwd=folder)
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout)

    assert told("check", "site.toml")["channels"] == list(CHANNELS)
    calibrated = told("calibrate", "healthy.mcap", "--structure", "site.toml", "--out", "b2.json")
    assert len(calibrated["frequencies_hz"]) == 3
    summary = told("replay", "run.mcap", "--structure", "site.toml", "--baseline", "b2.json", "--out", "out")
    assert summary["state"] in {"warning", "alarm"}
    assert summary["headline"].startswith("Changed since the baseline: ")
    assert "story" not in summary["headline"]
    assert "diagnosis" not in replay_text(summary), "none is made without a model"
    assert all(a["story"] is None and a["ddi"] is None and a["change"] is not None for a in summary["alarms"])
    lines = [json.loads(line) for line in (folder / "out/results.jsonl").read_text().splitlines()]
    assert lines[0]["alarm"]["level"] == "normal"
    assert (folder / "out/live.rrd").stat().st_size > 0
    assert told("report", "out", "--out", "r.html")["windows"] == len(lines)
    page = (folder / "r.html").read_text()
    assert "Change of the modes" in page
    assert "story" not in page.replace("ack SITE.toml --story", ""), "but in the command, which numbers what is judged"
