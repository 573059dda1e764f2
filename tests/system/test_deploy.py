"""What operators install: units that systemd accepts, a container file of known form, a site file that is sound."""

from __future__ import annotations

import configparser
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from monitor.config import configuration, security_check
from tests.support.commands import ended
from tests.support.debian import demand
from tests.support.samples import Cli

pytestmark = pytest.mark.system

DEPLOY = Path(__file__).parents[2] / "deploy"
UNITS = ("shm-monitor.service", "shm-monitor@.service")


def unit(name: str) -> dict[str, str]:
    parser = configparser.RawConfigParser(strict=False)
    parser.optionxform = str  # type: ignore[assignment,method-assign]
    parser.read(DEPLOY / name)
    return {key: value for section in parser.sections() for key, value in parser.items(section)}


@pytest.mark.parametrize("name", UNITS)
def test_systemd_accepts_the_unit(name: str, tmp_path: Path) -> None:
    demand("systemd")
    text = (DEPLOY / name).read_text().replace("/opt/shm-monitor/bin/shm-monitor", "/bin/true")
    (tmp_path / name).write_text(text)  # it wants programs to exist
    done = ended("systemd-analyze", "verify", tmp_path / name)
    assert done.returncode == 0 and not done.stderr, done.stderr


@pytest.mark.parametrize("name", UNITS)
def test_the_unit_locks_the_service_in(name: str) -> None:
    found = unit(name)
    assert found["Type"] == "notify" and float(found["WatchdogSec"]) >= 30 and found["Restart"] == "always"
    assert found["StartLimitIntervalSec"] == "0"  # never give up
    assert found["ProtectSystem"] == "strict" and found["NoNewPrivileges"] == "true"
    assert found["User"] != "root" and found["CapabilityBoundingSet"] == "" and found["MemoryMax"]
    assert int(found["LimitNOFILE"]) >= 1024 and int(found["TasksMax"]) >= 128
    assert found["KillMode"] == "mixed"  # SIGTERM for the monitor alone, which ends its own processes
    assert found["OOMPolicy"] == "continue"  # a diagnosis that takes too much is no end of the monitor
    # READY waits for the compiler for as long as that takes; what it compiled outlives a restart.
    assert found["TimeoutStartSec"] == "infinity"
    assert f"NUMBA_CACHE_DIR=/var/cache/{found['CacheDirectory']}" in found["Environment"]
    commands = [shlex.split(found[key])[1] for key in ("ExecStartPre", "ExecStart")]
    assert commands == ["check", "run"]


def test_the_two_units_differ_in_their_instances_only() -> None:
    one, many = (unit(name) for name in UNITS)
    differing = {key for key in one.keys() | many.keys() if one.get(key) != many.get(key)}
    assert differing <= {
        "Description",
        "EnvironmentFile",
        "ExecStartPre",
        "ExecStart",
        "StateDirectory",
        "ReadWritePaths",
    }


def test_the_container_file_is_of_known_form() -> None:
    """No engine here: each instruction is known, what it copies is there, it runs as nobody special."""
    text = re.sub(r"\\\n", " ", (DEPLOY / "Containerfile").read_text())
    rows = [row.split(None, 1) for row in text.splitlines() if row and not row.startswith("#")]
    known = set("ARG FROM WORKDIR COPY RUN ENV USER VOLUME STOPSIGNAL HEALTHCHECK ENTRYPOINT CMD".split())  # noqa: SIM905
    assert {name for name, _ in rows} <= known
    for name, rest in rows:
        if name == "COPY" and not rest.startswith("--from"):
            assert all((DEPLOY.parent / source).exists() for source in rest.split()[:-1]), rest
        if name == "RUN":
            assert subprocess.run(["sh", "-n", "-c", rest], check=False).returncode == 0, rest
    user = next(rest for name, rest in reversed(rows) if name == "USER")
    assert int(user.partition(":")[0]) > 0
    assert any(name == "RUN" and "--require-hashes" in rest for name, rest in rows)
    assert ("RUN", "shm-monitor warm") in [tuple(row) for row in rows]
    assert any(
        name == "ENV" and "NUMBA_CACHE_DIR=/var/lib/shm-monitor/" in rest for name, rest in rows
    )  # in the volume
    health = next(rest for name, rest in rows if name == "HEALTHCHECK")
    assert "shm-monitor status" in health


def test_images_are_named_by_version_and_containers_have_limits() -> None:
    """A digest can be put in the place of each version; it is known only where there is a registry."""
    text = (DEPLOY / "Containerfile").read_text()
    assert re.findall(r"^FROM (\S+)", text, re.MULTILINE) == ["${PYTHON_IMAGE}"] * 2
    assert re.search(r"^ARG PYTHON_IMAGE=\S+:3\.\d+-\S+$", text, re.MULTILINE)
    compose = (DEPLOY / "compose.yaml").read_text()
    pinned = re.search(r"^eclipse-zenoh==(\S+)", (DEPLOY.parent / "requirements.txt").read_text(), re.MULTILINE)
    assert pinned is not None and f"${{ZENOH_IMAGE:-eclipse/zenoh:{pinned[1]}}}" in compose
    monitor, router = compose.split("\nservices:\n")[0], compose.partition("  router:\n")[2].partition("  frame-1:")[0]
    for part in (monitor, router):
        assert all(f"{limit}: " in part for limit in ("mem_limit", "pids_limit", "ulimits")), part


def test_the_site_file_is_sound_and_opens_no_door(tmp_path: Path, main: Cli) -> None:
    done = main("check", DEPLOY / "site.toml")
    assert done.returncode == 0, done.stderr
    assert not security_check.warnings(DEPLOY / "site.toml", configuration.load(DEPLOY / "site.toml"))
    # Every table and setting that is only shown is sound too.
    text = (DEPLOY / "site.toml").read_text()
    shown = re.sub(r"^# (\w+ = |\[)", r"\1", text, flags=re.MULTILINE).replace('"baseline.json"', '"b.json"')
    assert shown.count("\n#") < text.count("\n#")
    (tmp_path / "site.toml").write_text(shown)
    done = main("check", tmp_path / "site.toml")
    problems = [row for row in done.stderr.splitlines() if "site.toml:" in row]
    # Files and variables that only the site has are missing here, nothing else.
    assert all(
        re.search(r"b\.json|tls|No such file|environment has no|notify\.urls|url_file", row) for row in problems
    ), problems


def test_the_fleet_file_is_sound(tmp_path: Path, main: Cli) -> None:
    done = main("check", DEPLOY / "fleet.toml")
    assert done.returncode == 0 and "no problems; sites frame-1, frame-2" in done.stdout, done.stderr
    (tmp_path / "fleet.toml").write_text((DEPLOY / "fleet.toml").read_text() + "colour = 1\n")
    done = main("check", tmp_path / "fleet.toml")
    assert done.returncode == 78 and "fleet.toml: fleet.colour" in done.stderr


def test_a_user_without_a_home_may_run_what_root_installed() -> None:
    """Where compiled code cannot be kept, it is compiled anew."""
    script = (
        "from monitor.inference import linearize; from monitor.model import loaded; print(loaded(), linearize.__name__)"
    )
    nowhere = "IPythonCacheLocator"  # none for files
    done = ended(sys.executable, "-c", script, cwd=DEPLOY.parent, NUMBA_CACHE_LOCATOR_CLASSES=nowhere)
    assert (done.returncode, done.stdout) == (0, "None linearize\n"), done.stderr
