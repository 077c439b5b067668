// Angle curves with their 95 % bands. A plot is drawn once; only dots and numbers move.

import { fill, make } from "./dom.js";

const LIGHT = ["#0072b2", "#c24e00", "#007a59"];
const DARK = ["#6bc0f0", "#ff9e5e", "#4fd3a8"];
const DASHES = [[], [7, 4], [2, 3]];
const TOP = 8;
const BOTTOM = 8;
const STEPS_DEG = [5, 10, 15, 20, 30, 45, 60, 90, 180];

export class Plot {
  constructor(data, group, words) {
    Object.assign(this, { data, group, words });
    this.canvas = make("canvas", { role: "img", "aria-label": this.#describe() });
    this.keys = group.curves.map((curve, k) => this.#key(curve, k));
    this.dots = group.curves.map(() => make("span", { class: "dot", "aria-hidden": "true" }));
    const head = make("div", { class: "plot-head" }, make("b", {}, group.title));
    head.append(...this.keys.map((key) => key.element));
    this.field = make("div", { class: "plot-field" }, this.canvas, ...this.dots);
    this.element = make("div", { class: "plot" }, head, this.field);
  }

  #key({ label }, k) {
    const value = make("span", { class: "number" });
    const line = make("i", { class: `dash dash-${k}`, "aria-hidden": "true" });
    return { value, line, element: make("span", { class: "key" }, line, label, value) };
  }

  #describe() {
    const parts = this.group.curves.map(({ label, column }) => {
      const { low, high, missing } = this.#extent(column);
      if (!Number.isFinite(low)) return fill(this.words.curve_missing, { label });
      return fill(this.words.curve, {
        label,
        low: low.toFixed(0),
        high: high.toFixed(0),
        missing: (100 * missing).toFixed(0),
      });
    });
    return `${this.group.title}. ${parts.join(" ")}`;
  }

  #extent(column) {
    const { values, nAngles, nFrames } = this.data;
    let [low, high, missing] = [Infinity, -Infinity, 0];
    for (let frame = 0; frame < nFrames; frame += 1) {
      const value = values[frame * nAngles + column];
      if (Number.isFinite(value)) [low, high] = [Math.min(low, value), Math.max(high, value)];
      else missing += 1;
    }
    return { low, high, missing: missing / nFrames };
  }

