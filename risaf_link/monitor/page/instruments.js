// Compass, artificial horizon, and the meters of innovation and test ratio. All SVG.

const TAU = 2 * Math.PI;

function svg(name, attributes = {}, text = "") {
  const element = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  element.textContent = text;
  return element;
}

function add(parent, name, attributes, text) {
  return parent.appendChild(svg(name, attributes, text));
}

const at = (radius, angle) => [radius * Math.sin(angle), -radius * Math.cos(angle)];

function wedge(radius, from, to) {
  const large = to - from > Math.PI ? 1 : 0;
  return `M0 0L${at(radius, from)}A${radius} ${radius} 0 ${large} 1 ${at(radius, to)}Z`;
}

function arc(radius, from, to) {
  return `M${at(radius, from)}A${radius} ${radius} 0 ${to - from > Math.PI ? 1 : 0} 1 ${at(radius, to)}`;
}

const show = (element, isShown) => element.setAttribute("visibility", isShown ? "visible" : "hidden");

export class Compass { // angles from north, rad
  constructor(root) {
    add(root, "circle", { r: 84, fill: "none", stroke: "var(--edge)", "stroke-width": 1.5 });
    for (let d = 0; d < 360; d += 10) {
      const angle = d * TAU / 360, [x1, y1] = at(84, angle), [x2, y2] = at(d % 30 ? 80 : 75, angle);
      add(root, "line", { x1, y1, x2, y2, stroke: "var(--muted)", "stroke-width": d % 30 ? 0.8 : 1.5 });
    }
    ["N", "E", "S", "W"].forEach((letter, i) => {
      const [x, y] = at(97, i * TAU / 4);
      add(root, "text", { x, y, style: `font-weight:${i ? 500 : 800};font-size:15px` }, letter);
    });
    this.sector = add(root, "path", { fill: "var(--estimate)", opacity: 0.28 });
    this.gpsArc = add(root, "path", { fill: "none", stroke: "var(--gps)", "stroke-width": 5, opacity: 0.5 });
    this.gps = add(root, "g");
    add(this.gps, "line", { y1: -30, y2: -68, stroke: "var(--gps)", "stroke-width": 2, "stroke-dasharray": "4 3" });
    add(this.gps, "path", { d: "M0-84 8-68H-8Z", fill: "var(--card)", stroke: "var(--gps)", "stroke-width": 2.5 });
    this.needle = add(root, "path", { d: "M0-74 13 40 0 28-13 40Z", fill: "var(--estimate)" });
  }

  draw(yaw, yawStd, gps, gpsStd, isGpsOld) {
    for (const part of [this.needle, this.sector]) show(part, yaw !== null);
    for (const part of [this.gps, this.gpsArc]) show(part, gps !== null);
    if (yaw !== null) {
      this.needle.setAttribute("transform", `rotate(${yaw * 360 / TAU})`);
      const half = Math.min(2 * (yawStd ?? 0), Math.PI - 0.01);
      this.sector.setAttribute("d", wedge(84, yaw - half, yaw + half));
    }
    if (gps !== null) {
      this.gps.setAttribute("transform", `rotate(${gps * 360 / TAU})`);
      this.gps.setAttribute("opacity", isGpsOld ? 0.35 : 1);
      const half = Math.min(2 * (gpsStd ?? 0), Math.PI - 0.01);
      this.gpsArc.setAttribute("d", arc(87, gps - half, gps + half));
      show(this.gpsArc, !isGpsOld);
    }
  }
}

export class Horizon { // rad
  constructor(root) {
    const clip = add(add(root, "defs"), "clipPath", { id: "disc" });
    add(clip, "circle", { r: 84 });
    const world = add(root, "g", { "clip-path": "url(#disc)" });
    this.world = add(world, "g");
    add(this.world, "rect", { x: -200, y: -400, width: 400, height: 400, fill: "var(--sky)" });
    add(this.world, "rect", { x: -200, y: 0, width: 400, height: 400, fill: "var(--soil)" });
    add(this.world, "line", { x1: -200, x2: 200, stroke: "var(--text)", "stroke-width": 1.5 });
    for (const d of [-30, -20, -10, 10, 20, 30]) {
      const y = -d * 2.1;
      add(this.world, "line", { x1: -18, x2: 18, y1: y, y2: y, stroke: "var(--muted)" });
      add(this.world, "text", { x: 32, y }, `${Math.abs(d)}°`);
    }
    add(root, "circle", { r: 84, fill: "none", stroke: "var(--edge)", "stroke-width": 1.5 });
    add(root, "path", { d: "M-58 0H-22L-11 9M58 0H22L11 9", fill: "none", stroke: "var(--estimate)", "stroke-width": 4, "stroke-linejoin": "round" });
    add(root, "circle", { r: 3, fill: "var(--estimate)" });
    this.root = root;
  }

