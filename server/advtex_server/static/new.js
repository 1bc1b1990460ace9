// Submit a scan: choose it, look at it, send it in pieces that survive a broken line, and make the job.

import { CallError, bytes, call, count, data, duration, el, findings, notice, token } from "./base.js";
import { inspected } from "./inspect.js";
import { zipDirectory, zipped } from "./zip.js";

const PIECE = 16 << 20; // bytes per request: after each the server has confirmed them
const RETRIES = [0, 1000, 2000, 4000, 8000, 15000, 15000, 30000, 30000, 60000, 60000, 60000];
const CHECK_MS = 500; // between looks whether the server has checked the scan
const SPEED_MS = 6000; // over which speed is measured
const byId = (id) => document.getElementById(id);
const form = byId("submit");
let scan = null; // {name, size, file} or {name, size, files}
let upload = null;
let busy = false;

function showFindings(details) {
  byId("findings").replaceChildren(...findings(details));
}

function choose(chosen, details, files) {
  scan = details.some((found) => found.severity === "error") ? null : chosen;
  byId("chosen").textContent = `${chosen.name}: ${bytes(chosen.size)}${files ? ` in ${count(files)} files` : ""}`;
  showFindings(details.length ? details : [{ severity: "info", message: "Names and sizes look right. The server looks into the files once they are sent." }]);
  byId("send").disabled = !scan;
  const label = form.elements.label;
  if (!label.value || label.dataset.guessed === label.value) {
    label.value = label.dataset.guessed = chosen.name.replace(/\.(zip|r3d|sens)$/i, "").slice(0, 200);
  }
}

async function chooseFile(file) {
  if (/\.sens$/i.test(file.name)) {
    choose({ name: file.name, size: file.size, file }, inspected(null, file.size, data.max_upload_bytes));
    return;
  }
  const { ok, entries } = await zipDirectory(file);
  choose({ name: file.name, size: file.size, file }, inspected(entries, file.size, data.max_upload_bytes, ok), entries?.length);
}

function chooseFolder(files) {
  const kept = files.filter(({ name }) => !name.split("/").some((part) => part.startsWith(".")));
  if (kept.length === 0) {
    choose({ name: "The folder", size: 0 }, inspected([], 0, data.max_upload_bytes));
    return;
  }
  const size = kept.reduce((sum, { file }) => sum + file.size, 0);
  const entries = kept.map(({ name, file }) => ({ name, size: file.size, encrypted: false }));
  choose({ name: kept[0].name.split("/")[0], size, files: kept }, inspected(entries, size, data.max_upload_bytes), kept.length);
}

/** All files below a dropped entry. */
async function walked(entry, prefix = "") {
  if (entry.isFile) {
    const file = await new Promise((resolve, reject) => entry.file(resolve, reject));
    return [{ name: prefix + entry.name, file }];
  }
  const reader = entry.createReader();
  const found = [];
  for (;;) { // it gives at most a hundred at a time
    const some = await new Promise((resolve, reject) => reader.readEntries(resolve, reject));
    if (!some.length) return found;
    for (const child of some) found.push(...(await walked(child, `${prefix}${entry.name}/`)));
  }
}

async function dropped(event) {
  event.preventDefault();
  byId("drop").classList.remove("over");
  if (busy) return;
  const entry = event.dataTransfer.items[0]?.webkitGetAsEntry?.();
  if (entry?.isDirectory) chooseFolder(await walked(entry));
  else if (event.dataTransfer.files.length) await chooseFile(event.dataTransfer.files[0]);
}

// -- sending ----------------------------------------------------------------------------------------------------------

function setBusy(value) {
  busy = value;
  byId("send").disabled = value || !scan;
  byId("progress").hidden = !value;
  for (const id of ["zip", "folder"]) byId(id).disabled = value;
}

function say(text, share) {
  byId("speed").textContent = text;
  if (share != null) byId("sent").value = share;
}

/** Speed over the last seconds, and what that means for the rest. */
function pace() {
  let marks = [];
  return (sent, total) => {
    const now = performance.now();
    if (marks.length && sent < marks.at(-1)[1]) marks = [];
    marks.push([now, sent]);
    while (now - marks[0][0] > SPEED_MS && marks.length > 2) marks.shift();
    const speed = (sent - marks[0][1]) / Math.max(0.05, (now - marks[0][0]) / 1000);
    const rest = speed > 0 && marks.length > 2 ? `, ${bytes(speed)}/s, ${duration((total - sent) / speed)} left` : "";
    say(`${bytes(sent)} of ${bytes(total)}${rest}`, sent / total);
  };
}