  /** Range of all curves with their bands, and where the lines of the grid go. */
  #scale() {
    let [low, high] = [0, 10];
    const { values, halves, nAngles, nFrames } = this.data;
    for (const { column } of this.group.curves)
      for (let frame = 0; frame < nFrames; frame += 1) {
        const value = values[frame * nAngles + column];
        if (!Number.isFinite(value)) continue;
        const half = Math.min(halves[frame * nAngles + column] || 0, 45);
        low = Math.min(low, value - half);
        high = Math.max(high, value + half);
      }
    const step = STEPS_DEG.find((size) => (high - low) / size <= 4) ?? 180;
    return { low, high, step };
  }

  /** Draw what does not move. */
  draw(axis, height) {
    const ratio = Math.min(window.devicePixelRatio, 2);
    this.axis = axis;
    this.height = height;
    this.canvas.style.height = `${height}px`;
    this.canvas.width = Math.round(axis.width * ratio);
    this.canvas.height = Math.round(height * ratio);
    const pen = this.canvas.getContext("2d");
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, axis.width, height);
    this.range = this.#scale();
    const style = getComputedStyle(document.documentElement);
    const dark = document.documentElement.dataset.mode === "dark";
    this.colours = dark ? DARK : LIGHT;
    this.#grid(pen, style);
    pen.save();
    pen.beginPath();
    pen.rect(axis.left, 0, axis.right - axis.left, height);
    pen.clip();
    this.group.curves.forEach((curve, k) => this.#band(pen, curve.column, this.colours[k]));
    this.group.curves.forEach((curve, k) => this.#curve(pen, curve.column, this.colours[k], k));
    pen.restore();
    this.keys.forEach(({ line }, k) => (line.style.color = this.colours[k]));
    this.dots.forEach((dot, k) => (dot.style.background = this.colours[k]));
  }

  #y(value) {
    const { low, high } = this.range;
    return TOP + ((high - value) / (high - low)) * (this.height - TOP - BOTTOM);
  }

  #grid(pen, style) {
    const { left, right } = this.axis;
    pen.fillStyle = "rgba(120,140,160,0.13)";
    for (const lift of this.data.meta.lifts) {
      if (lift.start === null || lift.end === null) continue;
      const from = this.axis.x(lift.start);
      pen.fillRect(from, 0, this.axis.x(lift.end) - from, this.height);
    }
    pen.font = `12px ${style.getPropertyValue("--font")}`;
    pen.fillStyle = style.getPropertyValue("--quiet");
    pen.textAlign = "right";
    pen.textBaseline = "middle";
    const { low, high, step } = this.range;
    for (let value = Math.ceil(low / step) * step; value <= high; value += step) {
      const y = Math.round(this.#y(value)) + 0.5;
      pen.strokeStyle = value === 0 ? "rgba(140,155,170,0.7)" : "rgba(140,155,170,0.28)";
      pen.beginPath();
      pen.moveTo(left, y);
      pen.lineTo(right, y);
      pen.stroke();
      pen.fillText(`${String(value).replace("-", "−")}°`, left - 6, y);
    }
  }

  #band(pen, column, colour) {
    const { values, halves, nAngles, time } = this.data;
    pen.fillStyle = colour;
    pen.globalAlpha = 0.17;
    const edge = (frame, sign) => {
      const at = frame * nAngles + column;
      return [this.axis.x(time[frame]), this.#y(values[at] + sign * halves[at])];
    };
    for (const [first, end] of this.#runs(column, true)) {
      pen.beginPath();
      for (let frame = first; frame < end; frame += 1) pen.lineTo(...edge(frame, 1));
      for (let frame = end - 1; frame >= first; frame -= 1) pen.lineTo(...edge(frame, -1));
      pen.fill();
    }
    pen.globalAlpha = 1;
  }

  #curve(pen, column, colour, k) {
    const { values, marks, nAngles, time } = this.data;
    const place = (frame) => [
      this.axis.x(time[frame]),
      this.#y(values[frame * nAngles + column]),
    ];
    pen.strokeStyle = colour;
    pen.lineWidth = 2;
    pen.lineJoin = "round";
    pen.setLineDash(DASHES[k]);
    for (const [first, end] of this.#runs(column, false)) {
      pen.beginPath();
      for (let frame = first; frame < end; frame += 1) pen.lineTo(...place(frame));
      if (end - first === 1) pen.arc(...place(first), 1.2, 0, 7); // a lone sample is still seen
      pen.stroke();
    }
    pen.setLineDash([]);
    pen.lineWidth = 1.2;
    for (let frame = 0; frame < time.length; frame += 1) {
      if (!marks[frame * nAngles + column] || !Number.isFinite(values[frame * nAngles + column]))
        continue;
      pen.beginPath();
      pen.arc(...place(frame), 2.6, 0, 7);
      pen.stroke();
    }
  }

  /** Stretches without a gap, as [first, end). */
  *#runs(column, withBand) {
    const { values, halves, nAngles, nFrames } = this.data;
    let first = -1;
    for (let frame = 0; frame <= nFrames; frame += 1) {
      const at = frame * nAngles + column;
      const there =
        frame < nFrames && Number.isFinite(values[at]) && (!withBand || Number.isFinite(halves[at]));
      if (there && first < 0) first = frame;
      if (!there && first >= 0) {
        yield [first, frame];
        first = -1;
      }
    }
  }

  /** Move dots and numbers to a sample. */
  move(frame) {
    const { values, halves, nAngles, time } = this.data;
    this.group.curves.forEach(({ column }, k) => {
      const value = values[frame * nAngles + column];
      const half = halves[frame * nAngles + column];
      const there = Number.isFinite(value);
      const around = Number.isFinite(half) ? ` ± ${half.toFixed(0)}` : "";
      const text = there ? `${value.toFixed(0).replace("-", "−")}${around}°` : this.words.not_seen;
      if (this.keys[k].value.textContent !== text) this.keys[k].value.textContent = text;
      this.dots[k].style.opacity = there ? 1 : 0;
      if (there)
        this.dots[k].style.transform =
          `translate(${this.axis.x(time[frame])}px, ${this.#y(value)}px)`;
    });
  }
}
