"use strict";
/* The page: asks for the status every few seconds, for the rest where it changed, and draws it. */

const EVERY_MS = 5000;      // between two questions for the status
const LATE_MS = 20000;      // without an answer: what is shown may be out of date
const POINTS = 1000;        // of a chart, at most
const GAP_STEPS = 5;        // a step in time so many times longer than those about it is a gap
const SIGMAS = 1.96;        // half width of a 95 % interval
const RANGES = [["6 hours", 6 * 3600], ["day", 86400], ["week", 7 * 86400], ["all", Infinity]];
const TIME_STEPS = [[1, [1, 2, 5, 10, 15, 30]], [60, [1, 2, 5, 10, 15, 30]], [3600, [1, 2, 3, 6, 12]], [86400, [1, 2, 4, 7, 14, 30, 60, 90, 180, 365, 730]]]
  .flatMap(([unit, counts]) => counts.map((count) => unit * count)); // between labels, finer than uPlot's own, for narrow charts
const SIGNS = { normal: "✓", not_judged: "?", advisory: "!", doubtful: "?!", warning: "!", alarm: "▲" };
const $ = (id) => document.getElementById(id);

let status = null, rows = [], drawn = [], matched = 0, range = RANGES[1][1], heard = 0, charts = [], busy = false;
let seen = {}, etags = {};

/* ---- asking ---- */

class Refused extends Error {}

async function ask(path) {
  const token = sessionStorage.getItem("token");
  const headers = token ? { Authorization: `Bearer ${token}` } : {};
  if (etags[path]) headers["If-None-Match"] = etags[path].tag;
  const answer = await fetch(`api/v1/${path}`, { headers, cache: "no-store", signal: AbortSignal.timeout(15000) });
  if (answer.status === 401) throw new Refused();
  if (answer.status === 304) return etags[path].content;
  if (!answer.ok) throw new Error(`${answer.status}`);
  const content = await answer.json();
  if (path === "status") etags[path] = { tag: answer.headers.get("ETag"), content };
  return content;
}

async function refresh() {
  if (busy) return;
  busy = true;
  try {
    const fresh = await ask("status");
    if (status && fresh.begun_ns !== status.begun_ns) seen = {}; // started anew: it counts anew
    status = fresh;
    heard = Date.now();
    $("login").hidden = true;
    $("shown").hidden = false;
    $("leave").hidden = !sessionStorage.getItem("token");
    showState();
    for (const [name, show] of Object.entries(SECTIONS)) {
      if (seen[name] !== status.revisions[name]) {
        await show();
        seen[name] = status.revisions[name];
      }
    }
  } catch (error) {
    if (error instanceof Refused) demandToken();
    else if (status) showState();
  } finally {
    busy = false;
  }
}

function demandToken() {
  if (sessionStorage.getItem("token")) $("login-says").textContent = "This token is not the monitor's.";
  sessionStorage.removeItem("token");
  etags = {};
  seen = {};
  $("shown").hidden = true;
  $("login").hidden = false;
  $("token").focus();
}

/* ---- words ---- */

const two = (n) => String(n).padStart(2, "0");
function utc(ns, seconds) {
  if (ns === null || ns === undefined) return "–";
  const d = new Date(ns / 1e6);
  const day = `${d.getUTCFullYear()}-${two(d.getUTCMonth() + 1)}-${two(d.getUTCDate())}`;
  return `${day} ${two(d.getUTCHours())}:${two(d.getUTCMinutes())}${seconds ? ":" + two(d.getUTCSeconds()) : ""}`;
}
const known = (x) => x !== null && x !== undefined && Number.isFinite(x);
function pair(value, std, unit, scale = 1, least = 0) {
  if (!known(value)) return "not known";
  const v = scale * value, half = known(std) ? SIGMAS * scale * std : NaN;
  if (!known(half)) return `${v.toPrecision(4)} ${unit}`;
  const digits = Math.min(6, Math.max(least, 1 - Math.floor(Math.log10(Math.max(half, 1e-6)))));
  return `${v.toFixed(digits)} ± ${half.toFixed(digits)} ${unit}`;
}
const number = (x, digits = 3) => (known(x) ? (x !== 0 && (Math.abs(x) < 1e-3 || Math.abs(x) >= 1e5) ? x.toExponential(2) : String(Number(x.toPrecision(digits)))) : "–");
function span(seconds) {
  if (!known(seconds)) return "–";
  return seconds < 120 ? `${Math.round(seconds)} s` : seconds < 5400 ? `${Math.round(seconds / 60)} min` : seconds < 172800 ? `${(seconds / 3600).toFixed(1)} h` : `${(seconds / 86400).toFixed(1)} days`;
}
function element(kind, text, attributes = {}) {
  const made = document.createElement(kind);
  if (text !== null && text !== undefined) made.textContent = text;
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  return made;
}
const tag = (level) => element("span", level.replace("_", " "), { class: `tag ${level}` });
const story = (j) => (!j ? "whole structure" : (status.stories[j - 1] || `story ${j}`));
const capital = (text) => text.charAt(0).toUpperCase() + text.slice(1);

