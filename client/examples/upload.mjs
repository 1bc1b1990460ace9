// Send a scan without an SDK: a resumable upload (tus 1.0.0), a job, its progress, and the model.
//
//     node upload.mjs SCAN.zip MODEL.glb       with ADVTEX_URL and ADVTEX_API_KEY in the environment; Node 20 or later
//
// In a browser, give `upload` the File of an <input type="file">: it is a Blob too.

import { createHash } from "node:crypto";
import { openAsBlob } from "node:fs";
import { writeFile } from "node:fs/promises";
import { basename } from "node:path";

const { ADVTEX_URL: server, ADVTEX_API_KEY: key } = process.env;
const PIECE = 16 << 20; // bytes per request: after each, the server has them for good
const ENDED = ["succeeded", "failed", "canceled", "rejected"];
const pause = (milliseconds) => new Promise((done) => setTimeout(done, milliseconds));

/** The answer, or an error that says what is wrong and where its code is explained. A broken line throws TypeError. */
async function call(method, path, { headers = {}, body } = {}) {
  const all = { Authorization: `Bearer ${key}`, "Tus-Resumable": "1.0.0", ...headers };
  const response = await fetch(new URL(path, server), { method, headers: all, body });
  if (response.ok) return response;
  const told = await response.json().catch(() => ({ message: `HTTP ${response.status}`, help: "" }));
  throw new Error(`${told.message} (${new URL(told.help, server)})`);
}

/** The id of the finished upload. */
async function upload(blob, name) {
  const metadata = `filename ${Buffer.from(name).toString("base64")}`;
  const made = await call("POST", "/v1/uploads", { headers: { "Upload-Length": blob.size, "Upload-Metadata": metadata } });
  const address = made.headers.get("Location");
  for (let failures = 0; ; ) {
    try {
      let offset = Number((await call("HEAD", address)).headers.get("Upload-Offset"));
      while (offset < blob.size) {
        const headers = { "Upload-Offset": offset, "Content-Type": "application/offset+octet-stream" };
        const sent = await call("PATCH", address, { headers, body: blob.slice(offset, offset + PIECE) });
        offset = Number(sent.headers.get("Upload-Offset"));
        failures = 0;
      }
      return address.split("/").pop();
    } catch (error) {
      if (!(error instanceof TypeError) || ++failures > 6) throw error;
      await pause(1000 * 2 ** failures); // then the server is asked how far it came
    }
  }
}

const [scan, model] = process.argv.slice(2);
const name = basename(scan);
const body = JSON.stringify({ upload_id: await upload(await openAsBlob(scan), name), options: { preset: "auto" }, label: name });
// The same key and body are the same job, however often this is sent.
const once = { "Content-Type": "application/json", "Idempotency-Key": createHash("sha256").update(body).digest("hex") };
let job = await (await call("POST", "/v1/jobs", { headers: once, body })).json();
while (!ENDED.includes(job.state)) {
  await pause(1000);
  job = await (await call("GET", `/v1/jobs/${job.id}`)).json();
  console.log(job.state, job.progress.stage, job.progress.step);
}
if (job.state !== "succeeded") throw new Error(`${job.state}: ${job.error?.message ?? ""}`);
const glb = await call("GET", `/v1/jobs/${job.id}/results/model.glb`);
await writeFile(model, Buffer.from(await glb.arrayBuffer()));
console.log(model);
