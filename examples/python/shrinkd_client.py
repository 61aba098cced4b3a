"""A client of shrinkd: one file to copy. Python 3.9 or newer and `requests`; numpy only where arrays are asked for.

    from shrinkd_client import Client

    client = Client("http://127.0.0.1:8080")
    job = client.submit({"scene": {"sphere": {"radius": 0.6}}}, outputs=["glb", "report"])
    for event in client.follow(job["id"]):
        print(event.seq, event.kind)
    client.download(job["id"], "glb", "sphere.glb")

What it promises:

- A submit whose answer was lost is repeated with the same key and is the same job.
- `follow` goes on where it was cut off and misses no event that the service still has, also when the service was killed meanwhile.
- `download` gives the bytes that the job's record names, checked by length and SHA-256, or raises.
- A call is tried a bounded number of times, and no pause between two tries is longer than `longest_pause` seconds.

What it does not: a `Client` is for one thread at a time (make one for each), and two downloads to one path at once disturb each other.

Whatever the service refuses is raised as `Problem`. What never reached it, or came back broken, is raised as it comes from `requests`
(`requests.RequestException`) once the tries are used up.
"""

from __future__ import annotations

import array
import base64
import codecs
import dataclasses
import email.utils
import hashlib
import importlib
import json
import os
import pathlib
import random
import re
import struct
import sys
import time
import types
import urllib.parse
import uuid
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, TypedDict, Union, cast, overload

import requests
from requests.auth import AuthBase

__all__ = [
    "Client",
    "CorruptDownload",
    "Event",
    "Fault",
    "Input",
    "Job",
    "JobCanceled",
    "JobFailed",
    "Mesh",
    "Output",
    "Problem",
    "Progress",
    "ShrinkdError",
    "decode_mesh",
    "gradient_file",
]

Pathlike = Union[str, "os.PathLike[str]"]

ENDED = ("succeeded", "failed", "canceled")
"""States in which a job stays."""

# a proxy before the service may answer 502 and 504 for it
TRY_AGAIN = (429, 502, 503, 504)
# what a POST may wait for within one request, by the service's contract
LONGEST_POLL_S = 60.0
# the service says that it is alive every 15 s; three of them missing is a dead connection
SILENCE_S = 45.0
# before the service has said how long to wait (`retry:`)
FIRST_RETRY_S = 2.0
# bytes read at once: of a connection that breaks, what has not filled one is lost
BLOCK = 1 << 14


class Output(TypedDict):
    """What a job made. `bytes` is its length, `sha256` the hash of its bytes in lower-case hexadecimal."""

    name: str
    href: str
    media_type: str
    bytes: int
    sha256: str
    certified: bool


class Fault(TypedDict):
    """One thing that is wrong in a request: a JSON Pointer to it, a stable name, a sentence."""

    pointer: str
    code: str
    detail: str


class Failure(TypedDict, total=False):
    """Why a job failed. `places` are positions in scene units."""

    type: str
    code: str
    title: str
    detail: str
    errors: list[Fault]
    places: list[list[float]]


class Progress(TypedDict, total=False):
    """How far a job has come: `fraction` from 0 to 1, `max_distance` in scene units, `eta_s` in seconds."""

    attempt: int
    stage: str
    iteration: int
    iterations: int
    fraction: float
    energy: float | None
    max_distance: float | None
    flips: int | None
    eta_s: float | None


class _JobAlways(TypedDict):
    id: str
    kind: str
    state: str
    attempt: int
    revision: int
    created_at: str
    labels: dict[str, str]
    outputs: list[Output]


class Job(_JobAlways, total=False):
    """A job's record. `attempt` counts the workers that took it up; times are RFC 3339 in UTC, `eta_s` is in seconds."""

    started_at: str | None
    finished_at: str | None
    eta_s: float | None
    progress: Progress | None
    metrics: dict[str, Any] | None
    problem: Failure | None
    shrink: dict[str, Any] | None
    fit: dict[str, Any] | None
    of: str | None


class _InputAlways(TypedDict):
    id: str
    bytes: int
    created_at: str
    description: dict[str, Any]


class Input(_InputAlways, total=False):
    """An uploaded file: its name `sha256:…`, and what was found in it."""

    options: dict[str, Any]


class ShrinkdError(Exception):
    """What this module raises itself."""


