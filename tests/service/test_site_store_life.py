"""Three machines, one site in object storage, and all that may happen to them, in a time of its own: seeded runs of a model.

Folders are copied and restored in part, storage fails, answers late or with an older state, and machines stop, also in the middle
of a call, while the others go on.
"""

from __future__ import annotations

import json
import os
import random
import shutil
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

from monitor.core import InUseError, MissingInputError
from tests.support.bucket import MANIFEST, Bucket, Clock, Machine, exceptions, no_failure

EVERY_S = 5.0
PARTS = [".", "state", "recordings", "results.jsonl", "state/checkpoint"]


class World:
    """The machines `a`, `b` and `c`, their folders and backups, and the bucket; `step` has something happen."""

    def __init__(self, folder: Path, seed: int) -> None:
        self.chance, self.folder, self.clock, self.bucket = random.Random(seed), folder, Clock(), Bucket()
        self.machines = {name: Machine(folder / name, self.bucket, self.clock, every_s=EVERY_S) for name in "abc"}
        self.running: dict[str, Machine] = {}
        self.busy: list[str] = []
        self.backups: list[Path] = []
        self.committed: set[bytes] = set()
        """Lines and recordings that a manifest ever named."""
        self.latest: set[bytes] = set()
        """What the latest manifest named."""
        self.excused: set[bytes] = set()
        """What somebody took away, until it is stored again."""
        self.removed: set[bytes] = set()
        """What a monitor removed, whose budget was full."""
        self.certain_s = 0.0
        """Until when two may believe to have the site, since somebody emptied the bucket."""
        self.count = 0
        self.log: list[str] = []

    def step(self) -> None:
        """Have something happen, with a storage that fails now and then."""
        with self.faults():
            self.act()
        self.check()

    def act(self) -> None:
        """Have one thing happen."""
        free = [name for name in self.machines if name not in self.busy]
        if not free:
            return
        name, kind = self.chance.choice(free), self.chance.random()
        with self.occupied(name):
            if name in self.running:
                self.act_on_running(name, self.running[name], kind)
            elif kind < 0.4:
                self.start(name)
            elif kind < 0.7 and self.backups:
                self.restore(name)
            else:
                self.clock.sleep(self.chance.uniform(0.0, 6.0))

    def act_on_running(self, name: str, one: Machine, kind: float) -> None:
        if one.store.lost is not None or kind < 0.07:
            self.log.append(f"{name} ends ({one.store.lost})")
            if kind < 0.03 or (one.store.lost is not None and self.chance.random() < 0.5):
                one.close()
            del self.running[name]
        elif kind < 0.35:
            self.work(one)
        elif kind < 0.6:
            one.push()
        elif kind < 0.75:
            one.renew()
        elif kind < 0.8:
            self.back_up(name)
        elif kind < 0.84:
            for path in sorted((one.folder / "recordings").glob("*"))[:1]:
                self.removed.add(path.read_bytes())
                path.unlink()
        elif kind < 0.845:
            self.log.append("emptied")
            self.bucket.objects.clear()
            self.latest = set()
            self.excused |= self.committed - self.everywhere()
            self.certain_s = self.clock.now_s + 4 * EVERY_S
        else:
            self.clock.sleep(self.chance.uniform(0.0, 6.0))

    def work(self, one: Machine) -> None:
        """Write as a monitor does: what is new first, then the checkpoint."""
        self.count += 1
        path = one.folder / "results.jsonl"
        if self.chance.random() < 0.5:
            with path.open("ab") as file:
                file.write(b"line %d\n" % self.count)
        else:
            one.write(f"recordings/{self.count}.mcap", b"record %d\n" % self.count)
        one.write("state/checkpoint", b"%09d" % (path.stat().st_size if path.exists() else 0))

    def start(self, name: str) -> None:
        one = self.machines[name] = Machine(self.folder / name, self.bucket, self.clock, every_s=EVERY_S)
        try:
            self.running[name] = one.open(wait=self.chance.random() < 0.3)
            self.log.append(f"{name} starts, {one.store.failed}")
        except (InUseError, MissingInputError) as error:
            self.running.pop(name, None)
            self.log.append(f"{name} does not start: {error}")

    def back_up(self, name: str) -> None:
        """Copy the folder of a machine that may be at work."""
        self.log.append(f"backup of {name}")
        self.backups.append(self.folder / f"backup-{len(self.backups)}")
        shutil.copytree(self.folder / name, self.backups[-1])

    def restore(self, name: str) -> None:
        """Have a folder be, all of it or in a part, what it or another one was."""
        part, backup = self.chance.choice(PARTS), self.chance.choice(self.backups[-2:])
        source, target = backup / part, self.folder / name / part
        self.log.append(f"{part} of {name} restored from {backup.name}")
        if target.is_dir():
            shutil.rmtree(target)
        target.unlink(missing_ok=True)
        if source.exists():
            shutil.copytree(source, target) if source.is_dir() else shutil.copy2(source, target)
        self.excused |= self.committed - self.everywhere()
        (self.folder / name / "state").mkdir(parents=True, exist_ok=True)
        (self.folder / name / "state" / "lock").touch()

    @contextmanager
    def occupied(self, name: str) -> Iterator[None]:
        """A machine does one thing at a time, also while it is stopped in the middle of it."""
        self.busy.append(name)
        try:
            yield
        finally:
            self.busy.remove(name)

    @contextmanager
    def faults(self) -> Iterator[None]:
        """A storage that fails, is away, or answers with what was, and machines that stop in the middle of a call."""
        kind = self.chance.choices(["well", "errors", "away", "stale"], [6, 3, 1, 1])[0]
        self.bucket.is_stale = lambda name: kind == "stale" and self.chance.random() < 0.5

        def fail(call: str, is_done: bool) -> None:
            if is_done:
                self.look(call)
            if len(self.busy) < 3 and self.chance.random() < 0.03:
                self.log.append(f"{self.busy[-1]} stops in a {call}")
                for _ in range(self.chance.randrange(12)):
                    self.clock.sleep(self.chance.uniform(0.0, 6.0))
                    self.act()
            if kind == "away" or (kind == "errors" and self.chance.random() < 0.3):
                raise exceptions.ReadTimeoutError(endpoint_url="s3")

        self.bucket.fail = fail
        try:
            yield
        finally:
            self.bucket.fail = no_failure

    def look(self, call: str) -> None:
        """Look at the storage after a call: what the manifest names is there."""
        stored = self.stored()
        self.committed |= stored
        self.excused -= stored - self.latest
        self.latest = stored

    def stored(self) -> set[bytes]:
        """Give what the manifest names; all of it must be there as it was stored."""
        if MANIFEST not in self.bucket.objects:
            return set()
        found: set[bytes] = set()
        for name, file in json.loads(self.bucket.objects[MANIFEST])["files"].items():
            spans = [
                (self.bucket.objects[f"city/tower/{key}"], offset, length) for key, offset, length in file["parts"]
            ]
            data = b"".join(whole[offset : offset + length] for whole, offset, length in spans)
            assert zlib.crc32(data) == file["crc32"], (name, self.log)
            if not name.startswith("state/"):
                found |= {*data.splitlines(keepends=True)}
        return found

    def everywhere(self) -> set[bytes]:
        """Give what the storage has, and what was put aside."""
        return self.stored().union(*(tokens(self.folder / name / "superseded") for name in self.machines))

    def check(self) -> None:
        """Nothing that was ever stored is lost, and of all who monitor the site one at most has nothing to say against it."""
        if self.chance.random() < 0.2:
            lost = self.committed - self.everywhere() - self.excused - self.removed
            assert not lost, (lost, self.log)
        sure = [name for name, one in self.running.items() if one.store.failed is None and name not in self.busy]
        assert len(sure) <= 1 or self.clock.now_s < self.certain_s, (sure, self.log)


