"""Monitors of one site on several machines that are killed, taken over, restored and copied, in one process on one clock.

A `World` has machines with folders, object storage, people who read messages, and a stream that keeps its samples until they are
processed.  So, whatever happens, `results.jsonl` has to end as that of a monitor that nobody disturbed, byte for byte, and people
have to hear of the same alarms; `World.faults` lists what is otherwise.
"""

from __future__ import annotations

import functools
import json
import random
import re
import shutil
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drivers.base import ACCELERATION, EndOfStream, SampleBlock, SourceHealth
from monitor.config import configuration
from monitor.core import UserError, Worker
from monitor.damage import save_baseline
from monitor.model import simulate
from monitor.pipeline import Pipeline
from monitor.runs import cut_into_blocks
from monitor.service.outlets.delivery_workers import Deliveries
from monitor.service.outlets.notify import Addresses, Notifier, NotifySettings
from monitor.service.site import Site
from monitor.service.site_store import SiteStore
from tests.service import bucket
from tests.service.bucket import Clock, exceptions
from tests.support.cut_disk import CutDisk, Killed, Life, Plan
from tests.support.samples import CHANNELS, FRAME, T0_NS
from tests.support.simulated import learned, windows_of

RATE, HOP_S, EVERY_S = 128.0, 5.0, 5.0
HONEST, LIAR = "json://honest/", "json://liar/"
SITE = (
    """
[site]
name = "tower"
baseline = "../baseline.json"
[source]
kind = "mcap"
files = ["none.mcap"]
[output]
dir = "out"
[recorder]
min_free_gb = 0.0
flush_s = 1.0
file_s = 60.0
[watch]
diagnose = false
[state]
checkpoint_s = 15.0
history = false
[alarm]

[refinement]
enabled = false
"""
    + FRAME
)
_TOLD = re.compile(r"site tower, message (\d+)$")
_EARLIER = re.compile(r"superseded by this: (.*)")
_ALARM = re.compile(r"(advisory|warning|alarm|cleared): ")


class People:
    """Whoever reads the messages at an address, behind a receiver that may not do what it says."""

    HONEST = ("takes",) * 4 + ("hangs", "keeps and hangs", "refuses", "keeps and refuses", "redirects", "restarts")
    """Ways of a receiver that never says that it took what it did not keep."""
    LIAR = (*HONEST, "takes and forgets", "takes and forgets")

    def __init__(self, chance: random.Random) -> None:
        self.chance, self.ways = chance, {HONEST: self.HONEST, LIAR: self.LIAR}
        self.heard: dict[str, list[tuple[int, str, tuple[str, ...]]]] = {HONEST: [], LIAR: []}
        """Of each message, as often as it came: its number, its title, and the titles of those before that it stands for."""
        self.met: Counter[str] = Counter()

    def answer(self, job: Mapping[str, Any]) -> str:
        """Take a message, or not, and say what the receiver does."""
        url = job["url"]
        way = self.chance.choice(self.ways[url])
        self.met[way] += 1
        if way.startswith(("takes", "keeps")) and way != "takes and forgets":
            number = _TOLD.search(job["body"])
            earlier = _EARLIER.search(job["body"])
            titles: list[str] = []
            for told in earlier[1].split("; ") if earlier else ():
                count, _, title = told.partition(" x ") if re.match(r"\d+ x ", told) else ("1", "", told)
                titles += [title] * int(count)
            assert number is not None
            self.heard[url].append((int(number[1]), job["title"].removeprefix("[tower] "), tuple(titles)))
        return way


class Post:
    """Delivers the messages of a life to people."""

    def __init__(self, disk: CutDisk, life: Life, people: People) -> None:
        self._disk, self._life, self._people = disk, life, people

    def run(self, job: Mapping[str, Any]) -> int | None:
        if self._disk.operate(self._life, "delivery begins", lambda: True) is None:
            return None
        way = self._people.answer(job)
        if self._disk.operate(self._life, "delivery ends", lambda: True) is None:
            return None
        return 0 if way.startswith("takes") else -14 if "hangs" in way else 1

    def stop(self) -> None: ...


