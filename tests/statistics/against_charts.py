"""Detection without a model against the charts of a textbook, set by set: false, found, delay.

    .venv/bin/python -m tests.statistics.against_charts OUT.jsonl [--data FOLDER] [--only TEXT] [--seeds N]

Same data, same split.  Sets: the mast of `tests/data/tower-modal`, simulated series (`tests.support.series`), the repository's
recordings, and those of FOLDER (docs/measured.md) that are there.  Where nothing happened to a structure a change is put in: its
frequencies fall by 0.5, 1 or 2 %.  A row that is in OUT.jsonl is not made again; the whole table is printed at the end.

Product and chart are compared at their own limits, and at equal false readings: the limit of one is moved until it has as many as
the other has at its own, one at least.  A reading that is not judged counts as not found.  Of series a reading counts at `warning`
or above, of recordings of seconds, in which nothing can persist, at `advisory` or above.  The delay is that of the first reading
found, from 1.  `compare` judges pairs, in place of readings.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import groupby
from pathlib import Path
from typing import Annotated, Protocol

import numpy as np
from numpy.typing import NDArray

from monitor.core import Array
from monitor.damage import FeatureTable
from tests.statistics import charts, tower
from tests.statistics.product_readings import Features, Modes, Pair, Record
from tests.statistics.recorded_sets import SETS, Recorded, stretched
from tests.support import series

CHANGES = (0.005, 0.01, 0.02)
"""Shares of a frequency that are put in. [1; the issue's]"""
LESS_FOUND, LATER = 0.02, 2
"""What a row may lack to be level: share of the readings found, and delay in readings. [the issue's]"""
Flags = Annotated[NDArray[np.bool_], "w"]


class Judge(Protocol):
    """What judges the later readings."""

    steps: int
    """Halvings of the search for a limit."""
    limits: tuple[float, float]
    """Between which it is looked for."""

    def healthy(self, limit: float | None = None) -> Flags:
        """Tell which healthy readings are announced, at its own limit by default."""

    def changed(self, limit: float | None = None) -> Flags:
        """Tell which changed ones are."""


@dataclass(frozen=True)
class Told:
    """What is told of a set."""

    false: int
    healthy: int
    found: int
    changed: int
    delay: float
    """Readings, from 1; infinite where none is found."""


@dataclass(frozen=True)
class Chart:
    """A chart of one sequence of readings."""

    chart: charts.Chart
    is_changed: Flags
    steps: int = 40
    limits: tuple[float, float] = (1e-6, 1e6)

    def healthy(self, limit: float | None = None) -> Flags:
        return self.chart.announced(1.0 if limit is None else limit)[~self.is_changed]

    def changed(self, limit: float | None = None) -> Flags:
        return self.chart.announced(1.0 if limit is None else limit)[self.is_changed]


def told(judge: Judge, limit: float | None = None) -> Told:
    """Count what a judge tells at a limit."""
    healthy, changed = judge.healthy(limit), judge.changed(limit)
    delay = float(changed.argmax() + 1) if changed.any() else math.inf if changed.size else 0.0
    return Told(int(healthy.sum()), healthy.size, int(changed.sum()), changed.size, delay)


def limit_of(judge: Judge, share: float) -> float:
    """Find the lowest limit at which no greater share of the healthy readings is announced."""
    low, high = judge.limits
    for _ in range(judge.steps):
        middle = math.sqrt(low * high)
        if judge.healthy(middle).sum() > share * judge.healthy(middle).size + 1e-9:
            low = middle
        else:
            high = middle
    return high


def at_equal(product: Judge, chart: Judge) -> dict[str, Told]:
    """Compare a product and a chart at their own limits and at equal false readings."""
    own, its = told(product), told(chart)
    return {
        "product": own,
        "chart": its,
        "chart_as_product": told(chart, limit_of(chart, max(own.false, 1) / max(own.healthy, 1))),
        "product_as_chart": told(product, limit_of(product, max(its.false, 1) / max(its.healthy, 1))),
    }


@dataclass(frozen=True)
class Case:
    """A row of the table, or one seed's part of it."""

    row: str
    seed: int
    judges: Callable[[], tuple[Judge, Judge]]
    """Product and chart."""

    @property
    def key(self) -> str:
        return f"{self.row} | {self.seed}"


def of_table(table: FeatureTable, learned_until_ns: int, changed_from_ns: float) -> tuple[Judge, Judge]:
    """Judge a series; where nothing is put in, it is changed never."""
    is_changed = table.t_ns[table.t_ns > learned_until_ns] >= changed_from_ns
    return Features(table, learned_until_ns, is_changed), Chart(charts.of_series(table, learned_until_ns), is_changed)


def mast() -> Iterator[Case]:
    """Change the last five days of a mast's three weeks."""
    for days in (6, 9, 12, 15):
        for told_of in ((), ("temperature",), ("temperature", "level")):
            for change in (0.0, *CHANGES):
                for how in ("all", "one") if change else ("none",):

                    def judges(days=days, told_of=told_of, change=change, how=how):  # type: ignore[no-untyped-def]
                        whole = tower.table()
                        from_ns = int(whole.t_ns[-1] - tower.LOSS_DAYS * tower.DAY_NS)
                        for name in list(whole.features)[: None if how == "all" else 1]:
                            whole.features[name][whole.t_ns > from_ns] *= 1.0 - change  # type: ignore[index]
                        known = {name: whole.covariates[name] for name in told_of}
                        until_ns = int(whole.t_ns[0] + days * tower.DAY_NS)
                        return of_table(FeatureTable(whole.t_ns, whole.features, known), until_ns, from_ns + 1 if change else math.inf)

                    with_ = " and ".join(told_of) or "no covariate"
                    yield Case(f"mast, {days} days learned, {with_}: {_put_in(change, how)}", 0, judges)


def simulated(seeds: int) -> Iterator[Case]:
    """Change simulated series."""
    puts = [(0.0, "none"), *((change, "one") for change in CHANGES), (0.01, "all"), (0.02, "slow")]
    for name in series.NATURES:
        for change, how in puts:
            for seed in range(seeds):

                def judges(name=name, seed=seed, change=change, how=how):  # type: ignore[no-untyped-def]
                    made = series.series(name, 1000 + seed, change, how if change else "one")
                    return of_table(made.table, made.learned_until_ns, made.changed_from_ns if change else math.inf)

                yield Case(f"simulated {name}: {_put_in(change, how)}", seed, judges)
    for learned in (20, 60):
        for change in (0.0, 0.02, 0.05):
            for seed in range(5 * seeds):

                def judges(learned=learned, seed=seed, change=change):  # type: ignore[no-untyped-def]
                    made = series.records(2000 + seed, change, learned=learned)
                    product, chart = of_table(made.table, made.learned_until_ns, made.changed_from_ns if change else math.inf)
                    assert isinstance(chart, Chart)
                    return product, Chart(charts.Chart(chart.chart.statistic, 1), chart.is_changed)

                yield Case(f"simulated AR(10) of {learned} records: {_put_in(change, 'one')}", seed, judges)


def recorded(data: Path | None) -> Iterator[Case]:
    """Judge windows of recordings by `modal`, segments by the chart."""
    for one in SETS:
        if (one.committed or data is not None) and one.is_there(data):
            for name in (*one.changes, *(_put_in(change, "all") for change in CHANGES)):

                def judges(one: Recorded = one, name: str = name) -> tuple[Judge, Judge]:
                    learned, healthy, changed = _pieces(one, data, name)
                    features = [
                        charts.ar_coefficients(piece, round(one.segment_s * one.rate_hz), one.order)
                        for piece in (*learned, *healthy, *changed)
                    ]
                    n, m = len(learned), len(healthy)
                    later = np.concatenate(features[n:])
                    is_changed = np.arange(len(later)) >= sum(map(len, features[n : n + m]))
                    chart = Chart(charts.of_segments(np.concatenate(features[:n]), later), is_changed)
                    return Modes(Record(one.rate_hz, one.window_s, learned, healthy, changed)), chart

                yield Case(f"{one.name}, `modal` windows of {one.window_s:g} s: {name}", 0, judges)


def _pieces(one: Recorded, data: Path | None, name: str) -> tuple[list[Array], list[Array], list[Array]]:
    """Read what is learned, what is healthy and what is changed, all resampled alike."""
    learned, healthy, changed = one.read(data)
    puts = {_put_in(change, "all"): change for change in CHANGES}
    later = [stretched(x, puts[name]) for x in healthy] if name in puts else [stretched(x) for x in changed[name]]
    return [stretched(x) for x in learned], [stretched(x) for x in healthy], later


@dataclass(frozen=True)
class Pairs:
    """Pairs of records of one state, and of two, by a statistic over its limit."""

    equal: Sequence[float]
    different: Sequence[float]
    steps: int = 40
    limits: tuple[float, float] = (1e-6, 1e6)

    def healthy(self, limit: float | None = None) -> Flags:
        return np.array(self.equal) > (limit or 1.0)

    def changed(self, limit: float | None = None) -> Flags:
        return np.array(self.different) > (limit or 1.0)


def compared(data: Path | None) -> Iterator[Case]:
    """Judge pairs of records by `compare` and by T2 of their segments."""
    for one in SETS:
        if (one.committed or data is not None) and one.is_there(data):
            for name in (*one.changes, *(_put_in(change, "all") for change in CHANGES)):

                def judges(one: Recorded = one, name: str = name) -> tuple[Judge, Judge]:
                    learned, healthy, changed = _pieces(one, data, name)
                    same = [*learned, *healthy]
                    equal = [(a, b) for i, a in enumerate(same) for b in same[i + 1 :]]
                    different = list(zip(same, changed, strict=False)) + [(same[0], b) for b in changed[len(same) :]]
                    pair = Pair(one.rate_hz)
                    n = round(one.segment_s * one.rate_hz)

                    def chart(a: Array, b: Array) -> float:
                        return charts.between(*(charts.ar_coefficients(x, n, one.order) for x in (a, b)))

                    product = Pairs([pair.statistic(a, b) for a, b in equal], [pair.statistic(a, b) for a, b in different])
                    return product, Pairs([chart(a, b) for a, b in equal], [chart(a, b) for a, b in different])

                yield Case(f"{one.name}, `compare`: {name}", 0, judges)


def _put_in(change: float, how: str) -> str:
    """Say what was put in."""
    of = {"one": " of the first", "all": " of all", "slow": " of the first, slowly", "none": ""}[how]
    return f"-{100 * change:g} %{of}" if change else "nothing put in"


def rows(lines: Sequence[Mapping[str, dict[str, float]]]) -> Iterator[str]:
    """Write the table: seeds of a row are summed, their delays are the median."""
    yield "| set | false | found | delay | chart: false, found, delay | at the product's false readings: chart | at the chart's: product | level |"
    yield "|---|---|---|---|---|---|---|---|"
    for row, group in groupby(lines, key=lambda line: str(line["row"])):
        parts = list(group)
        sums = {of: summed([Told(**part[of]) for part in parts]) for of in parts[0] if of not in ("row", "key")}
        own, chart = sums["product"], sums["chart"]
        level = [level_with(own, sums["chart_as_product"]), level_with(sums["product_as_chart"], chart)]
        yield (
            f"| {row} | {_false(own)} | {_found(own)} | {_delay(own)} | {_words(chart)} | {_words(sums['chart_as_product'])} | "
            f"{_words(sums['product_as_chart'])} | {', '.join('yes' if held else '**no**' for held in level) if own.changed else '-'} |"
        )


def summed(parts: Sequence[Told]) -> Told:
    """Sum the readings of several seeds."""
    return Told(
        sum(p.false for p in parts),
        sum(p.healthy for p in parts),
        sum(p.found for p in parts),
        sum(p.changed for p in parts),
        sorted(p.delay for p in parts)[len(parts) // 2],
    )


def level_with(product: Told, chart: Told) -> bool:
    """Tell if a product finds not fewer and not later than a chart, but for the tolerance."""
    least = chart.found / max(chart.changed, 1) - LESS_FOUND
    return product.found / max(product.changed, 1) >= least and product.delay <= chart.delay + LATER


def _delay(one: Told) -> str:
    return "-" if not one.changed else "never" if math.isinf(one.delay) else f"{one.delay:g}"


def _false(one: Told) -> str:
    return f"{one.false}/{one.healthy}"


def _found(one: Told) -> str:
    return f"{one.found}/{one.changed}" if one.changed else "-"


def _words(one: Told) -> str:
    return f"{_false(one)}, {_found(one)}, {_delay(one)}"


def main() -> None:
    """Make the rows that are not there, and print all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--data", type=Path)
    parser.add_argument("--only", default="")
    parser.add_argument("--seeds", type=int, default=2)
    given = parser.parse_args()
    cases = [*mast(), *simulated(given.seeds), *recorded(given.data), *compared(given.data)]
    made = {}
    if given.out.exists():
        made = {line["key"]: line for line in map(json.loads, given.out.read_text().splitlines())}
    with given.out.open("a") as file:
        for case in cases:
            if case.key not in made and given.only in case.row:
                found = at_equal(*case.judges())
                made[case.key] = {"row": case.row, "key": case.key, **{of: asdict(one) for of, one in found.items()}}
                print(json.dumps(made[case.key]), file=file, flush=True)
    print("\n".join(rows([made[case.key] for case in cases if case.key in made])))


if __name__ == "__main__":
    main()
