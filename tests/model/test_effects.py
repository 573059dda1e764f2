"""Effects on the command line and in structure files: recordings with known truth, and refusals."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from drivers.base import ACCELERATION, TEMPERATURE, SampleBlock
from drivers.mcap_file import read_recordings
from monitor.config import configuration
from monitor.model.effects import parse_effect
from monitor.model.effects.clock_rate import ClockRate
from monitor.model.effects.joint_flexibility import JointFlexibility
from monitor.model.model import Model
from monitor.model.simulation import simulate
from tests.contracts.effect_cases import CASES, CONTEXT, STRUCTURE
from tests.support.samples import Cli

T0_NS = 1_767_225_600_000_000_000


@pytest.fixture(scope="module")
def frame(tmp_path_factory: pytest.TempPathFactory, frame_text: str) -> Path:
    path = tmp_path_factory.mktemp("effects") / "frame.toml"
    path.write_text(frame_text)
    return path


@pytest.fixture
def short(main: Cli, frame: Path, tmp_path: Path) -> Cli:
    def run(*more: object) -> subprocess.CompletedProcess[str]:
        out = tmp_path / "s.mcap"
        return main("simulate", "--structure", frame, "--out", out, "--duration", 3, "--rate", 128, *more)

    return run


def blocks(path: Path, topic: str) -> list[SampleBlock]:
    return [block for block in read_recordings([path]) if block.topic == topic]


def metadata(path: Path) -> dict[str, str]:
    with path.open("rb") as file:
        (record,) = make_reader(file).iter_metadata()
    return record.metadata


@pytest.mark.parametrize("text", [c for c in CASES if not c.startswith("temperature")])
def test_the_command_plants_any_effect(short: Cli, tmp_path: Path, text: str) -> None:
    assert short("--effect", text, "--seed", 4).returncode == 0
    effect = parse_effect(text)
    wanted = simulate(Model(STRUCTURE, (effect,)), duration_s=3, rate_hz=128, noise=0.05, seed=4, context=CONTEXT)
    written = np.concatenate([b.samples for b in blocks(tmp_path / "s.mcap", ACCELERATION)])
    np.testing.assert_array_equal(written, wanted.floors.astype(np.float32))
    told = json.loads(metadata(tmp_path / "s.mcap")["effects"])
    assert told == [{"effect": effect.name, "location": effect.location, **effect.values()}]


def test_temperature_is_recorded_with_the_stiffness_that_follows_it(short: Cli, tmp_path: Path) -> None:
    assert short("--effect", "temperature_stiffness:frame:per_degc=-0.01,lag_s=0").returncode == 0
    felt = blocks(tmp_path / "s.mcap", TEMPERATURE)
    assert [b.t_ns for b in felt] == [T0_NS + k * 10**9 for k in range(3)]
    assert {b.unit for b in felt} == {"degC"} and felt[0].sample_rate_hz == 1.0
    np.testing.assert_allclose(
        [b.samples[0, 0] for b in felt], 20 - 5 * np.cos(2 * np.pi * np.arange(3) / 3), rtol=1e-6
    )
    assert metadata(tmp_path / "s.mcap")["reference_degc"] == "20.0"


def test_the_weather_can_be_told(short: Cli, tmp_path: Path) -> None:
    """Half a period of 6 s, and 10 K above the reference is 10 per_degc of stiffness."""
    assert short("--temperature", "5,8,6").returncode == 0
    felt = [b.samples[0, 0] for b in blocks(tmp_path / "s.mcap", TEMPERATURE)]
    np.testing.assert_allclose(felt, 5 - 4 * np.cos(np.pi * np.arange(3) / 3), rtol=1e-6)
    warm = "temperature_stiffness:frame:per_degc=0.01,lag_s=0"
    assert short("--effect", warm, "--temperature", "30,0,100,20", "--noise", 0).returncode == 0
    written = np.concatenate([b.samples for b in blocks(tmp_path / "s.mcap", ACCELERATION)])
    stiff = Model(STRUCTURE, (parse_effect("stiffness_change:frame:relative=0.1"),))
    plain = simulate(Model(STRUCTURE), duration_s=3, rate_hz=128).floors
    wanted = simulate(stiff, duration_s=3, rate_hz=128).floors
    assert (written - wanted).std() < 0.1 * (plain - wanted).std()  # but for the damping, which stays as it was


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (["--effect", "story_damper:floor 1:damping_n_s_per_m=1"], "story N"),
        (["--effect", "story_damper:story 1:damping_n_s_per_m=-1"], "above 0"),
        (["--effect", "sensor_gain:channel b:gain=2"], "'b'"),
        (["--effect", "channel_swap:channel a2,a1"], "a1,a2"),
        (["--effect", "base_excitation:base:share=1"], "below 1"),
        (["--effect", "base_excitation:base:share=0.6", "--effect", "base_excitation:base:share=0.6"], "add up"),
        (["--effect", "coloured_excitation:frame:corner_hz=5", "--excitation", "ground"], "ambient"),
        (["--effect", "gravity_softening:frame:factor=400"], "stand"),
        (["--temperature", "warm"], "MEAN"),
        (["--temperature", "20,10,0"], "PERIOD_S > 0"),
        (["--temperature", "20,10,5,0,1"], "MEAN"),
        (["--temperature", "20,inf"], "finite"),
    ],
)
def test_what_cannot_be_is_one_message(short: Cli, tmp_path: Path, arguments: list[str], word: str) -> None:
    done = short(*arguments)
    assert done.returncode == 78
    assert word in done.stderr and "Traceback" not in done.stderr
    assert not (tmp_path / "s.mcap").exists()


@pytest.mark.parametrize("text", CASES)
def test_any_effect_may_stand_in_a_structure_file(main: Cli, tmp_path: Path, frame_text: str, text: str) -> None:
    effect = parse_effect(text)
    values = ", ".join(f"{name} = {value!r}" for name, value in effect.values().items())
    path = tmp_path / "with.toml"
    table = f'\n[[effects]]\neffect = "{effect.name}"\nlocation = "{effect.location}"\nparameters = {{ {values} }}\n'
    path.write_text(frame_text + table)
    assert main("check", path).returncode == 0
    model = configuration.load(path).model()
    assert model.effects == (effect,)
    assert np.isfinite(model.stiffness_derivatives()).all() and np.isfinite(model.damping_matrix()).all()


@pytest.mark.parametrize("change_first", [False, True])
def test_a_story_that_changed_is_other_columns_between_the_girders_that_were_built(change_first: bool) -> None:
    joints, change = (
        parse_effect("joint_flexibility:frame:girder_to_column_ratio=8"),
        parse_effect("stiffness_change:story 1:relative=-0.15"),
    )
    model = Model(STRUCTURE, (change, joints) if change_first else (joints, change))
    assert STRUCTURE.story_heights_m is not None
    built, columns = STRUCTURE.stiffness_n_per_m, STRUCTURE.stiffness_n_per_m * [0.85, 1.0, 1.0]
    ratio = 8.0 * (built @ STRUCTURE.story_heights_m**2) / (columns @ STRUCTURE.story_heights_m**2)
    wanted = Model(STRUCTURE.with_stiffness(columns), (JointFlexibility("frame", ratio),)).stiffness_matrix()
    np.testing.assert_allclose(model.stiffness_matrix(), wanted, rtol=1e-12)


def test_replay_and_calibrate_take_a_structure_file_with_a_nonlinear_effect(
    main: Cli, tmp_path: Path, frame: Path, frame_text: str
) -> None:
    law = "cubic_stiffness:story 2:k3_n_per_m3=2e7"
    done = main(
        "simulate", "--structure", frame, "--out", tmp_path / "r.mcap", "--duration", 60, "--rate", 128, "--effect", law
    )
    assert done.returncode == 0
    path = tmp_path / "with.toml"
    path.write_text(
        frame_text
        + '\n[[effects]]\neffect = "cubic_stiffness"\nlocation = "story 2"\nparameters = { k3_n_per_m3 = 2e7 }\n'
    )
    done = main("calibrate", tmp_path / "r.mcap", "--structure", path, "--out", tmp_path / "b.json")
    assert done.returncode == 0, done.stderr
    more = ("--structure", path, "--baseline", tmp_path / "b.json", "--out", tmp_path / "out")
    done = main("replay", tmp_path / "r.mcap", *more)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("text", CASES)
def test_a_fit_that_ends_at_a_limit_of_what_is_possible_is_another_effect(text: str) -> None:
    effect, band_hz = parse_effect(text), np.linspace(0.5, 40.0, 80)
    assert effect.is_plausible(band_hz)
    if effect.name == "base_excitation":
        return  # the ground may cause all of the motion
    for i, parameter in enumerate(effect.parameters):
        for end in {parameter.low, parameter.high} - {0.0, parameter.absent}:
            if np.isfinite(end):
                coordinates = effect.coordinates
                coordinates[i] = 2.0 * parameter.coordinate(end)
                assert not effect.at(coordinates).is_plausible(band_hz), (parameter.name, end)


@pytest.mark.parametrize("relative", [0.0, 5e-5, 3e-4, 6e-3, 2e-2])
@pytest.mark.parametrize("std", [1e-5, 1e-3])
def test_the_cost_of_a_clock_is_its_evidence_by_quadrature(relative: float, std: float) -> None:
    """The likelihood at its best, over its mean under the prior of docs/decisions/0102."""
    x = np.concatenate(
        [np.linspace(-1e-3, 1e-3, 400_001), np.linspace(1e-3, 0.1, 400_001), np.linspace(-0.1, -1e-3, 400_001)]
    )
    x.sort()
    prior = sum(share * np.exp(-0.5 * (x / own) ** 2) / own for share, own in ((0.99, 1e-4), (0.01, 1e-2)))
    prior /= np.sqrt(2.0 * np.pi)
    mean = np.trapezoid(prior * np.exp(-0.5 * ((x - relative) / std) ** 2), x)
    cost = ClockRate("frame", relative).size_cost(np.array([[std**2]]))
    assert cost == pytest.approx(-np.log(mean), abs=0.02) and cost >= 0.0