function fill(place, ...items) { $(place).replaceChildren(...items); }
function table(place, heads, lines, none) {
  if (!lines.length) return fill(place, element("p", none, { class: "quiet" }));
  const made = element("table"), head = element("tr");
  for (const text of heads) head.append(element("th", text, { scope: "col" }));
  const top = element("thead"), body = element("tbody");
  top.append(head);
  for (const cells of lines) {
    const line = element("tr");
    cells.forEach((cell, i) => {
      const box = element("td", null, { "data-label": heads[i] }), inner = element("span");
      inner.append(cell);
      box.append(inner);
      line.append(box);
    });
    body.append(line);
  }
  made.append(top, body);
  fill(place, made);
}

/* ---- the state ---- */

function showState() {
  const late = Date.now() - heard > LATE_MS;
  const state = late ? "not_judged" : status.state;
  const time = new Date(heard);
  const clock = `${two(time.getHours())}:${two(time.getMinutes())}:${two(time.getSeconds())}`;
  $("state").className = `state ${state}`;
  $("site").textContent = status.site;
  const live = late ? "no answer" : status.monitor === "running" ? "● live" : `monitor ${status.monitor}`;
  if ($("live").textContent !== live) $("live").textContent = live;
  $("sign").textContent = SIGNS[state] || "";
  const word = late ? "No answer" : status.state.replace("_", " ");
  const headline = late ? `The monitor has not answered since ${clock}. Before: ${status.headline}` : status.headline;
  if ($("word").textContent !== word) $("word").textContent = word;
  if ($("headline").textContent !== headline) $("headline").textContent = headline;
  const doubts = late ? [] : status.doubts;
  if (doubts.join() !== [...$("doubts").children].map((item) => item.textContent).join()) { // else it would be read out again
    fill("doubts", ...doubts.map((text) => element("li", text)));
  }
  document.title = `${word}: ${status.site}`;
  $("version").textContent = `shm-monitor ${status.version}`;
  const facts = [
    ["Data until", status.t_ns || status.latest ? `${utc(status.t_ns || status.latest.t_end_ns, true)} UTC` : "no data yet"],
    ["Last data", known(status.data_age_s) ? `${span(status.data_age_s)} ago` : "none in this run"],
    ["Windows", known(status.windows) ? `${status.windows}, ${status.skipped} not judged` : "–"],
    ["Latest window", status.latest ? (status.latest.skipped ? `not judged: ${status.latest.skipped.split(/[:;(]/)[0].trim()}` : "judged") : "none yet"],
    ["Monitor", known(status.uptime_s) ? `${status.monitor}, up ${span(status.uptime_s)}` : status.monitor],
    ["Disk free", known(status.disk_free_bytes) ? `${(status.disk_free_bytes / 2 ** 30).toFixed(0)} GiB` : "–"],
    ["Parts that fail", status.troubles.length ? status.troubles.join("; ") : "none", status.troubles.length > 0],
  ];
  fill("facts", ...facts.map(([name, text, bad]) => {
    const box = element("div", null, bad ? { class: "bad" } : {});
    box.append(element("dt", name), element("dd", text));
    return box;
  }));
}

/* ---- charts ---- */

