"""Files whose writer is cut off at a chosen operation, as by kill -9 or by a power cut: for daemons that live in this process.

Every operation on a file below a folder that is watched is a point: it has a name, is counted, and may be the last of its life.
What the life does afterwards has no effect, so that it can be closed in peace.  A power cut takes back what no
fsync has confirmed: bytes of files, and names since the last fsync of anything (file systems write their log in order).
"""

from __future__ import annotations

import builtins
import io
import os
import random
import re
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import pytest

_NUMBERS = re.compile(r"[0-9][0-9A-Za-z:._-]*[0-9Z]|[0-9a-f]{8,}")
_CALLS = ("write", "fsync", "ftruncate", "replace", "rename", "unlink", "remove", "open")
_ANY = re.compile(r"^(superseded|findings|events)/.*")


class Killed(BaseException):
    """Ends a life at the operation that was chosen."""


@dataclass
class Plan:
    """Where a life is to end: at the `after`-th operation of those whose names are not in `but`."""

    but: frozenset[str]
    after: int
    how: str
    """``before`` the operation takes effect, ``after`` it, or ``half`` way through the bytes that are written."""


@dataclass
class Life:
    """What one run of a monitor does to the world, until it is cut off."""

    folder: Path
    plan: Plan | None = None
    dead: bool = False
    died_at: str | None = None
    seen: Counter[str] = field(default_factory=Counter)

    def reaches(self, point: str) -> str | None:
        """Count an operation, and say how the life ends at it, if it does."""
        self.seen[point] += 1
        plan = self.plan
        if plan is None or point in plan.but:
            return None
        plan.after -= 1
        return plan.how if plan.after == 0 else None

    def ends(self, point: str) -> None:
        """Cut the life off from the world."""
        self.dead, self.died_at = True, point
        raise Killed(point)


