"""Small faults put into the product, one at a time: which of them do no tests notice?

Faults (mutants) are drawn evenly over the rooms by a seed and kept as text, so that the same faults can be tried on
another checkout. Each is tried against the tests of its room and the contracts, all that are not slow; of these only
the test files that run the changed line, which coverage tells once for each checkout. Interrupted, it goes on where it was.

    make mutation SEED=7 MUTANTS=60               # this checkout; results in out/mutation
    make mutation SEED=7 MUTANTS=60 TREE=../other # another checkout, the same faults
"""

from __future__ import annotations

import argparse
import ast
import itertools
import json
import os
import random
import shutil
import subprocess
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from queue import SimpleQueue

ROOT = Path(__file__).resolve().parents[1]
OUT = ROOT / "out" / "mutation"
PACKAGES = OUT / "packages"
"""Of pip (Makefile): what puts the faults in, and coverage, with a module that starts coverage in processes of tests."""
CONTRACTS = "contracts"
ALIVE, UNSEEN, GONE = "alive", "run by no test", "no such line"
_HANGS_S = 900.0
"""A trial that takes longer is noticed: no selection of test files takes as long."""
_WITHOUT = {"core/RemoveDecorator", "core/VariableInserter", "core/VariableReplacer"}
"""Kinds of faults that are not put in: they change no line, or need to be told what."""
_NO_ARITHMETIC = {"BitAnd", "BitOr", "BitXor", "LShift", "RShift"}
"""Any test that runs a line notices these between numbers."""
_READ_SOURCES = {"tests/contracts/test_constants.py"}
"""Tests that notice a fault without running it."""
_STAMPS = itertools.count(1)


@dataclass(frozen=True)
class Mutant:
    """A fault: lines of a file, with their neighbours, before and after."""

    room: str
    file: str
    operator: str
    line: int
    before: str
    after: str


def rooms(tree: Path) -> dict[str, list[Path]]:
    """Product files by room."""
    found = {"drivers": sorted((tree / "drivers").rglob("*.py"))}
    for room in sorted((tree / "monitor").iterdir()):
        if test_files(tree, room.stem):
            found[room.stem] = sorted(room.rglob("*.py")) if room.is_dir() else [room]
    return found


def test_files(tree: Path, room: str) -> list[str]:
    places = [*(tree / "tests" / room).glob("test_*.py"), *(tree / "tests").glob(f"test_{room}.py")]
    return sorted(str(p.relative_to(tree)) for p in places)


def draw(tree: Path, seed: int, count: int) -> Iterator[Mutant]:
    """Rooms in turn, then any line of code of the room, then any fault of that line."""
    sys.path.append(str(PACKAGES / "operators"))  # last: its own dependencies are not the locked ones
    from cosmic_ray.mutating import mutate_code
    from cosmic_ray.plugins import get_operator, operator_names

    kinds: dict[str, list[str]] = defaultdict(list)
    for name in sorted(operator_names()):
        kind, *which = name.split("_")
        if kind not in _WITHOUT and not _NO_ARITHMETIC.intersection(which):
            kinds[kind].append(name)
    rng, seen = random.Random(seed), set()
    files = rooms(tree)
    for room in itertools.islice(itertools.cycle(files), count):
        while True:
            file = rng.choices(files[room], [f.stat().st_size for f in files[room]])[0]
            source, name = file.read_text(), rng.choice(kinds[rng.choice(list(kinds))])
            changed = mutate_code(source, get_operator(name)(), rng.randrange(40))
            if changed is None or _meaning(changed) == _meaning(source):
                continue
            fault = _fault(room, str(file.relative_to(tree)), name, source, changed)
            if (fault.file, fault.line, fault.after) not in seen:
                seen.add((fault.file, fault.line, fault.after))
                break
        yield fault


def _meaning(source: str) -> str | None:
    """The code without annotations and docstrings, which change nothing; None if it is no code."""
    try:
        tree = ast.parse(source)
    except SyntaxError:
        return None
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            node.returns = None
        if isinstance(node, ast.arg):
            node.annotation = None
        if isinstance(node, ast.AnnAssign):
            node.annotation = ast.Constant(None)
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            node.value = ast.Constant(None)
    return ast.dump(tree)