async function showWindows() {
  const last = rows.length ? rows[rows.length - 1].t_end_ns : null;
  const whole = last === null || seen.range !== range;
  if (whole) {
    const latest = status.latest ? status.latest.t_end_ns : 0;
    // Without a window of this run the past alone is shown: ask for the latest first.
    const end = latest || ((await ask("windows?limit=1")).windows.at(-1) || { t_end_ns: 0 }).t_end_ns;
    const since = Number.isFinite(range) ? Math.max(0, end - range * 1e9) : 0;
    const answer = await ask(`windows?since_ns=${BigInt(Math.floor(since))}&limit=${POINTS}`);
    rows = answer.windows;
    matched = answer.matched;
    seen.range = range;
  } else {
    const answer = await ask(`windows?since_ns=${BigInt(last)}&limit=${POINTS}`);
    const fresh = answer.windows.filter((row) => row.t_end_ns > last);
    const begin = fresh.length ? fresh[fresh.length - 1].t_end_ns - range * 1e9 : -Infinity;
    rows = [...rows, ...fresh].filter((row) => row.t_end_ns > begin);
    matched += fresh.length;
    if (rows.length > 2 * POINTS) { seen.range = null; return showWindows(); }
  }
  draw();
}

/* Puts a row without values where windows are missing: a step in time far longer than those about it. */
function withGaps(all) {
  const steps = all.slice(1).map((row, i) => row.t_end_ns - all[i].t_end_ns);
  return all.flatMap((row, i) => {
    const about = steps.slice(Math.max(0, i - 4), i + 3).sort((a, b) => a - b);
    const isGap = i > 0 && steps[i - 1] > GAP_STEPS * about[about.length >> 1];
    return isGap ? [{ t_end_ns: row.t_end_ns - steps[i - 1] / 2, skipped: "no data" }, row] : [row];
  });
}

function draw() {
  for (const chart of charts) chart.destroy();
  charts = [];
  drawn = withGaps(rows);
  drawLoss();
  drawModes();
}

function drawLoss() {
  const isModal = rows.some((row) => row.frequency_change), isLoss = !isModal && $("quantity").value === "ddi";
  const [key, std, scale, unit] = isModal ? ["frequency_change", "frequency_change_std", 100, "%"]
    : isLoss ? ["ddi", "ddi_std", 100, "%"] : ["stiffness_n_per_m", "stiffness_std", 1, "N/m"];
  const judged = rows.findLast((row) => row[key]), count = judged ? judged[key].length : 0;
  // A frequency goes with the square root of the stiffness: half the loss.
  const limit = !known(status.alarm_loss) ? null : isModal ? -50 * status.alarm_loss : isLoss ? 100 * status.alarm_loss : null;
  const limits = isModal || isLoss ? common(key, std, scale, limit) : null;
  $("s-loss").hidden = !judged && rows.some((row) => row.frequencies_hz);
  $("pick-quantity").hidden = isModal;
  $("h-loss").textContent = isModal ? "Change of the natural frequencies since the baseline" : isLoss ? "Stiffness lost since the baseline" : "Stiffness";
  $("loss-note").textContent = !rows.length ? "No window yet." : "Line: estimate. Band: 95 % interval."
    + (isLoss && status.has_baseline === false ? " There is no baseline: the loss is that against the structure file." : "")
    + (limits && limit ? ` Dashed: ${number(limit)} %, from which a confirmed ${isModal ? "change" : "loss"} is an alarm.` : "")
    + (matched > rows.length ? ` ${rows.length} of ${matched} windows are drawn.` : "");
  const { level = null, stories = [], changed = [] } = status.latest || {};
  const detectable = isLoss && status.judged && status.judged.detectable_loss;
  const list = [];
  for (let j = 0; j < count; j++) {
    const name = isModal ? `mode ${j + 1}` : story(j + 1), latest = rows.findLast((row) => row[key] && known(row[key][j]));
    const [caption, first, second] = captionOf(capital(name), latest ? pair(latest[key][j], latest[std] && latest[std][j], unit, scale, scale === 100 ? 1 : 0) : "not known");
    const stands = level && level !== "normal" && (isModal ? changed.some((part) => part.endsWith(name)) : stories.includes(j + 1));
    if (stands) first.append(" ", tag(level));
    else if (detectable) second.textContent = known(detectable[j]) ? `a loss of ${number(100 * detectable[j], 2)} % would be seen` : "a loss would not be seen";
    list.push([caption, drawn.map((row) => (row[key] ? row[key][j] : null)), drawn.map((row) => (row[std] ? row[std][j] : null)), scale, unit, limits]);
  }
  place("loss", list, limits ? limit : null);
}

