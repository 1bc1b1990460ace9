// Photographs where the viewer stands: each point of the surface has the colors of those that saw it from about there.
//
// An unstructured lumigraph (Buehler et al. 2001) of the two best photographs per pixel, on a canvas of its own. It is transparent where
// no photograph was taken from about there, so that the model below shows. tests/support/lumigraph.py renders the same without a GPU.

import { clipMatrix, dot, minus, rotated } from "./cameras.js";
import { linked, uploaded } from "./meshes.js";

const LIMIT = 0.7; // radians between the viewer's and the photograph's line of sight: beyond it the photograph is not used
const FADE = 0.35; // radians over which photographs give way to the model
const COARSE = 0.5; // radians that a photograph from twice as far away is worse by
const BORDER = 0.06; // share of a photograph beside its border over which it gives way
const TOLERANCE = [0.05, 0.02]; // of the depth, and metres: what lies deeper than the surface that a photograph saw is hidden from it
const CANDIDATES = 12; // photographs that a frame is made of
const SAMPLES = 400; // points of the surface that they are chosen by
const GOLDEN = 0.7548776662466927; // steps by it and by its square fill the unit square
const DEPTH_WIDTH = 320;
const NEAR = 0.05; // metres

const DEPTH_VERTEX = `#version 300 es
in vec3 position;
uniform mat4 clip;
void main() { gl_Position = clip * vec4(position, 1); }`;
const DEPTH_FRAGMENT = `#version 300 es
void main() {}`;
const VERTEX = `#version 300 es
in vec3 position;
uniform mat4 clip;
out vec3 place;
void main() { place = position; gl_Position = clip * vec4(position, 1); }`;
const FRAGMENT = `#version 300 es
precision highp float;
precision highp sampler2DArray;
uniform sampler2DArray photographs, depths;
uniform mat4 clips[${CANDIDATES}];
uniform vec3 eyes[${CANDIDATES}];
uniform float focals[${CANDIDATES}];
uniform int layers[${CANDIDATES}], count;
uniform vec3 eye;
uniform float focal, far;
in vec3 place;
out vec4 color;

struct Match { float penalty, lod; vec3 at; };

/* The depth of the surface that a photograph saw there, in metres. */
float seen(vec3 at) {
  float depth = texture(depths, at).r;
  return ${NEAR} * far / (far - depth * (far - ${NEAR}));
}

Match match(int index) {
  vec4 projected = clips[index] * vec4(place, 1);
  vec3 at = vec3(projected.xy / projected.w * 0.5 + 0.5, layers[index]);
  vec2 border = min(at.xy, 1.0 - at.xy);
  float inside = min(border.x, border.y);
  Match found = Match(${LIMIT}, 0.0, at);
  if (projected.w < ${NEAR} || inside <= 0.0 || projected.w > seen(at) * ${1 + TOLERANCE[0]} + ${TOLERANCE[1]}) return found;
  vec3 here = eye - place, there = eyes[index] - place;
  float farther = length(there) / length(here);
  float angle = acos(clamp(dot(normalize(here), normalize(there)), -1.0, 1.0));
  float penalty = angle + ${COARSE} * max(0.0, farther - 1.0) + ${LIMIT} * max(0.0, 1.0 - inside / ${BORDER});
  found.penalty = clamp(penalty, 1e-3, ${LIMIT});
  found.lod = max(0.0, log2(focals[index] / focal / farther));
  return found;
}

void main() {
  Match best = Match(${LIMIT}, 0.0, vec3(0)), second = best;
  float third = ${LIMIT};
  for (int index = 0; index < count; ++index) {
    Match found = match(index);
    if (found.penalty < best.penalty) { third = second.penalty; second = best; best = found; }
    else if (found.penalty < second.penalty) { third = second.penalty; second = found; }
    else third = min(third, found.penalty);
  }
  /* Weights end where the third takes over, so that nothing jumps when it does. */
  float first = 1.0 / best.penalty - 1.0 / third + 1e-9, other = 1.0 / second.penalty - 1.0 / third;
  vec3 mixed = first * textureLod(photographs, best.at, best.lod).rgb + other * textureLod(photographs, second.at, second.lod).rgb;
  float share = clamp((${LIMIT} - best.penalty) / ${FADE}, 0.0, 1.0);
  color = vec4(mixed / (first + other) * share, share);
}`;

export class Lumigraph {
  /** mesh: of `triangles`. photographs: {camera, picture: ImageBitmap}, all of the same size. Error where WebGL 2 is missing. */
  constructor(canvas, mesh, photographs) {
    this.canvas = canvas;
    this.gl = canvas.getContext("webgl2", { premultipliedAlpha: true, antialias: true, preserveDrawingBuffer: true });
    if (!this.gl) throw new Error("this browser has no WebGL 2");
    this.mesh = mesh;
    this.cameras = photographs.map(({ camera }) => camera);
    this.samples = samplesOf(mesh);
    this.far = Math.max(...this.cameras.flatMap(({ eye }) => this.samples.map((point) => Math.hypot(...minus(point, eye))))) * 1.5 + 1;
    this.program = linked(this.gl, VERTEX, FRAGMENT);
    uploaded(this.gl, mesh);
    this.photographs = this.photographArray(photographs.map(({ picture }) => picture));
    this.depths = this.depthArray();
  }

