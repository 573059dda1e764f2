"use strict";
/* Draws the charts that a page's content holds: uPlot has the axes and the pointer, the marks are drawn here. */

const LINES = { // of a kind of mark: colour, width, and what dashes it
  measured: ["--ink", 1], after: ["--after", 1.6], before: ["--before", 1.3], limit: ["--bad", 1.2], chosen: ["--before", 1.2],
  pole: ["--quiet", 3], stable: ["--after", 4.5], dashed: [],
};
const AREAS = { // colour and opacity
  band: ["--after", .25], off: ["--before", .18], still: ["--bad", .25], used: ["--after", .6], known: ["--muted", .13],
  unjudged: ["--muted", .3], cut: ["--quiet", .55], chance: ["--quiet", .25],
};
const PALETTE = [[24, 24, 62], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]]; // from weak to strong
const STEPS_S = [[1, [1, 2, 5, 10, 15, 30]], [60, [1, 2, 5, 10, 15, 30]], [3600, [1, 2, 3, 6, 12]], [86400, [1, 2, 4, 7, 14, 30, 60, 90, 180, 365, 730, 1825]]]
  .flatMap(([unit, counts]) => counts.map((count) => unit * count));
const LABEL_PX = 70, RIGHT_PX = 20, FONT = "12px system-ui, sans-serif";
const $ = (id) => document.getElementById(id);
let content = { charts: {} }, plots = [];

function utc(seconds, fine = true) { return new Date(seconds * 1e3).toISOString().slice(0, fine ? 19 : 16).replace("T", " "); }
const known = (x) => x !== null && x !== undefined;
const number = (x) => (x !== 0 && (Math.abs(x) < 1e-3 || Math.abs(x) >= 1e6) ? (+x.toPrecision(4)).toExponential().replace("+", "") : String(+x.toPrecision(5)));

/* Round times of each stretch [begin, end, from, to] (s since 1970; shares of the width) that fit: [share, label]. */
function timeTicks(stretches, width) {
  const out = [];
  let day = "", free = -Infinity;
  for (const [begin, end, from, to] of stretches) {
    const most = Math.max(1, Math.floor((to - from) * width / LABEL_PX));
    const step = STEPS_S.find((s) => (end - begin) / s <= most) || 86400 * 3650;
    const times = [];
    for (let t = Math.ceil(begin / step) * step; t <= end; t += step) times.push(t);
    for (const t of times.length || stretches.length < 2 ? times : [begin]) {
      const share = from + (t - begin) / (end - begin) * (to - from);
      if (share * width < free) continue;
      free = share * width + LABEL_PX;
      const [date, time] = utc(t, step < 60).split(" ");
      out.push([share, step >= 86400 ? date : date === day ? time : `${time}\n${date}`]);
      day = date;
    }
  }
  return out;
}

function timeAt(stretches, share) {
  const [begin, end, from, to] = stretches.find((s) => share <= s[3]) || stretches.at(-1);
  return share < from ? null : begin + (share - from) / (to - from) * (end - begin);
}

/* Powers of ten within a range, and multiples of them where it has few. */
function decades(low, high) {
  const wide = Math.log10(high / low), every = Math.max(1, Math.round(wide / 5)), out = [];
  const fine = wide > 2 ? [1] : wide > 0.6 ? [1, 2, 5] : [1, 1.2, 1.5, 2, 3, 5, 7, 8];
  for (let k = Math.floor(Math.log10(low)); k <= Math.ceil(Math.log10(high)); k += wide > 2 ? every : 1)
    for (const m of fine) if (m * 10 ** k >= low * .999 && m * 10 ** k <= high * 1.001) out.push(+(m * 10 ** k).toPrecision(3));
  return out;
}

function cut(text, px) {
  const ctx = cut.ctx ||= document.createElement("canvas").getContext("2d");
  ctx.font = FONT;
  if (ctx.measureText(text).width <= px) return text;
  while (text && ctx.measureText(`${text}…`).width > px) text = text.slice(0, -1);
  return `${text}…`;
}

