"""What the tests of the clients share: the service on a free port, and a proxy before it that cuts connections where it is told to."""

import dataclasses
import http.client
import json
import os
import pathlib
import queue
import re
import socket
import subprocess
import threading
import time

ROOT = pathlib.Path(__file__).resolve().parents[2]
PATIENCE_S = 300

# made at once
TINY = {
    "field": {"scene": {"sphere": {"radius": 0.6}}},
    "shrink": {"method": "paper", "lattice": {"latlong": {"n_theta": 32, "n_phi": 16}}},
    "outputs": ["glb"],
}
# two balls that flow into each other, on a lattice of some thousand vertices
SMALL = {
    "field": {
        "scene": {
            "smooth_union": {
                "k": 0.1,
                "of": [
                    {"sphere": {"radius": 0.4}},
                    {"translate": {"by": [0.35, 0, 0.2], "of": {"sphere": {"radius": 0.25}}}},
                ],
            }
        }
    },
    "shrink": {"lattice": {"octahedral": {"n": 16}}},
}
# the paper's loop on the finest lattice: longer than any test
ENDLESS = {
    "field": {"scene": {"ellipsoid": {"radii": [0.8, 0.6, 0.4]}}},
    "shrink": {"method": "paper", "lattice": {"latlong": {"n_theta": 2048, "n_phi": 1024}}},
}


