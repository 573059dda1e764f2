"""CAN logs become recordings through the code that reads buses."""

import subprocess
from collections.abc import Callable
from pathlib import Path

import can
import numpy as np
import pytest

from drivers import frames
from drivers.can_open import CanSettings
from drivers.mcap_file import read_recordings
from monitor.core import BadInputError, MissingInputError
from monitor.runs.readers import Options, import_files

DBC = Path(__file__).parents[2] / "deploy" / "frame.dbc"
T0 = 1_767_225_600


def write(path: Path, skip: range = range(0)) -> np.ndarray:
    """A log of 2000 samples, some lost and a foreign frame among them; returns the samples as numbered."""
    (layout,) = frames.load(DBC, ("a1", "a2", "a3"))
    raw = np.random.default_rng(3).integers(-30000, 30000, (2000, 3))
    data, _ = layout.encode(raw * 0.001, np.arange(2000))
    with can.Logger(path) as log:
        for k in range(2000):
            if k not in skip:
                log(
                    can.Message(
                        timestamp=T0 + k / 1024, arbitration_id=256, is_extended_id=False, data=data[k].tobytes()
                    )
                )
        log(can.Message(timestamp=T0 + 2, arbitration_id=9, is_extended_id=False, data=b"x"))
    return np.float32(raw * 0.001)


@pytest.mark.parametrize("suffix", [".blf", ".asc", ".log", ".trc"])
def test_every_format_gives_the_same_samples_at_the_same_times(tmp_path: Path, suffix: str) -> None:
    log, out, warnings = tmp_path / f"x{suffix}", tmp_path / "o.mcap", []
    samples = write(log, skip=range(500, 520))
    info = import_files([log], out, Options(dbc=DBC, rate_hz=1024.0), on_warning=warnings.append)
    assert (info.n_samples, info.sample_rate_hz) == (1980, 1024.0)
    assert abs(info.t_start_ns - T0 * 10**9) < 1_000_000  # .asc and .trc say milliseconds
    for block in read_recordings([out]):
        np.testing.assert_array_equal(block.samples, samples[block.sequence : block.sequence + block.n_samples])
        assert block.t_ns == info.t_start_ns + round(block.sequence / 1024.0 * 1e9)
    assert warnings == [f"{log}: 20 lost samples"]


def test_an_option_that_a_log_has_no_use_for_is_told(tmp_path: Path) -> None:
    log, out, told = tmp_path / "x.log", tmp_path / "o.mcap", list[str]()
    samples = write(log)
    import_files([log], out, Options(dbc=DBC, rate_hz=1024.0, unit="g", scale=2.0), on_warning=told.append)
    assert [one.partition(": ")[2].partition(" is not used")[0] for one in told] == ["--unit", "--scale"]
    taken = np.concatenate([block.samples for block in read_recordings([out])])
    np.testing.assert_array_equal(taken, samples)


def test_the_command(tmp_path: Path, main: Callable[..., subprocess.CompletedProcess[str]]) -> None:
    write(tmp_path / "x.blf")
    done = main("import", tmp_path / "x.blf", "--dbc", DBC, "--rate", "1024", "--out", tmp_path / "o.mcap")
    assert done.returncode == 0 and "1.95 s at 1024 Hz" in done.stdout and done.stderr == ""


def test_what_is_missing_or_too_much_is_named(tmp_path: Path) -> None:
    log = tmp_path / "x.log"
    write(log)
    for options, reason in (
        ({"rate_hz": 1024.0}, "--dbc"),
        ({"dbc": DBC}, "--rate"),
        ({"dbc": DBC, "rate_hz": 1024.0, "ground": "x"}, "no --channel"),
    ):
        with pytest.raises(BadInputError, match=reason):
            import_files([log], tmp_path / "o.mcap", Options(**options))  # type: ignore[arg-type]
    with pytest.raises(MissingInputError, match="does not exist"):
        import_files([log], tmp_path / "o.mcap", Options(dbc=tmp_path / "none.dbc", rate_hz=1024.0))
    assert not list(tmp_path.glob("*.mcap*"))


