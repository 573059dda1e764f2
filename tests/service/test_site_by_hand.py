"""A site without threads, driven by hand: all that a run does, in one thread and in an order that is the same each time."""

from __future__ import annotations

import threading
from pathlib import Path

import numpy as np

from drivers.base import SampleBlock
from monitor.core import Worker
from monitor.service.site import Site
from tests.support.samples import Cli, Cut
from tests.support.site import RATE, Scripted, lines, own, replayed, site, summary  # noqa: F401 - a fixture


def driven(path: Path, blocks: list[SampleBlock], enough: int | None = None) -> list[str]:
    """Drive a site, one piece of the workers' work after each block, until its source ends or so many windows came.

    Returned are the names of the threads that it began.
    """
    before, seconds = set(threading.enumerate()), [0.0]
    clock = lambda: seconds[0]  # noqa: E731
    with Worker.by_hand(clock) as hand:
        run = Site(path, Scripted(blocks), warm=lambda *_: None, clock=clock)
        run.start()
        while not run.reader.queue.over:
            hand.step()
            item = run.reader.queue.take(0.0)
            if item is not None:
                run.take(*item)
                seconds[0] += item[0].n_samples / item[0].sample_rate_hz
            run.step(seconds[0])
            if run.session.windows == enough:
                run.ask_to_stop()
                run.stop_reading()
                break
        run.finish()
        run.close()
        run.raise_failure()
    return [thread.name for thread in threading.enumerate() if thread not in before]


def test_a_site_by_hand_writes_what_a_replay_writes_and_goes_on_where_it_ended(
    site: Path,  # noqa: F811
    record: np.ndarray,
    cut: Cut,
    main: Cli,
) -> None:
    out, blocks = site.parent / "out", cut(record, RATE)
    assert driven(site, blocks, enough=4) == []
    assert len(lines(out)) == 4
    given = summary(out)["quality"]["samples"]
    assert driven(site, blocks) == []
    assert len(lines(out)) == 9 and summary(out)["quality"]["samples"] > given
    assert replayed(main, site, own(out), site.parent / "again") == (out / "results.jsonl").read_bytes()
