// The page: takes updates as they come and shows them. Angles and rates arrive in rad, and are shown in deg.

import { SensorArray } from "./array.js";
import { Compass, Horizon, InnovationMeter, RatioMeter } from "./instruments.js";
import { Timeline } from "./timeline.js";
import * as words from "./words.js";
import { compassDeg, deg, deviation, number, signed } from "./words.js";

const STALE_S = 2; // without a message: it is said, plainly
const CUT_MS = 3000; // without an update: the program that serves the page has gone
const REDRAW_MS = 450; // of the lines over time, which are dear
const MOST_ROWS = 3000, MOST_EVENTS = 200;
const PER_HOUR = 3600;
const [TIME, YAW, YAW_STD, GPS, INNOVATION, GATE, RATIO, STATE, ROLL, PITCH, ROLL_STD, PITCH_STD, RATE, BIAS, BIAS_STD, HEALTHY, SUSPECT, DEAD] = Array(18).keys();
const AXES = ["x", "y", "z"], COLOURS = ["--estimate", "--gps", "--third"];

const $ = (id) => document.getElementById(id);
const instruments = {
  compass: new Compass($("compass")), horizon: new Horizon($("horizon")),
  innovation: new InnovationMeter($("innovation")), ratio: new RatioMeter($("ratio")),
};
const sensors = new SensorArray($("cells"), $("legend"), $("sensor"), $("modes"));
const past = { rows: [], span: 180, cursorUs: null, nowUs: 0, playback: null, view: null };

const degOf = (i) => (row) => deg(row[i]);
const axis = (i, k, factor = 1) => (row) => row[i][k] === null ? null : deg(row[i][k]) * factor;
const timelines = [
  { title: "Heading", unit: "deg", wraps: 360, least: 20, lines: [
    { label: "GPS", colour: "--gps", value: (row) => compassDeg(row[GPS]), dots: true },
    { label: "estimated ± 2σ", colour: "--estimate", value: (row) => compassDeg(row[YAW]), band: (row) => 2 * deg(row[YAW_STD]) },
  ] },
  { title: "Deviation of heading", unit: "deg", from: 0, least: 0.5, digits: 2, lines: [{ label: "σ", colour: "--estimate", value: (row) => row[YAW] === null ? null : deg(row[YAW_STD]) }] },
  { title: "Innovation", unit: "deg", least: 1, digits: 2, lines: [
    { label: "gate ±", colour: "--good", value: (row) => row[GATE] === null ? null : 0, band: degOf(GATE), tell: degOf(GATE) },
    { label: "innovation", colour: "--estimate", value: degOf(INNOVATION), dots: true },
  ] },
  { title: "Test ratio", unit: "", from: 0, least: 1.2, digits: 2, marks: [{ level: 0.5, colour: "--amber" }, { level: 1, colour: "--red" }], lines: [
    { label: "amber 0.5, red 1", colour: "--estimate", value: (row) => row[RATIO], dots: true },
  ] },
  { title: "Roll and pitch", unit: "deg", least: 2, lines: [
    { label: "roll ± 2σ", colour: "--estimate", value: degOf(ROLL), band: (row) => 2 * deg(row[ROLL_STD]) },
    { label: "pitch ± 2σ", colour: "--gps", value: degOf(PITCH), band: (row) => 2 * deg(row[PITCH_STD]) },
  ] },
  { title: "Fused rate", unit: "deg/s", least: 2, digits: 2, lines: AXES.map((label, k) => ({ label, colour: COLOURS[k], value: axis(RATE, k) })) },
  { title: "Bias ± σ", unit: "deg/h", least: 10, digits: 0, lines: AXES.map((label, k) => ({ label, colour: COLOURS[k], value: axis(BIAS, k, PER_HOUR), band: axis(BIAS_STD, k, PER_HOUR) })) },
  { title: "Sensors", unit: "", from: 0, least: 3, digits: 0, lines: [
    { label: "healthy", colour: "--good", value: (row) => row[HEALTHY] },
    { label: "suspect", colour: "--amber", value: (row) => row[SUSPECT] },
    { label: "dead", colour: "--red", value: (row) => row[DEAD] },
  ] },
].map((plan) => new Timeline($("timelines"), plan));

function text(id, value) {
  const element = $(id);
  if (element.textContent !== value) element.textContent = value;
}

function showHeading(known, isOut) {
  const h = known?.heading;
  instruments.compass.draw(h?.yaw ?? null, h?.yaw_std, h?.gps ?? null, h?.gps_std, isOut);
  text("yaw", number(compassDeg(h?.yaw), 1, "°"));
  text("yaw-std", deviation(h?.yaw === null ? null : deg(h?.yaw_std), 2, "°"));
  text("gps", number(compassDeg(h?.gps), 1, "°"));
  text("gps-std", isOut ? " (last)" : deviation(deg(h?.gps_std), 1, "°"));
  text("speed-now", number(h?.speed, 1, " m/s"));
}

