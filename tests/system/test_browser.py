"""The pages draw in a real browser: no blank, no error on the console."""

from __future__ import annotations

import base64
import json
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from monitor.core import Level
from monitor.publish import EventPage, RerunPublisher, read_period, write_event, write_period, write_report
from tests.diagnosis.searched import LOSS, searched
from tests.publish import event_pages
from tests.publish.viewer_results import SCENE, window
from tests.support.browser import ROOT, browser_tool
from tests.support.debian import demand
from tests.support.period_lines import json_lines, line_of

pytestmark = pytest.mark.system


def shot(place: str, picture: Path, seconds: float = 1.0) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(ROOT / "docs/browser.py"), place, str(picture), str(seconds)]
    return subprocess.run(command, capture_output=True, text=True, timeout=240, check=False)


@pytest.fixture(scope="module", autouse=True)
def page() -> Iterator[Any]:
    """A page of the browser."""
    demand("chromium")
    with browser_tool().browser(1140, 1000) as shown:
        yield shown


def write_period_report(folder: Path) -> None:
    """Windows with an alarm, its diagnosis, and every table."""
    json_lines(folder / "results.jsonl", [line_of(k) for k in range(9_900, 10_150)])
    (folder / "findings").mkdir()
    t_ns = int(str(line_of(10_010)["t_end_ns"]))
    finding = {"id": "001", "t_ns": t_ns, "from_ns": t_ns, "reason": "warning", "verdict": "named", "says": "Softer."}
    json_lines(folder / "findings/001.json", [finding])
    channel = {"rms_m_s2": 3.0, "spikes": 0, "stuck_s": 0.0, "clipped_samples": 0}
    channels = {"accelerometer on the roof, north-east corner": channel}
    quality = {"availability": 1.0, "gaps": 1, "lost_s": 0.2, "overlaps": 0, "channels": channels}
    (folder / "summary.json").write_text(json.dumps({"alarms": [], "quality": quality}))
    write_period(folder / "r.html", read_period(folder, None, None))


def write_diagnosis_report(folder: Path) -> None:
    case = searched((LOSS,), (LOSS, "added_mass:floor 3:mass_kg=0.01"), "named", causes=1)
    write_report(folder / "r.html", case.diagnosis, case.content, case.segments)


def write_event_report(folder: Path) -> None:
    (folder / "r.html").write_text(event_pages.page(*event_pages.told()).html)


@pytest.mark.parametrize("write", [write_period_report, write_diagnosis_report, write_event_report])
def test_a_report_is_read_on_a_telephone_without_scrolling_sideways(
    write: Callable[[Path], None], tmp_path: Path, page: Any
) -> None:
    """At 390 px nothing reaches beyond the edge, no text is below 11 px, and no labels of an axis overlap."""
    write(tmp_path)
    smallest = """Math.min(...[...document.querySelectorAll('body *')].filter(e => e.offsetParent).map(e =>
      parseFloat(getComputedStyle(e).fontSize)))"""
    ticks = """Math.min(...plots.map(p => Math.max(p.axes[0]._splits?.length ?? 0, p.axes[1]._splits?.length ?? 0)))"""
    empty = """[...document.querySelectorAll('canvas')].filter(c => { const d = c.getContext('2d').getImageData(
      0, 0, c.width, c.height).data; return d.every((v, i) => i < 4 || v === d[i % 4]); }).length"""
    for width in (390, 1280):
        size = {"width": width, "height": 800, "deviceScaleFactor": 1, "mobile": width < 500}
        page.call("Emulation.setDeviceMetricsOverride", **size)
        page.call("Page.navigate", url=(tmp_path / "r.html").as_uri())
        for _ in range(300):
            page.wait(0.1)
            if page.value("document.readyState") == "complete":
                break
        assert page.value("document.documentElement.scrollWidth") <= width
        assert page.value(smallest) >= 11.0
        assert page.value("document.querySelectorAll('figure canvas').length") >= 5
        assert page.value(empty) == 0, "no chart is blank"
        assert page.value(ticks) >= 3 or width < 400
    assert page.errors == []


def test_times_beside_a_shortened_gap_do_not_overlap_and_log_axes_have_ticks(tmp_path: Path, page: Any) -> None:
    write_period_report(tmp_path)
    page.show((tmp_path / "r.html").as_uri(), 1.0)
    for end, begin in ((0.37, 0.43), (0.64, 0.7), (0.5, 0.56)):
        stretches = f"[[0, 40000, 0, {end}], [2600000, 2640000, {begin}, 1]]"
        places = np.array(page.value(f"timeTicks({stretches}, 270).map(t => 270 * t[0])"))
        assert len(places) >= 2 and np.diff(places).min() >= 65.0, "the width of a date"
    assert page.value("timeTicks([[60, 100, 0, 1]], 200).map(t => t[1]).join()").split() == [
        "00:01:00",
        "1970-01-01,00:01:30",
    ]
    assert page.value("decades(0.004, 120)") == [0.01, 0.1, 1, 10, 100]
    assert 1.0 in page.value("decades(0.7, 1.5)") and len(page.value("decades(0.7, 1.5)")) >= 3
    assert page.errors == []


