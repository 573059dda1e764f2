"""UFF, MAT and HDF5: files of other programs, hostile sizes, and what an import says that it took."""

from __future__ import annotations

import json
import os
import pty
import random
import struct
import subprocess
import sys
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io

from drivers.base import ACCELERATION, FORCE
from drivers.mcap_file import RecordingInfo, read_recordings
from monitor.core import BadInputError, UserError
from monitor.runs.readers import ImportedChannel, Options, import_files, zone_named
from monitor.signals import best_shift
from tests.runs.hostile import forked
from tests.runs.reading import imported
from tests.support.samples import Cli

h5py = pytest.importorskip("h5py")
pyuff = pytest.importorskip("pyuff")

DATA = Path(__file__).parents[1] / "data"
MATLAB = Path(scipy.io.__file__).parent / "matlab" / "tests" / "data"
X = np.sin(np.arange(250) / 7.0)
BOTH = np.column_stack([X, -2.0 * X])


@pytest.mark.parametrize("suffix", ["npz", "h5"])
def test_a_number_whose_bits_are_damaged_is_a_missing_reading_and_no_warning_of_numpy(
    suffix: str, tmp_path: Path
) -> None:
    samples, path = X.astype(np.float32), tmp_path / f"a.{suffix}"
    samples.view(np.uint32)[7] = 0x7F800001  # a signalling NaN
    if suffix == "npz":
        np.savez(path, samples=samples, fs=100.0)
    else:
        with h5py.File(path, "w") as file:
            file["samples"], file.attrs["fs"] = samples, 100.0
    with forked():
        _, values, told, _ = load(path)
    assert np.flatnonzero(np.isnan(values)).tolist() == [7] and any("missing" in text for text in told)


def load(path: Path, **options: Any) -> tuple[RecordingInfo, np.ndarray, list[str], list[ImportedChannel]]:
    """Import a file: content, accelerations, warnings and what was taken."""
    warnings: list[str] = []
    taken: list[ImportedChannel] = []
    out = path.parent / "out.mcap"
    options = {"ask_unit": lambda _: "m/s^2", "start_ns": 0} | options
    info = imported([path], out, on_warning=warnings.append, on_channel=taken.append, **options)
    blocks = [block.samples for block in read_recordings([out]) if block.topic == ACCELERATION]
    return info, np.concatenate(blocks), warnings, taken


def mat(path: Path, **arrays: Any) -> Path:
    scipy.io.savemat(path, arrays, do_compression=True)
    return path


def hdf5(path: Path, attributes: dict[str, Any] | None = None, **arrays: Any) -> Path:
    with h5py.File(path, "w") as file:
        file.attrs.update(attributes or {})
        for name, array in arrays.items():
            file[name.replace("__", "/")] = array
    return path


def uff(path: Path, columns: np.ndarray, binary: int = 0, **more: Any) -> Path:
    for k, data in enumerate(columns.T):
        fields = {
            "binary": binary, "func_type": 1, "rsp_node": 10 + k, "rsp_dir": -3, "ref_node": 0, "ref_dir": 0, "data": data,
            "x": np.arange(len(data)) / 200.0, "id1": "x", "id3": "02-JAN-26 03:04:05", "abscissa_spacing": 1,
            "abscissa_spec_data_type": 17, "ordinate_spec_data_type": 12, "orddenom_spec_data_type": 0,
            "ordinate_axis_units_lab": "g",
        }  # fmt: skip
        pyuff.UFF(str(path)).write_sets(pyuff.prepare_58(**(fields | more)), "add")
    return path


def test_a_file_of_catman(tmp_path: Path) -> None:
    (tmp_path / "c.uff").write_bytes((DATA / "uff" / "catman.uff").read_bytes())
    info, values, warnings, taken = load(tmp_path / "c.uff", start_ns=None, unit=None)
    assert (info.sample_rate_hz, info.n_samples, info.channels[ACCELERATION]) == (20_000.0, 13, ("1x",))
    assert info.t_start_ns == 1_588_273_972 * 10**9 and len(warnings) == 1 and "no zone" in warnings[0]
    assert values[[0, 12], 0].tolist() == pytest.approx([-3.81956, -5.84096])
    assert (taken[0].unit, taken[0].stated, taken[0].source) == ("m/s²", True, "c.uff:1x")


