"""A million messages over every way in, guided by coverage.

    pip install atheris
    python -m tests.fuzz.run [--runs 1000000] [TARGET ...]

Each target runs in a process of its own: what crashes, takes longer than 10 s or more than 2 GB is kept in ``fuzz-faults/``;
once mended it moves to ``found/``, which the tests run.
`kept` counts inputs that reached code which none before had; a run without any was not guided, and fails.
"""

from __future__ import annotations

import argparse
import importlib
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from tests.fuzz.files import MEMORY
from tests.fuzz.targets import TARGETS


def one(name: str, runs: int, seed: int) -> None:
    """Run one target in this process; does not return."""
    import atheris

    root = Path(__file__).parents[2]
    compiled = [path for path in (root / "monitor").rglob("*.py") if "\n@compiled" in path.read_text()]
    # numba compiles no tracing
    left_out = [".".join(path.relative_to(root).with_suffix("").parts) for path in compiled]
    with atheris.instrument_imports(include=["drivers", "monitor"], exclude=left_out):
        for module in [m for m in sys.modules if m.split(".")[0] in ("drivers", "monitor", "tests")]:
            del sys.modules[module]
        targets = importlib.import_module("tests.fuzz.targets")
    targets.quiet()
    target = targets.TARGETS[name]
    with tempfile.TemporaryDirectory() as corpus:
        for k, data in enumerate(target.seeds()):
            (Path(corpus) / f"seed-{k}").write_bytes(data)
        limits = [f"-runs={runs}", f"-seed={seed}", "-timeout=10", "-rss_limit_mb=2048", f"-max_len={target.longest}"]
        Path("fuzz-faults").mkdir(exist_ok=True)
        said = ["-print_final_stats=1", "-verbosity=0", f"-artifact_prefix=fuzz-faults/{name}-"]
        atheris.Setup([sys.argv[0], *limits, *said, corpus], target.run)
        atheris.Fuzz()


def main() -> None:
    """Each target in turn, and a table of what came of it."""
    parser = argparse.ArgumentParser()
    parser.add_argument("targets", nargs="*")
    parser.add_argument("--runs", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--one", action="store_true")
    asked = parser.parse_args()
    if asked.one:
        one(asked.targets[0], asked.runs, asked.seed)
    begun_all, total = time.monotonic(), 0
    print("target         messages   time, s   peak, MB   kept   outcome", flush=True)
    failed = False
    for name in asked.targets or TARGETS:
        runs, begun = round(asked.runs * TARGETS[name].share), time.monotonic()
        command = [sys.executable, *f"-m tests.fuzz.run --one --runs {runs} --seed {asked.seed} {name}".split()]
        with tempfile.TemporaryDirectory(dir=MEMORY) as place:  # libFuzzer leaves without tidying up
            environment = {**os.environ, "TMPDIR": place}
            done = subprocess.run(command, capture_output=True, text=True, errors="replace", env=environment)
        seconds = time.monotonic() - begun
        rows = (row for row in done.stderr.splitlines() if row.startswith("stat::"))
        said = dict(row.removeprefix("stat::").split(":", 1) for row in rows)
        count = said.get("number_of_executed_units", "?").strip()
        peak = int(said.get("peak_rss_mb", resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss // 1024))
        kept = int(said.get("new_units_added", "0"))
        outcome = "FAULT" if done.returncode else "ok" if kept else "NOT GUIDED"
        print(f"{name:<14} {count:>8}   {seconds:7.1f}   {peak:8}   {kept:4}   {outcome}", flush=True)
        total += int(count) if count.isdigit() else 0
        if outcome != "ok":
            failed = True
            print(done.stdout[-2000:], done.stderr[-1000:], sep="\n", flush=True)
    print(f"{'in all':<14} {total:>8}   {time.monotonic() - begun_all:7.1f}   seed {asked.seed}", flush=True)
    raise SystemExit(failed)


if __name__ == "__main__":
    main()