class Problem(ShrinkdError):
    """The service refused a request (RFC 9457).

    `status` is the HTTP status, `code` the stable name (docs/problems.md), `errors` has the place of every fault, `request_id` finds the
    request in the service's log, and `document` is all of it. `tries` says how often the request was sent.
    """

    def __init__(self, document: Mapping[str, Any], tries: int = 1) -> None:
        self.document = dict(document)
        self.status = int(document.get("status", 0))
        self.code = str(document.get("code", ""))
        self.detail = str(document.get("detail", ""))
        self.errors = cast("list[Fault]", list(document.get("errors") or []))
        self.request_id = str(document.get("request_id", ""))
        self.tries = tries
        super().__init__(self.detail)

    def __str__(self) -> str:
        lines = [f"{self.status} {self.code}: {self.detail}"]
        lines += [f"  {fault['pointer'] or '/'}: {fault['detail']}" for fault in self.errors]
        if self.request_id:
            lines.append(f"  (request {self.request_id})")
        return "\n".join(lines)


class JobFailed(ShrinkdError):
    """A job failed. `job` is its record, `problem` says why, `code` is the problem's stable name."""

    def __init__(self, job: Job) -> None:
        self.job = job
        self.problem: Failure = job.get("problem") or {}
        self.code = self.problem.get("code", "")
        super().__init__(job["id"])

    def __str__(self) -> str:
        lines = [f"job {self.job['id']} failed: {self.code}: {self.problem.get('detail', '')}"]
        lines += [f"  {fault['pointer'] or '/'}: {fault['detail']}" for fault in self.problem.get("errors", [])]
        places = self.problem.get("places", [])
        if places:
            lines.append("  at " + ", ".join("(" + ", ".join(f"{x:.4g}" for x in place) + ")" for place in places))
        return "\n".join(lines)


class JobCanceled(ShrinkdError):
    """A job that was waited for has been canceled. `job` is its record."""

    def __init__(self, job: Job) -> None:
        self.job = job
        super().__init__(f"job {job['id']} was canceled")


class CorruptDownload(ShrinkdError):
    """What came is not what the job's record names."""


@dataclasses.dataclass(frozen=True)
class Event:
    """One event of a job. `seq` is the job's own number, from 1. By `kind`, `data` is

    - `snapshot`, `done`: the job's record (`job`);
    - `state`: `state` and `attempt`;
    - `progress`: a `Progress`;
    - `mesh`: the front as it is now, coarse and quantized (`mesh`).
    """

    seq: int
    kind: str
    data: dict[str, Any]

    def job(self) -> Job:
        """The record in a `snapshot` or `done`. Raises `ValueError` for other kinds."""
        if self.kind not in ("snapshot", "done"):
            raise ValueError(f"an event of the kind {self.kind} holds no job")
        return cast(Job, self.data)

    def mesh(self) -> Mesh:
        """The front in a `mesh` event. Raises `ValueError` for other kinds."""
        if self.kind != "mesh":
            raise ValueError(f"an event of the kind {self.kind} holds no mesh")
        return decode_mesh(self.data)


@dataclasses.dataclass(frozen=True)
class Mesh:
    """A triangle mesh: positions in scene units, and triangles of three indices from 0, counter-clockwise seen from outside."""

    positions: list[tuple[float, float, float]]
    triangles: list[tuple[int, int, int]]

    def arrays(self) -> tuple[Any, Any]:
        """The same as numpy arrays: `[vertices, 3]` float64 and `[triangles, 3]` int64. Needs numpy."""
        numpy = importlib.import_module("numpy")
        positions = numpy.array(self.positions, dtype=numpy.float64).reshape(-1, 3)
        return positions, numpy.array(self.triangles, dtype=numpy.int64).reshape(-1, 3)


def decode_mesh(data: Mapping[str, Any]) -> Mesh:
    """The mesh in the body of a `mesh` event: a coordinate is `origin + q * step`, q being 16 bits. Raises `ValueError` when counts and
    bytes disagree, or a triangle names a vertex that is not there."""
    quantized = _integers(data["positions"], 2, 3 * int(data["vertices"]))
    corners = _integers(data["triangles"], int(data["index_bytes"]), 3 * int(data["faces"]))
    if len(corners) and max(corners) >= int(data["vertices"]):
        raise ValueError("a triangle names a vertex that is not there")
    (x0, y0, z0), (dx, dy, dz) = data["origin"], data["step"]
    positions = [
        (x0 + quantized[i] * dx, y0 + quantized[i + 1] * dy, z0 + quantized[i + 2] * dz) for i in range(0, len(quantized), 3)
    ]
    triangles = [(corners[i], corners[i + 1], corners[i + 2]) for i in range(0, len(corners), 3)]
    return Mesh(positions, triangles)


