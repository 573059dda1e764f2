"""What a page that the monitor writes shows: its words, its tables and the data of its charts."""

from __future__ import annotations

import json
from html.parser import HTMLParser
from typing import Any

import numpy as np

VOID = {"meta", "link", "br", "rect", "input"}


class Page(HTMLParser):
    """A page of one file; it is refused if it asks for anything from elsewhere."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.html, self.words, self.head, self.tags = html, "", "", []
        self.tables: list[list[list[str]]] = []
        self.headline = ""
        self.titles: dict[str, str] = {}
        """Title of each chart by its key."""
        self.notes: dict[str, str] = {}
        """What stands below the title of each chart."""
        self._scripts: list[str] = []
        self._open: list[tuple[str, dict[str, str | None]]] = []
        self._figure = ""
        self.feed(html)
        assert self._open == [], "every element is closed"
        data, styles = self._scripts[0], html.partition("<body")[0]
        assert "</" not in data and "url(" not in styles and "@import" not in styles
        assert not {"link", "img", "iframe", "object"} & {tag for tag, _ in self.tags}
        assert not any(name == "src" or name.startswith("on") for _, given in self.tags for name in given)
        assert any(str(given.get("content")).startswith("default-src 'none'") for _, given in self.tags)
        self.charts: dict[str, Any] = json.loads(data)["charts"]

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        self.tags.append((tag, given))
        if tag not in VOID:
            self._open.append((tag, given))
        if tag == "figure":
            self._figure = str(given["data-chart"])
            self.titles[self._figure] = self.notes[self._figure] = ""
        elif tag == "table":
            self.tables.append([])
        elif tag == "tr":
            self.tables[-1].append([])
        elif tag in ("td", "th"):
            self.tables[-1][-1].append("")
        elif tag == "script":
            self._scripts.append("")

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop()[0] == tag, tag

    def handle_data(self, data: str) -> None:
        inside = [tag for tag, _ in self._open]
        if "script" in inside:
            self._scripts[-1] += data
        elif "style" not in inside and "title" not in inside:
            if data.strip():
                self.words += f"{data.strip()} "
            if "h1" in inside:
                self.headline += data
            if "header" in inside:
                self.head += data
            if inside[-1:] == ["b"] and "figcaption" in inside:
                self.titles[self._figure] += data
            elif "figcaption" in inside:
                self.notes[self._figure] += data
            elif "table" in inside and self.tables[-1] and self.tables[-1][-1]:
                self.tables[-1][-1][-1] += data.strip()

    @property
    def state(self) -> str:
        """Class of the head: the state, or the kind of the verdict."""
        return next(str(given["class"]) for tag, given in self.tags if tag == "header").removeprefix("state ")

    def chart(self, begins: str) -> dict[str, Any]:
        """The first chart whose title begins so."""
        return dict(self.charts[next(key for key, title in self.titles.items() if title.startswith(begins))])

    def note(self, begins: str) -> str:
        """What stands below the title of this chart."""
        return next(self.notes[key].strip() for key, title in self.titles.items() if title.startswith(begins))

    def table(self, head: str) -> list[list[str]]:
        """The rows of the first table that has this word in its heading."""
        return next(rows[1:] for rows in self.tables if head in rows[0])


def marks(chart: dict[str, Any], what: str, kind: str = "") -> list[dict[str, Any]]:
    """The marks of a chart of one sort, and of a kind if it is given."""
    return [m for m in chart["marks"] if m["is"] == what and kind in ("", m["kind"])]


def numbers(values: list[float | None]) -> np.ndarray:
    """Values of a mark, with NaN where the curve is broken."""
    return np.array([np.nan if v is None else v for v in values], dtype=float)
