// What both painters of the skeleton share: colours, the floor, and how to read a sample.

export const SEEN = 1;
export const TRAIL_S = 1.5;
export const DASHES = 4;
export const HEAD_M = 0.095;

export function palette() {
  const dark = document.documentElement.dataset.mode === "dark";
  return {
    left: "#409ce8",
    right: "#f06c1a",
    middle: dark ? "#d3dce4" : "#5c6975",
    grid: dark ? "#33414e" : "#cfd8e0",
    camera: dark ? "#8fa3b5" : "#6b7a88",
  };
}

/** A joint at one sample, or null where it is missing. */
export function pointAt(data, frame, point) {
  const at = frame * data.nPoints + point;
  if (!data.states[at]) return null;
  return [data.points[3 * at], data.points[3 * at + 1], data.points[3 * at + 2]];
}

/** Whether a bone is drawn in full, in dashes, or not at all. */
export function boneState(data, frame, [from, to]) {
  const a = data.states[frame * data.nPoints + from];
  const b = data.states[frame * data.nPoints + to];
  if (!a || !b) return "missing";
  return a === SEEN && b === SEEN ? "seen" : "doubtful";
}

/** First sample of the hands' path that is still drawn. */
export function trailStart(data, frame) {
  const since = data.time[frame] - TRAIL_S;
  let first = frame;
  while (first > 0 && data.time[first - 1] >= since) first -= 1;
  return first;
}

/** Lines of the floor, half a metre apart, as pairs of points. */
export function floorLines(target, half = 2) {
  const x0 = Math.round(target[0] * 2) / 2;
  const z0 = Math.round(target[2] * 2) / 2;
  const lines = [];
  for (let k = -half; k <= half; k += 0.5) {
    lines.push([[x0 + k, 0, z0 - half], [x0 + k, 0, z0 + half]]);
    lines.push([[x0 - half, 0, z0 + k], [x0 + half, 0, z0 + k]]);
  }
  return lines;
}

/** Edges of a camera's pyramid, as pairs of points. */
export function cameraLines({ eye, corners }) {
  const around = corners.map((corner, k) => [corner, corners[(k + 1) % 4]]);
  return [...corners.map((corner) => [eye, corner]), ...around];
}
