// Pinhole cameras in the world of model.glb (metres, y up): those of photographs, and the viewer's own.
//
// A camera is {axes, eye, fx, fy, cx, cy, width, height}. axes: its right, down and forward as unit vectors; eye: metres; the rest in pixels.
// The viewer turns the model by its `orientation` before it looks at it: `stand`, a matrix of rows, is that rotation.

export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const minus = (a, b) => a.map((value, index) => value - b[index]);
export const along = (point, direction, distance) => point.map((value, index) => value + distance * direction[index]);
export const rotated = (rows, vector) => rows.map((row) => dot(row, vector));
export const transposed = (rows) => rows[0].map((_, column) => rows.map((row) => row[column]));

/** Rows of the rotation that turns around z first, then x, then y: as `orientation` of model-viewer does. */
export function orientationRows([roll, pitch, yaw]) {
  const [[sr, sp, sy], [cr, cp, cy]] = [[roll, pitch, yaw].map(Math.sin), [roll, pitch, yaw].map(Math.cos)];
  return [
    [cy * cr + sy * sp * sr, sy * sp * cr - cy * sr, sy * cp],
    [cp * sr, cp * cr, -sp],
    [cy * sp * sr - sy * cr, sy * sr + cy * sp * cr, cy * cp],
  ];
}

/** The camera of a photograph; view: of previews/photographs.json. */
export function photographCamera({ K, camera_to_world: pose, width, height }) {
  const [right, down, forward, eye] = transposed(pose.slice(0, 3));
  return { axes: [right, down, forward], eye, fx: K[0][0], fy: K[1][1], cx: K[0][2], cy: K[1][2], width, height };
}

/** The camera that the viewer draws with now; width and height: its size in pixels. */
export function viewerCamera(viewer, stand, width, height) {
  const { theta, phi, radius } = viewer.getCameraOrbit();
  const { x, y, z } = viewer.getCameraTarget();
  const { right, up, back } = orbitAxes(theta, phi);
  const focal = height / 2 / Math.tan((viewer.getFieldOfView() * Math.PI) / 360);
  const back_to_model = transposed(stand);
  const axes = [right, up.map((value) => -value), back.map((value) => -value)].map((axis) => rotated(back_to_model, axis));
  const eye = rotated(back_to_model, along([x, y, z], back, radius));
  return { axes, eye, fx: focal, fy: focal, cx: width / 2, cy: height / 2, width, height };
}

/** How the viewer stands where a camera does and looks along its axis, `distance` metres ahead of what it turns around.
 *
 * It holds itself level: roll is by how many radians the camera's picture has to be turned clockwise to fit. */
export function orbitOf(camera, stand, distance) {
  const [right, , forward] = camera.axes.map((axis) => rotated(stand, axis));
  const phi = Math.acos(Math.min(1, Math.max(-1, -forward[1])));
  const theta = Math.atan2(-forward[0], -forward[2]);
  const level = orbitAxes(theta, phi);
  return { theta, phi, target: along(rotated(stand, camera.eye), forward, distance), roll: Math.atan2(-dot(right, level.up), dot(right, level.right)) };
}

function orbitAxes(theta, phi) {
  const [st, ct, sp, cp] = [Math.sin(theta), Math.cos(theta), Math.sin(phi), Math.cos(phi)];
  return { right: [ct, 0, -st], up: [-cp * st, sp, -cp * ct], back: [sp * st, cp, sp * ct] };
}

/** By columns, the matrix that takes points of the world to clip space; w is the depth in metres.
 *
 * The camera's first row comes last, as on a screen, or first, as in a texture that holds its picture. */
export function clipMatrix({ axes, eye, fx, fy, cx, cy, width, height }, near, far, firstRowFirst) {
  const sign = firstRowFirst ? 1 : -1;
  const depth = (far + near) / (far - near);
  const rows = axes.map((axis) => [...axis, -dot(axis, eye)]);
  const combined = (x, y, z) => rows[0].map((_, index) => x * rows[0][index] + y * rows[1][index] + z * rows[2][index]);
  const toDepth = combined(0, 0, depth);
  toDepth[3] -= (2 * far * near) / (far - near);
  return new Float32Array(transposed([
    combined((2 * fx) / width, 0, (2 * cx) / width - 1),
    combined(0, (sign * 2 * fy) / height, sign * ((2 * cy) / height - 1)),
    toDepth, rows[2],
  ]).flat());
}