function showFusion(known, silence, isOut) {
  const h = known?.heading;
  const [word, kind, sign] = words.STATES[h?.state] ?? ["not known", "", "?"];
  text("state", word);
  $("state").className = `state ${kind}`;
  $("state").dataset.sign = sign;
  $("fusion").classList.toggle("old", isOut);
  document.title = h ? `${number(compassDeg(h.yaw))}° ${word}` : "risaf_link";
  const since = h?.time_since_fused ?? null;
  text("since", since === null ? "no heading was fused yet" : `last fused ${words.ageText(since + silence)} ago`);
  instruments.innovation.draw(deg(h?.innovation), deg(known?.gate), h?.test_ratio ?? 0);
  instruments.ratio.draw(h?.test_ratio);
  text("fused", number(h?.fused));
  text("rejected", number(h?.rejected));
  text("made-from", h ? words.SOURCES[h.source] ?? "–" : "–");
}

function showAttitude(known) {
  const a = known?.attitude, d = known?.deviations;
  instruments.horizon.draw(a?.roll ?? null, a?.pitch ?? null);
  text("roll", signed(deg(a?.roll), 2, "°"));
  text("pitch", signed(deg(a?.pitch), 2, "°"));
  text("roll-std", deviation(deg(d?.roll), 2, "°"));
  text("pitch-std", deviation(deg(d?.pitch), 2, "°"));
  const bias = (k) => known?.bias[k] ?? null, std = (k) => known?.bias_std[k] ?? null;
  fill($("rates").tBodies[0], AXES.map((name, k) => [
    name,
    signed(deg(known?.array?.rate[k]), 2) + deviation(deg(known?.array?.rate_std[k]), 3),
    bias(k) === null ? "–" : signed(deg(bias(k)) * PER_HOUR, 0) + deviation(std(k) === null ? null : deg(std(k)) * PER_HOUR, 0),
    number(known?.array?.active[k]),
  ]));
}

// Put texts into a table's cells, and no new elements where there are some.
function fill(body, rows) {
  while (body.rows.length > rows.length) body.deleteRow(-1);
  rows.forEach((cells, i) => {
    const row = body.rows[i] ?? body.insertRow();
    cells.forEach((value, k) => {
      const cell = row.cells[k] ?? row.insertCell();
      if (cell.textContent !== value) cell.textContent = value;
    });
  });
}

function showArray(known) {
  const a = known?.array;
  $("census").innerHTML = a ? `<b class="good">${a.healthy}</b> healthy, <b class="amber">${a.suspect}</b> suspect, <b class="red">${a.dead}</b> dead of ${a.sensors}` : "–";
  text("epochs", number(a?.epochs));
  text("incomplete", number(a?.epochs_incomplete));
  text("lost", number(a?.samples_lost));
}

function showHeard(update) {
  update.heard.forEach((h, i) => { if ($("heard").rows[i]) $("heard").rows[i].title = `${number(h.bytes_per_s / 1000, 1)} kB/s`; });
  fill($("heard"), update.heard.map((h) => [
    words.who(h).join(" · "),
    number(h.frames_per_s, 1),
    h.loss === null ? "–" : number(100 * h.loss, 1, " %"),
    h.trip_us === null ? "–" : number(h.trip_us / 1000, 1),
    words.ageText((update.now_us - h.heard_us) / 1e6).replace(" s", ""),
  ]));
  $("refused").hidden = !refused(update);
  text("refused", refused(update));
}

function refused(update) {
  const counts = Object.entries(update.rejected).map(([reason, count]) => `${number(count)} ${words.REJECTIONS[reason] ?? reason}`);
  return counts.length ? `Frames refused: ${counts.join(", ")}.` : "";
}

function showEvents(update) {
  const list = $("events");
  for (const event of update.events) {
    const item = document.createElement("li");
    const kind = event.severity <= 3 ? "red" : event.severity === 4 ? "amber" : "";
    for (const [name, className, value] of [
      ["time", "", words.timeText(event.time_us, update.playback)],
      ["span", `severity ${kind}`, words.SEVERITIES[event.severity] ?? "?"],
      ["span", "", `${event.text} `],
    ]) item.append(Object.assign(document.createElement(name), { className, textContent: value }));
    item.lastChild.append(Object.assign(document.createElement("small"), { textContent: `${event.system}:${event.component}` }));
    list.prepend(item);
  }
  while (list.children.length > MOST_EVENTS) list.lastChild.remove();
}

function showFreshness(update, silence) {
  const isStale = silence !== null && silence > STALE_S, body = document.body.classList;
  body.remove("waiting", "stale", "fresh", "cut");
  body.add(silence === null ? "waiting" : isStale ? "stale" : "fresh");
  const kind = update.playback ? "log" : "live";
  text("freshness", silence === null ? `${kind}: nothing yet` : `${kind} · last message ${words.ageText(silence)} ago`);
  const others = update.heard.length ? `${update.heard.length} other component${update.heard.length > 1 ? "s" : ""} heard, see Links.` : refused(update) || "Nothing is heard at all.";
  text("notice", silence === null ? `No risaf_link component is heard${update.playback ? " up to this point of the log" : " yet"}. ${others}`
    : isStale ? `No data for ${words.ageText(silence)}: what is shown is old.` : "");
}

