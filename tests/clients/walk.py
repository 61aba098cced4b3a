"""examples/walk.sh against the real program: python walk.py PROGRAM

Needs curl. Walks through a service that wants a key, with a stream that breaks in the middle, and then into every refusal that the script
has to report. Exits 0 when the files are those of the job, and what went wrong was said.
"""

import os
import pathlib
import re
import shutil
import subprocess
import sys
import tempfile

from support import PATIENCE_S, ROOT, Fault, Proxy, Service

# the strictest shell there is
SHELL = shutil.which("dash") or "sh"


def walk(address, folder, key=None):
    environment = {name: value for name, value in os.environ.items() if name != "SHRINKD_KEY"}
    if key:
        environment["SHRINKD_KEY"] = key
    command = [SHELL, str(ROOT / "examples" / "walk.sh"), address, str(folder)]
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=PATIENCE_S, check=False)


def refused(ended, *texts):
    """The walk ended as it must where something fails."""
    assert ended.returncode == 1, (ended.returncode, ended.stdout, ended.stderr)
    for text in texts:
        assert text in ended.stderr, (text, ended.stderr)


def main():
    program = sys.argv[1]
    with tempfile.TemporaryDirectory() as made, tempfile.TemporaryDirectory() as data:
        folder = pathlib.Path(made) / "a folder"
        with Service(program, data, {"SHRINKD_AUTH__MODE": "required"}) as service:
            key = service.key("--tenant", "walker")
            proxy = Proxy(service.address)

            refused(walk(proxy.url, folder), "401 unauthenticated: ")

            # the first answers to a GET are those of the stream: cut in its second frame, then before its head
            proxy.faults = [Fault("GET /v1/jobs/", frames=1), Fault("GET /v1/jobs/", bytes=0)]
            ended = walk(proxy.url + "/", folder, key)
            assert ended.returncode == 0 and not proxy.faults, (ended.returncode, ended.stdout, ended.stderr)
            streams = [head for head in proxy.heads("get /v1/jobs/") if "/events" in head.split("\r\n")[0]]
            assert [after(head) for head in streams[:3]] == [0, 1, 1], streams[:3]
            told = ended.stdout.splitlines()
            numbers = [int(line[4:]) for line in told if re.fullmatch(r"id: \d+", line)]
            assert told.count("-- cut off: on behind event 1") == 2, told
            assert numbers == list(range(1, len(numbers) + 1)) and "event: done" in told, told
            assert f"{len(numbers)} events; whoever has seen them is answered 204 and need not come back" in told, told
            assert '  /field/scene/sphere/radios: sphere has no member "radios"; its members are radius' in told, told
            assert key not in ended.stdout + ended.stderr

            job = next(line.split()[2] for line in told if line.startswith("202, job "))
            for name, file, magic in (("glb", "shape.glb", b"glTF"), ("preview", "shape.png", b"\x89PNG")):
                found = (folder / file).read_bytes()
                assert found.startswith(magic), file
                assert found == service.get(f"/v1/jobs/{job}/outputs/{name}", key=key), f"{file} is not what the service has"
            assert sorted(path.name for path in folder.iterdir()) == ["shape.glb", "shape.png"], "something was left behind"

            full = b'{"title":"full","status":503,"code":"queue_full","detail":"as \\"many\\" as may"}'
            head = b"HTTP/1.1 503 Service Unavailable\r\nconnection: close\r\ncontent-length: %d\r\n\r\n" % len(full)
            proxy.faults = [Fault("POST /v1/jobs", answer=head + full)]
            refused(walk(proxy.url, folder, key), '503 queue_full: as "many" as may')
        refused(walk(proxy.url, folder, key), "no answer from " + proxy.url)
    print(f"{len(numbers)} events and two files; refusals are told")


def after(head):
    """The number that a reader of a stream comes back with."""
    return next(int(line.split(": ")[1]) for line in head.split("\r\n") if line.startswith("last-event-id: "))


if __name__ == "__main__":
    main()
