"""Files of every format that `import` reads, right ones and the way in; `targets` has the other ways."""

from __future__ import annotations

import atexit
import contextlib
import functools
import importlib
import io
import math
import os
import shutil
import tempfile
import time
import warnings
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from monitor.core import UserError
from tests.runs.hostile import forked, with_room
from tests.runs.logger_files import START_NS, cosmos, geocsv, motion, packed, tables, workbook
from tests.runs.reading import imported

_LONGEST_S = 30.0
"""Longest time that a file may take."""
_MOST_TOLD = 40
"""Most warnings of one file."""
_UNPACKED = 1 << 26
"""Bytes that a file may unpack to."""


@dataclass(frozen=True)
class Target:
    """One way in."""

    run: Callable[[bytes], object]
    """Takes bytes; anything that it raises is a fault."""
    seeds: Callable[[], list[bytes]]
    """Inputs that are right."""
    share: float
    """Of the messages of a whole run; what is slow gets fewer."""
    longest: int = 20_000
    """Bytes; a stream of frames takes a time that grows with them."""
    least: int = 40
    """Of the messages of the tests; what is fast gets more."""


MEMORY = "/dev/shm" if Path("/dev/shm").is_dir() else None


@functools.cache
def scratch() -> Path:
    """A folder in memory, of this process."""
    folder = tempfile.mkdtemp(prefix="shm-fuzz-", dir=os.environ.get("TMPDIR", MEMORY))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return Path(folder)


def placed(name: str, data: bytes) -> Path:
    path = scratch() / name
    path.write_bytes(data)
    return path


def imported_file(
    suffix: str,
    seeds: Callable[[], list[bytes]],
    share: float = 0.01,
    least: int = 30,
    made: Callable[[bytes], bytes] = bytes,
    *,
    apart: bool = False,
    **options: Any,
) -> Target:
    """A file that `import` reads, `made` of the input; `apart` by a process of its own, which is a copy of this one elsewhere."""

    def run(data: bytes) -> bool:
        path, out = placed("a" + suffix, made(data)), scratch() / "out.mcap"
        told: list[str] = []
        begun, read = time.monotonic(), True
        try:
            with forked(apart=apart), with_room():
                imported([path], out, on_warning=told.append, unpacked_bytes=_UNPACKED, **options)
        except UserError as refused:
            assert path.name in str(refused)
            told.append(str(refused))
            read = False
        assert time.monotonic() - begun < _LONGEST_S
        assert len(told) <= _MOST_TOLD and max(map(len, told), default=0) < 10_000
        out.unlink(missing_ok=True)
        assert not out.with_name("out.mcap.part").exists()
        return read

    return Target(run, seeds, share, 20_000 if share > 0.01 else 4000, least)


def _csv_seeds() -> list[bytes]:
    rows = "\n".join(f"{k / 100:.2f},{math.sin(k):.4f},{math.cos(k):.4f},0.1" for k in range(30))
    dotted = "\n".join(f"{k};{k * 16667};0,1;0,2;9,{k:02d}" for k in range(30))
    return [
        f"time,a1,a2,a3\n{rows}\n".encode(),
        f"t [s];a1 [g];a2 [g];a3 [g]\n{rows.replace(',', ';')}\n".encode(),
        b"DeviceTag:,x\nOutputRate:,60Hz\n\nPacketCounter,SampleTimeFine,Acc_X,Acc_Y,Acc_Z\n"
        + dotted.replace(";", ",").encode(),
        b"2026-01-01T00:00:00.000Z,1,2,3\n2026-01-01T00:00:00.010Z,1,2,3\n2026-01-01T00:00:00.020Z,2,3,4\n",
        f"time,a1\n{rows}".encode("utf-16"),
    ]


def _zip_seeds() -> list[bytes]:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.csv", _csv_seeds()[0])
    return [file.getvalue()]


def _npz_seeds() -> list[bytes]:
    samples, made = np.sin(np.arange(90.0).reshape(30, 3)), []
    t = np.arange(30) / 100
    named: dict[str, Any] = {"samples": samples, "rate_hz": 100.0, "channels": ["a1", "a2", "a3"]}
    for arrays in (named, {"x": samples[:, 0], "t": t}):
        for save in (np.savez, np.savez_compressed):
            file = io.BytesIO()
            save(file, **arrays)
            made.append(file.getvalue())
    return made


def _npz_array_seeds() -> list[bytes]:
    arrays = (np.sin(np.arange(90.0).reshape(30, 3)), np.arange(9, dtype=np.int16), np.array(["a1", "a2"]))
    made = []
    for array in arrays:
        file = io.BytesIO()
        np.save(file, array)
        made.append(file.getvalue())
    return made


def _table_seeds() -> list[bytes]:
    """The head of each file of `logger_files`."""
    cut = [b"".join(one.content.splitlines(keepends=True)[:60]) for one in tables() if b"\0" not in one.content]
    return [content[:6000] for content in cut]


def _packed_seeds(magic: bytes) -> Callable[[], list[bytes]]:
    return lambda: [one.content for one in packed() if one.content.startswith(magic)]


