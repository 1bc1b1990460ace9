// The list of jobs: drawn from what the page brought, kept up to date by the stream of changes.

import { TERMINAL, USUAL_METHOD, ask, badge, call, count, data, duration, el, follow, meter, moment, notice, placeholder, stageName, tone } from "./base.js";

const BATCH_MS = 2000;
const list = document.getElementById("jobs");
const rows = new Map();

function thumbnail(job) {
  if (job.state !== "succeeded") return placeholder();
  const picture = el("img", { class: "thumb", alt: "", loading: "lazy", width: 64, height: 64 });
  picture.addEventListener("error", () => picture.replaceWith(placeholder()), { once: true });
  picture.src = `/v1/jobs/${job.id}/results/previews/thumbnail.jpg`;
  return picture;
}

function work(job) {
  const place = el("div", { class: "work" });
  if (job.state === "running") {
    const left = job.eta_seconds == null ? "" : `, ${duration(job.eta_seconds)} left`;
    const steps = job.steps ? ` ${count(job.step)} / ${count(job.steps)}` : "";
    const stage = job.stage ? stageName(job.stage) : "Starting";
    place.append(el("p", { class: "num" }, `${stage}${steps}${left}`), meter(job.step, job.steps, stage));
  } else if (job.problem || !TERMINAL.includes(job.state)) {
    place.append(el("p", {}, job.problem || job.waiting_reason));
  } else if (job.finished_at) {
    const took = (new Date(job.finished_at) - new Date(job.created_at)) / 1000;
    place.append(el("p", {}, job.state === "succeeded" ? `done in ${duration(took)}` : ""));
  }
  return place;
}

function row(job) {
  const facts = [job.preset, job.method === USUAL_METHOD ? null : job.method, job.batch && `batch ${job.batch}`];
  const name = el("div", {},
    el("a", { href: `/jobs/${job.id}` }, job.label || `Job ${job.id.slice(-6)}`),
    el("p", { class: "hint" }, facts.filter(Boolean).join(" · "), " · ", moment(job.created_at)));
  const item = el("li", { class: "job", "data-id": job.id }, thumbnail(job), name, work(job), badge(job.state));
  item.job = job;
  return item;
}

function fits(job) {
  const { state, label, batch } = data.filter;
  return (!state || job.state === state) && (!batch || job.batch === batch)
    && (!label || job.label.toLowerCase().includes(label.toLowerCase()));
}

/** Changes what differs, so that focus and pictures stay. */
function show(job) {
  const known = rows.get(job.id);
  const wanted = !job.deleted && fits(job);
  if (known && !wanted) {
    known.remove();
    rows.delete(job.id);
  } else if (known) {
    const fresh = row(job);
    if (known.job.state !== job.state) known.firstChild.replaceWith(fresh.firstChild);
    known.querySelector(".work").replaceWith(fresh.querySelector(".work"));
    known.querySelector(".badge").replaceWith(fresh.querySelector(".badge"));
    known.job = job;
  } else if (wanted && data.first && job.id > newest()) {
    const item = row(job);
    rows.set(job.id, item);
    list.prepend(item);
  }
  document.getElementById("empty").hidden = rows.size > 0;
}

const newest = () => list.firstElementChild?.dataset.id ?? "";

function share(batch) {
  const bar = el("div", { class: "share", "aria-hidden": "true" });
  for (const [state, jobs] of Object.entries(batch.states)) {
    const part = el("span", { class: tone(state) });
    part.style.flexGrow = jobs;
    bar.append(part);
  }
  return bar;
}

const counts = (batch) => Object.entries(batch.states).map(([state, jobs]) => `${count(jobs)} ${state}`).join(", ");

function showBatches(batches) {
  const place = document.getElementById("batches");
  place.hidden = !batches.length || Boolean(data.filter.batch);
  place.replaceChildren(...batches.map((batch) => el("a", { href: `/?batch=${encodeURIComponent(batch.id)}` },
    el("strong", {}, batch.id), share(batch), el("span", { class: "hint" }, counts(batch), batch.paused && !batch.finished && "; paused"))));
}

function showBatch(batch) {
  const place = document.getElementById("batch");
  const left = batch.finished ? "all have ended" : batch.eta_seconds == null ? "" : `about ${duration(batch.eta_seconds)} left`;
  const path = `/v1/batches/${encodeURIComponent(batch.id)}`;
  const act = (name, path_, question) => el("button", {
    onclick: async () => {
      if (question && !(await ask(...question))) return;
      try { showBatch(await call("POST", path_)); } catch (error) { notice(error.message); }
    },
  }, name);
  place.hidden = false;
  place.replaceChildren(
    el("h2", {}, `Batch ${batch.id}`), share(batch),
    el("p", {}, [`${count(batch.jobs)} ${batch.jobs === 1 ? "job" : "jobs"}: ${counts(batch)}`, left, batch.paused && "paused"].filter(Boolean).join("; ")),
    el("div", { class: "actions" },
      batch.states.failed && act("Retry the failed ones", `${path}/retry-failed`),
      !batch.finished && (batch.paused ? act("Resume", `${path}/resume`) : act("Pause", `${path}/pause`)),
      !batch.finished && act("Cancel all", `${path}/cancel`,
        ["Cancel the whole batch?", "Every job that has not ended is stopped.", "Cancel all"])));
}

let pending = null;
function refreshBatches(delay = BATCH_MS) {
  pending ??= setTimeout(async () => {
    pending = null;
    try {
      if (data.filter.batch) showBatch(await call("GET", `/v1/batches/${encodeURIComponent(data.filter.batch)}`));
      else showBatches((await call("GET", "/v1/batches?limit=8")).batches);
    } catch (error) {
      if (error.status && error.status !== 404) notice(error.message);
    }
  }, delay);
}

for (const job of data.jobs) {
  const item = row(job);
  rows.set(job.id, item);
  list.append(item);
}
document.getElementById("empty").hidden = rows.size > 0;
showBatches(data.batches);
if (data.filter.batch) refreshBatches(0);
const older = document.getElementById("older");
if (older) {
  const query = new URLSearchParams(location.search);
  query.set("cursor", older.dataset.cursor);
  older.href = `/?${query}`;
}
follow((last) => `/changes?after=${last ?? data.since}`, {
  job: (job) => {
    const state = rows.get(job.id)?.job.state;
    show(job);
    if (job.batch && state !== job.state) refreshBatches();
  },
});
