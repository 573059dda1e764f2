"""docs/settings.md states every key with its default and its bounds, so that none of them changes unseen."""

from __future__ import annotations

import runpy
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def test_the_page_of_settings_is_that_of_the_classes() -> None:
    made = runpy.run_path(str(ROOT / "docs/settings.py"))["page"]()
    assert made == (ROOT / "docs/settings.md").read_text(encoding="utf-8"), "run docs/settings.py"
    for key in (
        "| `window_s` | `400` |",
        "| `dbc` | - |",
        "| `latching` | `false` |",
        "| `max_payload_bytes` | `1048576` |",
        "(at least 4, at most 200) |",
        '## `[structure]`, `kind = "modal"`',
        "## `[[events.limits]]`",
    ):
        assert key in made
