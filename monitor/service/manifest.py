"""Manifest of a site in object storage: who monitors it, and of which parts of which objects its files consist.

Everything here is pure; `monitor.service.lease` writes the manifest, and `monitor.service.mirror` moves the files.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from pathlib import PurePosixPath
from typing import Literal, NamedTuple

from pydantic import BaseModel, ConfigDict, Field, field_validator

MANIFEST = "manifest.json"
LOCK = "state/lock"
"""File that a monitor of this folder holds open and locked, so that no other file has its number meanwhile."""
NOTE = "state/owner"
"""File with what this folder knows of the manifest (`Note`); it is not stored."""
SUPERSEDED = "superseded"
"""Folder for what a folder held when the monitor of another machine had gone on meanwhile."""
FETCHED = ".fetched"
"""What the name of a file ends with until it was fetched."""
_OWN = re.compile(rf"{LOCK}|{NOTE}|state/history\.db.*|{SUPERSEDED}/.*|.*\{FETCHED}")
"""Files that stay on this machine: the database repeats results.jsonl, and changes anywhere at any time."""
_RECORDING = re.compile(r"(.*\.mcap)(\.part)?")
"""Recordings, finished or not."""
_APPENDED = re.compile(r".*\.(jsonl|mcap|mcap\.part)")
"""Files to which bytes are only appended; others are small, and read again when they have changed."""

State = Literal["held", "released", "ended"]
"""Whether the owner of a site monitors it, has stopped, or has read the source to its end."""


class Part(NamedTuple):
    """Bytes of a file: `length` bytes of an object from `offset` on."""

    object: str
    offset: int
    length: int


class StoredFile(BaseModel):
    """One file: its parts in order, the CRC-32 of all of it, and its time of change, ns since 1970."""

    model_config = ConfigDict(frozen=True)

    parts: tuple[Part, ...] = ()
    crc32: int
    mtime_ns: int

    @property
    def length(self) -> int:
        """Length of the file, bytes."""
        return sum(part.length for part in self.parts)


Files = Mapping[str, StoredFile]
"""Stored files by their names in the output folder."""


class Manifest(BaseModel):
    """What is stored of a site, and who monitors it."""

    model_config = ConfigDict(frozen=True)

    owner: str = Field(min_length=1)
    """Name of the run of a monitor, drawn when it took the site."""
    machine: str
    process: int
    """Number of its process there."""
    place: str
    """Start of the machine's kernel and number of the folder's lock on its file system: no copy of the folder has the same."""
    generation: int
    """Counts the states of the files."""
    number: int
    """Counts how often the manifest was written."""
    written: str
    """Name of this write, drawn for it: of a machine that was cloned while it ran, two processes have one owner's name."""
    every_s: float
    state: State
    files: dict[str, StoredFile]

    @field_validator("files")
    @classmethod
    def _stay_in_the_folder(cls, files: dict[str, StoredFile]) -> dict[str, StoredFile]:
        for name in files:
            if PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts or not is_kept(name):
                raise ValueError(f"{name!r} is no file of a site")
        return files


class Note(BaseModel):
    """What a folder knows of the manifest, written before the manifest itself: so a folder that knows less is an older one."""

    model_config = ConfigDict(frozen=True)

    owners: tuple[str, ...] = ()
    """Names under which its monitor may have written the manifest last."""
    generation: int = 0
    """State of the files that it has, or newer ones."""

    def knows(self, found: Manifest) -> bool:
        """Return whether the files of the folder are as new as those of a manifest, which its monitor wrote."""
        return found.owner in self.owners and found.generation <= self.generation


def is_kept(name: str) -> bool:
    """Return whether a file of the output folder is kept in the storage."""
    return not _OWN.fullmatch(name)


def is_appended(name: str) -> bool:
    """Return whether a file only grows at its end."""
    return bool(_APPENDED.fullmatch(name))


def forms(name: str) -> tuple[str, ...]:
    """Give the names that a file may have: a recording is one file, finished or not."""
    found = _RECORDING.fullmatch(name)
    return (name,) if found is None else (found[1], f"{found[1]}.part")


def longest(name: str, files: Files) -> str:
    """Give the name of the longest form of a file that is stored; `name` where none is."""
    return max((form for form in forms(name) if form in files), key=lambda form: files[form].length, default=name)


def is_state(name: str) -> bool:
    """Return whether a file is the monitor's alone, as a checkpoint is."""
    return name.startswith("state/")


def is_unique(name: str) -> bool:
    """Return whether a file cannot be had again from the others, as recordings and results cannot."""
    return not is_state(name) and name != "summary.json"


def to_put(before: StoredFile | None, size: int) -> tuple[list[Part], int]:
    """Return the parts of a file that stay when it has grown to `size`, and the byte from which on it is stored anew.

    Parts that are no longer than what follows them are stored again with it, so that there are few.
    """
    parts, begin = ([], 0) if before is None else ([*before.parts], before.length)
    while parts and parts[-1].length <= size - begin:
        begin -= parts.pop().length
    return parts, begin


def to_get(
    files: Files, present: Mapping[str, tuple[int, int]], goes_on: Callable[[str, StoredFile], bool]
) -> list[str]:
    """Name the stored files that a folder lacks, or of which it has an older form, though its monitor wrote the manifest.

    So it is where a part of the folder was restored or lost.  `present` has length (bytes) and time of change (ns) of its files;
    `goes_on` tells whether one begins with what is stored.  A file whose name got longer since is not missed, as of a closed
    month, nor what follows from other files.
    """

    def is_behind(name: str, file: StoredFile) -> bool:
        if there := [form for form in forms(name) if form in present]:
            return not any(is_as_new(form, file) for form in there)
        return not any(other.startswith(name) for other in present)

    def is_as_new(name: str, file: StoredFile) -> bool:
        if (about := present[name]) == (file.length, file.mtime_ns):
            return True
        return goes_on(name, file) if is_appended(name) else about[1] >= file.mtime_ns

    return [name for name, file in files.items() if is_unique(name) and is_behind(name, file)]


def without_shorter(files: Files) -> Files:
    """Leave out the shorter form of a recording that is named as finished and as unfinished.

    A manifest of files that are stored so far may name both; the shorter one would replace the other.
    """
    return {name: file for name, file in files.items() if name == longest(name, files)}


def to_delete(before: Files, after: Files) -> set[str]:
    """Name the objects that a manifest refers to and the next one does not."""
    return _objects(before) - _objects(after)


def left_over(names: Iterable[str], files: Files) -> set[str]:
    """Name those of the objects to which nothing refers: of writes that came to nothing."""
    return {*names} - _objects(files) - {MANIFEST}


def _objects(files: Files) -> set[str]:
    return {part.object for file in files.values() for part in file.parts}
