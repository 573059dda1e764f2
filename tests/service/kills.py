"""Campaign of kills: a site whose monitors are cut off at every operation, taken over, restored and copied, in one process.

    .venv/bin/python -m tests.service.kills [KILLS] [FOLDER]

goes on where it stopped: each story, by its seed, is a line of FOLDER/stories.jsonl.  In a story the monitors of one site live
through sixty hops of data, in which an alarm comes and goes twice; one in three has no object storage.  The points at which they
are cut off are those that were hit least.  At the end it prints a table.
"""

from __future__ import annotations

import json
import logging
import shutil
import tempfile
import time
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from threadpoolctl import threadpool_limits

from monitor.core import InUseError, UserError
from tests.service.lives import Monitor, Undisturbed, World, undisturbed
from tests.support.campaign import words
from tests.support.cut_disk import Plan

LEAST = 20
"""Kills at each point."""
_DEEDS = 60
"""Most that happens in a story."""
_MEMORY = Path("/dev/shm")
"""Disk in memory, where there is one: what an fsync confirms is counted, not waited for."""

Row = dict[str, Any]


class Story:
    """One site's life; the points that were hit least are chosen: `hits` counts kills by point, `seen` has points by stage."""

    def __init__(
        self,
        folder: Path,
        stream: Undisturbed,
        seed: int,
        hits: Counter[str],
        seen: dict[str, set[str]],
    ) -> None:
        shutil.copy(stream.folder / "baseline.json", folder / "baseline.json")
        self.world = World(folder, stream, seed, with_store=seed % 3 != 0)
        self.chance, self.hits, self.seen = self.world.chance, Counter(hits), seen
        self.counted: Counter[str] = Counter()
        self.at = "a"
        """Machine that has the site."""
        self.backups = 0
        self.deeds = (self.kill,) * 10 + (self.end, self.back_up, self.restore)
        if self.world.with_store:
            self.deeds += (self.take_over, self.take_over, self.wake, self.restore, self.copy, self.away)

    def run(self) -> Row:
        """Live through the story; say what was counted, and what is wrong."""
        world = self.world
        with world.disk.watched():
            for _ in range(_DEEDS):
                if self.is_over:
                    break
                if world.with_store:
                    world.bucket.unsure = self.chance.choice([0.0, 0.0, 0.1])
                self.chance.choice(self.deeds)()
            world.finish(self.at)
        return {
            "kills": dict(world.kills),
            "tally": dict(world.tally),
            "receivers": dict(world.people.met),
            "faults": world.faults,
        }

    @property
    def is_over(self) -> bool:
        """Whether the windows of the stream are nearly all written."""
        file = self.world.folder / self.at / "out" / "results.jsonl"
        return file.exists() and file.read_bytes().count(b"\n") >= self.world.stream.results.count(b"\n") - 1

    def kill(self, stage: str | None = None) -> None:
        """Cut a life off at a point that was hit less than `LEAST` times, or anywhere."""
        has_begun = (self.world.folder / self.at / "out" / "results.jsonl").exists()
        stage = stage or ("again" if has_begun else "first")
        if stage == "again" and self.chance.random() < 0.2:
            stage = "end"
        often = frozenset(point for point, n in self.hits.items() if n >= LEAST)
        how = self.chance.choice(["before", "after", "half"])
        plan = Plan(often, self.chance.choice([1, 1, 2, 4, 8]), how)
        if self.chance.random() < 0.1:
            plan = Plan(frozenset(), self.chance.randint(1, 400), how)
        hops = self.chance.randint(0, 5)
        before = Counter(self.world.points)
        self.world.live(self.at, plan, hops, "ended" if stage == "end" else "killed")
        self.seen[stage] = self.seen.get(stage, set()) | {
            point for point, n in self.world.points.items() if n > before[point]
        }
        fresh = self.world.kills - self.counted
        self.counted = Counter(self.world.kills)
        self.hits += fresh

    def end(self) -> None:
        """Let a life end as it should."""
        self.world.live(self.at, None, self.chance.randint(0, 5), "ended")

    def take_over(self) -> None:
        """Have the other machine go on, after one that was killed, or ended."""
        if self.chance.random() < 0.3:
            self.end()
        else:
            self.kill()
        self.at = "b" if self.at == "a" else "a"
        self.world.tally["takeovers"] += 1
        self.kill("takeover")

    def wake(self) -> None:
        """Have the other machine go on while one is stopped, which then wakes: it has to learn of it before it writes there."""
        self.world.bucket.unsure = 0.0
        stopped = self._left()
        if stopped is None:
            return
        self.at = "b" if self.at == "a" else "a"
        heir = self._left()
        assert heir is not None
        self.world.tally["takeovers"] += 1
        self.world.tally["monitors that woke after a takeover"] += 1
        for _ in range(2):
            try:
                if not stopped.give():
                    stopped.rest()
            except UserError:
                self.world.tally["of these told that they lost the site"] += 1
                break
        else:
            self.world.faults.append("two writers: one that was taken over was not told")
        stopped.close()
        self._go_on(heir)

    def restore(self) -> None:
        """Have the folder be an older one of this site, and go on."""
        if not self.backups or not self.world.with_store:
            self.back_up()
            return
        self.world.restore(self.at, f"backup-{self.chance.randrange(self.backups)}")
        self.world.tally["restores"] += 1
        self.kill("takeover")

    def back_up(self) -> None:
        """Copy the folder while a monitor is at work."""
        monitor = self._left()
        if monitor is not None:
            self.world.back_up(self.at, f"backup-{self.backups}")
            self.backups += 1
            self._go_on(monitor)

    def copy(self) -> None:
        """Begin a second monitor on a copy of the folder, or on the folder itself, while one is at work."""
        self.world.bucket.unsure = 0.0
        monitor = self._left()
        if monitor is None:
            return
        place = self.at
        if self.chance.random() < 0.9:
            self.world.machine(place := "copy")
            self.world.back_up(self.at, "copy/out")
        self.world.tally["second monitors"] += 1
        second = Monitor(self.world, place)
        try:
            second.begin(wait=False)
            self.world.faults.append("two writers: a second one began")
        except InUseError:
            self.world.tally["of these refused"] += 1
        second.bury()
        self.world.disk.begin(monitor.life)
        self._go_on(monitor)

    def away(self) -> None:
        """Have the storage be away for a while, in which a monitor may be killed and begin again."""
        self.world.bucket.away = True
        self.world.tally["times without the storage"] += 1
        try:
            for _ in range(2):
                self.kill()
        finally:
            self.world.bucket.away = False

    def _left(self) -> Monitor | None:
        return self.world.live(self.at, None, self.chance.randint(1, 3), "left")

    def _go_on(self, monitor: Monitor) -> None:
        """Let a monitor live on for a while, then kill it."""
        try:
            for _ in range(self.chance.randint(0, 3)):
                monitor.give()
        except UserError as error:
            self.world.tally[f"ended by {type(error).__name__}"] += 1
        self.world.die(monitor)


