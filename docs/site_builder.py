"""docs/site_builder.py DIR: the pages of docs/ as a static site, by mkdocs and its theme Material; a warning is an error.

README.md is its first page and docs/index.md its map; the pages beside docs/ that these link to are pages too, and links to other
files of the repository become plain text.  Notebooks become pages, and the library's docstrings its reference.  Pages that the
navigation of docs/mkdocs.yml does not name are listed at its end.
"""

from __future__ import annotations

import inspect
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
BESIDE = ("ARCHITECTURE.md", "CONTRIBUTING.md", "CHANGELOG.md", "recordings/README.md")
_LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^)\s]+)\)")


def main() -> None:
    """Write it."""
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    out = Path(sys.argv[1]).resolve()
    with tempfile.TemporaryDirectory() as folder:
        pages = Path(folder, "pages")
        stage(pages)
        settings = Path(folder, "mkdocs.yml")
        settings.write_text(settings_text(pages), encoding="utf-8")
        command = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--strict", "--site-dir", str(out)]
        quiet = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}  # what the theme says of its successor is no fault of a page
        done = subprocess.run([*command, "--config-file", str(settings)], check=False, env=quiet)
    sys.exit(done.returncode)


def stage(pages: Path) -> None:
    """Lay the pages out as one folder, with links that hold there."""
    keep = shutil.ignore_patterns("*.py", "*.sh", "*.yml", "*.ipynb", "__pycache__")
    shutil.copytree(DOCS, pages, ignore=keep)
    (pages / "index.md").rename(pages / "map.md")
    shutil.copy(ROOT / "README.md", pages / "index.md")
    for name in BESIDE:
        (pages / name).parent.mkdir(exist_ok=True)
        shutil.copy(ROOT / name, pages / name)
    for notebook in sorted((DOCS / "notebooks").glob("*.ipynb")):
        place = pages / "notebooks" / f"{notebook.stem}.md"
        place.parent.mkdir(exist_ok=True)
        place.write_text(notebook_text(notebook), encoding="utf-8")
    (pages / "api.md").write_text(reference_text(), encoding="utf-8")
    for page in pages.rglob("*.md"):
        source = place_in_repository(page.relative_to(pages))
        text = page.read_text(encoding="utf-8")
        page.write_text("".join(mended(text, source, page, pages)), encoding="utf-8")


def place_in_repository(page: Path) -> Path:
    """Return the file that a page of the site was made of, relative to the repository."""
    if page == Path("index.md"):
        return Path("README.md")
    if page == Path("map.md"):
        return Path("docs/index.md")
    return page if str(page) in BESIDE else Path("docs") / page


def mended(text: str, source: Path, page: Path, pages: Path) -> Iterator[str]:
    """Yield the text of a page whose links lead to the site's pages; code stays as it is."""
    for part in re.split(r"(^```.*?^```$|`[^`\n]+`)", text, flags=re.DOTALL | re.MULTILINE):
        yield part if part.startswith("`") else _LINK.sub(lambda found: relinked(found, source, page, pages), part)


def relinked(found: re.Match[str], source: Path, page: Path, pages: Path) -> str:
    """Return a link so that it leads to the site's page, or its words alone where the site has no such page."""
    mark, words, target = found.groups()
    path, hash_mark, place = target.partition("#")
    if "://" in target or not path:
        return found[0]
    file = (ROOT / source.parent / path).resolve().relative_to(ROOT)
    if file.is_relative_to("docs"):
        there = {Path("docs/index.md"): Path("map.md")}.get(file, file.relative_to("docs"))
    else:
        there = {Path("README.md"): Path("index.md")}.get(file, file)
    if there.suffix == ".ipynb":
        there = there.with_suffix(".md")
    if (pages / there).is_dir() and (pages / there / "README.md").is_file():
        there /= "README.md"
    if not (pages / there).is_file():
        return words
    up = "../" * (len(page.relative_to(pages).parts) - 1)
    return f"{mark}[{words}]({up}{there}{hash_mark}{place})"


def notebook_text(notebook: Path) -> str:
    """Return a notebook as a page: its text, and its code in blocks."""
    cells = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
    parts = [
        "".join(c["source"]) if c["cell_type"] == "markdown" else f"```python\n{''.join(c['source'])}\n```"
        for c in cells
    ]
    return "\n\n".join(parts) + "\n"


def reference_text() -> str:
    """Return the reference of the library: docstring of each name, with parameters of functions and fields of results."""
    import shm_monitor

    parts = [
        "# Library reference",
        "`import shm_monitor as shm`; [library](library.md) tells how it is used and what stays.",
    ]
    for name in shm_monitor.__all__:
        thing = getattr(shm_monitor, name)
        parts.append(f"## {name}")
        if inspect.isfunction(thing):
            parts.append(f"```python\n{signature(name, thing)}\n```")
        parts.append(f"```text\n{inspect.getdoc(thing)}\n```")
        if inspect.isclass(thing) and thing.__module__.startswith("monitor.api"):
            parts.append(fields_text(thing))
    return "\n\n".join(parts) + "\n"


def signature(name: str, thing: Any) -> str:
    """Return how a function is called, one parameter a line."""
    called = inspect.signature(thing)
    kinds = [str(parameter).replace("'", "") for parameter in called.parameters.values()]
    first_named = next((k for k, p in enumerate(called.parameters.values()) if p.kind is p.KEYWORD_ONLY), None)
    if first_named is not None:
        kinds.insert(first_named, "*")
    lines = "".join(f"    {kind},\n" for kind in kinds)
    return f"{name}(\n{lines}) -> {str(called.return_annotation).strip(chr(39))}"


def fields_text(kind: type) -> str:
    """Return the fields of a result, with what the source says of each, and its methods."""
    source = inspect.getsource(kind)
    rows = re.findall(r"^    (\w+): ([^\n=]+?)(?: = [^\n]*)?\n    \"\"\"(.*?)\"\"\"", source, re.MULTILINE | re.DOTALL)
    rows += [
        (name, str(member.fget.__annotations__.get("return", "")), inspect.getdoc(member) or "")
        for name, member in vars(kind).items()
        if isinstance(member, property)
    ]
    escaped = [[" ".join(cell.split()).replace("|", "or") for cell in row] for row in rows]
    return "\n".join(
        ["| field | type | meaning |", "|---|---|---|", *(f"| `{n}` | `{t}` | {d} |" for n, t, d in escaped)]
    )


def settings_text(pages: Path) -> str:
    """Return the settings of mkdocs, with the pages that its navigation does not name at the end."""
    text = (DOCS / "mkdocs.yml").read_text(encoding="utf-8")
    named = set(re.findall(r"[\w./-]+\.md", text.partition("\nnav:")[2]))
    all_pages = {path.relative_to(pages).as_posix() for path in pages.rglob("*.md")}
    decisions = {page for page in all_pages if page.startswith("decisions/")}
    more = sorted(all_pages - named - decisions)
    text += f"  - Decisions: [{', '.join(sorted(decisions - named))}]\n"
    return text + (f"  - More: [{', '.join(more)}]\n" if more else "") + f"docs_dir: {pages}\n"


if __name__ == "__main__":
    main()
