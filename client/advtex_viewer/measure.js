// The distance between two points of the model's surface that are picked on the viewer.

import { el } from "./element.js";

const DRAGGED = 5; // pixels: a pointer that moved so far turned the model and picks nothing

/** -> the button that switches it on. stage: the element around the viewer, for the line. said: where the length is told. */
export function measuring(viewer, stage, said) {
  const line = el("svg:line");
  const ends = [el("svg:circle", { r: 5 }), el("svg:circle", { r: 5 })];
  const ruler = el("svg:svg", { class: "ruler", "aria-hidden": "true", hidden: "" }, line, ends);
  const length = el("div", { class: "length", hidden: true, "aria-hidden": true });
  const cross = el("div", { class: "cross", hidden: true });
  const button = el("button", { type: "button", "aria-pressed": "false", onclick: () => toggle(button.getAttribute("aria-pressed") !== "true") }, "Measure");
  let points = [];
  let pressed = null;
  stage.append(ruler, length, cross);

  function toggle(on) {
    button.setAttribute("aria-pressed", String(on));
    viewer.disableTap = on; // a tap would bring the point to the middle
    cross.hidden = !on;
    points = [];
    say(on ? "Click two points of the model, or put the cross on them and press Enter." : "");
    hold();
  }

  function say(text) { said.textContent = text; }

  function pick(x, y) {
    const hit = viewer.positionAndNormalFromPoint(x, y);
    if (!hit) {
      say("There is no surface at this point.");
      return;
    }
    points = points.length === 2 ? [hit.position] : [...points, hit.position];
    say(points.length === 2 ? `Distance: ${inMetres(distance(...points))}` : "Now the second point.");
    hold();
  }

  /** Points of the viewer follow the picked ones; the line is drawn between them. */
  function hold() {
    viewer.querySelectorAll(".held").forEach((old) => old.remove());
    points.forEach((point, index) => viewer.append(el("span", { class: "held", slot: `hotspot-${index}`, "data-position": point.toString() })));
    requestAnimationFrame(draw);
  }

  function draw() {
    const places = points.map((_, index) => viewer.queryHotspot(`hotspot-${index}`)?.canvasPosition);
    const shown = places.length && places.every((place) => place && place.z < 1);
    ruler.toggleAttribute("hidden", !shown);
    length.hidden = !shown || places.length < 2;
    if (!shown) return;
    const [from, to] = [places[0], places[places.length - 1]];
    ends.forEach((end, index) => set(end, { cx: [from, to][index].x, cy: [from, to][index].y }));
    set(line, { x1: from.x, y1: from.y, x2: to.x, y2: to.y });
    if (length.hidden) return;
    length.textContent = inMetres(distance(...points));
    length.style.left = `${(from.x + to.x) / 2}px`;
    length.style.top = `${(from.y + to.y) / 2}px`;
  }

  const on = () => button.getAttribute("aria-pressed") === "true";
  viewer.addEventListener("pointerdown", ({ clientX, clientY }) => { pressed = [clientX, clientY]; });
  viewer.addEventListener("click", ({ clientX, clientY }) => {
    if (on() && pressed && Math.hypot(clientX - pressed[0], clientY - pressed[1]) < DRAGGED) pick(clientX, clientY);
  });
  viewer.addEventListener("keydown", (event) => {
    if (!on() || event.key !== "Enter") return;
    const box = viewer.getBoundingClientRect();
    pick(box.left + box.width / 2, box.top + box.height / 2);
  });
  viewer.addEventListener("camera-change", draw);
  return button;
}

const set = (element, attributes) => Object.entries(attributes).forEach(([name, value]) => element.setAttribute(name, value));
const distance = (from, to) => Math.hypot(from.x - to.x, from.y - to.y, from.z - to.z);
const inMetres = (metres) => (metres < 1 ? `${(100 * metres).toFixed(1)} cm` : `${metres.toFixed(2)} m`);
