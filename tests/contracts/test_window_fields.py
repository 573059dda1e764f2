"""One table names the fields of a window's line."""

from __future__ import annotations

import runpy
from pathlib import Path

from monitor.publish import KEPT, LINE_SCHEMA, SHOWN

ROOT = Path(__file__).resolve().parents[2]


def test_the_page_of_results_is_up_to_date() -> None:
    script = runpy.run_path(str(ROOT / "docs/fields.py"))
    assert script["page"]() == (ROOT / "docs/results.md").read_text(encoding="utf-8"), "run docs/fields.py"


def test_a_key_is_named_once_and_what_is_kept_or_shown_is_in_the_line() -> None:
    for some in (KEPT, SHOWN):
        assert {field.key for field in some} < set(LINE_SCHEMA["properties"])
    text = (ROOT / "monitor/publish/results/window_fields.py").read_text(encoding="utf-8")
    assert [
        key for key in LINE_SCHEMA["properties"] if text.count(f'    "{key}",') + text.count(f'Field("{key}",') != 1
    ] == []
