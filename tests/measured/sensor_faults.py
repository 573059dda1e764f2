"""Put sensor faults into half of a measured recording and judge what a diagnosis names beside the healthy half.

``python -m tests.measured.sensor_faults [--out FILE.jsonl] [--faults gain,lag] [--frames flexible,stiff] [--trials N]``
"""

from __future__ import annotations

import argparse
import json
import tomllib
import warnings
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.signal import resample
from threadpoolctl import threadpool_limits

from drivers.base import ACCELERATION, GROUND, SampleBlock
from drivers.mcap_file import read_recordings
from monitor.config import Configuration
from monitor.inference import gather
from monitor.model import StructuralPrior
from monitor.runs import diagnose

Array = np.ndarray
RECORDINGS = Path(__file__).parents[2] / "recordings"
FRAMES = ("flexible", "stiff")
CHANNELS = ("a1", "a2", "a3")
PAIRS = ("a1,a2", "a1,a3", "a2,a3")
GAIN = 0.05
LAG_S = 2e-3
CLOCK = 1e-3
"""Excess of the channel's rate over the nominal rate."""
NOISE = (0.15, 0.30)
"""RMS of the noise over the channel's."""
CLIPPING = (2.0, 4.0)
"""Limit over the channel's RMS: of an earthquake's many quiet and few strong samples."""
TOLERANCE = 0.10
"""Relative error of a size that counts as right, whatever its standard deviation."""
BLOCK_N = 960
"""Samples a block."""


@dataclass(frozen=True)
class Fault:
    """Sensor fault with the effect, place and size that a diagnosis must name."""

    kind: str
    label: str
    place: str
    act: Callable[[Array, float], Array]
    """Samples of all channels, shape (n, 3), and rate in Hz to the faulty samples."""
    effect: str | None = None
    """None where the catalogue has no such effect, or nothing is wrong."""
    true_size: Callable[[Array], float] | None = None
    """Size of the effect's only parameter, given the healthy samples."""


def own_rms(samples: Array, channel: int) -> float:
    """Compute a channel's RMS about its mean, m/s^2."""
    return float(samples[:, channel].std())


def scaled(samples: Array, rate_hz: float, *, channel: int, factor: float) -> Array:
    """Multiply a channel, its constant tilt included."""
    out = samples.copy()
    out[:, channel] *= factor
    return out


def swapped(samples: Array, rate_hz: float, *, pair: tuple[int, int]) -> Array:
    """Exchange two channels."""
    out = samples.copy()
    out[:, list(pair)] = samples[:, list(pair)[::-1]]
    return out


def delayed(samples: Array, rate_hz: float, *, channel: int, seconds: float) -> Array:
    """Delay a channel by a fraction of a sample, by the phase of its transform."""
    return _read_at(samples, channel, np.arange(len(samples)) - seconds * rate_hz)


def fast_clock(samples: Array, rate_hz: float, *, channel: int, relative: float) -> Array:
    """Sample a channel on a clock that runs fast: sample i is taken at i / (1 + relative) true periods."""
    return _read_at(samples, channel, np.arange(len(samples)) / (1.0 + relative))


def _read_at(samples: Array, channel: int, index: Array) -> Array:
    """Interpolate a channel at fractional sample indices: band-limited to eight times the rate, then by a spline."""
    finer, n = 8, len(samples)
    own = samples[:, channel]
    mirrored = np.concatenate([own, own[::-1]])  # without a jump at the ends
    dense = resample(mirrored, finer * mirrored.size)
    at = np.clip(index, 0, n - 1)
    out = samples.copy()
    out[:, channel] = CubicSpline(np.arange(dense.size) / finer, dense)(at)
    return out


def clipped(samples: Array, rate_hz: float, *, channel: int, over_rms: float) -> Array:
    """Cut a channel's samples off at a multiple of its RMS."""
    limit = over_rms * own_rms(samples, channel)
    out = samples.copy()
    out[:, channel] = np.clip(out[:, channel], -limit, limit)
    return out


def noisy(samples: Array, rate_hz: float, *, channel: int, share: float) -> Array:
    """Add white noise to a channel."""
    out = samples.copy()
    noise = np.random.default_rng(channel).standard_normal(len(samples))
    out[:, channel] += share * own_rms(samples, channel) * noise
    return out


def unchanged(samples: Array, rate_hz: float) -> Array:
    """Return the healthy samples."""
    return samples


def _of_each_channel(
    kind: str,
    label: str,
    act: Callable[..., Array],
    effect: str | None = None,
    size: Callable[[int, Array], float] | None = None,
    **arguments: float,
) -> list[Fault]:
    """The same fault of every channel; `size` is a function of the channel and the healthy samples."""
    return [
        Fault(kind, label, f"channel {name}", partial(act, channel=j, **arguments), effect, size and partial(size, j))
        for j, name in enumerate(CHANNELS)
    ]