def _fault(room: str, file: str, operator: str, source: str, changed: str) -> Mutant:
    old, new = source.splitlines(keepends=True), changed.splitlines(keepends=True)
    first = next(k for k, (a, b) in enumerate(zip(old, new, strict=False)) if a != b)
    last = next(k for k, (a, b) in enumerate(zip(reversed(old), reversed(new), strict=False)) if a != b)
    last = min(last, len(old) - first - 1, len(new) - first - 1)
    begin, end = max(first - 1, 0), max(last - 1, 0)
    return Mutant(
        room,
        file,
        operator.removeprefix("core/"),
        first + 1,
        "".join(old[begin : len(old) - end]),
        "".join(new[begin : len(new) - end]),
    )


def place(tree: Path, fault: Mutant) -> tuple[str, int] | None:
    """The file's text with the fault, and its line; None where the tree has no such lines, or has them twice."""
    file = tree / fault.file
    text = file.read_text() if file.exists() else ""
    if text.count(fault.before) != 1:
        return None
    above = text[: text.index(fault.before)].count("\n") + 1
    lines = zip(fault.before.splitlines(), fault.after.splitlines(), strict=False)
    return text.replace(fault.before, fault.after), above + next(k for k, (a, b) in enumerate(lines) if a != b)


class Checkout:
    """A copy of a tree in which faults are put, with the environment of its tests."""

    def __init__(self, tree: Path, place: Path) -> None:
        self.place = place
        if not place.exists():
            subprocess.run(["git", "clone", "--quiet", "--shared", str(tree), str(place)], check=True)
        paths = (place, place / "monitor/api/installed", PACKAGES / "coverage")
        self._environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, paths)), "OPENBLAS_NUM_THREADS": "1"}

    def pytest(self, *arguments: str, within_s: float, **environment: str) -> tuple[int | None, str]:
        """Exit code (None: it hung) and output."""
        shutil.rmtree(self.place / "out" / "references", ignore_errors=True)
        words = ["-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", "-m", "not slow", "--timeout", "900", *arguments]
        command = ["timeout", "--kill-after=5", f"{within_s:.0f}", sys.executable, *words]
        if environment:
            command[4:5] = ["-m", "coverage", "run", "-m"]
        done = subprocess.run(
            command,
            cwd=self.place,
            env={**self._environment, **environment},
            capture_output=True,
            text=True,
            check=False,
        )
        return (None if done.returncode in (124, 137) else done.returncode), done.stdout + done.stderr

    def lines_run(self, test_file: str) -> tuple[dict[str, list[int]], float]:
        """Lines of product files that a test file runs, and how long it takes, in s."""
        import coverage  # in PYTHONPATH (Makefile)

        data, settings = self.place / "out" / "coverage", self.place / "out" / "coverage.ini"
        shutil.rmtree(data, ignore_errors=True)
        data.mkdir(parents=True)
        settings.write_text(f"[run]\ndata_file={data}/data\nsource=monitor,drivers\nparallel=true\nsigterm=true\n")
        begin = time.monotonic()
        code, output = self.pytest(
            test_file, within_s=3 * _HANGS_S, COVERAGE_RCFILE=str(settings), COVERAGE_PROCESS_START=str(settings)
        )
        if code not in (0, 5):  # 5: all its tests are slow
            raise SystemExit(f"{test_file} fails without a fault:\n{output[-3000:]}")
        took = time.monotonic() - begin
        whole = coverage.CoverageData(str(data / "whole"))
        for part in data.glob("data.*"):
            read = coverage.CoverageData(str(part))
            read.read()
            whole.update(read)
        lines = {f: sorted(whole.lines(f) or ()) for f in whole.measured_files()}
        return {str(Path(f).relative_to(self.place)): lines[f] for f in lines}, took

    def try_(self, fault: Mutant, cover: dict[str, tuple[dict[str, list[int]], float]]) -> str:
        """What notices the fault: a test, 'hangs', or nothing."""
        placed = place(self.place, fault)
        if placed is None:
            return GONE
        text, line = placed
        file = self.place / fault.file
        files = [*test_files(self.place, fault.room), *test_files(self.place, CONTRACTS)]
        extent = _extent(file.read_text(), line)
        chosen = [f for f in files if any(at in extent for at in cover[f][0].get(fault.file, ())) or f in _READ_SOURCES]
        if not set(chosen) - _READ_SOURCES:
            return UNSEEN
        original = file.read_text()
        try:
            self._write(file, text)
            code, output = self.pytest(*sorted(chosen, key=lambda f: cover[f][1]), within_s=_HANGS_S)
        finally:
            self._write(file, original)
        if code is None:
            return "hangs"
        if code == 0:
            return ALIVE
        told = [word for word in output.split() if word.startswith("tests/")]
        return told[-1] if told else f"exit code {code}"

    @staticmethod
    def _write(file: Path, text: str) -> None:
        """With a time of its own: compiled code of a file is known by its size and its second."""
        file.write_text(text)
        stamp = time.time() + 2.0 * next(_STAMPS)
        os.utime(file, (stamp, stamp))


