"""Reads recordings for the commands: blocks in time order, progress, and errors that name the recordings."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property
from math import inf
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from drivers.base import ACCELERATION, UNIT_OF, RecordingError, SampleBlock
from drivers.mcap_file import read_recordings, recorded_time
from monitor.config import Configuration
from monitor.core import BadInputError, ModalEstimate, OnProgress, Step, read_by_user
from monitor.identification import LEAST_PERIODS, LEAST_RECORD_S
from monitor.pipeline import Pipeline, Result
from monitor.publish import recorded_stretches
from monitor.signals import sample_clock

OnWarning = Callable[[str], None]
"""Shows a warning to the user."""

_BLOCK_S = 30.0
"""Greatest length of a joined block, s: about what one chunk of our own recordings holds at 1024 Hz.  Longer blocks save no
more calls."""
_ROUNDING_S = 1e-3
"""Time by which a window may reach over the end of a recording and lie within it. [s; rounding: below one sample at 100 Hz]"""
_UNTOLD_S = 60.0
"""Data up to which the length of the recordings is not asked for, as of one without an index it takes time. [s; judgement]"""
_LEAST_OVERLAP_S = 1.0
"""Overlap of two recordings up to which they follow one another. [s; judgement: as of the runs of an archive]"""


def read_blocks(
    paths: Sequence[Path], config: Configuration, on_warning: OnWarning, longest_s: float = _BLOCK_S
) -> Iterator[SampleBlock]:
    """Read what a site evaluates of its recordings, small blocks joined to at most `longest_s` (errors as `read_topics`)."""
    topics = tuple(dict.fromkeys([*UNIT_OF, *(table.topic for table in config.covariates)]))
    return read_topics(paths, topics, on_warning, longest_s, config.topics)


def read_topics(
    paths: Sequence[Path],
    topics: tuple[str, ...] | None,
    on_warning: OnWarning,
    longest_s: float = _BLOCK_S,
    topic_map: Mapping[str, str] | None = None,
) -> Iterator[SampleBlock]:
    """Read all samples of the topics (None: of all) of recordings in time order, small blocks joined to at most `longest_s`."""
    with read_by_user():
        yield from read_recordings(
            list(paths),
            topics=topics,
            topic_map=topic_map or None,
            on_warning=on_warning,
            longest_s=longest_s,
            evenly=evenly,
        )


def evenly(stamps_ns: NDArray[np.int64]) -> tuple[float, NDArray[np.int64]]:
    """Find rate, Hz, and evenly spaced stamps, ns, of a topic's stamps; ValueError where they tell no rate."""
    try:
        found = sample_clock(stamps_ns)
    except BadInputError as error:
        raise ValueError(str(error)) from error
    return found.rate_hz, found.even_ns


class RecordedSpan(NamedTuple):
    """Time that a recording covers."""

    file: str
    t_begin_ns: int
    """UTC of the first sample."""
    t_end_ns: int
    """UTC one sampling period after the last sample."""


def recorded_spans(paths: list[Path], config: Configuration) -> list[RecordedSpan]:
    """Return the time that each recording of accelerations covers, in the order of their beginnings."""
    spans = []
    for path in paths:
        try:
            begin_ns, end_ns = recorded_time(path, topic_map=config.topics or None, evenly=evenly)
        except (RecordingError, KeyError):  # of other quantities alone, such as temperature
            continue
        spans.append(RecordedSpan(path.name, begin_ns, end_ns))
    return sorted(spans, key=lambda span: span.t_begin_ns)


def without_window(spans: list[RecordedSpan], window_s: float, hop_s: float) -> list[str]:
    """Say within which recordings, joined where they follow one another, no window lies; `spans` in the order of time.

    Examples
    --------
    >>> spans = [RecordedSpan("a.mcap", 0, 30_000_000_000), RecordedSpan("b.mcap", 50_000_000_000, 59_000_000_000)]
    >>> without_window(spans, window_s=10.0, hop_s=2.0)[0].partition(":")[0]
    'b.mcap'
    """
    out, hop_ns, window_ns = [], round(hop_s * 1e9), round((window_s - _ROUNDING_S) * 1e9)
    for begin_ns, end_ns in recorded_stretches(span._asdict() for span in spans):
        wait_ns = (spans[0].t_begin_ns - begin_ns) % hop_ns  # windows begin whole hops after the first recording
        if begin_ns + wait_ns + window_ns > end_ns:
            names = ", ".join(span.file for span in spans if begin_ns <= span.t_begin_ns < end_ns)
            out.append(
                f"{names}: {(end_ns - begin_ns) * 1e-9:.6g} s in one piece hold no window of {window_s:g} s, of which one "
                f"begins every {hop_s:g} s: nothing of it was judged; set a shorter window_s under [processing]"
            )
    return out


