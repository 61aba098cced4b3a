#!/usr/bin/env python3
"""Changes the latent code of a network until the surface that the service extracts encloses a given volume.

    python3 examples/optimize_latent.py URL NET.safetensors --row 0 --volume 0.5

Each round extracts a surface, starting from the one before, computes the loss L = (V - target)^2 / 2 and its gradient by the
vertices, and asks the service for the gradient by the latent code. Nothing but Python's standard library is needed; any other loss
of the vertices will do, from PyTorch or JAX as well.
"""

import argparse
import json
import struct
import urllib.request


def call(method, url, body=None, kind="application/octet-stream"):
    """An answer's body; waits for the end of jobs."""
    headers = {"Content-Type": kind, "Prefer": "wait=60"}
    with urllib.request.urlopen(urllib.request.Request(url, body, headers, method=method)) as answer:
        return answer.read()


def finished(url, job):
    """The job once it has ended."""
    while job["state"] not in ("succeeded", "failed", "canceled"):
        job = json.loads(call("GET", f"{url}/v1/jobs/{job['id']}?wait=30"))
    if job["state"] != "succeeded":
        raise SystemExit(f"job {job['id']} {job['state']}: {job['problem']}")
    return job


def read(data):
    """The tensors of a safetensors file, as flat tuples."""
    size = struct.unpack("<Q", data[:8])[0]
    header = json.loads(data[8 : 8 + size])
    header.pop("__metadata__", None)

    def numbers(tensor):
        start, end = tensor["data_offsets"]
        letter = {"F32": "f", "U32": "I"}[tensor["dtype"]]
        return struct.unpack(f"<{(end - start) // 4}{letter}", data[8 + size + start : 8 + size + end])

    return {name: numbers(tensor) for name, tensor in header.items()}


def write(name, rows):
    """A safetensors file of one tensor with rows of three numbers."""
    data = b"".join(struct.pack("<3d", *row) for row in rows)
    header = {name: {"dtype": "F64", "shape": [len(rows), 3], "data_offsets": [0, len(data)]}}
    text = json.dumps(header).encode()
    return struct.pack("<Q", len(text)) + text + data


def volume(surface):
    """The volume that a surface encloses, and its gradient by the vertices: a third of the area vectors around each."""
    flat, vertex, corners = surface["positions"], surface["vertex"], surface["triangles"]
    points = [None] * (max(vertex) + 1)
    for i, v in enumerate(vertex):
        points[v] = flat[3 * i : 3 * i + 3]
    total, gradient = 0.0, [[0.0, 0.0, 0.0] for _ in points]
    for k in range(0, len(corners), 3):
        triangle = corners[k : k + 3]
        for i in range(3):
            b, c = points[triangle[(i + 1) % 3]], points[triangle[(i + 2) % 3]]
            cross = (b[1] * c[2] - b[2] * c[1], b[2] * c[0] - b[0] * c[2], b[0] * c[1] - b[1] * c[0])
            for axis in range(3):
                gradient[triangle[i]][axis] += cross[axis] / 6
                total += points[triangle[i]][axis] * cross[axis] / 18
    return total, gradient


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("url")
    parser.add_argument("network")
    parser.add_argument("--row", type=int, default=0, help="the latent code to begin with")
    parser.add_argument("--volume", type=float, required=True, help="the volume to end with")
    parser.add_argument("--tolerance", type=float, default=1e-3, help="relative error to stop at")
    parser.add_argument("--rounds", type=int, default=20)
    arguments = parser.parse_args()

    url = arguments.url.rstrip("/")
    with open(arguments.network, "rb") as file:
        bytes_ = file.read()
    network, size = read_codes(bytes_)
    code = list(network[arguments.row * size : (arguments.row + 1) * size])
    name = json.loads(call("POST", f"{url}/v1/inputs", bytes_))["id"]
    before, reach, last = None, 0.5, float("inf")
    for round_ in range(arguments.rounds):
        request = {
            "field": {"input": name, "latent": code},
            "shrink": {"lattice": {"octahedral": {"n": 32}}},
            "outputs": ["surface"],
        }
        if before:
            request["warm_start"] = before
        body = json.dumps(request).encode()
        job = finished(url, json.loads(call("POST", f"{url}/v1/jobs", body, "application/json")))
        before = job["id"]
        surface = read(call("GET", f"{url}/v1/jobs/{before}/outputs/surface"))
        value, gradient = volume(surface)
        error = value / arguments.volume - 1
        print(f"round {round_}: volume {value:.5f}, {100 * error:+.2f} %, code {[round(z, 4) for z in code]}")
        if abs(error) < arguments.tolerance:
            return
        # a slope foretells little where the last step did not help
        reach, last = reach if abs(error) < last else reach / 2, abs(error)
        # of the volume itself: Gauss and Newton's step for L is (V - target) / |g|^2 along its gradient g
        answer = call("POST", f"{url}/v1/jobs/{before}/sensitivity", write("gradient", gradient))
        job = finished(url, json.loads(answer))
        slope = read(call("GET", f"{url}/v1/jobs/{job['id']}/outputs/sensitivity"))["latent"]
        length = sum(g * g for g in slope) ** 0.5
        step = max(-reach, min(reach, (value - arguments.volume) / length)) / length
        code = [z - step * g for z, g in zip(code, slope)]
    raise SystemExit(f"the volume is not within {arguments.tolerance} after {arguments.rounds} rounds")


def read_codes(data):
    """The latent codes that come with shrinkd's own networks, and the size of one."""
    size = struct.unpack("<Q", data[:8])[0]
    shape = json.loads(data[8 : 8 + size])["latent_codes"]["shape"]
    return read(data)["latent_codes"], shape[1]


if __name__ == "__main__":
    main()
