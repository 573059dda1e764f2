"""Results of many sites as one Parquet dataset, partitioned by site and month, which any engine reads as one table."""

from __future__ import annotations

import itertools
import logging
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from urllib.parse import quote

from monitor.config import configuration
from monitor.core import (
    BadConfigurationError,
    MissingInputError,
    UserError,
    demand_file,
    finish,
    partial,
    require_extra,
)
from monitor.publish import closed_files, read_line, read_lines

_log = logging.getLogger(__name__)

_BATCH = 5_000
"""Lines that are converted together. [1; cost: some 30 MB]"""
_MONTH = re.compile(r"results-(\d{4}-\d{2})\.")
"""Month in the name of a closed file. [1; definition]"""


def site_folders(places: Sequence[Path]) -> dict[str, Path]:
    """Return the output folder of each site, by its name; a file of a folder that is no site file is left out with a warning.

    Raises
    ------
    MissingInputError, BadConfigurationError
        A named file cannot be read or is no site file; or two sites have one name.
    """
    found: dict[str, Path] = {}
    for place in places:
        for path in sorted(place.glob("*.toml")) if place.is_dir() else [place]:
            try:
                demand_file(path)
                settings = configuration.load(path)
            except UserError as error:
                if not place.is_dir():
                    raise
                _log.warning("left out: %s", error)
                continue
            if settings.site_name in found:
                raise BadConfigurationError(f"{path}: another site is named {settings.site_name!r} too")
            found[settings.site_name] = path.parent / settings.output.dir
    return found


def write_dataset(folders: Mapping[str, Path], place: Path) -> dict[str, int]:
    """Write the windows of sites as ``PLACE/site=NAME/month=YYYY-MM/results.parquet``, and return each site's number of windows.

    A closed month that stands is kept; a site without results is left out with a warning.  The columns are those of
    `monitor.publish.WINDOWS_SCHEMA`.

    Raises
    ------
    MissingInputError
        The dataset cannot be written.
    """
    require_extra("archive", "dataset")
    written: dict[str, int] = {}
    for name, folder in folders.items():
        own = place / f"site={quote(name, safe=' ')}"
        try:
            present = folder / "results.jsonl"
            if not present.exists():
                _log.warning("%s: no results in %s", name, folder)
                continue
            closed = [path for path in closed_files(folder) if not _stands(own, path)]
            written[name] = _write_site(name, itertools.chain.from_iterable(map(read_lines, [*closed, present])), own)
        except OSError as error:
            raise MissingInputError(f"{error.filename or own}: {error.strerror or error}") from error
    return written


def _stands(own: Path, closed: Path) -> bool:
    """Return whether the dataset has a closed month as it is now."""
    month = _MONTH.match(closed.name)
    file = own / f"month={month[1] if month else ''}" / "results.parquet"
    return file.exists() and file.stat().st_mtime_ns >= closed.stat().st_mtime_ns


def _write_site(name: str, lines: Iterable[bytes], own: Path) -> int:
    """Write the windows of a site, and return their number; the lines need not be in the order of their times."""
    import pyarrow.parquet as pq

    from monitor.publish import WINDOWS_SCHEMA, windows_table

    count, parsed = 0, _parsed(name, lines)
    files: dict[Path, Any] = {}
    with ExitStack() as open_files:
        while batch := list(itertools.islice(parsed, _BATCH)):
            for month, group in itertools.groupby(batch, key=lambda line: _month(int(line["t_end_ns"]))):
                file = own / f"month={month}" / "results.parquet"
                if file not in files:
                    file.parent.mkdir(parents=True, exist_ok=True)
                    writer = pq.ParquetWriter(partial(file), WINDOWS_SCHEMA, compression="zstd")
                    files[file] = open_files.enter_context(writer)
                files[file].write_table(windows_table(group, name))
            count += len(batch)
    for file in files:
        finish(file)
    return count


def _parsed(name: str, lines: Iterable[bytes]) -> Iterator[dict[str, Any]]:
    """Parse lines; damaged ones are left out and counted in a warning."""
    damaged = 0
    for text in lines:
        try:
            line = read_line(text)
            int(line["t_end_ns"])
        except (ValueError, KeyError, TypeError):
            damaged += 1
        else:
            yield dict(line)
    if damaged:
        _log.warning("%s: %d damaged lines are left out", name, damaged)


def _month(t_ns: int) -> str:
    return datetime.fromtimestamp(t_ns // 1_000_000_000, UTC).strftime("%Y-%m")
