// Lines over time on a canvas. All of them share one span and one cursor.

import { number } from "./words.js";

const MARGIN = { left: 46, right: 8, top: 8, bottom: 20 };
const GAP_S = 1.5; // between two rows: the line is broken
const STEPS = [1, 2, 5, 10];
const TURN_STEPS = [5, 10, 15, 30, 45, 90]; // deg
const OUTLIERS = 0.02; // share of dots and bands, at either end, that does not set the range
const TIME_STEPS = [5, 10, 15, 30, 60, 120, 300];

function niceStep(range, count) {
  const rough = range / count, power = 10 ** Math.floor(Math.log10(rough));
  return power * STEPS.find((step) => step * power >= rough * 0.999);
}

// A panel. `lines`: { label, colour, value(row), dots, band(row), tell(row) }, in the unit of the panel, the
// leading one last; `marks`: levels with a colour; `wraps`: 360 where values go round; `least`: the smallest
// range shown; `from`: where it begins.
export class Timeline {
  constructor(parent, { title, unit, lines, marks = [], wraps = 0, least = 1, from = null, digits = 1 }) {
    Object.assign(this, { unit, lines, marks, wraps, least, from, digits });
    const box = parent.appendChild(document.createElement("div"));
    box.className = "timeline";
    const head = box.appendChild(document.createElement("h3"));
    head.innerHTML = `${title} <span>${unit}</span>`;
    this.values = lines.map(({ label, colour, dots }) => {
      const key = head.appendChild(document.createElement("span"));
      key.innerHTML = `<i style="color:var(${colour})">${dots ? "●" : "▬"}</i> ${label} <b></b>`;
      return key.lastChild;
    });
    this.canvas = box.appendChild(document.createElement("canvas"));
    this.canvas.setAttribute("role", "img");
    this.canvas.setAttribute("aria-label", title);
  }

