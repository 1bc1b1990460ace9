// What of the model lies outside of a box, darkened on a canvas of its own; where it lies inside, the model below shows.

import { boundsOf, placed } from "./box.js";
import { clipMatrix, minus } from "./cameras.js";
import { linked, uploaded } from "./meshes.js";

const NEAR = 0.01; // metres
const AS_IT_IS = [[1, 0, 0], [0, 1, 0], [0, 0, 1]];
const SHADE = [0.04, 0.05, 0.06, 0.78]; // red, green, blue, opacity

const VERTEX = `#version 300 es
in vec3 position;
uniform mat4 clip;
out vec3 place;
void main() { place = position; gl_Position = clip * vec4(position, 1); }`;
const FRAGMENT = `#version 300 es
precision highp float;
uniform vec3 center, axes[3], reach;
in vec3 place;
out vec4 color;
void main() {
  vec3 offset = place - center;
  vec3 aside = abs(vec3(dot(axes[0], offset), dot(axes[1], offset), dot(axes[2], offset))) - reach;
  vec4 shade = vec4(${SHADE.join(", ")});
  color = max(max(aside.x, aside.y), aside.z) > 0.0 ? vec4(shade.rgb * shade.a, shade.a) : vec4(0);
}`;

export class Outside {
  /** mesh: of `triangles`. Error where WebGL 2 is missing. */
  constructor(canvas, mesh) {
    this.gl = canvas.getContext("webgl2", { premultipliedAlpha: true, antialias: true });
    if (!this.gl) throw new Error("this browser has no WebGL 2");
    this.canvas = canvas;
    this.mesh = mesh;
    this.whole = placed(boundsOf(mesh.positions, AS_IT_IS), AS_IT_IS);
    this.program = linked(this.gl, VERTEX, FRAGMENT);
    uploaded(this.gl, mesh);
  }

  /** camera: of `viewerCamera`, its size the canvas's. place: of `placed`. */
  draw(camera, { center, axes, half }) {
    const { gl, program, canvas, whole } = this;
    const at = (name) => gl.getUniformLocation(program, name);
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.useProgram(program);
    const far = Math.hypot(...minus(camera.eye, whole.center)) + Math.hypot(...whole.half) + NEAR;
    gl.uniformMatrix4fv(at("clip"), false, clipMatrix(camera, NEAR, far, false));
    gl.uniform3fv(at("center"), center);
    gl.uniform3fv(at("axes"), axes.flat());
    gl.uniform3fv(at("reach"), half);
    gl.drawElements(gl.TRIANGLES, this.mesh.indices.length, gl.UNSIGNED_INT, 0);
  }
}
