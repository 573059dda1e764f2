"""Several files, or several clocks, columns and topics of one, become one recording, or are refused with the mend."""

import gzip
import io
import warnings
import zipfile
from pathlib import Path

import numpy as np
import pytest
import scipy.io

from drivers.base import ACCELERATION, GROUND, TEMPERATURE, SampleBlock
from drivers.mcap_file import RecordingInfo, read_recordings, scan_messages
from monitor import api
from monitor.core import BadInputError
from monitor.runs.look import look
from tests.runs.reading import imported

DAY_S = 86_400
START_S = 1_767_225_600


def table(path: Path, begin_s: float, count: int = 300, rate_hz: float = 100.0, heading: str = "a1 [g],a2 [g]") -> Path:
    """Write a table of stamps in UTC; its first column counts on with the time."""
    t = begin_s + np.arange(count) / rate_hz
    dates = (np.datetime64(START_S * 1000, "ms") + np.rint(t * 1000).astype("timedelta64[ms]")).astype(str)
    width = heading.count(",")
    rows = (f"{date}Z,{x % 1000:.2f}{',0.5' * width}\n" for date, x in zip(dates, t, strict=True))
    path.write_text(f"time,{heading}\n" + "".join(rows))
    return path


def read(files: list[Path], **options: object) -> tuple[RecordingInfo, list[str], list[str]]:
    """Import files; give the content of the recording, what was told, and the topics with their channels."""
    told: list[str] = []
    out = files[0].parent / "out.mcap"
    info = imported(files, out, on_warning=told.append, **options)
    return info, told, [f"{b.topic} {b.unit} {','.join(b.channels)}" for b in every_block(out)]


def every_block(path: Path) -> list[SampleBlock]:
    """Read the blocks of all topics of a recording."""
    return list(read_recordings([path], topics=sorted({topic for topic, *_ in scan_messages(path)})))


# --- files that follow one another ---


@pytest.mark.parametrize("gap_s", [0.0, 1.0, 31 * DAY_S])
def test_files_that_follow_are_joined_whatever_lies_between(tmp_path: Path, gap_s: float) -> None:
    info, told, _ = read([table(tmp_path / "b.csv", 3.0 + gap_s), table(tmp_path / "a.csv", 0.0)])
    assert info.sample_rate_hz == 100.0 and info.duration_s == pytest.approx(6.0 + gap_s)
    assert "follow one another" in told[0]


@pytest.mark.parametrize("again_s", [0.01, 1.0])
def test_files_that_share_their_last_seconds_are_joined_and_these_counted_once(tmp_path: Path, again_s: float) -> None:
    info, told, _ = read([table(tmp_path / "a.csv", 0.0), table(tmp_path / "b.csv", 3.0 - again_s)])
    assert info.n_samples == 600 - round(100 * again_s) and info.duration_s == pytest.approx(6.0 - again_s)
    assert any("stand twice" in one for one in told)


def test_files_of_two_rates_that_follow_are_refused(tmp_path: Path) -> None:
    files = [table(tmp_path / "a.csv", 0.0), table(tmp_path / "b.csv", 10.0, rate_hz=200.0)]
    with pytest.raises(BadInputError, match=r"a\.csv 100 Hz.*b\.csv 200 Hz"):
        read(files)


@pytest.mark.parametrize("heading", ["a1 [g],a2 [mg]", "a1 [g]"])
def test_files_that_follow_with_other_columns_or_units_are_refused_with_the_reason(
    tmp_path: Path, heading: str
) -> None:
    files = [table(tmp_path / "a.csv", 0.0), table(tmp_path / "b.csv", 10.0, heading=heading)]
    with pytest.raises(BadInputError, match="joined where each states its date, and all the same columns and units"):
        read(files)


def test_files_that_are_to_be_aligned_are_not_joined_in_time(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).normal(size=2000)
    for name, begin in (("a.csv", 0.0), ("b.csv", 100.0)):
        t = START_S + begin + np.arange(2000) / 100
        (tmp_path / name).write_text(
            "time,a1 [g]\n" + "".join(f"{s:.2f},{x:.5f}\n" for s, x in zip(t, noise, strict=True))
        )
    info, told, _ = read([tmp_path / "a.csv", tmp_path / "b.csv"], align=True)
    assert info.channels[ACCELERATION] == ("a", "b") and any("-100.000 s" in one for one in told)


def test_arrays_of_two_rates_without_times_are_refused(tmp_path: Path) -> None:
    for name, fs in (("a.npz", 100.0), ("b.npz", 200.0)):
        np.savez(tmp_path / name, x=np.arange(500.0), fs=fs)
    with pytest.raises(BadInputError, match=r"a\.npz 100 Hz.*b\.npz 200 Hz"):
        read([tmp_path / "a.npz", tmp_path / "b.npz"], start_ns=0)


