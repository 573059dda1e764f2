# ruff: noqa: E501 - headings of files stand in one line
"""Files as loggers, spreadsheets and phones write them, of one known motion: the same three channels, told in many ways."""

from __future__ import annotations

import bz2
import gzip
import io
import lzma
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np

G = 9.80665
START = datetime(2026, 3, 2, 14, 0, 0, tzinfo=UTC)
START_NS = int(START.timestamp()) * 10**9
N = 600


def motion(rate_hz: float, n: int = N) -> np.ndarray:
    """Three channels of two modes with noise, m/s^2."""
    t = np.arange(n) / rate_hz
    noise = np.random.default_rng(7).normal(scale=0.02, size=(n, 3))
    first, second = np.sin(2.0 * np.pi * 2.0 * t), np.cos(2.0 * np.pi * 5.5 * t)
    return np.column_stack([first + second, 0.7 * first - second, 0.3 * first + 0.5 * second]) + noise


@dataclass(frozen=True)
class LoggerFile:
    """A file, and what is true of it."""

    name: str
    content: bytes
    rate_hz: float
    columns: int = 3
    unit: str = "m/s^2"
    start_ns: int | None = None
    says: str = ""
    """What must be told of it."""
    options: dict[str, Any] | None = None


Cell = Callable[[float], str]


def lines(
    times: list[str],
    values: np.ndarray,
    *,
    sep: str = ",",
    end: str = "\n",
    cell: Cell = lambda x: f"{x:.7f}",
    tail: str = "",
) -> str:
    """Rows of a time and readings."""
    return "".join(
        sep.join([t, *map(cell, row)] if t else list(map(cell, row))) + tail + end
        for t, row in zip(times, values, strict=True)
    )


def elapsed(rate_hz: float, form: str = "{:.6f}", scale: float = 1.0, n: int = N) -> list[str]:
    return [form.format(scale * k / rate_hz) for k in range(n)]


def dated(rate_hz: float, form: str, digits: int = 6, n: int = N) -> list[str]:
    """Dates in a form of strftime, with the fraction of the second where it has %f, cut to so many digits."""
    out = []
    for k in range(n):
        moment = START + timedelta(microseconds=round(1e6 * k / rate_hz))
        out.append(moment.strftime(form.replace("%f", f"{moment.microsecond:06d}"[:digits])))
    return out


def cut_ms(rate_hz: float, n: int = N) -> list[str]:
    return [f"{int(np.floor(1e3 * k / rate_hz + 1e-9)) / 1e3:.3f}" for k in range(n)]


def comma(x: float) -> str:
    return f"{x:.7f}".replace(".", ",")


def quoted(text: str) -> str:
    return "\n".join(",".join(f'"{cell}"' for cell in line.split(",")) for line in text.splitlines()) + "\n"


