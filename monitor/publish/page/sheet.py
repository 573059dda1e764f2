"""A page as a sheet: sections of texts, tables and charts, which one template turns into HTML.

A report is the sheet in one file with its charts' data; the live page asks for the same sheet again and again.
"""

from __future__ import annotations

import hashlib
import json
from base64 import b64encode
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined, Template
from markupsafe import Markup

from monitor import __version__
from monitor.core import DIRECTION_WORDS, rounded, storey_of, write_atomically
from monitor.publish.page.charts import Chart

_SIGNS = {
    "normal": "✓",
    "none": "✓",
    "not_judged": "?",
    "advisory": "!",
    "doubtful": "?!",
    "warning": "!",
    "alarm": "▲",
}
"""State or kind of verdict -> its sign, for those who do not see colours. [words]"""
_DIGITS = 5
"""Significant digits of the numbers of charts. [1; judgement: finer than a screen]"""
_NAMES = ("is", "id", "key", "kind", "size", "plan")
"""Keys of a section or block that are no texts. [names]"""
Cells = Sequence[tuple[str, str]]
"""Cells of an elevation: the state of each and its words."""
_FILES = resources.files("monitor.publish.page") / "files"


@dataclass(frozen=True, slots=True)
class Link:
    """Cell of a table that leads to another page."""

    words: str
    to: str


@dataclass(slots=True)
class Sheet:
    """Content of a page; all texts are plain, the template escapes them."""

    title: str
    name: str = ""
    """Of the structure or recording."""
    kind: str = ""
    """State or kind of verdict, which gives the head its colour and sign."""
    word: str = ""
    since: str = ""
    headline: str = ""
    live: str = ""
    """How the monitor is, on the live page."""
    lead: list[tuple[str, str]] = field(default_factory=list)
    """Sentences in the head, each with what it is called, or with an empty text."""
    sections: list[dict[str, Any]] = field(default_factory=list)
    charts: dict[str, dict[str, Any]] = field(default_factory=dict)
    """Name of a figure -> content of its chart."""

    @property
    def sign(self) -> str:
        """Sign of the state."""
        return _SIGNS.get(self.kind, "")

    def section(self, title: str, id: str = "") -> None:
        """Begin a section."""
        self.sections.append({"title": title, "id": id or f"s{len(self.sections)}", "blocks": []})

    def add(self, what: str, **content: Any) -> None:
        """Add a block to the last section."""
        self.sections[-1]["blocks"].append({"is": what, **content})

    def text(self, words: str, kind: str = "") -> None:
        """Add a paragraph, `quiet` for a note; nothing where there are no words."""
        if words:
            self.add("text", words=words, kind=kind)

    def note(self, words: str) -> None:
        """Add a quiet paragraph."""
        self.text(words, "quiet")

    def items(self, rows: Iterable[str], kind: str = "") -> None:
        """Add a list."""
        if listed := list(rows):
            self.add("items", rows=listed, kind=kind)

    def figures(self, rows: Iterable[tuple[str, str]]) -> None:
        """Add key figures, each with its meaning."""
        self.add("figures", rows=list(rows))

    def table(self, head: Sequence[str], rows: Sequence[Sequence[Any]], *, flows: bool = False, most: int = 0) -> None:
        """Add a table, of the first `most` rows if this is not 0; nothing without rows.

        A heading that begins with ``#`` stands over numbers, which are aligned right; one that begins with ``@`` over times.
        On a narrow page a table of more than three columns is folded: each cell stands beside its heading.  Where it `flows`,
        for many rows of numbers, the folded cells of a row follow one another.
        """
        if not rows:
            return
        names = [(h.lstrip("#@"), {"#": "n", "@": "t"}.get(h[:1], "")) for h in head]
        shown = rows[:most] if most else rows
        cells = [[asdict(v) if isinstance(v, Link) else str(v) for v in row] for row in shown]
        self.add("table", head=names, rows=cells, flows=flows)
        self.text(f"{len(rows) - len(shown)} more are not shown." if len(rows) > len(shown) else "")

    def elevation(self, says: str, names: Sequence[str], cells: Cells, more: Mapping[str, Cells]) -> None:
        """Add plan and elevation of a building, with state and words of each stiffness; nothing of another structure.

        The `more` columns have a cell for each storey, the lowest first; `says` what the words are.
        """
        places = list(filter(None, map(storey_of, names)))
        if not places or len(places) < len(names):
            return
        n = max(storey for storey, _ in places)
        columns = {places[i][1]: cells[i : i + n] for i in range(0, len(places), n)}
        graver = list(_SIGNS).index
        plan = {way: max((state for state, _ in own), key=graver) for way, own in columns.items()}
        of_storeys = [name.rpartition(", ")[0] for name in names], *columns.values(), *more.values()
        heads = [*(DIRECTION_WORDS[way] for way in columns), *more]
        self.add("elevation", plan=list(plan.items()), head=heads, rows=list(zip(*of_storeys, strict=False))[::-1])
        self.note(f"Elevation: {says}. Colour: its state; in the plan (not to scale) the gravest in each direction.")

    def draw(self, *charts: Chart, size: str = "", more: str = "") -> None:
        """Add charts side by side, one below another if `wide`; behind the words `more` where there are some."""
        if not charts:
            return
        part, captions = self.sections[-1], []
        for chart in charts:
            key = f"{part['id']}-{len(self.charts)}"
            self.charts[key] = chart.content | {"marks": rounded(chart.marks, _DIGITS)}
            captions.append({"key": key, "title": chart.title, "note": chart.note, "kind": chart.kind})
        self.add("more" if more else "charts", charts=captions, size=size, words=more)

    def rename(self, words: Callable[[str], str]) -> None:
        """Change every text of the page, as by the names of the stories."""

        def changed(value: Any) -> Any:
            if isinstance(value, str):
                return words(value)
            if isinstance(value, dict):
                return {key: part if key in _NAMES else changed(part) for key, part in value.items()}
            return [changed(part) for part in value] if isinstance(value, list | tuple) else value

        self.title, self.headline = words(self.title), words(self.headline)
        self.lead, self.sections = changed(self.lead), changed(self.sections)

    def body(self) -> str:
        """Write the HTML of the page's body."""
        return _template("sheet.html").render(s=self)

    def html(self) -> str:
        """Write the page as one file, which needs nothing from elsewhere."""
        names = "uplot", "page"
        return one_file("page.html", {"charts": self.charts}, names, names, title=self.title, s=self, live=False)

    def write(self, path: Path) -> None:
        """Write the page into a file, which appears under its name only when complete."""
        write_atomically(path, self.html())