def _workbook_seeds() -> list[bytes]:
    """A workbook, and its sheet alone, whose checksum would hide it otherwise."""
    rows = [
        ["Time (s)", "a1 (g)", "a2 (g)"],
        *([k / 100, *row[:2]] for k, row in enumerate(motion(100.0, 30).tolist())),
    ]
    (book,) = written(".xlsx", lambda path: workbook(path, rows))()
    with zipfile.ZipFile(io.BytesIO(book)) as archive:
        return [book, archive.read(_SHEET)]


_SHEET = "xl/worksheets/sheet1.xml"


def _with_sheet(data: bytes) -> bytes:
    """A sound workbook around a sheet."""
    if data.startswith(b"PK"):
        return data
    path = scratch() / "sheet.xlsx"
    workbook(path, [])
    file = io.BytesIO()
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(file, "w") as new:
        for name in old.namelist():
            new.writestr(name, data if name == _SHEET else old.read(name))
    return file.getvalue()


def _peer_seeds() -> list[bytes]:
    (record,) = (one.content for one in tables() if one.name.endswith(".AT2"))
    return [record]


def _cosmos_seeds() -> list[bytes]:
    gal = 100.0 * motion(100.0, 40)
    kinds = [cosmos(gal[:, 0], unit, kind=kind) for kind, unit in (("acceleration", "cm/sec2"), ("velocity", "cm/sec"))]
    three = [cosmos(column / 980.665, "g(02)", (8, 9, 6), channel=k) for k, column in enumerate(gal.T)]
    return ["".join(kinds).encode(), "".join(three).encode()]


def _geocsv_seeds() -> list[bytes]:
    start = "2026-03-02T14:00:00"
    head: dict[str, object] = {"sample_rate_hz": 100, "start_time": f"{start}Z", "scale_factor": 9, "scale_units": "g"}
    pairs = [f"{start}.{k:02d}Z| {k % 7}" for k in range(30)]
    lists = [geocsv("Sample", "Counts", [str(k % 5) for k in range(30)], sid=f"XX_A__HN{k}", **head) for k in range(3)]
    return ["".join(lists).encode(), geocsv("Time, Sample", "UTC, g", pairs, "|", sid="XX_A__HNZ").encode()]