@pytest.mark.parametrize("content", [b"", b"garbage", b"\0\xff" * 500, b"(x) can0 100#00\n", b"LOGG" + bytes(200)])
@pytest.mark.parametrize("suffix", [".blf", ".asc", ".log", ".trc"])
def test_damaged_logs_are_one_message(tmp_path: Path, suffix: str, content: bytes) -> None:
    (tmp_path / f"x{suffix}").write_bytes(content)
    with pytest.raises(BadInputError, match=f"x{suffix}"):
        import_files([tmp_path / f"x{suffix}"], tmp_path / "o.mcap", Options(dbc=DBC, rate_hz=1024.0))
    assert not list(tmp_path.glob("*.mcap*"))


def test_a_log_cut_short_gives_what_it_holds(tmp_path: Path) -> None:
    write(tmp_path / "x.log")
    raw = (tmp_path / "x.log").read_bytes()
    (tmp_path / "x.log").write_bytes(raw[: len(raw) // 2])
    warnings: list[str] = []
    info = import_files(
        [tmp_path / "x.log"], tmp_path / "o.mcap", Options(dbc=DBC, rate_hz=1024.0), on_warning=warnings.append
    )
    assert 990 < info.n_samples < 1010


@pytest.mark.parametrize(("suffix", "names"), [(".log", ("can0", "can1")), (".blf", ("1", "2")), (".asc", ("1", "2"))])
def test_a_log_of_two_buses_with_one_identifier_is_refused_without_a_choice(
    tmp_path: Path, suffix: str, names: tuple[str, str]
) -> None:
    log, out = tmp_path / f"x{suffix}", tmp_path / "o.mcap"
    (layout,) = frames.load(DBC, ("a1", "a2", "a3"))
    raw = np.random.default_rng(3).integers(-30000, 30000, (2, 400, 3))
    data = [layout.encode(one * 0.001, np.arange(400))[0] for one in raw]
    with can.Logger(log) as writer:
        for k in range(400):
            for bus in (0, 1):
                time_s, content = T0 + k / 1024 + 1e-4 * bus, data[bus][k].tobytes()
                writer(can.Message(time_s, arbitration_id=256, is_extended_id=False, channel=bus, data=content))
    with pytest.raises(BadInputError, match=rf"x{suffix}.*ACCEL3 \(0x100\).*buses {names[0]} and {names[1]}.*--bus"):
        import_files([log], out, Options(dbc=DBC, rate_hz=1024.0))
    assert not out.exists()
    for bus, name in enumerate(names):
        assert import_files([log], out, Options(dbc=DBC, rate_hz=1024.0, bus=name)).n_samples == 400
        taken = np.concatenate([block.samples for block in read_recordings([out])])
        np.testing.assert_array_equal(taken, np.float32(raw[bus] * 0.001))
    with pytest.raises(BadInputError, match=f"on bus can7, but on {names[0]}, {names[1]}"):
        import_files([log], out, Options(dbc=DBC, rate_hz=1024.0, bus="can7"))


def test_the_command_takes_a_bus(tmp_path: Path, main: Callable[..., subprocess.CompletedProcess[str]]) -> None:
    write(tmp_path / "x.log")
    options = ("--dbc", DBC, "--rate", "1024", "--out", tmp_path / "o.mcap")
    assert main("import", tmp_path / "x.log", "--bus", "vcan0", *options).returncode == 0
    done = main("import", tmp_path / "x.log", "--bus", "can7", *options)
    assert done.returncode == 65 and "on bus can7, but on vcan0" in done.stderr


def test_a_bus_is_of_logs_alone(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="channel names a live bus"):
        CanSettings(interface="socketcan", channel="can0", dbc="a.dbc", sample_rate_hz=1.0, bus="can0")
    (tmp_path / "a.csv").write_text("t,a1\n0,1\n1,2\n")
    with pytest.raises(BadInputError, match="--bus can0 is for CAN logs"):
        import_files([tmp_path / "a.csv"], tmp_path / "o.mcap", Options(bus="can0"))