def one_file(template: str, data: Any, styles: Sequence[str], scripts: Sequence[str], **content: Any) -> str:
    """Write a page as one file of a template, with data for its scripts and a policy by which no other script runs."""
    text = json.dumps(data, allow_nan=False, separators=(",", ":"), ensure_ascii=False)
    files = {"styles": [_text(f"{name}.css") for name in styles], "scripts": [_text(f"{name}.js") for name in scripts]}
    sums = (b64encode(hashlib.sha256(script.encode()).digest()).decode() for script in files["scripts"])
    policy = "default-src 'none'; style-src 'unsafe-inline'; script-src " + " ".join(f"'sha256-{c}'" for c in sums)
    embedded = Markup(text.replace("<", "\\u003c"))  # "<" could end the script element
    return _template(template).render(data=embedded, policy=policy, **files, **content)


def live_page() -> str:
    """Write the page that asks for its content (`Sheet.body` and charts)."""
    return _template("page.html").render(live=True, title="shm-monitor", version=__version__)


def api_page(described: Mapping[str, Any]) -> str:
    """Write the page of the JSON interface, of its OpenAPI document."""
    return _template("api.html").render(**described)


def page_file(name: str) -> bytes:
    """Read a file that the pages are made of."""
    return _FILES.joinpath(name).read_bytes()


def _text(name: str) -> Markup:
    """Read a style or script of the pages."""
    return Markup(page_file(name).decode())


@cache
def _template(name: str) -> Template:
    loader = PackageLoader("monitor.publish.page", "files")
    return Environment(
        loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    ).get_template(name)