function captionOf(name, text) {
  const caption = element("figcaption"), first = element("p"), second = element("p", null, { class: "quiet" });
  first.append(element("b", name), `: ${text}`);
  caption.append(first, second);
  return [caption, first, second];
}

function common(key, std, scale, limit) {
  let low = Math.min(-1, limit || 0), high = Math.max(0, limit || 0);
  for (const row of rows) (row[key] || []).forEach((value, j) => {
    if (!known(value)) return;
    const half = row[std] && known(row[std][j]) ? SIGMAS * row[std][j] : 0;
    low = Math.min(low, scale * (value - half));
    high = Math.max(high, scale * (value + half));
  });
  const pad = 0.07 * (high - low);
  return [low - pad, high + pad];
}

const modeNames = (row) => row.model_modes || [];

function drawModes() {
  const names = new Set();
  for (const row of rows) if (row.frequencies_hz) row.frequencies_hz.forEach((_, i) => names.add(modeNames(row)[i] ?? i + 1));
  const list = [];
  for (const name of [...names].sort((a, b) => a - b)) {
    const at = (row) => (row.frequencies_hz ? row.frequencies_hz.findIndex((_, i) => (modeNames(row)[i] ?? i + 1) === name) : -1);
    const pick = (row, key) => { const i = at(row); return i < 0 || !row[key] ? null : row[key][i]; };
    const latest = rows.findLast((row) => at(row) >= 0);
    const [caption, , second] = captionOf(`Mode ${name}`, pair(pick(latest, "frequencies_hz"), pick(latest, "frequencies_std_hz"), "Hz"));
    const damping = pick(latest, "damping_ratio");
    if (known(damping)) second.textContent = `damping ${pair(damping, pick(latest, "damping_std"), "%", 100)}`;
    list.push([caption, drawn.map((row) => pick(row, "frequencies_hz")), drawn.map((row) => pick(row, "frequencies_std_hz")), 1, "Hz", null]);
  }
  $("modes-note").textContent = list.length ? "Line: estimate. Band: 95 % interval. A gap: no estimate." : "No modes yet.";
  place("modes", list, null);
}

function place(where, list, threshold) {
  const style = getComputedStyle(document.documentElement), colour = (name) => style.getPropertyValue(name).trim();
  fill(where);
  const times = drawn.map((row) => row.t_end_ns / 1e9);
  for (const [caption, values, stds, scale, unit, limits] of list) {
    const figure = element("figure"), box = element("div", null, { role: "img", "aria-label": `${caption.textContent}; over time from ${utc(rows[0].t_end_ns)} to ${utc(rows[rows.length - 1].t_end_ns)} UTC` });
    const second = caption.lastChild, usual = second.textContent;
    figure.append(caption, box);
    $(where).append(figure);
    const shift = (sign) => values.map((value, i) => (known(value) ? scale * (value + sign * SIGMAS * (known(stds[i]) ? stds[i] : 0)) : null));
    const axis = { stroke: colour("--soft"), grid: { stroke: colour("--line"), width: 1 }, ticks: { stroke: colour("--line"), width: 1 }, font: "12px system-ui, sans-serif" };
    const options = {
      width: Math.max(200, box.clientWidth), height: 150,
      tzDate: (seconds) => uPlot.tzDate(new Date(seconds * 1e3), "Etc/UTC"),
      cursor: { sync: { key: "time" }, y: false, points: { show: false }, drag: { x: false, y: false } },
      legend: { show: false },
      scales: { x: { time: true }, y: limits ? { range: limits } : {} },
      axes: [{ ...axis, space: 60, incrs: TIME_STEPS, values: timeLabels }, { ...axis, size: 58, values: (_, ticks) => ticks.map((t) => `${+t.toFixed(6)}${unit === "%" ? " %" : ""}`) }],
      series: [{}, { stroke: "transparent", points: { show: false } }, { stroke: "transparent", points: { show: false } },
        { stroke: colour("--mark"), width: 2, points: { show: rows.length < 3, size: 5, filter: (_, series, all) => (all ? null : lone(values)) } }],
      bands: [{ series: [1, 2], fill: colour("--band") }],
      hooks: {
        draw: threshold === null ? [] : [(chart) => dashed(chart, threshold, colour("--limit"))],
        setCursor: [({ cursor: { idx } }) => { // the values under the pointer, in place of what stands there otherwise
          const at = cursorText(idx, values, stds, scale, unit);
          if (second.textContent !== (at || usual)) second.textContent = at || usual;
        }],
      },
    };
    charts.push(new uPlot(options, [times, shift(1), shift(-1), values.map((v) => (known(v) ? scale * v : null))], box));
  }
}

