"""The formats that are read, each by its class; which one a file is shows by its first bytes."""

from __future__ import annotations

import bz2
import gzip
import io
import lzma
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from typing import IO, Any

from drivers.mcap_records import MAGIC
from monitor.core import BadInputError
from monitor.runs.readers import (
    cosmos,
    delimited,
    geocsv,
    hdf5,
    mat,
    mdf,
    npz,
    peer,
    seismic,
    spreadsheet,
    tdms,
    uff,
    xsens_dot,
)
from monitor.runs.readers.base import LINE_BYTES, File, Limits, Options, Reader, read_bytes
from monitor.runs.readers.table import Table, without_fillers

_PIECE_BYTES = 1 << 20
"""Length of the pieces in which an archive is unpacked and counted. [bytes; cost]"""


_OPENERS: dict[bytes, Callable[[IO[bytes]], Any]] = {
    b"\x1f\x8b": lambda raw: gzip.GzipFile(fileobj=raw),
    b"BZh": bz2.BZ2File,
    b"\xfd7zXZ": lzma.LZMAFile,
}
"""First bytes of packed files, and what unpacks them."""


@dataclass(slots=True)
class Elsewhere:
    """A format that is told by its first bytes and not read here."""

    name: str
    magic: bytes
    says: str
    """What it is, and what to do."""

    def is_mine(self, file: File) -> bool:
        """Test whether a file is of this format."""
        return file.raw.startswith(self.magic)

    def read(self, file: File) -> list[Table]:
        """Refuse it."""
        raise BadInputError(f"{file.path}: is {self.says}")


class Packed:
    """One file packed by gzip, bzip2 or xz."""

    name = "packed file (gzip, bzip2 or xz)"

    def is_mine(self, file: File) -> bool:
        """Test whether a file is of this format."""
        return any(map(file.raw.startswith, _OPENERS))

    def read(self, file: File) -> list[Table]:
        """Unpack it and read what it holds."""
        opener = next(opener for magic, opener in _OPENERS.items() if file.raw.startswith(magic))
        try:
            with opener(io.BytesIO(file.raw)) as packed:
                raw = _unpacked(file, packed)
        except (OSError, EOFError, zlib.error, lzma.LZMAError) as error:
            raise BadInputError(f"{file.path}: damaged archive: {error}") from error
        return read(file.holding(raw, file.path.with_suffix("")))


class Zip:
    """A zip archive: NPZ, a workbook, or one packed table."""

    name = "zip archive"

    def is_mine(self, file: File) -> bool:
        """Test whether a file is of this format."""
        return file.raw.startswith(b"PK\x03\x04")

    def read(self, file: File) -> list[Table]:
        """Read what it holds."""
        try:
            with zipfile.ZipFile(io.BytesIO(file.raw)) as archive:
                infos = archive.infolist()
                # zipfile unpacks no more of a member than the archive states, whatever is packed.
                file.demand_room(sum(member.file_size for member in infos))
                members = [member.filename for member in infos if not member.filename.endswith("/")]
                if all(name.endswith(".npy") for name in members):
                    return npz.read_tables(file)
                if "xl/workbook.xml" in members:
                    return _LAST.read(file.holding(spreadsheet.as_text(file).encode()))
                tables = [name for name in members if ".csv" in name.lower()] or members
                if len(tables) != 1:
                    raise BadInputError(
                        f"{file.path}: holds {len(tables)} tables; unpack it and name one: {', '.join(tables)}"
                    )
                with archive.open(tables[0]) as member:
                    raw = _unpacked(file, member)
        except (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError, NotImplementedError, ValueError) as error:
            raise BadInputError(f"{file.path}: damaged zip archive, or an encrypted one: {error}") from error
        return read(file.holding(raw))


def _unpacked(file: File, packed: IO[bytes]) -> bytes:
    """Unpack piece by piece, no further than there is room."""
    data, counted = bytearray(), 0
    while piece := packed.read(_PIECE_BYTES):
        data += piece
        counted += len(piece) + LINE_BYTES * piece.count(b"\n")
        file.demand_room(counted)
    return bytes(data)


class Text:
    """A table of text of any dialect, that of Xsens DOT among them."""

    name = "table of text"

    def is_mine(self, file: File) -> bool:
        """Take what no other reader takes."""
        return True

    def read(self, file: File) -> list[Table]:
        """Guess its dialect and convert it."""
        decoded = delimited.decode(file.path, file.raw)
        if file.wanted:
            return [delimited.named_columns(file.path, decoded, file.wanted, file.on_warning, file.options.zone)]
        text = delimited.cut(file.path, decoded, file.on_warning, file.options.time)
        if xsens_dot.is_xsens(text):
            return [xsens_dot.to_table(text, file.on_warning, file.options.zone)]
        return delimited.to_tables(text, file.on_warning, file.options.zone)


READERS: tuple[Reader, ...] = (
    Elsewhere("MCAP", MAGIC, "an MCAP recording already; use it as it is"),
    Elsewhere("CAN log", b"LOGG", "a CAN log; name it with the suffix .blf"),
    seismic.Seismic(),
    hdf5.Hdf5(),
    mat.Mat(),
    uff.Uff(),
    tdms.Tdms(),
    mdf.Mdf(),
    Packed(),
    Zip(),
    cosmos.Cosmos(),
    geocsv.GeoCsv(),
    peer.Peer(),
)
_LAST = Text()


def read(file: File) -> list[Table]:
    """Convert a file of any format to tables; raise BadInputError if it is damaged or of none that is known."""
    others = [entry.load()() for entry in entry_points(group="shm_monitor.readers")]
    reader = next((one for one in (*others, *READERS) if one.is_mine(file)), _LAST)
    tables = [without_fillers(table, file.on_warning) for table in reader.read(file)]
    for table in tables:
        if len(table.values) < 2:
            raise BadInputError(f"{table.path}: {len(table.values)} samples are too few")
    return tables


def explain_table(path: Path, time: str | None = None) -> list[tuple[str, str, str]]:
    """Say what each part of a table of text is taken for, and why; BadInputError for a file of another format."""
    file = File(path, read_bytes(path), Options(time=time), Limits(), lambda _: None)
    if (other := next((one for one in READERS if one.is_mine(file)), None)) is not None:
        raise BadInputError(f"{path}: is read as {other.name}; --explain is for tables of text")
    text = delimited.cut(path, delimited.decode(path, file.raw), file.on_warning, time)
    return text.dialect.explained()
