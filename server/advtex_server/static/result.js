// What a finished job is: the model, its files, what the report says.

import { textureAgain } from "./again.js";
import { showAtlas } from "./atlas.js";
import { bytes, call, count, duration, el, findings, stageName } from "./base.js";
import { showComparison } from "./compare.js";
import { showCurves } from "./chart.js";
import { showModel } from "./viewer.js";

const FILES = {
  "model.glb": "One file; for viewers, game engines, the web", "model.usdz": "One file; for AR on iPhone and iPad", "model.obj": "Geometry; needs the .mtl and the textures",
  "model.mtl": "Materials of the OBJ", "model.png": "Texture", "report.json": "Everything that was measured",
  "index.html": "The pictures, to be opened from disk",
};
const SCORES = {
  lpips: ["LPIPS", "perceptual distance to the photographs; less is better"],
  psnr: ["PSNR", "dB; more is better, also for blur"],
  ssim: ["SSIM", "structural similarity; more is better"],
  gradient_ratio: ["Gradient ratio", "sharpness beside the photographs; 1 is best"],
  s3_ratio: ["S3 ratio", "perceived sharpness beside the photographs; 1 is best"],
  coverage: ["Coverage", "share of the pixels that show the model"],
};
const byId = (id) => document.getElementById(id);
let drawn = false;

async function loaded(url) {
  const response = url && (await fetch(url));
  return response?.ok ? response.json() : null;
}

/** Draws everything, once. */
export async function showResult(job) {
  if (drawn) return;
  drawn = true;
  const urls = new Map(job.results.map((file) => [file.name, file.url]));
  const address = (name) => (name && urls.get(name)) || null;
  byId("result").hidden = false;
  showDownloads(job.results);
  const [manifest, report] = await Promise.all([
    loaded(address("previews/manifest.json")).catch(() => null), loaded(address("report.json")).catch(() => null)]);
  showModel(byId("model"), manifest, address, {
    box: job.options.box, send: (box) => textureAgain(job, box),
    link: async (name) => (await call("POST", `/v1/jobs/${job.id}/links/${name}`)).url,
  });
  if (manifest) {
    showComparison(byId("compare"), manifest.views ?? [], address);
    showAtlas(byId("atlas"), manifest.atlas ?? [], address);
    showCurves(byId("curves"), await loaded(address(manifest.curves ?? "previews/curves.json")).catch(() => null));
  }
  if (report) {
    showStages(report.stages ?? []);
    showScores(report.heldout);
  }
  showScan(job, report);
}

function showDownloads(results) {
  const line = (file) => el("li", {},
    el("div", {}, el("a", { href: file.url, download: "" }, file.name), el("small", {}, FILES[file.name] ?? file.purpose ?? "")),
    el("span", { class: "num" }, bytes(file.size)));
  const pictures = results.filter((file) => file.name.startsWith("previews/"));
  const models = results.filter((file) => !pictures.includes(file));
  const order = Object.keys(FILES);
  models.sort((a, b) => (order.indexOf(a.name) + 99) % 99 - (order.indexOf(b.name) + 99) % 99);
  const size = pictures.reduce((sum, file) => sum + file.size, 0);
  byId("downloads").append(el("ul", { class: "files" }, models.map(line)));
  if (pictures.length) {
    byId("downloads").append(el("details", {}, el("summary", {}, `${count(pictures.length)} previews, ${bytes(size)}`),
      el("ul", { class: "files" }, pictures.map(line))));
  }
}

