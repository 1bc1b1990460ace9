// The model in 3D: model-viewer with what one can do there, or pictures where it cannot draw.

import { backgroundChoice, lightChoice, seenChoice, setLight } from "./appearance.js";
import { el } from "./element.js";
import { orientationRows } from "./cameras.js";
import { cropping } from "./crop.js";
import { measuring } from "./measure.js";
import { Photographs, lumigraphButton, photographChoice } from "./photographs.js";

const PATIENCE_MS = 15000;
const SCENE_VIEWER = "intent://arvr.google.com/scene-viewer/1.0";
const TOUCHED = matchMedia("(pointer: coarse)"); // phones and tablets: they get the small model, where there is one

/** manifest: of the previews, or null. address: the URL of a result file, null if there is none. server: what it does, if there is one:
 * `send` and `box` of `cropping`, and `link`, which resolves to an address of a file that needs no session. */
export function showModel(section, manifest, address, server = {}) {
  const stage = el("div", { class: "stage" });
  section.append(stage);
  const url = (TOUCHED.matches && address("model_mobile.glb")) || address("model.glb");
  if (!url) {
    stage.append(el("p", { class: "wait" }, "There is no model.glb in this result."));
    return;
  }
  const turntable = (manifest?.turntable ?? []).map(address).filter(Boolean);
  const wait = el("p", { class: "wait", role: "status" }, "Loading the model …");
  const viewer = el("model-viewer", {
    src: url, alt: "The textured model; drag or use the arrow keys to turn it", "camera-controls": "", "touch-action": "pan-y",
    "interaction-prompt": "none", "shadow-intensity": "0", poster: turntable[0] ?? address(manifest?.thumbnail),
    ar: "", "ar-modes": "webxr quick-look", "ar-scale": "fixed", "min-camera-orbit": "auto 0rad 1cm", "max-camera-orbit": "auto 180deg auto", "max-field-of-view": "120deg",
  });
  stage.append(viewer, wait);
  if (manifest?.orbit) start(viewer, stage, manifest.orbit);
  const late = setTimeout(() => { wait.textContent = "Still loading; without a GPU this takes a while."; }, PATIENCE_MS);
  viewer.addEventListener("load", () => {
    clearTimeout(late);
    wait.remove();
    setLight(viewer, "photographed");
    section.append(tools(viewer, stage, url, manifest, address, server));
  }, { once: true });
  function fallBack() {
    clearTimeout(late);
    wait.textContent = "This browser cannot draw the model; these are pictures of it.";
    if (turntable.length) viewer.replaceWith(...rotation(turntable));
    wait.classList.add("top");
  }
  viewer.addEventListener("error", fallBack);
  import("./vendor/model-viewer.min.js").catch(fallBack);
}

/** Where the turntable begins: by itself the viewer would look at a room's outer walls from far away. */
function start(viewer, stage, orbit) {
  const back = Math.max(1, orbit.aspect / (stage.clientWidth / stage.clientHeight));
  viewer.setAttribute("orientation", orbit.orientation.map((angle) => `${angle}rad`).join(" "));
  viewer.setAttribute("camera-target", orbit.target.map((metres) => `${metres}m`).join(" "));
  viewer.setAttribute("camera-orbit", `${orbit.theta}rad ${orbit.phi}rad ${orbit.radius * back}m`);
  viewer.setAttribute("field-of-view", `${orbit.field_of_view}deg`);
}

function tools(viewer, stage, url, manifest, address, server) {
  const said = el("p", { class: "hint", role: "status" });
  const stand = orientationRows(manifest?.orbit?.orientation ?? [0, 0, 0]);
  const [button, panel] = cropping(viewer, stage, url, stand, said, server);
  const bar = el("div", { class: "toolbar tools" }, lightChoice(viewer), backgroundChoice(stage), seenChoice(viewer, url === address("model.glb") ? seenPages(address) : []),
    measuring(viewer, stage, said), button, arButton(viewer, url, address, server.link, said));
  if (manifest?.photographs && manifest.orbit) addPhotographs(bar, viewer, stage, url, manifest, address, stand, said);
  return el("div", {}, bar, said, panel);
}

function seenPages(address) {
  const names = ["model_seen.png", ...[2, 3, 4].map((page) => `model_seen_${page}.png`)];
  return names.map(address).filter(Boolean);
}

async function addPhotographs(bar, viewer, stage, url, { photographs, orbit }, address, stand, said) {
  const listed = await fetch(address(photographs)).then((answer) => (answer.ok ? answer.json() : null)).catch(() => null);
  if (!listed) return;
  const found = new Photographs(listed, address);
  bar.append(photographChoice(viewer, stage, found, orbit, stand), lumigraphButton(viewer, stage, found, url, stand, said));
}

/** Only where it can be: WebXR takes the model that is loaded; apps know nothing of the session: Quick Look gets a copy of the USDZ,
 * and Scene Viewer, on Android where the browser has no WebXR, a link. It takes https alone. */
function arButton(viewer, url, address, link, said) {
  const scene = !viewer.canActivateAR && link && /android/i.test(navigator.userAgent) && location.protocol === "https:";
  return el("button", { type: "button", hidden: !viewer.canActivateAR && !scene, onclick: async () => {
    try {
      if (scene) {
        location.assign(sceneViewer(await link(url === address("model_mobile.glb") ? "model_mobile.glb" : "model.glb")));
        return;
      }
      const usdz = address("model.usdz");
      if (usdz && !viewer.iosSrc && document.createElement("a").relList.supports("ar")) {
        said.textContent = "Loading the model for AR …";
        viewer.iosSrc = URL.createObjectURL(await (await fetch(usdz)).blob());
      }
      await viewer.activateAR();
      said.textContent = "";
    } catch (error) {
      said.textContent = `AR cannot be started: ${error.message}`;
    }
  } }, "View in AR");
}

/** What Android opens Google's app with, or else this page again. model: the address of a GLB on this server. */
export function sceneViewer(model) {
  const query = new URLSearchParams({ file: new URL(model, location.href).href, mode: "ar_preferred", resizable: "false" });
  const app = "scheme=https;package=com.google.android.googlequicksearchbox;action=android.intent.action.VIEW";
  return `${SCENE_VIEWER}?${query}#Intent;${app};S.browser_fallback_url=${encodeURIComponent(location.href)};end;`;
}

/** Pictures from all around, and a slider that turns them. */
function rotation(frames) {
  const picture = el("img", { class: "turntable", src: frames[0], alt: "The model from one side" });
  const range = el("input", { class: "turn", type: "range", min: 0, max: frames.length - 1, value: 0, "aria-label": "Turn the model" });
  range.addEventListener("input", () => {
    picture.src = frames[Number(range.value)];
    range.setAttribute("aria-valuetext", `${Math.round((360 * range.value) / frames.length)} degrees`);
  });
  return [picture, range];
}
