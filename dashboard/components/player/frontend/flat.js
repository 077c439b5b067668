// The same skeleton on a plain canvas, for computers without a graphics card.

import {
  HEAD_M,
  SEEN,
  boneState,
  cameraLines,
  floorLines,
  palette,
  pointAt,
  trailStart,
} from "./figure.js";

const NEAR_M = 0.05;

export class FlatPainter {
  constructor(canvas, data) {
    this.canvas = canvas;
    this.data = data;
    this.context = canvas.getContext("2d");
    this.colours = palette();
  }

  retheme() {
    this.colours = palette();
  }

  resize(width, height) {
    this.ratio = Math.min(window.devicePixelRatio, 2);
    Object.assign(this, { width, height });
    this.canvas.width = Math.round(width * this.ratio);
    this.canvas.height = Math.round(height * this.ratio);
  }

  draw(frame, orbit) {
    const { context: pen, colours, data } = this;
    pen.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
    pen.clearRect(0, 0, this.width, this.height);
    pen.lineCap = "round";
    this.#aim(orbit);
    for (const pair of floorLines(orbit.target)) this.#line(pair, colours.grid, 1);
    for (const camera of data.meta.cameras)
      for (const pair of cameraLines(camera)) this.#line(pair, colours.camera, 1.2);
    for (const hand of data.meta.hands) this.#trail(hand, frame);
    for (const bone of data.meta.bones) {
      const state = boneState(data, frame, bone);
      if (state === "missing") continue;
      pen.setLineDash(state === "seen" ? [] : [6, 6]);
      this.#line([pointAt(data, frame, bone[0]), pointAt(data, frame, bone[1])], colours[bone[2]], 4);
      pen.setLineDash([]);
    }
    data.meta.points.forEach((name, k) => this.#joint(name, frame, k));
  }

  #joint(name, frame, point) {
    const place = pointAt(this.data, frame, point);
    const at = place && this.#project(place);
    if (!at) return;
    const head = name === "mid_ear";
    const side = /^(left|right)_/.exec(name)?.[1] ?? "middle";
    const seen = this.data.states[frame * this.data.nPoints + point] === SEEN;
    const { context: pen } = this;
    pen.globalAlpha = seen ? 1 : 0.6;
    pen.fillStyle = this.colours[side];
    pen.beginPath();
    pen.arc(...at, head ? this.#size(place, HEAD_M) : 3.4, 0, 7);
    pen.fill();
    pen.globalAlpha = 1;
  }

  /** How large a length appears at a place, in px. */
  #size(place, length) {
    const { eye, ahead, scale } = this.view;
    return (scale * length) / dot(place.map((value, axis) => value - eye[axis]), ahead);
  }

  #trail(hand, frame) {
    const side = this.data.meta.points[hand].startsWith("left") ? "left" : "right";
    for (let k = trailStart(this.data, frame); k < frame; k += 1) {
      const pair = [pointAt(this.data, k, hand), pointAt(this.data, k + 1, hand)];
      if (pair[0] && pair[1]) this.#line(pair, this.colours[side], 1.5);
    }
  }

  /** Axes of the picture: right, up, and towards what is looked at. */
  #aim(orbit) {
    const eye = orbit.eye;
    const ahead = unit(orbit.target.map((value, axis) => value - eye[axis]));
    const right = unit(cross(ahead, [0, 1, 0]));
    const half = (orbit.field * Math.PI) / 360;
    const scale = Math.min(this.height, this.width) / 2 / Math.tan(half);
    this.view = { eye, ahead, right, up: cross(right, ahead), scale };
  }

  #project(point) {
    const { eye, ahead, right, up, scale } = this.view;
    const away = point.map((value, axis) => value - eye[axis]);
    const depth = dot(away, ahead);
    if (depth < NEAR_M) return null;
    return [
      this.width / 2 + (scale * dot(away, right)) / depth,
      this.height / 2 - (scale * dot(away, up)) / depth,
    ];
  }

  #line([a, b], colour, width) {
    const [from, to] = [this.#project(a), this.#project(b)];
    if (!from || !to) return;
    this.context.strokeStyle = colour;
    this.context.lineWidth = width;
    this.context.beginPath();
    this.context.moveTo(...from);
    this.context.lineTo(...to);
    this.context.stroke();
  }

  dispose() {}
}

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const unit = (a) => a.map((value) => value / Math.hypot(...a));
const cross = (a, b) => [
  a[1] * b[2] - a[2] * b[1],
  a[2] * b[0] - a[0] * b[2],
  a[0] * b[1] - a[1] * b[0],
];
