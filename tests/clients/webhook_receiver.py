"""A receiver of notices that verifies them with the library of Standard Webhooks: python webhook_receiver.py PROGRAM

Needs standardwebhooks and trustme. Starts the service and submits jobs. Over http a receiver refuses the first notice and takes the
second; over https one gets its notice whose certificate the service trusts, and one whose certificate nobody vouches for gets none.
Exits 0 when every notice was signed as the library expects, and the two of one job had the same id.
"""

import http.server
import json
import os
import queue
import ssl
import subprocess
import sys
import tempfile
import threading
import urllib.request

import trustme
from standardwebhooks import Webhook

SECRET = "whsec_b25lIHNlY3JldCBvZiB0aGUgY2hlY2sgb2Ygc2hyaW5rZA=="
PATIENCE_S = 120


class Receiver(http.server.ThreadingHTTPServer):
    """Keeps every notice, and answers with these codes and then with 204."""

    def __init__(self, answers=(), authority=None):
        super().__init__(("127.0.0.1", 0), Handler)
        self.notices, self.answers, self.refused = queue.Queue(), iter(answers), threading.Event()
        self.scheme = "http"
        if authority:
            context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
            authority.issue_cert("localhost").configure_cert(context)
            self.socket = context.wrap_socket(self.socket, server_side=True)
            self.scheme = "https"
        threading.Thread(target=self.serve_forever, daemon=True).start()

    def get_request(self):
        try:
            return super().get_request()
        except ssl.SSLError as error:
            self.refused.set()
            raise OSError("no connection") from error

    def url(self):
        return f"{self.scheme}://localhost:{self.server_port}/"

    def verified(self):
        headers, body = self.notices.get(timeout=PATIENCE_S)
        return headers["webhook-id"], Webhook(SECRET).verify(body, headers)


class Handler(http.server.BaseHTTPRequestHandler):
    def do_POST(self):
        body = self.rfile.read(int(self.headers["content-length"]))
        self.server.notices.put((dict(self.headers), body))
        self.send_response(next(self.server.answers, 204))
        self.send_header("content-length", "0")
        self.end_headers()

    def log_message(self, *_):
        pass


def submit(address, receiver):
    job = {
        "field": {"scene": {"sphere": {"radius": 0.6}}},
        "shrink": {"method": "paper", "lattice": {"latlong": {"n_theta": 32, "n_phi": 16}}},
        "webhook": {"url": receiver.url()},
    }
    request = urllib.request.Request(
        f"http://{address}/v1/jobs", json.dumps(job).encode(), {"content-type": "application/json"}
    )
    return json.load(urllib.request.urlopen(request))["id"]


def main():
    trusted, unknown = trustme.CA(), trustme.CA()
    plain, private, impostor = Receiver([503]), Receiver(authority=trusted), Receiver(authority=unknown)
    settings = {
        "SHRINKD_LOG__FORMAT": "json",
        "SHRINKD_WEBHOOKS__SECRETS": json.dumps([SECRET]),
        "SHRINKD_WEBHOOKS__ALLOW_HTTP": "true",
        "SHRINKD_WEBHOOKS__PORTS": "[]",
        "SHRINKD_WEBHOOKS__ALLOW_PRIVATE": '["127.0.0.0/8"]',
    }
    with tempfile.TemporaryDirectory() as data, trusted.cert_pem.tempfile() as authorities:
        # where the certificates are of those who vouch for others, on systems with OpenSSL
        settings["SSL_CERT_FILE"] = authorities
        command = [sys.argv[1], "serve", "--listen", "127.0.0.1:0", "--data", data]
        service = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env={**os.environ, **settings})
        try:
            address = None
            while address is None:
                entry = json.loads(next(service.stderr))
                address = entry["http.address"] if entry.get("message") == "listening" else None
            # nobody reads on, and a full pipe must not stop the service
            threading.Thread(target=service.stderr.read, daemon=True).start()
            job = submit(address, plain)
            told = [plain.verified() for _ in range(2)]
            assert all((n["type"], n["data"]["id"]) == ("job.succeeded", job) for _, n in told), told
            assert len({id for id, _ in told}) == 1, told
            submit(address, impostor)
            assert impostor.refused.wait(PATIENCE_S), "the service did not look at the certificate"
            job = submit(address, private)
            _, notice = private.verified()
            assert (notice["type"], notice["data"]["id"]) == ("job.succeeded", job), notice
            assert impostor.notices.empty(), "a notice went to a receiver that nobody vouches for"
            print("two attempts with one id, one over TLS, none to a stranger; all verified")
        finally:
            service.terminate()
            service.wait(timeout=PATIENCE_S)


if __name__ == "__main__":
    main()
