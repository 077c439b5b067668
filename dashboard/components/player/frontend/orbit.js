// Where the skeleton is seen from: turned by dragging or arrow keys, with fixed views to go back to.

export const VIEWS = {
  oblique: { azimuth: 50, elevation: 14 },
  side: { azimuth: 90, elevation: 4 },
  front: { azimuth: 0, elevation: 4 },
  top: { azimuth: 89.9, elevation: 89 },
};
const FIELD_DEG = 34;

export class Orbit {
  constructor(points, cameras) {
    this.field = FIELD_DEG;
    this.body = bounds(points);
    this.room = bounds(points, cameras.map((camera) => camera.eye));
    this.show("oblique");
  }

  show(view) {
    const room = view === "room";
    const box = room ? this.room : this.body;
    Object.assign(this, room ? { azimuth: 35, elevation: 28 } : VIEWS[view]);
    this.target = [...box.middle];
    this.distance = (1.06 * box.radius) / Math.sin(((FIELD_DEG / 2) * Math.PI) / 180);
  }

  turn(dx, dy) {
    this.azimuth -= 0.45 * dx;
    this.elevation = Math.min(89, Math.max(-10, this.elevation + 0.45 * dy));
  }

  zoom(factor) {
    this.distance = Math.min(30, Math.max(0.8, this.distance * factor));
  }

  /** Position of the eye; azimuth 0 looks at the person's front, 90 at their right. */
  get eye() {
    const azimuth = (this.azimuth * Math.PI) / 180;
    const elevation = (this.elevation * Math.PI) / 180;
    const [x, y, z] = this.target;
    const flat = this.distance * Math.cos(elevation);
    return [
      x + flat * Math.cos(azimuth),
      y + this.distance * Math.sin(elevation),
      z + flat * Math.sin(azimuth),
    ];
  }
}

function bounds(points, more = []) {
  const low = [Infinity, 0, Infinity];
  const high = [-Infinity, 1.6, -Infinity];
  const take = (value, axis) => {
    if (!Number.isFinite(value)) return;
    low[axis] = Math.min(low[axis], value);
    high[axis] = Math.max(high[axis], value);
  };
  for (let i = 0; i < points.length; i += 1) take(points[i], i % 3);
  for (const point of more) point.forEach(take);
  if (!Number.isFinite(low[0])) return { middle: [0, 0.85, 0], radius: 1 };
  const middle = low.map((value, axis) => (value + high[axis]) / 2);
  const size = Math.hypot(...low.map((value, axis) => high[axis] - value));
  return { middle, radius: Math.max(0.6, size / 2) };
}