def test_the_time_of_a_universal_file_is_of_the_zone_that_is_told_and_doubted_where_it_counts(tmp_path: Path) -> None:
    path = uff(tmp_path / "a.uff", BOTH)
    as_utc, _, told, _ = load(path, start_ns=None)
    assert any("its time 02-JAN-26 03:04:05 has no zone; taken as UTC" in one for one in told)
    in_zone, _, told, _ = load(path, start_ns=None, zone=zone_named("+01:00"))
    assert (as_utc.t_start_ns - in_zone.t_start_ns, told) == (3600 * 10**9, [])
    assert load(path, start_ns=0)[2] == []


@pytest.mark.filterwarnings(
    "ignore::pytest.PytestUnraisableExceptionWarning"
)  # pyuff writes 58b through a file left open
@pytest.mark.parametrize("binary", [0, 1])
def test_universal_files_in_both_forms(tmp_path: Path, binary: int) -> None:
    info, values, *_ = load(uff(tmp_path / "a.uff", BOTH, binary))
    assert (info.sample_rate_hz, info.channels[ACCELERATION]) == (200.0, ("10-z", "11-z"))
    np.testing.assert_allclose(values, 9.80665 * BOTH, rtol=1e-6, atol=1e-6)
    _, chosen, *_ = load(tmp_path / "a.uff", channels={"top": "a.uff:11-z"})
    np.testing.assert_allclose(chosen[:, 0], values[:, 1])


def test_units_code_si_of_dataset_164_is_the_unit_where_none_is_written(tmp_path: Path) -> None:
    path = tmp_path / "a.uff"
    units = pyuff.prepare_164(
        units_code=1, units_description="SI", temp_mode=1, length=1.0, force=1.0, temp=1.0, temp_offset=1.0
    )
    pyuff.UFF(str(path)).write_sets(units, "add")
    uff(path, BOTH[:, :1], ordinate_axis_units_lab="NONE")
    uff(path, BOTH[:, 1:], ordinate_axis_units_lab="NONE", ordinate_spec_data_type=13, rsp_node=3, rsp_dir=1)
    _, values, _, taken = load(path, unit=None, channels={"a1": "10-z"}, forces={"f1": "3x"})
    np.testing.assert_allclose(values[:, 0], X, rtol=1e-6, atol=1e-6)
    assert [(t.topic, t.unit, t.stated) for t in taken] == [(ACCELERATION, "m/s^2", True), (FORCE, "N", True)]


def test_universal_files_without_time_responses_or_of_unlike_ones_are_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match=r"no time response .* but frequency response"):
        load(uff(tmp_path / "a.uff", BOTH, func_type=4))
    mixed = uff(uff(tmp_path / "d.uff", BOTH), BOTH[:, :1], func_type=4)
    assert ["time responses are samples: frequency response" in one for one in load(mixed)[2]] == [True]
    with pytest.raises(BadInputError, match="10-z has 250 samples and 10-z 100"):
        load(uff(uff(tmp_path / "b.uff", BOTH[:, :1]), BOTH[:100, :1]))
    (tmp_path / "c.uff").write_bytes(b"    -1\n    58\n" + b"\n" * (5 << 20))
    with pytest.raises(BadInputError, match="at most 256 MiB"):
        load(tmp_path / "c.uff")


@pytest.mark.parametrize(
    ("name", "column", "values"),
    [
        ("testdouble_7.4_GLNX86.mat", "testdouble", np.arange(9) * np.pi / 4),
        ("testdouble_6.1_SOL2.mat", "testdouble", np.arange(9) * np.pi / 4),
        ("testdouble_4.2c_SOL2.mat", "testdouble", np.arange(9) * np.pi / 4),
        ("testhdf5_7.4_GLNX86.mat", "testdouble", np.arange(9) * np.pi / 4),
    ],
)
def test_files_that_matlab_wrote(tmp_path: Path, name: str, column: str, values: np.ndarray) -> None:
    """Of version 7 (packed), 5, 4 and 7.3 (HDF5)."""
    (tmp_path / "m.mat").write_bytes((MATLAB / name).read_bytes())
    info, found, *_ = load(tmp_path / "m.mat", rate_hz=10.0)
    assert info.channels[ACCELERATION] == (column,)
    np.testing.assert_allclose(found[:, 0], values, rtol=1e-6)


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("teststruct_7.4_GLNX86.mat", r"no array of numbers but teststruct \(struct\)"),
        ("some_functions.mat", "no vector or matrix of numbers; it has a, b, c"),
        ("corrupted_zlib_data.mat", "cannot be used as MAT"),
        ("malformed1.mat", "cannot be used as MAT"),
    ],
)
def test_matlab_files_that_cannot_be_used(tmp_path: Path, name: str, reason: str) -> None:
    (tmp_path / "m.mat").write_bytes((MATLAB / name).read_bytes())
    with pytest.raises(BadInputError, match=reason):
        load(tmp_path / "m.mat", rate_hz=10.0)