function lone(values) { // where a value stands between two that are missing: a line would not show it
  return values.flatMap((value, i) => (known(value) && !known(values[i - 1]) && !known(values[i + 1]) ? [i] : []));
}

function cursorText(i, values, stds, scale, unit) {
  return known(i) && drawn[i] ? `${utc(drawn[i].t_end_ns, true)} UTC: ${known(values[i]) ? pair(values[i], stds[i], unit, scale) : drawn[i].skipped || "no estimate"}` : "";
}

function timeLabels(_, ticks) {
  let day = "";
  const fine = ticks.some((seconds) => seconds % 60); // else labels of one minute would be alike
  return ticks.map((seconds) => {
    const [date, time] = utc(seconds * 1e9, fine).split(" ");
    const first = date !== day;
    day = date;
    return first ? `${time}\n${date.slice(5)}` : time;
  });
}

function dashed(chart, value, colour) {
  const { ctx, bbox } = chart, y = chart.valToPos(value, "y", true);
  if (y < bbox.top || y > bbox.top + bbox.height) return;
  ctx.save();
  ctx.strokeStyle = colour;
  ctx.lineWidth = devicePixelRatio;
  ctx.setLineDash([6 * devicePixelRatio, 4 * devicePixelRatio]);
  ctx.beginPath();
  ctx.moveTo(bbox.left, y);
  ctx.lineTo(bbox.left + bbox.width, y);
  ctx.stroke();
  ctx.restore();
}

/* ---- lists ---- */

async function showAlarms() {
  const { alarms, event_alarms: ofEvents } = await ask("alarms");
  const events = ofEvents.map((a) => [
    tag("alarm"), `event ${a.id}: ${a.exceeded.join("; ")}`, "–", a.id.replace(/^(\d{4})(\d\d)(\d\d)T(\d\d)(\d\d).*/, "$1-$2-$3 $4:$5"),
    a.condition === "normal" ? `acknowledged${a.by ? ` by ${a.by}` : ""}` : "lasts",
  ]);
  table("alarms", ["Level", "Where", alarms.some((a) => known(a.change)) ? "Change" : "Lost", "Since", "Until"], [...events, ...alarms.map((a) => [
    tag(a.level), story(a.story || a.part), known(a.ddi) ? pair(a.ddi, a.ddi_std, "%", 100, 1) : known(a.change) ? pair(a.change, a.change_std, "%", 100, 1) : "–",
    utc(a.t_first_ns), a.t_last_ns ? utc(a.t_last_ns) : "lasts",
  ])], "No alarm so far.");
}

async function showFindings() {
  const { findings } = await ask("findings");
  if (!findings.length) return fill("findings", element("p", "No diagnosis so far. One is made when an alarm or a doubt asks for it.", { class: "quiet" }));
  const list = element("ul", null, { class: "items" });
  for (const one of findings) {
    const item = element("li");
    item.append(element("p", one.says || one.reason || "It says nothing."), element("p", `${utc(one.t_ns)} UTC; asked for by: ${one.reason || "–"}`, { class: "quiet" }));
    list.append(item);
  }
  fill("findings", list);
}