def test_paper_shows_the_charts_and_no_controls(tmp_path: Path, page: Any) -> None:
    write_period_report(tmp_path)
    page.call("Emulation.setDeviceMetricsOverride", width=1280, height=800, deviceScaleFactor=1, mobile=False)
    page.show((tmp_path / "r.html").as_uri(), 1.0)
    printed = base64.b64decode(page.call("Page.printToPDF", preferCSSPageSize=True)["data"])
    assert 1 < printed.count(b"/Type /Page\n") < 9 and len(printed) > 30_000
    page.value("dispatchEvent(new Event('beforeprint'))")
    page.wait(0.3)
    widest = page.value(
        "Math.max(...[...document.querySelectorAll('canvas')].map(c => c.getBoundingClientRect().right))"
    )
    assert 300 < widest <= 690, "the width of A4 within its margins"
    assert page.errors == []


def test_an_unbroken_name_of_a_hundred_letters_widens_no_page(tmp_path: Path, page: Any) -> None:
    """The site's, a story's, a channel's: at 390 px and 1280 px nothing reaches beyond the edge."""
    name = "n" * 100
    event, site, seen = event_pages.told()
    event = replace(event, floors=tuple(replace(floor, channel=name) for floor in event.floors))
    site = replace(site, names=(name,) * len(site.names), channels=(name,) * len(site.channels))
    seen = replace(seen, channels=(name,) * len(seen.channels))
    write_event(tmp_path / "event.html", EventPage(name, event, f"{name}.mcap", "ab" * 32, site, seen))
    folder = tmp_path / name
    folder.mkdir()
    lines = [line_of(k) for k in range(9_900, 10_150)]
    json_lines(folder / "results.jsonl", lines)
    channel = {"rms_m_s2": 3.0, "spikes": 0, "stuck_s": 0.0, "clipped_samples": 0}
    quality = {"availability": 1.0, "gaps": 1, "lost_s": 0.2, "overlaps": 0, "channels": {name: channel}}
    known = {"names": [name] * 3, "has_baseline": True, "alarm_loss": 0.1, "misfit": 5.0, "channels": [name]}
    (folder / "summary.json").write_text(json.dumps({"alarms": [], "quality": quality, "known": known}))
    write_period(tmp_path / "period.html", read_period(folder, None, None))
    for width in (390, 1280):
        size = {"width": width, "height": 800, "deviceScaleFactor": 1, "mobile": width < 500}
        page.call("Emulation.setDeviceMetricsOverride", **size)
        for file in ("event.html", "period.html"):
            page.call("Page.navigate", url=(tmp_path / file).as_uri())
            for _ in range(300):
                page.wait(0.1)
                if page.value("document.readyState") == "complete":
                    break
            assert page.value("document.body.textContent.includes('nnnnnnnnnn')")
            assert page.value("document.documentElement.scrollWidth") <= width, (file, width)


def test_the_period_report_draws(tmp_path: Path) -> None:
    write_period_report(tmp_path)
    done = shot(str(tmp_path / "r.html"), tmp_path / "r.png")
    assert (done.returncode, done.stderr) == (0, "")
    picture = np.asarray(Image.open(tmp_path / "r.png").convert("RGB")).astype(int)
    assert picture.shape[0] > 1200, "the whole page, not its first screen"
    red, _, blue = np.moveaxis(picture, 2, 0)
    assert (blue - red > 60).sum() > 2000, "curves and their bands"
    assert (red - blue > 30).sum() > 2000, "the alarm"
    ink = (np.abs(picture - np.median(picture, axis=1, keepdims=True)).max(axis=2) > 60).mean(axis=1)
    bands = np.array_split(ink, picture.shape[0] // 200)
    assert min(b.max() for b in bands) > 0.01, "no blank band"


def test_an_error_of_a_page_is_told(tmp_path: Path) -> None:
    bad = tmp_path / "bad.html"
    bad.write_text("<!DOCTYPE html><title>x</title><p>x<script>nowhere.at.all()</script>")
    done = shot(str(bad), tmp_path / "x.png")
    assert done.returncode == 1
    assert "nowhere is not defined" in done.stderr


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_the_viewer_draws_in_a_browser(tmp_path: Path) -> None:
    """`view --web`: sound stories green, the lost one red, on the dark ground of the panel with the structure."""
    publisher = RerunPublisher(SCENE, file=tmp_path / "live.rrd", serve=None, lossless=True)
    for k in range(20):
        result = window(k, Level.ALARM)
        assert result.damage is not None
        damage = replace(result.damage, loss=np.array([0.0, 0.15, 0.0]))
        publisher.window(replace(result, damage=damage, detectable_loss=np.full(3, 0.02)), "")
    publisher.close(60.0)
    command = [sys.executable, "-m", "monitor", "view", str(tmp_path), "--web", "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT) as server:
        try:
            address = server.stdout.readline().strip()
            with browser_tool().browser(1600, 1000) as page:
                page.call("Page.navigate", url=f"{address}&renderer=webgl")
                sound = lost = 0
                for _ in range(60):  # software rendering on a busy machine takes minutes
                    page.wait(10.0)
                    (tmp_path / "web.png").write_bytes(page.picture())
                    picture = np.asarray(Image.open(tmp_path / "web.png").convert("RGB")).astype(int)
                    red, green, blue = np.moveaxis(picture[300:660, :640], 2, 0)
                    sound = int(((green - red > 60) & (green - blue > 40)).sum())
                    lost = int(((red - green > 100) & (red - blue > 100)).sum())
                    if min(sound, lost) > 500:
                        break
                own = [e for e in page.errors if "ERR_NAME_NOT_RESOLVED" not in e and "Failed to fetch" not in e]
        finally:
            server.send_signal(signal.SIGINT)
            server.wait(20)
    assert min(sound, lost) > 500, (sound, lost)
    assert own == []