/** Sends the bytes; goes on with an earlier upload of the same scan. -> the upload's id */
function send(body, name, fingerprint) {
  const onProgress = pace();
  return new Promise((resolve, reject) => {
    upload = new tus.Upload(body, {
      endpoint: "/v1/uploads", chunkSize: PIECE, retryDelays: RETRIES, metadata: { filename: name },
      removeFingerprintOnSuccess: true, fingerprint: async () => fingerprint,
      onProgress, onSuccess: () => resolve(upload.url.split("/").at(-1)),
      onError: (error) => reject(told(error)),
      onShouldRetry: (error) => {
        const status = error.originalResponse?.getStatus() ?? 0;
        if (!status) say("The line is broken; trying again …");
        return !status || status === 409 || status === 423 || status >= 500;
      },
    });
    upload.findPreviousUploads().then((earlier) => {
      if (earlier.length) {
        upload.resumeFromPreviousUpload(earlier[0]);
        notice("Going on with the upload that was broken off.");
      }
      upload.start();
    });
  });
}

function told(error) {
  const answer = error.originalResponse;
  if (!answer) return new Error("The server cannot be reached. What it has stays there: send the same scan again to go on.");
  let body = { message: `the server answered ${answer.getStatus()}`, details: [] };
  try { body = JSON.parse(answer.getBody()); } catch { /* a proxy's page */ }
  return new CallError(answer.getStatus(), body);
}

/** "320x240" -> [320, 240] */
const parseSize = (text) => text.split("x").map(Number);

function spec(uploadId) {
  const given = Object.fromEntries(new FormData(form));
  const options = { preset: given.preset };
  for (const { name, value, dataset } of form.querySelectorAll("[data-option]")) {
    if (value === "") continue;
    if (name === "size") [options.width, options.height] = parseSize(value);
    else if (dataset.option === "bool") options[name] = value === "true";
    else options[name] = dataset.option === "str" ? value : Number(value);
  }
  return { upload_id: uploadId, options, label: given.label, ...(given.batch && { batch: given.batch }) };
}

async function packed() {
  if (scan.file) return scan.file;
  const onBytes = (read) => say(`Packing: ${bytes(read)} of ${bytes(scan.size)}`, read / Math.max(1, scan.size));
  return zipped(scan.files, onBytes);
}

async function submit() {
  const newest = scan.file ? scan.file.lastModified : Math.max(...scan.files.map(({ file }) => file.lastModified));
  const body = await packed();
  const fingerprint = ["advtex", scan.name, body.size, newest].join("-");
  const uploadId = await send(body, scan.file ? scan.name : `${scan.name}.zip`, fingerprint);
  byId("pause").hidden = byId("abandon").hidden = true;
  say("Everything is sent. The server looks into the files …", 1);
  let job = await call("POST", "/v1/jobs", { body: spec(uploadId), headers: { "Idempotency-Key": token() }, stay: true });
  while (job.state === "checking") {
    await new Promise((resolve) => setTimeout(resolve, CHECK_MS));
    job = await call("GET", `/v1/jobs/${job.id}`, { stay: true });
  }
  if (job.state !== "rejected") {
    location.assign(`/jobs/${job.id}`);
    return;
  }
  showFindings(job.error.details);
  byId("chosen").replaceChildren(el("p", { class: "problem", role: "alert" }, job.error.message, " ",
    el("a", { href: `/jobs/${job.id}` }, "The job that was rejected")));
  byId("chosen").scrollIntoView({ block: "center" });
}

async function start(event) {
  event.preventDefault();
  if (!scan || busy) return;
  setBusy(true);
  byId("pause").hidden = byId("abandon").hidden = false;
  byId("pause").textContent = "Pause";
  try {
    await submit();
  } catch (error) {
    if (error.status === 401) {
      notice("Your session has ended. ", el("a", { href: "/sign-in?next=/new" }, "Sign in again"), "; the upload goes on from where it is.");
    } else {
      showFindings([{ severity: "error", message: error.message, remedy: "" }, ...(error.details ?? [])]);
      byId("findings").scrollIntoView({ block: "center" });
    }
  } finally {
    setBusy(false);
  }
}

byId("zip").addEventListener("change", (event) => event.target.files.length && chooseFile(event.target.files[0]));
byId("folder").addEventListener("change", (event) => chooseFolder(
  Array.from(event.target.files, (file) => ({ name: file.webkitRelativePath, file }))));
byId("drop").addEventListener("dragover", (event) => { event.preventDefault(); byId("drop").classList.add("over"); });
byId("drop").addEventListener("dragleave", () => byId("drop").classList.remove("over"));
byId("drop").addEventListener("drop", dropped);
byId("pause").addEventListener("click", (event) => {
  const paused = event.target.textContent === "Resume";
  event.target.textContent = paused ? "Pause" : "Resume";
  if (paused) upload?.start();
  else upload?.abort();
});
byId("abandon").addEventListener("click", () => {
  upload?.abort(true).catch(() => {});
  location.reload();
});
form.addEventListener("submit", start);
addEventListener("beforeunload", (event) => { if (busy && upload && !byId("pause").hidden) event.preventDefault(); });
