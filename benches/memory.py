#!/usr/bin/env python3
"""What jobs take in memory and time, beside what they are estimated to take.

    cargo build --release --bin shrinkd
    python3 benches/memory.py target/release/shrinkd [MESH_OR_NETWORK ...]

Every job runs alone in a service of its own. Peak is the process's largest resident size (VmHWM of Linux) less what it had
before the job; the estimate is `memory_bytes` of `POST /v1/jobs?validate_only=true`. Files that are named are wrapped on two
lattices each. Exits 1 when a job took more than it was estimated to take, or failed for another reason than its shape.
"""

import json
import os
import subprocess
import sys
import tempfile
import urllib.request

MIB = 1 << 20


def resident(process, name):
    """A line of /proc/PID/status, in bytes."""
    with open(f"/proc/{process}/status") as lines:
        return next(int(line.split()[1]) * 1024 for line in lines if line.startswith(name + ":"))


class Service:
    """A service of its own in a folder of its own."""

    def __init__(self, program):
        self.folder = tempfile.TemporaryDirectory()
        command = [program, "serve", "--listen", "127.0.0.1:0", "--data", self.folder.name]
        environment = dict(os.environ, SHRINKD_LOG__FORMAT="json")
        self.process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=environment)
        for line in self.process.stderr:
            said = json.loads(line)
            if said.get("message") == "listening":
                self.url = "http://" + said["http.address"]
                return
        raise SystemExit("the service did not start")

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.process.kill()
        self.process.wait()
        self.process.stderr.close()
        self.folder.cleanup()

    def ask(self, path, body=None, kind="application/json"):
        request = urllib.request.Request(self.url + path, body, {"content-type": kind} if body else {})
        with urllib.request.urlopen(request, timeout=120) as answer:
            return json.load(answer)


def measure(program, name, job, file=None):
    """Runs one job; whether it took no more than its estimate."""
    with Service(program) as service:
        if file:
            with open(file, "rb") as f:
                stored = service.ask("/v1/inputs", f.read(), "application/octet-stream")["id"]
            if job.get("kind") == "fit":
                job = dict(job, meshes=[stored])
            else:
                job = dict(job, field=dict(job.get("field", {}), input=stored))
        # what reading the upload took was given back, and may be taken again by the job
        with open(f"/proc/{service.process.pid}/clear_refs", "w") as f:
            f.write("5")
        before = resident(service.process.pid, "VmRSS")
        body = json.dumps(job).encode()
        estimate = service.ask("/v1/jobs?validate_only=true", body)
        ended = service.ask("/v1/jobs", body)
        while not ended.get("finished_at"):
            ended = service.ask(f"/v1/jobs/{ended['id']}?wait=60")
        peak = resident(service.process.pid, "VmHWM") - before
        seconds = (ended.get("metrics") or {}).get("seconds") or {}
        seconds = sum(value for value in seconds.values() if isinstance(value, (int, float))) if isinstance(seconds, dict) else seconds
        code = (ended.get("problem") or {}).get("code", "")
        state = ended["state"] + (f" ({code})" if code else "")
        held = peak <= estimate["memory_bytes"]
        print(
            f"| {name} | {estimate['vertices']:,} | {peak / MIB:,.0f} | {estimate['memory_bytes'] / MIB:,.0f} "
            f"| {seconds:,.1f} | {state}{'' if held else ', MORE THAN ESTIMATED'} |",
            flush=True,
        )
        return held and code != "internal"


def main():
    program, files = os.path.abspath(sys.argv[1]), sys.argv[2:]
    fork = json.load(open(os.path.join(os.path.dirname(__file__), "../examples/scenes/fork.json")))
    scene = lambda lattice, method="adaptive": {
        "field": {"scene": fork},
        "shrink": {"method": method, "lattice": lattice},
        "outputs": ["glb", "surface", "preview", "report"],
    }
    octahedral = lambda n: {"octahedral": {"n": n}}
    latlong = lambda n_theta, n_phi: {"latlong": {"n_theta": n_theta, "n_phi": n_phi}}
    print("| job | vertices | peak, MiB | estimate, MiB | seconds | ended |")
    print("|---|---:|---:|---:|---:|---|")
    held = [measure(program, f"scene, octahedral {n}", scene(octahedral(n))) for n in (10, 72, 150, 300, 500)]
    held.append(measure(program, "scene, 200 x 100", scene(latlong(200, 100))))
    held += [measure(program, f"scene, {a} x {b}, paper", scene(latlong(a, b), "paper")) for a, b in ((200, 100), (1000, 500))]
    for file in files:
        for n in (10, 72):
            job = {"shrink": {"lattice": octahedral(n)}, "outputs": ["glb", "surface", "preview", "report"]}
            held.append(measure(program, f"{os.path.basename(file)}, octahedral {n}", job, file))
        if file.rsplit(".", 1)[-1] in ("ply", "obj", "stl", "off", "glb"):
            for fit in ({"epochs": 1}, {"epochs": 1, "width": 256, "batch": 32768}, {"epochs": 1, "eikonal": 0.1}):
                said = ", ".join(f"{name} {value}" for name, value in fit.items())
                held.append(measure(program, f"fit of {os.path.basename(file)}, {said}", {"kind": "fit", "fit": fit}, file))
    sys.exit(not all(held))


if __name__ == "__main__":
    main()