  draw(roll, pitch) {
    show(this.world, roll !== null);
    if (roll === null) return;
    const turn = 360 / TAU;
    this.world.setAttribute("transform", `rotate(${-roll * turn}) translate(0 ${pitch * turn * 2.1})`);
  }
}

export const judged = (ratio) => ratio > 1 ? "red" : ratio > 0.5 ? "amber" : "good";
const JUDGEMENTS = { good: "good", amber: "high", red: "rejected" };
const WIDTH = 300;

export class RatioMeter { // from 0 to 1.5; amber from 0.5, red from 1
  constructor(root) {
    const x = (ratio) => ratio / 1.5 * WIDTH;
    for (const [from, to, colour] of [[0, 0.5, "good"], [0.5, 1, "amber"], [1, 1.5, "red"]]) {
      add(root, "rect", { x: x(from), y: 8, width: x(to - from) - 1, height: 12, rx: 2, fill: `var(--${colour}-fill)`, opacity: 0.3 });
    }
    for (const mark of [0.5, 1]) add(root, "text", { x: x(mark), y: 31 }, mark);
    this.bar = add(root, "rect", { x: 0, y: 8, height: 12, rx: 2 });
    this.text = add(root, "text", { x: 0, y: 31, style: "text-anchor:start;font-size:14px;font-weight:650" });
  }

  draw(ratio) {
    const isKnown = ratio !== null && ratio !== undefined;
    this.text.textContent = isKnown ? `${ratio.toFixed(2)} ${JUDGEMENTS[judged(ratio)]}` : "–";
    this.text.setAttribute("class", isKnown ? judged(ratio) : "");
    this.text.style.fill = isKnown ? `var(--${judged(ratio)})` : "var(--muted)";
    this.bar.setAttribute("width", isKnown ? Math.min(ratio / 1.5, 1) * WIDTH : 0);
    this.bar.setAttribute("fill", isKnown ? `var(--${judged(ratio)}-fill)` : "none");
  }
}

export class InnovationMeter { // the innovation within its gate, deg
  constructor(root) {
    add(root, "rect", { x: 50, y: 8, width: 200, height: 12, rx: 2, fill: "var(--good-fill)", opacity: 0.25 });
    for (const x of [50, 150, 250]) add(root, "line", { x1: x, x2: x, y1: 4, y2: 24, stroke: "var(--muted)" });
    this.dot = add(root, "rect", { y: 3, width: 6, height: 22, rx: 2, stroke: "var(--card)" });
    this.low = add(root, "text", { x: 50, y: 34 });
    this.value = add(root, "text", { x: 150, y: 34, style: "font-size:14px;font-weight:650;fill:var(--text)" });
    this.high = add(root, "text", { x: 250, y: 34 });
  }

  draw(innovation, gate, ratio) {
    const isKnown = innovation !== null && gate !== null && gate > 0;
    show(this.dot, isKnown);
    this.value.textContent = innovation === null ? "–" : `${innovation >= 0 ? "+" : "−"}${Math.abs(innovation).toFixed(2)}°`;
    this.low.textContent = isKnown ? `gate −${gate.toFixed(1)}°` : "";
    this.high.textContent = isKnown ? `+${gate.toFixed(1)}°` : "";
    if (!isKnown) return;
    this.dot.setAttribute("x", 147 + 100 * Math.max(-1.47, Math.min(1.47, innovation / gate)));
    this.dot.setAttribute("fill", `var(--${judged(ratio)}-fill)`);
  }
}
