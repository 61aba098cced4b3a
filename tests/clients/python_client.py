"""examples/python/shrinkd_client.py against the real program: python python_client.py PROGRAM

Needs requests and numpy. Between client and service stands a proxy that breaks connections in the middle of streams, of downloads and of
answers. Exits 0 when the client missed nothing, doubled nothing and said what was wrong.
"""

import email.utils
import hashlib
import json
import pathlib
import sys
import tempfile
import time

from support import ENDLESS, PATIENCE_S, ROOT, SMALL, TINY, Fault, Proxy, Service

sys.path.insert(0, str(ROOT / "examples" / "python"))
import requests
import shrinkd_client
from shrinkd_client import Client, CorruptDownload, JobCanceled, JobFailed, Problem

# long enough to be killed in the middle, made within seconds
LONGER = {
    "field": {
        "scene": {"smooth_union": {"k": 0.1, "of": [{"box": {"half_extents": [0.5, 0.3, 0.3]}}, {"sphere": {"radius": 0.45}}]}}
    },
    "shrink": {"lattice": {"latlong": {"n_theta": 160, "n_phi": 80}}},
    "outputs": ["glb"],
}
REFUSAL = b"HTTP/1.1 503 Service Unavailable\r\nretry-after: 7\r\nconnection: close\r\ncontent-length: 0\r\n\r\n"


class Hasty(Client):
    """Notes how long it was to rest, and does not."""

    def __init__(self, *arguments, **options):
        super().__init__(*arguments, **options)
        self.rests = []

    def _rest(self, seconds):
        self.rests.append(seconds)


def raised(kind, call):
    """The exception that a call must raise."""
    try:
        call()
    except kind as error:
        return error
    raise AssertionError(f"expected {kind.__name__}, and nothing was raised")


def submitted(client, request=TINY, **options):
    members = {name: value for name, value in request.items() if name != "field"}
    return client.submit(request["field"], **{**members, **options})


def events_of(service, job):
    """All events of a job as the service has them: number, kind and data."""
    page = json.loads(service.get(f"/v1/jobs/{job}/events?after=0&limit=512", accept="application/json"))
    assert page["ended"], page
    return [(event["seq"], event["type"], event["data"]) for event in page["events"]]


def a_stream_is_read_however_it_is_cut():
    text = (
        ': heartbeat\n\nid: 1\nevent: state\ndata: {"a":\ndata:"größer"}\nretry: 250\n\n'
        'id:2\r\nevent:mesh\r\ndata:{}\r\n\r\nid: 3\revent: done\rdata: [1]\r\runknown: x\ndata: {"without": "a number"}\n\n'
        "id: 4\nevent: state\ndata: {}\n"
    )
    expected = [(1, "state", {"a": "größer"}, 0.25), (2, "mesh", {}, None), (3, "done", [1], None)]
    whole = text.encode()
    for size in range(1, len(whole) + 1):
        chunks = [whole[i : i + size] for i in range(0, len(whole), size)]
        frames = [frame for frame in shrinkd_client._frames(chunks) if frame.event]
        found = [(f.event.seq, f.event.kind, f.event.data, f.retry) for f in frames]
        assert found == expected, (size, found)


def a_pause_is_read_as_seconds_or_as_a_date():
    assert shrinkd_client._retry_after("7") == 7.0
    date = email.utils.formatdate(time.time() + 1000, usegmt=True)
    assert 900 < shrinkd_client._retry_after(date) <= 1000
    assert shrinkd_client._retry_after("soon") is None and shrinkd_client._retry_after(None) is None