  // rows: of the past, oldest first; view: { fromUs, toUs, cursorUs, timeText, isOut(row), colour(name) }
  draw(rows, view) {
    const { canvas } = this, ratio = window.devicePixelRatio || 1;
    const width = canvas.clientWidth, height = canvas.clientHeight;
    if (!width) return;
    if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
      canvas.width = Math.round(width * ratio);
      canvas.height = Math.round(height * ratio);
    }
    const c = canvas.getContext("2d");
    c.setTransform(ratio, 0, 0, ratio, 0, 0);
    c.clearRect(0, 0, width, height);
    c.font = "11px system-ui, 'DejaVu Sans', sans-serif";
    if (this.wraps) {
      const { value } = this.lines.at(-1), row = rows.findLast((r) => value(r) !== null);
      this.middle = row ? value(row) : 0;
    }
    for (const line of this.lines) line.shown = this.#unwrapped(line);
    const [low, high] = this.#range(rows);
    const x = (us) => MARGIN.left + (us - view.fromUs) / (view.toUs - view.fromUs) * (width - MARGIN.left - MARGIN.right);
    const y = (value) => height - MARGIN.bottom - (value - low) / (high - low) * (height - MARGIN.top - MARGIN.bottom);
    this.#shade(c, rows, x, height, view);
    this.#axes(c, low, high, x, y, width, height, view);
    c.save();
    c.beginPath();
    c.rect(MARGIN.left, MARGIN.top - 2, width - MARGIN.left - MARGIN.right, height - MARGIN.top - MARGIN.bottom + 4);
    c.clip();
    for (const line of this.lines) this.#line(c, line, rows, x, y, [low, high], view);
    c.restore();
    if (rows.length && !rows.some((row) => this.lines.some(({ value }) => value(row) !== null))) {
      c.fillStyle = view.colour("--muted");
      c.textAlign = "center";
      c.fillText("not told", width / 2, height / 2);
    }
    this.#tell(c, rows, x, height, view);
  }

  // What goes round is shown around its last value, so that its course has no jump there.
  #unwrapped({ value }) {
    if (!this.wraps) return value;
    const middle = this.middle, turn = this.wraps;
    return (row) => {
      const v = value(row);
      return v === null ? null : v - turn * Math.round((v - middle) / turn);
    };
  }

  #range(rows) {
    const lows = [], highs = [], inside = this.marks.map(({ level }) => level);
    for (const { band, dots, shown } of this.lines) {
      for (const row of rows) {
        const v = shown(row);
        if (v === null) continue;
        const half = band ? Math.min(band(row) ?? 0, this.wraps / 2 || Infinity) : 0;
        if (!dots) inside.push(v);
        lows.push(v - half);
        highs.push(v + half);
      }
    }
    lows.sort((a, b) => b - a);
    highs.sort((a, b) => a - b);
    const last = Math.floor((lows.length - 1) * (1 - OUTLIERS));
    let low = Math.min(lows[last] ?? Infinity, ...inside), high = Math.max(highs[last] ?? -Infinity, ...inside);
    if (low > high) [low, high] = [0, 0];
    if (this.from !== null) low = this.from;
    const room = Math.max(high - low, this.least), middle = (low + high) / 2;
    if (this.from === null) return [middle - 0.54 * room, middle + 0.54 * room];
    return [low, low + 1.08 * room];
  }

  #shade(c, rows, x, height, view) {
    c.fillStyle = view.colour("--shade");
    let since = null;
    rows.forEach((row, i) => {
      const isOut = view.isOut(row), isLast = i === rows.length - 1;
      if (isOut && since === null) since = row[0];
      if (since !== null && (!isOut || isLast)) {
        c.fillRect(x(since), MARGIN.top, Math.max(1, x(row[0]) - x(since)), height - MARGIN.top - MARGIN.bottom);
        since = null;
      }
    });
  }

  #axes(c, low, high, x, y, width, height, view) {
    c.strokeStyle = view.colour("--grid");
    c.fillStyle = view.colour("--muted");
    c.lineWidth = 1;
    c.textAlign = "right";
    c.textBaseline = "middle";
    const step = this.wraps ? TURN_STEPS.find((s) => s >= (high - low) / 5) ?? 90 : niceStep(high - low, 4);
    const digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
    const label = (value) => (this.wraps ? ((value % this.wraps) + this.wraps) % this.wraps : value);
    c.beginPath();
    for (let value = Math.ceil(low / step - 1e-9) * step; value <= high + 1e-9; value += step) {
      c.moveTo(MARGIN.left, y(value));
      c.lineTo(width - MARGIN.right, y(value));
      c.fillText(number(label(value), digits), MARGIN.left - 6, y(value));
    }
    c.stroke();
    c.textAlign = "center";
    c.textBaseline = "top";
    const seconds = (view.toUs - view.fromUs) / 1e6;
    const stepUs = 1e6 * (TIME_STEPS.find((s) => s >= seconds / (width / 80)) ?? 600);
    for (let us = Math.ceil((view.fromUs - view.zeroUs) / stepUs) * stepUs + view.zeroUs; us <= view.toUs; us += stepUs) {
      if (x(us) > MARGIN.left + 14 && x(us) < width - 24) c.fillText(view.timeText(us), x(us), height - MARGIN.bottom + 5);
    }
    for (const { level, colour } of this.marks) {
      c.strokeStyle = view.colour(colour);
      c.setLineDash([5, 4]);
      c.beginPath();
      c.moveTo(MARGIN.left, y(level));
      c.lineTo(width - MARGIN.right, y(level));
      c.stroke();
      c.setLineDash([]);
    }
  }

  #line(c, { shown: value, band, dots, colour }, rows, x, y, [low, high], view) {
    c.strokeStyle = c.fillStyle = view.colour(colour);
    if (dots) { // those that are out of range stand at its edge
      for (const row of rows) {
        const v = value(row);
        if (v !== null) c.fillRect(x(row[0]) - 1.5, y(Math.max(low, Math.min(high, v))) - 1.5, 3, 3);
      }
      return;
    }
    for (const run of this.#runs(rows, value)) {
      if (band) {
        c.globalAlpha = 0.22;
        c.beginPath();
        for (const row of run) c.lineTo(x(row[0]), y(value(row) + (band(row) ?? 0)));
        for (const row of run.toReversed()) c.lineTo(x(row[0]), y(value(row) - (band(row) ?? 0)));
        c.fill();
        c.globalAlpha = 1;
      }
      c.lineWidth = 1.7;
      c.lineJoin = "round";
      c.beginPath();
      for (const row of run) c.lineTo(x(row[0]), y(value(row)));
      c.stroke();
    }
  }

  // Rows that follow one another: without gaps, and without going round.
  #runs(rows, value) {
    const runs = [];
    let before = null;
    for (const row of rows) {
      const v = value(row);
      if (v === null) continue;
      const turned = this.wraps && before ? Math.abs(v - value(before)) : 0;
      const isBroken = !before || row[0] - before[0] > GAP_S * 1e6 || turned > this.wraps / 2;
      if (isBroken) runs.push([]);
      runs.at(-1).push(row);
      before = row;
    }
    return runs;
  }

  // The values at the cursor; without one, the last.
  #tell(c, rows, x, height, view) {
    let row = rows.at(-1);
    if (view.cursorUs !== null && rows.length) {
      row = rows.reduce((best, r) => Math.abs(r[0] - view.cursorUs) < Math.abs(best[0] - view.cursorUs) ? r : best);
      c.strokeStyle = view.colour("--muted");
      c.lineWidth = 1;
      c.beginPath();
      c.moveTo(x(row[0]), MARGIN.top);
      c.lineTo(x(row[0]), height - MARGIN.bottom);
      c.stroke();
    }
    this.lines.forEach(({ value, tell = value }, i) => {
      const told = row && rows.findLast((r) => r[0] <= row[0] && value(r) !== null);
      const v = told ? tell(told) : null;
      this.values[i].textContent = number(v ?? null, this.digits);
    });
  }

  timeAt(clientX, view) {
    const box = this.canvas.getBoundingClientRect();
    const share = (clientX - box.left - MARGIN.left) / (box.width - MARGIN.left - MARGIN.right);
    return share < 0 || share > 1 ? null : view.fromUs + share * (view.toUs - view.fromUs);
  }
}