def tokens(folder: Path) -> set[bytes]:
    """Give what nobody could get back of a folder: lines and recordings."""
    files = [path for path in folder.rglob("*") if path.is_file() and path.suffix in {".jsonl", ".mcap"}]
    return {line for path in files for line in path.read_bytes().splitlines(keepends=True)}


@pytest.fixture
def memory(tmp_path: Path) -> Iterator[Path]:
    """A folder in memory where there is one, so that no run waits for a disk."""
    if not os.access("/dev/shm", os.W_OK):
        yield tmp_path
        return
    with TemporaryDirectory(dir="/dev/shm") as name:
        yield Path(name)


@pytest.mark.parametrize("first", range(0, 200, 25))
def test_whatever_happens_there_is_one_monitor_that_is_sure_and_nothing_newer_is_lost(memory: Path, first: int) -> None:
    for seed in range(first, first + 25):
        world = World(memory / str(seed), seed)
        for _ in range(40):
            world.step()
        world.bucket.is_stale = lambda _: False
        for _ in range(2):  # the storage answers again
            for one in world.running.values():
                one.renew()
                one.push()
            world.clock.sleep(EVERY_S)
        left = {name: one for name, one in world.running.items() if one.store.lost is None}
        assert len(left) <= 1, (seed, left, world.log)
        for one in left.values():
            assert one.store.failed is None, (seed, world.log)
            owner = json.loads(world.bucket.objects[MANIFEST])["owner"]
            assert owner == one.store.lease.owner, (seed, world.log)
            one.close()
        world.clock.sleep(20.0 * EVERY_S)
        heir = Machine(world.folder / "d", world.bucket, world.clock, every_s=EVERY_S).open(wait=True)
        assert heir.store.failed is None
        assert tokens(heir.folder) == world.stored()
        world.check()