def overlaps(spans: list[RecordedSpan]) -> list[str]:
    """Say which recordings overlap in time, and for how long; `spans` in the order of their beginnings.

    Examples
    --------
    >>> overlaps([RecordedSpan("a.mcap", 0, 9_000_000_000), RecordedSpan("b.mcap", 5_000_000_000, 12_000_000_000)])
    ['a.mcap and b.mcap overlap by 4 s']
    """
    out = []
    for i, first in enumerate(spans):
        for second in spans[i + 1 :]:
            length_s = (min(first.t_end_ns, second.t_end_ns) - second.t_begin_ns) * 1e-9
            if length_s > _LEAST_OVERLAP_S:
                out.append(f"{first.file} and {second.file} overlap by {length_s:.6g} s")
    return out


def duration_s(first: SampleBlock | None, last: SampleBlock | None) -> float:
    """Return the seconds from the first block's start to the last block's end; 0 without blocks.

    Examples
    --------
    >>> import numpy as np
    >>> first = SampleBlock(ACCELERATION, 0, 0, 10.0, ("a1",), "m/s^2", np.zeros((20, 1), np.float32))
    >>> duration_s(first, first)
    2.0
    """
    if first is None or last is None:
        return 0.0
    return (last.t_ns - first.t_ns) * 1e-9 + last.n_samples / last.sample_rate_hz


_READING = Step("", unit="min of data")


class Progress:
    """Progress through the data of recordings, with a check that they are long enough for one window.

    `on_progress` is told after each block how much of the accelerations of `paths` there was, in the words of `step`; `spans`
    are theirs, where they are known.
    """

    def __init__(
        self,
        on_progress: OnProgress,
        paths: Sequence[Path] = (),
        topics: Mapping[str, str] | None = None,
        step: Step = _READING,
        spans: Sequence[RecordedSpan] | None = None,
    ) -> None:
        self.first: SampleBlock | None = None
        """First block of acceleration."""
        self.last: SampleBlock | None = None
        """Latest block of acceleration."""
        self.data_s = 0.0
        """Length of the acceleration data so far, the time between recordings apart."""
        self._on_progress, self._step = on_progress, step._replace(unit=_READING.unit)
        self._paths, self._topics, self._spans = paths, topics or None, spans

    def add(self, block: SampleBlock) -> None:
        """Count a block."""
        if block.topic == ACCELERATION:
            self.first = self.first or block
            self.last = block
            self.data_s += block.n_samples / block.sample_rate_hz
            if self.data_s >= _UNTOLD_S:
                self._on_progress(self._step._replace(done=self.data_s / 60.0, total=self._total_s / 60.0))

    @cached_property
    def _total_s(self) -> float:
        """Length of the accelerations, s; 0 where a recording does not tell."""
        if self._spans is not None:
            return sum(span.t_end_ns - span.t_begin_ns for span in self._spans) * 1e-9
        try:
            spans = [recorded_time(path, topic_map=self._topics, evenly=evenly) for path in self._paths]
        except (RecordingError, KeyError):
            return 0.0
        return sum(end_ns - begin_ns for begin_ns, end_ns in spans) * 1e-9

    def require_window(self, pipeline: Pipeline, windows: int, paths: list[Path]) -> None:
        """Raise BadInputError for recordings that did not fill one window; the message gives the length of the usable data."""
        if windows:
            return
        state, window_s = pipeline.state.align, pipeline.config.processing.window_s
        usable = state.n_run / state.rate_hz
        lost = f" ({state.dropped} samples were repeated, late or not finite)" if state.dropped else ""
        raise BadInputError(
            f"{file_names(paths)}: {usable:.1f} s of usable data without a gap{lost}, but one window takes {window_s:g} s; "
            "record longer or set a shorter window_s under [processing]"
        )

    def require_periods(self, windows: Sequence[ModalEstimate], paths: list[Path]) -> None:
        """Raise BadInputError for recordings too short to learn modes of: `LEAST_RECORD_S`, and `LEAST_PERIODS` of each mode."""
        lowest_hz = min((float(modes.frequencies_hz.min(initial=inf)) for modes in windows), default=inf)
        least_s = max(LEAST_RECORD_S, LEAST_PERIODS / lowest_hz)
        if self.data_s < least_s * (1.0 - 1e-9):
            raise BadInputError(
                f"{file_names(paths)}: {self.data_s:.3g} s of data are too short to state modes from "
                f"{lowest_hz:.3g} Hz on; {least_s:.3g} s are the least"
            )


def file_names(paths: Sequence[Path]) -> str:
    """Join the recordings' names for a message."""
    return ", ".join(map(str, paths))


class BlockConsumer(Protocol):
    """Interface of a pipeline, or of a session around one."""

    def push(self, block: SampleBlock) -> list[Result]:
        """Take a block, and return its results."""


def push_block(consumer: BlockConsumer, block: SampleBlock, paths: list[Path]) -> list[Result]:
    """Push a block of the recordings `paths`, and return its results; BadInputError with their names if it is refused."""
    try:
        return consumer.push(block)
    except BadInputError as error:
        raise BadInputError(f"{file_names(paths)}: {error}") from error
