// A box as the option `box` has it: {center, size, yaw}, in metres and degrees of the scan's world (`advtex_options/box.py`).
//
// `toGlb`, a matrix of rows, turns that world to the one of model.glb, whose y is up.

import { along, dot, minus, rotated, transposed } from "./cameras.js";

export const LEAST = 0.01; // metres of a side

/** The turn of a GLB's node, a quaternion. It takes axes to axes: its rows are whole numbers. */
export function scanToGlb([x, y, z, w]) {
  return [
    [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
    [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
    [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
  ].map((row) => row.map(Math.round));
}

/** The number of the scan's axis that is up, and its sign. */
export function upAxis(toGlb) {
  const axis = toGlb[1].findIndex((value) => value !== 0);
  return { axis, sign: toGlb[1][axis] };
}

/** In the world of model.glb: its middle, its axes as unit vectors, and half of its sides. */
export function placed({ center, size, yaw }, toGlb) {
  const { axis, sign } = upAxis(toGlb);
  const [right, ahead] = [(axis + 1) % 3, (axis + 2) % 3];
  const angle = (yaw * sign * Math.PI) / 180;
  const axes = [[1, 0, 0], [0, 1, 0], [0, 0, 1]];
  [axes[right][right], axes[right][ahead]] = [Math.cos(angle), Math.sin(angle)];
  [axes[ahead][right], axes[ahead][ahead]] = [-Math.sin(angle), Math.cos(angle)];
  return { center: rotated(toGlb, center), axes: axes.map((found) => rotated(toGlb, found)), half: size.map((side) => side / 2) };
}

/** Corner number `index` of 8, whose bits say on which side of each axis it lies. */
export const corner = ({ center, axes, half }, index) =>
  axes.reduce((point, axis, number) => along(point, axis, index & (1 << number) ? half[number] : -half[number]), center);

/** The box that just holds all points of a mesh of `triangles`. */
export function boundsOf(positions, toGlb) {
  const [low, high] = [[Infinity, Infinity, Infinity], [-Infinity, -Infinity, -Infinity]];
  const back = transposed(toGlb);
  for (let at = 0; at < positions.length; at += 3) {
    rotated(back, positions.subarray(at, at + 3)).forEach((value, axis) => {
      low[axis] = Math.min(low[axis], value);
      high[axis] = Math.max(high[axis], value);
    });
  }
  return { center: low.map((value, axis) => (value + high[axis]) / 2), size: low.map((value, axis) => high[axis] - value), yaw: 0 };
}

/** The share of a mesh's faces whose middle lies in it: those that the engine keeps. place: of `placed`. */
export function shareKept({ positions, indices }, { center, axes, half }) {
  let kept = 0;
  for (let face = 0; face < indices.length; face += 3) {
    const middle = [0, 1, 2].map((axis) => [0, 1, 2].reduce((sum, vertex) => sum + positions[3 * indices[face + vertex] + axis], 0) / 3);
    const offset = minus(middle, center);
    if (axes.every((axis, number) => Math.abs(dot(axis, offset)) <= half[number])) kept += 1;
  }
  return (3 * kept) / indices.length;
}

/** To whole millimetres and tenths of a degree, so that what is drawn is what is sent. */
export function rounded({ center, size, yaw }) {
  const millimetres = (value) => Math.round(1000 * value) / 1000;
  const turn = Math.round(10 * (((yaw + 180) % 360 + 360) % 360 - 180)) / 10;
  return { center: center.map(millimetres), size: size.map((side) => Math.max(LEAST, millimetres(side))), yaw: turn };
}

export const boxText = ({ center, size, yaw }) => [...center, ...size, yaw].map((value) => String(Number(value.toFixed(3)))).join(",");

export function parseBox(text) {
  const [x, y, z, alongX, alongY, alongZ, yaw = 0] = text.split(",").map(Number);
  return { center: [x, y, z], size: [alongX, alongY, alongZ], yaw };
}