def test_a_zone_that_one_file_lacks_is_told_of_that_file(tmp_path: Path) -> None:
    first = table(tmp_path / "a.csv", 0.0)
    second = tmp_path / "b.csv"
    second.write_text(first.read_text().replace("Z", ""))
    _, told, _ = read([first, second])
    assert any(one.startswith(f"{second}: its time") and "no zone" in one for one in told)


# --- columns ---


def test_a_covariate_leaves_the_accelerations_of_its_file(tmp_path: Path) -> None:
    heading = "a [g],t1 [degC]"
    files = [table(tmp_path / "one.csv", 0.0, heading=heading), table(tmp_path / "two.csv", 0.0, heading=heading)]
    info, *_ = read(files, covariates={"air": "one.csv:t1"})
    assert info.channels[ACCELERATION] == ("one", "two")


def test_every_quantity_has_a_topic_of_its_own(tmp_path: Path) -> None:
    heading = "a [g],Air [degC],Temperature [degC],Wind 1 [m/s],wind_1 [m/s],Acceleration [mm]"
    _, _, blocks = read([table(tmp_path / "a.csv", 0.0, heading=heading)])
    assert {one.split()[0] for one in blocks} == {
        ACCELERATION, TEMPERATURE, "/temperature_2", "/wind_1", "/wind_1_2", "/acceleration_2"
    }  # fmt: skip


def test_the_same_column_of_two_files_is_kept_of_both(tmp_path: Path) -> None:
    heading = "a [g],Wind [m/s]"
    files = [table(tmp_path / f"{name}.csv", 0.0, heading=heading) for name in ("one", "two")]
    assert {"/wind m/s Wind", "/two_wind m/s two_Wind"} <= set(read(files)[2])


def test_a_unit_that_the_user_states_holds_for_the_ground_too(tmp_path: Path) -> None:
    path = table(tmp_path / "a.csv", 0.0, heading="a [g],base [V]")
    info, *_ = read([path], channels={"a": "a"}, ground="base", unit="g")
    assert info.channels[GROUND] == ("ground",)


def test_a_file_that_no_channel_names_cuts_nothing(tmp_path: Path) -> None:
    files = [table(tmp_path / "a.csv", 0.0), table(tmp_path / "b.csv", 1.0, heading="x [g],y [g],z [g]")]
    info, told, _ = read(files, channels={"a1": "a.csv:a1"})
    assert info.n_samples == 300 and any(one.startswith(f"{files[1]}: left out") for one in told)


# --- clocks of one file ---


def tdms(path: Path, second_hz: float, name: str = "b1", count: int = 1000) -> Path:
    """Write a file with a group at 100 Hz and another one."""
    nptdms = pytest.importorskip("nptdms")
    channels = [
        nptdms.ChannelObject(group, channel, np.arange(n) * 1e-3, {"wf_increment": 1.0 / hz, "unit_string": "g"})
        for group, channel, n, hz in (("floors", "a1", 500, 100.0), ("slow", name, count, second_hz))
    ]
    with nptdms.TdmsWriter(path) as writer:
        writer.write_segment(channels)
    return path


def test_groups_of_several_rates_are_refused_until_one_is_chosen(tmp_path: Path) -> None:
    path = tdms(tmp_path / "a.tdms", 200.0)
    with pytest.raises(BadInputError, match=r"100 Hz.*200 Hz.*--channel"):
        read([path], start_ns=0)
    info, *_ = read([path], start_ns=0, channels={"b": "b1"})
    assert (info.sample_rate_hz, info.n_samples) == (200.0, 1000)


def test_channels_of_one_name_in_two_groups_are_told_apart_by_the_groups(tmp_path: Path) -> None:
    path = tdms(tmp_path / "a.tdms", 100.0, "a1", 500)
    info, *_ = read([path], start_ns=0)
    assert info.channels[ACCELERATION] == ("floors/a1", "slow/a1")


# --- packed files ---


@pytest.mark.parametrize("packing", ["gzip", "zip"])
def test_a_packed_file_that_has_a_process_of_its_own_is_read(tmp_path: Path, packing: str) -> None:
    raw = io.BytesIO()
    scipy.io.savemat(raw, {"a": np.arange(300.0), "fs": 100.0, "unit": "g"})
    path = tmp_path / ("a.mat.gz" if packing == "gzip" else "a.zip")
    if packing == "gzip":
        path.write_bytes(gzip.compress(raw.getvalue()))
    else:
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("a.mat", raw.getvalue())
    info, *_ = read([path], start_ns=0)
    assert info.n_samples == 300


