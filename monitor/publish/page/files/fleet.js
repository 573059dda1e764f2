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
  const wanted = words.toLowerCase().split(/\s+/).filter(w => w);
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
