"""What every reader of a format is given, and what it is asked."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from datetime import tzinfo
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Protocol

from monitor.core import BadInputError, MissingInputError
from monitor.runs.readers import own_process
from monitor.runs.readers.table import OnWarning, Table

_UNPACKED_BYTES = 1 << 28
"""Most that any archive may unpack to, however small it is. [bytes; as a chunk of an MCAP file, `drivers.mcap_records`]"""
_UNPACKED_RATIO = 16
"""Most that a larger archive may unpack to, over its own size. [ratio; judgement: digits pack to a half or a fifth]"""
LINE_BYTES = 57
"""Memory that a line of text takes besides its characters, which counts as unpacked. [bytes; measured: CPython 3.11]"""
_MOST_UNPACKED_BYTES = 1 << 31
"""Most that an archive of any size may unpack to. [bytes; judgement]"""


@dataclass(frozen=True, slots=True)
class Options:
    """What the user says of files, for every format alike."""

    rate_hz: float | None = None
    """Sample rate; it overrides the rate of a time column."""
    unit: str | None = None
    """Unit of columns of acceleration: of those whose file states none, or states one that is not known."""
    channels: dict[str, str] | None = None
    """Channel name -> "FILE" or "FILE:COLUMN", with FILE by name or stem, or "COLUMN" of a single file.  By default the channels
    are the columns of a single file, or the stems of several files.  Columns with a unit of a rate of rotation go to the topic
    ``/rotation_rate``, those of another quantity to a topic of their own."""
    time: str | None = None
    """Name of the column of the times."""
    covariates: dict[str, str] | None = None
    """Name of a covariate -> "FILE:COLUMN" or "COLUMN", as in `channels`."""
    ground: str | None = None
    """"FILE" or "FILE:COLUMN" of the base motion."""
    forces: dict[str, str] | None = None
    """Name of a measured force -> "FILE" or "FILE:COLUMN"."""
    start_ns: int | None = None
    """UTC of the first sample, ns since 1970; by default the time stated in a file."""
    unknown_start_ns: int | None = None
    """The same where no file states a time; by default 1970, with a warning."""
    zone: tzinfo | None = None
    """Zone of times that state none; by default UTC, with a warning."""
    dbc: Path | None = None
    """DBC file that describes the frames of CAN logs."""
    bus: str | None = None
    """Bus of a CAN log of several, as the log names it."""
    scale: float | None = None
    """m/s^2 of a count, where a file holds counts."""
    inventory: Path | None = None
    """StationXML with the sensitivities of seismic formats."""
    align: bool = False
    """Shift the clocks of the files so that their readings fit each other (`clocks.align`)."""

    def given(self) -> list[str]:
        """List the options that the user states, as the command line names them."""
        values = {one.name: getattr(self, one.name) for one in fields(self) if one.name != "unknown_start_ns"}
        stated = [name for name, value in values.items() if value is not None and value is not False]
        return [f"--{_OPTION_OF.get(name, name)}" for name in stated]


_OPTION_OF = {"rate_hz": "rate", "channels": "channel", "covariates": "covariate", "forces": "force"}
_OPTION_OF |= {"start_ns": "start", "zone": "timezone"}
"""Field of `Options` -> option of the command line, where they differ. [names; definition]"""


@dataclass(frozen=True, slots=True)
class Limits:
    """Bounds on what a damaged or hostile file may cost."""

    unpacked_bytes: int = _UNPACKED_BYTES
    """Most that any archive may unpack to, however small it is."""
    reader_s: float = own_process.LEAST_S
    """Longest time in which a small file is read by a process of its own."""


@dataclass(frozen=True, slots=True)
class File:
    """A file to be read."""

    path: Path
    raw: bytes = field(repr=False)
    options: Options
    limits: Limits
    on_warning: OnWarning
    is_packed: bool = False
    """Whether another file holds it."""
    wanted: tuple[str, ...] = ()
    """Columns of a table of text that alone are read, the times first; by default all."""

    @property
    def most_bytes(self) -> int:
        """Most that the file may unpack to."""
        return min(_MOST_UNPACKED_BYTES, max(self.limits.unpacked_bytes, _UNPACKED_RATIO * len(self.raw)))

    @property
    def suffix(self) -> str:
        """Suffix in lower case."""
        return self.path.suffix.casefold()

    def holding(self, raw: bytes, path: Path | None = None) -> File:
        """Return the file that this one holds, packed."""
        return replace(self, raw=raw, path=path or self.path, is_packed=True)

    def demand_room(self, size: int) -> None:
        """Raise BadInputError if the file unpacks to more bytes than it may."""
        try:
            own_process.demand_room(size, self.most_bytes)
        except ValueError as error:
            raise BadInputError(f"{self.path}: {error}") from error

    def read_apart(self, module: str, kind: str) -> tuple[own_process.Arrays, own_process.Told]:
        """Read the file's arrays, and what is told of them, in a process of its own (`own_process.read_apart`)."""
        with TemporaryDirectory() as folder:
            path = self.path
            if self.is_packed:
                path = Path(folder, self.path.name)
                path.write_bytes(self.raw)
            try:
                return own_process.read_apart(module, kind, path, self.most_bytes, self.limits.reader_s)
            except BadInputError as error:
                raise BadInputError(str(error).replace(str(path), str(self.path))) from error


class Reader(Protocol):
    """Reader of one format; entry points of group ``shm_monitor.readers`` add readers of other distributions."""

    name: str
    """Of the format, for messages."""

    def is_mine(self, file: File) -> bool:
        """Test whether a file is of this format, by its first bytes or, where these do not tell it, by its suffix."""

    def read(self, file: File) -> list[Table]:
        """Convert a file to tables, one for each clock; raise BadInputError if it is damaged."""


def demand_file(path: Path) -> None:
    """Raise MissingInputError if there is no such file."""
    if not path.is_file():
        raise MissingInputError(f"{path}: {'is no file' if path.exists() else 'does not exist'}")


def read_bytes(path: Path) -> bytes:
    """Read a file; raise MissingInputError if it cannot be read."""
    try:
        demand_file(path)
        return path.read_bytes()
    except (OSError, ValueError) as error:
        raise MissingInputError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from error
