"""Imports CAN logs (.blf .asc .log .trc .mf4) with the driver that reads buses too, so that both give the same samples."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from drivers.base import EndOfStream, SampleBlock, SourceContext, SourceError
from drivers.can_bus import CanSource
from drivers.can_open import LOG_SUFFIXES, CanSettings
from drivers.frames import FrameError
from drivers.mcap_file import McapWriter, RecordingInfo, recording_info
from monitor.core import BadInputError
from monitor.runs.readers.base import Options, demand_file
from monitor.runs.readers.table import OnWarning

_UNREPORTED_COUNTS = ("frames", "samples", "foreign", "overruns")
"""Counts that are no errors, or that other counts include."""


def is_log(path: Path) -> bool:
    """Test whether a file is a CAN log, by its suffix."""
    return path.suffix.lower() in LOG_SUFFIXES


def import_log(files: list[Path], out: Path, options: Options, on_warning: OnWarning) -> RecordingInfo:
    """Write the samples of a log, at a nominal rate which is required, as a recording, and return its content.

    Raises BadInputError if log or DBC cannot be used, or where no bus is named and two of the log carry the same identifier;
    MissingInputError if one of them cannot be read.
    """
    path, dbc, rate_hz, bus = files[0], options.dbc, options.rate_hz, options.bus
    _demand_use(files, options)
    assert dbc is not None
    assert rate_hz is not None
    for option in options.given():
        if option not in ("--rate", "--dbc", "--bus"):
            on_warning(f"{path}: {option} is not used: the DBC states the units, and the log its times")
    settings = CanSettings(
        interface="log", channel=str(path.resolve()), dbc=str(dbc.resolve()), sample_rate_hz=rate_hz, bus=bus
    )
    try:
        source = CanSource(settings, SourceContext(channels=()))
        blocks = _blocks(source)
        first = next(blocks, None)
    except FrameError as error:
        raise BadInputError(str(error)) from error
    except SourceError as error:  # of a log that cannot be opened it names the file
        text = str(error)
        raise BadInputError(text if str(path) in text or str(path.resolve()) in text else f"{path}: {text}") from error
    if first is None:
        raise BadInputError(_says_none(path, source, bus))
    try:
        with McapWriter(out) as writer:
            writer.write(first)
            for block in blocks:
                writer.write(block)
    except SourceError as error:
        raise BadInputError(f"{path}: {error}") from error
    health = source.health()
    for name, count in health.counts.items():
        if count and name not in _UNREPORTED_COUNTS:
            on_warning(f"{path}: {count} {name.replace('_', ' ')}")
    if health.detail:
        on_warning(f"{path}: {health.detail}")
    return recording_info(out)


def _says_none(path: Path, source: CanSource, bus: str | None) -> str:
    """Say that a log holds none of the frames that are looked for, and what it holds."""
    names = ", ".join(f"{layout.name} ({layout.frame_id:#x})" for layout in source.layouts)
    if bus is not None and source.buses:
        names += f" on bus {bus}, but on {', '.join(sorted(source.buses))}"
    counts, detail = source.health().counts, source.health().detail
    return (
        f"{path}: no samples of {names}; it holds {counts['foreign']} other and {counts['undecodable']} undecodable "
        f"frames{f': {detail}' if detail else ''}"
    )


def _demand_use(files: list[Path], options: Options) -> None:
    """Refuse files and options that are not those of one CAN log."""
    for reason, holds in {
        "--align is for several files with clocks of their own; this is a CAN log": options.align,
        "import CAN logs one by one": len(files) > 1,
        "a CAN log needs --dbc FILE.dbc to say what its frames mean": options.dbc is None,
        "its DBC names the channels and it has times: no --channel, --ground, --start": options.start_ns is not None
        or any((options.channels, options.forces, options.ground, options.covariates)),
        "neither frames nor DBC tell the sample rate; give --rate HZ": options.rate_hz is None,
        f"--rate {options.rate_hz}: at most 1e6 Hz": options.rate_hz is not None and options.rate_hz > 1e6,
    }.items():
        if holds:
            raise BadInputError(f"{files[0]}: {reason}")
    for file in filter(None, (files[0], options.dbc)):
        demand_file(file)


def _blocks(source: CanSource) -> Iterator[SampleBlock]:
    """Read all blocks of a source, and close it."""
    try:
        with suppress(EndOfStream):
            source.open()
            while (block := source.read(1.0)) is not None:
                yield block
    finally:
        source.close()