LAYOUTS = pytest.mark.parametrize(
    ("arrays", "names", "rate_hz"),
    [
        ({"samples": BOTH, "fs": 100.0, "channels": np.array(["u", "v"], object), "unit": "g"}, ("u", "v"), 100.0),
        ({"acc": BOTH.T, "Fs": 100.0, "unit": "g"}, ("acc_1", "acc_2"), 100.0),
        ({"east": X, "west": -2.0 * X, "dt": 0.005, "note": "of a Tuesday", "unit": "g"}, ("east", "west"), 200.0),
        ({"t": np.arange(250) / 50, "a": X[:, None], "b": (-2.0 * X)[None], "unit": "g"}, ("a", "b"), 50.0),
    ],
)


@LAYOUTS
def test_layouts_of_mat(tmp_path: Path, arrays: dict[str, Any], names: tuple[str, ...], rate_hz: float) -> None:
    info, values, warnings, taken = load(mat(tmp_path / "m.mat", **arrays))
    assert (info.channels[ACCELERATION], info.sample_rate_hz, warnings) == (names, rate_hz, [])
    np.testing.assert_allclose(values, 9.80665 * BOTH, rtol=1e-6, atol=1e-6)
    assert all(t.stated for t in taken)


def test_arrays_besides_the_samples_are_told_to_be_left_out(tmp_path: Path) -> None:
    _, values, told, _ = load(mat(tmp_path / "m.mat", samples=BOTH, air=X, fs=100.0, unit="g"))
    assert values.shape == BOTH.shape and ["samples` are left out: air" in one for one in told] == [True]


@pytest.mark.parametrize("words", ["g", np.array(["g", "mg"], object)], ids=["all", "each"])
def test_the_unit_of_arrays_stands_beside_them_for_all_or_for_each(tmp_path: Path, words: Any) -> None:
    _, values, _, taken = load(mat(tmp_path / "m.mat", acc=BOTH, fs=100.0, units=words))
    factors = 9.80665 * np.array([1.0, 1.0 if isinstance(words, str) else 1e-3])
    np.testing.assert_allclose(values, factors * BOTH, rtol=1e-6, atol=1e-6)
    assert [(one.unit, one.stated) for one in taken] == list(zip(np.broadcast_to(words, 2), [True] * 2, strict=True))


def test_times_are_taken_up_to_the_year_2096_and_later_ones_refused(tmp_path: Path) -> None:
    clock = 4e9 + np.arange(250) / 250.0
    info, *_ = load(mat(tmp_path / "early.mat", t=clock - 1.0, a=X, unit="g"))
    assert info.n_samples == 250
    with pytest.raises(BadInputError, match="times of"):
        load(mat(tmp_path / "late.mat", t=clock, a=X, unit="g"))


@pytest.mark.system
@LAYOUTS
def test_layouts_of_hdf5(tmp_path: Path, arrays: dict[str, Any], names: tuple[str, ...], rate_hz: float) -> None:
    texts = {"channels": ["u", "v"]} if "channels" in arrays else {}
    info, values, *_ = load(hdf5(tmp_path / "h.h5", **(arrays | texts)))
    assert (info.channels[ACCELERATION], info.sample_rate_hz) == (names, rate_hz)
    np.testing.assert_allclose(values, 9.80665 * BOTH, rtol=1e-6, atol=1e-6)


@pytest.mark.system
def test_groups_units_and_rate_of_hdf5(tmp_path: Path) -> None:
    path = hdf5(tmp_path / "h.h5", {"sample_rate": 100}, bridge__top=X, bridge__deep__low=-2 * X, short=X[:9])
    with h5py.File(path, "a") as file:
        file["bridge/top"].attrs["units"] = "g"
        file["again"] = h5py.SoftLink("/bridge")
        file["bridge/itself"] = file["/"]
    info, values, warnings, taken = load(path, unit="mg")
    assert (info.channels[ACCELERATION], info.sample_rate_hz) == (("bridge/top", "bridge/deep/low"), 100.0)
    np.testing.assert_allclose(values, 9.80665 * BOTH * [1, 1e-3], rtol=1e-6, atol=1e-6)
    assert [(t.unit, t.stated) for t in taken] == [("g", True), ("mg", False)] and "short" in warnings[0]


