// The fleet: drawn from what the page brought, and asked again every few seconds while it is seen.

import { bytes, count, data, duration, el, meter, moment, stageName, tone } from "./base.js";

const ASK_MS = 3000;
const place = (id) => document.getElementById(id);
const hint = (text) => el("p", { class: "hint" }, text);
const share = (part) => `${Math.round(100 * part)} %`;

function table(head, rows) {
  return el("table", {},
    el("thead", {}, el("tr", {}, head.map(([name, numeric]) => el("th", { class: numeric && "num", scope: "col" }, name)))),
    el("tbody", {}, rows));
}

/** Jobs of other owners are theirs alone: they have no link. */
function jobName(job, owner, label) {
  const name = label || `Job ${job.slice(-6)}`;
  return owner === data.owner ? el("a", { href: `/jobs/${job}` }, name) : el("span", { title: `Job ${job}` }, name);
}

function work(found) {
  if (!found) return [];
  const stage = found.stage ? stageName(found.stage) : "Starting";
  const steps = found.steps ? ` ${count(found.step)} / ${count(found.steps)}` : "";
  const left = found.eta_seconds == null ? "" : `, ${duration(found.eta_seconds)} left`;
  return [
    el("p", {}, jobName(found.job, found.owner, found.label),
      el("span", { class: "hint" }, ` ${found.owner}${found.attempt > 1 ? `, attempt ${found.attempt}` : ""}`)),
    el("p", { class: "hint num" }, found.pauses || `${stage}${steps}${left}`),
    meter(found.step, found.steps, stage),
  ];
}

function gpu(found) {
  if (!found) return null;
  const used = `${bytes(found.memory_used_bytes)} of ${bytes(found.memory_bytes)}`;
  return hint(`GPU ${found.utilization == null ? "" : `${share(found.utilization)} busy, `}${used}`);
}

function worker(found) {
  const state = found.busy ? "busy" : "plain";
  return el("li", {},
    el("div", { class: "top" }, el("strong", { class: "mono" }, found.name),
      el("span", { class: `badge ${state}` }, found.busy ? "at work" : "idle")),
    gpu(found.gpu), work(found.work));
}

function workers(fleet) {
  if (!fleet.workers) return [hint("Redis does not answer: workers are not known.")];
  const classes = byMemory(fleet.workers);
  const parts = [...classes].map(([gib, members]) => el("section", { "aria-label": `Workers of ${gib} GiB` },
    el("h3", {}, `${gib} GiB `, el("span", { class: "hint" },
      `${members.filter((found) => found.busy).length} of ${members.length} at work`)),
    el("ul", { class: "workers" }, members.map(worker))));
  if (fleet.elsewhere.length) {
    parts.push(el("section", { "aria-label": "Elsewhere" },
      el("h3", {}, "On workers that tell of no job"),
      el("ul", { class: "workers" }, fleet.elsewhere.map((found) => el("li", {}, work(found))))));
  }
  return parts.length ? parts : [hint("No worker is running: start advtex-worker.")];
}

function byMemory(members) {
  const classes = new Map();
  for (const found of members) classes.set(found.memory_gib, [...(classes.get(found.memory_gib) ?? []), found]);
  return classes;
}

function queue(fleet) {
  if (!fleet.queue.length) return hint("Nothing waits.");
  return table([["Owner"], ["Jobs", true], ["Oldest", true], ["By memory"]], fleet.queue.map((line) => el("tr", {},
    el("th", { scope: "row" }, line.owner), el("td", { class: "num" }, count(line.jobs)),
    el("td", { class: "num" }, duration(line.oldest_seconds)),
    el("td", {}, Object.entries(line.by_memory_gib).map(([gib, jobs]) => `${gib} GiB: ${count(jobs)}`).join(", ")))));
}

const clock = (seconds) => new Date(seconds * 1000).toLocaleTimeString([], { hour: "2-digit", minute: "2-digit" });
const total = (states) => Object.values(states).reduce((sum, jobs) => sum + jobs, 0);

function day(fleet) {
  const most = Math.max(1, ...fleet.hours.map((hour) => total(hour.states)));
  const ended = {};
  for (const { states } of fleet.hours) for (const [state, jobs] of Object.entries(states)) ended[state] = (ended[state] ?? 0) + jobs;
  if (!total(ended)) return [hint("Nothing has ended.")];
  const told = Object.entries(ended).map(([state, jobs]) => `${count(jobs)} ${state}`).join(", ");
  const bars = el("div", { class: "hours", role: "img", "aria-label": `Jobs that ended, by hour: ${told}` },
    fleet.hours.map((hour) => {
      const parts = Object.entries(hour.states).map(([state, jobs]) => {
        const part = el("span", { class: tone(state) });
        part.style.height = `${(100 * jobs) / most}%`;
        return part;
      });
      return el("div", { title: `${clock(hour.begins)}: ${count(total(hour.states))}` }, parts);
    }));
  return [el("p", {}, told), bars, el("p", { class: "ends hint" },
    el("span", {}, clock(fleet.hours[0].begins)), el("span", {}, `at most ${count(most)} an hour`), el("span", {}, "now"))];
}

function failures(fleet) {
  if (!fleet.failures.length) return [hint("None.")];
  return fleet.failures.map((cause) => el("details", { open: fleet.failures.length === 1 },
    el("summary", {}, el("code", {}, cause.cause), ` ${count(cause.jobs)} ${cause.jobs === 1 ? "job" : "jobs"}`),
    el("ul", { class: "findings" }, cause.newest.map((job) => el("li", { class: "error" },
      el("span", {}, jobName(job.id, job.owner, job.label), ` ${job.owner}, `,
        moment(new Date(job.finished_at * 1000).toISOString())),
      el("span", { class: "remedy" }, job.message)))),
    el("p", { class: "hint" }, el("a", { href: `/errors#job-${cause.cause}` }, "What it means, and what helps"))));
}

function show(fleet) {
  const waiting = fleet.queue.reduce((sum, line) => sum + line.jobs, 0);
  const facts = [`${count(waiting)} waiting`, `${count(fleet.states.running ?? 0)} running`];
  if (fleet.states.checking) facts.push(`${count(fleet.states.checking)} being checked`);
  if (fleet.workers) facts.push(`${count(fleet.workers.length)} ${fleet.workers.length === 1 ? "worker" : "workers"}`);
  place("facts").textContent = facts.join(" · ");
  const lonely = fleet.workers && fleet.without_worker;
  place("trouble").hidden = !lonely;
  place("trouble").textContent = lonely ? `${count(lonely)} waiting ${lonely === 1 ? "job fits" : "jobs fit"} no living worker.` : "";
  place("workers").replaceChildren(...workers(fleet));
  place("queue").replaceChildren(queue(fleet));
  place("day").replaceChildren(...day(fleet));
  const open = new Set([...place("failures").querySelectorAll("details[open] code")].map((code) => code.textContent));
  place("failures").replaceChildren(...failures(fleet));
  for (const details of place("failures").querySelectorAll("details")) {
    if (open.has(details.querySelector("code").textContent)) details.open = true;
  }
}

async function ask() {
  if (document.hidden) return;
  const answer = await fetch("/fleet/now").catch(() => null);
  if (answer?.status === 401) location.assign("/sign-in?next=/fleet");
  else if (answer?.ok) show(await answer.json());
}

show(data.fleet);
setInterval(ask, ASK_MS);
document.addEventListener("visibilitychange", ask);
