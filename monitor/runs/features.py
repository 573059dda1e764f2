"""Judges features without waveforms: a table of times, features and covariates as text, learned on its first part."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from monitor.core import Array, BadInputError, Level, OnProgress, Step, WindowResult, rounded
from monitor.damage import (
    FALSE_ANNOUNCEMENTS_PER_YEAR,
    LAGS_H,
    TOGETHER,
    AlarmSettings,
    FeatureJudge,
    FeatureModel,
    FeatureTable,
    Known,
    LearnedRange,
    assess,
    judge_features,
)
from monitor.publish import Summary, facts_of_line, feature_scene, to_json, window_line
from monitor.runs.readers import formats
from monitor.runs.readers.base import File, Limits, Options, read_bytes
from monitor.runs.readers.table import Table
from monitor.runs.replay import ResultFiles
from monitor.runs.viewer import close_view, open_view

_NEAR_ZERO = 0.5
"""Smallest reading over the median one, in size, from which none is near zero. [ratio; judgement]"""
_LEARNS = "learns the features of the healthy rows"


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
    """Learn the features' law from the rows up to a time, judge the later ones, and write the files of a replay.

    The file is of any format that `import` reads, with names of its columns.  The column `options.time` holds dates in any form
    (of `options.zone`, or UTC, where they name no zone) or numbers, as s since 1970, or since `options.start_ns`.

    Raises MissingInputError or BadInputError if the file cannot be read or used; the message names the place.
    """
    on_progress(Step("reads the table", then=_LEARNS))
    table = read_table(path, options, names, covariates, on_warning)
    on_progress(Step(_LEARNS, then="judges the rows"))
    try:
        judge, results = judge_features(table, train_until_ns, on_progress, false_announcements_per_year)
    except BadInputError as error:
        raise BadInputError(f"{path}: {error}: choose a later --train-until, or leave the feature out") from error
    if not results:
        raise BadInputError(f"{path}: no row is later than --train-until: nothing to judge")
    return _publish(path, judge, results, out, false_announcements_per_year, on_warning)


def _publish(
    path: Path,
    judge: FeatureJudge,
    results: Sequence[WindowResult],
    out: Path,
    per_year: float,
    on_warning: Callable[[str], None],
) -> dict[str, Any]:
    """Write the results as those of a replay, and return the content of summary.json."""
    known, learned = _known(judge), {c.name: LearnedRange("", *c.range) for c in judge.models[0].basis.covariates}
    begun, summary, written = time.monotonic(), Summary(), ResultFiles(out)
    scene = feature_scene(path.name, judge.parts, learned)
    view = open_view(scene, file=out / "live.rrd", on_warning=on_warning)
    try:
        for result in results:
            line = window_line(result)
            summary.window(result, facts_of_line(line), known)
            written.window(result, to_json(line))
            if view is not None:
                view.state(assess(summary.course, known))
                view.window(result, "")
        data_s = (results[-1].t_end_ns - results[0].t_end_ns) * 1e-9
        content = summary.content(data_s / max(time.monotonic() - begun, 1e-9), [])
        content = {
            **assess(summary.course, known, whole=True).content,
            **content,
            "judged": content["windows"] - content["skipped"],
            "announced": sum(r.alarm.level is not Level.NORMAL for r in results),
            "known": asdict(known),
            "covariates_learned": {name: of._asdict() for name, of in learned.items()},
            "thresholds": {"false_announcements_per_year": per_year},
            "features": [_learned(model) for model in judge.models],
        }
        written.close(content, [])
    except BaseException:
        written.abandon()
        if view is not None:
            view.abort()
        raise
    close_view(view, out / "live.rrd", on_warning)
    return content


def read_table(
    path: Path, options: Options, names: list[str], covariates: list[str], on_warning: Callable[[str], None]
) -> FeatureTable:
    """Read the columns of a table; rows that cannot be read are left out and named (errors as of `features`)."""
    assert options.time is not None
    wanted = (options.time, *names, *covariates)
    read = _table_with(formats.read(File(path, read_bytes(path), options, Limits(), on_warning, wanted=wanted)), wanted)
    start_ns = read.start_ns if options.start_ns is None else options.start_ns
    all_ns = read.clock_ns if start_ns is None else read.clock_ns + (start_ns - read.clock_ns[0])
    if (np.diff(all_ns) < 0).any():
        on_warning(f"{path}: the times do not increase: the rows were sorted")
    t_ns, first = np.unique(all_ns, return_index=True)
    if t_ns.size < all_ns.size:
        on_warning(f"{path}: {all_ns.size - t_ns.size} rows repeat a time: of each the first was kept")
    values = dict(zip(read.columns, read.values[first].T, strict=True))
    for name in wanted[1:]:
        _doubt_zeros(path, name, values[name], on_warning)
    return FeatureTable(t_ns, {n: values[n] for n in names}, {n: values[n] for n in covariates})


def _table_with(tables: Sequence[Table], wanted: Sequence[str]) -> Table:
    """Find the table that has times and the wanted columns, but for that of the times, which a reader may have taken as such."""
    for table in tables:
        if table.time_ns is not None and {*wanted[1:]} <= {*table.columns}:
            return table
    known = [name for table in tables for name in table.columns]
    absent = [name for name in wanted[1:] if name not in known] or ["of times beside the others"]
    raise BadInputError(f"{tables[0].path}: no column {', '.join(absent)}; the columns are {', '.join(known)}")


def _doubt_zeros(path: Path, name: str, values: Annotated[Array, "n"], on_warning: Callable[[str], None]) -> None:
    """Tell of readings of exactly 0 where no other is near it: some programs write it for none."""
    zero = values == 0.0
    others = np.abs(values[~zero & np.isfinite(values)])
    if 0 < np.count_nonzero(zero) < others.size and others.min() > _NEAR_ZERO * np.median(others):
        on_warning(
            f"{path}: {name}: {np.count_nonzero(zero)} readings are exactly 0, and no other is near it: if they stand for "
            "none, leave the cells empty"
        )


def _known(judge: FeatureJudge) -> Known:
    """Collect what the state depends on and no reading changes."""
    parts = judge.parts
    return Known(
        names=(*parts.features, TOGETHER),
        has_baseline=True,
        alarm_loss=AlarmSettings().alarm_loss,
        misfit=1.0,
        n_modes=len(parts.features),
        relative=parts.relative,
    )


def _learned(model: FeatureModel) -> dict[str, Any]:
    """Collect what was learned of a feature."""
    return {
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
