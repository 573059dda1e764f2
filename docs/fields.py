"""docs/fields.py: writes the table of a window's fields into docs/results.md."""

from __future__ import annotations

from pathlib import Path

from monitor.publish.results.window_fields import FIELDS

PAGE = Path(__file__).parent / "results.md"
BEGIN, END = "<!-- fields: written by docs/fields.py -->\n", "<!-- end of fields -->"


def page() -> str:
    """Return the page with the table as it is now."""
    before, _, rest = PAGE.read_text(encoding="utf-8").partition(BEGIN)
    rows = [f"| `{field.key}` | {field.kind.value} | {field.meaning} |\n" for field in FIELDS]
    return "".join(
        [before, BEGIN, "\n| key | value | meaning |\n|---|---|---|\n", *rows, "\n", END, rest.partition(END)[2]]
    )


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
