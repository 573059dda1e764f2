"""What the other five axes of the shake-table frames' sensors say: joints, torsion, the table, and the peaks at 2 f1 and 4 f1.

    .venv/bin/python -m tests.measured.shake_table_axes FOLDER [--kind flexible|stiff] [--extended structure.extended.toml]

FOLDER is the user's own download of the source's files (github.com/chrystalchern/mdof), named KIND-northridge-LEVEL.csv with
LEVEL floor1 (lowest), floor2, floor3 and ground.  With ``--extended``, a structure file that ``diagnose`` wrote, the witnesses
are compared with its model; without it the recording is diagnosed first, which takes minutes.

A wall that is clamped against rotation at both ends and bends by a drift d shortens by 3/5 d^2 / h, so that the floors move up
and down at twice the frequency of the sway.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import csd, find_peaks, welch
from threadpoolctl import threadpool_limits

from drivers.base import ACCELERATION, GROUND, ROTATION_RATE
from drivers.mcap_file import read_recordings
from monitor.config import Configuration, configuration
from monitor.diagnosis import WitnessRecord, WitnessSensor, compare_witnesses
from monitor.model import Condition, Model, ShearFrame
from monitor.runs import Options, diagnose, import_files
from monitor.signals import SegmentDesign, transform

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

RECORDINGS = Path(__file__).parents[2] / "recordings"
RATE_HZ = 120.0
HEIGHT_M = 0.1524
LEVELS = {"1": ("floor3", 1), "2": ("floor2", 2), "3": ("floor1", 3), "g": ("ground", 0)}
AXES = {
    "b": ("Acc_Y", "acceleration", "y"),
    "c": ("Acc_Z", "acceleration", "z"),
    "p": ("Gyr_X", "rotation_rate", "x"),
    "q": ("Gyr_Y", "rotation_rate", "y"),
    "r": ("Gyr_Z", "rotation_rate", "z"),
}
"""Letter of a channel -> column of the source, quantity and axis; the number behind it is the floor's."""
FIRST_HZ = {"flexible": 3.69, "stiff": 7.8}
OSCILLATOR_HZ = 11.0
"""Where earlier versions named an oscillator on floor 2 of the flexible frame."""
CLAMPED = 0.6
"""Shortening of a wall clamped at both ends, over d^2 / h."""
SEGMENT_N = 600
LOWEST_HZ = 1.5
"""Accelerations are integrated from here on. [Hz]"""


def import_all(folder: Path, kind: str, out: Path) -> None:
    """Import all axes of one frame as a recording."""
    files = [folder / f"{kind}-northridge-{level}.csv" for level, _ in LEVELS.values()]
    places = {"a1": "floor3:Acc_X", "a2": "floor2:Acc_X", "a3": "floor1:Acc_X"}
    places |= {f"{x}{n}": f"{level}:{AXES[x][0]}" for n, (level, _) in LEVELS.items() for x in AXES}
    channels = {name: f"{kind}-northridge-{place}" for name, place in places.items()}
    import_files(files, out, Options(channels=channels, ground=f"{kind}-northridge-ground:Acc_X"))


def site(kind: str, base: Path | None = None) -> str:
    """Write the structure file with all axes as sensors."""
    text = (base or RECORDINGS / f"mini-shake-table-{kind}.toml").read_text(encoding="utf-8")
    tables = [
        f'[[sensors]]\nchannel = "{x}{n}"\nfloor = {floor}\nquantity = "{quantity}"\naxis = "{axis}"\n\n'
        for n, (_, floor) in LEVELS.items()
        for x, (_, quantity, axis) in AXES.items()
    ]
    head, tail = text.split("[processing]", 1)
    return f"{head}{''.join(tables)}[processing]{tail}"


def read_all(recording: Path) -> dict[str, Array]:
    """Read every channel of a recording, by its name; of equal lengths, rad/s and m/s^2."""
    parts: dict[str, list[Array]] = {}
    for block in read_recordings([recording], topics=(ACCELERATION, GROUND, ROTATION_RATE)):
        for name, column in zip(block.channels, block.samples.T, strict=True):
            parts.setdefault(name, []).append(column.astype(np.float64))
    return {name: np.concatenate(columns) for name, columns in parts.items()}


def integrated(values: Array, times: int) -> Array:
    """Integrate samples so many times above `LOWEST_HZ`; a negative number differentiates."""
    hz = np.fft.rfftfreq(len(values), 1.0 / RATE_HZ)
    spectrum = np.fft.rfft(values - values.mean())
    spectrum[1:] /= (2j * np.pi * hz[1:]) ** times
    spectrum[hz < LOWEST_HZ] = 0.0
    return np.asarray(np.fft.irfft(spectrum, len(values)))