function paint(chart, spec, colour) {
  const { ctx, bbox } = chart, dpr = devicePixelRatio, [low, high] = spec.y;
  const px = (x) => chart.valToPos(x, "x", true), py = (y) => chart.valToPos(Math.min(high, Math.max(low, y)), "y", true);
  const stroke = (kind) => {
    ctx.setLineDash(kind.includes("dashed") ? [5 * dpr, 3 * dpr] : []);
    const [name, width] = LINES[kind.split(" ")[0]];
    Object.assign(ctx, { strokeStyle: colour(name), lineWidth: width * dpr, lineJoin: "round", lineCap: "round" });
  };
  const area = (kind) => { ctx.fillStyle = colour(AREAS[kind][0]); ctx.globalAlpha = AREAS[kind][1]; };
  const path = (xs, ys, from, to) => { for (let i = from; i < to; i++) ctx.lineTo(px(xs[i]), py(ys[i])); };
  const marks = {
    line({ x, y, low: l, high: h, kind }) { // in pieces, between values that are missing; one alone is a point
      for (let i = 0; i < x.length; i++) {
        let end = i;
        while (end < x.length && known(y[end])) end++;
        if (end === i + 1) marks.dots({ x: [x[i]], y: [y[i]], half: l ? [h[i] - y[i]] : null });
        if (end > i + 1) {
          if (l) {
            ctx.beginPath(); area("band"); path(x, h, i, end);
            for (let k = end - 1; k >= i; k--) ctx.lineTo(px(x[k]), py(l[k]));
            ctx.fill(); ctx.globalAlpha = 1;
          }
          ctx.beginPath(); stroke(kind); path(x, y, i, end); ctx.stroke();
        }
        i = end;
      }
    },
    dots({ x, y, half, kind = "stable" }) {
      x.forEach((at, i) => {
        if (half && half[i] > 0) { ctx.beginPath(); stroke("measured"); ctx.moveTo(px(at), py(y[i] - half[i])); ctx.lineTo(px(at), py(y[i] + half[i])); ctx.stroke(); }
        ctx.beginPath(); ctx.fillStyle = colour(LINES[kind][0]); ctx.arc(px(at), py(y[i]), LINES[kind][1] / 2 * dpr, 0, 7); ctx.fill();
      });
    },
    shade({ x, y, kind }) {
      const [a, b] = x.map(px), [bottom, top] = (y || spec.y).map(py);
      area(kind); ctx.fillRect(a, top, b - a, bottom - top); ctx.globalAlpha = 1;
    },
    grid({ x, y, rows, columns, levels, signed }) { // a picture of levels, one byte each, the top row first
      const canvas = Object.assign(document.createElement("canvas"), { width: columns, height: rows }), inner = canvas.getContext("2d");
      const picture = inner.createImageData(columns, rows), bytes = atob(levels);
      for (let i = 0; i < bytes.length; i++) {
        const level = bytes.charCodeAt(i), signedLevel = (level - 128) / 127, at = level / 255 * (PALETTE.length - 1), k = Math.min(PALETTE.length - 2, Math.floor(at));
        const rgb = signed ? (signedLevel > 0 ? [194, 53, 43] : [22, 104, 184]) : PALETTE[k].map((c, j) => c + (at - k) * (PALETTE[k + 1][j] - c));
        picture.data.set([...rgb, signed ? 255 * Math.abs(signedLevel) : 255], 4 * i);
      }
      inner.putImageData(picture, 0, 0);
      ctx.imageSmoothingEnabled = false;
      ctx.drawImage(canvas, px(x[0]), py(y[1]), px(x[1]) - px(x[0]), py(y[0]) - py(y[1]));
    },
  };
  ctx.save();
  ctx.beginPath();
  ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
  ctx.clip();
  for (const mark of spec.marks) marks[mark.is](mark);
  ctx.restore();
}

