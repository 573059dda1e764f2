"""The page of ten thousand sites in a real browser: light, drawn row by row, filtered and sorted."""

from __future__ import annotations

from pathlib import Path

import pytest

from monitor.damage import State
from monitor.service import fleet, fleet_page
from tests.support.browser import browser_tool
from tests.support.debian import demand

pytestmark = pytest.mark.system


def sites(count: int) -> list[fleet.SiteStatus]:
    found = [
        fleet.SiteStatus(f"bridge-{k:05d}", State.NORMAL, "Nothing.", ddi=1e-6 * k, t_end_ns=10**18)
        for k in range(count)
    ]
    found[7] = fleet.SiteStatus("a </script><b>", State.ALARM, "Story 2 lost <i>20</i> %.", troubles=("no data",))
    return sorted(found, key=lambda site: (-site.state.rank, site.site))


def test_ten_thousand_sites_are_filtered_and_sorted(tmp_path: Path) -> None:
    demand("chromium")
    file = tmp_path / "fleet.html"
    file.write_text(fleet_page(sites(10_000), "Fleet", 10**18))
    assert file.stat().st_size < 2e6
    with browser_tool().browser(1140, 800) as shown:
        shown.call("Page.navigate", url=file.as_uri())
        for _ in range(600):
            shown.wait(0.1)
            if shown.value("document.querySelectorAll('#space .row').length"):
                break
        first = "document.querySelector('#space .row').innerText"
        assert shown.value("document.querySelectorAll('#space .row').length") < 100  # those in view alone
        assert "a </script><b>" in shown.value(first) and "<i>20</i> %. no data." in shown.value(first)
        assert "10000 of 10000" in shown.value("document.getElementById('count').textContent")
        shown.value("document.querySelector('#head button[data-by=\"2\"]').click()")
        assert "bridge-09999" in shown.value(first)
        shown.value(
            "(() => { const f = document.getElementById('find'); f.value = 'ALARM'; f.oninput({target: f}); })()"
        )
        assert "1 of 10000" in shown.value("document.getElementById('count').textContent")
        shown.call("Emulation.setDeviceMetricsOverride", width=390, height=800, deviceScaleFactor=1, mobile=True)
        assert shown.value("document.documentElement.scrollWidth") <= 390
        assert not shown.errors
