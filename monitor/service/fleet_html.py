"""Page of a fleet: one HTML file with the state of every site, which a browser filters, sorts and draws row by row."""

from __future__ import annotations

import json
from collections.abc import Sequence
from html import escape

from monitor.core import utc
from monitor.damage import State
from monitor.service.fleet import SiteStatus

_STYLE = """
:root { color-scheme: light dark; --paper: #fff; --ink: #1d232b; --muted: #5c6673; --line: #d5dae0; --hover: #f1f4f7; }
@media (prefers-color-scheme: dark) { :root { --paper: #16191e; --ink: #e8ebef; --muted: #9aa5b3; --line: #343b45;
  --hover: #20252c; } }
* { box-sizing: border-box; }
body { margin: 0; height: 100dvh; display: flex; flex-direction: column; background: var(--paper); color: var(--ink);
  font: 15px/1.4 system-ui, sans-serif; }
header { padding: .7rem 1rem .5rem; } h1 { font-size: 1.25rem; margin: 0 0 .4rem; }
.muted { color: var(--muted); font-weight: 400; font-size: .87rem; }
#states { display: flex; flex-wrap: wrap; gap: .35rem; margin-bottom: .5rem; }
#states button { border: 1px solid var(--line); border-radius: 1rem; background: none; color: inherit; font: inherit;
  padding: .1rem .7rem; cursor: pointer; } #states button[aria-pressed=true] { outline: 2px solid var(--ink); }
#find { width: min(24rem, 100%); font: inherit; padding: .3rem .5rem; border: 1px solid var(--line); border-radius: .3rem;
  background: var(--paper); color: inherit; }
.row { display: grid; grid-template-columns: minmax(7rem, 14rem) 7rem 6.5rem 5rem 10.5rem 5rem minmax(12rem, 1fr); gap: .8rem;
  align-items: center; padding: 0 1rem; height: 30px; border-bottom: 1px solid var(--line); }
.row > * { overflow: hidden; text-overflow: ellipsis; white-space: nowrap; }
.row .n { text-align: right; font-variant-numeric: tabular-nums; }
#head { font-size: .87rem; } #head button { all: unset; cursor: pointer; color: var(--muted); }
[aria-sort=ascending]::after { content: " ↑"; } [aria-sort=descending]::after { content: " ↓"; }
#head button:focus-visible { outline: 2px solid var(--ink); }
#body { flex: 1; overflow-y: auto; position: relative; } #space { position: relative; }
#space .row { position: absolute; left: 0; right: 0; } #space .row:hover { background: var(--hover); }
.state { color: #fff; border-radius: 1rem; padding: 0 .6rem; font-size: .82rem; font-weight: 600; text-align: center;
  background: #68717d; } .state.normal { background: #2c7d46; } .state.alarm { background: #c2352b; }
.state.advisory, .state.doubtful, .state.warning { background: #b65905; }
@media (max-width: 900px) { #head { display: none; }
  .row { height: 76px; grid-template-columns: 1fr 7rem; grid-template-rows: repeat(3, auto); gap: 0 .6rem;
    align-content: center; }
  .row > :nth-child(3), .row > :nth-child(4) { font-size: .87rem; text-align: left; }
  .row > :nth-child(5), .row > :nth-child(6) { display: none; }
  .row > :nth-child(7) { grid-column: 1 / 3; font-size: .87rem; color: var(--muted); } }
"""
_SCRIPT = """
"use strict";
const data = JSON.parse(document.getElementById("data").textContent);
const rows = data.rows, states = data.states, body = document.getElementById("body"), space = document.getElementById("space");
const chosen = new Set(); let order = 1, words = "", shown = rows, up = false;
const low = rows.map(r => (r[0] + " " + states[r[1]] + " " + r[7]).toLowerCase());
const cell = {
  3: r => r[2] === null ? "" : (100 * r[2]).toFixed(1) + (r[3] === null ? "" : " ± " + (100 * r[3]).toFixed(1)) + " %",
  4: r => r[4] === null ? "" : r[4].toPrecision(4) + " Hz",
  5: r => r[5] === null ? "" : new Date(1e3 * r[5]).toISOString().slice(0, 19).replace("T", " "),
  6: r => r[6] === null ? "" : (100 * r[6]).toFixed(1) + " %" };
function element(kind, text) { const e = document.createElement("span"); e.className = kind; e.textContent = text; return e; }
function line(r) {
  const e = document.createElement("div"); e.className = "row"; e.setAttribute("role", "row");
  e.append(element("", r[0]), element("state " + states[r[1]].replace(" ", "_"), states[r[1]]), element("n", cell[3](r)),
    element("n", cell[4](r)), element("", cell[5](r)), element("n", cell[6](r)), element("", r[7]));
  e.lastChild.title = r[7]; return e; }
let drawn = [-1, -1];
function draw(anew) {
  const high = matchMedia("(max-width: 900px)").matches ? 76 : 30;
  const first = Math.max(0, Math.floor(body.scrollTop / high) - 5);
  const end = Math.min(shown.length, first + Math.ceil(body.clientHeight / high) + 10);
  if (!anew && drawn[0] === first && drawn[1] === end) return;
  drawn = [first, end]; space.style.height = shown.length * high + "px";
  space.replaceChildren(...shown.slice(first, end).map((r, k) => {
    const e = line(r); e.style.top = (first + k) * high + "px"; return e; })); }
function choose() {
  const wanted = words.toLowerCase().split(/\\s+/).filter(w => w);
  shown = rows.filter((r, k) => (!chosen.size || chosen.has(r[1])) && wanted.every(w => low[k].includes(w)));
  const value = r => r[order] === null ? -Infinity : r[order], sign = up ? 1 : -1;
  if (order !== 1 || up) shown.sort((a, b) => (value(a) < value(b) ? -sign : value(a) > value(b) ? sign : 0));
  document.getElementById("count").textContent = shown.length + " of " + rows.length + " sites, " + data.at + " UTC";
  for (const b of document.querySelectorAll("#head button"))
    b.parentElement.setAttribute("aria-sort", +b.dataset.by !== order ? "none" : up ? "ascending" : "descending");
  body.scrollTop = 0; draw(true); }
states.forEach((name, k) => {
  const n = rows.reduce((sum, r) => sum + (r[1] === k), 0), b = document.createElement("button");
  b.textContent = name + " " + n; b.hidden = !n; b.setAttribute("aria-pressed", "false");
  b.onclick = () => {
    chosen.has(k) ? chosen.delete(k) : chosen.add(k); b.setAttribute("aria-pressed", chosen.has(k)); choose(); };
  document.getElementById("states").prepend(b); });
for (const b of document.querySelectorAll("#head button"))
  b.onclick = () => { const by = +b.dataset.by; up = by === order ? !up : by === 0 || by === 7; order = by; choose(); };
document.getElementById("find").oninput = e => { words = e.target.value; choose(); };
body.addEventListener("scroll", () => draw(false)); addEventListener("resize", () => draw(true));
choose();
"""
_HEAD = (
    ("site", 0),
    ("state", 1),
    ("largest loss", 2),
    ("first mode", 4),
    ("window until, UTC", 5),
    ("available", 6),
    ("says", 7),
)