def _extent(source: str, line: int) -> range:
    """Lines of the statement that holds a line; of the whole file inside a compiled function, where coverage sees none."""
    found = range(line, line + 1)
    for node in ast.walk(ast.parse(source)):
        if not isinstance(node, ast.stmt) or not node.lineno <= line <= (node.end_lineno or 0):
            continue
        body = getattr(node, "body", None)
        if isinstance(node, ast.FunctionDef) and any("compiled" in ast.unparse(d) for d in node.decorator_list):
            return range(1, len(source.splitlines()) + 1)
        end = body[0].lineno - 1 if body else node.end_lineno or node.lineno
        if line <= end:
            found = range(node.lineno, end + 1)
    return found


def _in_pairs(tree: Path, name: str, work: list[object], one: object, workers: int) -> Iterator[tuple[object, object]]:
    free: SimpleQueue[Checkout] = SimpleQueue()
    for k in range(workers):
        free.put(Checkout(tree, OUT / name / f"copy{k}"))

    def run(item: object) -> tuple[object, object]:
        checkout = free.get()
        try:
            return item, one(checkout, item)  # type: ignore[operator]
        finally:
            free.put(checkout)

    with ThreadPoolExecutor(workers) as pool:
        yield from pool.map(run, work)


def _kept(file: Path) -> dict[str, object]:
    return json.loads(file.read_text()) if file.exists() else {}


def _keep(file: Path, kept: dict[str, object]) -> None:
    file.with_suffix(".part").write_text(json.dumps(kept, indent=1))
    file.with_suffix(".part").replace(file)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--mutants", type=int, default=60)
    parser.add_argument("--tree", type=Path, default=ROOT, help="the checkout to try, at its last commit")
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    tree = options.tree.resolve()
    OUT.mkdir(parents=True, exist_ok=True)
    drawn = OUT / f"mutants-{options.seed}-{options.mutants}.json"
    if not drawn.exists():
        _keep(drawn, {str(k): asdict(m) for k, m in enumerate(draw(tree, options.seed, options.mutants))})
    faults = {k: Mutant(**m) for k, m in _kept(drawn).items()}  # type: ignore[arg-type]
    name = subprocess.run(
        ["git", "-C", tree, "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=True
    )
    name = name.stdout.strip()
    (OUT / name).mkdir(exist_ok=True)

    cover_file, result_file = OUT / name / "cover.json", OUT / name / f"results-{options.seed}-{options.mutants}.json"
    cover, results = _kept(cover_file), _kept(result_file)
    wanted = sorted({f for m in faults.values() for f in (*test_files(tree, m.room), *test_files(tree, CONTRACTS))})
    left = [f for f in wanted if f not in cover]
    for file, found in _in_pairs(tree, name, left, lambda c, f: c.lines_run(f), options.workers):
        cover[file] = found
        _keep(cover_file, cover)
        print(f"coverage {len(cover)}/{len(wanted)} {file}: {found[1]:.0f} s", flush=True)
    left = [k for k in faults if k not in results]
    for k, told in _in_pairs(tree, name, left, lambda c, k: c.try_(faults[k], cover), options.workers):
        results[k] = told
        _keep(result_file, results)
        print(
            f"{len(results)}/{len(faults)} {faults[k].file}:{faults[k].line} {faults[k].operator}: {told}", flush=True
        )

    table: dict[str, Counter[str]] = defaultdict(Counter)
    for k, told in results.items():
        table[faults[k].room][told if told in (ALIVE, UNSEEN, GONE) else "noticed"] += 1
    print(f"\n{'room':16}{'noticed':>9}{ALIVE:>9}{UNSEEN:>16}{GONE:>14}")
    for room, counts in [*sorted(table.items()), ("all", sum(table.values(), Counter()))]:
        print(f"{room:16}{counts['noticed']:9}{counts[ALIVE]:9}{counts[UNSEEN]:16}{counts[GONE]:14}")


if __name__ == "__main__":
    main()
