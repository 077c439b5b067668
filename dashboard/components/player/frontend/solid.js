// The skeleton in three dimensions, by three.js.

import * as THREE from "./three.module.min.js";
import {
  DASHES,
  HEAD_M,
  SEEN,
  boneState,
  cameraLines,
  floorLines,
  palette,
  pointAt,
  trailStart,
} from "./figure.js";

const BONE_M = 0.02;
const JOINT_M = 0.03;
const UP = new THREE.Vector3(0, 1, 0);

export class SolidPainter {
  constructor(canvas, data) {
    this.data = data;
    // Throws where there is no WebGL; the player then draws flat.
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: true, alpha: true });
    this.renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
    this.camera = new THREE.PerspectiveCamera(34, 1, 0.05, 80);
    this.bones = data.meta.bones;
    this.scene = new THREE.Scene();
    this.#build();
  }

  #build() {
    const colours = palette();
    this.scene.clear();
    this.scene.add(new THREE.HemisphereLight(0xffffff, 0x8090a0, 2.6));
    const sun = new THREE.DirectionalLight(0xffffff, 1.1);
    sun.position.set(2, 4, 3);
    this.scene.add(sun);
    this.floor = lines([], colours.grid);
    this.scene.add(this.floor);
    for (const camera of this.data.meta.cameras)
      this.scene.add(lines(cameraLines(camera), colours.camera));
    const rod = new THREE.CylinderGeometry(1, 1, 1, 8, 1, true);
    const ball = new THREE.SphereGeometry(1, 12, 8);
    const full = () => new THREE.MeshLambertMaterial();
    const faded = () =>
      new THREE.MeshLambertMaterial({ transparent: true, opacity: 0.62, depthWrite: false });
    this.solid = instances(rod, full(), this.bones.length);
    this.dashed = instances(rod, faded(), this.bones.length * DASHES);
    this.joints = instances(ball, full(), this.data.nPoints);
    this.fadedJoints = instances(ball, faded(), this.data.nPoints);
    this.scene.add(this.solid, this.dashed, this.joints, this.fadedJoints);
    this.#paint(colours);
    this.trails = this.data.meta.hands.map((hand) => this.#trail(hand, colours));
    this.scene.add(...this.trails);
  }

  #paint(colours) {
    const sides = Object.fromEntries(
      Object.entries(colours).map(([side, colour]) => [side, new THREE.Color(colour)]),
    );
    this.boneColours = this.bones.map(([, , side]) => sides[side]);
    this.jointColours = this.data.meta.points.map(
      (name) => sides[/^(left|right)_/.exec(name)?.[1] ?? "middle"],
    );
  }

  /** A hand's whole path as pieces, of which a window is drawn; gaps have pieces of no length. */
  #trail(hand, colours) {
    const { data } = this;
    const places = new Float32Array(6 * Math.max(1, data.nFrames - 1));
    for (let frame = 0; frame + 1 < data.nFrames; frame += 1) {
      const [a, b] = [pointAt(data, frame, hand), pointAt(data, frame + 1, hand)];
      if (a && b) places.set([...a, ...b], 6 * frame);
    }
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(places, 3));
    const side = data.meta.points[hand].startsWith("left") ? "left" : "right";
    const line = new THREE.LineSegments(
      geometry,
      new THREE.LineBasicMaterial({ color: colours[side], transparent: true, opacity: 0.85 }),
    );
    line.frustumCulled = false;
    return line;
  }

  retheme() {
    this.#build();
    this.gridFor = null;
  }

  resize(width, height) {
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
  }

  draw(frame, orbit) {
    this.#placeFloor(orbit);
    this.#placeBones(frame);
    this.#placeJoints(frame);
    const start = trailStart(this.data, frame);
    for (const trail of this.trails) trail.geometry.setDrawRange(2 * start, 2 * (frame - start));
    this.camera.fov = heightAngle(orbit.field, this.camera.aspect);
    this.camera.position.set(...orbit.eye);
    this.camera.lookAt(...orbit.target);
    this.camera.updateProjectionMatrix();
    this.renderer.render(this.scene, this.camera);
  }

  #placeFloor(orbit) {
    const key = orbit.target.map((value) => value.toFixed(2)).join();
    if (this.gridFor === key) return;
    this.gridFor = key;
    this.floor.geometry.dispose();
    this.floor.geometry = lineGeometry(floorLines(orbit.target));
  }

  #placeBones(frame) {
    begin(this.solid, this.dashed);
    this.bones.forEach((bone, k) => {
      const state = boneState(this.data, frame, bone);
      if (state === "missing") return;
      const [a, b] = bone.slice(0, 2).map((point) => this.#vector(frame, point));
      if (state === "seen") add(this.solid, rodBetween(a, b), this.boneColours[k]);
      for (let d = 0; state === "doubtful" && d < DASHES; d += 1) {
        const [from, to] = [(d + 0.2) / DASHES, (d + 0.8) / DASHES];
        const piece = rodBetween(a.clone().lerp(b, from), a.clone().lerp(b, to));
        add(this.dashed, piece, this.boneColours[k]);
      }
    });
    finish(this.solid, this.dashed);
  }

  #placeJoints(frame) {
    begin(this.joints, this.fadedJoints);
    this.data.meta.points.forEach((name, k) => {
      const state = this.data.states[frame * this.data.nPoints + k];
      if (!state) return;
      const radius = name === "mid_ear" ? HEAD_M : JOINT_M;
      const matrix = new THREE.Matrix4().makeScale(radius, radius, radius);
      matrix.setPosition(this.#vector(frame, k));
      add(state === SEEN ? this.joints : this.fadedJoints, matrix, this.jointColours[k]);
    });
    finish(this.joints, this.fadedJoints);
  }

  #vector(frame, point) {
    return new THREE.Vector3(...pointAt(this.data, frame, point));
  }

  dispose() {
    this.renderer.dispose();
  }
}

/** Angle of view over the height, so that the shorter side of the picture spans the field. */
function heightAngle(fieldDeg, aspect) {
  const half = Math.tan((fieldDeg * Math.PI) / 360);
  return (360 / Math.PI) * Math.atan(half / Math.min(1, aspect));
}

function instances(geometry, material, count) {
  const mesh = new THREE.InstancedMesh(geometry, material, count);
  mesh.frustumCulled = false;
  for (let k = 0; k < count; k += 1) mesh.setColorAt(k, new THREE.Color()); // makes the buffer
  return mesh;
}

// Only what is there is drawn: meshes are filled anew for every sample.
function begin(...meshes) {
  for (const mesh of meshes) mesh.count = 0;
}

function add(mesh, matrix, colour) {
  mesh.setMatrixAt(mesh.count, matrix);
  mesh.setColorAt(mesh.count, colour);
  mesh.count += 1;
}

function finish(...meshes) {
  for (const mesh of meshes) {
    mesh.instanceMatrix.needsUpdate = true;
    if (mesh.instanceColor) mesh.instanceColor.needsUpdate = true;
  }
}

function rodBetween(a, b) {
  const along = b.clone().sub(a);
  const length = along.length();
  const turn = new THREE.Quaternion().setFromUnitVectors(UP, along.normalize());
  return new THREE.Matrix4().compose(
    a.clone().add(b).multiplyScalar(0.5),
    turn,
    new THREE.Vector3(BONE_M, length, BONE_M),
  );
}

function lineGeometry(pairs) {
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.Float32BufferAttribute(pairs.flat(2), 3));
  return geometry;
}

function lines(pairs, colour) {
  return new THREE.LineSegments(lineGeometry(pairs), new THREE.LineBasicMaterial({ color: colour }));
}
