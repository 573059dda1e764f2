"""``python -m tests.hidden [N] [--world planar|building|shaken] [--seed S] [--effects a,b] [--clean N] [--out F] [--add F]``"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from itertools import groupby
from multiprocessing import SimpleQueue
from pathlib import Path
from typing import Any

from threadpoolctl import threadpool_limits

from tests.hidden import tables, trial
from tests.hidden.worlds import NAMES, WORLDS, clean, rounds

_PAUSE_S = 0.5
"""Between two looks at the results."""
_found: SimpleQueue[dict[str, Any]]
"""Where a process puts its results, trial by trial."""


def _one(task: tuple[int, str]) -> dict[str, Any]:
    with threadpool_limits(limits=1):
        return trial.run(*task)


def _begin(found: SimpleQueue[dict[str, Any]]) -> None:
    global _found
    _found = found


def _some(tasks: list[tuple[int, str]]) -> None:
    for task in tasks:
        _found.put(_one(task))


def _results(tasks: list[tuple[int, str]], processes: int) -> Iterator[dict[str, Any]]:
    """Yield every result as soon as it is there; the trials of one truth share a process, which calibrates once."""
    if processes == 1:
        yield from map(_one, tasks)
        return
    by_truth = [list(some) for _, some in groupby(tasks, key=lambda task: task[0] // trial.TRIALS_A_TRUTH)]
    found: SimpleQueue[dict[str, Any]] = SimpleQueue()
    with ProcessPoolExecutor(processes, initializer=_begin, initargs=(found,)) as pool:
        running = [pool.submit(_some, some) for some in by_truth]
        while not (all(r.done() for r in running) and found.empty()):
            if found.empty():
                time.sleep(_PAUSE_S)
            else:
                yield found.get()
        for r in running:
            r.result()  # raises what a process failed with


def _options(arguments: Sequence[str] | None) -> argparse.Namespace:
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
    options = parser.parse_args(arguments)
    only = set(filter(None, options.effects.split(",")))
    if only - set(NAMES):
        parser.error(f"unknown: {', '.join(sorted(only - set(NAMES)))}")
    options.names = tuple(name for name in NAMES if name in only) or WORLDS[options.world].NAMES
    if options.n is None:
        options.n = 2 * len(options.names)
    return options


def _read(paths: Iterable[Path]) -> list[dict[str, Any]]:
    return [json.loads(line) for path in paths for line in path.read_text().splitlines()]


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the trials, one line each, then the tables."""
    options = _options(arguments)
    own = options.out
    results = _read(options.add) + _read([own] if own is not None and own.exists() and own not in options.add else [])
    done = {(r["seed"], r["name"]) for r in results}
    tasks = rounds(options.n, options.seed, options.names)
    tasks += rounds(options.clean, options.seed + 50_000, (clean(options.world),))
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
