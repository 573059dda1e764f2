"""``python -m tests.hidden [N] [--world planar|building] [--seed S] [--effects a,b] [--clean N] [--out FILE] [--add FILE...]``"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

from threadpoolctl import threadpool_limits

from tests.hidden import tables, trial
from tests.hidden.worlds import NAMES, WORLDS, rounds


def _one(task: tuple[int, str]) -> dict[str, Any]:
    with threadpool_limits(limits=1):
        return trial.run(*task)


def _results(tasks: list[tuple[int, str]], processes: int) -> Iterator[dict[str, Any]]:
    if processes == 1:
        yield from map(_one, tasks)
        return
    with ProcessPoolExecutor(processes) as pool:
        yield from pool.map(_one, tasks, chunksize=trial.TRIALS_A_TRUTH)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tests.hidden", description="Hide effects and have them found.")
    parser.add_argument("n", type=int, nargs="?", help="trials (default: two rounds)")
    parser.add_argument("--world", choices=WORLDS, default="planar", help="the simulator (default: planar)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--effects", default="", help=f"only these, comma separated, of any world: {', '.join(dict.fromkeys(NAMES))}"
    )
    parser.add_argument("--clean", type=int, default=0, help="this many clean records more")
    parser.add_argument("--processes", type=int, choices=(1, 2), default=1)
    parser.add_argument(
        "--out", type=Path, help="append a JSON line a trial; the trials that it holds are counted, and not run again"
    )
    parser.add_argument(
        "--add", type=Path, nargs="*", default=[], help="count these files' trials too; N = 0 prints them"
    )
    options = parser.parse_args()
    only = set(filter(None, options.effects.split(",")))
    if only - set(NAMES):
        parser.error(f"unknown: {', '.join(sorted(only - set(NAMES)))}")
    options.names = tuple(name for name in NAMES if name in only) or WORLDS[options.world].NAMES
    if options.n is None:
        options.n = 2 * len(options.names)
    return options


def _read(paths: Iterable[Path]) -> list[dict[str, Any]]:
    return [json.loads(line) for path in paths for line in path.read_text().splitlines()]


def main() -> None:
    """Run the trials, one line each, then the tables."""
    options = _options()
    own = options.out
    results = _read(options.add) + _read([own] if own is not None and own.exists() and own not in options.add else [])
    done = {(r["seed"], r["name"]) for r in results}
    tasks = rounds(options.n, options.seed, options.names)
    tasks += rounds(options.clean, options.seed + 50_000, ("clean" if options.world == "planar" else "clean3d",))
    tasks = [task for task in tasks if task not in done]
    for result in _results(tasks, options.processes):
        results.append(result)
        print(tables.line(result), file=sys.stderr, flush=True)
        if options.out is not None:
            with options.out.open("a") as out:
                out.write(json.dumps(result) + "\n")
    print(tables.report(results))


if __name__ == "__main__":
    main()