def tables() -> Iterator[LoggerFile]:
    """Tables of text."""
    a = motion(100.0)
    t = elapsed(100.0)
    names = "t,a1,a2,a3\n"

    def one(name: str, text: str | bytes, rate: float = 100.0, **more: Any) -> LoggerFile:
        return LoggerFile(name, text.encode() if isinstance(text, str) else text, rate, **more)

    plain = lines(t, a)
    yield one("plain.csv", "time,a1 (m/s^2),a2 (m/s^2),a3 (m/s^2)\n" + plain)
    yield one("g.csv", "time [s],a1 [g],a2 [g],a3 [g]\n" + lines(t, a / G), unit="g")
    yield one("mg_names.csv", "time_s,ax_mg,ay_mg,az_mg\n" + lines(t, 1e3 * a / G), unit="mg")
    yield one("in_g.csv", "Time,X in g,Y in g,Z in g\n" + lines(t, a / G), unit="g")
    yield one("sec2.csv", "Time,X (m/sec^2),Y (m/sec^2),Z (m/sec^2)\n" + plain, unit="m/sec^2")
    yield one("spaced_unit.csv", "Time,X [m s-2],Y [m s-2],Z [m s-2]\n" + plain, unit="m s-2")
    yield one("feet.csv", "Time,X [ft/s^2],Y [ft/s^2],Z [ft/s^2]\n" + lines(t, a / 0.3048), unit="ft/s^2")
    yield one(
        "inches.txt", "Time\tX [in/s^2]\tY [in/s^2]\tZ [in/s^2]\n" + lines(t, a / 0.0254, sep="\t"), unit="in/s^2"
    )
    yield one("gal.csv", "Time;NS [Gal];EW [Gal];UD [Gal]\n" + lines(t, 100.0 * a, sep=";"), unit="Gal")
    yield one("gs.csv", "Time,X (g's),Y (g's),Z (g's)\n" + lines(t, a / G), unit="g's")
    yield one(
        "german.csv",
        "Zeit [s];a1 [m/s²];a2 [m/s²];a3 [m/s²]\r\n"
        + lines([x.replace(".", ",") for x in t], a, sep=";", end="\r\n", cell=comma),
        unit="m/s²",
    )
    yield one(
        "cp1252.csv",
        ("Zeit [s];a1 [m/s²];a2 [m/s²];a3 [m/s²]\n" + lines(t, a, sep=";", cell=comma)).encode("cp1252"),
        unit="m/s²",
    )
    yield one("utf16.txt", ("t\ta1 (m/s^2)\ta2 (m/s^2)\ta3 (m/s^2)\n" + lines(t, a, sep="\t")).encode("utf-16"))
    yield one("bom.csv", b"\xef\xbb\xbf" + ("t,a1 (g),a2 (g),a3 (g)\n" + lines(t, a / G)).encode(), unit="g")
    yield one("quoted.csv", quoted("time,a1 (g),a2 (g),a3 (g)\n" + lines(t, a / G)), unit="g")
    yield one("sep.csv", "sep=;\nt;a1 [g];a2 [g];a3 [g]\n" + lines(t, a / G, sep=";"), unit="g")
    yield one(
        "comments.txt",
        "# logger 7, firmware 1.2\n# site: roof\n# t a1 a2 a3\n" + lines(t, a, sep=" "),
        options={"unit": "m/s^2"},
    )
    yield one("spaces.txt", lines(t, a, sep="   "), options={"unit": "m/s^2"})
    yield one("trailing.csv", "t,a1 [g],a2 [g],a3 [g]\n" + lines(t, a / G, tail=","), unit="g")
    yield one("trailing_both.csv", "t,a1 [g],a2 [g],a3 [g],\n" + lines(t, a / G, tail=","), unit="g")
    yield one("units_row.csv", "Time,Acc1,Acc2,Acc3\ns,g,g,g\n" + lines(t, a / G), unit="g")
    yield one("units_brackets_row.csv", "Time,Acc1,Acc2,Acc3\n[s],[g],[g],[g]\n\n" + lines(t, a / G), unit="g")
    yield one("units_above.csv", "s;g;g;g\nTime;Acc1;Acc2;Acc3\n" + lines(t, a / G, sep=";"), unit="g")
    yield one(
        "rates_row.txt",
        "TIME\tAcc1\tAcc2\tAcc3\nsec\tg\tg\tg\nSR=100 Hz\tSR=100 Hz\tSR=100 Hz\tSR=100 Hz\n"
        + lines(t, a / G, sep="\t"),
        unit="g",
    )
    yield one("sensors_row.csv", "Time,Acc1,Acc2,Acc3\ns,g,g,g\nID,4711,4712,4713\n" + lines(t, a / G), unit="g")
    toa5 = '"TOA5","s","CR6","1","CR6.Std.10","CPU:p.CR6","5","Accel"\n"TIMESTAMP","RECORD","X","Y","Z"\n"TS","RN","m/s^2","m/s^2","m/s^2"\n"","","Smp","Smp","Smp"\n'
    stamps = dated(100.0, "%Y-%m-%d %H:%M:%S.%f", 2)
    yield one(
        "toa5.dat",
        toa5
        + "".join(
            f'"{s}",{k},{r[0]:.6f},{r[1]:.6f},{r[2]:.6f}\n' for k, (s, r) in enumerate(zip(stamps, a, strict=True))
        ),
        start_ns=START_NS,
    )
    yield one("fewer.csv", "a1 (g),a2 (g),a3 (g)\n" + lines(t, a / G), unit="g")
    yield one(
        "counter.csv",
        "sample,time_ms,a1_g,a2_g,a3_g\n"
        + "".join(f"{k},{10 * k}," + ",".join(f"{v:.7f}" for v in r / G) + "\n" for k, r in enumerate(a)),
        unit="g",
    )
    yield one("enz.csv", "time,E (m/s^2),N (m/s^2),Z (m/s^2)\n" + plain)
    yield one("no_time.csv", "Sample rate: 100 Hz\nUnit: g\nE,N,Z\n" + lines([""] * N, a / G), unit="g")
    yield one(
        "rate_line.txt",
        "Logger X\nSampling Frequency (Hz): 100\nChannels: 3\n\nA1 (g)\tA2 (g)\tA3 (g)\n"
        + lines([""] * N, a / G, sep="\t"),
        unit="g",
    )
    yield one(
        "interval_line.txt", "Sample Interval (s), 0.01\nA1 (g),A2 (g),A3 (g)\n" + lines([""] * N, a / G), unit="g"
    )
    yield one(
        "start_line.txt",
        "Start Time: 2026-03-02 14:00:00\nRate: 100 Hz\nA1 (g),A2 (g),A3 (g)\n" + lines([""] * N, a / G),
        unit="g",
        start_ns=START_NS,
    )
    yield one(
        "iso.csv",
        "timestamp,a1 [g],a2 [g],a3 [g]\n" + lines(dated(100.0, "%Y-%m-%dT%H:%M:%S.%fZ", 3), a / G),
        unit="g",
        start_ns=START_NS,
    )
    yield one(
        "zone.csv",
        "timestamp,a1 [g],a2 [g],a3 [g]\n" + lines([s + "+00:00" for s in dated(100.0, "%Y-%m-%dT%H:%M:%S.%f")], a / G),
        unit="g",
        start_ns=START_NS,
    )
    yield one(
        "us.csv",
        "Date,a1 [g],a2 [g],a3 [g]\n" + lines(dated(100.0, "%m/%d/%Y %I:%M:%S.%f %p", 3), a / G),
        unit="g",
        start_ns=START_NS,
    )
    yield one(
        "dots.csv",
        "Datum;a1 [g];a2 [g];a3 [g]\n" + lines(dated(100.0, "%d.%m.%Y %H:%M:%S,%f", 3), a / G, sep=";", cell=comma),
        unit="g",
        start_ns=START_NS,
    )
    yield one(
        "months.csv",
        "Time,a1 [g],a2 [g],a3 [g]\n" + lines(dated(100.0, "%d-%b-%Y %H:%M:%S.%f", 3), a / G),
        unit="g",
        start_ns=START_NS,
    )
    two = [s.replace(" ", ",") for s in dated(100.0, "%Y-%m-%d %H:%M:%S.%f", 3)]
    yield one("two_columns.csv", "Date,Time,a1 [g],a2 [g],a3 [g]\n" + lines(two, a / G), unit="g", start_ns=START_NS)
    three = [f"{s[:-4]},{int(s[-3:])}" for s in dated(100.0, "%Y-%m-%d %H:%M:%S.%f", 3)]
    yield one("fraction.csv", "Time,ms,a1 [g],a2 [g],a3 [g]\n" + lines(three, a / G), unit="g", start_ns=START_NS)
    yield one(
        "of_day.csv",
        "Time,a1 [g],a2 [g],a3 [g]\n" + lines(dated(100.0, "%H:%M:%S.%f", 3), a / G),
        unit="g",
        says="no date",
    )
    epoch = START.timestamp()
    yield one(
        "unix.csv",
        "time,a1 [g],a2 [g],a3 [g]\n" + lines([f"{epoch + k / 100:.2f}" for k in range(N)], a / G),
        unit="g",
        start_ns=START_NS,
    )
    for unit, factor in (("ms", 1e3), ("us", 1e6), ("ns", 1e9)):
        moments = [
            str(round((epoch * 100 + k) * factor / 100)) if unit != "ns" else str(START_NS + k * 10**7)
            for k in range(N)
        ]
        yield one(
            f"unix_{unit}.csv", "timestamp,a1 [g],a2 [g],a3 [g]\n" + lines(moments, a / G), unit="g", start_ns=START_NS
        )
    days = epoch / 86400.0 + 25569.0
    yield one(
        "serial.csv",
        "Date,a1 [g],a2 [g],a3 [g]\n" + lines([f"{days + k / 8.64e6:.11f}" for k in range(N)], a / G),
        unit="g",
        start_ns=START_NS,
    )
    yield one(
        "datenum.csv",
        "Time,a1 [g],a2 [g],a3 [g]\n" + lines([f"{days + 693960.0 + k / 8.64e6:.11f}" for k in range(N)], a / G),
        unit="g",
        start_ns=START_NS,
    )
    for rate in (60.0, 120.0, 128.0, 150.0, 256.0, 400.0, 512.0):
        yield one(
            f"cut_{rate:.0f}.csv",
            names.replace("a1,a2,a3", "a1 [g],a2 [g],a3 [g]") + lines(cut_ms(rate), motion(rate) / G),
            rate,
            unit="g",
        )
    paused = [
        f"{float(x) + (7.3 if k >= 250 else 0.0) + (41.0 if k >= 500 else 0.0):.3f}"
        for k, x in enumerate(cut_ms(120.0))
    ]
    yield one(
        "pauses.csv", "t,a1 [g],a2 [g],a3 [g]\n" + lines(paused, motion(120.0) / G), 120.0, unit="g", says="2 gaps"
    )
    jitter = np.arange(N) / 104.2 + np.random.default_rng(3).normal(scale=1.2e-3, size=N)
    phone = [f"{x:.6f}" for x in np.maximum.accumulate(jitter - jitter[0])]
    yield one(
        "phone.csv", "time (s),x (m/s^2),y (m/s^2),z (m/s^2)\n" + lines(phone, motion(104.2)), 104.2, says="scatter"
    )
    wide = np.column_stack([a, np.sqrt((a**2).sum(axis=1))])
    head = '"Time (s)","Acceleration x (m/s^2)","Acceleration y (m/s^2)","Acceleration z (m/s^2)","Absolute acceleration (m/s^2)"\n'
    yield one("magnitude.csv", head + lines(t, wide))
    warm = np.column_stack([a / G, np.full(N, 21.5)])
    yield one(
        "temperature.csv",
        "t,a1 [g],a2 [g],a3 [g],Temp [degC]\n" + lines(t, warm),
        unit="g",
        says="covariate /temperature",
    )
    holed = plain.splitlines(keepends=True)
    for k, word in ((100, ""), (200, "---"), (300, "NULL"), (400, "NaN"), (450, "Overrange")):
        cells = holed[k].split(",")
        holed[k] = ",".join([cells[0], word, *cells[2:]])
    yield one("holes.csv", "t,a1 (m/s^2),a2 (m/s^2),a3 (m/s^2)\n" + "".join(holed), says="5 readings are missing")
    filled = a.copy()
    filled[50:53, 1] = -7999.0
    yield one("fillers.csv", "t,a1 (m/s^2),a2 (m/s^2),a3 (m/s^2)\n" + lines(t, filled), says="-7999")
    grouped = "".join(
        f"{x};{1e6 * r[0]:,.1f};{1e6 * r[1]:,.1f};{1e6 * r[2]:,.1f}\n" for x, r in zip(t, a / G, strict=True)
    )
    yield one("thousands.csv", "t;a1 [ug];a2 [ug];a3 [ug]\n" + grouped, unit="ug")
    points = grouped.replace(",", "_").replace(".", ",").replace("_", ".")
    yield one("points.csv", "t;a1 [ug];a2 [ug];a3 [ug]\n" + points, unit="ug")
    whole = "".join(
        f"{x};{round(1e6 * r[0]):,};{round(1e6 * r[1]):,};{round(1e6 * r[2]):,}\n"
        for x, r in zip(t, a / G, strict=True)
    )
    yield one("whole_thousands.csv", "t;a1 [ug];a2 [ug];a3 [ug]\n" + whole, unit="ug")
    yield one(
        "joined.csv",
        "t,a1 [g],a2 [g],a3 [g]\n"
        + lines(t[:300], a[:300] / G)
        + "t,a1 [g],a2 [g],a3 [g]\n"
        + lines(t[300:], a[300:] / G),
        unit="g",
        says="headings stand again",
    )
    doubled = "".join(row * 2 for row in plain.splitlines(keepends=True))
    yield one("doubled.csv", "t,a1 (m/s^2),a2 (m/s^2),a3 (m/s^2)\n" + doubled, says="600 rows stand twice")
    block = plain.splitlines(keepends=True)
    yield one(
        "again.csv",
        "t,a1 (m/s^2),a2 (m/s^2),a3 (m/s^2)\n" + "".join([*block[:400], *block[300:]]),
        says="100 rows stand twice",
    )
    yield one(
        "disorder.csv",
        "t,a1 (m/s^2),a2 (m/s^2),a3 (m/s^2)\n" + "".join([*block[:300:2], *block[1:300:2], *block[300:]]),
        says="order",
    )
    yield one("cut_off.csv", "t,a1 (m/s^2),a2 (m/s^2),a3 (m/s^2)\n" + plain + "6.00,0.1", says="cut short")
    yield one("blank_lines.csv", "t,a1 (m/s^2),a2 (m/s^2),a3 (m/s^2)\n" + "\n".join(plain.splitlines(keepends=True)))
    yield one("mac.csv", ("t,a1 (m/s^2),a2 (m/s^2),a3 (m/s^2)\n" + plain).replace("\n", "\r"))
    yield one("stroke.txt", "t|a1 [g]|a2 [g]|a3 [g]\n" + lines(t, a / G, sep="|"), unit="g")
    yield one("log_named.log", "t,a1 [g],a2 [g],a3 [g]\n" + lines(t, a / G), unit="g")
    yield one("asc_named.asc", "t\ta1 [g]\ta2 [g]\ta3 [g]\n" + lines(t, a / G, sep="\t"), unit="g")
    lvm = "LabVIEW Measurement\t\nSeparator\tTab\nX_Columns\tNo\nDate\t2026/03/02\nTime\t14:00:00\n***End_of_Header***\t\n\t\nChannels\t3\t\t\t\nSamples\t600\t600\t600\t\nDate\t2026/03/02\t2026/03/02\t2026/03/02\t\nTime\t14:00:00\t14:00:00\t14:00:00\t\nY_Unit_Label\tg\tg\tg\t\nX_Dimension\tTime\tTime\tTime\t\nX0\t0.0E+0\t0.0E+0\t0.0E+0\t\nDelta_X\t0.01\t0.01\t0.01\t\n***End_of_Header***\t\t\t\t\nX_Value\tA1\tA2\tA3\tComment\n"
    yield one("labview.lvm", lvm + "".join("\t" + "\t".join(f"{v:.7f}" for v in r) + "\t\n" for r in a / G), unit="g")
    exponents = lines(t, a / G, cell=lambda x: f"{x:.6E}")
    yield one("exponents.csv", "t,a1 [g],a2 [g],a3 [g]\n" + exponents, unit="g")
    yield one(
        "fortran.txt",
        "t a1 a2 a3\n" + lines(t, a, sep=" ", cell=lambda x: f"{x:.6E}".replace("E", "D")),
        options={"unit": "m/s^2"},
    )
    at2 = "PEER NGA STRONG MOTION DATABASE RECORD\nSomewhere, 3/2/2026, ROOF, 90\nACCELERATION TIME SERIES IN UNITS OF G\nNPTS=    600, DT=   .0100 SEC\n"
    flat = a[:, 0] / G
    yield one(
        "record.AT2",
        at2 + "\n".join("  ".join(f"{v: .7E}" for v in flat[k : k + 5]) for k in range(0, N, 5)) + "\n",
        unit="g",
        columns=1,
    )


