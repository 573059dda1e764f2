"""Files of a run's results: results.jsonl, and before it the closed months that a daemon may have packed."""

from __future__ import annotations

import io
import os
import re
import shutil
from collections import deque
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

from monitor.core import BadInputError, finish, partial

RESULTS = "results.jsonl"
_PACKED = ".zst"
_CLOSED = re.compile(r"results-\d{4,}-\d{2}\.jsonl(?:\.zst)?")
_COPY_BYTES = 1 << 20
"""Bytes that are read at a time. [bytes; cost]"""


def month_file(folder: Path, t_ns: int) -> Path:
    """Return the file of the closed month that holds a time (UTC, ns since 1970), not packed."""
    return folder / f"results-{datetime.fromtimestamp(t_ns // 1_000_000_000, UTC):%Y-%m}.jsonl"


def closed_files(folder: Path) -> list[Path]:
    """List the closed months in a folder, the oldest first, packed ones before those of the same month that are not."""
    found = [path for path in folder.glob("results-*") if _CLOSED.fullmatch(path.name)]
    return sorted(found, key=lambda path: (path.name.removesuffix(_PACKED), path.suffix != _PACKED))


def read_lines(path: Path) -> Iterator[bytes]:
    """Read the lines of results.jsonl or of a closed month, each with its newline.

    Raises OSError if the file cannot be read, BadInputError if its packed bytes are damaged.
    """
    if path.suffix != _PACKED:
        with path.open("rb") as file:
            yield from file
        return
    import zstandard

    try:
        with (
            path.open("rb") as packed,
            zstandard.ZstdDecompressor().stream_reader(packed, read_across_frames=True) as raw,
        ):
            yield from io.BufferedReader(raw, _COPY_BYTES)
    except zstandard.ZstdError as error:
        raise BadInputError(f"{path}: damaged ({error}); move it away, or put a copy in its place") from error


def read_all_lines(folder: Path) -> Iterator[bytes]:
    """Read the lines of all months and of results.jsonl, which must exist, as they were written (errors as `read_lines`)."""
    for path in (*closed_files(folder), folder / RESULTS):
        yield from read_lines(path)


def pack_month(path: Path) -> None:
    """Replace the file of a closed month by its packed form, appended to what was packed of that month before.

    Raises OSError if the disk does not allow it, and BadInputError if what was packed is damaged; the files are then as before.
    """
    import zstandard

    place = path.with_name(path.name + _PACKED)
    if place.exists() and _last_line(place) == _last_line(path):  # packed just before the power went
        path.unlink()
        return
    try:
        with partial(place).open("wb") as out:
            if place.exists():
                with place.open("rb") as before:
                    shutil.copyfileobj(before, out, _COPY_BYTES)
            with path.open("rb") as file:
                zstandard.ZstdCompressor(write_checksum=True).copy_stream(file, out)
            out.flush()
            os.fsync(out.fileno())
        finish(place)
    except OSError:
        partial(place).unlink(missing_ok=True)
        raise
    path.unlink()


def _last_line(path: Path) -> bytes:
    return next(iter(deque(read_lines(path), maxlen=1)), b"")
