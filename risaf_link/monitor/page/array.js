// The array: a cell a sensor.

import { deg, number, REASONS, SENSOR_STATES, signed } from "./words.js";

// cividis (Nuñez, Anderton, Renslow 2018) at nine places, without its darkest end: signs stand on it.
const SCALE = ["#35456c", "#4b546c", "#5f636e", "#737475", "#878479", "#9f9677", "#b8a971", "#d3bd65", "#fee838"];
const STATE_FILLS = ["var(--good-fill)", "var(--amber-fill)", "var(--red-fill)"];
const SIGNS = ["", "!", "✕"];
const BIAS_COUNT = 1e-5; // rad/s
const LEAST_SCALE = 0.05; // deg/s: biases that are all small are not made to look large

const biasOf = (bias) => bias && bias.map((count) => deg(count * BIAS_COUNT)); // deg/s

function colourAt(share) {
  const place = Math.max(0, Math.min(1, share)) * (SCALE.length - 1);
  const k = Math.min(Math.floor(place), SCALE.length - 2), mix = Math.round((place - k) * 100);
  return `color-mix(in srgb, ${SCALE[k + 1]} ${mix}%, ${SCALE[k]})`;
}

export class SensorArray {
  constructor(cells, legend, detail, modes) {
    Object.assign(this, { cells, legend, detail, sensors: null, pointed: null });
    this.mode = modes.elements ? modes.querySelector(":checked").value : "bias";
    modes.addEventListener("change", (event) => { this.mode = event.target.value; this.#paint(); });
    for (const kind of ["pointerover", "focusin", "click"]) {
      cells.addEventListener(kind, (event) => {
        const index = event.target.closest(".cell")?.dataset.index;
        if (index !== undefined) this.#point(Number(index));
      });
    }
  }

  draw(sensors) {
    this.sensors = sensors;
    this.#paint();
  }

  clear() {
    this.sensors = null;
    this.pointed = null;
    this.cells.replaceChildren();
    this.legend.replaceChildren();
    this.detail.textContent = "No sensor is known yet.";
  }

  #paint() {
    if (!this.sensors) return;
    const { state, rejected, bias } = this.sensors;
    while (this.cells.children.length > state.length) this.cells.lastChild.remove();
    while (this.cells.children.length < state.length) this.cells.append(this.#cell(this.cells.children.length));
    const sizes = bias.map((b) => b && Math.max(...biasOf(b).map(Math.abs)));
    const healthy = sizes.filter((size, i) => size !== null && state[i] === 0);
    const most = Math.max(LEAST_SCALE, ...healthy);
    state.forEach((s, i) => {
      const cell = this.cells.children[i];
      const fills = { bias: sizes[i] === null ? "" : colourAt(sizes[i] / most), rejected: rejected[i] === null ? "" : colourAt(rejected[i] / 100), state: STATE_FILLS[s] ?? "" };
      cell.style.setProperty("--fill", fills[this.mode] || "var(--edge)");
      cell.style.setProperty("--rejected", (rejected[i] ?? 0) / 100);
      if (cell.dataset.state !== String(s)) {
        cell.dataset.state = s;
        cell.replaceChildren(...(SIGNS[s] ? [Object.assign(document.createElement("span"), { textContent: SIGNS[s] })] : []));
      }
      const label = `sensor ${i}, ${SENSOR_STATES[s] ?? "not known"}`;
      if (cell.title !== label) { cell.title = label; cell.setAttribute("aria-label", label); }
    });
    this.#tellLegend(most);
    if (this.pointed !== null) this.#point(this.pointed);
    else this.detail.textContent = "Point at a sensor, or tap it.";
  }

  #cell(index) {
    const cell = document.createElement("button");
    cell.type = "button";
    cell.className = "cell";
    cell.dataset.index = index;
    return cell;
  }

  #tellLegend(most) {
    const key = `${this.mode} ${most.toFixed(3)}`;
    if (this.legend.dataset.key === key) return;
    this.legend.dataset.key = key;
    const gradient = `<span class="scale" style="background:linear-gradient(90deg,${SCALE.join()})"></span>`;
    const scales = {
      bias: `0 ${gradient} ${most.toFixed(2)} deg/s, worst axis`,
      rejected: `0 ${gradient} 100 % rejected`,
      state: `<span><i class="cell" data-state="0" style="--fill:var(--good-fill)"></i>healthy</span>`,
    };
    this.legend.innerHTML = `${scales[this.mode]} <span><i class="cell" data-state="1"><span>!</span></i>suspect</span>
      <span><i class="cell" data-state="2"><span>✕</span></i>dead</span> <span>bar: rejected</span>`;
  }

  #point(index) {
    const { state, rejected, bias, reason } = this.sensors ?? {};
    this.cells.querySelector(".pointed")?.classList.remove("pointed");
    if (!state || index >= state.length) { this.pointed = null; return; }
    this.pointed = index;
    this.cells.children[index].classList.add("pointed");
    const why = REASONS[reason[index] ?? 0];
    const axes = biasOf(bias[index])?.map((b) => signed(b, 3)).join(", ") ?? "–";
    this.detail.textContent = `Sensor ${index}: ${SENSOR_STATES[state[index]] ?? "not told yet"}${why ? ` (${why})` : ""}; `
      + `relative bias ${axes} deg/s; ${number(rejected[index])} % rejected`;
  }
}
