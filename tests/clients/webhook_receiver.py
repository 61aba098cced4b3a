"""A receiver of notices that verifies them with the library of Standard Webhooks: python webhook_receiver.py PROGRAM

Needs standardwebhooks. Starts the service, submits a job, refuses its first notice, and takes the second. Exits 0 when both were
signed as the library expects and have the same id.
"""

import http.server
import json
import os
import queue
import subprocess
import sys
import tempfile
import threading
import urllib.request

from standardwebhooks import Webhook

SECRET = "whsec_b25lIHNlY3JldCBvZiB0aGUgY2hlY2sgb2Ygc2hyaW5rZA=="
PATIENCE_S = 120


class Receiver(http.server.BaseHTTPRequestHandler):
    notices = queue.Queue()
    answers = iter([503, 204])

    def do_POST(self):
        body = self.rfile.read(int(self.headers["content-length"]))
        self.notices.put((dict(self.headers), body))
        self.send_response(next(self.answers, 204))
        self.send_header("content-length", "0")
        self.end_headers()

    def log_message(self, *_):
        pass


def main():
    receiver = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Receiver)
    threading.Thread(target=receiver.serve_forever, daemon=True).start()
    settings = {
        "SHRINKD_LOG__FORMAT": "json",
        "SHRINKD_WEBHOOKS__SECRETS": json.dumps([SECRET]),
        "SHRINKD_WEBHOOKS__ALLOW_HTTP": "true",
        "SHRINKD_WEBHOOKS__PORTS": "[]",
        "SHRINKD_WEBHOOKS__ALLOW_PRIVATE": '["127.0.0.0/8"]',
    }
    with tempfile.TemporaryDirectory() as data:
        command = [sys.argv[1], "serve", "--listen", "127.0.0.1:0", "--data", data]
        service = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env={**os.environ, **settings})
        try:
            address = None
            while address is None:
                entry = json.loads(next(service.stderr))
                address = entry["http.address"] if entry.get("message") == "listening" else None
            # nobody reads on, and a full pipe must not stop the service
            threading.Thread(target=service.stderr.read, daemon=True).start()
            job = {
                "field": {"scene": {"sphere": {"radius": 0.6}}},
                "shrink": {"method": "paper", "lattice": {"latlong": {"n_theta": 32, "n_phi": 16}}},
                "webhook": {"url": f"http://127.0.0.1:{receiver.server_port}/"},
            }
            request = urllib.request.Request(
                f"http://{address}/v1/jobs", json.dumps(job).encode(), {"content-type": "application/json"}
            )
            accepted = json.load(urllib.request.urlopen(request))
            ids = set()
            for _ in range(2):
                headers, body = Receiver.notices.get(timeout=PATIENCE_S)
                notice = Webhook(SECRET).verify(body, headers)
                assert notice["type"] == "job.succeeded" and notice["data"]["id"] == accepted["id"], notice
                ids.add(headers["webhook-id"])
            assert len(ids) == 1, ids
            print("two attempts, one id, both verified")
        finally:
            service.terminate()
            service.wait(timeout=PATIENCE_S)


if __name__ == "__main__":
    main()
