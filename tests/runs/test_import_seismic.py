"""MiniSEED and K-NET: read as ObsPy reads them, in m/s^2 by their own scale, a given one, or the station's inventory."""

from __future__ import annotations

import io
import pickle
import sys
from pathlib import Path

import numpy as np
import pytest

from drivers.mcap_file import read_recordings
from monitor.core import BadInputError, UserError
from monitor.runs.readers import Limits, Options, import_files, seismic
from monitor.runs.readers.base import File
from tests.runs.hostile import forked

HEAD = b"000001D " + b" " * 56
T0 = "2026-01-01T00:00:00"


@pytest.fixture
def counts() -> np.ndarray:
    return np.random.default_rng(0).integers(-1000, 1000, (500, 2)).astype(np.int32)


def miniseed(path: Path, counts: np.ndarray, *pieces: slice) -> Path:
    """Two channels, in the pieces that there are of them."""
    obspy = pytest.importorskip("obspy")
    stream = obspy.Stream()
    for part in pieces or (slice(0, len(counts)),):
        for i, name in enumerate(("HNX", "HNY")):
            start = obspy.UTCDateTime(T0) + part.start / 100.0
            header = {"network": "XX", "station": "ROOF", "channel": name, "sampling_rate": 100.0, "starttime": start}
            stream.append(obspy.Trace(counts[part, i].copy(), header))
    stream.write(str(path), format="MSEED")
    return path


def read(path: Path) -> np.ndarray:
    return np.concatenate([block.samples for block in read_recordings([path])])


def test_counts_are_scaled_and_keep_their_time(tmp_path: Path, counts: np.ndarray) -> None:
    file = miniseed(tmp_path / "a.mseed", counts)
    info = import_files([file], tmp_path / "r.mcap", Options(scale=1e-3))
    assert info.channels["/acceleration"] == ("XX.ROOF..HNX", "XX.ROOF..HNY") and info.sample_rate_hz == 100.0
    assert info.t_start_ns == 1_767_225_600_000_000_000
    assert read(tmp_path / "r.mcap") == pytest.approx(1e-3 * counts, rel=1e-6)


class _Code:
    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[type, tuple[str, str]]:
        return open, (str(self.path), "w")


def test_code_in_a_file_is_not_run(tmp_path: Path) -> None:
    pytest.importorskip("obspy")
    (tmp_path / "a.sac").write_bytes(pickle.dumps([b"\0", _Code(tmp_path / "run")]))
    with pytest.raises(BadInputError, match="seismic records"), forked():
        import_files([tmp_path / "a.sac"], tmp_path / "r.mcap", Options(scale=1.0))
    assert not (tmp_path / "run").exists()


def test_what_lies_between_records_is_missing(tmp_path: Path, counts: np.ndarray) -> None:
    file, told = miniseed(tmp_path / "a.mseed", counts, slice(0, 200), slice(300, 500)), list[str]()
    import_files([file], tmp_path / "r.mcap", Options(scale=1.0), on_warning=told.append)
    samples = read(tmp_path / "r.mcap")
    assert np.isnan(samples[200:300]).all() and samples[300:] == pytest.approx(counts[300:])
    assert any("missing" in text for text in told)


def test_records_of_text_are_left_out_and_counted(tmp_path: Path, counts: np.ndarray) -> None:
    obspy = pytest.importorskip("obspy")
    log = {"network": "XX", "station": "ROOF", "channel": "LOG", "sampling_rate": 0.0}
    text, told = np.frombuffer(b"clock locked\n", "S1").copy(), list[str]()
    stream = obspy.Stream([obspy.Trace(text, {**log, "starttime": obspy.UTCDateTime(T0) + k}) for k in range(2)])
    stream.write(str(tmp_path / "log.mseed"), format="MSEED")
    file = miniseed(tmp_path / "a.mseed", counts)
    file.write_bytes(file.read_bytes() + (tmp_path / "log.mseed").read_bytes())
    info = import_files([file], tmp_path / "r.mcap", Options(scale=1e-3), on_warning=told.append)
    assert info.channels["/acceleration"] == ("XX.ROOF..HNX", "XX.ROOF..HNY")
    assert any("XX.ROOF..LOG: 2 records of text are left out" in text for text in told)
    with pytest.raises(BadInputError, match=r"log\.mseed: holds no samples"):
        import_files([tmp_path / "log.mseed"], tmp_path / "r.mcap", Options(scale=1e-3))


def test_readings_that_fail_the_check_of_their_record_are_told(tmp_path: Path, counts: np.ndarray) -> None:
    pytest.importorskip("obspy")
    file, told = miniseed(tmp_path / "a.mseed", counts[:100]), list[str]()
    raw = bytearray(file.read_bytes())
    raw[71] ^= 1  # the last value that the first record should reach
    file.write_bytes(raw)
    import_files([file], tmp_path / "r.mcap", Options(scale=1e-3), on_warning=told.append)
    assert any("Data integrity check" in text for text in told)


def test_counts_alone_are_refused_with_the_mend(tmp_path: Path, counts: np.ndarray) -> None:
    file = miniseed(tmp_path / "a.mseed", counts)
    with pytest.raises(BadInputError, match=r"a\.mseed: MiniSEED holds counts; give --scale"):
        import_files([file], tmp_path / "r.mcap")
    assert not (tmp_path / "r.mcap").exists()


