"""What people write: addresses, times, and problems of settings in words."""

from __future__ import annotations

from pathlib import Path

import pytest
from pydantic import ValidationError

from monitor.config import OutputSettings
from monitor.core.parse import parse_address, utc_ns
from monitor.core.settings import settings_problems
from monitor.service import Request
from tests.support.samples import T0_NS, Cli


def test_an_address_is_host_and_port() -> None:
    assert parse_address("127.0.0.1:9876") == ("127.0.0.1", 9876)
    assert parse_address("[::1]:80") == ("::1", 80)
    assert parse_address("host:0", any_port=True) == ("host", 0)
    assert OutputSettings(serve="[::1]:80").address == ("::1", 80)


def test_what_is_no_address_is_refused_wherever_it_stands(main: Cli, tmp_path: Path, frame_text: str) -> None:
    for text in ("host", ":80", "host:", "host:65536", "host:-1", "host:²", "host:8 0"):
        for read in (parse_address, lambda t: OutputSettings(serve=t)):
            with pytest.raises(ValueError, match="is not HOST:PORT"):
                read(text)
        (tmp_path / "s.toml").write_text(f'[output.metrics]\nlisten = "{text}"\n{frame_text}')
        done = main("check", "s.toml", cwd=tmp_path)
        assert done.returncode == 78 and "output.metrics.listen" in done.stderr and "HOST:PORT" in done.stderr
    (tmp_path / "s.toml").write_text(f'[output.metrics]\nlisten = "[::1]:80"\n{frame_text}')
    assert main("check", "s.toml", cwd=tmp_path).returncode == 0
    done = main("replay", "r.mcap", "--structure", "s.toml", "--out", "o", "--serve", "host", cwd=tmp_path)
    assert done.returncode == 2 and "is not HOST:PORT" in done.stderr
    assert main("view", "host:65536", cwd=tmp_path).returncode == 66


def test_a_time_is_utc_unless_it_says_otherwise_and_whole_microseconds() -> None:
    assert utc_ns("2026-01-01") == utc_ns("2026-01-01T00:00:00Z") == utc_ns("2026-01-01T01:00+01:00") == T0_NS
    assert utc_ns("2026-01-01T00:00:00.000001") == T0_NS + 1000
    assert utc_ns("1969-12-31T23:59:59.5") == -500_000_000


def test_what_is_no_time_is_wrong_usage_in_every_command(main: Cli, tmp_path: Path) -> None:
    for text in ("", "yesterday", "01.02.2026", "2026-13-01", "1677-01-01", "2263-01-01", "9999-12-31"):
        with pytest.raises(ValueError, match=r"no time|beyond the years"):
            utc_ns(text)
    (tmp_path / "o").mkdir()
    for command in (
        ("simulate", "--structure", "s.toml", "--out", "r.mcap", "--start"),
        ("import", "a.csv", "--out", "r.mcap", "--start"),
        ("report", "o", "--out", "r.html", "--from"),
        ("export", "o", "--out", "t.csv", "--to"),
    ):
        for value in ("", "yesterday", "2263-01-01", "1969-12-31"):
            done = main(*command, value, cwd=tmp_path)
            assert done.returncode == 2 and f"{command[-1]}: " in done.stderr, done.stderr


def test_problems_are_told_with_their_place_and_without_the_values() -> None:
    with pytest.raises(ValidationError) as caught:
        Request.model_validate({"action": "reset", "story": "s3cret", "who": ""})
    lines = settings_problems(caught.value, "output", "zenoh")
    assert [line.partition(": ")[0] for line in lines] == ["output.zenoh.story", "output.zenoh.who"]
    assert "s3cret" not in "".join(lines)
    with pytest.raises(ValidationError) as caught:
        Request(action="shelve", story=1, who="ann")
    assert settings_problems(caught.value) == ["shelving needs a note and seconds"]