function plot(figure, spec) {
  const box = figure.querySelector(".plot"), now = figure.querySelector(".now"), usual = now.textContent, width = Math.max(200, box.clientWidth);
  const style = getComputedStyle(document.documentElement), colour = (name) => style.getPropertyValue(name).trim();
  const main = spec.marks.findLast((m) => m.is !== "shade" && m.is !== "grid" && m.x.length > 2 && m.x.every((x, i) => !i || x >= m.x[i - 1]));
  const axis = { stroke: colour("--muted"), grid: { stroke: colour("--line"), width: .5 }, ticks: { show: false }, font: FONT, gap: 6 };
  const left = spec.y_names ? Math.min(160, width * .34) : 58, inside = width - left - RIGHT_PX;
  const times = spec.stretches && timeTicks(spec.stretches, inside), given = (pairs) => ({ splits: () => pairs.map((p) => p[0]), values: () => pairs.map((p) => p[1]) });
  const bottom = times ? given(times) : spec.x_names ? given(spec.x_names.map((name, i) => [i, cut(name, inside / spec.x_names.length)])) : { space: 60, values: (_, at) => at.map(number) };
  const side = spec.y_names ? given(spec.y_names.map((name, i) => [spec.y_names.length - .5 - i, cut(name, left - 8)]))
    : spec.log ? given(decades(...spec.y).map((y) => [y, number(y)])) : spec.height < 40 ? given([]) : { space: 26, values: (_, at) => at.map(number) };
  const under = (times ? 40 : 24) + (spec.x_title ? 18 : 0);
  const options = {
    width, height: spec.height + under + 10, padding: [8, RIGHT_PX, 0, 0], legend: { show: false }, series: [{}, { paths: () => null, points: { show: false } }],
    scales: { x: { time: false, range: spec.x }, y: { range: spec.y, distr: spec.log ? 3 : 1 } },
    axes: [{ ...axis, ...bottom, size: times ? 40 : 24, ...(spec.x_title && { label: spec.x_title, labelSize: 18, labelGap: 0, labelFont: FONT }) }, { ...axis, ...side, size: left }],
    cursor: { y: false, points: { show: false }, drag: { x: false, y: false }, ...(times && { sync: { key: "time" } }) },
    hooks: {
      draw: [(chart) => paint(chart, spec, colour)],
      setCursor: [({ cursor: { idx: i } }) => { // the values under the pointer, in place of what stands there otherwise
        const at = main && known(i) && main.x[i], when = times && known(i) && timeAt(spec.stretches, at);
        const band = main && main.low ? ` (${number(main.low[i] ?? 0)} to ${number(main.high[i] ?? 0)})` : main && main.half ? ` ± ${number(main.half[i] ?? 0)}` : "";
        const said = main && known(i) && known(at) ? `${times ? (known(when) ? `${utc(when)} UTC` : "no data") : number(at)}: ${known(main.y[i]) ? number(main.y[i]) + band : "no estimate"}` : usual;
        if (now.textContent !== said) now.textContent = said;
      }],
    },
  };
  return new uPlot(options, main ? [main.x, main.y] : [spec.x, [null, null]], box);
}

function draw() {
  for (const one of plots) one.destroy();
  plots = [];
  for (const figure of document.querySelectorAll("figure[data-chart]")) {
    const spec = content.charts[figure.dataset.chart];
    if (spec && figure.querySelector(".plot").clientWidth) plots.push(plot(figure, spec));
  }
}

let width = innerWidth, redraw = 0;
addEventListener("resize", () => {
  if (innerWidth === width) return; // a telephone's address bar comes and goes
  width = innerWidth;
  clearTimeout(redraw);
  redraw = setTimeout(draw, 150);
});
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
addEventListener("toggle", draw, true);
for (const [name, paper] of [["beforeprint", true], ["afterprint", false]]) {
  addEventListener(name, () => { document.documentElement.classList.toggle("paper", paper); draw(); });
}
if ($("data")) { content = JSON.parse($("data").textContent); draw(); }