def _integers(text: str, size: int, count: int) -> Sequence[int]:
    """Unsigned little-endian integers of 2 or 4 bytes in base64."""
    letters = {2: "H", 4: "I"}
    if size not in letters:
        raise ValueError(f"integers of {size} bytes are not understood")
    raw = base64.b64decode(text, validate=True)
    numbers = array.array(letters[size])
    if numbers.itemsize != size or len(raw) != size * count:
        raise ValueError(f"expected {size * count} bytes, found {len(raw)}")
    numbers.frombytes(raw)
    if sys.byteorder == "big":
        numbers.byteswap()
    return numbers


def gradient_file(rows: Iterable[Sequence[float]]) -> bytes:
    """A gradient as `Client.sensitivity` sends it: a safetensors file with the tensor `gradient`, `[vertices, 3]` F64. `rows` are
    `vertices` triples: the derivative of a loss by x, y, z of each welded vertex (a numpy array of that shape is fine)."""
    packed = [struct.pack("<3d", *(float(x) for x in row)) for row in rows]
    entry = {"dtype": "F64", "shape": [len(packed), 3], "data_offsets": [0, 24 * len(packed)]}
    header = json.dumps({"gradient": entry}).encode()
    # the data of a safetensors file begin at a multiple of eight
    header += b" " * (-len(header) % 8)
    return struct.pack("<Q", len(header)) + header + b"".join(packed)


