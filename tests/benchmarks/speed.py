"""All speeds in one run, side by side, as Markdown tables: a hop and its peers, its growth, recordings, a diagnosis.

Run: ``make benchmark``, or ``python tests/benchmarks/speed.py [--quick] [--hours 24] [--rounds 25] [--json F] [--plot F.svg]``.
CPU time of the process, one thread of linear algebra; medians of interleaved rounds, quartiles, the fastest; ratios in the run.
Peers are measured where they are installed (tests/benchmarks/requirements.txt).
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import scipy.linalg  # noqa: F401 - loaded before threads are limited
from threadpoolctl import threadpool_limits

ROOT = Path(__file__).resolve().parents[2]
sys.path = [str(ROOT), *(p for p in sys.path if p != str(Path(__file__).parent))]

from monitor.core import keep_freed  # noqa: E402
from tests.benchmarks import archive, windows  # noqa: E402
from tests.benchmarks.rounds import Cost  # noqa: E402


def show(head: str, costs: dict[str, Cost], base: Cost, unit: float = 1e3) -> None:
    """Print a table of costs, each over the base."""
    print(f"\n| {head} |\n|---|---|---|---|", *(cost.row(base, unit) for cost in costs.values()), sep="\n")


def compare_windows(rounds: int, told: dict[str, Any]) -> None:
    """A hop beside its floor and its peers."""
    costs = windows.compare(rounds)
    floor = costs[windows.FLOOR]
    show("one 10 s hop of a 400 s window, 15 orders | CPU ms (quartiles) | fastest | over the floor", costs, floor)
    plain, uncertain = (windows.PYOMA, windows.PYOMA_1), (windows.PYOMA_UNC, windows.PYOMA_UNC_1)
    ways = {
        windows.FOUND: plain,
        windows.PLAIN: (*plain, windows.KOMA),
        windows.FOUND_UNC: uncertain,
        windows.UNREFINED: uncertain,
        windows.FULL: uncertain,
    }
    for ours, peer in ((ours, peer) for ours, others in ways.items() for peer in others):
        if peer in costs:
            low, middle, high = costs[peer].over(costs[ours])
            fastest = costs[peer].fastest / costs[ours].fastest
            print(f"{peer} over {ours}: {middle:.3g} ({low:.3g}-{high:.3g}); of the fastest rounds {fastest:.3g}")
            told[f"{peer} over {ours}"] = {"median": middle, "of the fastest rounds": fastest}
    for name, error in windows.accuracy(4 * rounds).items():
        print(f"RMS error of the frequencies, {4 * rounds} windows, {name}: {', '.join(f'{e:.3f}' for e in error)} %")
    for cost in windows.cold(rounds).values():
        print(f"single, between others' work: {cost.row()}")
    told["windows_ms"] = {name: 1e3 * cost.median for name, cost in costs.items()}
    told["fastest_windows_ms"] = {name: 1e3 * cost.fastest for name, cost in costs.items()}


def show_growth(rounds: int, channels: tuple[int, ...], told: dict[str, Any]) -> None:
    """How a hop grows."""
    found = windows.growth(rounds, channels)
    print("\n| growth of one hop | | CPU ms (quartiles) | fastest |\n|---|---|---|---|")
    for what, costs in found.items():
        for value, cost in costs:
            print(f"| {what} | {value:g} {cost.row()[len(cost.name) + 2 :]}")
    told["growth_ms"] = {what: [[value, 1e3 * c.median] for value, c in costs] for what, costs in found.items()}


def show_reading(path: Path, rounds: int, hours: float, told: dict[str, Any]) -> None:
    """The stages before identification beside reading alone."""
    costs = archive.reading(path, rounds)
    base: Cost = costs[archive.LIBRARY]
    show(f"{hours:g} h of 3 channels at 1024 Hz | CPU s (quartiles) | fastest | over the library", costs, base, 1.0)
    told["reading_s"] = {name: cost.median for name, cost in costs.items()}


def draw(told: dict[str, Any], out: Path) -> None:
    """Draw the costs of a hop beside its peers, and how it grows, as one SVG."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    growth: dict[str, list[list[float]]] = told["growth_ms"]
    matplotlib.rcParams.update({"svg.hashsalt": "shm", "font.size": 9})
    figure, axes = pyplot.subplots(1, 1 + len(growth), figsize=(15, 3.6), width_ratios=[2.4, *[1] * len(growth)])
    names, values = list(told["windows_ms"]), list(told["windows_ms"].values())
    colours = ["#1f6fb4" if name.startswith(("hop", "its")) else "#999999" for name in names]
    axes[0].barh(names[::-1], values[::-1], color=colours[::-1])
    axes[0].set(xscale="log", xlabel="CPU ms", title="one hop of a 400 s window")
    for axis, (what, points) in zip(axes[1:], growth.items(), strict=True):
        axis.loglog(*zip(*points, strict=True), "o-", color="#1f6fb4")
        axis.set(xlabel=what, ylim=(1, 2e4), title="CPU ms of one hop")
    figure.tight_layout()
    figure.savefig(out, metadata={"Date": None})


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="to see in seconds that it runs; its figures say nothing")
    parser.add_argument("--hours", type=float, default=24.0, help="of the replay")
    parser.add_argument("--rounds", type=int, default=25)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--plot", type=Path, help="needs matplotlib")
    given = parser.parse_args(arguments)
    told: dict[str, Any] = {}
    keep_freed()  # as the commands do
    hours, rounds = (0.3, 2) if given.quick else (given.hours, given.rounds)
    with tempfile.TemporaryDirectory(prefix="shm-speed-") as name, threadpool_limits(limits=1):
        folder = Path(name)
        compare_windows(rounds, told)
        show_growth(max(2, rounds // 2), (3,) if given.quick else (3, 10, 30, 100), told)
        some = archive.write(folder / "reading.mcap", archive.configuration(), min(hours, 1.0))
        show_reading(some, max(2, rounds // 5), min(hours, 1.0), told)
        told["replay"] = archive.replays(folder, hours, 1 if given.quick else None)
        print(f"\nreplay: {json.dumps(told['replay'], indent=1)}", flush=True)
        if not given.quick:
            told["reprocess"] = archive.reprocessing(folder, hours)
            print(f"\nreprocess: {json.dumps(told['reprocess'], indent=1)}", flush=True)
            told["diagnosis"] = archive.diagnosis(folder)
            print(f"\ndiagnosis: {json.dumps(told['diagnosis'], indent=1)}")
    if given.json is not None:
        given.json.write_text(json.dumps(told, indent=1) + "\n")
    if given.plot is not None:
        draw(told, given.plot)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