class Bucket(bucket.Bucket):
    """Object storage of all machines; it notes who wrote the manifest, and that what it has of the results only grows."""

    def __init__(self, results: bytes, chance: random.Random) -> None:
        super().__init__()
        self.away, self.unsure = False, 0.0
        self.owners: list[str] = []
        self.faults: list[str] = []
        self._results, self._most, self._chance = results, 0, chance

    def client(self, disk: CutDisk, life: Life) -> Client:
        return Client(self, disk, life)

    def may_fail(self) -> None:
        if self.away or self._chance.random() < self.unsure:
            raise exceptions.ReadTimeoutError(endpoint_url="s3")

    def put_object(self, **what: Any) -> dict[str, Any]:
        answer = super().put_object(**what)
        self.note(what["Key"])
        return answer

    def note(self, key: str) -> None:
        """Look at a manifest that was written."""
        if not key.endswith("manifest.json"):
            return
        manifest = json.loads(self.objects[key])
        if manifest["owner"] in self.owners[:-1]:
            self.faults.append("two writers: one that had lost the site wrote again")
        elif manifest["owner"] not in self.owners:
            self.owners.append(manifest["owner"])
        folder = key.rpartition("/")[0]
        parts = manifest["files"].get("results.jsonl", {"parts": []})["parts"]
        try:
            stored = b"".join(self.objects[f"{folder}/{name}"][first : first + n] for name, first, n in parts)
        except KeyError:
            self.faults.append("an object that the manifest names is gone")
            return
        if not self._results.startswith(stored):
            self.faults.append("the storage has lines that nobody should have written")
        if len(stored) < self._most:
            self.faults.append(f"the storage lost {self._most - len(stored)} bytes of the results that it had")
        self._most = max(self._most, len(stored))


class Client:
    """What a life sees of the storage."""

    exceptions = bucket.Bucket.exceptions

    def __init__(self, storage: Bucket, disk: CutDisk, life: Life) -> None:
        self._bucket, self._disk, self._life = storage, disk, life

    def _do(self, what: str, key: str, work: Callable[[], Any]) -> Any:
        def answer() -> Any:
            try:
                return work()
            except exceptions.ClientError as error:
                return error

        self._bucket.may_fail()
        kind = "manifest" if key.endswith("manifest.json") else "object"
        result = self._disk.operate(self._life, f"{what} {kind}", answer)
        if self._life.dead and result is None:
            raise exceptions.EndpointConnectionError(endpoint_url="s3")
        self._bucket.may_fail()
        if isinstance(result, Exception):
            raise result
        return result

    def get_object(self, **what: Any) -> Any:
        return self._do("GET", what["Key"], lambda: self._bucket.get_object(**what))

    def put_object(self, **what: Any) -> Any:
        return self._do("PUT", what["Key"], lambda: self._bucket.put_object(**what))

    def delete_object(self, **what: Any) -> Any:
        return self._do("DELETE", what["Key"], lambda: self._bucket.delete_object(**what))

    def get_paginator(self, _: str) -> Client:
        return self

    def paginate(self, **what: Any) -> Iterator[dict[str, Any]]:
        yield from self._do("LIST", what["Prefix"], lambda: [*self._bucket.paginate(**what)])


class Quiet:
    """Source that is open and gives nothing: the test gives the blocks."""

    def __init__(self) -> None:
        self.at_end = False

    def open(self) -> None: ...

    def read(self, timeout_s: float) -> SampleBlock | None:
        if self.at_end:
            raise EndOfStream
        return None

    def health(self) -> SourceHealth:
        return SourceHealth(True, {})

    def close(self) -> None: ...


@dataclass(frozen=True)
class Undisturbed:
    """A stream in which story 2 softens and recovers, its baseline, and what a monitor that nobody disturbs makes of it."""

    folder: Path
    blocks: tuple[SampleBlock, ...]
    results: bytes = b""
    alarms: tuple[str, ...] = ()


@functools.cache
def undisturbed() -> Undisturbed:
    folder = Path(tempfile.mkdtemp(prefix="shm-lives-"))
    (folder / "a").mkdir()
    models = []
    for text in (SITE, SITE.replace("1514.8507", "900.0")):
        (folder / "a" / "site.toml").write_text(text)
        models.append(configuration.load(folder / "a" / "site.toml").model())
    (folder / "a" / "site.toml").write_text(SITE)
    healthy, weak = (
        simulate(model, duration_s=400.0 - 300.0 * k, rate_hz=RATE, noise=0.03, seed=6 + k).floors
        for k, model in enumerate(models)
    )
    n = round(60 * RATE)
    stream = np.concatenate([healthy[:n], weak[:n], healthy[n : 2 * n], weak[-n:], healthy[2 * n : 3 * n]])
    size = round(HOP_S * RATE)
    blocks = tuple(cut_into_blocks(ACCELERATION, stream, CHANNELS, RATE, T0_NS, size))
    settings = configuration.load(folder / "a" / "site.toml")
    seen = windows_of(Pipeline(settings), healthy, RATE)
    save_baseline(learned(settings, seen, span_ns=(0, 400 * 10**9)), folder / "baseline.json")
    calm = World(folder, Undisturbed(folder, blocks), 0, with_store=False)
    calm.people.ways = {HONEST: ("takes",), LIAR: ("takes",)}
    with calm.disk.watched():
        calm.finish()
    alarms = tuple(title for _, title, _ in calm.people.heard[HONEST] if _ALARM.match(title))
    return Undisturbed(folder, blocks, (folder / "a" / "out" / "results.jsonl").read_bytes(), alarms)


