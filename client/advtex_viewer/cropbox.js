// The box over the viewer: its edges, all outside of it darkened, and handles for mouse, fingers and arrow keys.
//
// `box` is in the scan's world and `place` the same in that of model.glb (`box.js`), in which everything here is computed.

import { LEAST, boundsOf, corner, parseBox, placed, rounded, scanToGlb, upAxis } from "./box.js";
import { along, dot, minus, rotated, transposed, viewerCamera } from "./cameras.js";
import { el } from "./element.js";
import { Outside } from "./outside.js";

export const NAMES = "XYZ";
export const [STEP, TURN] = [0.01, 1]; // metres and degrees of an arrow key; ten times as much with Shift
const ROUNDING = 0.002; // metres that the box around the model is larger by: no face may lie on its border
const NEAR = 0.01; // metres before the camera: what is nearer is not drawn
const ACROSS = 40; // degrees of the view that shows all of the box
const ABOVE = 55; // degrees from the up axis, of that view
const DENSEST = 2; // pixels of the canvas per pixel of the page
const CORNERS = [0, 1, 2, 3, 4, 5, 6, 7];
const EDGES = CORNERS.flatMap((from) => [1, 2, 4].filter((bit) => !(from & bit)).map((bit) => [from, from | bit]));
const TURNS_BY = 7; // the corner
const KEYS = { ArrowRight: [1, 1], ArrowLeft: [1, -1], ArrowUp: [2, 1], ArrowDown: [2, -1], PageUp: [3, 1], PageDown: [3, -1] };

export class CropBox {
  /** mesh: of `triangles`. option: the box to begin with, as its option has it; null for one around the model. */
  constructor(viewer, stage, stand, mesh, option) {
    Object.assign(this, { viewer, stage, stand, onChange: () => {} });
    this.toGlb = scanToGlb(mesh.rotation);
    const bounds = boundsOf(mesh.positions, this.toGlb);
    this.whole = rounded({ ...bounds, size: bounds.size.map((side) => side + ROUNDING) });
    this.canvas = el("canvas", { class: "overlay", "aria-hidden": true });
    this.lines = EDGES.map(() => el("svg:line"));
    this.layer = el("div", { class: "overlay", hidden: true }, this.canvas, el("svg:svg", { class: "overlay box", "aria-hidden": "true" }, this.lines));
    this.outside = new Outside(this.canvas, mesh);
    this.set(option ? parseBox(option) : this.whole);
    this.handles = this.made();
    viewer.after(this.layer);
    viewer.addEventListener("camera-change", () => this.draw());
    new ResizeObserver(() => this.draw()).observe(stage);
  }

  set(box) {
    this.box = rounded(box);
    this.place = placed(this.box, this.toGlb);
  }

  /** settled: not in the middle of a drag. */
  change(part, settled = true) {
    this.set({ ...this.box, ...part });
    this.draw();
    this.onChange(settled);
  }

  show(on) {
    this.layer.hidden = !on;
    if (on) this.frame();
  }

  /** The viewer looks at all of the model and of the box, from above. */
  frame() {
    const { viewer, stage, stand } = this;
    const whole = placed(this.whole, this.toGlb);
    const reach = Math.max(...CORNERS.flatMap((index) => [whole, this.place].map((found) => Math.hypot(...minus(corner(found, index), whole.center)))));
    const across = ((ACROSS * Math.PI) / 180) * Math.min(1, stage.clientWidth / stage.clientHeight);
    viewer.dispatchEvent(new CustomEvent("camera-change", { detail: { source: "user-interaction" } })); // a photograph at its camera goes
    viewer.cameraTarget = rotated(stand, whole.center).map((metres) => `${metres}m`).join(" ");
    viewer.fieldOfView = `${ACROSS}deg`;
    const distance = reach / Math.sin(across / 2);
    viewer.maxCameraOrbit = `auto 180deg ${2 * distance}m`; // by itself it stays nearer to the model
    viewer.cameraOrbit = `${viewer.getCameraOrbit().theta}rad ${ABOVE}deg ${distance}m`;
    viewer.updateComplete.then(() => { viewer.jumpCameraToGoal(); this.draw(); });
  }

  // What can be done with it. Vectors are in the world of model.glb.

  /** Moves one side along its axis; the opposite one stays. */
  push(axis, side, metres, settled) {
    const size = Math.max(LEAST, this.box.size[axis] + metres);
    const outward = this.inScan(this.place.axes[axis]);
    this.change({ size: this.box.size.with(axis, size), center: along(this.box.center, outward, (side * (size - this.box.size[axis])) / 2) }, settled);
  }

  shift(vector, settled) {
    this.change({ center: along(this.box.center, this.inScan(vector), 1) }, settled);
  }

  turn(degrees, settled) {
    this.change({ yaw: this.box.yaw + degrees }, settled);
  }

  inScan(vector) { return rotated(transposed(this.toGlb), vector); }

  // Handles: each has a place, what a drag from one ray to another does, and what a key does, which is [number, step].

  made() {
    const { axis: up, sign } = upAxis(this.toGlb);
    const side = (axis, way) => this.handle(`Side of ${way > 0 ? "most" : "least"} ${NAMES[axis]}`, "face",
      () => along(this.place.center, this.place.axes[axis], way * this.place.half[axis]), (from, to) => this.pull(axis, way, from, to),
      ([, step]) => this.push(axis, way, step * STEP));
    const move = ([number, step]) => this.shift(along([0, 0, 0], this.place.axes[(up + number) % 3], step * STEP * (number === 3 ? sign : 1)));
    return [
      ...[0, 1, 2].flatMap((axis) => [side(axis, -1), side(axis, 1)]),
      this.handle("Middle of the box", "middle", () => this.place.center, (from, to) => this.carry(from, to), move),
      this.handle("Turn of the box", "swing", () => corner(this.place, TURNS_BY), (from, to) => this.swing(from, to), ([, step]) => this.turn(step * TURN)),
    ];
  }