def campaign(seeds: Iterable[int], rows: list[Row], most_kills: int = 10**9, file: Path | None = None) -> list[Row]:
    """Live through stories until there were so many kills, each point often enough; `rows` are those of before."""
    stream = undisturbed()
    hits, seen = hits_of(rows), dict[str, set[str]]()
    for row in rows:
        for stage, points in row["seen"].items():
            seen.setdefault(stage, set()).update(points)
    done = {row["seed"] for row in rows}
    for seed in seeds:
        points = {point for points in seen.values() for point in points}
        is_even = all(hits[point] >= LEAST for point in points)
        if hits.total() >= most_kills and (is_even or hits.total() >= 2 * most_kills):
            break
        if seed in done:
            continue
        begun_s = time.monotonic()
        with tempfile.TemporaryDirectory(prefix="shm-story-", dir=_MEMORY if _MEMORY.is_dir() else None) as folder:
            row = {"seed": seed, **Story(Path(folder), stream, seed, hits, seen).run()}
        row |= {"seen": {stage: sorted(points) for stage, points in seen.items()}}
        row["seconds"] = round(time.monotonic() - begun_s, 1)
        hits.update(row["kills"])
        rows.append(row)
        if file is not None:
            with file.open("a") as target:
                target.write(json.dumps(row) + "\n")
            print(
                f"{seed}: {sum(row['kills'].values())} kills, {row['seconds']} s, {row['faults'] or 'nothing wrong'}",
                flush=True,
            )
    return rows


def hits_of(rows: list[Row]) -> Counter[str]:
    """Count the kills at each point that was reached, 0 where nothing was killed."""
    hits = Counter({point: 0 for row in rows for points in row["seen"].values() for point in points})
    for row in rows:
        hits.update(row["kills"])
    return hits


def table(rows: list[Row]) -> str:
    """What came of the stories."""
    kills, tally, met, faults = hits_of(rows), Counter[str](), Counter[str](), Counter[str]()
    for row in rows:
        tally.update(row["tally"])
        met.update(row["receivers"])
        faults.update(row["faults"])
    often = sum(count >= LEAST for count in kills.values())
    lines = [
        f"{len(rows)} stories, {kills.total()} kills; {often} of {len(kills)} points were hit {LEAST} times or more"
    ]
    lines += [f"  {count:5d}  {point}" for point, count in sorted(kills.items(), key=lambda item: -item[1])]
    lines += ["counted:", *(f"  {count:5d}  {what}" for what, count in sorted(tally.items()))]
    lines += ["deliveries, by what the receiver did:", *(f"  {n:5d}  {what}" for what, n in sorted(met.items()))]
    lines += ["wrong:", *(f"  {n:5d}  {what}" for what, n in faults.most_common())] if faults else ["wrong: nothing"]
    return "\n".join(lines)


def main() -> None:
    most, folder = words(2000, "out/kills")
    logging.disable(logging.CRITICAL)
    file = Path(folder) / "stories.jsonl"
    file.parent.mkdir(parents=True, exist_ok=True)
    rows = [json.loads(line) for line in file.read_text().splitlines()] if file.exists() else []
    with threadpool_limits(limits=1):
        rows = campaign(range(10**6), rows, most, file)
    print(table(rows))


if __name__ == "__main__":
    main()
