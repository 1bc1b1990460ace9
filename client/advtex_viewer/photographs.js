// Photographs in 3D: one laid over the model at its own camera, and those from where the viewer stands blended onto the surface.

import { choice } from "./appearance.js";
import { el } from "./element.js";
import { dot, minus, orbitOf, photographCamera, rotated, transposed, viewerCamera } from "./cameras.js";
import { triangles } from "./glb.js";
import { Lumigraph } from "./lumigraph.js";

const NEAREST = 0.2; // of the turntable's radius: what the viewer turns around is not nearer to a photograph's camera
const DENSEST = 2; // pixels of the canvas per pixel of the page

/** What photographs.json lists, and its stream once it is asked for. address: the URL of a result file, null without. */
export class Photographs {
  constructor({ stream, views }, address) {
    this.views = views;
    this.url = address(stream);
  }

  /** The JPEG of a view, as a Blob. */
  async picture({ offset, bytes }) {
    this.stream ??= fetch(this.url).then((answer) => answer.blob());
    return (await this.stream).slice(offset, offset + bytes, "image/jpeg");
  }
}

/** A choice of a photograph: the viewer goes to its camera, and a slider lays it over the model until the viewer moves.
 *
 * orbit: of the manifest. stand: see `cameras.js`. */
export function photographChoice(viewer, stage, photographs, orbit, stand) {
  const picture = el("img", { alt: "", draggable: false });
  const over = el("div", { class: "wipe" }, picture, el("div", { class: "edge" }));
  const range = el("input", { class: "turn", type: "range", min: 0, max: 100, step: 0.5, value: 50, "aria-label": "Photograph against model" });
  const parts = [over, range];
  const names = Object.fromEntries(photographs.views.map(({ name, heldout }, index) => [index, `${name}${heldout ? ", held out" : ""}`]));
  let camera = null;
  stage.append(...parts);
  const label = choice("Compare with", { "": "No photograph", ...names }, show);
  const select = label.querySelector("select");

  function hide() {
    parts.forEach((part) => { part.hidden = true; });
    camera = null;
    select.value = "";
  }

  async function show(index) {
    if (index === "") return hide();
    const view = photographs.views[index];
    const [url, { width, height }] = [URL.createObjectURL(await photographs.picture(view)), stageSize(stage)];
    URL.revokeObjectURL(picture.src);
    picture.src = url;
    await picture.decode();
    camera = photographCamera(view);
    const ahead = dot(minus(rotated(transposed(stand), orbit.target), camera.eye), camera.axes[2]);
    const distance = Math.min(orbit.radius, Math.max(NEAREST * orbit.radius, ahead));
    const place = orbitOf(camera, stand, distance);
    const focal = lay(picture, camera, place.roll, width, height);
    viewer.cameraTarget = place.target.map((metres) => `${metres}m`).join(" ");
    viewer.cameraOrbit = `${place.theta}rad ${place.phi}rad ${distance}m`;
    viewer.fieldOfView = `${(360 / Math.PI) * Math.atan(height / 2 / focal)}deg`;
    await viewer.updateComplete;
    viewer.jumpCameraToGoal();
    parts.forEach((part) => { part.hidden = false; });
    move();
  }

  function move() {
    over.style.setProperty("--at", `${range.value}%`);
    range.setAttribute("aria-valuetext", `${Math.round(range.value)} % photograph`);
  }

  range.addEventListener("input", move);
  viewer.addEventListener("camera-change", ({ detail }) => camera && detail.source === "user-interaction" && hide());
  new ResizeObserver(() => camera && show(select.value)).observe(stage);
  hide();
  return label;
}

/** Puts a photograph's principal point in the middle of the stage, turned by `roll`, as large as fits. -> the focal length in pixels. */
function lay(picture, { fx, fy, cx, cy, width, height }, roll, stageWidth, stageHeight) {
  const [sine, cosine] = [Math.sin(roll), Math.cos(roll)];
  const corners = [[0, 0], [width, 0], [0, height], [width, height]].map(([u, v]) => [(u - cx) / fx, (v - cy) / fy]);
  const reach = (across) => Math.max(...corners.map(([x, y]) => Math.abs(across ? cosine * x - sine * y : sine * x + cosine * y)));
  const focal = Math.min(stageWidth / 2 / reach(true), stageHeight / 2 / reach(false));
  const [left, top] = [(cx * focal) / fx, (cy * focal) / fy];
  Object.assign(picture.style, {
    width: `${(width * focal) / fx}px`, height: `${(height * focal) / fy}px`, left: `${stageWidth / 2 - left}px`, top: `${stageHeight / 2 - top}px`,
    transformOrigin: `${left}px ${top}px`, transform: `rotate(${roll}rad)`,
  });
  return focal;
}

const stageSize = (stage) => ({ width: stage.clientWidth, height: stage.clientHeight });

/** A button that lays the photographs from where the viewer stands over the model. model: its GLB's address. said: for what goes wrong. */
export function lumigraphButton(viewer, stage, photographs, model, stand, said) {
  const canvas = el("canvas", { class: "lumigraph", hidden: true, "aria-hidden": true });
  const button = el("button", { type: "button", "aria-pressed": "false", onclick: toggle }, "Photographs where you stand");
  let lumigraph = null;
  viewer.after(canvas);

  async function toggle() {
    const on = button.getAttribute("aria-pressed") !== "true";
    button.setAttribute("aria-pressed", String(on));
    canvas.hidden = true;
    said.textContent = "";
    if (!on) return;
    try {
      if (!lumigraph) said.textContent = "Loading the photographs …";
      lumigraph ??= make();
      lumigraph = await lumigraph;
      said.textContent = "";
      canvas.hidden = button.getAttribute("aria-pressed") !== "true";
      draw();
    } catch (error) {
      lumigraph = null;
      button.setAttribute("aria-pressed", "false");
      said.textContent = `The photographs cannot be shown: ${error.message}`;
    }
  }

  async function make() {
    const views = photographs.views.filter(({ heldout }) => !heldout);
    const { width: resizeWidth, height: resizeHeight } = views[0];
    const [mesh, ...found] = await Promise.all([
      fetch(model).then((answer) => answer.arrayBuffer()).then(triangles),
      ...views.map(async (view) => ({
        camera: photographCamera(view), picture: await createImageBitmap(await photographs.picture(view), { resizeWidth, resizeHeight }),
      }))]);
    return new Lumigraph(canvas, mesh, found);
  }

  function draw() {
    if (canvas.hidden) return;
    const { width, height } = stageSize(stage);
    const density = Math.min(DENSEST, devicePixelRatio);
    [canvas.width, canvas.height] = [Math.round(width * density), Math.round(height * density)];
    lumigraph.draw(viewerCamera(viewer, stand, canvas.width, canvas.height));
  }

  viewer.addEventListener("camera-change", draw);
  new ResizeObserver(draw).observe(stage);
  return button;
}
