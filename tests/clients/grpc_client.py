"""An independent gRPC client (Python's grpcio) against the real program: python grpc_client.py PROGRAM

Needs grpcio-tools, grpcio-reflection, grpcio-status and grpcio-health-checking. Makes its stubs from the contract, submits, watches,
downloads and compares with HTTP's bytes, asks for refusals, and reads the contract by reflection. Exits 0 when all of it is right.
"""

import json
import pathlib
import subprocess
import sys
import tempfile
import threading
import urllib.request

import grpc
from google.protobuf import json_format
from google.protobuf.descriptor_pool import DescriptorPool
from google.rpc import error_details_pb2
from grpc_health.v1 import health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha.proto_reflection_descriptor_database import ProtoReflectionDescriptorDatabase
from grpc_status import rpc_status
from grpc_tools import protoc

ROOT = pathlib.Path(__file__).resolve().parents[2]
PATIENCE_S = 120


def stubs(folder):
    """The modules of messages and of calls, made from the contract."""
    well_known = pathlib.Path(protoc.__file__).parent / "_proto"
    arguments = ["protoc", f"-I{ROOT}/proto", f"-I{well_known}", f"--python_out={folder}", f"--grpc_python_out={folder}"]
    assert protoc.main([*arguments, f"{ROOT}/proto/shrinkd/v1/shrinkd.proto"]) == 0
    sys.path.insert(0, str(folder))
    from shrinkd.v1 import shrinkd_pb2, shrinkd_pb2_grpc

    return shrinkd_pb2, shrinkd_pb2_grpc


def serve(program, folder):
    """Starts the service; the process and its address."""
    command = [program, "serve", "--listen", "127.0.0.1:0", "--data", str(folder)]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env={"SHRINKD_LOG__FORMAT": "json"})
    for line in process.stderr:
        entry = json.loads(line)
        if entry.get("message") == "listening":
            # nobody reads on, and a full pipe must not stop the service
            threading.Thread(target=process.stderr.read, daemon=True).start()
            return process, entry["http.address"]
    raise SystemExit("the service did not start")


def refused(call, code, reason):
    """Makes a call that must be refused, and reads its answers; the details by type."""
    try:
        list(call())
    except grpc.RpcError as error:
        assert error.code() == code, error
        details = {}
        for packed in rpc_status.from_call(error).details:
            for kind in (error_details_pb2.ErrorInfo, error_details_pb2.BadRequest, error_details_pb2.RequestInfo):
                if packed.Is(kind.DESCRIPTOR):
                    details[kind.__name__] = kind()
                    packed.Unpack(details[kind.__name__])
        assert details["ErrorInfo"].reason == reason, details
        assert details["RequestInfo"].request_id, details
        return details
    raise AssertionError(f"{reason}: was not refused")


def check(address, pb, rpc):
    channel = grpc.insecure_channel(address)
    service = rpc.ShrinkdStub(channel)

    request = pb.SubmitRequest(idempotency_key="python")
    request.spec.update({
        "field": {"scene": {"sphere": {"radius": 0.6}}},
        "shrink": {"method": "paper", "lattice": {"latlong": {"n_theta": 32, "n_phi": 16}}},
        "labels": {"client": "python"},
    })
    submitted = service.Submit(request, timeout=PATIENCE_S)
    job = submitted.job.id
    assert not submitted.replayed and service.Submit(request).replayed

    events = list(service.Watch(pb.WatchRequest(id=job, after=0), timeout=PATIENCE_S))
    assert [event.id for event in events] == list(range(1, len(events) + 1)), events
    assert events[-1].kind == "done" and events[-1].data["state"] == "succeeded", events[-1]
    resumed = list(service.Watch(pb.WatchRequest(id=job, after=2), timeout=PATIENCE_S))
    assert resumed == events[2:]

    record = service.Get(pb.GetRequest(id=job))
    assert record.state == pb.STATE_SUCCEEDED and record.labels["client"] == "python"
    over_http = json.load(urllib.request.urlopen(f"http://{address}/v1/jobs/{job}"))
    assert over_http["id"] == record.id and over_http["revision"] == record.revision
    assert json_format.MessageToDict(record.metrics).keys() == over_http["metrics"].keys()
    for output in record.outputs:
        chunks = service.Download(pb.DownloadRequest(id=job, name=output.name), timeout=PATIENCE_S)
        data = b"".join(chunk.data for chunk in chunks)
        assert data == urllib.request.urlopen(f"http://{address}{output.href}").read(), output.name
        assert len(data) == output.bytes

    page = service.List(pb.ListRequest(labels={"client": "python"}, limit=1))
    assert [found.id for found in page.jobs] == [job] and not page.next_cursor

    mesh = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"
    uploaded = service.Upload(iter([pb.Chunk(data=mesh[:20]), pb.Chunk(data=mesh[20:])]))
    assert uploaded.id.startswith("sha256:") and uploaded.bytes == len(mesh), uploaded

    wrong = pb.SubmitRequest(json='{"field": {"scene": {"sphere": {"radius": -1}}}}')
    details = refused(lambda: [service.Submit(wrong)], grpc.StatusCode.INVALID_ARGUMENT, "invalid_request")
    assert details["BadRequest"].field_violations[0].field == "/field/scene/sphere/radius", details
    unknown = pb.GetRequest(id="018f0000-0000-7000-8000-000000000000")
    refused(lambda: [service.Get(unknown)], grpc.StatusCode.NOT_FOUND, "unknown_job")
    missing = pb.DownloadRequest(id=job, name="film")
    refused(lambda: service.Download(missing), grpc.StatusCode.NOT_FOUND, "unknown_output")

    health = health_pb2_grpc.HealthStub(channel).Check(health_pb2.HealthCheckRequest(service="shrinkd.v1.Shrinkd"))
    assert health.status == health_pb2.HealthCheckResponse.SERVING

    reflected = ProtoReflectionDescriptorDatabase(channel)
    assert "shrinkd.v1.Shrinkd" in reflected.get_services()
    methods = DescriptorPool(reflected).FindServiceByName("shrinkd.v1.Shrinkd").methods
    expected = pb.DESCRIPTOR.services_by_name["Shrinkd"].methods
    assert [method.name for method in methods] == [method.name for method in expected]
    print(f"{len(events)} events, {len(record.outputs)} outputs, {len(methods)} methods: as they should be")


def main():
    with tempfile.TemporaryDirectory() as made, tempfile.TemporaryDirectory() as data:
        pb, rpc = stubs(pathlib.Path(made))
        process, address = serve(sys.argv[1], data)
        try:
            check(address, pb, rpc)
        finally:
            process.terminate()
            process.wait(timeout=PATIENCE_S)


if __name__ == "__main__":
    main()