class Client:
    """Speaks to one service.

    `url` is where it listens, such as `http://127.0.0.1:8080`; `key` an API key or token, sent as `Authorization: Bearer`; `timeout` the
    seconds to wait for a connection and for an answer to begin. A call that meets a broken connection, or an answer 429 or 503, is
    repeated after the service's `Retry-After` (growing pauses where it says nothing), `tries` times in all. Where the service asks for a
    pause of more than `longest_pause` seconds, its `Problem` is raised at once.

    Every call raises `Problem` when the service refuses, and `requests.RequestException` when it cannot be reached.
    """

    def __init__(
        self,
        url: str,
        key: str | None = None,
        timeout: float = 30.0,
        *,
        tries: int = 6,
        longest_pause: float = 60.0,
    ) -> None:
        self.url = url.rstrip("/")
        self.timeout = timeout
        self.tries = max(1, tries)
        self.longest_pause = longest_pause
        self._session = requests.Session()
        # as an `auth`, because a header would give way to a ~/.netrc
        self._session.auth = _Bearer(key) if key else None

    def __enter__(self) -> Client:  # noqa: PYI034 (Self is of Python 3.11)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: types.TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Closes the connections that are kept."""
        self._session.close()

    def upload(
        self,
        source: bytes | Pathlike,
        *,
        family: str | None = None,
        encoding: Any = None,
        activation: Any = None,
        w0: Any = None,
        skip: Any = None,
    ) -> Input:
        """Uploads a scene, a network, a mesh or a grid, given as its bytes or as a path, and tells what the service found in it. What a
        network's file does not say may be said here (docs/networks.md); the field of a job has to say it again. The same bytes are the
        same input. Raises `Problem` for a file that cannot be read as a field."""
        body = bytes(source) if isinstance(source, (bytes, bytearray)) else pathlib.Path(source).read_bytes()
        said = {"family": family, "encoding": encoding, "activation": activation, "w0": w0, "skip": skip}
        query = {
            name: value if isinstance(value, str) else json.dumps(value) for name, value in said.items() if value is not None
        }
        headers = {"content-type": "application/octet-stream"}
        return cast(Input, self._call("POST", "/v1/inputs", params=query, data=body, headers=headers).json())

    def submit(
        self,
        field: Mapping[str, Any],
        *,
        shrink: Mapping[str, Any] | None = None,
        outputs: Sequence[str] | None = None,
        labels: Mapping[str, str] | None = None,
        weight: Mapping[str, Any] | None = None,
        warm_start: str | None = None,
        latent_motion: bool | None = None,
        budget: Mapping[str, int] | None = None,
        deadline_s: int | None = None,
        webhook: Mapping[str, str] | None = None,
        idempotency_key: str | None = None,
    ) -> Job:
        """Submits a job for a surface; its record, once the job is durable. `field` is `{"scene": …}` or `{"input": "sha256:…", …}`;
        the other members are those of docs/options.md and have defaults. Within 24 hours, requests with the same `idempotency_key` are one
        job; without one, a new one is made, so that repeats within this call are. Raises `Problem` with the place of every fault."""
        members: dict[str, Any] = {
            "field": field,
            "shrink": shrink,
            "outputs": None if outputs is None else list(outputs),
            "labels": labels,
            "weight": weight,
            "warm_start": warm_start,
            "latent_motion": latent_motion,
            "budget": budget,
            "deadline_s": deadline_s,
            "webhook": webhook,
        }
        request = {name: value for name, value in members.items() if value is not None}
        return self.submit_request(request, idempotency_key=idempotency_key)

    def submit_request(self, request: Mapping[str, Any], *, idempotency_key: str | None = None) -> Job:
        """Submits a whole request for a job as it is, such as a fit (docs/fitting.md). Otherwise as `submit`."""
        body = json.dumps(request).encode()
        headers = {"content-type": "application/json", "idempotency-key": idempotency_key or str(uuid.uuid4())}
        return cast(Job, self._call("POST", "/v1/jobs", data=body, headers=headers).json())

    def sensitivity(
        self,
        job_id: str,
        gradient: bytes | Iterable[Sequence[float]],
        *,
        idempotency_key: str | None = None,
    ) -> Job:
        """Asks for the derivatives of a loss by the latent code and the weights of a job's network. `gradient` has the loss's derivatives
        by the vertices of the job's output `surface`: `vertices` triples for the welded vertices, or a safetensors file with the tensor
        `gradient` of `[vertices, 3]` or `[rows, columns, 3]`. The answer is a job; its output `sensitivity` is a safetensors file with
        `latent`, `layers.i.weight` and `layers.i.bias` (docs/fitting.md). Raises `Problem` (`not_differentiable`) when the job made no
        `surface` of a network."""
        body = gradient if isinstance(gradient, bytes) else gradient_file(gradient)
        key = idempotency_key or str(uuid.uuid4())
        headers = {"content-type": "application/octet-stream", "idempotency-key": key}
        return cast(Job, self._call("POST", f"/v1/jobs/{_quoted(job_id)}/sensitivity", data=body, headers=headers).json())

    def get(self, job_id: str) -> Job:
        """A job's record as it is now. A job that failed is no error here."""
        return cast(Job, self._call("GET", f"/v1/jobs/{_quoted(job_id)}").json())

    def list(
        self,
        *,
        state: Sequence[str] | None = None,
        labels: Mapping[str, str] | None = None,
        created_from: str | None = None,
        created_to: str | None = None,
        page: int = 50,
    ) -> Iterator[Job]:
        """Jobs, newest first, of all pages, each asked for when it is reached. `state` are the states wanted, `labels` what they must be
        labelled with; times are RFC 3339, from `created_from` on and before `created_to`. `page` is how many come at once, 1 to 200."""
        query: dict[str, Any] = {"limit": page}
        if state:
            query["state"] = [state] if isinstance(state, str) else [str(one) for one in state]
        if labels:
            query["label"] = [f"{name}:{value}" for name, value in labels.items()]
        for name, time_ in (("created_from", created_from), ("created_to", created_to)):
            if time_ is not None:
                query[name] = time_
        while True:
            found = self._call("GET", "/v1/jobs", params=query).json()
            yield from cast("Iterable[Job]", found["jobs"])
            if not found.get("next_cursor"):
                return
            query["cursor"] = found["next_cursor"]

    def follow(self, job_id: str, after: int | None = None) -> Iterator[Event]:
        """The events of a job as they happen, to its end. Begins with a `snapshot`; with `after`, behind the event of that number (0: from
        the first). Ends behind `done`, or at once where everything was seen before.

        A stream that is cut off is taken up behind the last event, after the pause that the service asked for (`retry:`): nothing is
        missed and nothing told twice. Only when the service no longer has what lies between (it keeps 512 events of a job) does it go on
        with a `snapshot` instead, and the numbers have a gap. Raises when `tries` streams in a row bring nothing."""
        seen, pause, fruitless = after, FIRST_RETRY_S, 0
        while True:
            headers = {"accept": "text/event-stream", "cache-control": "no-cache"}
            if seen is not None:
                headers["last-event-id"] = str(seen)
            answer = self._call(
                "GET",
                f"/v1/jobs/{_quoted(job_id)}/events",
                headers=headers,
                stream=True,
                silence=max(SILENCE_S, self.timeout),
            )
            brought, cut = False, None
            with answer:
                if answer.status_code == 204:
                    return
                try:
                    for frame in _frames(answer.iter_content(chunk_size=None)):
                        # also the heartbeat of a job that waits for its turn is a sign of life
                        brought = True
                        if frame.retry is not None:
                            pause = frame.retry
                        if frame.event is None:
                            continue
                        seen = frame.event.seq
                        yield frame.event
                        if frame.event.kind == "done":
                            return
                except requests.RequestException as error:
                    cut = error
            # cut off in the middle, or ended because the service stops
            fruitless = 0 if brought else fruitless + 1
            if fruitless >= self.tries:
                raise cut or requests.ConnectionError(f"the stream of job {job_id} ends again and again")
            self._rest(pause)

    def wait(self, job_id: str, timeout: float | None = None) -> Job:
        """Waits for a job to succeed; its record. Raises `JobFailed` or `JobCanceled` when it ends otherwise, `TimeoutError` after
        `timeout` seconds (never, when nothing is said)."""
        deadline = None if timeout is None else time.monotonic() + timeout
        while True:
            left = LONGEST_POLL_S if deadline is None else max(0.0, deadline - time.monotonic())
            poll = int(min(LONGEST_POLL_S, left))
            job = cast(
                Job,
                self._call("GET", f"/v1/jobs/{_quoted(job_id)}", params={"wait": poll}, silence=poll + self.timeout).json(),
            )
            if job["state"] == "failed":
                raise JobFailed(job)
            if job["state"] == "canceled":
                raise JobCanceled(job)
            if job["state"] == "succeeded":
                return job
            if deadline is not None and time.monotonic() >= deadline:
                raise TimeoutError(f"job {job_id} is {job['state']} after {timeout:g} s")
            if poll == 0:
                # less than a second is left, and the service counts whole ones
                self._rest(min(left, 0.1))

    def cancel(self, job_id: str) -> Job:
        """Cancels a job; its record. One that runs is told to stop and is `canceling` until it does; one that has ended stays as it is."""
        return cast(Job, self._call("POST", f"/v1/jobs/{_quoted(job_id)}/cancel").json())

    def forget(self, job_id: str) -> None:
        """Forgets a job that has ended, with its outputs. Raises `Problem` (`job_not_ended`) for one that has not."""
        try:
            self._call("DELETE", f"/v1/jobs/{_quoted(job_id)}")
        except Problem as problem:
            # the answer to the first try was lost on the way
            if problem.code != "unknown_job" or problem.tries == 1:
                raise

    @overload
    def download(self, job: str | Job, name: str, path: None = None) -> bytes: ...

    @overload
    def download(self, job: str | Job, name: str, path: Pathlike) -> pathlib.Path: ...

    def download(self, job: str | Job, name: str, path: Pathlike | None = None) -> bytes | pathlib.Path:
        """Downloads an output of a job, given as its id or its record: to `path`, which is returned, or as bytes.

        A file is written beside `path` and renamed when its length and SHA-256 are those of the job's record, so `path` is whole or as it
        was. A download that is cut off goes on where it was (`Range`, `If-Range`), and so does one that an earlier program left unfinished.
        Raises `Problem` (`unknown_output`, `job_not_ended`, `output_expired`), `CorruptDownload`, or what `requests` raises when `tries`
        connections in a row bring nothing."""
        output = self._output(job, name)
        if path is None:
            whole = bytearray()
            self._fetch(output, whole)
            _check(output, len(whole), hashlib.sha256(whole).hexdigest())
            return bytes(whole)
        target = pathlib.Path(path)
        # named by its content, so that a part of something else is never gone on with
        part = target.with_name(f"{target.name}.{output['sha256'][:12]}.part")
        begun = part.stat().st_size if part.exists() else 0
        try:
            self._fetch_file(output, part, begun)
        except CorruptDownload:
            part.unlink()
            if not begun:
                raise
            # what was left there was no good
            self._fetch_file(output, part, 0)
        os.replace(part, target)
        return target

    def _output(self, job: str | Job, name: str) -> Output:
        """What a job's record says of an output; the record is read anew where the one at hand does not list it."""
        if not isinstance(job, str):
            for output in job["outputs"]:
                if output["name"] == name:
                    return output
            job = job["id"]
        for output in self.get(job)["outputs"]:
            if output["name"] == name:
                return output
        # the service says best what is wrong: there is none of the name, or the job has not ended
        self._call("GET", f"/v1/jobs/{_quoted(job)}/outputs/{_quoted(name)}", stream=True).close()
        raise CorruptDownload(f"the record of job {job} does not list its output {name}")

    def _fetch_file(self, output: Output, part: pathlib.Path, begun: int) -> None:
        with open(part, "r+b" if begun else "wb") as file:
            if begun > output["bytes"]:
                raise CorruptDownload(f"{part} is longer than the output")
            file.seek(begun)
            self._fetch(output, file)
            file.flush()
            os.fsync(file.fileno())
        # what lies on the disk is what counts
        with open(part, "rb") as file:
            digest = hashlib.sha256()
            for block in iter(lambda: file.read(BLOCK), b""):
                digest.update(block)
        _check(output, part.stat().st_size, digest.hexdigest())

    def _fetch(self, output: Output, sink: Any) -> None:
        """Fetches what `sink` (a `bytearray`, or a file at its end) lacks of an output."""
        memory = isinstance(sink, bytearray)
        have = len(sink) if memory else sink.tell()
        tag, fruitless = f'"{output["sha256"]}"', 0
        while have < output["bytes"]:
            # offsets are of the bytes themselves, so nothing on the way may compress them
            headers = {"accept-encoding": "identity"}
            if have:
                headers.update({"range": f"bytes={have}-", "if-range": tag})
            before, cut = have, None
            with self._call("GET", output["href"], headers=headers, stream=True) as answer:
                if answer.status_code != 206 or not answer.headers.get("content-range", "").startswith(f"bytes {have}-"):
                    # the whole, because the part was not to be had
                    have = 0
                    if memory:
                        sink.clear()
                    else:
                        sink.seek(0)
                        sink.truncate()
                # where a link leads into a bucket, the bucket has tags of its own
                tag = answer.headers.get("etag", tag)
                try:
                    for block in answer.iter_content(BLOCK):
                        if memory:
                            sink.extend(block)
                        else:
                            sink.write(block)
                        have += len(block)
                except requests.RequestException as error:
                    cut = error
            if have > output["bytes"]:
                raise CorruptDownload(f"output {output['name']}: more than {output['bytes']} bytes came")
            if have < output["bytes"]:
                fruitless = fruitless + 1 if have <= before else 0
                if fruitless >= self.tries:
                    raise cut or requests.ConnectionError(f"output {output['name']} ends early again and again")
                self._rest(self._pause(fruitless))

    def _call(
        self,
        method: str,
        path: str,
        *,
        params: Mapping[str, Any] | None = None,
        data: bytes | None = None,
        headers: Mapping[str, str] | None = None,
        stream: bool = False,
        silence: float | None = None,
    ) -> requests.Response:
        """An answer that is a success. Repeats what may be repeated: every call here does the same when it is made twice, submits
        because of their keys."""
        for tries in range(1, self.tries + 1):
            try:
                answer = self._session.request(
                    method,
                    self.url + path,
                    params=params,
                    data=data,
                    headers=headers,
                    stream=stream,
                    timeout=(self.timeout, silence or self.timeout),
                )
                if not stream:
                    _whole(answer)
            except (requests.ConnectionError, requests.Timeout, requests.exceptions.ChunkedEncodingError):
                if tries == self.tries:
                    raise
                self._rest(self._pause(tries))
                continue
            if answer.status_code < 400:
                return answer
            problem = Problem(_document(answer), tries)
            answer.close()
            again = answer.status_code in TRY_AGAIN or problem.code == "idempotency_key_in_flight"
            pause = _retry_after(answer.headers.get("retry-after"))
            if not again or tries == self.tries or (pause or 0.0) > self.longest_pause:
                raise problem
            self._rest(self._pause(tries) if pause is None else pause)
        raise AssertionError("unreachable")

    def _pause(self, tries: int) -> float:
        """Seconds before the next try where nobody says how many: half a second, and twice as long every time, with some chance in it so
        that many clients do not come back at once."""
        longest = min(self.longest_pause, 0.5 * 2.0 ** min(tries, 16))
        return random.uniform(longest / 2, longest)

    def _rest(self, seconds: float) -> None:
        time.sleep(min(seconds, self.longest_pause))