def fleet_page(statuses: Sequence[SiteStatus], title: str, at_ns: int) -> str:
    """Write the page of a fleet; only the rows in view are elements of it, so that ten thousand sites are drawn at once.

    The sites are first shown in the given order, the gravest first; they were asked at `at_ns`, UTC, ns since 1970.
    """
    states = list(State)
    rows = [
        [
            s.site,
            states.index(s.state),
            _rounded(s.ddi),
            _rounded(s.ddi_std),
            _rounded(s.frequency_hz),
            None if s.t_end_ns is None else s.t_end_ns // 1_000_000_000,
            _rounded(s.availability),
            s.says,
        ]
        for s in statuses
    ]
    content = {"at": utc(at_ns, seconds=True), "states": [state.words for state in states], "rows": rows}
    # "<" could end the script; everything of the data is shown as text.
    data = json.dumps(content, allow_nan=False, separators=(",", ":"), ensure_ascii=False).replace("<", "\\u003c")
    head = "".join(
        f'<span role="columnheader"><button data-by="{k}">{escape(name)}</button></span>' for name, k in _HEAD
    )
    return (
        f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"/>'
        f'<meta name="viewport" content="width=device-width, initial-scale=1"/><title>{escape(title)}</title>'
        f"<style>{_STYLE}</style></head>\n<body><header><h1>{escape(title)} "
        f'<span class="muted" id="count" role="status"></span></h1><div id="states"></div>'
        f'<input id="find" type="search" placeholder="site, state or words" aria-label="Filter"/></header>\n'
        f'<div class="row" id="head" role="row">{head}</div><div id="body" role="table" tabindex="0">'
        f'<div id="space"></div></div>\n<script type="application/json" id="data">{data}</script>\n'
        f"<script>{_SCRIPT}</script></body></html>\n"
    )


def _rounded(value: float | None) -> float | None:
    """Round to six digits; None for what is no number."""
    return None if value is None or value != value else float(f"{value:.6g}")
