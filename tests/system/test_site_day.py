"""A day with everything wrong at once: half an hour of data, and the whole; both with `make test-slow`, for they watch clocks."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.system.site_day import Report, live_through

pytestmark = pytest.mark.system


def check(report: Report) -> None:
    """Nothing is lost but in the spans in which the docs allow it, the process stays as it is, and it ends in time."""
    assert report.counts.get("kill") or report.counts.get("end"), report
    assert not report.unlike, report
    assert report.judged > 0.5 * report.windows > 0, report
    assert max(report.ends_s) < 15.0, (
        report
    )  # 5 s are promised, by the daemon's clock; here it is one of a dozen busy threads
    assert report.messages > 0, report
    assert not report.strange_rows, report
    growth = report.growth()
    assert growth["threads"] <= 8 and growth["handles"] <= 120 and growth["memory_mb"] < 150.0, growth


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_half_an_hour_with_everything_wrong_at_once(tmp_path: Path) -> None:
    check(live_through(tmp_path, 0.5, 15.0, 3))


@pytest.mark.slow
@pytest.mark.timeout(14400)
def test_a_day_with_everything_wrong_at_once(tmp_path: Path) -> None:
    check(live_through(tmp_path, 24.0, 15.0, 4))
