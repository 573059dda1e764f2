"""CAN source: frames of any interface of python-can, or of a log file, decoded by a DBC to blocks of samples."""

from __future__ import annotations

import contextlib
from collections import Counter, deque
from collections.abc import Callable, Iterator
from time import monotonic
from typing import IO, Any

import can
import numpy as np

from drivers import frames
from drivers.base import ACCELERATION, EndOfStream, SampleBlock, SourceContext, SourceError, SourceHealth
from drivers.can_open import PARSE_ERRORS, CanSettings, first_bus, is_malformed, open_bus, open_log
from drivers.nodes import Joiner, Node, Rows

_BUS_OFF = 0x40
_CONTROLLER = 0x04
_OVERRUN = 0x01
_WAIT_S = 0.2


class CanSource:
    """Source of blocks from the frames of a DBC's messages (`drivers.base.Source`).

    Silence and waits are measured by `clock`, s; `connect` opens the bus.  Raises `frames.FrameError`, a `ValueError`, if the
    DBC cannot be read or does not carry the channels.
    """

    Settings = CanSettings

    def __init__(
        self,
        settings: CanSettings,
        context: SourceContext,
        *,
        clock: Callable[[], float] = monotonic,
        connect: Callable[[CanSettings, tuple[tuple[int, bool], ...]], can.BusABC] = open_bus,
    ) -> None:
        self._settings, self._folder, self._clock, self._connect = settings, context.folder, clock, connect
        self.layouts = frames.load(context.folder / settings.dbc, context.channels)
        self.channels = context.channels or tuple(name for layout in self.layouts for name in layout.channels)
        rate, by_frame = settings.sample_rate_hz, settings.counter_counts == "frames"
        self._nodes = tuple(Node(layout, rate, by_frame) for layout in self.layouts)
        self._joiner = Joiner(self._nodes, self.channels, rate, settings.realign)
        self._by_id = {(node.layout.frame_id, node.layout.extended): node for node in self._nodes}
        self._batch = sum(-(-settings.block_samples // node.layout.n_samples) for node in self._nodes)
        self._two_blocks_s = 2.0 * settings.block_samples / rate
        self._patience_s = min(0.25, self._two_blocks_s)
        """Longest wait for a whole block."""
        self._bus: can.BusABC | None = None
        self._log: Iterator[can.Message] | None = None
        self.buses: set[str] = set()
        """Buses of the log on which the DBC's identifiers came."""
        self._first_bus = first_bus(str(settings.channel))
        self._bus_of: dict[tuple[int, bool], str] = {}
        self._file: IO[Any] | None = None
        self._failed = ""
        self._ended = False
        self._pending, self._since = 0, 0.0
        self._off_since: float | None = None
        self._ready: deque[SampleBlock] = deque()
        self._counts = dict.fromkeys(("frames", "foreign", "undecodable", "error_frames", "overruns", "bus_off"), 0)
        self._samples = 0

    def open(self) -> None:
        """Connect to the bus, or open the log file."""
        self.close()
        self._failed, self._off_since = "", None
        if self._settings.interface == "log":
            if self._ended:
                return
            self._file, self._log = open_log(self._folder / str(self._settings.channel))
            return
        self._bus = self._connect(self._settings, tuple(self._by_id))
        self._joiner.reset()

    def read(self, timeout_s: float) -> SampleBlock | None:
        """Return the next block, shorter than `block_samples` where samples are lost or the bus is slow; None if none in time."""
        deadline = self._clock() + timeout_s
        while not self._ready:
            if self._failed:
                raise SourceError(self._failed)
            if self._ended:
                raise EndOfStream
            if self._log is not None:
                self._read_log()
            elif self._bus is None:
                raise SourceError("not open")
            elif not self._receive(self._bus, deadline):
                break
        return self._ready.popleft() if self._ready else None

    def health(self) -> SourceHealth:
        """Return the counts so far, and the clocks."""
        counts = Counter({**self._counts, "samples": self._samples})
        for node in self._nodes:
            counts.update(node.counts())
        counts.update(unmatched=self._joiner.unmatched, realigned=self._joiner.realigned)
        connected = self._bus is not None or self._log is not None
        clocks = tuple(node.health() for node in self._nodes if node.line is not None)
        return SourceHealth(connected and not self._failed, dict(counts), clocks, self._failed or self._detail())

    def close(self) -> None:
        """Leave the bus; `read` still returns blocks that had arrived."""
        bus, self._bus, self._log = self._bus, None, None
        if self._pending:
            self._process_frames()
        if self._file is not None:
            self._file.close()
        if bus is not None:
            with contextlib.suppress(can.CanError, OSError):
                bus.shutdown()

    def _detail(self) -> str:
        """Describe the alignment of the nodes, and the nodes that do not run in real time."""
        notes = [self._joiner.detail] if len(self._nodes) > 1 and self._joiner.detail else []
        free = [n.layout.name for n in self._nodes if len(n.clock.offsets) >= 5 and not n.clock.real_time]
        if free:
            notes.append(f"{', '.join(free)} does not run in real time at the nominal rate: time is its count")
        return "; ".join(notes)

    def _receive(self, bus: can.BusABC, deadline: float) -> bool:
        """Receive frames until they fill a block; False if the deadline passes first."""
        n_received = 0
        while self._pending < self._batch and not self._failed:
            is_silent = not self._receive_frame(bus, max(0.0, min(_WAIT_S, deadline - self._clock())))
            n_received += 1
            if (is_silent or n_received % 64 == 0) and self._clock() >= deadline:
                # A short timeout of the caller must not give small blocks: frames stay pending up to `_patience_s`.
                if not (self._failed or (self._pending and self._clock() - self._since >= self._patience_s)):
                    return False
                break
        self._process_frames()
        return bool(self._ready or self._failed) or self._clock() < deadline

    def _receive_frame(self, bus: can.BusABC, timeout_s: float) -> bool:
        """Receive one frame or malformed message; False if there is none, or the bus failed."""
        try:
            message = bus.recv(timeout_s)
        except PARSE_ERRORS as error:
            if is_malformed(error, self._settings.interface):
                self._counts["undecodable"] += 1
                return True
            self._failed = str(error).splitlines()[0] if str(error) else type(error).__name__
            return False
        if message is not None:
            self._accept_frame(message)
        if self._is_off(bus, message):
            self._counts["bus_off"] += 1
            self._failed = "bus off"
        return message is not None

    def _is_off(self, bus: can.BusABC, message: can.Message | None) -> bool:
        """Test whether the controller is off the bus, after `message` or, if that is None, silence.

        Anyone may forge an error frame that says so: it is believed if the controller says so too, which few interfaces of
        python-can can tell, or if no frame follows for the time of two blocks: a controller that is off receives nothing.
        """
        if message is not None:
            return message.is_error_frame and bus.state is can.BusState.ERROR
        return self._off_since is not None and self._clock() - self._off_since >= self._two_blocks_s

    def _read_log(self) -> None:
        """Read frames from the log until they fill a block or the log ends."""
        assert self._log is not None
        try:
            while self._pending < self._batch:
                message = next(self._log, None)
                if message is None:
                    self._ended = True
                    break
                self._accept_frame(message)
        except SourceError as error:
            self._failed, self._ended = str(error), True
        except PARSE_ERRORS as error:
            self._counts["undecodable"] += 1
            self._joiner.detail = f"the log is damaged: {error or type(error).__name__}"
            self._ended = True
        self._process_frames(everything=self._ended)

    def _accept_frame(self, message: can.Message) -> None:
        """Count a frame, and pass it to its node."""
        kind = message.arbitration_id
        # Over udp_multicast a sender states the type of each field.
        if not isinstance(kind, int):
            self._counts["undecodable"] += 1
            return
        if message.is_error_frame:
            self._accept_error_frame(kind, message.data)
            return
        self._off_since = None
        node = self._by_id.get((kind, bool(message.is_extended_id)))
        if node is None or (self._log is not None and not self._is_of_bus(node, message)):
            self._counts["foreign"] += 1
            return
        n, data = node.layout.n_bytes, message.data
        # FD frames have certain lengths only and are padded.
        if message.is_remote_frame or len(data) < n or (len(data) > n and n < 8):
            self._counts["undecodable"] += 1
            return
        if not self._pending:
            self._since = self._clock()
        self._pending += 1
        self._counts["frames"] += 1
        node.frames.append(bytes(data[:n]))
        node.times.append(message.timestamp)

    def _is_of_bus(self, node: Node, message: can.Message) -> bool:
        """Test whether a log's frame is of the chosen bus; SourceError where none is chosen and two carry an identifier."""
        key, bus = (node.layout.frame_id, node.layout.extended), message.channel
        name = str(bus + self._first_bus if isinstance(bus, int) else bus)
        self.buses.add(name)
        if self._settings.bus is not None:
            return name == self._settings.bus
        if (first := self._bus_of.setdefault(key, name)) != name:
            what = f"{node.layout.name} ({key[0]:#x}) comes on the buses {first} and {name} of the log"
            raise SourceError(f"{what}: choose one, as --bus {name}, or bus = {name!r} under [source]")
        return True

    def _accept_error_frame(self, kind: int, data: bytearray) -> None:
        """Count an error frame; `kind` are the bits of Linux, which socketcan, socketcand and gs_usb carry."""
        self._counts["error_frames"] += 1
        if kind & _CONTROLLER and len(data) > 1 and data[1] & _OVERRUN:
            self._counts["overruns"] += 1
        if kind & _BUS_OFF and self._log is not None:
            self._counts["bus_off"] += 1
        elif kind & _BUS_OFF and self._off_since is None:
            self._off_since = self._clock()

    def _process_frames(self, *, everything: bool = False) -> None:
        """Decode the pending frames to blocks."""
        self._pending = 0
        try:
            self._append_blocks(self._joiner.join(everything=everything))
        except SourceError as error:
            self._failed = str(error)
            self._ended = self._log is not None

    def _append_blocks(self, rows: Rows) -> None:
        """Cut rows into blocks of consecutive samples that have the same anchor of time."""
        index, samples = rows
        line = self._nodes[0].line
        if line is None:
            return
        start, last = 0, len(index)
        while start < last:
            first = int(index[start])
            stop = min(start + self._settings.block_samples, last)
            broken = np.flatnonzero(np.diff(index[start:stop]) != 1)
            stop = start + int(broken[0]) + 1 if len(broken) else stop
            shift = line.next_shift(first)
            if shift is not None:
                stop = min(stop, start + shift - first)
            block, rate, t_ns = samples[start:stop], self._settings.sample_rate_hz, line.at(first)
            if first >= 0 and t_ns >= 0:
                self._ready.append(SampleBlock(ACCELERATION, t_ns, first, rate, self.channels, "m/s^2", block))
                self._samples += len(block)
            start = stop
