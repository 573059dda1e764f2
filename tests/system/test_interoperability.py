"""Other tools read what we write, and we read what they write."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from drivers.mcap_file import read_recordings
from monitor.publish import LINE_SCHEMA
from tests.support.samples import Cli

pytestmark = pytest.mark.system

pandas = pytest.importorskip("pandas")
polars = pytest.importorskip("polars")
ProtobufDecoders = pytest.importorskip("mcap_protobuf.decoder").DecoderFactory
Ros2Writer = pytest.importorskip("mcap_ros2.writer").Writer

IMU = """std_msgs/Header header
geometry_msgs/Quaternion orientation
float64[9] orientation_covariance
geometry_msgs/Vector3 angular_velocity
float64[9] angular_velocity_covariance
geometry_msgs/Vector3 linear_acceleration
float64[9] linear_acceleration_covariance
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
================================================================================
MSG: geometry_msgs/Quaternion
float64 x
float64 y
float64 z
float64 w
================================================================================
MSG: geometry_msgs/Vector3
float64 x
float64 y
float64 z
"""


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory, main: Cli, frame_text: str) -> Path:
    folder = tmp_path_factory.mktemp("run")
    (folder / "s.toml").write_text(frame_text)
    for done in (
        main("simulate", "--structure", "s.toml", "--out", "r.mcap", "--duration", 60, "--rate", 200, cwd=folder),
        main("replay", "r.mcap", "--structure", "s.toml", "--out", "out", cwd=folder),
    ):
        assert done.returncode == 0, done.stderr
    return folder


def test_a_recording_decodes_with_its_own_schema_alone(run: Path) -> None:
    with (run / "r.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[ProtobufDecoders()], validate_crcs=True)
        blocks = [m.decoded_message for m in reader.iter_decoded_messages(topics=["/acceleration"])]
        summary = reader.get_summary()
    assert [s.name for s in summary.schemas.values()] == ["shm.SampleBlock"]
    theirs = np.concatenate([np.frombuffer(b.samples, "<f4").reshape(-1, len(b.channels)) for b in blocks])
    ours = np.concatenate([b.samples for b in read_recordings([run / "r.mcap"])])
    np.testing.assert_array_equal(theirs, ours)
    assert list(blocks[0].channels) == ["a1", "a2", "a3"]
    assert blocks[1].timestamp.ToNanoseconds() > blocks[0].timestamp.ToNanoseconds()


def test_results_are_json_messages_that_follow_their_schema(run: Path) -> None:
    with (run / "out/results.mcap").open("rb") as file:
        found = list(make_reader(file, validate_crcs=True).iter_messages(topics=["/results"]))
    lines = (run / "out/results.jsonl").read_text().splitlines()
    assert [m.data.decode() for _, _, m in found] == lines
    schema = found[0][0]
    assert (schema.encoding, json.loads(schema.data)) == ("jsonschema", LINE_SCHEMA)
    kinds = {"array": list, "integer": int, "number": (int, float), "string": str, "object": dict, "boolean": bool}
    for line in map(json.loads, lines):
        assert set(line) == set(LINE_SCHEMA["properties"])
        for key, value in line.items():
            allowed = LINE_SCHEMA["properties"][key]["type"]
            names = [allowed] if isinstance(allowed, str) else allowed
            assert (value is None and "null" in names) or any(isinstance(value, kinds[n]) for n in names if n != "null")


def test_results_are_tables_in_pandas_and_polars(run: Path) -> None:
    frame = pandas.read_json(run / "out/results.jsonl", lines=True)
    table = polars.read_ndjson(run / "out/results.jsonl")
    assert len(frame) == table.height == 9
    first = [row[0] for row in frame["frequencies_hz"]]
    assert first == table["frequencies_hz"].list.get(0).to_list()
    assert all(math.isclose(f, 5.2, rel_tol=0.1) for f in first)
    assert table["alarm"].struct.field("level").to_list() == ["normal"] * 9
    ends = table["t_end_ns"].cast(polars.Datetime("ns"))
    assert ends.diff().drop_nulls().dt.total_seconds().to_list() == [5] * 8


def test_a_ros_2_recording_by_their_own_writer_is_read(tmp_path: Path, main: Cli, frame_text: str) -> None:
    topics = {"/imu/top": "a1.x", "/imu/middle": "a2.x", "/imu/low": "a3.x"}
    rng = np.random.default_rng(1)
    values = rng.normal(size=(6000, 3))
    with (tmp_path / "bag.mcap").open("wb") as file:
        writer = Ros2Writer(file)
        schema = writer.register_msgdef("sensor_msgs/msg/Imu", IMU)
        empty = {"x": 0.0, "y": 0.0, "z": 0.0}
        for i, row in enumerate(values):
            t_ns = 1_767_225_600_000_000_000 + i * 5_000_000
            stamp = {"sec": t_ns // 10**9, "nanosec": t_ns % 10**9}
            for topic, value in zip(topics, row, strict=True):
                message = {
                    "header": {"stamp": stamp, "frame_id": "imu"},
                    "orientation": {**empty, "w": 1.0},
                    "orientation_covariance": [0.0] * 9,
                    "angular_velocity": empty,
                    "angular_velocity_covariance": [0.0] * 9,
                    "linear_acceleration": {**empty, "x": float(value)},
                    "linear_acceleration_covariance": [0.0] * 9,
                }
                writer.write_message(topic, schema, message, t_ns, t_ns)
        writer.finish()
    blocks = list(read_recordings([tmp_path / "bag.mcap"], topic_map=topics))
    np.testing.assert_allclose(np.concatenate([b.samples for b in blocks]), values.astype(np.float32))
    table = "".join(f'"{k}" = "{v}"\n' for k, v in topics.items())
    (tmp_path / "s.toml").write_text(frame_text + "\n[topics]\n" + table)
    done = main(
        "replay", tmp_path / "bag.mcap", "--structure", tmp_path / "s.toml", "--out", tmp_path / "out", "--json"
    )
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["windows"] == 3


def test_a_bag_of_other_messages_is_refused_with_the_mend(tmp_path: Path, main: Cli, frame_text: str) -> None:
    with (tmp_path / "bag.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start("ros2")
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
        writer.add_message(writer.register_channel("/chatter", "cdr", schema), 1, b"\0\1\0\0", 1)
        writer.finish()
    (tmp_path / "s.toml").write_text(frame_text)
    done = main("replay", tmp_path / "bag.mcap", "--structure", tmp_path / "s.toml", "--out", tmp_path / "out")
    assert done.returncode == 65
    assert "topic map" in done.stderr
    assert "/chatter" in done.stderr
