"""Files of loggers: one class a format, one form of what is read, one recording that comes of it."""

from monitor.runs.readers.base import Limits, Options
from monitor.runs.readers.formats import explain_table
from monitor.runs.readers.recording import (
    ImportedChannel,
    acceleration_unit,
    are_recordings,
    as_recordings,
    doubt_unit,
    import_files,
)
from monitor.runs.readers.stamps import zone_named

__all__ = [
    "ImportedChannel",
    "Limits",
    "Options",
    "acceleration_unit",
    "are_recordings",
    "as_recordings",
    "doubt_unit",
    "explain_table",
    "import_files",
    "zone_named",
]
