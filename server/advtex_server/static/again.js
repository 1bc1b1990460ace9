// The scan of a job once more.

import { call, token } from "./base.js";

const LABEL = 200; // characters, at most
const CROPPED = ", cropped";

/** Makes a job of the same scan, which is not sent again, with the same options and this box, and goes to its page. */
export async function textureAgain({ source, upload_id, label, options, priority, retention_seconds }, box) {
  const named = label && !label.endsWith(CROPPED) ? label.slice(0, LABEL - CROPPED.length) + CROPPED : label;
  const scan = source ? { source } : { upload_id };
  const made = await call("POST", "/v1/jobs", {
    body: { ...scan, options: { ...options, box }, label: named, priority, retention_seconds }, headers: { "Idempotency-Key": token() },
  });
  location.assign(`/jobs/${made.id}`);
}
