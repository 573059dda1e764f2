"""Judges features without waveforms: a table of times, features and covariates as text, learned on its first part."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from monitor.core import BadInputError, Level, OnProgress, Step, os_errors_of, rounded, utc_ns, write_atomically
from monitor.damage import FeatureJudge, FeatureTable, FeatureVerdict, judge_features

_MISSING = {"", "nan", "na", "n/a", "null", "none", "-", "--"}
"""Texts, in lower case, of a value that is missing. [words; convention]"""
_NAMED_LINES = 5
"""Most lines that a message names. [lines; judgement]"""
_LEARNS = "learns the features of the healthy rows"
RESULT_FILES = ("results.jsonl", "summary.json")
"""Files that are written. [names; definition]"""


def features(
    path: Path,
    time: str,
    names: list[str],
    covariates: list[str],
    train_until_ns: int,
    out: Path,
    on_warning: Callable[[str], None] = lambda _: None,
    on_progress: OnProgress = lambda _: None,
) -> dict[str, Any]:
    """Learn the features' law from the rows up to a time, judge the later ones, and write results.jsonl and summary.json.

    The file has a line of column names, separated by commas, semicolons or tabs; an empty field is a missing value.  The column
    `time` is in ISO 8601 (UTC where it names no zone), or in s since 1970.

    Raises MissingInputError or BadInputError if the file cannot be read or used; the message names the place.
    """
    on_progress(Step("reads the table", then=_LEARNS))
    table = read_table(path, time, names, covariates, on_warning)
    on_progress(Step(_LEARNS, then="judges the rows"))
    try:
        judge, verdicts = judge_features(table, train_until_ns, on_progress)
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
    path: Path, time: str, names: list[str], covariates: list[str], on_warning: Callable[[str], None]
) -> FeatureTable:
    """Read the columns of a table; rows that cannot be read are left out and named (errors as of `features`)."""
    wanted = [time, *names, *covariates]
    rows, bad = _read_columns(path, wanted)
    if bad:
        more = f" and {len(bad) - _NAMED_LINES} more" if len(bad) > _NAMED_LINES else ""
        on_warning(f"{path}: left out {'; '.join(bad[:_NAMED_LINES])}{more}")
    if not rows:
        raise BadInputError(f"{path}: no row can be read")
    if any(a[0] > b[0] for a, b in pairwise(rows)):
        on_warning(f"{path}: the times do not increase: the rows were sorted")
    t_ns, first = np.unique(np.array([t for t, _ in rows], dtype=np.int64), return_index=True)
    if t_ns.size < len(rows):
        on_warning(f"{path}: {len(rows) - t_ns.size} rows repeat a time: of each the first was kept")
    values = np.array([v for _, v in rows]).reshape(len(rows), -1)[first].T
    columns = dict(zip(wanted[1:], values, strict=True))
    return FeatureTable(t_ns, {n: columns[n] for n in names}, {n: columns[n] for n in covariates})


def _read_columns(path: Path, wanted: list[str]) -> tuple[list[tuple[int, list[float]]], list[str]]:
    """Read the time and the other wanted columns of a file, row by row, and the reason for each row that is left out."""
    try:
        with os_errors_of(path):
            text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise BadInputError(f"{path}: not UTF-8 text: save the table as CSV in UTF-8") from error
    head = text.split("\n", 1)[0]
    separator = max(";\t,", key=head.count)
    reader = csv.reader(io.StringIO(text), delimiter=separator)
    try:
        header = [field.strip() for field in next(reader, [])]
        if absent := [name for name in wanted if name not in header]:
            raise BadInputError(f"{path}: no column {', '.join(absent)}; the columns are {', '.join(header)}")
        if twice := sorted({name for name in wanted if header.count(name) > 1 or wanted.count(name) > 1}):
            raise BadInputError(f"{path}: column {', '.join(twice)} stands or is named twice: give each its own name")
        return _rows(reader, [header.index(name) for name in wanted], len(header), decimal_comma=separator == ";")
    except csv.Error as error:
        raise BadInputError(f"{path}: line {reader.line_num}: {error}") from error


def _rows(
    reader: Any, columns: list[int], width: int, *, decimal_comma: bool
) -> tuple[list[tuple[int, list[float]]], list[str]]:
    """Parse the rows; return time and values of each, and the reason for each row that was left out."""
    rows, bad = [], []
    for fields in reader:
        if not any(field.strip() for field in fields):
            continue
        if len(fields) != width:
            bad.append(f"line {reader.line_num}: {len(fields)} fields of {width}")
            continue
        texts = [fields[c].strip() for c in columns]
        try:
            rows.append((_time_ns(texts[0]), [_number(text, decimal_comma) for text in texts[1:]]))
        except ValueError as error:
            bad.append(f"line {reader.line_num}: {error}")
    return rows, bad


def _time_ns(text: str) -> int:
    """Parse a time: s since 1970, or ISO 8601."""
    try:
        seconds = float(text)
    except ValueError:
        return utc_ns(text.replace("/", "-"))
    if not np.isfinite(seconds) or abs(seconds) > 9e9:
        raise ValueError(f"{text!r} is no time in s since 1970")
    return round(seconds * 1e9)


def _number(text: str, decimal_comma: bool) -> float:
    """Parse a number; a missing one is NaN."""
    if text.lower() in _MISSING:
        return float("nan")
    try:
        value = float(text.replace(",", ".") if decimal_comma else text)
    except ValueError:
        raise ValueError(f"{text!r} is no number") from None
    return value if np.isfinite(value) else float("nan")


def _line(verdict: FeatureVerdict) -> dict[str, Any]:
    return {
        "t_end_ns": verdict.t_ns,
        "residual_sigma": rounded(list(verdict.residual_sigma), 6),
        "alarm": {"level": verdict.level.value, "features": list(verdict.changed), "reason": verdict.reason},
        "skipped": verdict.skipped and verdict.skipped.reason,
    }


def _summary(judge: FeatureJudge, verdicts: list[FeatureVerdict]) -> dict[str, Any]:
    learned = []
    for model in judge.models:
        axes = () if model.law is None else model.law.axes
        learned.append(
            {
                "feature": model.name,
                "relative": model.log,
                "readings": model.readings,
                "residual_std": rounded(model.std, 6),
                "variance_explained": rounded(model.explained, 4),
                "covariates": {a.name: {"range": list(a.range), "lag_s": a.lag_s} for a in axes},
                "confounded": [] if model.law is None else [[a, b, round(r, 3)] for a, b, r in model.law.confounded()],
            }
        )
    announced = [v for v in verdicts if v.level is not Level.NORMAL]
    begun = [
        v
        for before, v in zip([None, *verdicts], verdicts, strict=False)
        if v.level is not Level.NORMAL and (before is None or before.level is Level.NORMAL)
    ]
    return {
        "judged": sum(v.skipped is None for v in verdicts),
        "skipped": sum(v.skipped is not None for v in verdicts),
        "announced": len(announced),
        "alarms": [{"t_ns": v.t_ns, "features": list(v.changed), "reason": v.reason} for v in begun],
        "together": None if judge.together is None else {"stretches": round(judge.together.expected.stretches, 1)},
        "features": learned,
    }
