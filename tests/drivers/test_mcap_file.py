"""Recordings: what is written comes back, in time order; what is damaged is named, never guessed."""

import io
import itertools
import json
import os
import random
import resource
import struct
import tarfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Channel, ChunkIndex, DataEnd, Footer, Header, Message as MessageRecord, Schema
from mcap.writer import CompressionType, Writer

from drivers import codec
from drivers.base import ACCELERATION, GROUND, TEMPERATURE, UNIT_OF, RecordingError, RecordingMissingError, SampleBlock
from drivers.mcap_file import McapWriter, read_recordings, recorded_time, recording_info, scan_messages
from drivers.mcap_index import read_index
from drivers.mcap_records import HEAD, MAGIC, McapFile
from drivers.mcap_writer import LIBRARY
from tests.support.any_block import blocks, same

DATA = Path(__file__).parents[1] / "data"
_S = 10**9


def block(second: int, topic: str = ACCELERATION, unit: str = "m/s^2", n: int = 100) -> SampleBlock:
    samples = np.random.default_rng(second).normal(size=(n, 2)).astype(np.float32)
    return SampleBlock(topic, 1_700_000_000 * _S + second * _S, 100 * second, 100.0, ("a1", "a2"), unit, samples)


def write(path: Path, *written: SampleBlock, chunk_every: int = 3) -> Path:
    with McapWriter(path) as writer:
        for count, item in enumerate(written, start=1):
            writer.write(item)
            if count % chunk_every == 0:
                writer.flush()
    return path


def foreign(path: Path, compression: CompressionType, chunked: bool, crcs: bool = False) -> Path:
    """The same ten blocks as another writer stores them."""
    with path.open("wb") as file:
        writer = Writer(file, compression=compression, use_chunking=chunked, chunk_size=2000, enable_crcs=crcs)
        writer.start()
        schema = writer.register_schema(codec.SCHEMA_NAME, "protobuf", codec.SCHEMA_BYTES)
        channel = writer.register_channel(ACCELERATION, "protobuf", schema)
        for second in range(10):
            writer.add_message(channel, block(second).t_ns, codec.encode(block(second)), block(second).t_ns)
        writer.finish()
    return path


every_layout = pytest.mark.parametrize(
    ("compression", "chunked", "crcs"),
    [
        *itertools.product(CompressionType, [True], [True, False]),
        *itertools.product([CompressionType.NONE], [False], [True, False]),
    ],
)

Rewrite = Callable[[bytes], Path]


@pytest.fixture
def rewrite(tmp_path: Path) -> Iterator[Rewrite]:
    """Gives a file another content each time, in its place: opening one anew for each would take most of the time."""
    path = tmp_path / "rewritten.mcap"

    def write(content: bytes) -> Path:
        file.seek(0)
        file.write(content)
        file.truncate()
        return path

    with path.open("wb", buffering=0) as file:
        yield write


def chunks(path: Path) -> list[ChunkIndex]:
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    return summary.chunk_indexes


def seconds(read: list[SampleBlock]) -> list[int]:
    return [item.sequence // 100 for item in read]


@given(written=blocks())
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=50)
def test_any_block_written_is_read_back(tmp_path: Path, written: SampleBlock) -> None:
    topic = next(name for name, unit in UNIT_OF.items() if unit == written.unit)
    path = tmp_path / "a.mcap"
    with McapWriter(path) as writer:
        writer.write(SampleBlock(topic, *(getattr(written, name) for name in written.__slots__[1:])))
    (read,) = read_recordings([path], (topic,))
    assert same(SampleBlock(ACCELERATION, *(getattr(read, name) for name in read.__slots__[1:])), written)