class _Bearer(AuthBase):
    def __init__(self, key: str) -> None:
        self.key = key

    def __call__(self, request: requests.PreparedRequest) -> requests.PreparedRequest:
        request.headers["authorization"] = f"Bearer {self.key}"
        return request


@dataclasses.dataclass
class _Frame:
    """What a frame of a stream says: an event, how many seconds to wait before coming back, or both."""

    event: Event | None = None
    retry: float | None = None


def _frames(chunks: Iterable[bytes]) -> Iterator[_Frame]:
    """The frames of a stream of server-sent events (WHATWG HTML, section 9.2.6), however its bytes are cut into chunks. A frame that is
    not complete is none."""
    decode = codecs.getincrementaldecoder("utf-8")("replace").decode
    names: dict[str, str] = {}
    for line in _lines(decode(chunk) for chunk in chunks):
        if line:
            name, _, value = line.partition(":")
            value = value.removeprefix(" ")
            # a line that begins with a colon is a comment, such as the heartbeat
            if name == "data" and name in names:
                names[name] += "\n" + value
            elif name:
                names[name] = value
            continue
        frame = _Frame()
        if names.get("retry", "").isdecimal():
            frame.retry = int(names["retry"]) / 1000.0
        if "data" in names and names.get("id", "").isdecimal():
            frame.event = Event(int(names["id"]), names.get("event", "message"), json.loads(names["data"]))
        names = {}
        yield frame


