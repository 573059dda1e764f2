"""The pages draw in a real browser: no blank, no error on the console."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from monitor.publish.period import read_period, write_period
from tests.debian import demand
from tests.test_period import json_lines, line_of

ROOT = Path(__file__).parents[1]


def shot(page: str, picture: Path, seconds: float = 1.0) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(ROOT / "docs/browser.py"), page, str(picture), str(seconds)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)


@pytest.fixture(scope="module", autouse=True)
def _chromium() -> None:
    demand("chromium")


def test_the_period_report_draws(tmp_path: Path) -> None:
    json_lines(tmp_path / "results.jsonl", [line_of(k) for k in range(9_900, 10_150)])
    (tmp_path / "summary.json").write_text(json.dumps({"alarms": []}))
    write_period(tmp_path / "r.html", read_period(tmp_path, None, None))
    done = shot(str(tmp_path / "r.html"), tmp_path / "r.png")
    assert (done.returncode, done.stderr) == (0, "")
    picture = np.asarray(Image.open(tmp_path / "r.png").convert("RGB")).astype(int)
    assert picture.shape[0] > 1200, "the whole page, not its first screen"
    red, _, blue = np.moveaxis(picture, 2, 0)
    assert (blue - red > 60).sum() > 2000, "curves and their bands"
    assert (red - blue > 30).sum() > 2000, "the alarm"
    dark = (picture.max(axis=2) < 130).mean(axis=1)
    bands = np.array_split(dark, picture.shape[0] // 200)
    assert min(b.max() for b in bands) > 0.01, "no blank band"


def test_an_error_of_a_page_is_told(tmp_path: Path) -> None:
    page = tmp_path / "bad.html"
    page.write_text("<!DOCTYPE html><title>x</title><p>x<script>nowhere.at.all()</script>")
    done = shot(str(page), tmp_path / "x.png")
    assert done.returncode == 1
    assert "nowhere is not defined" in done.stderr