function showPlayer(update) {
  const p = update.playback;
  $("player").hidden = !p;
  text("source", update.source);
  text("clock", p ? `${new Date(update.now_us / 1000).toISOString().replace("T", " ").slice(0, 19)} UTC` : words.timeText(update.now_us));
  if (!p) return;
  text("play", p.is_paused ? "▶" : "❚❚");
  $("play").dataset.paused = p.is_paused;
  $("seek").max = (p.end_us - p.begin_us) / 1e6;
  if (!seeking) $("seek").value = (update.now_us - p.begin_us) / 1e6;
  text("position", words.elapsed((update.now_us - p.begin_us) / 1e6));
  text("length", words.elapsed((p.end_us - p.begin_us) / 1e6));
  if ($("speed") !== document.activeElement) $("speed").value = String(p.speed);
}

function showChoice(update) {
  const found = [...new Set(update.heard.filter((h) => h.is_estimator).map((h) => `${h.system}:${h.component}`))];
  $("choice").hidden = found.length < 2;
  const select = $("chosen");
  if (found.join() !== select.dataset.found) {
    select.dataset.found = found.join();
    select.replaceChildren(...found.map((name) => new Option(name)));
  }
  if (select !== document.activeElement) select.value = update.chosen?.join(":") ?? "";
}

function drawPast() {
  const style = getComputedStyle(document.documentElement);
  const { begin_us: beginUs, end_us: endUs } = past.playback ?? { begin_us: 0, end_us: Infinity };
  const spanUs = Math.min(past.span * 1e6, endUs - beginUs), fromUs = Math.max(beginUs, past.nowUs - spanUs);
  const toUs = fromUs + spanUs;
  past.view = {
    fromUs, toUs, cursorUs: past.cursorUs, zeroUs: beginUs,
    timeText: (us) => words.timeText(us, past.playback),
    isOut: (row) => row[STATE] === words.DEAD_RECKONING,
    colour: (name) => style.getPropertyValue(name),
  };
  const first = past.rows.findIndex((row) => row[TIME] >= fromUs);
  const rows = first < 0 ? [] : past.rows.slice(first);
  for (const timeline of timelines) timeline.draw(rows, past.view);
}

let seeking = false, lastUpdateMs = 0, lastDrawnMs = 0, drawing = 0;

function show(update) {
  lastUpdateMs = performance.now();
  if (update.is_new) {
    past.rows = [];
    $("events").replaceChildren();
    sensors.clear();
  }
  past.rows.push(...update.rows);
  if (past.rows.length > MOST_ROWS) past.rows.splice(0, past.rows.length - MOST_ROWS);
  Object.assign(past, { nowUs: update.now_us, playback: update.playback });
  const known = update.known, silence = known ? Math.max(0, update.now_us - known.heard_us) / 1e6 : null;
  showPlayer(update);
  showChoice(update);
  showFreshness(update, silence);
  const isOut = known?.heading?.state === words.DEAD_RECKONING;
  showHeading(known, isOut);
  showFusion(known, silence > STALE_S ? silence : 0, isOut);
  showAttitude(known);
  showArray(known);
  if (update.sensors) sensors.draw(update.sensors);
  showHeard(update);
  showEvents(update);
  if (update.is_new || lastUpdateMs - lastDrawnMs > REDRAW_MS) {
    lastDrawnMs = lastUpdateMs;
    drawing ||= requestAnimationFrame(() => { drawing = 0; drawPast(); });
  }
}

let updates = null;

function listen(of = "") {
  updates?.close();
  updates = new EventSource(`updates${of ? `?of=${of}` : ""}`);
  updates.onmessage = (event) => show(JSON.parse(event.data));
}

setInterval(() => {
  if (!lastUpdateMs || performance.now() - lastUpdateMs < CUT_MS) return;
  document.body.classList.remove("waiting", "fresh", "stale");
  document.body.classList.add("cut");
  text("freshness", "page cut off");
  text("notice", "The program that serves this page does not answer. What is shown is old.");
  if (updates.readyState === EventSource.CLOSED) listen($("chosen").value);
}, 1000);

function play(wish) {
  return fetch("play", { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(wish) });
}

$("play").onclick = () => play({ is_paused: $("play").dataset.paused !== "true" });
$("speed").onchange = (event) => { play({ speed: Number(event.target.value) }); event.target.blur(); };
$("seek").oninput = () => { seeking = true; };
$("seek").onchange = async (event) => {
  await play({ seek_us: past.playback.begin_us + Number(event.target.value) * 1e6 });
  seeking = false;
};
$("chosen").onchange = (event) => { listen(event.target.value); event.target.blur(); };
$("span").onchange = (event) => { past.span = Number(event.target.value); drawPast(); };
for (const timeline of timelines) {
  timeline.canvas.onpointermove = (event) => { past.cursorUs = timeline.timeAt(event.clientX, past.view); drawPast(); };
  timeline.canvas.onpointerleave = () => { past.cursorUs = null; drawPast(); };
}
window.addEventListener("resize", drawPast);
listen();
