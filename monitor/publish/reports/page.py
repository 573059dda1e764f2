"""Self-contained HTML page that all reports share: its style sheet and its tables."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

from monitor.publish.reports import charts

STYLE = """
:root { color-scheme: light dark; --paper: #fff; --ink: #1d232b; --muted: #5c6673; --line: #d5dae0; --quiet: #aab2bd;
  --before: #d1690a; --after: #1668b8; --bad: #c2352b; --good: #2c7d46; }
@media screen and (prefers-color-scheme: dark) { :root { --paper: #16191e; --ink: #e8ebef; --muted: #9aa5b3;
  --line: #343b45; --quiet: #5d6774; --before: #f09a4a; --after: #5aa9f0; --bad: #ee6b60; --good: #62bd80; } }
body { max-width: 1080px; margin: 2rem auto; padding: 0 1rem; background: var(--paper); color: var(--ink);
  font: 15px/1.5 system-ui, sans-serif; }
h1 { font-size: 1.7rem; line-height: 1.25; margin: .3rem 0 .6rem; }
h2 { font-size: 1.15rem; margin: 2.2rem 0 .4rem; border-bottom: 1px solid var(--line); }
p { max-width: 80ch; margin: .4rem 0; } .muted, figcaption, th { color: var(--muted); }
figure { margin: .6rem 0; break-inside: avoid; } figcaption { font-size: .87rem; }
table { border-collapse: collapse; font-size: .9rem; margin: .5rem 0; }
td, th { text-align: left; padding: .2rem 1rem .2rem 0; border-bottom: 1px solid var(--line); vertical-align: top; }
td.n, th.n { text-align: right; white-space: nowrap; font-variant-numeric: tabular-nums; }
td.t { white-space: nowrap; }
.verdict { display: inline-block; padding: .1rem .6rem; border-radius: 1rem; color: #fff; font-weight: 600;
  background: var(--bad); } .verdict.none { background: var(--good); } .verdict.named { background: var(--after); }
.verdict.ambiguous { background: var(--before); }
.figures { display: flex; flex-wrap: wrap; gap: .6rem 2.4rem; margin: 1rem 0; }
.figures div { font-size: .87rem; color: var(--muted); max-width: 19rem; }
.figures b { display: block; font-size: 1.15rem; white-space: nowrap; color: var(--ink); }
.pair { display: grid; grid-template-columns: 1fr 1fr; gap: 1rem; } .key { font-weight: 600; white-space: nowrap; }
@media print { @page { size: A4; margin: 14mm; } body { margin: 0; max-width: none; font-size: 9.5pt; }
  h1 { font-size: 16pt; } table { font-size: 8pt; } td, th { padding-right: .5rem; }
  h2 { break-after: avoid; } tr { break-inside: avoid; } thead { display: table-header-group; }
  * { print-color-adjust: exact; -webkit-print-color-adjust: exact; } }
"""


def document(title: str, parts: Sequence[str]) -> str:
    """Write an HTML page without external files; the page is well-formed XML as well.

    Parameters
    ----------
    title : str
        Title of the page, not escaped.
    parts : sequence of str
        HTML of the body.
    """
    viewport = '<meta name="viewport" content="width=device-width"/>'
    style = f"<style>{STYLE}{charts.STYLE}</style>"
    head = f'<head><meta charset="utf-8"/>{viewport}<title>{escape(title)}</title>{style}</head>'
    return f'<!DOCTYPE html>\n<html lang="en">{head}\n<body>{"".join(parts)}</body></html>\n'


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Write a table.

    Parameters
    ----------
    head : sequence of str
        Headings; none without a header row.  A heading that begins with ``#`` stands over numbers, which are aligned right; one
        that begins with ``@`` stands over times, which do not wrap.
    rows : sequence of sequence of str
        Cells of each row.

    Examples
    --------
    >>> table(["mode", "#Hz"], [["1", "5.2"]])
    '<table><thead><tr><th>mode</th><th class="n">Hz</th></tr></thead><tr><td>1</td><td class="n">5.2</td></tr></table>'
    """
    numeric = [{"#": ' class="n"', "@": ' class="t"'}.get(h[:1], "") for h in head] or [""] * max(map(len, rows))
    top = "".join(f"<th{n}>{escape(h.lstrip('#@'))}</th>" for h, n in zip(head, numeric, strict=False))
    body = "".join(
        "<tr>" + "".join(f"<td{n}>{escape(str(v))}</td>" for v, n in zip(row, numeric, strict=True)) + "</tr>"
        for row in rows
    )
    return "<table>" + (f"<thead><tr>{top}</tr></thead>" if head else "") + body + "</table>"
