// How the model looks: its light, what lies behind it, and what of its texture was seen.

import { el } from "./element.js";

const LIGHTS = { photographed: "As photographed", studio: "Studio light" };
const BACKGROUNDS = { page: "As the page", light: "Light", gray: "Gray", dark: "Dark" };
const SURFACES = { texture: "Texture", seen: "What was seen" };
const SEEN = [ // of model_seen.png: the least gray value, the color that it is shown in as in the result's pictures, and what it means
  { least: 171, color: [150, 158, 163], name: "Seen" },
  { least: 86, color: [255, 153, 0], name: "Guessed from beside it" },
  { least: 0, color: [217, 0, 217], name: "Not seen" },
];
const SEEN_SIDE = 2048; // texels of the picture that shows it

/** -> a labeled choice. options: words by value. */
export function choice(label, options, act) {
  const select = el("select", { "aria-label": label, onchange: () => act(select.value) }, Object.entries(options).map(([value, words]) => el("option", { value }, words)));
  return el("label", { class: "choose" }, label, select);
}

export function lightChoice(viewer) {
  return choice("Light", LIGHTS, (light) => setLight(viewer, light));
}

/** Photographs have the light of the place in them: as they are, the texture shines by itself and nothing else lights it. */
export function setLight(viewer, light) {
  const own = light === "photographed";
  viewer.toneMapping = own ? "none" : "neutral";
  for (const material of viewer.model.materials) {
    const surface = material.pbrMetallicRoughness;
    material.emissiveTexture.setTexture(surface.baseColorTexture.texture);
    surface.setBaseColorFactor(own ? [0, 0, 0, 1] : [1, 1, 1, 1]);
    material.setEmissiveFactor(own ? [1, 1, 1] : [0, 0, 0]);
    material.setSpecularFactor(own ? 0 : 1);
  }
}

export function backgroundChoice(stage) {
  return choice("Background", BACKGROUNDS, (name) => { stage.dataset.background = name; });
}

/** A choice and its legend, nothing without the files. images: the addresses of model_seen.png and those of further pages. */
export function seenChoice(viewer, images) {
  if (!images.length) return [];
  const legend = el("ul", { class: "legend", hidden: true, "aria-label": "Colors" }, SEEN.map(({ color, name }) => {
    const patch = el("span", { "aria-hidden": "true" });
    patch.style.background = `rgb(${color})`;
    return el("li", {}, patch, name);
  }));
  const textures = {};
  const select = choice("Surface", SURFACES, async (name) => {
    textures.texture ??= viewer.model.materials.map((material) => material.pbrMetallicRoughness.baseColorTexture.texture);
    if (name === "seen") textures.seen ??= await Promise.all(images.map(async (image) => viewer.createTexture(await colored(image))));
    viewer.model.materials.forEach((material, page) => {
      material.pbrMetallicRoughness.baseColorTexture.setTexture(textures[name][page]);
      material.emissiveTexture.setTexture(textures[name][page]);
    });
    legend.hidden = name !== "seen";
  });
  return [select, legend];
}

/** The picture in the colors of SEEN, as an address. */
async function colored(image) {
  const bitmap = await createImageBitmap(await (await fetch(image)).blob());
  const scale = Math.min(1, SEEN_SIDE / Math.max(bitmap.width, bitmap.height));
  const canvas = el("canvas", { width: Math.round(bitmap.width * scale), height: Math.round(bitmap.height * scale) });
  const context = canvas.getContext("2d", { willReadFrequently: true });
  context.imageSmoothingEnabled = false;
  context.drawImage(bitmap, 0, 0, canvas.width, canvas.height);
  const pixels = context.getImageData(0, 0, canvas.width, canvas.height);
  for (let at = 0; at < pixels.data.length; at += 4) {
    pixels.data.set(SEEN.find(({ least }) => pixels.data[at] >= least).color, at);
  }
  context.putImageData(pixels, 0, 0);
  return URL.createObjectURL(await new Promise((resolve) => canvas.toBlob(resolve)));
}
