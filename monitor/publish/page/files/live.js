"use strict";
/* Asks for the content of the live page every few seconds, and shows what has changed of it. */

const EVERY_MS = 5000;      // between two questions
const LATE_MS = 20000;      // without an answer: what is shown may be out of date
const RANGES = [["the last 6 hours", 6 * 3600], ["the last day", 86400], ["the last week", 7 * 86400], ["all that is kept", 0]];

let range = RANGES[1][1], heard = 0, busy = false, tag = "", etag = "";

class Refused extends Error {}

async function ask(path, headers = {}) {
  const token = sessionStorage.getItem("token");
  if (token) headers.Authorization = `Bearer ${token}`;
  const answer = await fetch(`api/v1/${path}`, { headers, cache: "no-store", signal: AbortSignal.timeout(15000) });
  if (answer.status === 401) throw new Refused();
  if (!answer.ok && answer.status !== 304) throw new Error(`${answer.status}`);
  return answer;
}

async function refresh() {
  if (busy) return;
  busy = true;
  try {
    const answer = await ask(`page?range_s=${range}&charts=${encodeURIComponent(tag)}`, etag ? { "If-None-Match": etag } : {});
    heard = Date.now();
    $("login").hidden = true;
    $("shown").hidden = false;
    $("leave").hidden = !sessionStorage.getItem("token");
    if (answer.status === 200) {
      etag = answer.headers.get("ETag");
      const { html, charts, tag: drawn, title } = await answer.json();
      show(html, charts);
      tag = drawn;
      document.title = title;
    }
  } catch (error) {
    if (error instanceof Refused) demandToken();
    else if (heard && $("live").textContent !== "no answer" && Date.now() - heard > LATE_MS) late();
  } finally {
    busy = false;
  }
}

/* Puts each part that has changed in place of the old one, and draws its charts. */
function show(html, charts) {
  const fresh = new DOMParser().parseFromString(html, "text/html");
  if (charts) content = { charts };
  const parts = [fresh.querySelector("header"), ...fresh.querySelectorAll("section")];
  const texts = new Map(parts.map((part) => [part.id, part.outerHTML]));
  const old = [...document.querySelectorAll("#content > header, #content section")];
  if (old.map((part) => part.id).join() !== parts.map((part) => part.id).join()) {
    $("content").replaceChildren(...fresh.body.children);
    show.seen = new Map();
  } else parts.forEach((part, i) => {
    if (texts.get(part.id) === show.seen.get(part.id)) return; // else it would be read out again
    for (const more of part.querySelectorAll("details")) more.open = $(more.id)?.open;
    old[i].replaceWith(part);
  });
  const drawn = charts || parts.some((part) => texts.get(part.id) !== show.seen.get(part.id) && texts.get(part.id).includes("<figure"));
  show.seen = texts;
  if (drawn) draw();
}
show.seen = new Map();

function late() {
  const clock = new Date(heard).toTimeString().slice(0, 8);
  $("state").className = "state not_judged";
  $("live").textContent = "no answer";
  $("headline").textContent = `The monitor has not answered since ${clock}. Before: ${$("word").textContent}: ${$("headline").textContent}`;
  $("word").textContent = "No answer";
  $("sign").textContent = "?";
  for (const part of document.querySelectorAll("#state small, #headline ~ p")) part.remove(); // what the earlier state asked for
  document.title = "No answer";
  etag = tag = "";
  show.seen = new Map();
}

function demandToken() {
  if (sessionStorage.getItem("token")) $("login-says").textContent = "This token is not the monitor's.";
  sessionStorage.removeItem("token");
  etag = tag = "";
  $("shown").hidden = true;
  $("login").hidden = false;
  $("token").focus();
}

RANGES.forEach(([name, seconds]) => $("range").append(new Option(name, seconds, seconds === range, seconds === range)));
$("range").addEventListener("change", () => { range = Number($("range").value); etag = tag = ""; refresh(); });
$("save").addEventListener("click", async () => {
  const url = URL.createObjectURL(await (await ask(`report?range_s=${range}`)).blob());
  Object.assign(document.createElement("a"), { href: url, download: "report.html" }).click();
});
$("login").addEventListener("submit", (event) => {
  event.preventDefault();
  sessionStorage.setItem("token", $("token").value.trim());
  $("token").value = "";
  refresh();
});
$("leave").addEventListener("click", () => { sessionStorage.removeItem("token"); location.reload(); });
setInterval(refresh, EVERY_MS);
refresh();
