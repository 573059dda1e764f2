"""What `check` finds besides the tables themselves (recordings, sensors on one floor, passwords, types), and `host` at once."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.support.samples import Cli


@pytest.fixture
def site(tmp_path: Path, frame_text: str) -> Path:
    """A site file over a recording that does not exist."""
    path = tmp_path / "site.toml"
    path.write_text('[source]\nkind = "mcap"\nfiles = ["rec.mcap"]\n' + frame_text)
    return path


def test_a_recording_of_the_source_that_is_missing_is_told(site: Path, main: Cli) -> None:
    done = main("check", site)
    assert done.returncode == 66, done.stderr
    assert "site.toml: source.files: " in done.stderr and "rec.mcap" in done.stderr
    site.write_text(site.read_text().replace("rec.mcap", "*.mcap"))
    done = main("check", site)
    assert done.returncode == 66 and "no recording has such a name" in done.stderr


def test_a_recording_of_the_source_that_is_none_is_told(site: Path, main: Cli) -> None:
    site.with_name("rec.mcap").write_text("a1,a2\n1,2\n")
    done = main("check", site)
    assert done.returncode == 65, done.stderr
    assert "site.toml: source.files: " in done.stderr and "rec.mcap" in done.stderr


def test_a_recording_of_the_source_that_is_sound_passes(site: Path, main: Cli) -> None:
    simulated = ("simulate", "--structure", site, "--out", site.with_name("rec.mcap"), "--duration", 5)
    assert main(*simulated).returncode == 0
    done = main("check", site)
    assert done.returncode == 0 and "no problems" in done.stdout, done.stderr


def test_sensors_on_one_floor_are_remarked(tmp_path: Path, frame_text: str, main: Cli) -> None:
    path = tmp_path / "s.toml"
    path.write_text(frame_text)
    assert "same floor" not in main("check", path).stderr
    path.write_text(frame_text.replace("floor = 3", "floor = 2"))
    done = main("check", path)
    assert done.returncode == 0
    assert "sensors: a2, a3 are on the same floor 2" in done.stderr


def test_the_password_file_of_the_mqtt_outlet_is_looked_for(tmp_path: Path, frame_text: str, main: Cli) -> None:
    path = tmp_path / "s.toml"
    path.write_text(f'[output.mqtt]\nhost = "127.0.0.1"\nuser = "u"\npassword_file = "secret"\n{frame_text}')
    done = main("check", path)
    assert done.returncode == 78, done.stderr
    assert "s.toml: output.mqtt.password_file: secret: no such file" in done.stderr
    (tmp_path / "secret").write_text("word\n")
    assert main("check", path).returncode == 0


@pytest.mark.parametrize(
    ("table", "told"),
    [
        (
            '[output.mqtt]\nhost = "h"\nport = "1883"\n',
            'output.mqtt.port: must be a whole number, and is the text "1883"',
        ),
        ("[notify]\nurls = 'mailto://x'\n", "notify.urls: must be an array, and is text"),
    ],
)
def test_types_in_the_tables_of_outlets_are_checked(
    tmp_path: Path, frame_text: str, main: Cli, table: str, told: str
) -> None:
    path = tmp_path / "s.toml"
    path.write_text(table + frame_text)
    done = main("check", path)
    assert done.returncode == 78 and f"s.toml: {told}" in done.stderr, done.stderr


def test_types_in_a_fleet_file_are_checked(tmp_path: Path, main: Cli) -> None:
    path = tmp_path / "fleet.toml"
    path.write_text('[fleet]\nconnect = ["tcp/127.0.0.1:7447"]\nconnect_timeout_s = "5"\n')
    done = main("check", path)
    assert done.returncode == 78 and 'fleet.connect_timeout_s: must be a number, and is the text "5"' in done.stderr


def test_a_host_of_bad_files_alone_ends_with_their_problems(tmp_path: Path, frame_text: str, main: Cli) -> None:
    one, other = tmp_path / "one.toml", tmp_path / "other.toml"
    one.write_text(frame_text.replace("window_s = 20.0", 'window_s = "20"'))
    other.write_text(frame_text + "\n[alarms]\nmin_loss = 0.01\n")
    for files in ((one,), (one, other)):
        done = main("host", *files)
        assert done.returncode == 78
        assert "one.toml: processing.window_s: must be a number" in done.stderr
    assert "other.toml: alarms" in done.stderr


def test_a_host_begins_where_a_file_cannot_be_read_yet(
    tmp_path: Path, frame_text: str, main: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun: list[list[Path]] = []

    class Noted:
        def __init__(self, places: list[Path], *_: object, **__: object) -> None:
            begun.append(places)

        def run(self) -> None: ...

    monkeypatch.setattr("monitor.service.Host", Noted)
    bad, early = tmp_path / "bad.toml", tmp_path / "early.toml"
    bad.write_text(frame_text.replace("window_s = 20.0", 'window_s = "20"'))
    early.write_text('[structure]\nkind = "matrices"\nmass_matrix = "m.mtx"\nstiffness_matrix = "k.mtx"\n')
    assert main("check", early).returncode == 66, "its matrices come later"
    assert main("host", bad, early).returncode == 0 and begun == [[bad, early]]


@pytest.mark.parametrize("host", ["mqtt://u:PASS@broker", "u:PASS@broker", "broker/PASS", "broker PASS"])
@pytest.mark.parametrize("table", ["source", "output.mqtt"])
def test_a_password_in_the_address_of_a_broker_is_refused_and_never_repeated(
    table: str, host: str, tmp_path: Path, frame_text: str, main: Cli
) -> None:
    kind = 'kind = "mqtt"\ntopic = "shm/a/b"\n' if table == "source" else ""
    path = tmp_path / "s.toml"
    path.write_text(f'[{table}]\n{kind}host = "{host}"\n{frame_text}')
    done = main("check", path)
    assert done.returncode == 78, done.stderr
    assert f"s.toml: {table}.host: must be a name or an address alone" in done.stderr
    assert "PASS" not in done.stdout + done.stderr
