// The triangles of a model.glb as the engine writes it: one node, and primitives with positions and indices of their own.

const JSON_START = 20;
const POSITIONS = 5126; // float32
const INDICES = { 5123: Uint16Array, 5125: Uint32Array };

/** -> {positions: Float32Array, indices: Uint32Array} in the file's world (y up), and the quaternion that turned them there.
 *
 * Error where the file is another kind. */
export function triangles(buffer) {
  const header = new DataView(buffer);
  const length = header.getUint32(12, true);
  const document = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, JSON_START, length)));
  const start = JSON_START + length + 8;
  const read = (index, kinds) => {
    const accessor = document.accessors[index];
    const view = document.bufferViews[accessor.bufferView];
    const Kind = kinds[accessor.componentType];
    if (!Kind || view.byteStride) throw new Error("the model's arrays are of a kind that is not known here");
    const count = accessor.count * (accessor.type === "VEC3" ? 3 : 1);
    return new Kind(buffer, start + (view.byteOffset ?? 0) + (accessor.byteOffset ?? 0), count);
  };
  const node = document.nodes[document.scenes[document.scene].nodes[0]];
  const parts = document.meshes[node.mesh].primitives.map(({ attributes, indices }) => [
    read(attributes.POSITION, { [POSITIONS]: Float32Array }), read(indices, INDICES)]);
  const positions = new Float32Array(parts.reduce((sum, [found]) => sum + found.length, 0));
  const indices = new Uint32Array(parts.reduce((sum, [, found]) => sum + found.length, 0));
  let [points, corners] = [0, 0];
  for (const [found, order] of parts) {
    positions.set(found, points);
    indices.set(Uint32Array.from(order, (index) => index + points / 3), corners);
    points += found.length;
    corners += order.length;
  }
  const rotation = node.rotation ?? [0, 0, 0, 1];
  return { positions: turned(positions, rotation), indices, rotation };
}

/** Points turned by a quaternion (x, y, z, w), in place. */
function turned(points, [x, y, z, w]) {
  for (let at = 0; at < points.length; at += 3) {
    const [a, b, c] = points.subarray(at, at + 3);
    const [p, q, r] = [2 * (y * c - z * b), 2 * (z * a - x * c), 2 * (x * b - y * a)];
    points[at] = a + w * p + y * r - z * q;
    points[at + 1] = b + w * q + z * p - x * r;
    points[at + 2] = c + w * r + x * q - y * p;
  }
  return points;
}