def test_the_index_names_every_chunk_and_its_first_and_last_time(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mcap", *map(block, range(9)))
    places = [(c.message_start_time, c.message_end_time, c.chunk_start_offset, c.chunk_length) for c in chunks(path)]
    found = read_index(recording := McapFile(path), LIBRARY)
    assert found is not None and len(places) == 3
    assert [(*times, segment.offset, segment.length) for *times, segment in found] == places
    assert [channel.topic for channel in recording.channels.values()] == [ACCELERATION]


def records(*written: Header | Schema | Channel | MessageRecord | DataEnd | Footer) -> bytes:
    builder = RecordBuilder()
    for one in written:
        one.write(builder)
    return bytes(builder.end())


def test_an_index_with_an_unreadable_record_defines_nothing(tmp_path: Path) -> None:
    sent = block(0)
    message = MessageRecord(
        channel_id=1, log_time=sent.t_ns, data=codec.encode(sent), publish_time=sent.t_ns, sequence=0
    )
    data = MAGIC + records(Header(profile="", library=LIBRARY), message)
    data += records(DataEnd(data_section_crc=zlib.crc32(data)))
    summary = records(
        Schema(id=1, name=codec.SCHEMA_NAME, encoding="protobuf", data=codec.SCHEMA_BYTES),
        Channel(id=1, topic=ACCELERATION, message_encoding="protobuf", metadata={}, schema_id=1),
    )
    summary += HEAD.pack(Opcode.CHUNK_INDEX, 4) + bytes(4)
    footer = records(Footer(summary_start=len(data), summary_offset_start=0, summary_crc=0))[:-4]
    crc = zlib.crc32(footer, zlib.crc32(summary))
    path = tmp_path / "a.mcap"
    path.write_bytes(data + summary + footer + crc.to_bytes(4, "little") + MAGIC)
    assert read_index(recording := McapFile(path), LIBRARY) is None
    assert not recording.channels and not recording.schemas
    with pytest.raises(RecordingError, match="a message of channel 1, which the file does not define"):
        read_recordings([path])


def test_the_same_blocks_give_the_same_bytes(tmp_path: Path) -> None:
    first = write(tmp_path / "a.mcap", *map(block, range(9))).read_bytes()
    assert write(tmp_path / "b.mcap", *map(block, range(9))).read_bytes() == first


def test_the_reference_reader_accepts_our_files_with_metadata_and_json(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with McapWriter(path, {"origin": {"seed": "7"}}) as writer:
        writer.write(block(0))
        writer.write_json("/results", 5, '{"a": 1}')
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        found = [
            (schema.name, schema.encoding, channel.message_encoding) for schema, channel, _ in reader.iter_messages()
        ]
        summary = reader.get_summary()
        (metadata,) = reader.iter_metadata()
    assert found == [("shm.results", "jsonschema", "json"), ("shm.SampleBlock", "protobuf", "protobuf")]
    assert {index.compression for index in summary.chunk_indexes} == {"zstd"}
    assert metadata.metadata == {"seed": "7"}


def test_nothing_stands_under_the_final_name_before_close_nor_after_an_error(tmp_path: Path) -> None:
    path = tmp_path / "made" / "a.mcap"
    with McapWriter(path) as writer:
        writer.write(block(0))
        writer.flush()
        assert [entry.name for entry in path.parent.iterdir()] == ["a.mcap.part"]
    assert [entry.name for entry in path.parent.iterdir()] == ["a.mcap"]
    with pytest.raises(KeyError), McapWriter(path.with_name("b.mcap")) as writer:
        writer.write(block(0))
        raise KeyError
    assert [entry.name for entry in path.parent.iterdir()] == ["a.mcap"]


def test_what_was_flushed_survives_a_crash(tmp_path: Path) -> None:
    writer = McapWriter(tmp_path / "a.mcap")
    for second in range(5):
        writer.write(block(second))
        if second == 3:
            writer.flush()
    left = tmp_path / "left.mcap"
    left.write_bytes(writer.part_path.read_bytes())
    writer.abort()
    warnings: list[str] = []
    assert seconds(list(read_recordings([left], on_warning=warnings.append))) == [0, 1, 2, 3]
    assert len(warnings) == 1 and "left.mcap" in warnings[0] and "4 whole blocks" in warnings[0]


@every_layout
def test_every_layout_is_read(tmp_path: Path, compression: CompressionType, chunked: bool, crcs: bool) -> None:
    path = foreign(tmp_path / "a.mcap", compression, chunked, crcs)
    assert all(same(read, block(second)) for second, read in enumerate(read_recordings([path])))
    assert recording_info(path).n_samples == 1000


@pytest.mark.parametrize("tail", [b"", bytes(5000)], ids=["cut", "zeros"])
def test_a_truncated_file_gives_its_whole_chunks_and_one_warning(tmp_path: Path, tail: bytes) -> None:
    whole = write(tmp_path / "a.mcap", *map(block, range(12))).read_bytes()
    ends = [index.chunk_start_offset + index.chunk_length for index in chunks(tmp_path / "a.mcap")]
    assert len(ends) == 4
    cut = tmp_path / "cut.mcap"
    for number, end in enumerate(ends, start=1):
        for size in (end - 1, end, end + 1, end + 20):
            cut.write_bytes(whole[:size] + tail)
            expected = 3 * (number - (size < end))
            warnings: list[str] = []
            if not expected:
                with pytest.raises(RecordingError, match=r"cut\.mcap: no block"):
                    list(read_recordings([cut]))
                continue
            assert seconds(list(read_recordings([cut], on_warning=warnings.append))) == list(range(expected))
            assert len(warnings) == 1 and f"{expected} whole blocks" in warnings[0]


def test_every_flipped_bit_of_our_files_is_noticed(tmp_path: Path, rewrite: Rewrite) -> None:
    whole = write(tmp_path / "a.mcap", *(block(second, n=10) for second in range(4))).read_bytes()
    for at in range(len(whole)):
        damaged = bytearray(whole)
        damaged[at] ^= 1 << at % 8
        warnings: list[str] = []
        try:
            list(read_recordings([rewrite(damaged)], on_warning=warnings.append))
        except RecordingError as error:
            assert "rewritten.mcap" in str(error)
        else:  # a flip in the last eight bytes looks like a cut there
            assert warnings, f"flip at {at} unnoticed"


def spoil(path: Path, *damaged: ChunkIndex) -> None:
    """Flip a bit in the middle of each of these chunks."""
    content = bytearray(path.read_bytes())
    for chunk in damaged:
        content[chunk.chunk_start_offset + chunk.chunk_length // 2] ^= 1
    path.write_bytes(content)


@pytest.mark.parametrize("ours", [True, False], ids=["our writer", "another writer"])
@pytest.mark.parametrize("which", [[0], [1], [-1], [0, 1]])  # the first one defines the channels of all
def test_damaged_chunks_are_left_out_and_told_before_the_first_block(
    tmp_path: Path, ours: bool, which: list[int]
) -> None:
    path = tmp_path / "a.mcap"
    if ours:
        write(path, *map(block, range(10)))
    else:
        foreign(path, CompressionType.ZSTD, True, crcs=True)
    damaged = [chunks(path)[number] for number in which]
    lost = {s for s in range(10) if any(c.message_start_time <= block(s).t_ns <= c.message_end_time for c in damaged)}
    spoil(path, *damaged)
    warnings: list[str] = []
    read = read_recordings([path], on_warning=warnings.append)
    (said,) = warnings
    assert f"a.mcap: damaged at byte {damaged[0].chunk_start_offset}: chunk" in said
    assert ("one chunk is" if len(which) == 1 else "2 chunks are") in said and f"{10 - len(lost)} blocks" in said
    assert lost and seconds(list(read)) == [s for s in range(10) if s not in lost]
    assert recording_info(path).n_samples == 100 * (10 - len(lost))


def test_a_file_of_damaged_chunks_alone_is_refused_with_the_place(tmp_path: Path) -> None:
    path = foreign(tmp_path / "a.mcap", CompressionType.ZSTD, True, crcs=True)
    spoil(path, *(every := chunks(path)))
    with pytest.raises(RecordingError, match=f"byte {every[0].chunk_start_offset}: chunk"):
        read_recordings([path])


@every_layout
def test_whatever_the_bytes_only_recording_errors_escape(
    tmp_path: Path, rewrite: Rewrite, compression: CompressionType, chunked: bool, crcs: bool
) -> None:
    whole = foreign(tmp_path / "a.mcap", compression, chunked, crcs).read_bytes()
    chance, refused = random.Random(4), 0
    for _ in range(400):
        data = bytearray(whole)
        at = chance.choice([chance.randrange(len(data)), chance.randrange(900)])
        match chance.randrange(5):
            case 0:
                data[at] ^= 1 << chance.randrange(8)
            case 1:
                del data[at:]
            case 2:
                data[at:at] = chance.randbytes(chance.randrange(1, 20))
            case 3:
                del data[at : at + chance.randrange(1, 20)]
            case _:
                data[at : at + 8] = b"\xff" * 8
        try:
            for item in read_recordings([rewrite(data)]):
                assert item.samples.shape[1] == len(item.channels)
        except RecordingError as error:
            assert "rewritten.mcap" in str(error)
            refused += 1
    assert refused > 100


@pytest.mark.parametrize("compression", [CompressionType.ZSTD, CompressionType.LZ4])
def test_a_chunk_that_unpacks_to_gigabytes_is_refused_without_unpacking(
    tmp_path: Path, compression: CompressionType
) -> None:
    import lz4.frame
    import zstandard

    packer = zstandard.compress if compression is CompressionType.ZSTD else lz4.frame.compress
    name = b"zstd" if compression is CompressionType.ZSTD else b"lz4"
    packed = packer(bytes(1 << 29))
    body = struct.pack("<QQQII", 0, 0, 1 << 29, 0, len(name)) + name + struct.pack("<Q", len(packed)) + packed
    path = tmp_path / "a.mcap"
    path.write_bytes(b"\x89MCAP0\r\n" + struct.pack("<BQ", 6, len(body)) + body)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(RecordingError, match="claims"):
        list(read_recordings([path]))
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 50_000  # KiB


def test_files_and_topics_are_merged_in_time_order_whatever_their_order(tmp_path: Path) -> None:
    late = write(tmp_path / "a.mcap", *map(block, range(20, 30)))
    early = write(tmp_path / "b.mcap", *map(block, range(10)))
    ground = [block(second, GROUND) for second in range(5, 25)]
    middle = write(tmp_path / "c.mcap", *map(block, range(19, 9, -1)), *ground)
    read = list(read_recordings([late, early, middle]))
    assert seconds([item for item in read if item.topic == ACCELERATION]) == list(range(30))
    assert [item.t_ns for item in read] == sorted(item.t_ns for item in read)
    assert len(read) == 50


def test_memory_does_not_grow_with_length(tmp_path: Path) -> None:
    samples = np.random.default_rng(0).normal(size=(100_000, 3)).astype(np.float32)
    with McapWriter(tmp_path / "a.mcap") as writer:
        for number in range(100):  # 120 MB
            t_ns = number * 1000 * _S
            writer.write(SampleBlock(ACCELERATION, t_ns, number * 100_000, 100.0, ("a", "b", "c"), "m/s^2", samples))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert sum(item.n_samples for item in read_recordings([tmp_path / "a.mcap"])) == 10_000_000
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 60_000  # KiB


def test_what_cannot_be_opened_is_missing(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path, tmp_path / "none.mcap", tmp_path / "pipe", Path("a\0b"), tmp_path / ("x" * 300)):
        with pytest.raises(RecordingMissingError) as caught:
            read_recordings([path])
        assert str(path) in str(caught.value)


@pytest.mark.parametrize(("content", "reason"), [(b"", "is empty"), (b"time,a1\n0,1\n", "no MCAP file")])
def test_other_files_are_refused_and_import_is_named(tmp_path: Path, content: bytes, reason: str) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=f"{reason}.*import") as caught:
        read_recordings([path])
    assert not isinstance(caught.value, RecordingMissingError)


def test_a_wrong_unit_or_schema_or_block_is_named_with_topic_and_time(tmp_path: Path) -> None:
    wrong_unit = write(tmp_path / "a.mcap", block(0, unit="degC"))
    with pytest.raises(RecordingError, match=rf"a\.mcap: /acceleration at {block(0).t_ns} ns: unit 'degC'"):
        list(read_recordings([wrong_unit]))
    with McapWriter(tmp_path / "b.mcap") as writer:
        writer.write_json(ACCELERATION, 17, "{}")
    with pytest.raises(RecordingError, match=r"b\.mcap: /acceleration at 17 ns: schema 'shm.acceleration'"):
        read_recordings([tmp_path / "b.mcap"])


def test_a_recording_without_acceleration_is_refused_but_one_of_several_may_lack_it(tmp_path: Path) -> None:
    warm = write(tmp_path / "warm.mcap", block(0, TEMPERATURE, "degC"))
    with pytest.raises(RecordingError, match=r"warm\.mcap: no messages of /acceleration.*/temperature"):
        read_recordings([warm])
    both = list(read_recordings([warm, write(tmp_path / "a.mcap", block(0))]))
    assert {item.topic for item in both} == {ACCELERATION, TEMPERATURE}


def test_recording_info_counts_gaps_as_duration(tmp_path: Path) -> None:
    info = recording_info(write(tmp_path / "a.mcap", block(0), block(7), block(0, GROUND)))
    assert info.topics == (ACCELERATION, GROUND)
    assert info.channels[ACCELERATION] == ("a1", "a2")
    assert (info.sample_rate_hz, info.duration_s, info.n_samples) == (100.0, 8.0, 200)
    assert info.t_start_ns == block(0).t_ns


def test_recording_info_lists_covariates_of_any_name(tmp_path: Path) -> None:
    info = recording_info(write(tmp_path / "a.mcap", block(0), block(0, "/wind", "m/s")))
    assert info.channels == {ACCELERATION: ("a1", "a2"), "/wind": ("a1", "a2")}


def test_the_recorded_time_is_told_by_the_ends_of_a_file_with_an_index_as_by_all_of_it(tmp_path: Path) -> None:
    ours = write(tmp_path / "a.mcap", block(3), block(9), block(7, n=99), block(0), block(12, GROUND), chunk_every=2)
    for path in (ours, foreign(tmp_path / "b.mcap", CompressionType.ZSTD, chunked=True)):
        info = recording_info(path)
        assert recorded_time(path) == (info.t_start_ns, info.t_end_ns)
    assert recorded_time(ours)[1] - recorded_time(ours)[0] == 10 * _S
    with pytest.raises(RecordingError):
        recorded_time(write(tmp_path / "c.mcap", block(0, GROUND)))


@pytest.mark.parametrize("name", ["controlled_data_0", "uncontrolled_data_0"])
def test_a_foreign_ros2_recording_gets_a_clear_answer(name: str) -> None:
    path = DATA / "mcap-ros2" / f"{name}.mcap"
    with pytest.raises(RecordingError, match=r"no block of /acceleration.*holds .*\(.*msg.*\).*topic map"):
        read_recordings([path])
    assert len(list(scan_messages(path))) == {"controlled_data_0": 1356, "uncontrolled_data_0": 1594}[name]


def test_all_conformance_files_give_the_expected_messages(rewrite: Rewrite) -> None:
    with tarfile.open(DATA / "mcap-conformance.tar.xz") as archive:
        files = {member.name: archive.extractfile(member) or io.BytesIO() for member in archive}
        content = {name: file.read() for name, file in files.items()}
    cases = sorted(name for name in content if name.endswith(".mcap"))
    assert len(cases) == 502
    messages = 0
    for name in cases:
        records = json.loads(content[name.removesuffix("mcap") + "json"])["records"]
        fields = [(record["type"], dict(record["fields"])) for record in records]
        topics = {field["id"]: field["topic"] for kind, field in fields if kind == "Channel"}
        expected = [
            (topics.get(field["channel_id"], "example"), int(field["log_time"]), bytes(map(int, field["data"])))
            for kind, field in fields
            if kind == "Message"
        ]
        assert list(scan_messages(rewrite(content[name]))) == expected, name
        messages += len(expected)
    assert messages > 1000


def test_a_chunk_of_empty_messages_is_refused_before_they_fill_the_memory(tmp_path: Path) -> None:
    file = McapFile(tmp_path / "empty.mcap", most_messages=100)
    for count in (100, 101):
        with file.path.open("wb") as out:
            writer = Writer(out, chunk_size=1 << 20)
            writer.start()
            channel = writer.register_channel("/other", "json", 0)
            for k in range(count):
                writer.add_message(channel, k, b"", k)
            writer.finish()
        if count == 100:
            assert sum(len(messages) for _, messages in file.segments()) == 100
    with pytest.raises(RecordingError, match=r"empty\.mcap.*more than 100 messages in a chunk"):
        list(file.segments())
