// Small curves over steps, one per series.

import { count, el } from "./base.js";

const TITLES = {
  l1: "L1 loss", adversarial: "Adversarial loss", discriminator: "Discriminator loss", psnr: "PSNR (dB)",
  gradient_ratio: "Gradient ratio", accuracy: "Patches told apart (share)", accuracy_real: "Real patches told (share)",
  accuracy_fake: "Fake patches told (share)",
  margin: "Margin (real − fake logits)", spread: "Spread of the logits", gradient_adversarial: "Gradient, adversarial",
  gradient_l1: "Gradient, L1", gradient_features: "Gradient, features", gradient_gabor: "Gradient, Gabor energies",
  gabor: "Gabor energies, distance",
};
// Drawn whole: noise about one half must not look like a curve.
const WHOLE = { accuracy: [0, 1], accuracy_real: [0, 1], accuracy_fake: [0, 1] };
const [WIDTH, HEIGHT, PAD] = [300, 110, 6];

const short = (value) => (Math.abs(value) >= 100 ? value.toFixed(0) : Number(value.toPrecision(3)).toString());

function chart(name, steps, values) {
  const points = steps.map((step, index) => [step, values[index]]).filter(([, value]) => value != null);
  const heights = points.map(([, value]) => value);
  if (points.length < 2 || heights.every((value) => value === 0)) return null; // a part that this method does without
  const [least, most] = [Math.min(...heights), Math.max(...heights)];
  const [low, high] = WHOLE[name] ?? [least, most];
  const [first, last] = [points[0][0], points.at(-1)[0]];
  const x = (step) => (WIDTH * (step - first)) / (last - first || 1);
  const y = (value) => PAD + (HEIGHT - 2 * PAD) * (1 - (value - low) / (high - low || 1));
  const title = TITLES[name] ?? name.replaceAll("_", " ");
  const label = `${title}: from ${short(heights[0])} to ${short(heights.at(-1))} over steps ${count(first)} to ${count(last)}`;
  const drawing = el("svg:svg", { viewBox: `0 0 ${WIDTH} ${HEIGHT}`, preserveAspectRatio: "none", role: "img", "aria-label": label });
  for (const value of [low, high]) {
    drawing.append(el("svg:line", { class: "grid-line", x1: 0, x2: WIDTH, y1: y(value), y2: y(value) }));
  }
  const path = points.map(([step, value], index) => `${index ? "L" : "M"}${x(step).toFixed(1)} ${y(value).toFixed(1)}`).join("");
  drawing.append(el("svg:path", { class: "curve", d: path }));
  return el("figure", { class: "chart num" },
    el("div", { class: "top" }, el("strong", {}, title), el("span", {}, short(heights.at(-1)))),
    drawing,
    el("div", { class: "ends" }, el("span", {}, `step ${count(first)}`),
      el("span", {}, `${short(least)} – ${short(most)}`), el("span", {}, count(last))));
}

/** Draws `curves.json` into a section; hides it while there is nothing to draw. */
export function showCurves(section, curves) {
  const sources = [curves, curves?.quality].filter((source) => source?.steps?.length);
  const drawn = sources.flatMap(({ steps, series }) => Object.entries(series).map(([name, values]) => chart(name, steps, values)));
  const kept = drawn.filter(Boolean);
  section.hidden = kept.length === 0;
  section.querySelector(".charts")?.remove();
  section.append(el("div", { class: "charts" }, kept));
}
