"""Receive the ends of jobs: a server of the standard library that believes only what is signed.

    python webhook.py PORT        with the webhook's secret, whsec_..., in ADVTEX_WEBHOOK_SECRET

Needs `standardwebhooks`. Behind it stands whatever you do with a finished model; the same delivery can come twice.
"""

from __future__ import annotations

import json
import os
import sys
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

from standardwebhooks import Webhook, WebhookVerificationError

MOST_BYTES = 1 << 20


SEEN: set[str] = set()
"""Deliveries by `webhook-id`; keep them in a database where a job must not be taken up twice."""


class Receiver(BaseHTTPRequestHandler):
    def do_POST(self) -> None:
        body = self.rfile.read(min(int(self.headers.get("Content-Length", 0)), MOST_BYTES))
        try:
            Webhook(os.environ["ADVTEX_WEBHOOK_SECRET"]).verify(body, dict(self.headers.items()))
        except WebhookVerificationError as error:
            self.send_error(401, str(error))
            return
        event, delivery = json.loads(body), self.headers["webhook-id"]
        if delivery not in SEEN:
            SEEN.add(delivery)
            print(event["type"], event["data"]["id"], event["data"]["label"], flush=True)
        self.send_response(204)  # within 15 seconds: longer work belongs into a queue of yours
        self.end_headers()


if __name__ == "__main__":
    ThreadingHTTPServer(("", int(sys.argv[1])), Receiver).serve_forever()
