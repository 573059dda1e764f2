"""Detection without a model against the charts of a textbook, set by set: false, found, delay.

    .venv/bin/python -m tests.statistics.against_charts OUT.jsonl [--data FOLDER] [--only TEXT] [--seeds N]

Same data, same split.  Sets: the mast of `tests/data/tower-modal`, simulated series (`tests.support.series`), the repository's
recordings, and those of FOLDER (docs/measured.md) that are there.  Where nothing happened to a structure a change is put in: its
frequencies fall by 0.5, 1 or 2 %.  A row that is in OUT.jsonl is not made again; all that are there are printed at the end.

Product and chart are compared at their own limits, and at equal false readings: the limit of one is moved until it has as many as
the other has at its own, one at least.  A reading that is not judged counts as not found.  Of series a reading counts at
`warning` or above, of recordings of seconds, in which nothing can persist, at `advisory` or above.  The delay is that of the
first reading found, from 1.  `compare` judges pairs, in place of readings.  Product and chart are level where the one finds not
fewer than the other by more than 2 % of the readings, nor later by more than two: at the product's own limit, at the chart's own,
and, where both have as many false readings, both moved.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cache, partial
from itertools import combinations, groupby, product
from pathlib import Path
from typing import Annotated, Any, Protocol

import h5py
import numpy as np
from numpy.typing import NDArray

from monitor.core import Array
from monitor.damage import FeatureTable
from tests.statistics import charts, tower
from tests.statistics.product_readings import TAKES_HEALTHY, Features, Modes, Record, statistic_of_pair
from tests.statistics.recorded_sets import SETS, Recorded, stretched
from tests.support import series
from tests.support.tower import DAY_NS, HOUR_NS

CHANGES = (0.005, 0.01, 0.02)
"""Shares of a frequency that are put in. [1; the issue's]"""
LONG = 2000
"""Readings from which a series is long; of shorter ones five times as many are made. [readings; choice]"""
LESS_FOUND, LATER = 0.02, 2
"""What a row may lack to be level: share of the readings found, and delay in readings. [the issue's]"""
MAST_TEMPERATURES = "tower-modal-temperature/tests/data/result_db_short/60-minutes/stats_temp.nc"
FIVE = tuple(f"temperature_{n}" for n in range(1, 6))
Flags = Annotated[NDArray[np.bool_], "w"]


class Judge(Protocol):
    """What judges the later readings."""

    @property
    def steps(self) -> int:
        """Halvings of the search for a limit."""

    @property
    def limits(self) -> tuple[float, float]:
        """Between which it is looked for."""

    def healthy(self, limit: float | None = None) -> Flags:
        """Tell which healthy readings are announced, at its own limit by default."""

    def changed(self, limit: float | None = None) -> Flags:
        """Tell which changed ones are."""

    def unjudged(self) -> int:
        """Count the readings that are not judged."""


@dataclass(frozen=True)
class Told:
    """What is told of a set."""

    false: int
    healthy: int
    found: int
    changed: int
    unjudged: int
    delay: float
    """Readings, from 1; infinite where none is found."""

    def words(self) -> str:
        """Write false, found and delay."""
        false = f"{self.false}/{self.healthy}" + (f" ({self.unjudged} not judged)" if self.unjudged else "")
        if not self.changed:
            return f"{false}, -, -"
        return f"{false}, {self.found}/{self.changed}, {'never' if math.isinf(self.delay) else f'{self.delay:g}'}"


OF = ("product", "chart", "chart_as_product", "product_as_chart")
"""What a row holds: both at their own limits, each at the other's false readings. [names]"""


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

    def unjudged(self) -> int:
        return int(np.isnan(self.chart.statistic).sum())


@dataclass(frozen=True)
class Pairs:
    """Pairs of records of one state, and of two, by a statistic over its limit; NaN where it is refused."""

    equal: Array
    different: Array
    steps: int = 40
    limits: tuple[float, float] = (1e-6, 1e6)

    @classmethod
    def by(cls, statistic: Callable[[Array, Array], float], equal: Sequence[Any], different: Sequence[Any]) -> Pairs:
        """Judge pairs by a statistic."""
        return cls(np.array([statistic(a, b) for a, b in equal]), np.array([statistic(a, b) for a, b in different]))

    def healthy(self, limit: float | None = None) -> Flags:
        return self.equal > (1.0 if limit is None else limit)

    def changed(self, limit: float | None = None) -> Flags:
        return self.different > (1.0 if limit is None else limit)

    def unjudged(self) -> int:
        return int(np.isnan(self.equal).sum() + np.isnan(self.different).sum())


def told(judge: Judge, limit: float | None = None) -> Told:
    """Count what a judge tells at a limit."""
    healthy, changed = judge.healthy(limit), judge.changed(limit)
    delay = float(changed.argmax() + 1) if changed.any() else math.inf
    return Told(int(healthy.sum()), healthy.size, int(changed.sum()), changed.size, judge.unjudged(), delay)


def limit_of(judge: Judge, other: Told) -> float:
    """Find the lowest limit at which no greater share of the healthy readings is announced than by another, or one of its."""
    share = max(other.false, 1) / max(other.healthy, 1)
    low, high = judge.limits
    for _ in range(judge.steps):
        middle = math.sqrt(low * high)
        healthy = judge.healthy(middle)
        low, high = (middle, high) if healthy.sum() > share * healthy.size + 1e-9 else (low, middle)
    return high


def at_equal(product: Judge, chart: Judge) -> dict[str, Told]:
    """Compare a product and a chart at their own limits and at equal false readings."""
    own, its = told(product), told(chart)
    moved = told(chart, limit_of(chart, own)), told(product, limit_of(product, its))
    return dict(zip(OF, (own, its, *moved), strict=True))


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


def of_table(table: FeatureTable, learned_until_ns: int, changed_from_ns: float) -> tuple[Features, Chart]:
    """Judge a series; where nothing is put in, it is changed never."""
    is_changed = table.t_ns[table.t_ns > learned_until_ns] >= changed_from_ns
    return Features(table, learned_until_ns, is_changed), Chart(charts.of_series(table, learned_until_ns), is_changed)


def mast(data: Path | None) -> Iterator[Case]:
    """Change the last five days of a mast's three weeks; its five temperatures one by one are in the folder of downloads."""
    kinds: list[tuple[str, ...]] = [(), ("temperature",), ("temperature", "level")]
    if data is not None and (data / MAST_TEMPERATURES).exists():
        kinds.append(FIVE)
    for days, known in product((6, 9, 12, 15), kinds):
        for change, how in ((0.0, "one"), *product(CHANGES, ("all", "one"))):
            told_of = "five temperatures" if known is FIVE else " and ".join(known) or "no covariate"
            row = f"mast, {days} days learned, {told_of}: {_put_in(change, how)}"
            yield Case(row, 0, partial(_of_mast, days, known, change, how, data))


def _of_mast(days: int, known: Sequence[str], change: float, how: str, data: Path | None) -> tuple[Judge, Judge]:
    whole = tower.table()
    covariates = dict(whole.covariates) | (_five_temperatures(data, whole.t_ns) if data is not None else {})
    from_ns = int(whole.t_ns[-1] - tower.LOSS_DAYS * DAY_NS) + 1
    features = {
        name: np.where((whole.t_ns >= from_ns) & (j == 0 or how == "all"), 1.0 - change, 1.0) * values
        for j, (name, values) in enumerate(whole.features.items())
    }
    table = FeatureTable(whole.t_ns, features, {name: covariates[name] for name in known})
    return of_table(table, int(whole.t_ns[0] + days * DAY_NS), from_ns if change else math.inf)


def _five_temperatures(data: Path, t_ns: NDArray[np.int64]) -> dict[str, Array]:
    """Read the mast's five thermometers at its hours, of which the file's are more."""
    with h5py.File(data / MAST_TEMPERATURES) as file:
        begun = np.datetime64(file["time"].attrs["units"].decode().removeprefix("hours since "), "ns").astype(np.int64)
        rows = np.searchsorted(begun + HOUR_NS * file["time"][...], t_ns)
        return dict(zip(FIVE, file["mean"][...][rows].T, strict=True))


def simulated(seeds: int) -> Iterator[Case]:
    """Change simulated series, and coefficients of simulated records."""
    puts = ((0.0, "one"), *((change, "one") for change in CHANGES), (0.01, "all"), (0.02, "slow"))
    for (name, nature), (change, how) in product(series.NATURES.items(), puts):
        for seed in range(seeds if nature.hours > LONG else 5 * seeds):
            yield Case(f"simulated {name}: {_put_in(change, how)}", seed, partial(_of_nature, name, seed, change, how))
    for learned, change, seed in product((20, 60), (0.0, 0.05, 0.1), range(5 * seeds)):
        row = f"simulated AR(10) of {learned} records: {_put_in(change, 'one')}"
        yield Case(row, seed, partial(_of_coefficients, learned, seed, change))


def _of_nature(name: str, seed: int, change: float, how: str) -> tuple[Judge, Judge]:
    made = series.series(name, 1000 + seed, change, how)
    return of_table(made.table, made.learned_until_ns, made.changed_from_ns if change else math.inf)


def _of_coefficients(learned: int, seed: int, change: float) -> tuple[Judge, Judge]:
    made = series.records(2000 + seed, change, learned=learned)
    features, chart = of_table(made.table, made.learned_until_ns, made.changed_from_ns if change else math.inf)
    return features, Chart(charts.of_series(made.table, made.learned_until_ns, in_a_row=1), chart.is_changed)


def recorded(data: Path | None) -> Iterator[Case]:
    """Judge recordings: their windows by `modal` and their segments by the chart, then pairs of them."""
    there = [one for one in SETS if one.is_there(data)]
    windows = "`modal` windows of {:g} s, chart of"
    ways = [(f"{windows} segments", _of_segments), (f"{windows} windows", _of_windows), ("`compare`", _of_pairs)]
    ways += [("`compare --healthy`", partial(_of_pairs, beside_others=True))] if TAKES_HEALTHY else []
    for of, judge in ways:
        for one in there:
            for name in (*one.changes, *(_put_in(change, "all") for change in CHANGES)):
                yield Case(f"{one.name}, {of.format(one.window_s)}: {name}", 0, partial(judge, one, data, name))


@cache
def _modes(one: Recorded, data: Path | None) -> Modes:
    """Learn a set's modes once."""
    learned, healthy, _ = _pieces(one, data, _put_in(CHANGES[0], "all"))
    return Modes(Record(one.rate_hz, one.window_s, learned, healthy, []))


def _pieces(one: Recorded, data: Path | None, name: str) -> tuple[list[Array], list[Array], list[Array]]:
    """Read what is learned, what is healthy and what is changed, all resampled alike."""
    learned, healthy, changed = one.read(data)
    puts = {_put_in(change, "all"): change for change in CHANGES}
    later = [stretched(x, puts[name]) for x in healthy] if name in puts else [stretched(x) for x in changed[name]]
    return [stretched(x) for x in learned], [stretched(x) for x in healthy], later


def _of_segments(one: Recorded, data: Path | None, name: str) -> tuple[Judge, Judge]:
    learned, healthy, changed = (
        np.concatenate([one.coefficients(piece) for piece in pieces]) for pieces in _pieces(one, data, name)
    )
    chart = charts.of_segments(learned, np.concatenate([healthy, changed]))
    is_changed = np.arange(chart.statistic.size) >= len(healthy)
    return _modes(one, data).beside(_pieces(one, data, name)[2]), Chart(chart, is_changed)


def _of_windows(one: Recorded, data: Path | None, name: str) -> tuple[Judge, Judge]:
    learned, healthy, changed = _pieces(one, data, name)
    modes = _modes(one, data).beside(changed)
    segments = np.concatenate([one.coefficients(piece) for piece in learned])
    of = [
        [charts.between(segments, one.coefficients(x[part])) for x in pieces for part in modes.record.windows(len(x))]
        for pieces in (healthy, changed)
    ]
    return modes, Chart(charts.Chart(np.concatenate(of), 1), np.arange(len(of[0]) + len(of[1])) >= len(of[0]))


def _of_pairs(one: Recorded, data: Path | None, name: str, *, beside_others: bool = False) -> tuple[Judge, Judge]:
    learned, healthy, changed = _pieces(one, data, name)
    same = [*learned, *healthy]
    equal, different = list(combinations(same, 2)), list(zip(same, changed, strict=False))

    def compared(a: Array, b: Array) -> float:
        others = [x for x in same if x is not a and x is not b] if beside_others else []
        return statistic_of_pair(a, b, one.rate_hz, others)

    def tested(a: Array, b: Array) -> float:
        return charts.between(one.coefficients(a), one.coefficients(b))

    return Pairs.by(compared, equal, different), Pairs.by(tested, equal, different)


def _put_in(change: float, how: str) -> str:
    """Say what was put in."""
    of = {"one": " of the first", "all": " of all", "slow": " of the first, slowly"}[how]
    return f"-{100 * change:g} %{of}" if change else "nothing put in"


def rows(lines: Iterable[Mapping[str, Any]]) -> Iterator[str]:
    """Write the table: seeds of a row are summed, their delays are the median."""
    yield (
        "| set | false, found, delay | chart: false, found, delay | at the product's false readings: chart | at the chart's: "
        "product | level both ways, and both moved |"
    )
    yield "|---|---|---|---|---|---|"
    for row, group in groupby(lines, key=lambda line: line["row"]):
        parts = list(group)
        own, chart, chart_moved, own_moved = (summed([Told(**part[of]) for part in parts]) for of in OF)
        level = [level_with(own, chart_moved), level_with(own_moved, chart)] if own.changed else []
        if level and own.false == chart.false:
            level.append(level_with(own_moved, chart_moved))
        cells = [row, own.words(), chart.words(), chart_moved.words(), own_moved.words()]
        yield f"| {' | '.join([*cells, ', '.join('yes' if held else '**no**' for held in level) or '-'])} |"


def summed(parts: Sequence[Told]) -> Told:
    """Sum the readings of several seeds."""
    sums = {of: sum(getattr(part, of) for part in parts) for of in ("false", "healthy", "found", "changed", "unjudged")}
    return Told(**sums, delay=sorted(part.delay for part in parts)[len(parts) // 2])


def level_with(one: Told, other: Told) -> bool:
    """Tell if a product finds not fewer and not later than a chart, but for the tolerance."""
    least = other.found / other.changed - LESS_FOUND
    return one.found / one.changed >= least and one.delay <= other.delay + LATER


def main() -> None:
    """Make the rows that are not there, and print all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--data", type=Path)
    parser.add_argument("--only", default="")
    parser.add_argument("--seeds", type=int, default=2)
    given = parser.parse_args()
    cases = [*mast(given.data), *simulated(given.seeds), *recorded(given.data)]
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