def a_cut_stream_is_taken_up_without_a_gap(service, proxy):
    client = Hasty(proxy.url)
    job = submitted(client, SMALL, outputs=["glb", "report"])["id"]
    stream = f"GET /v1/jobs/{job}/events"
    # inside of the answer's head, and inside of the second frame of every stream
    proxy.faults = [Fault(stream, bytes=40), *(Fault(stream, frames=1) for _ in range(4))]
    struck = proxy.struck
    seen = [(event.seq, event.kind, event.data) for event in client.follow(job, after=0)]
    assert proxy.struck == struck + 5 and not proxy.faults, proxy.faults
    assert [number for number, _, _ in seen] == list(range(1, len(seen) + 1)), [number for number, _, _ in seen]
    assert seen == events_of(service, job)
    assert seen[-1][1] == "done" and seen[-1][2]["state"] == "succeeded", seen[-1]
    resumed = [head for head in proxy.heads(stream.lower()) if "last-event-id: 4" in head]
    assert resumed, proxy.heads(stream.lower())
    # the service asks for two seconds
    assert client.rests.count(2.0) == 5, client.rests
    # another one may ask for more
    frame = b'id: 1\nevent: state\ndata: {"attempt":0,"state":"queued"}\nretry: 5000\n\n'
    head = b"HTTP/1.1 200 OK\r\ncontent-type: text/event-stream\r\nconnection: close\r\n\r\n"
    proxy.faults = [Fault(stream, answer=head + frame)]
    again = [(event.seq, event.kind, event.data) for event in client.follow(job, after=0)]
    assert again == seen and client.rests[-1] == 5.0, client.rests
    # whoever has seen everything is sent away, and a newcomer is told what there is
    assert list(client.follow(job, after=len(seen))) == []
    late = list(client.follow(job))
    assert [event.kind for event in late] == ["snapshot", "done"] and late[0].job()["id"] == job, late

    meshes = [event.mesh() for event in client.follow(job, after=0) if event.kind == "mesh"]
    assert meshes, "a front was never shown"
    for mesh in meshes:
        positions, triangles = mesh.arrays()
        assert positions.shape == (len(mesh.positions), 3) and triangles.shape == (len(mesh.triangles), 3)
        assert abs(positions).max() <= 1.0 and set(triangles.flat) == set(range(len(positions)))
    # the last front lies about the two balls, which reach from -0.4 to 0.6
    low, high = positions[:, 0].min(), positions[:, 0].max()
    assert abs(low + 0.4) < 0.02 and abs(high - 0.6) < 0.02, (low, high)
    torn = {**json.loads(json.dumps(late[1].data)), "vertices": 1, "faces": 0, "positions": "AAAA", "triangles": ""}
    raised(ValueError, lambda: shrinkd_client.decode_mesh({**torn, "origin": [0, 0, 0], "step": [1, 1, 1], "index_bytes": 2}))
    return f"{len(seen)} events over 6 connections"


def a_killed_service_is_followed_on(program, folder):
    # the job is taken up again soon; on a machine so busy that heartbeats are late, more often than once, and never too often
    settings = {"SHRINKD_WORKER__LEASE_S": "5", "SHRINKD_WORKER__MAX_LOSSES": "1000"}
    with Service(program, folder, settings) as service:
        proxy = Proxy(service.address)
        client = Hasty(proxy.url)
        job = submitted(client, LONGER)["id"]
        killed, seen = False, []
        for event in client.follow(job, after=0):
            seen.append((event.seq, event.kind, event.data))
            if event.kind == "progress" and not killed:
                killed = True
                service.kill()
                service.start()
                proxy.target = service.address
        assert killed and seen == events_of(service, job)
        assert [number for number, _, _ in seen] == list(range(1, len(seen) + 1)), [number for number, _, _ in seen]
        assert seen[-1][2]["state"] == "succeeded" and seen[-1][2]["attempt"] >= 2, seen[-1]
        assert client.wait(job)["attempt"] >= 2
    return f"{len(seen)} events over two lives of the service"


def a_cut_download_is_whole(service, proxy, folder):
    client = Hasty(proxy.url)
    job = client.wait(
        submitted(client, shrink={**TINY["shrink"], "lattice": {"octahedral": {"n": 32}}}, outputs=["glb"])["id"], PATIENCE_S
    )
    expected = service.get(f"/v1/jobs/{job['id']}/outputs/glb")
    download = f"GET /v1/jobs/{job['id']}/outputs/glb"
    # before the answer, in its head, and twice in the bytes
    proxy.faults = [Fault(download, bytes=n) for n in (0, 100, 40000, 60000)]
    path = client.download(job, "glb", folder / "cut.glb")
    assert path.read_bytes() == expected and not proxy.faults
    heads = proxy.heads(download.lower())
    ranges = [head for head in heads if "range: bytes=" in head]
    assert len(heads) == 5 and len(ranges) == 2, heads
    sha256 = hashlib.sha256(expected).hexdigest()
    assert all(f'if-range: "{sha256}"' in head for head in ranges), ranges
    assert client.download(job["id"], "glb") == expected

    # a program that gave up leaves what it has, and a later one goes on with it
    giving_up = Hasty(proxy.url, tries=1)
    proxy.faults = [Fault(download, bytes=50000), Fault(download, bytes=0)]
    target = folder / "left.glb"
    raised(requests.RequestException, lambda: giving_up.download(job, "glb", target))
    (part,) = folder.glob("left.glb.*")
    begun = part.stat().st_size
    assert 0 < begun < len(expected) and not target.exists()
    client.download(job, "glb", target)
    assert target.read_bytes() == expected and not part.exists()
    assert f"range: bytes={begun}-" in proxy.heads(download.lower())[-1]

    # what it left may be no good
    part.write_bytes(b"nonsense" + expected[8:1000])
    target.unlink()
    client.download(job, "glb", target)
    assert target.read_bytes() == expected and not part.exists()

    # and what comes may not be it: then what was there stays
    wrong = b"HTTP/1.1 200 OK\r\ncontent-length: %d\r\nconnection: close\r\n\r\n" % len(expected) + bytes(len(expected))
    proxy.faults = [Fault(download, answer=wrong)]
    error = raised(CorruptDownload, lambda: client.download(job, "glb", target))
    assert sha256 in str(error) and target.read_bytes() == expected
    assert sorted(path.name for path in folder.iterdir()) == ["cut.glb", "left.glb"]
    return f"{len(expected)} bytes in pieces"