def lvm(columns: str, segments: int = 1) -> str:
    """A LabVIEW file with a column of times for all channels (One), for each (Multi) or none (No)."""
    multi, g = columns == "Multi", motion(100.0) / G
    text = f"LabVIEW Measurement\t\nSeparator\tTab\nX_Columns\t{columns}\nDate\t2026/03/02\nTime\t14:00:00.0\n***End_of_Header***\t\n\t\n"
    for begin in range(0, N, N // segments):
        of_each = {
            "Date": "2026/03/02",
            "Time": f"14:00:{begin / 100:08.5f}",
            "Y_Unit_Label": "g",
            "X0": "0.0E+0",
            "Delta_X": "0.01",
        }
        text += "Channels\t3\t\t\t\n"
        text += "".join(
            f"{key}\t" + ("\t\t" if multi else "\t").join([value] * 3) + "\t\n" for key, value in of_each.items()
        )
        heads = "\t".join(f"X_Value\tA{k}" for k in (1, 2, 3)) if multi else "X_Value\tA1\tA2\tA3"
        text += f"***End_of_Header***\t\t\t\t\n{heads}\tComment\n"
        for k, row in enumerate(g[begin : begin + N // segments]):
            x, cells = f"{k / 100:.6f}", [f"{v:.6f}" for v in row]
            text += (
                "\t".join(f"{x}\t{v}" for v in cells) if multi else "\t".join(["" if columns == "No" else x, *cells])
            )
            text += "\n"
    return text


def at_midnight(form: str) -> list[str]:
    """Times of 23:59:57 on, the day fixed in `form`."""
    return [
        form + f"{'23:59' if k < 300 else '00:00'}:{(57 + k / 100 if k < 300 else (k - 300) / 100):05.2f}"
        for k in range(N)
    ]


def odd_tables() -> Iterator[LoggerFile]:
    """Tables of text of loggers, phones and spreadsheets whose headings, cells or times are of a rarer form."""
    a, t = motion(100.0), elapsed(100.0)
    g = a / G
    names, plain = "t,a1 [g],a2 [g],a3 [g]\n", lines(t, g)
    rows = plain.splitlines(keepends=True)
    stamps = dated(100.0, "%Y-%m-%d %H:%M:%S.%f", 2)

    def one(name: str, text: str, rate: float = 100.0, unit: str = "g", **more: Any) -> LoggerFile:
        return LoggerFile(name, text.encode(), rate, unit=unit, **more)

    def behind(times: list[str], head: str, name: str, **more: Any) -> LoggerFile:
        return one(name, f"{head},a1 [g],a2 [g],a3 [g]\n" + lines(times, g), **more)

    toa5 = '"TOA5","s","CR6","1","CR6.Std.10","CPU:p.CR6","5","Accel"\n"TIMESTAMP","RECORD","BattV","PTemp_C","Acc(1)","Acc(2)","Acc(3)"\n"TS","RN","Volts","Deg C","g","g","g"\n"","","Min","Avg","Smp","Smp","Smp"\n'
    shown = [
        f"{x.rstrip('0').rstrip('.')},{k},13.1,21.4" for k, x in enumerate(stamps)
    ]  # whole seconds lose their digits
    yield one("toa5_array.dat", toa5 + lines(shown, g), start_ns=START_NS, says="/battv")
    for columns in ("One", "Multi", "No"):
        yield one(f"labview_{columns}.lvm", lvm(columns), start_ns=START_NS)
    gcdc = ";Title, http://www.gcdataconcepts.com, X2-5\n;Start_time, 2026-03-02, 14:00:00.000\n;SampleRate, 100,Hz\n;Headers, time,Ax,Ay,Az\n"
    yield one(
        "gcdc.csv", gcdc + plain + ";Reset, 6 s\n", start_ns=START_NS, options={"unit": "g"}, says="1 line of comments"
    )
    yield one(
        "comment_within.csv", names + "".join([*rows[:300], "# battery\n", *rows[300:]]), says="1 line of comments"
    )
    yield one(
        "infinite.csv",
        names + "".join([*rows[:50], "0.50,∞,-∞,∞\n", *rows[51:]]),
        says="missing",
    )
    head = "time,seconds_elapsed,z,y,x\n"
    yield one(
        "sensor_logger.csv",
        head + lines([f"{START_NS + k * 10**7},{k / 100:.9f}" for k in range(N)], g),
        start_ns=START_NS,
        options={"unit": "g"},
    )
    whole = [f"2026-03-02 14:00:{k // 100:02d},{k / 100:.2f}" for k in range(N)]
    yield behind(whole, "Timestamp,Elapsed (s)", "seconds_beside.csv", start_ns=START_NS, says="which is finer")
    grouped = [f"{10 * k:,};".replace(",", ".") + ";".join(map(comma, row)) + "\n" for k, row in enumerate(g)]
    yield one("groups_beside_decimals.csv", "Zeit [ms];a1 [g];a2 [g];a3 [g]\n" + "".join(grouped))
    narrow = [f"{x.replace('.', ',')};" + ";".join(f"{1e6 * v:,.1f}".replace(",", " ").replace(".", ",") for v in r) for x, r in zip(t, g, strict=True)]  # fmt: skip
    yield one("narrow_spaces.csv", "t;a1 [ug];a2 [ug];a3 [ug]\n" + "\n".join(narrow).replace(" ", "\u202f"), unit="ug")
    yield one("minus_signs.csv", names + plain.replace(",-", ",\u2212"))
    yield one("percent.csv", "t,a1 (% g),a2 (% g),a3 (% g)\n" + lines(t, 100.0 * g), unit="% g")
    yield one("spaced_names.txt", "Time [s]  Acc X [g]  Acc Y [g]  Acc Z [g]\n" + lines(t, g, sep="  "))
    column: dict[str, Any] = {"columns": 1, "options": {"rate_hz": 100.0}}
    yield one("one_column.txt", "Acceleration (g)\n" + "".join(f"{v:.7f}\n" for v in g[:, 0]), **column)
    yield one(
        "one_column_decimal_comma.txt", "Acceleration (g)\n" + "".join(f"{comma(v)}\n" for v in g[:, 0]), **column
    )
    yield one(
        "sentence.txt",
        "Acceleration in cm/s/s\nSampling interval 0.010 s\n" + lines([""] * N, 100.0 * a, sep=" "),
        unit="cm/s/s",
    )
    yield one("values_in.txt", "; All values in mg\n; time x y z\n" + lines(t, 1e3 * g, sep=" "), unit="mg")
    bare = "a1 [g],a2 [g],a3 [g]\n"
    yield one("kilo.csv", "Sample rate: 0.1 kS/s\n" + bare + lines([""] * N, g))
    yield one("thousand.csv", "Sample rate: 1,000 Hz\n" + bare + lines([""] * N, motion(1000.0) / G), 1000.0)
    yield one(
        "cutoff.csv",
        "Filter cutoff freq: 40 Hz\nSensor update rate: 1600 Hz\nSample rate: 100 Hz\n" + bare + lines([""] * N, g),
    )
    yield one(
        "a_second.txt",
        "Start Time: 03/02/2026 (061) 14:00\nSamples/sec = 100\nCh1 (g) Ch2 (g) Ch3 (g)\n"
        + lines([""] * N, g, sep=" "),
    )
    for name, tail in (("state", "OK"), ("flag", "True"), ("hexadecimal", "0x1F"), ("note", '"ok, fine"')):
        yield one(
            f"{name}.csv", f"t,a1 [g],a2 [g],a3 [g],{name}\n" + lines(t, g, tail=f",{tail}"), says=f"no numbers: {name}"
        )
    noted = [f"{row[:-1]},{'hit' if k == 300 else ''}\n" for k, row in enumerate(rows)]
    yield one("rare_note.csv", "t,a1 [g],a2 [g],a3 [g],note\n" + "".join(noted), says="no numbers: note")
    placed = [f"{k + 1},{x.replace(' ', ',')}" for k, x in enumerate(stamps)]
    yield one(
        "unit_column.csv",
        "Place,Date,Time,Value,Unit\n" + lines(placed, a[:, :1], tail=",m/s2"),
        unit="m/s2",
        columns=1,
        start_ns=START_NS,
    )
    own = [f"{x},,,,{k % 5}\n" if k % 2 else row[:-1] + ",\n" for k, (x, row) in enumerate(zip(elapsed(200.0, n=2 * N), np.repeat(rows, 2), strict=True))]  # fmt: skip
    own = [own[k] if k % 2 else f"{k / 200:.6f}" + own[k][own[k].index(",") :] for k in range(2 * N)]
    yield one("own_rows.csv", "t,a1 [g],a2 [g],a3 [g],w [deg/s]\n" + "".join(own), says="as of another clock")
    yield one("labels.csv", "Name,Roof,Mid,Low\nUnit:,g,g,g\n" + plain)
    yield one(
        "update_rate.txt",
        "// Update Rate: 100.0Hz\nCounter;X [g];Y [g];Z [g]\n" + lines([f"{k:05d}" for k in range(N)], g, sep=";"),
    )
    east = [x.replace("14:", "16:", 1) for x in stamps]
    yield behind(east, "Time (UTC+2)", "zone_in_heading.csv", start_ns=START_NS)
    yield one("stars.csv", names + "".join([*rows[:7], "0.07,*****,*****,****\n", *rows[8:]]), says="missing")
    yield behind([f"{x} IST" for x in stamps], "time", "unknown_zone.csv", start_ns=START_NS, says="IST has no zone")
    yield behind(stamps, "Time (UTC+99)", "absurd_zone.csv", start_ns=START_NS, says="has no zone")
    short_zone = [x.replace("14:", "16:", 1) + "+02" for x in stamps]
    yield behind(short_zone, "time", "short_zone.csv", start_ns=START_NS)
    yield behind(
        [f"{59 + k // 6000:02d}:{k / 100 % 60:05.2f}" for k in range(N)], "time", "minutes.csv", says="no date"
    )
    yield behind([f"{start % 3600 // 60:02d}:{start % 60 + k % 100 / 100:05.2f}" for k in range(N) for start in [3597 + k // 100]], "time", "past_the_hour.csv", says="no date")  # fmt: skip
    turned = "one turn of their clock"
    midnight_ns = START_NS + (10 * 3600 - 3) * 10**9
    yield behind(at_midnight("2026-03-02,"), "Date,Time", "date_of_the_start.csv", start_ns=midnight_ns, says=turned)
    winter = [x.replace("23:59", "02:59").replace("00:00:", "02:00:") for x in at_midnight("2026-10-25 ")]
    yield behind(winter, "time", "winter_time.csv", says=turned)
    for tick, ticks in (("ms", 10), ("us", 10_000)):
        wrapped = [str((2**32 - 300 * ticks + ticks * k) % 2**32) for k in range(N)]
        yield behind(wrapped, f"t_{tick}", f"wrapped_{tick}.csv", says=turned)
    often = "from row 8, and 90 times more, its times are 0.065536 s earlier"
    yield behind([str(10_000 * k % 2**16) for k in range(N)], "t_us", "wrapped_often.csv", says=often)
    yield behind([str(10 * k) for k in range(N)], "millis", "millis.csv")
    since_1904 = [f"{START.timestamp() + 2_082_844_800 + k / 100:.3f}" for k in range(N)]
    yield behind(since_1904, "Time", "since_1904.csv", start_ns=START_NS, says="since 1904")
    beside = [f"{int(START.timestamp()) + k // 100},{k % 100 * 10_000}" for k in range(N)]
    yield behind(beside, "unix time,usec", "unix_and_usec.csv", start_ns=START_NS)
    yield one("versions.csv", ",".join(["1.0.2 Hz"] * 4) + "\n" + names + plain)
    yield one("note_beyond.csv", ",,,,exported by hand\n" + names + plain)
    yield behind([f"{k / 8.64e6:.12f}" for k in range(N)], "time_days", "days_by_name.csv")
    yield one(
        "time_within.csv",
        "a1 [g],a2 [g],time [s],a3 [g]\n" + "".join(f"{r[0]},{r[1]},{x},{r[2]}\n" for x, r in zip(t, g, strict=True)),
    )
    yield one(
        "counter_that_wraps.csv",
        "counter,t [s],a1 [g],a2 [g],a3 [g]\n" + lines([f"{k % 256},{x}" for k, x in enumerate(t)], g),
    )
    yield behind([f"2026-03-02T16:00:{x[:12]}{'0' * 8}"[:29] + "+02:00" for x in (f"{k / 100:09.6f}" for k in range(N))], "time", "zone_of_two.csv", start_ns=START_NS)  # fmt: skip


def odd_times() -> Iterator[LoggerFile]:
    """Tables whose times and headings are written in rarer ways."""
    g = motion(100.0) / G

    def one(name: str, heading: str, times: list[str], **more: Any) -> LoggerFile:
        text = f"{heading};a1 [g];a2 [g];a3 [g]\n" + lines(times, g, sep=";")
        return LoggerFile(f"{name}.csv", text.encode(), 100.0, unit="g", **{"start_ns": START_NS, **more})

    for name, form, digits in (
        ("iso_basic", "%Y%m%dT%H%M%S.%fZ", 3),
        ("fourteen_digits", "%Y%m%d%H%M%S.%f", 3),
        ("seventeen_digits", "%Y%m%d%H%M%S%f", 3),
        ("day_of_year", "%Y-%jT%H:%M:%S.%f", 3),
        ("month_before_day", "%b %d, %Y %H:%M:%S.%f", 3),
        ("weekday", "%a %d %b %Y %H:%M:%S.%f", 3),
        ("points_in_time", "%d.%m.%Y %H.%M.%S,%f", 3),
        ("half_before_time", "%Y-%m-%d 오후 %I:%M:%S.%f", 3),
        ("half_spaced", "%d.%m.%Y %I:%M:%S.%f p. m.", 3),
        ("date_parts", "%Y;%m;%d;%H;%M;%S.%f", 3),
    ):
        yield one(name, "Year;Month;Day;Hour;Minute;Second" if ";" in form else "time", dated(100.0, form, digits))
    stamps = dated(100.0, "%Y-%m-%d %H:%M:%S.%f", 3)
    yield one("floating_ms", "ts", [f"{START_NS // 10**6 + 10 * k}.0" for k in range(N)])
    yield one("whole_days", "time", [f"0 days 00:00:{k / 100:09.6f}" for k in range(N)], start_ns=None)
    yield one("date_at_midnight", "Date;Time", [f"2026-03-02 00:00:00;{x[11:]}" for x in stamps])
    yield one("local_and_utc", "local time;UTC time", [f"{x.replace('14:', '15:', 1)};{x}" for x in stamps])
    seconds = [f"{START.timestamp() + k / 100:.2f};{x.replace('14:', '15:', 1)}" for k, x in enumerate(stamps)]
    yield one("epoch_and_local", "epoch;datetime", seconds)
    text = "asctime,a1 (g),a2 (g),a3 (g)\n" + lines([x.replace(".", ",") for x in stamps], g)
    yield LoggerFile("split_fraction.csv", text.encode(), 100.0, unit="g", start_ns=START_NS)
    for stated in ("Fréquence d'échantillonnage : 100 Hz", "Frecuencia de muestreo (Hz);100", "Frequenza: 100 Hz"):
        text = f"{stated}\na1 (g);a2 (g);a3 (g)\n" + lines([""] * N, g, sep=";", cell=comma)
        yield LoggerFile(f"{stated[:9]}.csv", text.encode(), 100.0, unit="g")
    beside = [f"{int(START.timestamp()) + k // 100};{k % 100 * 10**7}" for k in range(N)]
    yield one("sec_and_nsec", "sec;nsec", beside)
    east = dated(100.0, "%Y-%m-%d %H:%M:%S.%f", 3)
    yield one("zone_above", "Time zone;UTC-04:00\ntime", [x.replace("14:", "10:", 1) for x in east])
    yield one("zone_by_place", "Time zone;Europe/Zurich\ntime", [x.replace("14:", "15:", 1) for x in east])
    t = elapsed(100.0)
    for name, unit in (("latex", "$m/s^2$"), ("braces", "m/s^{2}"), ("nested", "m/(s^2)"), ("words", "m_per_s2")):
        text = f"t [s],a1 ({unit}),a2 ({unit}),a3 ({unit})\n" + lines(t, motion(100.0))
        yield LoggerFile(f"{name}.csv", text.encode(), 100.0, unit=unit.replace("{2}", "2"))
    text = "Time,a1,a2,a3\ns,mV/g,mV/g,mV/g\nsec,g,g,g\n" + lines(t, g)
    yield LoggerFile("sensitivities.csv", text.encode(), 100.0, unit="g")
    rows = [f"{START_NS + 10**7 * k},{k},{START_NS + 10**7 * k}" for k in range(N)]
    text = "%time,field.header.seq,field.header.stamp,field.x,field.y,field.z\n" + lines(rows, g)
    yield LoggerFile("fields.csv", text.encode(), 100.0, unit="g", start_ns=START_NS, options={"unit": "g"})
    rows = [f"{row},{'20.5' if k % 100 == 0 else ''}\n" for k, row in enumerate(lines(t, g).splitlines())]
    text = "t,a1,a2,a3,temp\n" + "".join(rows)
    yield LoggerFile("slow_by_name.csv", text.encode(), 100.0, unit="g", options={"unit": "g"}, says="left out: temp")
    text = "millis,AcX,AcY,AcZ,Tmp,GyX,GyY,status\n" + lines([str(10 * k) for k in range(N)], g, tail=",25.1,1,2,0")
    said = "left out: Tmp, GyX, GyY, status"
    yield LoggerFile("by_name.csv", text.encode(), 100.0, unit="g", options={"unit": "g"}, says=said)


def packed() -> Iterator[LoggerFile]:
    """Tables that are packed, and workbooks."""
    text = ("t,a1 [g],a2 [g],a3 [g]\n" + lines(elapsed(100.0), motion(100.0) / G)).encode()
    for name, raw in (
        ("p.csv.gz", gzip.compress(text)),
        ("p.csv.bz2", bz2.compress(text)),
        ("p.csv.xz", lzma.compress(text)),
    ):
        yield LoggerFile(name, raw, 100.0, unit="g")
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("inner.csv", text)
    yield LoggerFile("p.zip", buffer.getvalue(), 100.0, unit="g")


def workbook(path: Path, rows: list[list[Any]]) -> None:
    """The least that is a workbook of one sheet."""

    def cell(value: Any) -> str:
        return f'<c t="inlineStr"><is><t>{value}</t></is></c>' if isinstance(value, str) else f"<c><v>{value!r}</v></c>"

    sheet = "".join(f"<row>{''.join(map(cell, row))}</row>" for row in rows)
    main_ns = 'xmlns="http://schemas.openxmlformats.org/spreadsheetml/2006/main"'
    of_types, rels = (
        "http://schemas.openxmlformats.org/package/2006",
        "http://schemas.openxmlformats.org/officeDocument/2006/relationships",
    )
    form = "application/vnd.openxmlformats-officedocument.spreadsheetml"
    with zipfile.ZipFile(path, "w") as book:
        book.writestr(
            "[Content_Types].xml",
            f'<Types xmlns="{of_types}/content-types"><Default Extension="xml" ContentType="application/xml"/>'
            '<Default Extension="rels" ContentType="application/vnd.openxmlformats-package.relationships+xml"/>'
            f'<Override PartName="/xl/workbook.xml" ContentType="{form}.sheet.main+xml"/>'
            f'<Override PartName="/xl/worksheets/sheet1.xml" ContentType="{form}.worksheet+xml"/></Types>',
        )
        book.writestr(
            "_rels/.rels",
            f'<Relationships xmlns="{of_types}/relationships"><Relationship Id="r1" Type="{rels}/officeDocument" Target="xl/workbook.xml"/></Relationships>',
        )
        book.writestr(
            "xl/workbook.xml",
            f'<workbook {main_ns} xmlns:r="{rels}"><sheets><sheet name="Data" sheetId="1" r:id="r1"/></sheets></workbook>',
        )
        book.writestr(
            "xl/_rels/workbook.xml.rels",
            f'<Relationships xmlns="{of_types}/relationships"><Relationship Id="r1" Type="{rels}/worksheet" Target="worksheets/sheet1.xml"/></Relationships>',
        )
        book.writestr("xl/worksheets/sheet1.xml", f"<worksheet {main_ns}><sheetData>{sheet}</sheetData></worksheet>")


def geocsv(columns: str, units: str, rows: list[str], mark: str = ",", **head: object) -> str:
    """A series with its head."""
    head = {"delimiter": mark, **head, "field_unit": units.replace(",", mark), "sample_count": len(rows)}
    lines_of_head = "".join(f"# {key}: {value}\n" for key, value in head.items())
    return f"# dataset: GeoCSV 2.0\n{lines_of_head}{columns.replace(',', mark)}\n" + "\n".join(rows) + "\n"


def cosmos(
    values: np.ndarray,
    unit: str = "cm/sec2(04)",
    form: tuple[int, int, int] = (8, 10, 5),
    *,
    channel: object = 1,
    kind: str = "acceleration",
    step_ms: float = 10.0,
) -> str:
    """A component with its headers, in columns of a width and so many digits, between which need be no space."""

    def block(numbers: np.ndarray, each: int, width: int, digits: int) -> str:
        cells = [f"{x:{width}.{digits}f}" for x in numbers]
        return "".join("".join(cells[k : k + each]) + "\n" for k in range(0, len(cells), each))

    whole, real = np.full(100, -999.0), np.full(100, -999.0)
    whole[[39, 40, 41, 42, 43, 44]] = START.year, 61, START.month, START.day, START.hour, START.minute
    real[[29, 33, 61]] = START.second, 0.005, step_ms
    text = [f"Corrected {kind}    (Format v01.20 with 13 text lines) Src: none", *["Some text, NPTS= 5, DT= 1"] * 12]
    text[8] = f"Sta Chan {channel}:  90 deg (Rcrdr Chan  1) Location: roof"
    each, width, digits = form
    return (
        "\n".join(text)
        + f"\n 100 Integer-header values follow on  10 lines, Format= (10I8)\n{block(whole, 10, 8, 0)}"
        + f" 100 Real-header values follow on  17 lines, Format= (6F13.6)\n{block(real, 6, 13, 6)}"
        + '   1 Comment line(s) follow, each starting with a "|":\n| 100 pts, approx 3 secs\n'
        + f"{len(values):8d} {kind} pts, approx {len(values) // 100:4d} secs, units={unit},"
        + f"Format=({each}{f'F{width}.{digits}' if digits else f'I{width}'})\n{block(values, each, width, digits)}"
        + f"End-of-data for Chan {channel} {kind}\n"
    )


def records() -> Iterator[LoggerFile]:
    """Records of seismology in text, which state all that is to be known of them."""
    a = motion(100.0)
    stamps = dated(100.0, "%Y-%m-%dT%H:%M:%S.%fZ")
    start = stamps[0]

    def one(name: str, text: str, unit: str, **more: Any) -> LoggerFile:
        return LoggerFile(name, text.encode(), 100.0, unit=unit, start_ns=START_NS, **more)

    def series(k: int, rows: list[str], units: str = "M/S**2", columns: str = "Sample", **head: object) -> str:
        return geocsv(columns, units, rows, sid=f"XX_A{k}__HNZ", sample_rate_hz=100, **head)

    plain = [[f"{v:.7f}" for v in column] for column in a.T]
    counts = [[f"{t}| {round(1e6 * v)}" for t, v in zip(stamps, column, strict=True)] for column in a.T]
    yield one("slist.geocsv", "".join(series(k, plain[k], start_time=start) for k in range(3)), "M/S**2")
    scale: dict[str, Any] = {"scale_factor": 1e6, "scale_units": "M/S**2", "mark": "|"}
    pairs = [series(k, counts[k], "UTC, Counts", "Time, Sample", **scale) for k in range(3)]
    yield one("tspair.geocsv", "".join(pairs), "M/S**2", says="the sensitivity that it states, 1e+06 of a M/S**2")
    pieces = [
        series(
            k, [f"{t}, {v}" for t, v in zip(stamps[part], plain[k][part], strict=True)], "UTC, M/S**2", "Time, Sample"
        )
        for k in range(3)
        for part in (slice(0, 200), slice(200, N))
    ]
    yield one("pieces.geocsv", "".join(pieces), "M/S**2", says="follow one another in time")
    whole = geocsv("Time, a1, a2, a3, air", "ISO_8601, g, g, g, degC", lines(stamps, a / G, tail=",12.5").splitlines())
    yield one("table.geocsv", whole, "g", says="air (degC) is kept as the covariate /temperature")
    gal = 100.0 * a
    gap = a[:, 0] / G
    gap[50] = -999.0
    yield one(
        "gap.V1", cosmos(gap, "g(02)", (7, 11, 6)), "g", columns=1, says="1 readings are missing: -999 stands for them"
    )
    yield one(
        "uncorrected.V1", "".join(cosmos(gal[:, k] / 980.665, "g(02)", (8, 9, 6), channel=k + 1) for k in range(3)), "g"
    )
    parts = ((1.0, "acceleration", "cm/sec2(04)"), (0.1, "velocity", "cm/sec (05)"), (0.01, "displacement", "cm(06)"))
    all_three = [cosmos(f * gal[:, k], u, channel=k + 1, kind=kind) for k in range(3) for f, kind, u in parts]
    yield one("corrected.V2", "".join(all_three), "cm/sec2", says="chan2_velocity (cm/sec) is kept as the covariate")
    raw = [cosmos(np.round(1e5 * a[:, k]), "counts (50)", (10, 8, 0), channel="?") for k in range(3)]
    yield one("raw.V0", "".join(raw), "counts", options={"scale": 1e-5})
