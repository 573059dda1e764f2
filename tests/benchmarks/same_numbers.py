"""Compare what two checkouts compute from the shipped recordings.

    python tests/benchmarks/same_numbers.py OTHER_CHECKOUT [--this CHECKOUT] [--std 1e-6] [--keep DIR] [--jobs 0,1,2]

Each checkout replays, calibrates and diagnoses the recordings in `recordings/` and reproduces the paper's tables, with the
interpreter that runs this script.  Then every number of every JSON file is compared.  Without ``--std`` files must be equal
to the byte but for what they say of the run itself (times of the clock, paths).  With ``--std`` texts may differ and a number
may differ by that share of the standard deviation that stands beside it (relative to its size where none does).

Exit code 0 if nothing differs, else 1 with one line a difference.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parents[2]
OF_THE_RUN = {"realtime_factor", "created", "created_ns", "version"}
"""Keys whose values are the run's own, not the data's."""
FRAME = ["--structure", "recordings/frame.toml"]
JOBS: list[list[str]] = [
    ["calibrate", "recordings/frame-healthy.mcap", *FRAME, "--out", "OUT/baseline.json"],
    ["replay", "recordings/frame-before.mcap", "recordings/frame-after.mcap", *FRAME, "--baseline", "OUT/baseline.json",
     "--out", "OUT/replay"],
    ["diagnose", "recordings/frame-after.mcap", *FRAME, "--baseline", "OUT/baseline.json", "--out", "OUT/after"],
    ["diagnose", "recordings/frame-healthy.mcap", *FRAME, "--out", "OUT/drawing"],
    ["evaluate", "recordings/frame-after.mcap", "--structure", "OUT/after/structure.extended.toml"],
    *[
        [command, f"recordings/mini-shake-table-{kind}.mcap", "--structure", f"recordings/mini-shake-table-{kind}.toml",
         "--out", f"OUT/{command}-{kind}"]
        for kind in ("flexible", "stiff")
        for command in ("replay", "diagnose")
    ],
    ["reproduce", "--json", "OUT/reproduce.json", "--seeds", "20"],
]  # fmt: skip


def compute(checkout: Path, out: Path, wanted: set[int]) -> None:
    """Run the wanted jobs in `checkout`, results in `out`; a job that was done before is not done again."""
    out.mkdir(parents=True, exist_ok=True)
    environment = os.environ | {"PYTHONPATH": str(checkout)}
    for number, job in enumerate(JOBS):
        done = out / f"job-{number}.done"
        if done.exists() or number not in wanted:
            continue
        command = [sys.executable, "-m", "monitor", *(word.replace("OUT", str(out)) for word in job)]
        print(" ".join(["shm-monitor", *job]), f"({checkout})", flush=True)
        run = subprocess.run(command, cwd=checkout, env=environment, capture_output=True, text=True)
        if run.returncode:
            sys.exit(f"exit {run.returncode}: {run.stderr}")
        (out / f"job-{number}.txt").write_text(run.stdout)
        done.touch()


def documents(out: Path) -> dict[str, list[Any]]:
    """The JSON values of every file below `out`, a line each where it is lines, and the lines of every TOML file."""
    found: dict[str, list[Any]] = {}
    for path in sorted(out.rglob("*")):
        name, text = str(path.relative_to(out)), path.suffix in {".json", ".jsonl", ".toml", ".txt"}
        if not text or path.name == "job-0.txt":
            continue
        content = path.read_text().replace(str(out), "OUT")
        if path.suffix == ".json":
            found[name] = [json.loads(content)]
        elif path.suffix == ".jsonl":
            found[name] = [json.loads(line) for line in content.splitlines()]
        else:
            found[name] = [re.sub(r"\d+(\.\d+)? x real", "N x real", line) for line in content.splitlines()]
    return found


def differences(a: Any, b: Any, share: float | None, at: str = "", std: float | None = None) -> Iterator[str]:
    """Say where two JSON values differ by more than `share` of the standard deviation beside them."""
    if isinstance(a, dict) and isinstance(b, dict):
        for key in sorted(a.keys() | b.keys()):
            if key in OF_THE_RUN:
                continue
            if key not in a or key not in b:
                yield f"{at}.{key}: only in {'the second' if key in b else 'the first'}"
                continue
            beside = next(
                (a[k] for k in (f"{key}_std", key.replace("_hz", "_std_hz"), "std") if k in a and k != key), None
            )
            yield from differences(a[key], b[key], share, f"{at}.{key}", beside)
    elif isinstance(a, list) and isinstance(b, list):
        if len(a) != len(b):
            yield f"{at}: {len(a)} and {len(b)} items"
        for i, (x, y) in enumerate(zip(a, b, strict=False)):
            yield from differences(
                x, y, share, f"{at}[{i}]", std[i] if isinstance(std, list) and i < len(std) else None
            )
    elif isinstance(a, (int, float)) and isinstance(b, (int, float)) and share is not None:
        scale = abs(std) if isinstance(std, (int, float)) and std else max(abs(a), abs(b))
        if not math.isclose(a, b, rel_tol=0.0, abs_tol=share * scale):
            yield f"{at}: {a!r} and {b!r}, a difference of {abs(a - b) / scale:.1e}"
    elif a != b and not (share is not None and isinstance(a, str) and isinstance(b, str)):
        yield f"{at}: {a!r} and {b!r}"


def main() -> None:
    """Compute both checkouts and print what differs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("other", type=Path)
    parser.add_argument("--this", type=Path, default=HERE)
    parser.add_argument("--std", type=float)
    parser.add_argument(
        "--keep", type=Path, help="folder for the other checkout's results, used again if it holds them"
    )
    parser.add_argument("--jobs", help="numbers of the jobs, all unless told; later jobs need the results of 0")
    words = parser.parse_args()
    wanted = set(range(len(JOBS))) if words.jobs is None else {int(number) for number in words.jobs.split(",")}
    with tempfile.TemporaryDirectory() as folder:
        other = words.keep or Path(folder) / "other"
        compute(words.other.resolve(), other.resolve(), wanted)
        this = Path(folder) / "this"
        compute(words.this.resolve(), this, wanted)
        a, b = documents(other.resolve()), documents(this)
        found = [f"{name}: not in the other checkout's results" for name in sorted(b.keys() - a.keys())]
        if words.jobs is None:
            found += [f"{name}: not in this checkout's results" for name in sorted(a.keys() - b.keys())]
        for name in sorted(a.keys() & b.keys()):
            found += [f"{name}{line}" for line in differences(a[name], b[name], words.std)]
        for line in found[:100]:
            print(line)
        total = sum(len(items) for items in b.values())
        print(f"{len(b)} files, {total} lines compared, {len(found)} differences")
    sys.exit(1 if found else 0)


if __name__ == "__main__":
    main()
