"""Recordings as the commands read them: blocks in time order, and what is said when there is too little of them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Protocol

from drivers.base import ACCELERATION, RecordingError, RecordingMissingError, SampleBlock
from drivers.mcap_file import read_recordings
from monitor.config import Configuration
from monitor.core import BadInputError, MissingInputError
from monitor.pipeline import Pipeline, Result

OnWarning = Callable[[str], None]
OnProgress = Callable[[float], None]


_MERGED_S = 30.0
"""About what a chunk of a recording of our own holds at 1024 Hz; no fewer calls come of more."""


def blocks(
    paths: list[Path], config: Configuration, on_warning: OnWarning, longest_s: float = _MERGED_S
) -> Iterator[SampleBlock]:
    """All samples of the recordings in time order, small blocks joined to blocks of at most `longest_s`.

    Raises
    ------
    MissingInputError, BadInputError
    """
    try:
        yield from read_recordings(paths, topic_map=config.topics or None, on_warning=on_warning, longest_s=longest_s)
    except RecordingMissingError as error:
        raise MissingInputError(str(error)) from error
    except RecordingError as error:
        raise BadInputError(str(error)) from error


def duration_s(first: SampleBlock | None, last: SampleBlock | None) -> float:
    """From the first block's start to the last one's end."""
    if first is None or last is None:
        return 0.0
    return (last.t_ns - first.t_ns) * 1e-9 + last.n_samples / last.sample_rate_hz


class Progress:
    """Follows the data's time, to say when there was too little of it."""

    def __init__(self, on_progress: OnProgress) -> None:
        self.first: SampleBlock | None = None
        self.last: SampleBlock | None = None
        self._tell = on_progress

    def saw(self, block: SampleBlock) -> None:
        """Follow a block."""
        if block.topic == ACCELERATION:
            self.first = self.first or block
            self.last = block
            self._tell(duration_s(self.first, block))

    def demand(self, pipeline: Pipeline, windows: int, paths: list[Path]) -> None:
        """Raise BadInputError if not even one window came about."""
        if windows:
            return
        state, window_s = pipeline.state.align, pipeline.config.processing.window_s
        usable = state.n_run / state.rate_hz
        lost = f" ({state.dropped} samples were repeated, late or not finite)" if state.dropped else ""
        raise BadInputError(
            f"{names(paths)}: {usable:.1f} s of usable data without a gap{lost}, but one window takes {window_s:g} s; "
            "record longer or set a shorter window_s under [processing]"
        )


def names(paths: list[Path]) -> str:
    """The recordings, for a message."""
    return ", ".join(map(str, paths))


class Taker(Protocol):
    """A pipeline, or what stands before one."""

    def push(self, block: SampleBlock) -> list[Result]:
        """Take a block in."""


def pushed(taker: Taker, block: SampleBlock, paths: list[Path]) -> list[Result]:
    """The results; what is refused is said of the recordings."""
    try:
        return taker.push(block)
    except BadInputError as error:
        raise BadInputError(f"{names(paths)}: {error}") from error