@pytest.mark.system
def test_hdf5_reads_nothing_outside_its_file(tmp_path: Path) -> None:
    (tmp_path / "secret").write_bytes(np.arange(100.0).tobytes())
    hdf5(tmp_path / "other.h5", secret=X)
    with h5py.File(tmp_path / "link.h5", "w") as file:
        file["a"] = h5py.ExternalLink(str(tmp_path / "other.h5"), "/secret")
    with pytest.raises(BadInputError, match="it has none"):
        load(tmp_path / "link.h5", rate_hz=1.0)
    with h5py.File(tmp_path / "raw.h5", "w") as file:
        file.create_dataset("a", (100,), "f8", external=[(str(tmp_path / "secret"), 0, 800)])
    with pytest.raises(BadInputError, match="lies in other files"):
        load(tmp_path / "raw.h5", rate_hz=1.0)
    layout = h5py.VirtualLayout((250,), "f8")
    layout[:] = h5py.VirtualSource(str(tmp_path / "other.h5"), "secret", (250,))
    with h5py.File(tmp_path / "virtual.h5", "w") as file:
        file.create_virtual_dataset("a", layout)
    with pytest.raises(BadInputError, match="lies in other files"):
        load(tmp_path / "virtual.h5", rate_hz=1.0)


@pytest.mark.system
def test_files_that_would_fill_the_memory_are_refused_before_they_are_unpacked(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "claim.h5", "w") as file:
        file.create_dataset("a", (1 << 18,), "f4", chunks=(1 << 10,), compression="gzip")
    with h5py.File(tmp_path / "chunk.h5", "w") as file:
        made = file.create_dataset("a", (1000,), "f8", chunks=(1000,), compression="gzip")
        made.id.write_direct_chunk((0,), zlib.compress(bytes(1 << 20)))
    packed = zlib.compress(bytes(2 << 20))
    head = b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack("<H", 0x100) + b"IM"
    (tmp_path / "packed.mat").write_bytes(head + struct.pack("<II", 15, len(packed)) + packed)
    for name, reason in (
        ("claim.h5", "would unpack to 2 MiB or more; at most 1 MiB"),
        ("chunk.h5", "a chunk of dataset a unpacks to more than its 8000 bytes"),
        ("packed.mat", "at most 1 MiB"),
    ):
        with pytest.raises(BadInputError, match=reason):
            load(tmp_path / name, rate_hz=1.0, unpacked_bytes=1 << 20)


@pytest.mark.system
def test_whatever_the_bytes_of_hdf5_only_our_errors_escape(tmp_path: Path) -> None:
    path = hdf5(tmp_path / "a.h5", a=X[:40], fs=10.0)
    whole, chance, outcomes = path.read_bytes(), random.Random(5), set()
    for _ in range(4):  # each takes a process
        data = bytearray(whole)
        for _ in range(chance.randrange(1, 4)):
            at = chance.randrange(len(data) - 20)
            if chance.random() < 0.5:
                data[at] ^= 1 << chance.randrange(8)
            else:
                data[at : at + chance.randrange(1, 12)] = chance.randbytes(4)
        path.write_bytes(bytes(data))
        try:
            load(path)
            outcomes.add("read")
        except BadInputError as error:
            assert path.name in str(error)
            outcomes.add("refused")
    assert outcomes


@pytest.mark.system
@pytest.mark.parametrize("kind", ["h5", "mat"])
@pytest.mark.parametrize(
    ("program", "says"),
    [("import time; time.sleep(600)", "did not end within 1 s"), ("import os; os.abort()", r"failed \(exit code -6\)")],
)
def test_a_file_at_which_the_library_hangs_or_crashes_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str, program: str, says: str
) -> None:
    """As damaged files do it with HDF5 1.14 (one bit in an attribute's heap) and with SciPy's reader of MAT."""
    path = hdf5(tmp_path / "a.h5", a=X) if kind == "h5" else mat(tmp_path / "a.mat", a=X)
    stand_in = tmp_path / "python"
    stand_in.write_text(f"#!{sys.executable}\n{program}\n")
    stand_in.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(stand_in))
    limit = {"reader_s": 1.0} if "sleep" in program else {}
    with pytest.raises(BadInputError, match=says):
        load(path, **limit)


