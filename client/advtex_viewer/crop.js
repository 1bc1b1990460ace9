// A box around what is to be kept of the model: a button, and below the viewer its numbers and what may be done with it.

import { LEAST, boxText, shareKept, upAxis } from "./box.js";
import { CropBox, NAMES, STEP, TURN } from "./cropbox.js";
import { el } from "./element.js";
import { triangles } from "./glb.js";

/** -> the button, and what it shows below the viewer.
 *
 * model: the GLB's address. stand: see `cameras.js`. said: for what goes wrong. box: the option of the job, or null.
 * send: takes the option's text and makes a job of it; null where there is no server. */
export function cropping(viewer, stage, model, stand, said, { box = null, send = null } = {}) {
  const button = el("button", { type: "button", "aria-pressed": "false", onclick: toggle }, "Crop");
  const panel = el("div", { class: "crop", hidden: true });
  let tool = null;

  async function toggle() {
    const on = () => button.getAttribute("aria-pressed") === "true";
    button.setAttribute("aria-pressed", String(!on()));
    said.textContent = "";
    try {
      if (on() && !tool) said.textContent = "Loading the model's shape …";
      if (on()) tool ??= fetch(model).then((answer) => answer.arrayBuffer()).then(begin);
      (await tool)?.show(on());
      said.textContent = "";
      panel.hidden = !on();
    } catch (error) {
      tool = null;
      button.setAttribute("aria-pressed", "false");
      said.textContent = `The model cannot be cropped here: ${error.message}`;
    }
  }

  function begin(buffer) {
    const mesh = triangles(buffer);
    const tools = new CropBox(viewer, stage, stand, mesh, box);
    panel.replaceChildren(...numbers(tools, mesh, said, send));
    return tools;
  }

  return [button, panel];
}

function numbers(tool, mesh, said, send) {
  const { axis: up, sign } = upAxis(tool.toGlb);
  const changed = (list, axis) => (value) => tool.change({ [list]: tool.box[list].with(axis, list === "size" ? Math.max(LEAST, value) : value) });
  const fields = [
    ...["center", "size"].flatMap((list) => [0, 1, 2].map((axis) => field(`${list === "center" ? "Center" : "Size"} ${NAMES[axis]}, m`, STEP, () => tool.box[list][axis], changed(list, axis)))),
    field("Turn, °", TURN, () => tool.box.yaw, (yaw) => tool.change({ yaw })),
  ];
  const kept = el("p", { class: "hint", role: "status" });
  const option = el("code", {});
  const again = send && el("button", { type: "button", class: "primary", onclick: sent }, "Texture again with this box");

  async function sent() {
    again.disabled = true;
    try {
      await send(boxText(tool.box));
    } catch (error) {
      said.textContent = `The job cannot be sent: ${error.message}`;
      again.disabled = false;
    }
  }

  tool.onChange = (settled) => {
    fields.forEach(({ show }) => show());
    option.textContent = `--box=${boxText(tool.box)}`;
    if (!settled) return;
    const share = shareKept(mesh, tool.place);
    kept.textContent = share ? `Keeps ${share < 0.001 ? "less than .1" : (100 * share).toFixed(1)} % of the model's faces.` : "Nothing of the model lies in the box.";
    if (again) again.disabled = !share;
  };
  tool.change({});
  return [
    el("div", { class: "numbers", role: "group", "aria-label": "The box, in the scan's world" }, fields.map(({ label }) => label)),
    kept, el("p", { class: "hint" }, `In the scan's world, in which ${sign > 0 ? "+" : "−"}${NAMES[up]} is up. As an option of a run: `, option),
    el("div", { class: "actions" }, again, el("button", { type: "button", onclick: () => tool.change(tool.whole) }, "Whole model")),
  ];
}

function field(name, step, value, act) {
  const show = () => { if (input.valueAsNumber !== value()) input.value = String(value()); };
  const input = el("input", { type: "number", step, onchange: () => { if (Number.isFinite(input.valueAsNumber)) act(input.valueAsNumber); show(); } });
  return { label: el("label", {}, name, input), show };
}