def faults() -> list[Fault]:
    """List all faults; neighbours in the list differ in kind, so that a campaign cut short has some of each."""
    gains, lags = [], []
    for sign in (1, -1):
        gain, lag_s = 1.0 + sign * GAIN, sign * LAG_S
        gains += _of_each_channel("gain", f"gain {gain:.2f}", scaled, "sensor_gain", _constant(gain), factor=gain)
        label = f"lag {1e3 * lag_s:+.0f} ms"
        lags += _of_each_channel("lag", label, delayed, "time_offset", _constant(lag_s), seconds=lag_s)
    noises, limits = [], []
    for share in reversed(NOISE):
        label = f"noise of {100.0 * share:.0f} %"
        noises += _of_each_channel("noise", label, noisy, "sensor_noise", _times_rms(share), share=share)
    for over_rms in CLIPPING:
        label = f"cut off at {over_rms:g} RMS"
        limits += _of_each_channel(
            "clipping", label, clipped, "sensor_clipping", _times_rms(over_rms), over_rms=over_rms
        )
    by_kind = [
        [Fault("clean", "no fault", "", unchanged)],
        gains,
        lags,
        _of_each_channel("polarity", "reversed", scaled, "sensor_polarity", factor=-1.0),
        [Fault("swap", "swapped", f"channel {p}", partial(swapped, pair=_indices(p)), "channel_swap") for p in PAIRS],
        _of_each_channel("clock", f"clock {100.0 * CLOCK:.1f} % fast", fast_clock, relative=CLOCK),
        noises,
        limits,
    ]
    longest = max(map(len, by_kind))
    return [kind[i] for i in range(longest) for kind in by_kind if i < len(kind)]


def _constant(size: float) -> Callable[[int, Array], float]:
    return lambda channel, healthy: size


def _times_rms(factor: float) -> Callable[[int, Array], float]:
    return lambda channel, healthy: factor * own_rms(healthy, channel)


def _indices(pair: str) -> tuple[int, int]:
    first, second = (CHANNELS.index(name) for name in pair.split(","))
    return first, second


@dataclass(frozen=True, eq=False)
class Half:
    """Half of a recording."""

    floors: Array
    """Shape (n, 3), m/s^2."""
    ground: Array
    """Shape (n, 1), m/s^2."""
    t_ns: int
    rate_hz: float

    def blocks(self, floors: Array) -> list[SampleBlock]:
        """Make blocks as a driver hands them over, with the given samples of the floors."""
        out = []
        for at in range(0, len(floors), BLOCK_N):
            t_ns = self.t_ns + round(at / self.rate_hz * 1e9)
            for topic, channels, values in ((GROUND, ("ground",), self.ground), (ACCELERATION, CHANNELS, floors)):
                part = values[at : at + BLOCK_N].astype(np.float32)
                out.append(SampleBlock(topic, t_ns, at, self.rate_hz, channels, "m/s^2", part))
        return out


@lru_cache
def halves(frame: str) -> tuple[Half, Half]:
    """Read a measured recording and cut it in two halves of equal length."""
    blocks = list(read_recordings([RECORDINGS / f"mini-shake-table-{frame}.mcap"], on_warning=warnings.warn))
    floors, ground = (
        np.concatenate([b.samples for b in blocks if b.topic == topic]).astype(float)
        for topic in (ACCELERATION, GROUND)
    )
    first = next(b for b in blocks if b.topic == ACCELERATION)
    n, rate_hz = min(len(floors), len(ground)) // 2, first.sample_rate_hz
    return tuple(
        Half(floors[at : at + n], ground[at : at + n], first.t_ns + round(at / rate_hz * 1e9), rate_hz) for at in (0, n)
    )  # type: ignore[return-value]


@lru_cache
def configuration(frame: str) -> Configuration:
    """Read a frame's structure file."""
    return Configuration.model_validate(tomllib.loads((RECORDINGS / f"mini-shake-table-{frame}.toml").read_text()))


@lru_cache
def reference(frame: str, healthy: int) -> StructuralPrior:
    """Learn the baseline of one half."""
    config, half = configuration(frame), halves(frame)[healthy]
    return diagnose.learn_healthy_prior(gather(half.blocks(half.floors), config.front_end()), config)


def run(frame: str, healthy: int, fault: Fault) -> dict[str, Any]:
    """Diagnose the other half with a fault, beside the baseline of half `healthy`; return the answer as plain data."""
    prior, config, half = reference(frame, healthy), configuration(frame), halves(frame)[1 - healthy]
    began = perf_counter()
    segments = gather(half.blocks(fault.act(half.floors, half.rate_hz)), config.front_end())
    found, gain = diagnose.diagnose_segments(segments, prior, config)
    causes = [
        {
            "effect": c.effect.name,
            "location": c.effect.location,
            "parameters": {
                name: {"value": float(value), "std": float(c.std.get(name, 0.0))}
                for name, value in c.effect.values().items()
            },
        }
        for c in found.causes
    ]
    size = None if fault.true_size is None else fault.true_size(half.floors)
    return {
        "trial": trial_name(frame, healthy, fault),
        "kind": fault.kind,
        "frame": frame,
        "healthy_half": healthy + 1,
        "fault": fault.label,
        "place": fault.place,
        "effect": fault.effect,
        "size": size,
        "verdict": found.verdict,
        "causes": causes,
        "alternatives": [[c.effect.name, c.effect.location, float(p)] for c, p in found.alternatives],
        "left_over": [[m.where, round(float(m.size), 1), m.says] for m in found.left_over[:5]],
        "nats_a_sample": gain.after - gain.before,
        "outcome": outcome(fault, size, found.verdict, causes, [m.where for m in found.left_over]),
        "seconds": round(perf_counter() - began, 1),
    }


