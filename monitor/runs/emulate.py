"""Emulates sensor nodes: sends a stream of blocks over CAN, Zenoh or MQTT at its real pace."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Protocol

import can
import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from drivers import frames
from drivers.base import ACCELERATION, SampleBlock, SourceError
from drivers.frames import Layout
from drivers.socketcand_server import SocketcandServer, frame_text
from monitor.core import BadConfigurationError, BadInputError, MissingInputError, parse_address, settings_problems

CAN_BURST_S = 0.01
"""Length of data, s, whose frames are sent in one burst, as by a node's transmit queue."""
BLOCK_SAMPLES = 128
"""Number of samples in a block over Zenoh or MQTT."""
DESTINATIONS = "can:socketcand-server:HOST:PORT, can:INTERFACE:CHANNEL, zenoh:MODE:ENDPOINT:KEY or mqtt:HOST:PORT:TOPIC"


class Sink(Protocol):
    """Destination of a stream of blocks."""

    def send(self, block: SampleBlock) -> None:
        """Send a block."""

    def close(self) -> None:
        """Finish the transmission and disconnect."""


def send_when_due(blocks: Iterable[SampleBlock], sink: Sink, *, speed: float | None = 1.0) -> int:
    """Send blocks, in time order, when they are due, and return the number of samples sent of `/acceleration`.

    `speed` is a multiple of real time; None sends all blocks at once.
    """
    begun, first_ns, count = time.monotonic(), None, 0
    for block in blocks:
        if first_ns is None:
            first_ns = block.t_ns
        if speed is not None:
            due_s = ((block.t_ns - first_ns) * 1e-9 + block.n_samples / block.sample_rate_hz) / speed
            time.sleep(max(0.0, begun + due_s - time.monotonic()))
        sink.send(block)
        count += block.n_samples if block.topic == ACCELERATION else 0
    return count


def cut_blocks(blocks: Iterable[SampleBlock], n_samples: int) -> Iterator[SampleBlock]:
    """Cut blocks at the sequence numbers that are multiples of `n_samples`."""
    for block in blocks:
        start = 0
        while start < block.n_samples:
            stop = min(block.n_samples, start + n_samples - (block.sequence + start) % n_samples)
            t_ns = block.t_ns + round(start / block.sample_rate_hz * 1e9)
            yield replace(block, t_ns=t_ns, sequence=block.sequence + start, samples=block.samples[start:stop])
            start = stop


Transmit = Callable[[Layout, list[float], NDArray[np.uint8]], None]
"""Sends n frames of one message, given its layout, the UTC of each frame, s, and the bytes, a row a frame."""


class CanSink:
    """Destination on a CAN bus: sends the blocks of `/acceleration` as frames of a DBC, and ignores other topics.

    A frame has the time of its last sample; its counter counts samples, or frames if `counts_frames`.
    """

    def __init__(
        self, layouts: tuple[Layout, ...], transmit: Transmit, close: Callable[[], None], *, counts_frames: bool = False
    ) -> None:
        self._layouts, self._transmit, self._close, self._by_frame = layouts, transmit, close, counts_frames
        self._rest: dict[str, SampleBlock] = {}
        self.saturated = 0
        """Number of values outside the range of the DBC, sent as the nearest value within."""
        self.left_out = 0
        """Number of samples that did not fill a frame."""

    def send(self, block: SampleBlock) -> None:
        """Quantise a block and send its frames."""
        if block.topic != ACCELERATION:
            return
        for layout in self._layouts:
            self._send(layout, block)

    def close(self) -> None:
        """Disconnect; samples that did not fill a frame are left out."""
        self.left_out += sum(rest.n_samples for rest in self._rest.values())
        self._rest = {}
        self._close()

    def _send(self, layout: Layout, block: SampleBlock) -> None:
        """Send the whole frames of one message, and keep the remaining samples for the next block."""
        n = layout.n_samples
        rest = self._rest.pop(layout.name, None)
        if rest is not None and rest.sequence + rest.n_samples == block.sequence:
            block = replace(rest, samples=np.concatenate((rest.samples, block.samples)))
        elif rest is not None:
            self.left_out += rest.n_samples
        # Frames begin at multiples of their number of samples, independent of where blocks begin.
        skip = -block.sequence % n
        self.left_out += min(skip, block.n_samples) if rest is None else 0
        whole = max(0, block.n_samples - skip) // n * n
        if block.n_samples > skip + whole:
            end = skip + whole
            t_ns = block.t_ns + round(end / block.sample_rate_hz * 1e9)
            self._rest[layout.name] = replace(
                block, t_ns=t_ns, sequence=block.sequence + end, samples=block.samples[end:]
            )
        if not whole:
            return
        columns = [block.channels.index(name) for name in layout.channels]
        at = np.arange(skip, skip + whole, n)
        numbers = block.sequence + at
        data, saturated = layout.encode(
            block.samples[skip : skip + whole, columns].astype(np.float64), numbers // n if self._by_frame else numbers
        )
        self.saturated += saturated
        times = [(block.t_ns + round((k + n - 1) / block.sample_rate_hz * 1e9)) * 1e-9 for k in at.tolist()]
        self._transmit(layout, times, data)


def transmit_over_tcp(server: SocketcandServer) -> Transmit:
    """Return the function that sends frames to the clients of a socketcand server."""

    def transmit(layout: Layout, times: list[float], data: NDArray[np.uint8]) -> None:
        server.send(
            b"".join(
                frame_text(layout.frame_id, layout.extended, t_s, row.tobytes())
                for t_s, row in zip(times, data, strict=True)
            )
        )

    return transmit


