"""References that many tests read (a calibration, a diagnosis), computed once for all workers and all tiers.

A reference is kept in out/references, in a folder named after a checksum of the code, the recordings, the locked
packages and what the tests share: any change of one of these, and all references are computed anew.
"""

from __future__ import annotations

import fcntl
import functools
import hashlib
import pickle
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import ParamSpec, TypeVar

ROOT = Path(__file__).resolve().parents[2]
_KEPT = ROOT / "out" / "references"
_READ = ("monitor/**/*.py", "drivers/**/*.py", "recordings/*", "requirements*.txt", "tests/support/*.py")

P = ParamSpec("P")
T = TypeVar("T")


@functools.cache
def place() -> Path:
    """Folder of the references of this code; those of other code are deleted."""
    digest = hashlib.sha256()
    for pattern in _READ:
        for file in sorted(ROOT.glob(pattern)):
            if file.is_file():
                digest.update(str(file.relative_to(ROOT)).encode() + b"\0" + file.read_bytes())
    place = _KEPT / digest.hexdigest()[:16]
    place.mkdir(parents=True, exist_ok=True)
    for other in _KEPT.iterdir():
        if other != place:
            shutil.rmtree(other, ignore_errors=True)
    return place


@contextmanager
def _alone(name: str) -> Iterator[Path]:
    """The only worker that computes this reference."""
    kept = place() / name
    with open(kept.with_name(name + ".lock"), "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield kept


def _name(make: Callable[..., object], arguments: tuple[object, ...]) -> str:
    """Of the function and its file's content: the test module that defines it may change, too."""
    file = Path(make.__code__.co_filename)
    digest = hashlib.sha256(file.read_bytes() + repr(arguments).encode()).hexdigest()[:12]
    return f"{file.stem}-{make.__name__}-{digest}"


def once(make: Callable[P, T]) -> Callable[P, T]:
    """Compute a function's result once for all workers; arguments tell themselves apart by `repr`, results are pickled.

    All callers of a worker have the same copy.
    """
    here: dict[str, T] = {}

    @functools.wraps(make)
    def kept(*arguments: P.args, **named: P.kwargs) -> T:
        name = _name(make, (*arguments, *sorted(named.items())))
        if name not in here:
            with _alone(name) as place:
                if not place.exists():
                    place.with_suffix(".part").write_bytes(pickle.dumps(make(*arguments, **named)))
                    place.with_suffix(".part").rename(place)
                here[name] = pickle.loads(place.read_bytes())
        return here[name]

    return kept