def outcome(
    fault: Fault, size: float | None, verdict: str, causes: list[dict[str, Any]], wrong_places: Collection[str] = ()
) -> str:
    """Judge an answer: ``right``, ``right, and more``, ``size``, ``missed``, ``wrong``, or for no fault ``none`` or ``false``.

    A drifting clock is no effect of the catalogue; it must be among the places of the lack of fit, `wrong_places`.
    """
    if fault.kind == "clean":
        return "none" if verdict == "none" else "false"
    if fault.effect is None:
        if f"clock of {fault.place}" not in wrong_places:
            return "wrong" if causes else "missed"
        return "right, and more" if causes else "right"
    own = [c for c in causes if (c["effect"], c["location"]) == (fault.effect, fault.place)]
    if not own:
        return "missed" if not causes else "wrong"
    if size is not None:
        ((estimate),) = own[0]["parameters"].values()
        # A gain's size is its distance from 1, of which a tenth is half a percent here.
        scale = abs(size - 1.0) if fault.effect == "sensor_gain" else abs(size)
        if abs(estimate["value"] - size) > max(2.0 * estimate["std"], TOLERANCE * scale):
            return "size"
    return "right" if len(causes) == 1 else "right, and more"


def trial_name(frame: str, healthy: int, fault: Fault) -> str:
    """Name a trial, so that it is not run again."""
    return f"{frame}, half {2 - healthy}: {fault.label} {fault.place}".rstrip()


def trials(frames: tuple[str, ...], kinds: tuple[str, ...]) -> Iterator[tuple[str, int, Fault]]:
    """List the trials: every fault in turn, in both halves of every frame."""
    for fault in faults():
        if not kinds or fault.kind in kinds:
            for healthy in (0, 1):
                for frame in frames:
                    yield frame, healthy, fault


def cause_text(cause: dict[str, Any]) -> str:
    """Describe a cause with its sizes in one line."""
    sizes = ", ".join(f"{v['value']:.4g} ± {v['std']:.1g}" for v in cause["parameters"].values())
    return f"{cause['effect']} {cause['location']} {sizes}".rstrip()


def row(result: dict[str, Any]) -> str:
    """Write a result as a row of the table."""
    named = "; ".join(map(cause_text, result["causes"])) or "-"
    true = "" if result["size"] is None else f" ({result['size']:.4g})"
    return f"| {result['trial']}{true} | {result['verdict']} | {named} | {result['outcome']} |"


def summary(results: list[dict[str, Any]]) -> str:
    """Count the outcomes by kind of fault."""
    lines = []
    for kind in dict.fromkeys(r["kind"] for r in results):
        outcomes = [r["outcome"] for r in results if r["kind"] == kind]
        verdicts = [r["verdict"] for r in results if r["kind"] == kind]
        counts = {name: outcomes.count(name) for name in dict.fromkeys(outcomes)}
        said = {name: verdicts.count(name) for name in dict.fromkeys(verdicts)}
        lines.append(f"{kind}: {counts}, verdicts {said}")
    return "\n".join(lines)


def main() -> None:
    """Run the trials that the file does not have yet, and print the table of all."""
    parser = argparse.ArgumentParser(prog="python -m tests.measured.sensor_faults", description=__doc__)
    parser.add_argument("--out", type=Path, help="append a JSON line a trial; trials in the file are not run again")
    parser.add_argument("--faults", default="", help="only these kinds, comma separated")
    parser.add_argument("--frames", default=",".join(FRAMES))
    parser.add_argument("--trials", type=int, help="at most so many")
    options = parser.parse_args()
    results = (
        [json.loads(line) for line in options.out.read_text().splitlines()]
        if options.out is not None and options.out.exists()
        else []
    )
    done = {r["trial"] for r in results}
    todo = [
        t
        for t in trials(tuple(options.frames.split(",")), tuple(filter(None, options.faults.split(","))))
        if trial_name(*t) not in done
    ]
    print("| trial (true size) | verdict | named, size ± standard deviation | outcome |\n|---|---|---|---|")
    print("\n".join(map(row, results)), flush=True)
    with threadpool_limits(limits=1):
        for trial in todo[: options.trials]:
            result = run(*trial)
            results.append(result)
            print(row(result), flush=True)
            if options.out is not None:
                with options.out.open("a") as out:
                    out.write(json.dumps(result) + "\n")
    print(summary(results))


if __name__ == "__main__":
    main()