# --- the same files elsewhere ---


def test_a_file_whose_name_holds_a_year_hides_no_warning(tmp_path: Path) -> None:
    path = tmp_path / "survey1970.csv"
    noise = np.random.default_rng(0).normal(size=6000)
    rows = "".join(f"{k / 100},{'' if k == 5000 else x}\n" for k, x in enumerate(noise))
    path.write_text("t,a1 [m/s^2]\n" + rows)
    told: list[str] = []
    found = look([path], on_warning=told.append)
    assert any("readings are missing" in one for one in told)
    assert "times count from 1970" in found.notes[0]


def test_the_library_names_the_users_file_in_its_errors(tmp_path: Path) -> None:
    path = table(tmp_path / "a.csv", 0.0)
    later = table(tmp_path / "b.csv", DAY_S).read_text().partition("\n")[2]
    path.write_text(path.read_text() + later)
    with warnings.catch_warnings(), pytest.raises(BadInputError, match=r"a\.csv: gaps fill most"):
        warnings.simplefilter("ignore")
        api.read(path)


def test_the_library_refuses_a_unit_of_a_recording(tmp_path: Path) -> None:
    table(tmp_path / "a.csv", 0.0)
    read([tmp_path / "a.csv"])
    with pytest.raises(BadInputError, match="leave --unit out"):
        api.read(tmp_path / "out.mcap", unit="g")


# --- seismic records ---


def test_of_an_inventory_only_accelerometers_are_channels(tmp_path: Path) -> None:
    obspy = pytest.importorskip("obspy")
    from obspy.core.inventory import Channel, InstrumentSensitivity, Inventory, Network, Response, Station

    place = {"latitude": 0.0, "longitude": 0.0, "elevation": 0.0}
    channels = [
        Channel(name, "", depth=0.0, response=Response(instrument_sensitivity=InstrumentSensitivity(4e5, 1.0, unit, "")),
                start_date=obspy.UTCDateTime(0), **place)
        for name, unit in (("HNX", "M/S**2"), ("HHX", "M/S"))
    ]  # fmt: skip
    station = Station("ROOF", channels=channels, start_date=obspy.UTCDateTime(0), **place)
    Inventory(networks=[Network("XX", [station])]).write(str(tmp_path / "s.xml"), format="STATIONXML")
    head = {"network": "XX", "station": "ROOF", "sampling_rate": 100.0, "starttime": obspy.UTCDateTime(START_S)}
    data = np.arange(500, dtype=np.int32)
    traces = [obspy.Trace(data, {**head, "channel": name}) for name in ("HNX", "HHX")]
    obspy.Stream(traces).write(str(tmp_path / "a.mseed"), format="MSEED")
    info, told, blocks = read([tmp_path / "a.mseed"], inventory=tmp_path / "s.xml")
    assert info.channels[ACCELERATION] == ("XX.ROOF..HNX",)
    assert "/xx_roof_hhx m/s XX.ROOF..HHX" in blocks and any("HHX (m/s) is kept" in one for one in told)


def test_day_files_of_seismic_records_that_overlap_are_joined(tmp_path: Path) -> None:
    obspy = pytest.importorskip("obspy")
    data = np.random.default_rng(0).integers(-1000, 1000, 1000).astype(np.int32)
    files = [tmp_path / "day2.mseed", tmp_path / "day1.mseed"]
    for path, begin in zip(files, (490, 0), strict=True):
        start = obspy.UTCDateTime(START_S) + begin / 100
        head = {"network": "XX", "station": "ROOF", "channel": "HNX", "sampling_rate": 100.0, "starttime": start}
        obspy.Trace(data[begin : begin + 500], head).write(str(path), format="MSEED")
    info, *_ = read(files, scale=1e-3)
    assert (info.n_samples, info.t_start_ns) == (990, START_S * 10**9)
    written = np.concatenate([block.samples[:, 0] for block in every_block(tmp_path / "out.mcap")])
    np.testing.assert_allclose(written, 1e-3 * data[:990], rtol=1e-6)


def test_three_components_of_one_record_have_names(tmp_path: Path) -> None:
    obspy = pytest.importorskip("obspy")
    sample = (Path(obspy.__file__).parent / "io/nied/tests/data/test.knet").read_text()
    files = []
    for suffix, direction in (("EW1", "E-W"), ("NS1", "N-S"), ("UD1", "U-D")):
        files.append(tmp_path / f"AKT0139608101812.{suffix}")
        files[-1].write_text(sample.replace("E-W", direction))
    info, *_ = read(files)
    assert info.channels[ACCELERATION] == ("BO.AKT013..EW", "BO.AKT013..NS", "BO.AKT013..UD")