  handle(name, kind, where, drag, press) {
    const knob = el("button", { type: "button", class: `knob ${kind}`, "aria-label": name, title: name });
    let held = null;
    knob.addEventListener("pointerdown", (event) => {
      event.preventDefault();
      knob.focus();
      knob.setPointerCapture(event.pointerId);
      held = { ray: this.rayOf(event), box: this.box };
    });
    knob.addEventListener("pointermove", (event) => {
      if (!held) return;
      this.set(held.box); // all of the way at once: rounding would add up
      drag(held.ray, this.rayOf(event));
    });
    for (const end of ["pointerup", "pointercancel"]) {
      knob.addEventListener(end, () => {
        if (held) this.change({});
        held = null;
      });
    }
    knob.addEventListener("keydown", (event) => {
      const key = KEYS[event.key];
      if (!key) return;
      event.preventDefault();
      press([key[0], key[1] * (event.shiftKey ? 10 : 1)]);
    });
    this.layer.append(knob);
    return { knob, where };
  }

  pull(axis, way, from, to) {
    const point = along(this.place.center, this.place.axes[axis], way * this.place.half[axis]);
    const outward = this.place.axes[axis].map((value) => way * value);
    const [begin, end] = [from, to].map((ray) => nearest(point, outward, this.camera.eye, ray));
    if (begin !== null && end !== null) this.push(axis, way, end - begin, false);
  }

  /** Parallel to the picture. */
  carry(from, to) {
    const depth = dot(minus(this.place.center, this.camera.eye), this.camera.axes[2]);
    this.shift(minus(to, from).map((value) => depth * value), false);
  }

  /** By the angle about the middle, seen from above. */
  swing(from, to) {
    const level = corner(this.place, TURNS_BY)[1] - this.camera.eye[1];
    if (level / from[1] <= 0 || level / to[1] <= 0) return;
    const [begin, end] = [from, to].map((ray) => {
      const [x, , z] = minus(along(this.camera.eye, ray, level / ray[1]), this.place.center);
      return Math.atan2(-z, x);
    });
    this.turn(((end - begin) * 180) / Math.PI, false);
  }

  // Drawing.

  /** From the camera through a point of the page; its part along the camera's axis is 1. */
  rayOf({ clientX, clientY }) {
    const { left, top } = this.stage.getBoundingClientRect();
    const { axes: [right, down, forward], cx, cy, fx, fy } = this.camera;
    return along(along(forward, right, (clientX - left - cx) / fx), down, (clientY - top - cy) / fy);
  }

  draw() {
    if (this.layer.hidden) return;
    const [width, height] = [this.stage.clientWidth, this.stage.clientHeight];
    const density = Math.min(DENSEST, devicePixelRatio);
    this.camera = viewerCamera(this.viewer, this.stand, width, height);
    [this.canvas.width, this.canvas.height] = [Math.round(width * density), Math.round(height * density)];
    this.outside.draw(viewerCamera(this.viewer, this.stand, this.canvas.width, this.canvas.height), this.place);
    EDGES.forEach((ends, index) => {
      const [from, to] = this.before(...ends.map((number) => corner(this.place, number))).map((point) => this.seen(point));
      this.lines[index].toggleAttribute("hidden", !from);
      if (from) Object.entries({ x1: from.x, y1: from.y, x2: to.x, y2: to.y }).forEach(([name, value]) => this.lines[index].setAttribute(name, value));
    });
    for (const { knob, where } of this.handles) {
      const { x, y, depth } = this.seen(where());
      knob.hidden = depth < NEAR || x < 0 || y < 0 || x > width || y > height;
      Object.assign(knob.style, { left: `${x}px`, top: `${y}px`, zIndex: knob.hidden ? 0 : Math.round(1000 / depth) }); // the nearer, the higher
    }
  }

  /** Pixels, and metres before the camera. */
  seen(point) {
    const { axes, eye, fx, fy, cx, cy } = this.camera;
    const [x, y, depth] = rotated(axes, minus(point, eye));
    return { x: (fx * x) / depth + cx, y: (fy * y) / depth + cy, depth };
  }

  /** The ends of the part of an edge that lies before the camera; nothing if none does. */
  before(from, to) {
    const [first, second] = [from, to].map((point) => dot(minus(point, this.camera.eye), this.camera.axes[2]) - NEAR);
    if (first <= 0 && second <= 0) return [];
    const crossing = () => along(from, minus(to, from), first / (first - second));
    return [first > 0 ? from : crossing(), second > 0 ? to : crossing()];
  }
}

/** How far along a line (a point, a unit vector) the point lies that is nearest to a ray; null where they are parallel. */
function nearest(point, direction, eye, ray) {
  const length = Math.hypot(...ray);
  const unit = ray.map((value) => value / length);
  const [offset, cosine] = [minus(point, eye), dot(direction, unit)];
  const sine = 1 - cosine * cosine;
  return sine < 1e-3 ? null : (cosine * dot(unit, offset) - dot(direction, offset)) / sine;
}
