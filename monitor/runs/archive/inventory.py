"""The recordings of an archive: which follow one another and make one replay, and the name of its results."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from monitor import __version__

_OVERLAP_NS = 1_000_000_000
"""Recordings of one stream overlap by less than this; those that overlap by more were made side by side."""


@dataclass(frozen=True, slots=True, order=True)
class Survey:
    """Channels, rate and span of one recording, as read before its replay."""

    folder: str
    channels: tuple[str, ...]
    rate_hz: float
    t_start_ns: int
    t_end_ns: int
    path: Path


@dataclass(frozen=True, slots=True)
class Run:
    """Recordings that make one replay."""

    stream: str
    """The folder that holds them."""
    paths: tuple[Path, ...]
    """In the order of their times."""
    t_start_ns: int
    t_end_ns: int

    def name(self, configuration: str) -> str:
        """Name the results; another configuration, recording or version of the program gives another name."""
        begun = datetime.fromtimestamp(self.t_start_ns // 1_000_000_000, UTC).strftime("%Y%m%dT%H%M%S")
        label = "".join(c if c.isalnum() or c in "-_." else "-" for c in Path(self.stream).name)
        return f"{label}-{begun}-{fingerprint(configuration, *map(file_version, self.paths))}"


def fingerprint(*parts: str) -> str:
    """Compute sixteen hexadecimal digits that change with any of the parts.

    Examples
    --------
    >>> len(fingerprint("a", "b")), fingerprint("a", "b") == fingerprint("ab")
    (16, False)
    """
    return hashlib.sha256(json.dumps([__version__, *parts]).encode()).hexdigest()[:16]


def file_version(path: Path) -> str:
    """Identify the present version of a file by its path, its size and the time of its last change."""
    status = path.stat()
    return f"{path} {status.st_size} {status.st_mtime_ns}"


def group_into_runs(surveys: Iterable[Survey], longest_gap_s: float) -> list[Run]:
    """Group recordings that follow one another into runs, the longest run first.

    A recording goes on with another's run if it lies in the same folder, has the same channels and rate, and begins no more than
    `longest_gap_s` after that one's end and not before it.
    """
    open_runs: list[list[Survey]] = []
    done: list[Run] = []
    for survey in sorted(surveys):
        fitting = [r for r in open_runs if _continues(r[-1], survey, longest_gap_s)]
        if fitting:
            max(fitting, key=lambda r: r[-1].t_end_ns).append(survey)
        else:
            open_runs.append([survey])
    for chain in open_runs:
        ends = max(s.t_end_ns for s in chain)
        done.append(Run(chain[0].folder, tuple(s.path for s in chain), chain[0].t_start_ns, ends))
    return sorted(done, key=lambda run: run.t_start_ns - run.t_end_ns)


def _continues(before: Survey, after: Survey, longest_gap_s: float) -> bool:
    same = (before.folder, before.channels, before.rate_hz) == (after.folder, after.channels, after.rate_hz)
    return same and -_OVERLAP_NS < after.t_start_ns - before.t_end_ns <= longest_gap_s * 1e9


def expand_patterns(patterns: Sequence[str]) -> list[Path]:
    """List the files that patterns (``*``, ``?``, ``**``) or names stand for, each once, absolute; names of no file stay."""
    import glob

    found = [name for pattern in patterns for name in (sorted(glob.glob(pattern, recursive=True)) or [pattern])]
    return [path for path in dict.fromkeys(Path(name).resolve() for name in found)]