class CutDisk:
    """Disk with the folders of several machines; `life` of a folder is what writes there."""

    def __init__(self, limbo: Path) -> None:
        self._limbo, self._kept = limbo, 0
        self._lives: dict[str, Life] = {}
        self._durable: dict[tuple[int, int], int] = {}
        """Length that an fsync has confirmed, of the files that were written since the machine began."""
        self._undo: list[tuple[str, Callable[[], object]]] = []
        """How each change of a name since the last fsync is taken back, with the folder of the machine."""
        limbo.mkdir(parents=True, exist_ok=True)
        self._real = {name: getattr(os, name) for name in _CALLS}
        self._real_open = builtins.open

    def begin(self, life: Life) -> None:
        """Let a life write into its folder."""
        self._lives[str(life.folder)] = life

    def end(self, life: Life) -> None:
        """Watch the folder of a life no more, once nothing of it is left."""
        if self._lives.get(str(life.folder)) is life:
            del self._lives[str(life.folder)]

    def replaced(self, folder: Path) -> None:
        """Forget what could be taken back in a folder that somebody replaced."""
        self._undo = [(whose, undo) for whose, undo in self._undo if whose != str(folder)]

    def power_cut(self, folder: Path, chance: random.Random) -> None:
        """Take back what was not on the disk of a machine, or a part of it: a disk may have more than was confirmed."""
        place = str(folder)
        ours = [undo for whose, undo in self._undo if whose == place]
        self._undo = [(whose, undo) for whose, undo in self._undo if whose != place]
        for undo in reversed(ours[chance.randint(0, len(ours)) :]):
            undo()
        for path in sorted(folder.rglob("*")):
            if not path.is_file() or path.name.startswith("history.db"):  # a database has a log of its own
                continue
            about = path.stat()
            confirmed = self._durable.pop((about.st_dev, about.st_ino), about.st_size)
            if confirmed < about.st_size:
                os.truncate(path, chance.choice([confirmed, chance.randint(confirmed, about.st_size)]))

    @contextmanager
    def watched(self) -> Iterator[None]:
        """Count and cut the operations of this process."""
        with pytest.MonkeyPatch.context() as patch:
            for name, really in self._real.items():
                patch.setattr(os, name, partial(getattr(self, f"_{name}"), really))
            for module in (builtins, io):
                patch.setattr(module, "open", partial(self._open_file, self._real_open))
            yield

    def operate(self, life: Life, point: str, work: Callable[[], Any], half: Callable[[], Any] | None = None) -> Any:
        """Do an operation of a life, unless it is dead; the chosen one ends it. None is returned by what has no effect."""
        if life.dead:
            return None
        how = life.reaches(point)
        if how == "half" and half is not None:
            half()
        result = None if how in {"before", "half"} else work()
        if how is not None:
            life.ends(point)
        return result

    def _life_of(self, path: str) -> tuple[Life, str] | None:
        """Find whose a path is, and its name in that folder, in which numbers are left out."""
        for place, life in self._lives.items():
            if path.startswith(place + "/"):
                name = _ANY.sub(r"\1/*", path[len(place) + 1 :])
                return (life, _NUMBERS.sub("*", name)) if "history.db" not in name else None
        return None

    def _of_handle(self, handle: int) -> tuple[Life, str] | None:
        try:
            return self._life_of(os.readlink(f"/proc/self/fd/{handle}").removesuffix(" (deleted)"))
        except OSError:
            return None

    def _written(self, handle: int) -> None:
        about = os.fstat(handle)
        self._durable.setdefault((about.st_dev, about.st_ino), about.st_size)

    def _write(self, really: Any, handle: int, data: Any) -> int:
        if (found := self._of_handle(handle)) is None:
            return int(really(handle, data))
        life, name = found

        def work(part: Any = data) -> int:
            self._written(handle)
            return int(really(handle, part))

        written = self.operate(life, f"write {name}", work, lambda: work(bytes(data)[: len(data) // 2]))
        return len(data) if written is None else int(written)

    def _fsync(self, really: Any, handle: int) -> Any:
        if (found := self._of_handle(handle)) is None:
            return really(handle)
        life, name = found

        def work() -> None:  # the test's disk need not be asked
            about = os.fstat(handle)
            self._durable[about.st_dev, about.st_ino] = about.st_size
            self._undo = [(whose, undo) for whose, undo in self._undo if whose != str(life.folder)]
            self._forget_undone()

        return self.operate(life, f"fsync {name}", work)

    def _ftruncate(self, really: Any, handle: int, length: int) -> Any:
        if (found := self._of_handle(handle)) is None or os.fstat(handle).st_size == length:
            return really(handle, length)
        return self.operate(found[0], f"truncate {found[1]}", lambda: really(handle, length))

    def _replace(self, really: Any, source: Any, target: Any, **options: Any) -> Any:
        path, place = os.path.abspath(source), os.path.abspath(target)
        if (found := self._life_of(place)) is None:
            return really(source, target, **options)
        life, name = found

        def work() -> None:
            kept = self._link(place)
            really(path, place)
            self._note(life, lambda: (really(place, path), kept and really(kept, place)))

        return self.operate(life, f"rename {name}", work)

    _rename = _replace

    def _unlink(self, really: Any, path: Any, **options: Any) -> Any:
        place = os.path.abspath(path)
        if (found := self._life_of(place)) is None or options or not os.path.lexists(place):
            return really(path, **options)
        life, name = found

        def work() -> None:
            kept = self._link(place)
            really(place)
            self._note(life, lambda: kept and not os.path.lexists(place) and os.link(kept, place))

        return self.operate(life, f"remove {name}", work)

    _remove = _unlink

    def _link(self, place: str) -> str | None:
        """Keep what a name leads to, if it is a file."""
        if not os.path.isfile(place):
            return None
        self._kept += 1
        kept = str(self._limbo / str(self._kept))
        os.link(place, kept)
        return kept

    def _open(self, really: Any, path: Any, flags: int, mode: int = 0o777, *, dir_fd: int | None = None) -> int:
        folder = "" if dir_fd is None else os.readlink(f"/proc/self/fd/{dir_fd}")
        place = os.path.abspath(os.path.join(folder, os.fspath(path)))
        found = self._life_of(place)
        if found is None or not flags & (os.O_CREAT | os.O_TRUNC):
            return int(really(path, flags, mode, dir_fd=dir_fd))
        (life, name), is_new = found, not os.path.exists(place)

        def work() -> int:
            handle = int(really(path, flags, mode, dir_fd=dir_fd))
            if is_new or flags & os.O_TRUNC:
                about = os.fstat(handle)
                self._durable[about.st_dev, about.st_ino] = 0
            if is_new:
                self._note(life, lambda: os.path.lexists(place) and self._real["unlink"](place))
            return handle

        handle = self.operate(life, f"{'create' if is_new else 'open'} {name}", work)
        return int(really(os.devnull, os.O_RDWR)) if handle is None else int(handle)

    def _note(self, life: Life, undo: Callable[[], object]) -> None:
        self._undo.append((str(life.folder), undo))

    def _forget_undone(self) -> None:
        """Let go of what names led to, once no change of a name can be taken back."""
        if not self._undo:
            for kept in self._limbo.iterdir():
                self._real["unlink"](kept)

    def _open_file(
        self, really: Any, file: Any, mode: str = "r", buffering: int = -1, *rest: Any, **options: Any
    ) -> Any:
        """Open a file so that its bytes pass `_write`, whatever buffers them."""
        found = None if isinstance(file, int) else self._life_of(os.path.abspath(os.fspath(file)))
        if found is None or not set(mode) & set("wax+"):
            return really(file, mode, buffering, *rest, **options)
        flags = os.O_RDWR if "+" in mode else os.O_WRONLY
        flags |= os.O_CREAT * ("r" not in mode) | os.O_TRUNC * ("w" in mode) | os.O_APPEND * ("a" in mode)
        opener = options.pop("opener", None) or (lambda path, how: os.open(path, how | os.O_CLOEXEC, 0o666))
        raw = _Raw(opener(os.fspath(file), flags), mode.replace("t", "").replace("b", ""))
        raw.disk = self
        buffered = io.BufferedRandom(raw) if "+" in mode else io.BufferedWriter(raw)
        if "b" in mode:
            return buffered
        names = ("encoding", "errors", "newline")
        return io.TextIOWrapper(buffered, **dict(zip(names, rest, strict=False)), **options)


class _Raw(io.FileIO):
    """Bytes of a file that is written by the functions of `io`."""

    disk: CutDisk

    def write(self, data: Any) -> int:
        return self.disk._write(lambda _, part: super(_Raw, self).write(part), self.fileno(), data)
