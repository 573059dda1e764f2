"""Channels of another quantity or axis change no number of a replay, a calibration or a diagnosis."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from drivers.base import ACCELERATION, GROUND, ROTATION_RATE, SampleBlock
from drivers.mcap_file import McapWriter, read_recordings
from monitor.config import configuration
from monitor.core import BadConfigurationError
from monitor.model import ShearFrame, parse_effect
from tests.support.samples import T0_NS, Cli

FRAME = """
[structure]
kind = "shear_frame"
masses_kg = [0.3, 0.3]
stiffness_n_per_m = [1500.0, 1500.0]
masses_range_kg = [[0.299, 0.301], [0.299, 0.301]]
stiffness_range_n_per_m = [[1450, 1550], [1450, 1550]]
story_heights_m = [0.1, 0.1]

[[sensors]]
channel = "a1"
floor = 1

[[sensors]]
channel = "a2"
floor = 2
"""
WITNESSES = """
[[sensors]]
channel = "across"
floor = 1
axis = "y"

[[sensors]]
channel = "r1"
floor = 1
quantity = "rotation_rate"
axis = "y"

[[sensors]]
channel = "rg"
floor = 0
quantity = "rotation_rate"
axis = "y"
"""
PROCESSING = """
[processing]
window_s = 20.0
hop_s = 10.0

