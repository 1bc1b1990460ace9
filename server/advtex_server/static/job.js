// One job: where it stands, live while it runs, and what came of it.

import { RETRYABLE, STAGES, TERMINAL, USUAL_METHOD, ask, badge, bytes, call, count, data, duration, el, findings, follow, meter, moment, notice, stageName } from "./base.js";
import { showCurves } from "./chart.js";
import { showResult, showScan, showStages } from "./result.js";

const GLIMPSE_MS = 4000;
const path = `/v1/jobs/${data.id}`;
const byId = (id) => document.getElementById(id);
let job = null;
let stop = null;
let looked = 0;

function showHeading() {
  const { options } = job;
  const size = options.width ? `${options.width}×${options.height}` : null;
  const facts = [options.preset, options.method === USUAL_METHOD ? null : options.method, size,
    options.holdout && `every ${options.holdout}th frame held out`, job.attempt > 1 && `attempt ${job.attempt}`];
  byId("facts").replaceChildren(facts.filter(Boolean).join(" · "), " · ", moment(job.created_at),
    job.batch ? " · batch " : "", job.batch ? el("a", { href: `/?batch=${encodeURIComponent(job.batch)}` }, job.batch) : "",
    job.deadline ? " · due " : "", job.deadline ? moment(job.deadline) : "",
    job.expires_at ? " · kept until " : "", job.expires_at ? moment(job.expires_at) : "");
  document.title = `${job.state === "succeeded" ? "" : `${job.state}: `}${job.label || "Job"} · advtex`;
  const ended = TERMINAL.includes(job.state);
  const button = (name, act, kind = "") => el("button", { class: kind, onclick: act }, name);
  const actions = [
    !ended && button("Cancel", cancel),
    RETRYABLE.includes(job.state) && button("Retry", () => change("POST", `${path}/retry`), "primary"),
    ended && button("Delete", remove, "danger"),
  ].filter(Boolean);
  const names = actions.map((action) => action.textContent).join();
  if (byId("actions").dataset.names !== names) { // keeps the focus while nothing changes
    byId("actions").replaceChildren(...actions);
    byId("actions").dataset.names = names;
  }
}

function stageLine() {
  const at = STAGES.indexOf(job.progress.stage);
  return el("ol", { class: "steps", "aria-hidden": "true" }, STAGES.map((stage, index) => el("li",
    { class: index < at ? "done" : index === at ? "current" : "", title: stageName(stage) })));
}

function running() {
  const { stage, step, steps, eta_seconds: eta, steps_per_second: rate, losses } = job.progress;
  const name = stage ? stageName(stage) : "Starting";
  const numbers = [steps ? `step ${count(step)} of ${count(steps)}` : null, rate && `${rate.toPrecision(3)} steps/s`,
    eta != null && `${duration(eta)} left`].filter(Boolean).join(" · ");
  const { accuracy, ...others } = losses;
  const shown = Object.entries(others).filter(([, value]) => value) // no parts that are switched off
    .map(([loss, value]) => `${loss.replaceAll("_", " ")} ${value.toPrecision(3)}`);
  if (accuracy != null) shown.push(`tells ${Math.round(100 * accuracy)} % of patches apart`);
  return [
    el("div", { class: "line" }, el("strong", {}, name), el("span", { class: "num" }, numbers)), meter(step, steps, name), stageLine(),
    shown.length > 0 && el("p", { class: "hint num" }, shown.join(" · ")),
  ];
}

function ending() {
  const { error } = job;
  if (job.state === "canceled") return [el("p", {}, "Canceled. A retry goes on from the last checkpoint.")];
  if (!error) return [];
  const log = error.log_tail && el("details", { open: true }, el("summary", {}, "The end of the log"), el("pre", { tabIndex: 0, role: "region", "aria-label": "The end of the log" }, error.log_tail));
  return [
    el("p", { class: "problem" }, error.message, " ", error.help && el("a", { href: error.help }, "What this means")),
    error.details.length > 0 && el("ul", { class: "findings", "aria-label": "Problems of the scan" }, findings(error.details)), log,
    job.state === "rejected" && el("p", { class: "hint" }, "Correct the scan and send it again as a new one."),
  ];
}

/** Of its deadline: whether it was missed, or will be at the pace of this moment. */
function lateness() {
  if (!job.deadline) return null;
  const left = (new Date(job.deadline) - Date.now()) / 1000;
  const ended = TERMINAL.includes(job.state);
  if (job.late || (!ended && left < 0)) return ended ? "ended after its deadline" : "late: its deadline has passed";
  return !ended && job.progress.eta_seconds > left ? `will be late by about ${duration(job.progress.eta_seconds - left)}` : null;
}

function showNow() {
  const took = job.finished_at && (new Date(job.finished_at) - new Date(job.created_at)) / 1000;
  const waits = job.waiting_reason && el("p", {}, `Waits: ${job.waiting_reason}`);
  const memory = !TERMINAL.includes(job.state) && job.memory_bytes ? `needs about ${bytes(job.memory_bytes)} of memory` : "";
  const aside = job.state === "succeeded" ? `done in ${duration(took)}` : memory;
  const late = lateness();
  const section = byId("now");
  section.classList.add("now");
  section.replaceChildren(
    el("div", { class: "line" }, el("span", { class: "actions" }, badge(job.state), late && el("span", { class: "badge warn" }, late)), el("span", { class: "hint" }, aside)),
    ...[waits, job.state === "running" && running(), ending()].flat().filter(Boolean));
}

/** Pictures and curves of the running job, as often as they change; of one that was stopped, the last ones. */
async function glimpse() {
  if (Date.now() - looked < GLIMPSE_MS) return;
  looked = Date.now();
  let live;
  try { live = await call("GET", `${path}/live`); } catch { return; } // the next time, perhaps
  if (job.state === "succeeded") return;
  showCurves(byId("curves"), live.curves);
  byId("live").hidden = live.images.length === 0;
  byId("live").querySelector(".shots").replaceChildren(...live.images.map(({ view, href }) => el("figure", {},
    el("img", { src: href, alt: `View ${view} as it is now` }), el("figcaption", {}, `${view}, step ${count(live.step)}`))));
}

function show(next) {
  job = next;
  showHeading();
  showNow();
  if (job.state === "succeeded") {
    byId("live").hidden = true;
    showResult(job);
    return;
  }
  if (job.attempt > 0) glimpse();
  showScan(job);
  const { stage_seconds: spent, stage_peak_bytes: memory, stage_device_peak_bytes: device } = job.progress;
  showStages(Object.entries(spent).map(([stage, seconds]) => ({
    stage, seconds, peak_memory_bytes: memory[stage], peak_device_memory_bytes: device[stage],
  })));
}

function watch() {
  stop?.();
  stop = TERMINAL.includes(job.state) ? null : follow(() => `${path}/events`, {
    job: (next) => {
      show(next);
      if (TERMINAL.includes(next.state)) { stop?.(); stop = null; }
    },
  });
}

async function change(method, address) {
  try {
    const next = await call(method, address);
    if (next) { show(next); watch(); }
    return true;
  } catch (error) {
    notice(error.message);
    return false;
  }
}

async function cancel() {
  if (await ask("Cancel this job?", "It stops with a checkpoint: a retry goes on from there.", "Cancel the job")) {
    if (await change("POST", `${path}/cancel`) && !TERMINAL.includes(job.state)) notice("The worker is asked to stop.");
  }
}

async function remove() {
  if (await ask("Delete this job?", "The job and all its results are removed from the server. This cannot be undone.", "Delete")) {
    if (await change("DELETE", path)) location.assign("/");
  }
}

show(data);
watch();