class Monitor:
    """One life of the site's monitor on a machine, whose workers do by hand what is due, in any order."""

    def __init__(self, world: World, machine: str, plan: Plan | None = None) -> None:
        self.world, self.machine = world, machine
        self.life = Life(world.folder / machine / "out", plan)
        self.source = Quiet()
        self.workers: list[Worker[Any]] = []
        self.site: Site | None = None
        world.disk.begin(self.life)

    def begin(self, *, wait: bool = True) -> Monitor:
        """Begin to monitor; of another monitor that is at work it is waited until that is known, or not."""
        world, life = self.world, self.life
        folder = life.folder.parent
        deliveries = Deliveries(lambda: Post(world.disk, life, world.people), resend_s=(1.0, 4.0))
        settings = NotifySettings(source_lost_s=1e9, blind_s=1e9, most_per_hour=10**6)
        place = life.folder / "state" / "people.jsonl"
        with self.by_hand():
            store = self._store() if world.with_store else None
            keep = (lambda: None) if store is None else functools.partial(store.settle, 0.5)
            to = Addresses((HONEST, LIAR))
            notifier = Notifier("tower", settings, to, place, world.clock, deliveries, keep)
            self.site = Site(
                folder / "site.toml",
                self.source,
                [notifier],
                clock=world.clock,
                warm=lambda *_: None,
                lean=not wait,
                store=store,
            )
            self.site.start()
        return self

    @contextmanager
    def by_hand(self) -> Iterator[None]:
        """Have the workers that are made meanwhile be this life's."""
        with Worker.by_hand(self.world.clock) as hand:
            hand.workers = self.workers
            yield

    def _store(self) -> SiteStore:
        client = Client(self.world.bucket, self.world.disk, self.life)
        clock, url = self.world.clock, "s3://bucket/city"
        return SiteStore(url, "tower", self.life.folder, EVERY_S, clock=clock, client=lambda: client, sleep=clock.sleep)

    def work(self, most: int) -> None:
        """Have workers do what is due, in any order; what is left is done later."""
        for _ in range(most):
            due = [worker for worker in self.workers if worker.name != "source" and worker.due_in_s <= 0.0]
            if not due:
                return
            self.world.chance.choice(due).step()

    def give(self) -> bool:
        """Give the next block, and now and then some before it again; return whether there was one."""
        assert self.site is not None
        blocks, chance, clock = self.world.stream.blocks, self.world.chance, self.world.clock
        now_ns = self.site.session.now_ns
        done = round((now_ns - T0_NS) * 1e-9 / HOP_S) if now_ns else 0
        if done >= len(blocks):
            return False
        with self.by_hand():
            for block in blocks[max(0, done - chance.choice([0, 0, 0, 1, 3])) : done + 1]:
                self.site.take(block, clock())
                self.work(chance.choice([0, 1, 3, 10]))
            for _ in range(5):
                clock.now_s += HOP_S / 5
                self.site.step(clock())
                self.work(chance.choice([0, 3, 10, 100]))
        return True

    def rest(self) -> None:
        """Let a while pass without data."""
        assert self.site is not None
        with self.by_hand():
            for _ in range(5):
                self.world.clock.now_s += HOP_S / 5
                self.site.step(self.world.clock())
                self.work(100)

    def close(self) -> None:
        """End after an error, as a daemon does."""
        assert self.site is not None
        self.source.at_end = True
        self.site.close()
        self.world.disk.end(self.life)

    def end(self, *, at_end: bool = False) -> None:
        """End as after SIGTERM, or after the last sample."""
        assert self.site is not None
        self.source.at_end = at_end
        if at_end:
            for worker in self.workers:
                while worker.name == "source" and worker.step():
                    continue
        else:
            self.site.ask_to_stop()
            self.site.stop_reading()
        self.site.finish()
        self.site.close()
        self.world.disk.end(self.life)

    def bury(self) -> None:
        """Close what a life that was cut off held; nothing of it is heard."""
        self.life.dead, self.source.at_end = True, True
        if self.site is not None:
            with suppress(Exception):
                self.site.close()
        self.world.disk.end(self.life)