[identification]
block_rows = 10
"""


class Sites:
    """One recording of two floors, and the same with witnesses; a site of each."""

    def __init__(self, folder: Path, main: Cli) -> None:
        self.main, self.folder = main, folder
        self.plain, self.more = folder / "plain.toml", folder / "more.toml"
        self.plain.write_text(FRAME + PROCESSING)
        self.more.write_text(FRAME.replace("\n[[sensors]]", WITNESSES + "\n[[sensors]]", 1) + PROCESSING)
        self.bare, self.full = folder / "plain.mcap", folder / "more.mcap"
        done = main("simulate", "--structure", self.plain, "--out", self.bare, "--duration", 90, "--rate", 100)
        assert done.returncode == 0, done.stderr
        rng = np.random.default_rng(1)
        with McapWriter(self.full) as writer:
            for block in read_recordings([self.bare]):
                noise = 10.0 * rng.standard_normal((block.n_samples, 3)).astype(np.float32)
                # Not only behind the others: between them.
                samples = np.column_stack([block.samples[:, 0], noise[:, 0], block.samples[:, 1]])
                writer.write(replace(block, channels=("a1", "across", "a2"), samples=samples))
                turn = noise[:, 1:]
                writer.write(replace(block, topic=ROTATION_RATE, channels=("rg", "r1"), unit="rad/s", samples=turn))

    def both(self, command: str, *more: object, out: str) -> tuple[Path, Path]:
        """Run a command on both sites, and return where each wrote."""
        outs = self.folder / f"plain-{out}", self.folder / f"more-{out}"
        pairs = ((self.bare, self.plain), (self.full, self.more))
        for (recording, structure), place in zip(pairs, outs, strict=True):
            done = self.main(command, recording, "--structure", structure, "--out", place, *more)
            assert done.returncode == 0, done.stderr
        return outs


@pytest.fixture(scope="module")
def sites(tmp_path_factory: pytest.TempPathFactory, main: Cli) -> Sites:
    return Sites(tmp_path_factory.mktemp("witness"), main)


def test_a_replay_gives_the_same_bytes(sites: Sites) -> None:
    bare, full = sites.both("replay", out="replay")
    lines = (bare / "results.jsonl").read_bytes()
    assert lines.count(b"\n") == 8 and b'"skipped": null' in lines
    assert lines == (full / "results.jsonl").read_bytes()


@pytest.mark.parametrize("fault", [0.0, np.nan])
@pytest.mark.parametrize("in_file", [False, True])
def test_channels_that_enter_no_estimate_are_told_and_one_that_dies_is_told_by_name(
    sites: Sites, tmp_path: Path, in_file: bool, fault: float
) -> None:
    """Also where the structure file does not know the channel."""
    recording = tmp_path / "dead.mcap"
    with McapWriter(recording) as writer:
        for block in read_recordings([sites.full]):
            samples = block.samples.copy()
            if block.topic == ACCELERATION:
                samples[block.t_ns - T0_NS + np.arange(len(samples)) * 10_000_000 > 40 * 10**9, 1] = fault
            writer.write(replace(block, samples=samples))
    structure = sites.more if in_file else sites.plain
    told = []
    for source in (sites.full, recording):
        done = sites.main("replay", source, "--structure", structure, "--out", tmp_path / "out")
        assert done.returncode == 0, done.stderr
        summary = json.loads((tmp_path / "out" / "summary.json").read_text())
        assert set(summary["quality"]["channels"]) == {"a1", "a2", "across"}
        told.append(" ".join([summary["headline"], *summary["doubts"]]))
    aside = 3 if in_file else 1
    assert all(f"udged along x only: {aside} of {aside + 2} channels enter no estimate" in text for text in told)
    wrong = "is stuck" if fault == 0.0 else "gives no numbers"
    assert [f"hannel across, which enters no estimate, {wrong}" in text for text in told] == [False, True]
    assert (tmp_path / "out" / "results.jsonl").read_bytes() == (
        sites.folder / "plain-replay" / "results.jsonl"
    ).read_bytes()


@pytest.mark.engine
def test_a_calibration_gives_the_same_baseline(sites: Sites) -> None:
    contents = [json.loads(path.read_text()) for path in sites.both("calibrate", out="baseline.json")]
    for content in contents:
        del content["recordings"]  # their names and checksums
    assert contents[0] == contents[1]


@pytest.mark.engine
def test_a_diagnosis_gives_the_same_numbers_and_compares_the_witnesses(sites: Sites) -> None:
    outs = sites.both("diagnose", out="diagnose")
    bare, full = (json.loads((out / "diagnosis.json").read_text()) for out in outs)
    assert bare.pop("witness") == []
    witnesses = full.pop("witness")
    assert [w["channel"] for w in witnesses] == ["across", "r1", "rg"]
    more = full["says"].removeprefix(bare["says"])
    assert ("contradicts" in more) == any(w["verdict"] == "contradicts" for w in witnesses)
    full["says"] = bare["says"]
    assert bare == full
    assert "<h2>Witnesses</h2>" in (outs[1] / "report.html").read_text()
    assert "<h2>Witnesses</h2>" not in (outs[0] / "report.html").read_text()
    extended = configuration.load(outs[1] / "structure.extended.toml")
    assert [s.channel for s in extended.witnesses] == ["across", "r1", "rg"]


def test_check_tells_which_sensors_are_witnesses(sites: Sites) -> None:
    done = sites.main("check", sites.more)
    assert "channels a1, a2; witnesses across, r1, rg" in done.stdout
    assert "witnesses" not in sites.main("check", sites.plain).stdout


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        (
            'axis = "y"\n\n[[sensors]]\nchannel = "rg"',
            '\n[[sensors]]\nchannel = "rg"',
            "sensors.1.axis: Field required",
        ),
        ('axis = "y"', 'axis = "w"', "sensors.0.axis"),
        ('channel = "across"\nfloor = 1', 'channel = "across"\nfloor = 3', "'across' is on floor 3 of 2"),
        ('channel = "a1"\nfloor = 1', 'channel = "a1"\nfloor = 0', "'a1' is on floor 0 of 2"),
        ("rotation_rate", "tilt", "sensors.1.quantity"),
    ],
)
def test_what_is_wrong_with_a_witness_is_told_with_its_place(tmp_path: Path, old: str, new: str, told: str) -> None:
    text = FRAME.replace("\n[[sensors]]", WITNESSES + "\n[[sensors]]", 1)
    assert old in text
    path = tmp_path / "s.toml"
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(BadConfigurationError, match=told.replace(".", r"\.")):
        configuration.load(path)


def test_a_site_needs_an_accelerometer_along_the_models_direction(tmp_path: Path) -> None:
    path = tmp_path / "s.toml"
    path.write_text(FRAME.replace("floor = ", 'axis = "y"\nfloor = '))
    with pytest.raises(BadConfigurationError, match="none of them is an accelerometer along x"):
        configuration.load(path)


def test_without_a_model_accelerometers_of_all_axes_are_judged(tmp_path: Path) -> None:
    path = tmp_path / "s.toml"
    path.write_text(
        '[structure]\nkind = "modal"\n[[sensors]]\nchannel = "a1"\n[[sensors]]\nchannel = "b1"\naxis = "y"\n'
        '[[sensors]]\nchannel = "r1"\nquantity = "rotation_rate"\naxis = "z"\n'
    )
    config = configuration.load(path)
    assert config.channels == ("a1", "b1")
    assert [s.channel for s in config.witnesses] == ["r1"]


def test_a_block_of_rates_of_rotation_has_their_unit() -> None:
    samples = np.zeros((1, 1), np.float32)
    assert SampleBlock(ROTATION_RATE, 0, 0, 1.0, ("r1",), "rad/s", samples).unit == "rad/s"
    with pytest.raises(ValueError, match="unknown unit 'deg/s'"):
        SampleBlock(ROTATION_RATE, 0, 0, 1.0, ("r1",), "deg/s", samples)


MIDSPAN = """
[[sensors]]
channel = "m2"
floor = 2
quantity = "rotation_rate"
axis = "y"
mounted = "midspan"
"""


@pytest.mark.parametrize("excitation", ["ambient", "ground"])
def test_simulated_gyroscopes_turn_with_the_joints(tmp_path: Path, main: Cli, excitation: str) -> None:
    """By an integration of the floors' recorded accelerations in the frequency domain, where the motion is."""
    path, out = tmp_path / "s.toml", tmp_path / "s.mcap"
    path.write_text(FRAME + WITNESSES + MIDSPAN)
    effect = "joint_flexibility:frame:girder_to_column_ratio=0.5"
    options = ("--duration", 100, "--rate", 200, "--noise", 0, "--excitation", excitation, "--effect", effect)
    done = main("simulate", "--structure", path, "--out", out, *options)
    assert done.returncode == 0, done.stderr
    read = {t: np.concatenate([b.samples for b in read_recordings([out], (t,))]) for t in (ACCELERATION, ROTATION_RATE)}
    moved, turned = read[ACCELERATION].astype(float), read[ROTATION_RATE].astype(float)
    if excitation == "ground":
        moved -= np.concatenate([b.samples for b in read_recordings([out], (GROUND,))])
    model = configuration.load(path).model()
    frame = replace(model, effects=(parse_effect(effect),)).altered_structure()
    assert isinstance(frame, ShearFrame)
    rotations = frame.joint_rotations()
    taper, omega = np.hanning(len(moved))[:, None], 2j * np.pi * np.fft.rfftfreq(len(moved), 1 / 200.0)
    inside = (np.abs(omega) > 2.0 * np.pi * 3.0) & (np.abs(omega) < 2.0 * np.pi * 30.0)
    speed = np.fft.rfft(moved * taper, axis=0)[inside] / omega[inside, None]
    rates = np.fft.rfft(turned * taper, axis=0)[inside]
    wanted = speed @ np.array([rotations[0], -0.5 * rotations[1]]).T
    of_joint, of_ground, of_middle = 0, 1, 2
    assert np.abs(rates[:, [of_joint, of_middle]] - wanted).max() < 0.02 * np.abs(wanted).max()
    assert not turned[:, of_ground].any() and np.abs(turned.mean(axis=0)).max() < 0.05 * turned[:, 0].std()


def test_without_heights_gyroscopes_are_left_out_of_a_simulation(tmp_path: Path, main: Cli) -> None:
    path, out = tmp_path / "s.toml", tmp_path / "s.mcap"
    path.write_text((FRAME + WITNESSES).replace("story_heights_m = [0.1, 0.1]\n", ""))
    done = main("simulate", "--structure", path, "--out", out, "--duration", 10, "--rate", 200)
    assert done.returncode == 0, done.stderr
    assert {b.topic for b in read_recordings([out])} == {ACCELERATION}
