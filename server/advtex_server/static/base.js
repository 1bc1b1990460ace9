// What all pages share: calls of the API, streams that come back by themselves, words for numbers, elements.

import { el } from "./element.js";

export { el };
export const data = JSON.parse(document.getElementById("data").textContent);
// The words of states and stages, in their order: `STATES` and `STAGE_LABELS` of the contract; the method of who names none.
const { states, stages, usual_method: usualMethod } = JSON.parse(document.getElementById("words").textContent);
export const STAGES = Object.keys(stages);
export const USUAL_METHOD = usualMethod;
export const TERMINAL = Object.keys(states).filter((state) => states[state].terminal);
export const RETRYABLE = TERMINAL.filter((state) => states[state].retryable);
const RETURN_MS = 2000;

export class CallError extends Error {
  constructor(status, body) {
    super(body.message);
    this.status = status;
    this.details = body.details;
  }
}

/** Calls the API. An ended session leads to the sign-in page, unless `stay`. */
export async function call(method, path, { body, headers = {}, stay = false } = {}) {
  const response = await fetch(path, {
    method, headers: body ? { "Content-Type": "application/json", ...headers } : headers, body: body && JSON.stringify(body),
  });
  if (response.status === 401 && !stay) signIn();
  const text = await response.text();
  if (response.ok) return text ? JSON.parse(text) : null;
  let said = { message: `the server answered ${response.status}`, details: [] };
  try { said = { ...said, ...JSON.parse(text) }; } catch { /* a proxy's page */ }
  throw new CallError(response.status, said);
}

export function signIn() {
  location.assign(`/sign-in?next=${encodeURIComponent(location.pathname + location.search)}`);
}

/** Server-sent events, through restarts of the server and ended sessions. -> a function that ends it.
 *
 * Only while the page is seen: a browser opens six lines to a server at most, and each stream is one of them. */
export function follow(address, handlers) {
  let source, timer, last = null, ended = false;
  function open() {
    source = new EventSource(address(last));
    for (const [name, handle] of Object.entries(handlers)) {
      source.addEventListener(name, (event) => {
        last = event.lastEventId || last;
        handle(JSON.parse(event.data));
      });
    }
    source.onerror = () => {
      if (ended || source.readyState !== EventSource.CLOSED) return;
      clearTimeout(timer);
      timer = setTimeout(async () => {
        try { await call("GET", "/v1/key"); } catch (error) { if (error.status === 401) return; }
        if (!ended && !document.hidden) open();
      }, RETURN_MS);
    };
  }
  function seen() {
    source?.close();
    clearTimeout(timer);
    if (!document.hidden) open();
  }
  document.addEventListener("visibilitychange", seen);
  seen();
  return () => {
    ended = true;
    clearTimeout(timer);
    document.removeEventListener("visibilitychange", seen);
    source?.close();
  };
}

/** What no other request has: a key by which the server knows one that is sent again. */
export const token = () => Array.from(crypto.getRandomValues(new Uint8Array(16)), (byte) => byte.toString(16).padStart(2, "0")).join("");

export function notice(...content) {
  const place = document.getElementById("notice");
  place.replaceChildren(...content);
  clearTimeout(notice.timer);
  notice.timer = setTimeout(() => place.replaceChildren(), 8000);
}

/** Whether the user agrees. */
export function ask(title, text, action) {
  const dialog = document.getElementById("ask");
  dialog.querySelector("h2").textContent = title;
  dialog.querySelector("p").textContent = text;
  dialog.querySelector(".danger").textContent = action;
  dialog.returnValue = "no";
  dialog.showModal();
  return new Promise((resolve) => dialog.addEventListener("close", () => resolve(dialog.returnValue === "yes"), { once: true }));
}

export function bytes(count) {
  const units = ["B", "kB", "MB", "GB", "TB"];
  const power = count < 1 ? 0 : Math.min(units.length - 1, Math.floor(Math.log10(count) / 3));
  const value = count / 1000 ** power;
  return `${value.toFixed(power && value < 99.5 ? 1 : 0)} ${units[power]}`;
}

export function duration(seconds) {
  if (seconds < 10) return `${seconds.toFixed(1)} s`;
  if (seconds < 90) return `${Math.round(seconds)} s`;
  const minutes = Math.round(seconds / 60);
  if (minutes < 90) return `${minutes} min`;
  const hours = Math.floor(minutes / 60);
  return hours < 48 ? `${hours} h ${minutes % 60} min` : `${Math.round(hours / 24)} days`;
}

export function moment(text) {
  const date = new Date(text);
  const today = date.toDateString() === new Date().toDateString();
  const shown = date.toLocaleString([], today ? { timeStyle: "short" } : { dateStyle: "medium", timeStyle: "short" });
  return el("time", { dateTime: text, title: date.toLocaleString() }, today ? `today ${shown}` : shown);
}

export const count = (value) => value.toLocaleString("en");
export const tone = (state) => states[state]?.tone ?? "plain";
export const badge = (state) => el("span", { class: `badge ${tone(state)}` }, states[state]?.label ?? state);
export const stageName = (stage) => stages[stage] ?? stage.replaceAll("_", " ");

/** How far a stage is, as a bar; one that does not know moves to and fro. */
export function meter(step, steps, label) {
  if (!steps) return el("div", { class: "meter waits", role: "progressbar", "aria-label": label }, el("span"));
  const percent = Math.min(100, (100 * step) / steps);
  const filled = el("span");
  filled.style.width = `${percent}%`;
  const attributes = { "aria-valuenow": Math.round(percent), "aria-valuemin": 0, "aria-valuemax": 100 };
  return el("div", { class: "meter", role: "progressbar", "aria-label": label, ...attributes }, filled);
}

/** Problems of a scan, each with its place and what helps. */
export function findings(details) {
  return details.map((found) => el("li", { class: found.severity },
    el("span", {}, found.where && el("code", {}, found.where), found.where && " ", found.message),
    found.remedy && el("span", { class: "remedy" }, found.remedy)));
}

export function placeholder() {
  const box = el("span", { class: "thumb none", "aria-hidden": "true" });
  const icon = el("svg:svg", { viewBox: "0 0 24 24" });
  icon.append(el("svg:path", { d: "m12 3 8 4.500v9L12 21l-8-4.500v-9zM4 7.500l8 4.500 8-4.500M12 12v9" }));
  box.append(icon);
  return box;
}