  /** Draws what the camera sees; its size is the canvas's. */
  draw(camera) {
    const { gl, program, canvas } = this;
    const chosen = this.candidates(camera);
    const at = (name) => gl.getUniformLocation(program, name);
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.useProgram(program);
    gl.uniformMatrix4fv(at("clip"), false, clipMatrix(camera, NEAR, this.far, false));
    gl.uniform3fv(at("eye"), camera.eye);
    gl.uniform1f(at("focal"), camera.fx);
    gl.uniform1f(at("far"), this.far);
    gl.uniform1i(at("count"), chosen.length);
    gl.uniform1i(at("photographs"), 0);
    gl.uniform1i(at("depths"), 1);
    if (chosen.length) {
      const cameras = chosen.map((index) => this.cameras[index]);
      gl.uniformMatrix4fv(at("clips"), false, cameras.flatMap((found) => [...clipMatrix(found, NEAR, this.far, true)]));
      gl.uniform3fv(at("eyes"), cameras.flatMap(({ eye }) => eye));
      gl.uniform1fv(at("focals"), cameras.map(({ fx }) => fx));
      gl.uniform1iv(at("layers"), chosen);
    }
    gl.drawElements(gl.TRIANGLES, this.mesh.indices.length, gl.UNSIGNED_INT, 0);
  }

  /** The photographs that see most of what the camera sees from about there, as numbers. */
  candidates(camera) {
    const shown = this.samples.filter((point) => holds(camera, point));
    const scores = this.cameras.map((photograph, index) => [index, shown.reduce((sum, point) => {
      if (!holds(photograph, point)) return sum;
      const [here, there] = [minus(camera.eye, point), minus(photograph.eye, point)];
      return sum + Math.max(0, LIMIT - Math.acos(Math.min(1, dot(here, there) / Math.hypot(...here) / Math.hypot(...there))));
    }, 0)]);
    return scores.filter(([, score]) => score > 0).sort((a, b) => b[1] - a[1]).slice(0, CANDIDATES).map(([index]) => index);
  }

  photographArray(pictures) {
    const { gl } = this;
    const [{ width, height }] = pictures;
    const levels = Math.floor(Math.log2(Math.max(width, height))) + 1;
    const texture = this.array(0, levels, gl.RGBA8, width, height, pictures.length);
    gl.texParameteri(gl.TEXTURE_2D_ARRAY, gl.TEXTURE_MIN_FILTER, gl.LINEAR_MIPMAP_LINEAR);
    pictures.forEach((picture, layer) => {
      gl.texSubImage3D(gl.TEXTURE_2D_ARRAY, 0, 0, 0, layer, width, height, 1, gl.RGBA, gl.UNSIGNED_BYTE, picture);
      picture.close();
    });
    gl.generateMipmap(gl.TEXTURE_2D_ARRAY);
    return texture;
  }

  /** The depth of the mesh from each photograph's camera. */
  depthArray() {
    const { gl } = this;
    const [{ width, height }] = this.cameras;
    const scale = Math.min(1, DEPTH_WIDTH / width);
    const [columns, rows] = [Math.round(width * scale), Math.round(height * scale)];
    const texture = this.array(1, 1, gl.DEPTH_COMPONENT24, columns, rows, this.cameras.length);
    for (const side of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D_ARRAY, side, gl.NEAREST);
    const program = linked(gl, DEPTH_VERTEX, DEPTH_FRAGMENT);
    gl.useProgram(program);
    gl.bindFramebuffer(gl.FRAMEBUFFER, gl.createFramebuffer());
    gl.viewport(0, 0, columns, rows);
    this.cameras.forEach((camera, layer) => {
      gl.framebufferTextureLayer(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, texture, 0, layer);
      gl.clear(gl.DEPTH_BUFFER_BIT);
      gl.uniformMatrix4fv(gl.getUniformLocation(program, "clip"), false, clipMatrix(camera, NEAR, this.far, true));
      gl.drawElements(gl.TRIANGLES, this.mesh.indices.length, gl.UNSIGNED_INT, 0);
    });
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    return texture;
  }

  array(unit, levels, format, width, height, layers) {
    const { gl } = this;
    const texture = gl.createTexture();
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(gl.TEXTURE_2D_ARRAY, texture);
    gl.texStorage3D(gl.TEXTURE_2D_ARRAY, levels, format, width, height, layers);
    for (const side of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D_ARRAY, side, gl.CLAMP_TO_EDGE);
    return texture;
  }
}

/** SAMPLES points from all over the surface, as many on each piece as its area asks for. */
function samplesOf({ positions, indices }) {
  const corner = (index) => [...positions.subarray(3 * indices[index], 3 * indices[index] + 3)];
  const areas = [];
  let whole = 0;
  for (let face = 0; face < indices.length; face += 3) {
    const [a, b, c] = [0, 1, 2].map((index) => corner(face + index));
    const [p, q] = [minus(b, a), minus(c, a)];
    whole += Math.sqrt(Math.max(0, dot(p, p) * dot(q, q) - dot(p, q) ** 2));
    areas.push(whole);
  }
  const points = [];
  for (let face = 0; face < areas.length; ++face) {
    while (points.length < SAMPLES && (points.length + 0.5) * whole < areas[face] * SAMPLES) {
      const [a, b, c] = [0, 1, 2].map((index) => corner(3 * face + index));
      const [s, t] = [Math.sqrt((points.length * GOLDEN) % 1), (points.length * GOLDEN * GOLDEN) % 1]; // evenly over the triangle
      points.push(a.map((value, index) => value * (1 - s) + s * (b[index] * (1 - t) + c[index] * t)));
    }
  }
  return points;
}

/** Whether a point lies within the camera's picture. */
function holds({ axes, eye, fx, fy, cx, cy, width, height }, point) {
  const [x, y, z] = rotated(axes, minus(point, eye));
  const [u, v] = [(fx * x) / z + cx, (fy * y) / z + cy];
  return z > NEAR && u > 0 && v > 0 && u < width && v < height;
}