@functools.cache
def _obspy() -> Any:
    """ObsPy, which calls what newer Pythons call outdated."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        obspy = importlib.import_module("obspy")
        with contextlib.suppress(TypeError):
            obspy.read(
                io.BytesIO(b"of no format")
            )  # loads all of them, which a copy of this process would do each time
        return obspy


def _miniseed_seeds() -> list[bytes]:
    obspy = _obspy()
    counts, made = np.random.default_rng(0).integers(-1000, 1000, (300, 2)).astype(np.int32), []
    header = {"network": "XX", "station": "ROOF", "sampling_rate": 100.0}
    traces = [obspy.Trace(counts[:, k].copy(), {**header, "channel": f"HN{k}"}) for k in range(2)]
    text = np.frombuffer(b"clock locked\n" * 4, "S1").copy()
    for encoding in ("STEIM2", "STEIM1", "INT32"):
        file = io.BytesIO()
        obspy.Stream(traces).write(file, format="MSEED", encoding=encoding, reclen=256)
        made.append(file.getvalue())
    file = io.BytesIO()
    obspy.Stream([obspy.Trace(text, {**header, "channel": "LOG", "sampling_rate": 0.0})]).write(file, format="MSEED")
    return [*made, made[0] + file.getvalue()]


def _knet_seeds() -> list[bytes]:
    return [(Path(_obspy().__file__).parent / "io" / "nied" / "tests" / "data" / "test.knet").read_bytes()[:3000]]


def _seismic_seeds(form: str) -> Callable[[], list[bytes]]:
    def write(path: Path) -> None:
        counts = np.round(1e5 * motion(100.0, 200)[:, 0]).astype(np.float32 if form == "SAC" else np.int32)
        head = {"network": "XX", "station": "ROOF", "channel": "HNZ", "sampling_rate": 100.0}
        head["starttime"] = _obspy().UTCDateTime(ns=START_NS)
        _obspy().Stream([_obspy().Trace(counts, head)]).write(str(path), format=form)

    return written("." + form.lower(), write)


def written(suffix: str, write: Callable[[Path], object]) -> Callable[[], list[bytes]]:
    """A file as the library that reads it writes it."""

    def seeds() -> list[bytes]:
        path = scratch() / ("seed" + suffix)
        path.unlink(missing_ok=True)
        write(path)
        return [path.read_bytes()]

    return seeds


def _write_uff(path: Path) -> None:
    import pyuff

    x = np.arange(30) / 100
    data = pyuff.prepare_58(
        func_type=1, rsp_node=1, rsp_dir=3, ref_node=0, ref_dir=0, data=np.sin(x), x=x, abscissa_spacing=1,
        abscissa_spec_data_type=17, ordinate_spec_data_type=12, orddenom_spec_data_type=0, id1="x",
    )  # fmt: skip
    pyuff.UFF(str(path)).write_sets(data, "add")


def _mat_seeds() -> list[bytes]:
    from scipy.io import savemat

    content = {"acc": motion(100.0, 60), "fs": 100.0, "unit": "g"}
    forms: tuple[dict[str, Any], ...] = ({"do_compression": True}, {}, {"format": "4"})
    return [written(".mat", lambda path, form=form: savemat(path, content, **form))()[0] for form in forms]  # type: ignore[misc]


def _hdf5_seeds() -> list[bytes]:
    import h5py

    def write(path: Path, user_block: int, **form: Any) -> None:
        with h5py.File(path, "w", userblock_size=user_block) as file:
            file.attrs["fs"] = 100.0
            for name in ("a1", "bridge/a2"):
                file.create_dataset(name, data=motion(100.0, 60)[:, 0], **form).attrs["unit"] = "g"

    forms = ({}, {"compression": "gzip", "shuffle": True, "fletcher32": True}, {"compression": "lzf"})
    return [
        written(".h5", functools.partial(write, user_block=block, **form))()[0]
        for form, block in zip(forms, (0, 512, 0), strict=True)
    ]


def _write_tdms(path: Path) -> None:
    import nptdms

    told = {"wf_increment": 0.01, "wf_start_time": np.datetime64("2026-03-02T14:00:00"), "unit_string": "g"}
    with nptdms.TdmsWriter(str(path)) as file:
        for part in np.split(motion(100.0, 60), 2):
            file.write_segment([nptdms.ChannelObject("Log", f"a{k}", part[:, k], properties=told) for k in range(3)])


def _write_mdf(path: Path, version: str, **form: Any) -> None:
    import asammdf

    with asammdf.MDF(version=version) as file:
        for unit in ("g", "degC"):
            columns = motion(100.0, 60).T
            file.append([asammdf.Signal(x, np.arange(60) / 100, unit, f"{unit} {k}") for k, x in enumerate(columns)])
        file.save(path, overwrite=True, **form)


def _mdf_seeds() -> list[bytes]:
    forms = ((".mf4", "4.10", {}), (".mf4", "4.10", {"compression": 2}), (".mdf", "3.30", {}))
    return [
        written(suffix, lambda path, version=version, form=form: _write_mdf(path, version, **form))()[0]  # type: ignore[misc]
        for suffix, version, form in forms
    ]


def _npz_array(data: bytes) -> bool:
    read = []
    for deflated in (False, True):
        file = io.BytesIO()
        with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED if deflated else zipfile.ZIP_STORED) as archive:
            archive.writestr("samples.npy", data)
        read.append(bool(_ARRAY.run(file.getvalue())))
    return all(read)


_ARRAY = imported_file(".npz", _npz_array_seeds, rate_hz=100.0)
_COUNTS: dict[str, Any] = {"apart": True, "scale": 1e-5}

FILES: dict[str, Target] = {
    "csv": imported_file(".csv", _csv_seeds, 0.03, 300),
    "table": imported_file(".csv", _table_seeds, 0.03),
    "xlsx": imported_file(".xlsx", _workbook_seeds, made=_with_sheet),
    "peer": imported_file(".AT2", _peer_seeds),
    "zip": imported_file(".zip", _zip_seeds, least=300),
    "gzip": imported_file(".csv.gz", _packed_seeds(b"\x1f\x8b")),
    "bzip2": imported_file(".csv.bz2", _packed_seeds(b"BZh")),
    "xz": imported_file(".csv.xz", _packed_seeds(b"\xfd7zXZ")),
    "npz": imported_file(".npz", _npz_seeds, 0.02, 300),
    "npz_array": Target(_npz_array, _npz_array_seeds, 0.01, 4000, 300),
    "mat": imported_file(".mat", _mat_seeds, apart=True, rate_hz=100.0),
    "hdf5": imported_file(".h5", _hdf5_seeds, apart=True),
    "uff": imported_file(".uff", written(".uff", _write_uff), apart=True, rate_hz=100.0),
    "tdms": imported_file(".tdms", written(".tdms", _write_tdms), apart=True),
    "mdf": imported_file(".mf4", _mdf_seeds, apart=True),
    "geocsv": imported_file(".csv", _geocsv_seeds),
    "cosmos": imported_file(".V2", _cosmos_seeds),
    "miniseed": imported_file(".mseed", _miniseed_seeds, **_COUNTS),
    "knet": imported_file(".knet", _knet_seeds, apart=True),
    "sac": imported_file(".sac", _seismic_seeds("SAC"), apart=True, unit="gal"),
    **{form.lower(): imported_file(".gse2", _seismic_seeds(form), **_COUNTS) for form in ("GSE2", "SLIST", "TSPAIR")},
}
APART = ("mat", "hdf5", "uff", "tdms", "mdf", "miniseed", "knet", "sac", "gse2", "slist", "tspair")
"""Formats of which each file is read by a process of its own."""
