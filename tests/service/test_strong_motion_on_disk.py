"""Strong motion is on the disk while it goes on: a kill at any pace costs none of its beginning."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from drivers.base import ACCELERATION, SampleBlock
from drivers.recorder import recorded
from tests.events.shaken import T0_NS, blocks
from tests.support.quake import shaken
from tests.support.shaken_site import SITE
from tests.support.site import Daemon, Scripted
from tests.support.waiting import until


def test_a_quake_is_on_the_disk_while_it_goes_on_however_seldom_the_rest_is_written(tmp_path: Path) -> None:
    """Data as fast as they are evaluated; the quake begins at 80 s."""
    (tmp_path / "site.toml").write_text(SITE.replace("enabled = false", "min_free_gb = 0.0\nflush_s = 1e5"))
    folder, on_disk_s = tmp_path / "out" / "recordings", list[float]()

    def latest_s() -> float:
        found = recorded(folder, 0, unfinished=True)
        return max(((b.t_ns - T0_NS) * 1e-9 + b.length_s for _, b in found if b.topic == ACCELERATION), default=0.0)

    def script() -> Iterator[SampleBlock]:
        for block in blocks(shaken(), with_ground=False, n=100):
            begin_s = (block.t_ns - T0_NS) * 1e-9
            if begin_s == 88.0:
                until(lambda: latest_s() >= 88.0, "what came of the quake is on the disk", 5.0)
                on_disk_s.append(latest_s())
                return
            yield block

    Daemon(tmp_path / "site.toml", Scripted(script()), tick_s=0.01).run()
    assert on_disk_s == [88.0]