@pytest.mark.parametrize(("kind", "module"), [("h5", "h5py"), ("uff", "pyuff")])
def test_without_a_library_one_line_names_the_extra(
    tmp_path: Path, kind: str, module: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = hdf5(tmp_path / "a.h5", a=X) if kind == "h5" else uff(tmp_path / "a.uff", BOTH)
    monkeypatch.setitem(sys.modules, module, None)  # as if it were not installed
    with pytest.raises(UserError, match=r"needs the extra formats: pip install 'shm-monitor\[formats\]'") as told:
        load(path)
    assert told.value.exit_code == 78


# --- units, start, level -----------------------------------------------------------------------------------------------


def table(path: Path, head: str = "t,a1,a2") -> Path:
    path.write_text(head + "\n" + "".join(f"{k / 100:.2f},{X[k]:.6f},{2 + X[k]:.6f}\n" for k in range(250)))
    return path


def test_an_import_says_start_rate_unit_and_level(tmp_path: Path, main: Cli) -> None:
    table(tmp_path / "log.csv")
    done = main("import", "log.csv", "--out", "o.mcap", "--start", "2026-01-02T03:04:05", cwd=tmp_path)
    assert done.returncode == 0
    assert "warning: no unit is stated of log.csv:a1, log.csv:a2; taken as m/s^2 (see --unit)" in done.stderr
    first, a1, a2 = done.stdout.splitlines()
    assert first == "2.50 s at 100 Hz from 2026-01-02 03:04:05 UTC in o.mcap: /acceleration: a1, a2"
    assert a1.startswith("  a1: log.csv:a1, unit m/s^2 (taken), mean ")
    assert ", mean 2.0" in a2
    table(tmp_path / "log.csv", "t,a1 [g],a2 [g]")
    done = main("import", "log.csv", "--out", "o.mcap", "--unit", "mg", "--json", cwd=tmp_path)
    assert "no unit" not in done.stderr
    told = json.loads(done.stdout)
    assert told["start_ns"] == 0 and [(c["unit"], c["stated"]) for c in told["taken"]] == [("g", True)] * 2
    assert told["taken"][1]["rms"] == pytest.approx(9.80665 * X.std(), rel=1e-4)


@pytest.mark.parametrize(
    ("head", "units"),
    [
        ("time_ms,ax_g,ay_g", ("g", "g")),
        ("t_us,acc_x_mg,acc_y_mg", ("mg", "mg")),
        ("Time(s),ax (mg),ay [g]", ("mg", "g")),
        ("t [ms],Accel x [in g],Accel y in g", ("g", "g")),
        ("time in ms,a1_m_s2,a2 m/s^2", ("m/s^2", "m/s^2")),
        ("elapsed_s,top_mps2,low_gal", ("m/s^2", "gal")),
    ],
)
def test_units_inside_names_are_those_of_the_columns_and_are_said(
    tmp_path: Path, main: Cli, head: str, units: tuple[str, str]
) -> None:
    ticks = 1000 if "ms" in head.split(",")[0] else 1_000_000 if "us" in head.split(",")[0] else 1
    rows = "".join(f"{ticks * k / 100:g},{x},{-x}\n" for k, x in enumerate(X.round(4)))
    (tmp_path / "log.csv").write_text(f"{head}\n{rows}")
    done = main("import", "log.csv", "--out", "o.mcap", "--start", "2026-01-02T03:04:05", cwd=tmp_path)
    assert done.stderr == ""
    first, *channels = done.stdout.splitlines()
    assert first.startswith("2.50 s at 100 Hz")
    for line, unit, name in zip(channels, units, head.split(",")[1:], strict=True):
        where = "stated in the file" if name.endswith(("]", ")")) else "by the column's name"
        assert f"unit {unit} ({where})" in line


def test_a_letter_that_numbers_channels_is_no_unit(tmp_path: Path) -> None:
    path = table(tmp_path / "log.csv", "t,ch_f,ch_g")
    _, _, warnings, taken = load(path, ask_unit=None)
    assert [one.stated for one in taken] == [False, False]
    assert any("no unit is stated of log.csv:ch_f, log.csv:ch_g" in text for text in warnings)


def test_arrays_state_units_in_their_names(tmp_path: Path) -> None:
    info, values, _, taken = load(mat(tmp_path / "m.mat", acc_x_mg=X, acc_y_mg=-X, time_ms=10.0 * np.arange(250)))
    assert (info.sample_rate_hz, [one.unit for one in taken]) == (100.0, ["mg", "mg"])
    np.testing.assert_allclose(values[:, 0], 9.80665e-3 * X, rtol=1e-6, atol=1e-9)


def test_a_unit_taken_for_granted_is_told_with_the_level_that_it_means(tmp_path: Path, main: Cli) -> None:
    table(tmp_path / "log.csv")
    rows = "".join(f"{k / 100:.2f},{0.1 * x:.6f},{0.1 * x + 1.0:.6f}\n" for k, x in enumerate(X))
    (tmp_path / "log.csv").write_text("t,a1,a2\n" + rows)
    done = main("import", "log.csv", "--out", "o.mcap", cwd=tmp_path)
    assert "taken as m/s^2 (see --unit): the RMS is then up to 0.0" in done.stderr
    assert "; if they are g, 0." in done.stderr
    assert ", which is gravity in g" in done.stderr


@pytest.mark.system
def test_on_a_terminal_the_unit_is_asked_until_it_is_one(tmp_path: Path) -> None:
    table(tmp_path / "log.csv")
    ours, theirs = pty.openpty()
    command = [
        sys.executable,
        "-m",
        "monitor",
        "import",
        "log.csv",
        "--out",
        "o.mcap",
        "--start",
        "2026-01-01",
        "--json",
    ]
    with subprocess.Popen(
        command, stdin=theirs, stderr=theirs, stdout=subprocess.PIPE, cwd=tmp_path, text=True,
        env={**os.environ, "TERM": "dumb"},
    ) as process:  # fmt: skip
        os.close(theirs)
        os.write(ours, b"volts\nmg\n")
        told = json.loads(process.stdout.read())
    os.close(ours)
    assert process.returncode == 0
    assert [c["unit"] for c in told["taken"]] == ["mg", "mg"]


# --- clocks that do not agree ------------------------------------------------------------------------------------------


def clocked(path: Path, begin_s: float, values: np.ndarray) -> Path:
    rows = "".join(f"{begin_s + k / 100:.2f},{v:.6f}\n" for k, v in enumerate(values))
    path.write_text("t,a [m/s^2]\n" + rows)
    return path


def test_files_are_aligned_by_what_they_hold(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    motion = rng.normal(size=3000)
    files = [
        clocked(tmp_path / "one.csv", 1000.0, motion[:2500]),
        clocked(tmp_path / "two.csv", 5.0, motion[300:2800] + 0.5 * rng.normal(size=2500)),
        clocked(tmp_path / "three.csv", 1015.0, -motion[100:2400] + 0.5 * rng.normal(size=2300)),
    ]
    with pytest.raises(BadInputError, match=r"overlap: one.csv with three.csv \(10\.0 s\)\. .*--align"):
        import_files(files, tmp_path / "o.mcap")
    warnings: list[str] = []
    import_files(files, tmp_path / "o.mcap", Options(align=True), on_warning=warnings.append)
    assert "two.csv: clock shifted by +998.000 s to fit one.csv (correlation" in warnings[0]
    assert "three.csv: clock shifted by -14.000 s to fit one.csv (correlation -" in warnings[1]
    values = np.concatenate([b.samples for b in read_recordings([tmp_path / "o.mcap"])])
    assert len(values) == 2100  # from sample 300 to 2400
    np.testing.assert_allclose(values[:, 0], motion[300:2400], atol=1e-5)
    assert abs(np.corrcoef(values.T)[0, 1:] - [0.9, -0.9]).max() < 0.05


def test_what_fits_nowhere_or_nearly_as_well_elsewhere_is_said(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    files = [clocked(tmp_path / f"{name}.csv", 0.0, rng.normal(size=2500)) for name in ("one", "two")]
    with pytest.raises(BadInputError, match=r"two\.csv: its readings fit those of .*one\.csv nowhere"):
        import_files(files, tmp_path / "o.mcap", Options(align=True))
    motion = rng.normal(size=2600)
    echo = motion[60:2560] + 0.9 * motion[:2500]
    files = [clocked(tmp_path / "one.csv", 0.0, motion[:2500]), clocked(tmp_path / "two.csv", 90.0, echo)]
    warnings: list[str] = []
    import_files(files, tmp_path / "o.mcap", Options(align=True), on_warning=warnings.append)
    assert "or by -0.600 s more, which fits nearly as well" in warnings[0]


def test_a_shift_is_found_across_the_end_of_the_reference() -> None:
    noise = np.random.default_rng(0).normal(size=1000)
    assert best_shift(noise[200:], noise[:600]).shift == -200
    assert best_shift(noise[:600], noise[500:]).shift == 500
    assert best_shift(np.zeros(5), np.zeros(5)).correlation == 0.0
