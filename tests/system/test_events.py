"""Events in a real `run`: killed in the middle of one it tells it once after the restart; a full disk loses no line."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.mcap_file import recording_info
from tests.events.shaken import RATE as SHAKEN_RATE, STIFFNESS, kanai_tajimi, shake, structure_text
from tests.support.faulty_disk import faulty_disk, is_possible
from tests.support.http import fetch
from tests.support.live_site import RATE, SIZE, LiveDaemon, save_stream
from tests.support.samples import T0_NS
from tests.support.site import lines
from tests.support.zenoh_router import free_port

pytestmark = pytest.mark.system

QUIET_S, QUAKE_S, AFTER_S = 25.0, 25.0, 30.0
"""Of the stream's time."""
PACE_S = 0.02
"""Between two blocks of half a second: 25 times real time."""
SITE = """
[site]
name = "bench"

[output]
dir = "out"
[output.metrics]
listen = "127.0.0.1:{port}"

[recorder]
min_free_gb = 0.0
flush_s = 0.5

[watch]
diagnose = false

[state]
checkpoint_s = 10.0

[events]
merge_s = 4.0
post_s = 12.0
pre_s = 15.0

[[events.limits]]
drift_ratio = 1e-5
says = "look at it"
"""


@pytest.fixture
def site(tmp_path: Path) -> Path:
    """A site file, and the stream of its frame: quiet, a quake, quiet.  It is simulated at another rate, and so slower."""
    slower = RATE / SHAKEN_RATE
    (tmp_path / "site.toml").write_text(SITE.format(port=free_port()) + structure_text(STIFFNESS * slower**2))
    wave = np.zeros(round((QUIET_S + QUAKE_S + AFTER_S) * RATE))
    quake = kanai_tajimi(QUAKE_S * slower, 1.0, 2.5, np.random.default_rng(3))
    wave[round(QUIET_S * RATE) :][: quake.size] += quake
    save_stream(tmp_path, shake(wave, np.random.default_rng(4))[0].floors)
    return tmp_path


def at_s(daemon: LiveDaemon) -> float:
    """Time of the stream that the source has given."""
    return daemon.given * SIZE / RATE


def event_lines(folder: Path) -> list[dict[str, Any]]:
    return lines(folder / "out", "events.jsonl")


def test_an_event_in_which_the_daemon_is_killed_is_told_once_after_the_restart(site: Path) -> None:
    with LiveDaemon(site, PACE_S) as daemon:
        daemon.until(lambda: at_s(daemon) > QUIET_S + 0.5 * QUAKE_S, "the middle of the quake")
    assert not event_lines(site)
    with LiveDaemon(site, PACE_S) as daemon:
        daemon.until(lambda: at_s(daemon) > QUIET_S + QUAKE_S + AFTER_S - 5.0, "the end of the stream")
        assert daemon.stop()[0] == 0
    found = event_lines(site)
    assert found and all(n == 1 for n in Counter((line["id"], line["revision"]) for line in found).values())
    first = found[0]
    begin_s = (first["t_begin_ns"] - T0_NS) * 1e-9
    assert abs(begin_s - QUIET_S) < 3.0 and first["verdict"] == "look at it"
    info = recording_info(site / "out" / first["recording"])
    assert info.t_start_ns <= first["t_begin_ns"] - 10 * 10**9, "what was recorded before the kill belongs to it"
    page = (site / "out" / "events" / f"{first['id']}.html").read_text()
    assert "look at it" in page and "a1: acceleration" in page
    assert "Traceback" not in daemon.said


@pytest.mark.skipif(not is_possible(), reason="only root may mount a disk")
def test_an_event_at_a_full_disk_keeps_its_line_and_is_told(site: Path) -> None:
    backing, out = site / "backing", site / "out"
    backing.mkdir()
    out.mkdir()
    port = int((site / "site.toml").read_text().partition("127.0.0.1:")[2].partition('"')[0])
    with faulty_disk(backing, out) as disk, LiveDaemon(site, PACE_S) as daemon:
        daemon.until(lambda: at_s(daemon) > QUIET_S + 5.0, "the quake")
        disk.fill()
        blocked = 'shm_output_failed{output="events"} 1.0'
        daemon.until(lambda: blocked in fetch(port).decode(), "the recording cannot be written")
        disk.make_room()
        daemon.until(lambda: event_lines(site), "the line")
        assert daemon.stop()[0] == 0
        line = event_lines(site)[0]
        assert line["revision"] == 0 and all(peak > 0.0 for peak in line["peak_acceleration_m_s2"].values())
        assert not (out / line["recording"]).exists()
    assert "cannot be written" in daemon.said and "Traceback" not in daemon.said