def _lines(texts: Iterable[str]) -> Iterator[str]:
    """Complete lines, ended by CR, LF or both."""
    pieces: list[str] = []
    carriage = False
    for text in texts:
        if carriage and text:
            # the second half of a CR and LF
            text, carriage = text.removeprefix("\n"), False
        if text:
            carriage = text.endswith("\r")
        *ended, rest = re.split("\r\n|\r|\n", text)
        for line in ended:
            yield "".join(pieces) + line
            pieces.clear()
        pieces.append(rest)


def _whole(answer: requests.Response) -> None:
    """Raises when the JSON of a success is cut off: `requests` lets a body pass whose head broke off before its length."""
    if answer.ok and answer.status_code != 204:
        try:
            answer.json()
        except ValueError as error:
            raise requests.exceptions.ChunkedEncodingError(f"{answer.url}: no JSON, or not all of it came") from error


def _quoted(name: str) -> str:
    return urllib.parse.quote(name, safe="")


def _document(answer: requests.Response) -> dict[str, Any]:
    """The problem document of an answer, or one made up for an answer without, such as a proxy's."""
    try:
        document = answer.json()
    except (ValueError, requests.RequestException):
        document = None
    if isinstance(document, dict) and "code" in document:
        return document
    reason = answer.reason or "no reason given"
    return {"status": answer.status_code, "code": "no_problem_document", "detail": f"{answer.url}: {reason}"}


def _retry_after(value: str | None) -> float | None:
    """Seconds in a field `Retry-After`: a number, or a date."""
    if value is None:
        return None
    if value.strip().isdecimal():
        return float(value)
    try:
        return max(0.0, email.utils.parsedate_to_datetime(value).timestamp() - time.time())
    except (TypeError, ValueError):
        return None


def _check(output: Output, length: int, digest: str) -> None:
    if length != output["bytes"]:
        raise CorruptDownload(f"output {output['name']}: expected {output['bytes']} bytes, found {length}")
    if digest != output["sha256"]:
        raise CorruptDownload(f"output {output['name']}: expected SHA-256 {output['sha256']}, found {digest}")