def _transmit_over_bus(bus: can.BusABC) -> Transmit:
    """Return the function that sends frames on a bus of python-can."""

    def transmit(layout: Layout, times: list[float], data: NDArray[np.uint8]) -> None:
        for t_s, row in zip(times, data, strict=True):
            message = can.Message(
                timestamp=t_s,
                arbitration_id=layout.frame_id,
                is_extended_id=layout.extended,
                is_fd=layout.n_bytes > 8,
                data=row.tobytes(),
            )
            try:
                bus.send(message, timeout=1.0)
            except can.CanError as error:
                raise MissingInputError(f"the bus takes no frames: {error}") from error

    return transmit


def open_sink(
    to: str,
    channels: tuple[str, ...],
    *,
    dbc: Path | None = None,
    wait_s: float = 60.0,
    say: Callable[[str], None] = lambda _: None,
) -> tuple[Sink, float]:
    """Open the destination that `to` names, one of `DESTINATIONS`; CAN needs a `dbc`, the layout of its frames.

    `wait_s` is how long a socketcand server waits for its first client. With the sink comes the length of the blocks that it
    takes: s of data below 1, samples from 1 on.
    """
    kind, _, rest = to.partition(":")
    if kind in ("zenoh", "mqtt"):
        if dbc is not None:
            raise BadConfigurationError(f"--to {to!r}: --dbc is for CAN")
        return (_open_zenoh if kind == "zenoh" else _open_mqtt)(to, rest), BLOCK_SAMPLES
    interface, _, channel = rest.partition(":")
    if kind != "can" or not interface or not channel:
        raise BadConfigurationError(f"--to {to!r}: expected {DESTINATIONS}")
    if dbc is None:
        raise BadConfigurationError(f"--to {to!r}: CAN needs --dbc FILE.dbc")
    try:
        layouts = frames.load(dbc, channels)
    except frames.FrameError as error:
        raise BadConfigurationError(str(error)) from error
    if interface != "socketcand-server":
        try:
            bus = can.Bus(interface=interface, channel=channel, fd=any(layout.n_bytes > 8 for layout in layouts))
        except (can.CanError, OSError, ValueError, TypeError, ImportError) as error:
            raise MissingInputError(f"--to {to!r}: {error}") from error
        return CanSink(layouts, _transmit_over_bus(bus), bus.shutdown), CAN_BURST_S
    try:
        host, port = parse_address(channel, any_port=True)
    except ValueError:
        raise BadConfigurationError(f"--to {to!r}: expected {DESTINATIONS}") from None
    try:
        server = SocketcandServer(host, port)
    except OSError as error:
        raise MissingInputError(f"--to {to!r}: {error.strerror or error}") from error
    say(f"socketcand server on {host}:{server.port}, waiting for a client")
    if not server.wait_for_client(wait_s):
        server.close()
        raise MissingInputError(f"--to {to!r}: no client came within {wait_s:g} s")
    return CanSink(layouts, transmit_over_tcp(server), server.close), CAN_BURST_S


@contextmanager
def _errors_of(to: str) -> Iterator[None]:
    """Raise the errors of opening a destination as errors of the user, who named it."""
    try:
        yield
    except (ImportError, SourceError) as error:
        kind = MissingInputError if isinstance(error, SourceError) else BadConfigurationError
        raise kind(f"--to {to!r}: {error}") from error
    except ValidationError as error:
        raise BadConfigurationError(f"--to {to!r}: {'; '.join(settings_problems(error))}") from error
    except ValueError:
        raise BadConfigurationError(f"--to {to!r}: expected {DESTINATIONS}") from None


def _open_mqtt(to: str, rest: str) -> Sink:
    with _errors_of(to):
        from drivers.mqtt import MqttPublisher, PublisherSettings

        place, _, topic = rest.rpartition(":")
        host, port = parse_address(place)
        return MqttPublisher(PublisherSettings.model_validate({"host": host, "port": port, "topic": topic}))


def _open_zenoh(to: str, rest: str) -> Sink:
    from drivers.zenoh_bus import PublisherSettings, ZenohPublisher

    mode, _, place = rest.partition(":")
    endpoint, _, key = place.rpartition(":")
    if not endpoint or not key:
        raise BadConfigurationError(f"--to {to!r}: expected {DESTINATIONS}")
    where = {"listen" if mode == "router" else "connect": [endpoint]}
    with _errors_of(to):
        return ZenohPublisher(PublisherSettings.model_validate({"mode": mode, "key": key, **where}))


def send_all(
    blocks: Iterable[SampleBlock], to: str, *, dbc: Path | None, speed: float | None, say: Callable[[str], None]
) -> None:
    """Open the destination for the channels of the first block, send all blocks, and report saturated or omitted samples.

    Destination, `dbc` and errors are as of `open_sink`, the speed is as of `send_when_due`.  BadInputError is raised if there
    is no block of `/acceleration`.
    """
    stream = iter(blocks)
    head: list[SampleBlock] = []
    for block in stream:
        head.append(block)
        if block.topic == ACCELERATION:
            break
    else:
        raise BadInputError("nothing of /acceleration to send")
    sink, length = open_sink(to, head[-1].channels, dbc=dbc, say=say)
    try:
        n = round(length) if length >= 1 else max(1, round(length * head[-1].sample_rate_hz))
        count = send_when_due(cut_blocks(chain(head, stream), n), sink, speed=speed)
    finally:
        sink.close()
    say(f"{count} samples sent")
    if isinstance(sink, CanSink) and (sink.saturated or sink.left_out):
        say(f"{sink.saturated} numbers saturated, {sink.left_out} samples left out")