@pytest.mark.parametrize(("unit", "works"), [("M/S**2", True), ("M/S", False)])
def test_an_inventory_tells_what_a_count_is(tmp_path: Path, counts: np.ndarray, unit: str, works: bool) -> None:
    obspy = pytest.importorskip("obspy")
    from obspy.core.inventory import Channel, InstrumentSensitivity, Inventory, Network, Response, Station

    known = Response(instrument_sensitivity=InstrumentSensitivity(4e5, 1.0, unit, "COUNTS"))
    place = {"latitude": 0.0, "longitude": 0.0, "elevation": 0.0}
    channels = [
        Channel(name, "", depth=0.0, response=known, start_date=obspy.UTCDateTime(0), **place)
        for name in ("HNX", "HNY")
    ]
    station = Station("ROOF", channels=channels, start_date=obspy.UTCDateTime(0), **place)
    Inventory(networks=[Network("XX", [station])]).write(str(tmp_path / "s.xml"), format="STATIONXML")
    file = miniseed(tmp_path / "a.mseed", counts)
    if works:
        import_files([file], tmp_path / "r.mcap", Options(inventory=tmp_path / "s.xml"))
        assert read(tmp_path / "r.mcap") == pytest.approx(counts / 4e5, rel=1e-6)
    else:
        with pytest.raises(BadInputError, match="no acceleration"):
            import_files([file], tmp_path / "r.mcap", Options(inventory=tmp_path / "s.xml"))


def test_k_net_is_read_by_its_own_scale(tmp_path: Path) -> None:
    """ObsPy's own test file, whose header states the largest acceleration, 4.383 Gal about the mean."""
    obspy = pytest.importorskip("obspy")
    file = Path(obspy.__file__).parent / "io" / "nied" / "tests" / "data" / "test.knet"
    info = import_files([file], tmp_path / "r.mcap")
    samples = read(tmp_path / "r.mcap")
    assert np.abs(samples - samples.mean()).max() == pytest.approx(0.04383, rel=0.01)
    assert info.channels["/acceleration"] == ("BO.AKT013..EW",) and info.sample_rate_hz == 100.0
    assert str(np.datetime64(info.t_start_ns, "ns"))[:19] == "1996-08-10T18:12:24"
    with pytest.raises(BadInputError, match="its own scale"):
        import_files([file], tmp_path / "s.mcap", Options(scale=1.0))


@pytest.mark.parametrize("raw", [HEAD, b"Origin Time       1996\n" + b"nonsense\n" * 30])
def test_a_damaged_file_is_named(tmp_path: Path, raw: bytes) -> None:
    pytest.importorskip("obspy")
    (tmp_path / "a.x").write_bytes(raw)
    with pytest.raises(BadInputError, match=r"a\.x: (cannot be used as|holds no samples)"):
        import_files([tmp_path / "a.x"], tmp_path / "r.mcap", Options(scale=None if raw.startswith(b"O") else 1.0))


def test_without_obspy_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "obspy", None)  # as if it were not installed
    (tmp_path / "a.mseed").write_bytes(HEAD)
    with pytest.raises(UserError, match="shm-monitor\\[seismic\\]"):
        import_files([tmp_path / "a.mseed"], tmp_path / "r.mcap", Options(scale=1.0))


def test_the_scale_is_for_counts_alone(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("t,a1 [g]\n0.00,0.1\n0.01,0.2\n0.02,0.1\n")
    with pytest.raises(BadInputError, match="for MiniSEED"):
        import_files([tmp_path / "a.csv"], tmp_path / "r.mcap", Options(scale=1.0))
    with pytest.raises(BadInputError, match="--scale 0"):
        import_files([tmp_path / "a.csv"], tmp_path / "r.mcap", Options(scale=0.0))


def test_the_scale_leaves_other_files_beside_the_counts_alone(tmp_path: Path, counts: np.ndarray) -> None:
    file = miniseed(tmp_path / "a.mseed", counts[:, :1].repeat(2, axis=1))
    rows = "".join(f"{1_767_225_600 + k / 100:.2f},{0.5 * (-1) ** k}\n" for k in range(500))
    (tmp_path / "b.csv").write_text("t,top\n" + rows)
    chosen = {"low": "a.mseed:XX.ROOF..HNX", "top": "b.csv:top"}
    told = list[str]()
    import_files(
        [file, tmp_path / "b.csv"],
        tmp_path / "r.mcap",
        Options(scale=1e-3, unit="g", channels=chosen),
        on_warning=told.append,
    )
    samples = read(tmp_path / "r.mcap")
    assert samples[:, 0] == pytest.approx(1e-3 * counts[:, 0], rel=1e-6)
    assert np.abs(samples[:, 1]) == pytest.approx(0.5 * 9.80665, rel=1e-6)
    assert not any("--unit" in text for text in told)


def test_other_files_are_told_apart() -> None:
    def is_mine(raw: bytes) -> bool:
        return seismic.Seismic().is_mine(File(Path("a.dat"), raw, Options(), Limits(), lambda _: None))

    assert is_mine(HEAD) and is_mine(b"MS\x03") and is_mine(b"Origin Time  2011")
    assert not any(map(is_mine, (b"", b"t,a1\n0,1\n", b"123456 1.0\n", io.BytesIO(b"PK\x03\x04").read())))
