"""Judges features without waveforms: a table of times, features and covariates as text, learned on its first part."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from monitor.core import Array, BadInputError, Level, OnProgress, Step, rounded, write_atomically
from monitor.damage import (
    FALSE_ANNOUNCEMENTS_PER_YEAR,
    LAGS_H,
    FeatureJudge,
    FeatureTable,
    FeatureVerdict,
    judge_features,
)
from monitor.runs.readers import delimited, stamps
from monitor.runs.readers.base import Options, read_bytes
from monitor.runs.readers.delimited import Text
from monitor.runs.readers.dialect import CALENDAR, HEAD, MARKS, Dialect, guess, is_missing, is_number, split
from monitor.runs.readers.table import Table, without_fillers

_NAMED_LINES = 5
"""Most lines that a message names. [lines; judgement]"""
_NEAR_ZERO = 0.5
"""Smallest reading over the median one, in size, from which none is near zero. [ratio; judgement]"""
_LEARNS = "learns the features of the healthy rows"
RESULT_FILES = ("results.jsonl", "summary.json")
"""Files that are written. [names; definition]"""


def features(
    path: Path,
    options: Options,
    names: list[str],
    covariates: list[str],
    train_until_ns: int,
    out: Path,
    on_warning: Callable[[str], None] = lambda _: None,
    on_progress: OnProgress = lambda _: None,
    false_announcements_per_year: float = FALSE_ANNOUNCEMENTS_PER_YEAR,
) -> dict[str, Any]:
    """Learn the features' law from the rows up to a time, judge the later ones, and write results.jsonl and summary.json.

    The file is a table of text of any dialect with a line of column names.  The column `options.time` holds dates in any form (of
    `options.zone`, or UTC, where they name no zone) or numbers, as s since 1970, or since `options.start_ns`.

    Raises MissingInputError or BadInputError if the file cannot be read or used; the message names the place.
    """
    on_progress(Step("reads the table", then=_LEARNS))
    table = read_table(path, options, names, covariates, on_warning)
    on_progress(Step(_LEARNS, then="judges the rows"))
    try:
        judge, verdicts = judge_features(table, train_until_ns, on_progress, false_announcements_per_year)
    except BadInputError as error:
        raise BadInputError(f"{path}: {error}: choose a later --train-until, or leave the feature out") from error
    if not verdicts:
        raise BadInputError(f"{path}: no row is later than --train-until: nothing to judge")
    out.mkdir(parents=True, exist_ok=True)
    write_atomically(out / "results.jsonl", "".join(json.dumps(_line(v), allow_nan=False) + "\n" for v in verdicts))
    summary = _summary(judge, verdicts)
    write_atomically(out / "summary.json", json.dumps(summary, indent=1, allow_nan=False) + "\n")
    return summary


def read_table(
    path: Path, options: Options, names: list[str], covariates: list[str], on_warning: Callable[[str], None]
) -> FeatureTable:
    """Read the columns of a table; rows that cannot be read are left out and named (errors as of `features`)."""
    assert options.time is not None
    wanted = [options.time, *names, *covariates]
    text = _read_rows(path, wanted, on_warning)
    all_ns = delimited.times_in(text, 0, on_warning, options.zone)
    if options.start_ns is not None:
        all_ns = all_ns + (options.start_ns - all_ns[0])
    if (np.diff(all_ns) < 0).any():
        on_warning(f"{path}: the times do not increase: the rows were sorted")
    t_ns, first = np.unique(all_ns, return_index=True)
    if t_ns.size < all_ns.size:
        on_warning(f"{path}: {all_ns.size - t_ns.size} rows repeat a time: of each the first was kept")
    read = Table(path, tuple(wanted[1:]), (), text.values(range(1, len(wanted)), on_warning))
    values = dict(zip(read.columns, without_fillers(read, on_warning).values[first].T, strict=True))
    for name, column in values.items():
        _doubt_zeros(path, name, column, on_warning)
    return FeatureTable(t_ns, {n: values[n] for n in names}, {n: values[n] for n in covariates})


def _read_rows(path: Path, wanted: list[str], on_warning: Callable[[str], None]) -> Text:
    """Read the rows that can be read, as a table of the wanted columns alone."""
    lines = delimited.lines_of(delimited.decode(path, read_bytes(path)))
    at, delimiter, header = _heading(lines, wanted)
    if absent := [name for name in wanted if name not in header]:
        raise BadInputError(f"{path}: no column {', '.join(absent)}; the columns are {', '.join(header)}")
    if twice := sorted({name for name in wanted if header.count(name) > 1 or wanted.count(name) > 1}):
        raise BadInputError(f"{path}: column {', '.join(twice)} stands or is named twice: give each its own name")
    columns = [header.index(name) for name in wanted]
    rows: dict[int, list[str]] = {}
    bad: dict[int, str] = {}
    for number, line in enumerate(lines[at + 1 :], at + 2):
        cells = split(line, delimiter)
        if not any(cells):
            continue
        if len(cells) < len(header) or any(cells[len(header) :]):
            bad[number] = f"{len(cells)} fields of {len(header)}"
        else:
            rows[number] = [cells[column] for column in columns]
    if not rows:
        raise BadInputError(f"{path}: no row can be read")
    dialect = guess(path, ["\t".join(cells) for cells in (wanted, *rows.values())], wanted[0], ("\t",))
    bad |= {number: reason for number, cells in rows.items() if (reason := _unreadable(cells, dialect))}
    if bad:
        named = "; ".join(f"line {number}: {bad[number]}" for number in sorted(bad)[:_NAMED_LINES])
        more = f" and {len(bad) - _NAMED_LINES} more" if len(bad) > _NAMED_LINES else ""
        on_warning(f"{path}: left out {named}{more}")
    good = [number for number in rows if number not in bad]
    if not good:
        raise BadInputError(f"{path}: no row can be read")
    return Text(path, ["\t".join(rows[number]) for number in good], good, dialect, ())


def _heading(lines: list[str], wanted: list[str]) -> tuple[int, str | None, list[str]]:
    """Find the line, and the mark between its cells, that names most of the wanted columns, the most cells among those."""
    cut = ((at, mark, split(line.lstrip("#%! "), mark)) for at, line in enumerate(lines[:HEAD]) for mark in MARKS)
    return max(cut, key=lambda one: (len({*wanted} & {*one[2]}), -one[0], len(one[2])))


def _unreadable(cells: list[str], dialect: Dialect) -> str:
    """Return why a row of the wanted columns cannot be read; empty where it can."""
    time, *others = cells
    is_time = stamps.is_time if dialect.columns[0].role in CALENDAR else is_number
    if not is_time(time):
        return f"{time!r} is no time"
    return next((f"{cell!r} is no number" for cell in others if not (is_missing(cell) or is_number(cell))), "")


def _doubt_zeros(path: Path, name: str, values: Annotated[Array, "n"], on_warning: Callable[[str], None]) -> None:
    """Tell of readings of exactly 0 where no other is near it: some programs write it for none."""
    zero = values == 0.0
    others = np.abs(values[~zero & np.isfinite(values)])
    if 0 < np.count_nonzero(zero) < others.size and others.min() > _NEAR_ZERO * np.median(others):
        on_warning(
            f"{path}: {name}: {np.count_nonzero(zero)} readings are exactly 0, and no other is near it: if they stand for "
            "none, leave the cells empty"
        )


def _line(verdict: FeatureVerdict) -> dict[str, Any]:
    return {
        "t_end_ns": verdict.t_ns,
        "time": f"{np.datetime64(verdict.t_ns, 'ns').astype('datetime64[s]')}Z",
        "residual_sigma": rounded(list(verdict.residual_sigma), 6),
        "alarm": {"level": verdict.level.value, "features": list(verdict.changed), "reason": verdict.reason},
        "years": rounded(verdict.years, 4),
        "skipped": verdict.skipped and verdict.skipped.reason,
    }


def _summary(judge: FeatureJudge, verdicts: list[FeatureVerdict]) -> dict[str, Any]:
    learned = [
        {
            "feature": model.name,
            "relative": model.log,
            "readings": model.readings,
            "residual_std": rounded(model.std, 6),
            "variance_explained": rounded(model.explained, 4),
            "covariates": {
                c.name: {"range": list(c.range), "lag_s": 3600.0 * LAGS_H[c.lag]} for c in model.basis.covariates
            },
            "confounded": [[a, b, round(r, 3)] for a, b, r in model.confounded()],
        }
        for model in judge.models
    ]
    episodes = _episodes(verdicts)
    skipped = sum(v.skipped is not None for v in verdicts)
    last = verdicts[-1]
    state = "not_judged" if skipped == len(verdicts) else last.level.value
    headline = {
        "not_judged": "No feature could be judged.",
        "normal": f"No change of {', '.join(m.name for m in judge.models)} beyond what the covariates explain.",
    }.get(state, f"{state.upper()}: {last.reason}")
    return {
        "state": state,
        "headline": headline,
        "windows": len(verdicts),
        "judged": len(verdicts) - skipped,
        "skipped": skipped,
        "announced": sum(v.level is not Level.NORMAL for v in verdicts),
        "alarms": episodes,
        "features": learned,
    }


def _episodes(verdicts: list[FeatureVerdict]) -> list[dict[str, Any]]:
    """List the announcements, each by its highest level and what was said of it last."""
    episodes: list[dict[str, Any]] = []
    is_open = False
    for verdict in verdicts:
        if verdict.level is Level.NORMAL:
            if is_open:
                episodes[-1]["t_last_ns"] = verdict.t_ns
            is_open = False
            continue
        if not is_open:
            episodes.append({"level": verdict.level.value, "t_first_ns": verdict.t_ns, "t_last_ns": None})
        highest = max(Level(episodes[-1]["level"]), verdict.level, key=lambda level: level.rank)
        episodes[-1]["level"] = highest.value
        if verdict.skipped is None:
            episodes[-1] |= {"features": list(verdict.changed), "reason": verdict.reason}
        is_open = True
    return episodes