def a_submit_whose_answer_was_lost_is_one_job(proxy):
    client = Hasty(proxy.url)
    labels = {"test": "lost"}
    # the service took it, and its answer never arrived whole
    proxy.faults = [Fault("POST /v1/jobs", bytes=0), Fault("POST /v1/jobs", bytes=300), Fault("POST /v1/jobs", answer=REFUSAL)]
    job = submitted(client, labels=labels)
    assert not proxy.faults and 7.0 in client.rests, client.rests
    assert [found["id"] for found in client.list(labels=labels)] == [job["id"]]

    once = submitted(client, labels={"test": "key"}, idempotency_key="mine")
    assert submitted(client, labels={"test": "key"}, idempotency_key="mine")["id"] == once["id"]
    reused = raised(Problem, lambda: submitted(client, labels={"test": "other"}, idempotency_key="mine"))
    assert (reused.status, reused.code) == (422, "idempotency_key_reused"), reused


def tries_are_bounded(proxy):
    client = Hasty(proxy.url, tries=3)
    proxy.faults = [Fault("GET /v1/jobs", answer=REFUSAL) for _ in range(3)]
    refused = raised(Problem, lambda: list(client.list()))
    assert refused.status == 503 and refused.tries == 3 and client.rests == [7.0, 7.0], (refused, client.rests)
    impatient = Hasty(proxy.url, longest_pause=5.0)
    proxy.faults = [Fault("GET /v1/jobs", answer=REFUSAL)]
    assert raised(Problem, lambda: list(impatient.list())).tries == 1 and impatient.rests == []
    before = len(proxy.requests)
    proxy.faults = [Fault("GET /v1/jobs/", bytes=0) for _ in range(3)]
    raised(requests.ConnectionError, lambda: client.get("00000000-0000-7000-8000-000000000000"))
    assert len(proxy.requests) == before + 3 and not proxy.faults
    job = submitted(client)["id"]
    stream = f"GET /v1/jobs/{job}/events"
    proxy.faults = [Fault(stream, bytes=0) for _ in range(3)]
    raised(requests.RequestException, lambda: list(client.follow(job)))
    client.wait(job)


def problems_say_what_is_wrong_and_where(client):
    wrong = raised(Problem, lambda: client.submit({"scene": {"sphere": {"radios": 1}}}))
    assert (wrong.status, wrong.code) == (422, "invalid_request") and wrong.request_id
    assert [fault["code"] for fault in wrong.errors] == ["unknown_member", "missing_member"], wrong.errors
    lines = str(wrong).splitlines()
    assert lines[0].startswith("422 invalid_request: ") and lines[1].startswith("  /field/scene/sphere/radios: "), lines
    assert wrong.request_id in lines[-1]
    nobody = "00000000-0000-7000-8000-000000000000"
    assert raised(Problem, lambda: client.get(nobody)).code == "unknown_job"
    assert raised(Problem, lambda: list(client.follow(nobody))).code == "unknown_job"
    assert raised(Problem, lambda: client.upload(b"no field at all")).code == "unrecognized_input"
    ring = {"field": {"scene": {"torus": {"major": 0.5, "minor": 0.2}}}, "shrink": SMALL["shrink"]}
    job = submitted(client, ring)["id"]
    failed = raised(JobFailed, lambda: client.wait(job, PATIENCE_S))
    assert failed.code == "genus" and failed.job["id"] == job, failed
    assert str(failed).startswith(f"job {job} failed: genus: ") and "at (" in str(failed), str(failed)
    assert client.get(job)["state"] == "failed"


