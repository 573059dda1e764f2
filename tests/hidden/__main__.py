"""``python -m tests.hidden [N] [--seed S] [--effects a,b] [--clean N] [--out FILE] [--add FILE...]``"""

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
from tests.hidden.plans import NAMES, rounds


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
    parser.add_argument("n", type=int, nargs="?", default=2 * len(NAMES), help="trials (default: two of every kind)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--effects", default="", help=f"only these, comma separated: {', '.join(dict.fromkeys(NAMES))}")
    parser.add_argument("--clean", type=int, default=0, help="this many clean records more")
    parser.add_argument("--processes", type=int, choices=(1, 2), default=1)
    parser.add_argument("--out", type=Path, help="append a JSON line a trial")
    parser.add_argument(
        "--add", type=Path, nargs="*", default=[], help="count these files' trials too; N = 0 prints them"
    )
    options = parser.parse_args()
    unknown = set(filter(None, options.effects.split(","))) - set(NAMES)
    if unknown:
        parser.error(f"unknown: {', '.join(sorted(unknown))}")
    return options


def _read(paths: Iterable[Path]) -> list[dict[str, Any]]:
    return [json.loads(line) for path in paths for line in path.read_text().splitlines()]


def main() -> None:
    """Run the trials, one line each, then the tables."""
    options = _options()
    results = _read(options.add)
    tasks = rounds(options.n, options.seed, tuple(filter(None, options.effects.split(","))))
    tasks += rounds(options.clean, options.seed + 50_000, ("clean",))
    for result in _results(tasks, options.processes):
        results.append(result)
        print(tables.line(result), file=sys.stderr, flush=True)
        if options.out is not None:
            with options.out.open("a") as out:
                out.write(json.dumps(result) + "\n")
    print(tables.report(results))


if __name__ == "__main__":
    main()