class Service:
    """The program as a service in a folder, on a port that is free. `settings` are variables such as `SHRINKD_AUTH__MODE`."""

    def __init__(self, program, folder, settings=None):
        self.program, self.folder, self.settings = program, str(folder), dict(settings or {})
        self.process, self.address = None, None
        self.start()

    def start(self):
        command = [self.program, "serve", "--listen", "127.0.0.1:0", "--data", self.folder]
        environment = {**os.environ, "SHRINKD_LOG__FORMAT": "json", **self.settings}
        self.process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=environment)
        told = []
        for line in self.process.stderr:
            told.append(line)
            entry = json.loads(line) if line.startswith("{") else {}
            if entry.get("message") == "listening":
                self.address = entry["http.address"]
                # nobody reads on, and a full pipe must not stop the service
                threading.Thread(target=self.process.stderr.read, daemon=True).start()
                return
        raise SystemExit("the service did not start: " + "".join(told))

    @property
    def url(self):
        return f"http://{self.address}"

    def kill(self):
        """As if the power had gone."""
        self.process.kill()
        self.process.wait(timeout=PATIENCE_S)

    def key(self, *options):
        """A new API key that counts: the service looks for new ones five times a second at most."""
        command = [self.program, "keys", "create", "--data", self.folder, *options]
        key = subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()
        until(lambda: self.answer("/v1/jobs", key=key)[0] != 401, "a new key counts")
        return key

    def get(self, path, **headers):
        """The body of a success."""
        status, body = self.answer(path, **headers)
        assert status == 200, (path, status, body)
        return body

    def answer(self, path, accept="*/*", key=None):
        """Status and body of an answer, without any of the clients."""
        host, port = self.address.split(":")
        connection = http.client.HTTPConnection(host, int(port), timeout=PATIENCE_S)
        connection.request("GET", path, headers={"accept": accept, **({"authorization": f"Bearer {key}"} if key else {})})
        answer = connection.getresponse()
        body = answer.read()
        connection.close()
        return answer.status, body

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.process.terminate()
        try:
            self.process.wait(timeout=PATIENCE_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            raise


@dataclasses.dataclass
class Fault:
    """What becomes of one request whose first line begins with `line`: of its answer `bytes` bytes get through, or `frames` whole frames
    of a stream and the first bytes of the next one, and then the connection breaks. With `answer` these bytes are the answer, and the
    request does not reach the service."""

    line: str
    bytes: int = None
    frames: int = None
    answer: bytes = None


class Proxy:
    """Stands between a client and a service. `target` may be changed while connections are open; `requests` has the heads of all requests
    that came, and `faults` what is still to happen, in order."""

    # of the frame that is cut in two
    A_FEW = 7

    def __init__(self, target):
        self.target, self.faults, self.requests, self.struck = target, [], [], 0
        self.lock = threading.Lock()
        self.listener = socket.create_server(("127.0.0.1", 0))
        threading.Thread(target=self._accept, daemon=True).start()

    @property
    def url(self):
        return f"http://127.0.0.1:{self.listener.getsockname()[1]}"

    def heads(self, line):
        """The heads of the requests that began so."""
        with self.lock:
            return [head for head in self.requests if head.startswith(line)]

    def _accept(self):
        while True:
            try:
                client, _ = self.listener.accept()
            except OSError:
                return
            threading.Thread(target=self._serve, args=(client,), daemon=True).start()

    def _serve(self, client):
        try:
            host, port = self.target.split(":")
            service = socket.create_connection((host, int(port)))
        except OSError:
            broken(client)
            return
        # the fault that awaits the answer to the request that went by last
        waiting = queue.SimpleQueue()
        threading.Thread(target=self._answers, args=(service, client, waiting), daemon=True).start()
        try:
            while data := client.recv(1 << 16):
                # a client of HTTP/1.1 that does not pipeline: what begins like a request is one, and its head comes whole
                if re.match(rb"(GET|HEAD|POST|DELETE) /", data):
                    head = data.split(b"\r\n\r\n")[0].decode("latin-1").lower()
                    with self.lock:
                        self.requests.append(head)
                        fault = None
                        if self.faults and head.startswith(self.faults[0].line.lower()):
                            fault = self.faults.pop(0)
                    if fault and fault.answer is not None:
                        with self.lock:
                            self.struck += 1
                        # all of the request is taken in first, lest its rest break the connection before the answer is read
                        self._swallow(client, data)
                        client.sendall(fault.answer)
                        broken(service)
                        client.shutdown(socket.SHUT_WR)
                        return
                    waiting.put(fault)
                service.sendall(data)
        except OSError:
            pass
        finally:
            broken(service)

    @staticmethod
    def _swallow(client, data):
        head, _, body = data.partition(b"\r\n\r\n")
        found = re.search(rb"content-length: *(\d+)", head.lower())
        left = int(found.group(1)) - len(body) if found else 0
        while left > 0:
            got = client.recv(1 << 16)
            if not got:
                return
            left -= len(got)

    def _answers(self, service, client, waiting):
        fault, passed, tail = None, 0, b""
        try:
            while data := service.recv(1 << 14):
                while not waiting.empty():
                    fault, passed, tail = waiting.get(), 0, b""
                if fault is not None:
                    keep = self._keep(fault, passed, tail, data)
                    if keep is not None:
                        client.sendall(data[:keep])
                        with self.lock:
                            self.struck += 1
                        break
                    passed, tail = passed + len(data), tail + data
                client.sendall(data)
        except OSError:
            pass
        broken(client)
        broken(service)

    def _keep(self, fault, passed, before, data):
        """How much of `data` still gets through, where the connection is to break in it."""
        if fault.bytes is not None:
            return max(0, fault.bytes - passed) if passed + len(data) > fault.bytes else None
        # the end of the frames wanted, and a few bytes of the one behind
        whole, end = before + data, 0
        for _ in range(fault.frames):
            end = whole.find(b"\n\n", end) + 2
            if end == 1:
                return None
        end += self.A_FEW
        return max(0, end - len(before)) if len(whole) >= end else None


def broken(connection):
    """Ends a connection for both sides, also where another thread waits at it."""
    try:
        connection.shutdown(socket.SHUT_RDWR)
    except OSError:
        pass
    connection.close()


def until(condition, what):
    """Waits for a condition."""
    deadline = time.monotonic() + PATIENCE_S
    while not (value := condition()):
        assert time.monotonic() < deadline, f"in {PATIENCE_S} s: {what}"
        time.sleep(0.02)
    return value