def a_job_is_listed_cancelled_and_forgotten(client, proxy):
    labels = {"test": "list"}
    made = [
        submitted(client, labels=labels, shrink={**TINY["shrink"], "lattice": {"octahedral": {"n": 8 + i}}})["id"]
        for i in range(3)
    ]
    for job in made:
        client.wait(job, PATIENCE_S)
    assert [job["id"] for job in client.list(labels=labels, page=2)] == made[::-1]
    assert [job["id"] for job in client.list(labels=labels, state="succeeded", page=1)] == made[::-1]
    assert list(client.list(labels=labels, state=["failed", "canceled"])) == []

    job = submitted(client, ENDLESS)["id"]
    for event in client.follow(job, after=0):
        if event.kind == "progress":
            break
    assert raised(Problem, lambda: client.forget(job)).code == "job_not_ended"
    assert raised(Problem, lambda: client.download(job, "glb")).code == "job_not_ended"
    raised(TimeoutError, lambda: client.wait(job, 0.01))
    assert client.cancel(job)["state"] in ("canceling", "canceled")
    assert raised(JobCanceled, lambda: client.wait(job, PATIENCE_S)).job["state"] == "canceled"
    assert client.cancel(job)["state"] == "canceled"
    # the answer is lost, and the second try finds that there is no such job any more
    proxy.faults = [Fault("DELETE /v1/jobs", bytes=0)]
    Hasty(proxy.url).forget(job)
    assert not proxy.faults
    assert raised(Problem, lambda: client.get(job)).code == "unknown_job"
    assert raised(Problem, lambda: client.forget(job)).code == "unknown_job"
    assert raised(Problem, lambda: client.download(made[0], "film")).code == "unknown_output"


def a_network_is_uploaded_and_differentiated(client, folder):
    network = ROOT / "tests" / "fixtures" / "networks" / "blob.safetensors"
    uploaded = client.upload(network)
    assert uploaded["id"] == "sha256:" + hashlib.sha256(network.read_bytes()).hexdigest()
    assert uploaded["description"]["kind"] == "network" and client.upload(network.read_bytes()) == uploaded
    job = submitted(client, {**SMALL, "field": {"input": uploaded["id"]}}, outputs=["surface"])
    done = client.wait(job["id"], PATIENCE_S)
    gradient = [(0.0, 0.0, 1.0)] * done["metrics"]["vertices"]
    derived = client.wait(client.sensitivity(done["id"], gradient)["id"], PATIENCE_S)
    assert derived["kind"] == "sensitivity" and derived.get("of") == done["id"], derived
    # the submit's own record lists no outputs yet, and is read anew
    tensors = client.download(derived, "sensitivity")
    header = json.loads(tensors[8 : 8 + int.from_bytes(tensors[:8], "little")])
    assert "layers.0.weight" in header and "layers.0.bias" in header, header
    assert client.download(job, "surface", folder / "surface").stat().st_size == done["outputs"][0]["bytes"]
    assert raised(Problem, lambda: client.sensitivity(done["id"], b"no gradient")).code == "malformed_gradient"
    plain = client.wait(submitted(client, outputs=["glb"])["id"], PATIENCE_S)["id"]
    assert raised(Problem, lambda: client.sensitivity(plain, gradient)).code == "not_differentiable"
    # a parameter of the upload
    assert raised(Problem, lambda: client.upload(network, w0="fast")).status in (400, 422)


def a_key_is_brought_along(program, folder):
    with Service(program, folder, {"SHRINKD_AUTH__MODE": "required"}) as service:
        stranger = raised(Problem, lambda: list(Client(service.url).list()))
        assert (stranger.status, stranger.code) == (401, "unauthenticated"), stranger
        keys = [service.key("--tenant", "a", "--scope", "read"), service.key("--tenant", "a"), service.key("--tenant", "b")]
        reader, writer, other = (Client(service.url, key) for key in keys)
        assert list(reader.list()) == []
        assert raised(Problem, lambda: submitted(reader)).code == "insufficient_scope"
        job = writer.wait(submitted(writer)["id"], PATIENCE_S)
        assert [event.kind for event in reader.follow(job["id"])] == ["snapshot", "done"]
        assert reader.download(job, "glb")[:4] == b"glTF"
        assert raised(Problem, lambda: other.get(job["id"])).code == "unknown_job"


def main():
    program = sys.argv[1]
    a_stream_is_read_however_it_is_cut()
    a_pause_is_read_as_seconds_or_as_a_date()
    with tempfile.TemporaryDirectory() as made, tempfile.TemporaryDirectory() as data, Service(program, data) as service:
        proxy, folder = Proxy(service.address), pathlib.Path(made)
        with Client(proxy.url) as client:
            streamed = a_cut_stream_is_taken_up_without_a_gap(service, proxy)
            downloaded = a_cut_download_is_whole(service, proxy, folder)
            a_submit_whose_answer_was_lost_is_one_job(proxy)
            tries_are_bounded(proxy)
            problems_say_what_is_wrong_and_where(client)
            a_job_is_listed_cancelled_and_forgotten(client, proxy)
            a_network_is_uploaded_and_differentiated(client, folder)
    with tempfile.TemporaryDirectory() as data:
        survived = a_killed_service_is_followed_on(program, data)
    with tempfile.TemporaryDirectory() as data:
        a_key_is_brought_along(program, data)
    print(f"{streamed}, {survived}, {downloaded}: nothing missed, nothing twice")


if __name__ == "__main__":
    main()
