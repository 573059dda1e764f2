"""The documentation as a site: built strictly, whole, and without anything of another host."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest

from tests.support.commands import ended

ROOT = Path(__file__).parents[2]


@pytest.mark.docs
@pytest.mark.timeout(600)
def test_the_site_is_built_strictly_and_needs_no_other_host(tmp_path: Path) -> None:
    """Every page is there, links and anchors hold (a warning would be an error), scripts, styles and fonts are its own."""
    places = f"{ROOT}:{ROOT / 'monitor/api/installed'}"
    done = ended(sys.executable, ROOT / "docs/site_builder.py", tmp_path / "site", PYTHONPATH=places)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    site = tmp_path / "site"
    for page in (ROOT / "docs").rglob("*.md"):
        made = site / page.relative_to(ROOT / "docs").with_suffix(".html")
        made = {"README": made.with_name("index.html"), "index": site / "map.html"}.get(page.stem, made)
        assert made.is_file(), page
    for notebook in (ROOT / "docs/notebooks").glob("*.ipynb"):
        assert (site / "notebooks" / f"{notebook.stem}.html").is_file()
    assert "Identify the modes of samples" in (site / "api.html").read_text(encoding="utf-8")
    for page in site.rglob("*.html"):
        text = page.read_text(encoding="utf-8")
        loaded = re.findall(r"<(?:script|link|img|iframe)\b[^>]*?(?:src|href)=\"?(\w+:)?//[^\" >]+", text)
        assert not loaded, (page, loaded)
    for style in site.rglob("*.css"):
        assert not re.search(r"url\(['\"]?https?:", style.read_text(encoding="utf-8")), style