function showScores(heldout) {
  if (!heldout?.texture) return;
  const value = (found) => (typeof found === "number" ? found.toFixed(3) : "–");
  const rows = Object.entries(SCORES).filter(([name]) => typeof heldout.texture[name] === "number");
  const views = heldout.texture.views;
  byId("scores").hidden = rows.length === 0;
  byId("scores").append(el("div", { class: "scroll", tabIndex: 0, role: "region", "aria-label": "Scores" }, el("table", {},
    el("caption", { class: "away" }, "Scores on held-out views"),
    el("thead", {}, el("tr", {}, el("th", { scope: "col" }, `Mean over ${views} views`), el("th", { scope: "col", class: "num" }, "Result"),
      el("th", { scope: "col", class: "num" }, "Plain average"))),
    el("tbody", {}, rows.map(([name, [title, help]]) => el("tr", {},
      el("th", { scope: "row" }, title, el("p", { class: "hint" }, help)),
      el("td", { class: "num" }, value(heldout.texture[name])), el("td", { class: "num" }, value(heldout.mean?.[name]))))))));
}

/** stages: {stage, seconds, peak_memory_bytes, peak_device_memory_bytes}, the last two where they are known. */
export function showStages(stages) {
  const section = byId("stages");
  section.hidden = stages.length === 0;
  section.querySelector(".scroll")?.remove();
  const total = stages.reduce((sum, { seconds }) => sum + seconds, 0);
  const most = Math.max(...stages.map(({ seconds }) => seconds), 0.001);
  const [memory, device] = ["peak_memory_bytes", "peak_device_memory_bytes"].map((name) => stages.some((found) => found[name]));
  const bar = (seconds) => {
    const filled = el("span");
    filled.style.width = `${(100 * seconds) / most}%`;
    return el("div", { class: "meter", "aria-hidden": "true" }, filled);
  };
  section.append(el("div", { class: "scroll", tabIndex: 0, role: "region", "aria-label": "Stages" }, el("table", {},
    el("caption", { class: "away" }, "Stages with their time and memory"),
    el("thead", {}, el("tr", {}, el("th", { scope: "col" }, "Stage"), el("th", { scope: "col", class: "num" }, `Time (${duration(total)} in all)`),
      el("td", { "aria-hidden": "true" }), memory && el("th", { scope: "col", class: "num" }, "Peak memory"),
      device && el("th", { scope: "col", class: "num" }, "On the GPU"))),
    el("tbody", {}, stages.map((found) => el("tr", {},
      el("th", { scope: "row" }, stageName(found.stage)), el("td", { class: "num" }, duration(found.seconds)), el("td", {}, bar(found.seconds)),
      memory && el("td", { class: "num" }, found.peak_memory_bytes ? bytes(found.peak_memory_bytes) : "–"),
      device && el("td", { class: "num" }, found.peak_device_memory_bytes ? bytes(found.peak_device_memory_bytes) : "–")))))));
}

/** What the scan was, and what was found in it. */
export function showScan(job, report = null) {
  const section = byId("scan");
  const scan = report?.scan;
  const facts = [
    ["Views", scan && `${count(scan.views)}${scan.heldout?.length ? `, and ${scan.heldout.length} held out` : ""}`],
    ["Size of the views", scan && `${scan.width} × ${scan.height}`],
    ["Mesh", scan && `${count(scan.faces)} faces`],
    ["Texture", report?.atlas && `${report.atlas.width} × ${report.atlas.height}`],
    ["Kind", scan?.kind],
    ["Mesh from", scan && (report.fusion ? "fused depth" : "the scan")],
    ["Cameras moved by", report?.refinement?.mean?.moved_pixels != null && `${report.refinement.mean.moved_pixels.toFixed(1)} pixels on average`],
    ["Made on", report?.device],
  ].filter(([, value]) => value);
  const notes = (scan?.notes ?? job.progress.notes).map((text) => ({ severity: "info", message: String(text) }));
  const details = [...job.warnings, ...notes];
  section.hidden = facts.length + details.length === 0;
  section.querySelectorAll("dl, ul").forEach((old) => old.remove());
  section.append(
    el("dl", { class: "pairs" }, facts.map(([name, value]) => el("div", {}, el("dt", {}, name), el("dd", {}, value)))),
    el("ul", { class: "findings", "aria-label": "What was found in the scan" }, findings(details)));
}
