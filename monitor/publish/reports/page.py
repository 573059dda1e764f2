"""Self-contained HTML page that all reports share: its style sheet and its tables."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape

from monitor.publish.reports import charts

_MOST_UNFOLDED = 3
"""Largest number of columns that fit on a narrow page. [count; measured at 390 px]"""
STYLE = """
:root { color-scheme: light dark; --paper: #fff; --ink: #1d232b; --muted: #5c6673; --line: #d5dae0; --quiet: #aab2bd;
  --before: #d1690a; --after: #1668b8; --bad: #c2352b; }
@media screen and (prefers-color-scheme: dark) { :root { --paper: #16191e; --ink: #e8ebef; --muted: #9aa5b3;
  --line: #343b45; --quiet: #5d6774; --before: #f09a4a; --after: #5aa9f0; --bad: #ee6b60; } }
body { max-width: 1080px; margin: 2rem auto; padding: 0 1rem; background: var(--paper); color: var(--ink);
  font: 15px/1.5 system-ui, sans-serif; overflow-wrap: break-word; }
h1 { font-size: 1.7rem; line-height: 1.25; margin: .3rem 0 .6rem; }
h2 { font-size: 1.15rem; margin: 2.2rem 0 .4rem; border-bottom: 1px solid var(--line); }
p { max-width: 80ch; margin: .4rem 0; } .muted, figcaption, th { color: var(--muted); }
figure { margin: .6rem 0; break-inside: avoid; } figcaption { font-size: .87rem; }
table { border-collapse: collapse; font-size: .9rem; margin: .5rem 0; }
td, th { text-align: left; padding: .2rem 1rem .2rem 0; border-bottom: 1px solid var(--line); vertical-align: top; }
td.n, th.n { text-align: right; white-space: nowrap; font-variant-numeric: tabular-nums; }
td.t { white-space: nowrap; }
td:not(.n, .t) { min-width: 5rem; } td:not(.n, .t), p, li, figcaption, span, b, .figures div {
  overflow-wrap: anywhere; }
.verdict { display: inline-block; padding: .1rem .7rem; border-radius: 1rem; color: #fff; font-weight: 600;
  background: #68717d; text-transform: uppercase; letter-spacing: .03em; }
.verdict.normal { background: #2c7d46; } .verdict.named { background: #1668b8; }
.verdict.advisory, .verdict.doubtful, .verdict.warning, .verdict.ambiguous { background: #b65905; }
.verdict.alarm, .verdict.unexplained { background: #c2352b; }
ul.doubts { margin: .6rem 0; padding-left: 1.1rem; border-left: 3px solid var(--before); max-width: 80ch; }
ul.doubts li { margin: .2rem 0 .2rem .6rem; } ul.doubts:empty { display: none; }
.figures { display: flex; flex-wrap: wrap; gap: .6rem 2.4rem; margin: 1rem 0; }
.figures div { font-size: .87rem; color: var(--muted); max-width: 19rem; }
.figures b { display: block; font-size: 1.15rem; color: var(--ink); }
.long td:last-child { overflow-wrap: anywhere; }
.stories { margin: .8rem 0; border-bottom: 4px solid var(--ink); max-width: 60rem; }
.stories div { display: grid; grid-template-columns: 9rem 1fr; gap: .8rem; align-items: center; margin-bottom: 2px; }
.stories b { padding: .4rem .7rem; color: #fff; background: #68717d; } .stories .beyond { background: #c2352b; }
.stories .within { background: #2c7d46; }
.signs { display: grid; grid-template-columns: 2fr 1fr 1fr; gap: 1.5rem; break-inside: avoid; }
.sign { margin-top: 3.2rem; border-top: 1px solid var(--ink); color: var(--muted); font-size: .87rem; }
.pair { display: grid; grid-template-columns: 1fr 1fr; gap: 1rem; } .key { font-weight: 600; white-space: nowrap; }
@media screen and (max-width: 640px) { h1 { font-size: 1.3rem; } .pair { grid-template-columns: 1fr; }
  body { margin: 1rem auto; } table { width: 100%; } td, th { padding-right: .6rem; } td.t, th.n { white-space: normal; }
  .folds thead { display: none; } .folds tr { display: block; padding: .4rem 0; border-bottom: 1px solid var(--line); }
  .folds td { display: grid; grid-template-columns: 8rem 1fr; text-align: left; border: 0; padding: .1rem 0;
    white-space: normal; } .folds td::before { content: attr(data-of); color: var(--muted); }
  .flows td { display: inline-block; padding-right: 1rem; } .flows td::before { margin-right: .4rem; }
  .flows td:empty { display: none; } }
@media print { @page { size: A4; margin: 14mm; } body { margin: 0; max-width: none; font-size: 9.5pt; }
  h1 { font-size: 16pt; } table { font-size: 8pt; } td, th { padding-right: .5rem; }
  h2 { break-after: avoid; } tr { break-inside: avoid; } thead { display: table-header-group; }
  * { print-color-adjust: exact; -webkit-print-color-adjust: exact; } }
"""


def document(title: str, parts: Sequence[str]) -> str:
    """Write an HTML page of a title, not yet escaped, and the HTML of its body; the page is well-formed XML as well."""
    viewport = '<meta name="viewport" content="width=device-width, initial-scale=1"/>'
    style = f"<style>{STYLE}{charts.STYLE}</style>"
    head = f'<head><meta charset="utf-8"/>{viewport}<title>{escape(title)}</title>{style}</head>'
    return f'<!DOCTYPE html>\n<html lang="en">{head}\n<body>{"".join(parts)}</body></html>\n'


def verdict(kind: str, words: str, title: str) -> str:
    """Write the verdict as a badge of a kind of the style sheet, and the title, not yet escaped, beside it."""
    return f'<span class="verdict {kind}">{words}</span><h1>{escape(title)}</h1>'


def doubts(said: Iterable[str]) -> str:
    """List what is doubtful."""
    return f'<ul class="doubts">{"".join(f"<li>{escape(doubt)}</li>" for doubt in said)}</ul>'


def figures(pairs: Iterable[tuple[str, str]]) -> str:
    """Write key figures, each with its meaning."""
    return f'<div class="figures">{"".join(f"<div><b>{escape(a)}</b>{escape(b)}</div>" for a, b in pairs)}</div>'


def rest(count: int, what: str) -> str:
    """State how many are not shown or drawn; nothing if there are none."""
    return f"<p>{count} more are not {what}.</p>" if count > 0 else ""


def table(head: Sequence[str], rows: Sequence[Sequence[str]], *, flows: bool = False) -> str:
    """Write a table; without headings it has no header row.

    A heading that begins with ``#`` stands over numbers, which are aligned right; one that begins with ``@`` over times and
    names of events, which do not wrap.  On a narrow page a table of more than three columns is folded: each cell stands on a line
    of its own beside its heading.  Where it `flows`, for many rows of numbers, the folded cells of a row follow one another, and
    empty ones are left out.

    Examples
    --------
    >>> table(["mode", "#Hz"], [["1", "5.2"]])
    '<table><thead><tr><th>mode</th><th class="n">Hz</th></tr></thead><tr><td>1</td><td class="n">5.2</td></tr></table>'
    """
    kinds = [{"#": ' class="n"', "@": ' class="t"'}.get(h[:1], "") for h in head] or [""] * max(map(len, rows))
    names = [escape(h.lstrip("#@")) for h in head]
    top = "".join(f"<th{kind}>{name}</th>" for name, kind in zip(names, kinds, strict=False))
    folds = len(head) > _MOST_UNFOLDED
    cells = [f'{kind} data-of="{name}"' for name, kind in zip(names, kinds, strict=True)] if folds else kinds
    body = "".join(
        "<tr>" + "".join(f"<td{cell}>{escape(str(v))}</td>" for v, cell in zip(row, cells, strict=True)) + "</tr>"
        for row in rows
    )
    opening = f'<table class="folds{" flows" if flows else ""}">' if folds else "<table>"
    return opening + (f"<thead><tr>{top}</tr></thead>" if head else "") + body + "</table>"