class World:
    """Machines, storage, people and the stream of a site; `chance` draws all that is left to it."""

    def __init__(self, folder: Path, stream: Undisturbed, seed: int, *, with_store: bool) -> None:
        self.folder, self.stream, self.with_store = folder, stream, with_store
        self.chance, self.clock = random.Random(seed), Clock()
        self.disk = CutDisk(folder / "limbo")
        self.people = People(self.chance)
        self.bucket = Bucket(stream.results, self.chance)
        self.tally: Counter[str] = Counter()
        self.points: Counter[str] = Counter()
        self.kills: Counter[str] = Counter()
        self.faults: list[str] = []

    def machine(self, name: str) -> Path:
        """A machine's folder, with the site's file."""
        place = self.folder / name
        place.mkdir(exist_ok=True)
        (place / "site.toml").write_text(SITE)
        return place

    def live(self, machine: str, plan: Plan | None, hops: int, then: str) -> Monitor | None:
        """Let a monitor live on a machine until it is cut off, or for so many hops, and end then: ``killed``, ``ended``.

        With ``left`` it goes on, and is returned.
        """
        self.machine(machine)
        monitor = Monitor(self, machine, plan)
        try:
            monitor.begin()
            for _ in range(hops):
                if not monitor.give():
                    break
            if then == "left":
                return monitor
            if then == "ended":
                monitor.end()
                self._count(monitor.life, None)
                return None
        except Killed as end:
            assert monitor.life.died_at == str(end)
        except UserError as error:
            self._refused(monitor, error)
            return None
        self.die(monitor)
        return None

    def _refused(self, monitor: Monitor, error: UserError) -> None:
        """Close a monitor that does not begin, or ends, because another may have the site or nobody knows."""
        self.tally[f"ended by {type(error).__name__}"] += 1
        self._count(monitor.life, None)
        monitor.bury()

    def die(self, monitor: Monitor) -> None:
        """Bury a life, and cut the power of its machine in every second case."""
        monitor.bury()
        is_power = self.chance.random() < 0.5
        if is_power:
            self.disk.power_cut(monitor.life.folder, self.chance)
        self._count(monitor.life, "power cut" if is_power else "kill -9")

    def _count(self, life: Life, death: str | None) -> None:
        self.points.update(life.seen)
        if death is not None:
            self.tally[death] += 1
            self.kills[life.died_at or "between two operations"] += 1

    def finish(self, machine: str = "a") -> None:
        """Let a monitor process the rest of the stream, and all messages be taken; then look what is wrong."""
        self.machine(machine)
        self.bucket.away, self.bucket.unsure = False, 0.0
        self.people.ways = {HONEST: ("takes",), LIAR: ("takes",)}
        last = Monitor(self, machine).begin()
        while last.give():
            continue
        for _ in range(3):
            self.clock.now_s += HOP_S
            last.work(10**6)
        last.end(at_end=True)
        self._count(last.life, None)
        if self.stream.results:
            self._look(last.life.folder)

    def _look(self, out: Path) -> None:
        """Compare the folder of the last monitor, and what people heard, with what should have been."""
        self.faults += self.bucket.faults
        found, wanted = ((out / "results.jsonl").read_bytes().splitlines(), self.stream.results.splitlines())
        counts, due = Counter(found), Counter(wanted)
        if lost := due - counts:
            self.faults.append(f"{sum(lost.values())} lines are lost")
        if doubled := counts - due:
            kinds = "doubled" if doubled.keys() <= due.keys() else "other"
            windows = [json.loads(line)["window"] for line in doubled]
            self.faults.append(f"{sum(doubled.values())} lines are {kinds}: windows {windows}")
        elif not lost and found != wanted:
            self.faults.append("lines are out of order")
        self.tally["lines"] += len(due)
        heard = self.people.heard[HONEST]
        words: dict[int, set[str]] = {}
        for number, title, _ in heard:
            words.setdefault(number, set()).add(title)
        for number, titles in words.items():
            if len(titles) > 1:
                self.faults.append(f"message {number} came with other words: {sorted(titles)}")
        numbered = Counter(title for titles in words.values() for title in titles if _ALARM.match(title))
        mentioned = Counter(title for _, _, earlier in set(heard) for title in earlier if _ALARM.match(title))
        alarms = Counter(self.stream.alarms)
        for title, count in (alarms - (numbered + mentioned)).items():
            self.faults.append(f"{count} of {alarms[title]} times nobody heard {title!r}")
        for title, count in (numbered - alarms).items():
            self.faults.append(f"{count} times {title!r} came again with another number")
        self.tally["alarms"] += sum(alarms.values())
        self.tally["alarms told by a later one"] += sum((alarms - numbered).values())
        self.tally["messages that came again, with their number"] += len(heard) - len(words)
        waiting = (out / "state" / "people.jsonl").read_text().splitlines()[1:]
        if waiting:
            self.faults.append(f"{len(waiting)} messages still wait")

    def back_up(self, machine: str, name: str) -> None:
        """Copy the folder of a machine as it is."""
        shutil.rmtree(self.folder / name, ignore_errors=True)
        shutil.copytree(self.folder / machine / "out", self.folder / name)

    def restore(self, machine: str, name: str) -> None:
        """Have a machine's folder be what was copied."""
        self.disk.replaced(self.folder / machine / "out")
        shutil.rmtree(self.folder / machine / "out", ignore_errors=True)
        shutil.copytree(self.folder / name, self.folder / machine / "out")
