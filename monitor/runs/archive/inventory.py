"""Inventory of an archive: groups recordings that follow one another into runs, and names the results of each run."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from monitor import __version__
from monitor.runs.object_storage import is_remote, remote_paths, remote_version

_OVERLAP_NS = 1_000_000_000
"""Overlap, ns, below which two recordings may belong to one stream; with a larger overlap they were made in parallel."""


@dataclass(frozen=True, slots=True, order=True)
class Survey:
    """Channels, rate and span of one recording, as read before its replay."""

    folder: str
    channels: tuple[str, ...]
    rate_hz: float
    t_start_ns: int
    t_end_ns: int
    path: Path
    version: str = ""
    """As of `file_version`, when it was surveyed."""


@dataclass(frozen=True, slots=True)
class Run:
    """Run of consecutive recordings, which are replayed together."""

    stream: str
    """Folder of the recordings, in the order of their times."""
    paths: tuple[Path, ...]
    versions: tuple[str, ...]
    """Version of each, as of `file_version`."""
    t_start_ns: int
    t_end_ns: int

    def name(self, configuration: str) -> str:
        """Name the results of the run; the name depends on configuration, recordings and version of the program."""
        begun = datetime.fromtimestamp(self.t_start_ns // 1_000_000_000, UTC).strftime("%Y%m%dT%H%M%S")
        label = "".join(c if c.isalnum() or c in "-_." else "-" for c in Path(self.stream).name)
        return f"{label}-{begun}-{fingerprint(configuration, *self.versions)}"


def fingerprint(*parts: str) -> str:
    """Compute a hash of sixteen hexadecimal digits that depends on all parts and on the version of the program.

    Examples
    --------
    >>> len(fingerprint("a", "b")), fingerprint("a", "b") == fingerprint("ab")
    (16, False)
    """
    return hashlib.sha256(json.dumps([__version__, *parts]).encode()).hexdigest()[:16]


def file_version(path: Path) -> str:
    """Identify the present version of a file by its path, its size and the time of its last change; of an object by its ETag."""
    if is_remote(path):
        return remote_version(path)
    status = path.stat()
    return f"{path} {status.st_size} {status.st_mtime_ns}"


def group_into_runs(surveys: Iterable[Survey], longest_gap_s: float) -> list[Run]:
    """Group recordings that follow one another into runs, the longest run first.

    A recording continues the run of another if it lies in the same folder, has the same channels and rate, and begins at most
    `longest_gap_s` after the end of the other; an overlap below 1 s is allowed.
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
        paths, versions = (tuple(s.path for s in chain), tuple(s.version for s in chain))
        done.append(Run(chain[0].folder, paths, versions, chain[0].t_start_ns, ends))
    return sorted(done, key=lambda run: run.t_start_ns - run.t_end_ns)


def _continues(before: Survey, after: Survey, longest_gap_s: float) -> bool:
    """Test whether a recording may follow another in one run."""
    same = (before.folder, before.channels, before.rate_hz) == (after.folder, after.channels, after.rate_hz)
    return same and -_OVERLAP_NS < after.t_start_ns - before.t_end_ns <= longest_gap_s * 1e9


def expand_patterns(patterns: Sequence[str]) -> list[Path]:
    """List the absolute paths of the files that patterns (``*``, ``?``, ``**``) or names denote, each once.

    A pattern that matches no file is kept as a name.  ``s3://`` patterns denote objects.
    """
    import glob

    found = list[Path]()
    for pattern in patterns:
        if pattern.startswith("s3://"):
            found += remote_paths(pattern)
        else:
            found += [Path(name).resolve() for name in sorted(glob.glob(pattern, recursive=True)) or [pattern]]
    return list(dict.fromkeys(found))