def drifts(channels: dict[str, Array]) -> list[Array]:
    """Return the drift of every story, the top one first, m."""
    top, middle, low = (integrated(channels[f"a{n}"] - channels["ground"], 2) for n in (1, 2, 3))
    return [top - middle, middle - low, low]


def in_band(values: Array, hz: float, half_hz: float) -> Complex:
    """Transform half-overlapping segments, and keep a band about a frequency, shape (n_segments, n_bins)."""
    design = SegmentDesign(RATE_HZ, SEGMENT_N, SEGMENT_N // 2 + 1)
    firsts = range(0, len(values) - SEGMENT_N + 1, SEGMENT_N // 2)
    parts = [values[first : first + SEGMENT_N] for first in firsts]
    spectra = np.stack([transform(design, (part - part.mean())[:, None])[:, 0] for part in parts])
    at = np.arange(design.n_bins) * design.step_hz
    return np.asarray(spectra[:, np.abs(at - hz) <= half_hz])


def unexplained(motion: Complex, by: list[Complex]) -> float:
    """Return the share of a motion's power that no linear combination of others explains."""
    columns = np.stack([part.ravel() for part in by], axis=1)
    weights, *_ = np.linalg.lstsq(columns, motion.ravel(), rcond=None)
    return float((np.abs(motion.ravel() - columns @ weights) ** 2).sum() / (np.abs(motion) ** 2).sum())


def factor(motion: Complex, by: Complex) -> tuple[float, float]:
    """Regress a motion on another, with the standard deviation by the jackknife over the segments."""
    cross, power = (motion * by.conj()).sum(axis=1).real, (np.abs(by) ** 2).sum(axis=1)
    others = (cross.sum() - cross) / (power.sum() - power)
    return float(cross.sum() / power.sum()), float(np.sqrt(len(cross) - 1.0) * others.std())


def tell_harmonics(channels: dict[str, Array], first_hz: float) -> None:
    """Print what explains the motion at twice and four times the first frequency."""
    bent = drifts(channels)
    products = [x * y for i, x in enumerate(bent) for y in bent[i:]]
    shortened = [integrated(d**2, -2) / HEIGHT_M for d in bent]
    for times, half_hz in ((2, 0.5), (4, 0.6)):
        hz = times * first_hz
        squares = [in_band(x, hz, half_hz) for x in products]
        table = in_band(channels["ground"], hz, half_hz)
        along = [in_band(channels[f"a{n}"], hz, half_hz) for n in (1, 2, 3)]
        print(f"{times} f1 = {hz:.2f} Hz")
        for n in (1, 2, 3):
            up = in_band(channels[f"c{n}"] - channels["cg"], hz, half_hz)
            below = np.asarray(sum(in_band(x, hz, half_hz) for x in shortened[n - 1 :]))
            k, std = factor(up, below)
            left = float((np.abs(up + CLAMPED * below) ** 2).sum() / (np.abs(up) ** 2).sum())
            twist, own = in_band(channels[f"r{n}"], hz, half_hz), along[n - 1]
            print(
                f"  floor {n}: up by {k:.3f} +- {std:.3f} d^2/h of the stories below; -0.6 leaves {100 * left:.2f} %; "
                f"a{n}: the table leaves {100 * unexplained(own, [table]):.1f} %, with squares of drifts "
                f"{100 * unexplained(own, [table, *squares]):.1f} %; twist: the floors' motion leaves "
                f"{100 * unexplained(twist, along):.1f} %, squares of drifts {100 * unexplained(twist, squares):.1f} %"
            )


def tell_peaks(channels: dict[str, Array]) -> None:
    """Print the peaks of every axis, of power 10 dB over what surrounds them, strongest first."""
    for x, (column, _, _) in AXES.items():
        for n in LEVELS:
            hz, power = welch(channels[f"{x}{n}"], RATE_HZ, nperseg=1200)
            at, _ = find_peaks(10.0 * np.log10(power), prominence=10.0)
            strongest = at[np.argsort(-power[at])][:6]
            width = hz[1] * 3.0
            told = [f"{hz[k]:.1f} Hz ({np.sqrt(width * power[k]):.2g})" for k in strongest]
            print(f"  {x}{n} {column}: {', '.join(told)}")


def tell_oscillator(channels: dict[str, Array], hz: float) -> None:
    """Print how much every axis of each floor moves at a frequency for its motion 0.2 Hz beside, over the lowest floor's sway.

    An oscillator of 1 % damping would stand out by a factor of two or more where it is.
    """
    n = 4 * SEGMENT_N
    at, power = welch(channels["a3"], RATE_HZ, nperseg=n)
    middle, *beside = (int(np.abs(at - f).argmin()) for f in (hz, hz - 0.2, hz + 0.2))
    for floor in (1, 2, 3):
        told = []
        for x in ("a", *AXES):
            transfer = np.abs(csd(channels["a3"], channels[f"{x}{floor}"], RATE_HZ, nperseg=n)[1] / power)
            told.append(f"{x}{floor} {transfer[middle] / transfer[beside].mean():.2f}")
        print(f"  at {hz} Hz over 0.2 Hz beside: {', '.join(told)}")


def tell_turns(channels: dict[str, Array]) -> None:
    """Print how fast the walls' chords turn and the floors, deg/s RMS."""
    for n, drift in enumerate(drifts(channels), 1):
        chord = np.degrees(integrated(drift, -1).std() / HEIGHT_M)
        floor = np.degrees(channels[f"q{n}"].std())
        print(f"  story {n}: chord {chord:.1f} deg/s, floor {n} {floor:.2f} deg/s")


def shortening(model: Model) -> Array:
    """Predict how far each floor comes down in mode 1, over the sum of d^2 / h of the stories below, shape (n,).

    A wall whose ends turn by the shares a and b of its chord's turn shortens by (3/5 - (a + b)/10 + (a^2 + b^2 - a b/2)/15)
    d^2 / h: the geometric stiffness of a beam in cubic bending.
    """
    frame = model.altered_structure()
    assert isinstance(frame, ShearFrame)
    assert frame.story_heights_m is not None
    shape = model.modes().shapes[:, 0]
    turned, drift = frame.joint_rotations() @ shape, frame.drift_matrix() @ shape
    upper, lower = (x * frame.story_heights_m / drift for x in (turned, np.append(turned[1:], 0.0)))
    each = CLAMPED - (upper + lower) / 10.0 + (upper**2 + lower**2 - upper * lower / 2.0) / 15.0
    below = np.cumsum((drift**2)[::-1])[::-1]
    return np.asarray(np.cumsum((each * drift**2)[::-1])[::-1] / below)


def tell_witnesses(recording: Path, structure: Path, extended: Path | None) -> None:
    """Print what the witnesses say of the model that a diagnosis gave, and how its walls shorten."""
    config = configuration.load(structure)
    if extended is None:
        found = diagnose.diagnose([recording], config, None, print)
        print(found.content["says"])
        for told in found.content["witness"]:
            print(f"  {told['verdict']}: {told['says']}")
        print(f"  floors come down by {shortening(found.extended).round(3)} d^2/h of the stories below by the model")
        return
    model = configuration.load(extended).model()
    sensors = tuple(
        WitnessSensor(s.channel, s.quantity, s.axis or "x", s.floor or 0, s.mounted) for s in config.witnesses
    )
    for told in compare(recording, config, sensors, model):
        print(f"  {told.verdict}: {told.says}")
    print(f"  floors come down by {shortening(model).round(3)} d^2/h of the stories below by the model")


def compare(recording: Path, config: Configuration, sensors: tuple[WitnessSensor, ...], model: Model) -> list[Any]:
    """Compare witnesses on a given model, beside the same without its effects."""
    record = WitnessRecord(config.front_end(), sensors)
    for block in read_recordings([recording], topics=(ACCELERATION, GROUND, ROTATION_RATE)):
        record.add(block)
    n = model.structure.n_dofs
    still = Condition(np.zeros(n), np.zeros(n), np.zeros(n), np.ones(len(config.channels)))
    context = config.instrumented().context(RATE_HZ)
    return compare_witnesses(record, sensors, Model(model.structure), model, context, still)


def main() -> None:
    """Tell of both frames what their other axes say."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="folder of the source's files")
    parser.add_argument("--kind", choices=tuple(FIRST_HZ), action="append", help="one frame; both by default")
    parser.add_argument("--extended", type=Path, help="structure file that a diagnosis of that frame wrote")
    options = parser.parse_args()
    for kind in options.kind or FIRST_HZ:
        print(f"== {kind}")
        with tempfile.TemporaryDirectory() as scratch, threadpool_limits(limits=1):
            recording, structure = Path(scratch, "all.mcap"), Path(scratch, "frame.toml")
            import_all(options.folder, kind, recording)
            structure.write_text(site(kind), encoding="utf-8")
            channels = read_all(recording)
            tell_turns(channels)
            tell_harmonics(channels, FIRST_HZ[kind])
            tell_peaks(channels)
            if kind == "flexible":
                tell_oscillator(channels, OSCILLATOR_HZ)
            tell_witnesses(recording, structure, options.extended)


if __name__ == "__main__":
    main()