async function showEvents() {
  const { events } = await ask("events");
  table("events", ["Begin", "Lasted", "Peak acceleration", "Largest drift", "Verdict"], events.map((e) => {
    const peaks = Object.entries(e.peak_acceleration_m_s2 || {}).filter(([, v]) => known(v)).sort((a, b) => b[1] - a[1]);
    const drifts = (e.drift_peak_m || []).map((v, j) => [v, j]).filter(([v]) => known(v)).sort((a, b) => b[0] - a[0]);
    const least = (e.saturated || []).length || e.cut ? "at least " : "";
    return [
      utc(e.t_begin_ns, true), known(e.t_end_ns) ? `${((e.t_end_ns - e.t_begin_ns) / 1e9).toFixed(0)} s` : "lasts",
      peaks.length ? `${least}${number(peaks[0][1])} m/s² (${peaks[0][0]})` : "–",
      drifts.length ? `${least}${number(1e3 * drifts[0][0])} mm (${story(drifts[0][1] + 1)})` : "–",
      e.verdict || (e.revision === null ? "preliminary" : "no limit was judged"),
    ];
  }), "No strong motion so far.");
}

async function showSensors() {
  const { channels, stream, source, refused, quality } = await ask("sensors");
  const parts = [];
  if (source) parts.push(source.connected ? "Source connected" : source.ended ? "Source read to its end" : `Source not connected${source.error ? `: ${source.error}` : ""}`);
  if (source?.trouble) parts.push(source.trouble);
  if (stream) parts.push(`${number(stream.rate_hz, 5)} Hz`, `${(100 * stream.availability).toFixed(1)} % of the latest span came`);
  if (quality && known(quality.availability)) parts.push(`${(100 * quality.availability).toFixed(2)} % since the start, ${quality.gaps} gaps`);
  if (refused && refused.blocks) parts.push(`${refused.blocks} blocks refused`);
  $("stream").textContent = parts.join("; ");
  table("sensors", ["Channel", "In use", "RMS", "Peak", "Noise floor", "Remarks"], channels.map((c) => {
    const remarks = [
      c.reason, c.spikes > 0 && `${c.spikes} spikes`, c.clipped > 0 && `${(100 * c.clipped).toFixed(1)} % clipped`, c.repeated > 0.1 && `${(100 * c.repeated).toFixed(0)} % repeated`,
      c.lost > 0 && "samples lost", known(c.hum_hz) && `mains hum at ${number(c.hum_hz)} Hz`, c.step_m_s2 > 0 && "its offset stepped",
    ].filter(Boolean);
    return [
      c.channel, c.in_use ? "✓ yes" : "✗ no", known(c.rms_m_s2) ? `${number(c.rms_m_s2)} m/s²` : "–", known(c.peak_m_s2) ? `${number(c.peak_m_s2)} m/s²` : "–",
      known(c.noise_floor) ? `${number(c.noise_floor)} m/s²/√Hz` : "–", remarks.join("; ") || "none",
    ];
  }), "No sensor has been heard of yet.");
}

const SECTIONS = { alarms: showAlarms, windows: showWindows, findings: showFindings, events: showEvents, sensors: showSensors };

/* ---- begin ---- */

for (const select of document.querySelectorAll(".range")) {
  RANGES.forEach(([name, seconds]) => select.append(new Option(name === "all" ? "all that is kept" : `last ${name}`, seconds, seconds === range, seconds === range)));
  select.addEventListener("change", () => { range = Number(select.value); seen.windows = null; refresh(); });
}
$("quantity").addEventListener("change", draw);
$("login").addEventListener("submit", (event) => {
  event.preventDefault();
  sessionStorage.setItem("token", $("token").value.trim());
  $("token").value = "";
  refresh();
});
$("leave").addEventListener("click", () => { sessionStorage.removeItem("token"); location.reload(); });
let width = innerWidth, redraw = 0;
addEventListener("resize", () => {
  if (innerWidth === width) return; // a telephone's address bar comes and goes
  width = innerWidth;
  clearTimeout(redraw);
  redraw = setTimeout(() => rows.length && draw(), 150);
});
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => rows.length && draw());
setInterval(refresh, EVERY_MS);
refresh();
