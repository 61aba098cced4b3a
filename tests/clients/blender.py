"""examples/blender_import.py in Blender itself: python blender.py PROGRAM

Needs the package bpy, which is Blender as a module. Imports surfaces of the service on both lattices, saves them, opens what was saved,
and looks at shape, UVs, shading and camera. Exits 0 when all of it is right and what cannot be imported is refused.
"""

import json
import os
import pathlib
import subprocess
import sys
import tempfile
import urllib.request

import bpy
import numpy
from bpy_extras.object_utils import world_to_camera_view
from mathutils import Vector
from support import PATIENCE_S, ROOT, Fault, Proxy, Service

RADII = (0.8, 0.5, 0.3)
SIDES = {"latlong": {"latlong": {"n_theta": 48, "n_phi": 24}}, "octahedral": {"octahedral": {"n": 12}}}


def post(service, request):
    """Submits a job and waits for its end."""
    headers = {"content-type": "application/json", "prefer": "wait=60"}
    sent = urllib.request.Request(service.url + "/v1/jobs", json.dumps(request).encode(), headers)
    with urllib.request.urlopen(sent, timeout=PATIENCE_S) as answer:
        job = json.load(answer)
    while job["state"] not in ("succeeded", "failed", "canceled"):
        job = json.loads(service.get(f"/v1/jobs/{job['id']}?wait=30"))
    return job


def run(*arguments, **variables):
    """The script in a process of its own, as Blender would start it."""
    command = [sys.executable, str(ROOT / "examples" / "blender_import.py"), "--", *arguments]
    environment = {name: value for name, value in os.environ.items() if name != "SHRINKD_KEY"}
    ended = subprocess.run(
        command, env={**environment, **variables}, capture_output=True, text=True, timeout=PATIENCE_S, check=False
    )
    return ended.returncode, ended.stdout, ended.stderr


def refused(text, *arguments):
    code, _, told = run(*arguments)
    assert code != 0 and "ImportFailed" in told and text in told, (text, told)


def array(collection, member, width):
    found = numpy.empty(width * len(collection), dtype=numpy.float32)
    collection.foreach_get(member, found)
    return found.reshape(-1, width)


def check_file(path, job, vertices):
    """What was saved is the surface, unwrapped, smooth, and in the picture."""
    bpy.ops.wm.open_mainfile(filepath=str(path))
    (one,) = [found for found in bpy.data.objects if "shrinkd_job" in found]
    (output,) = [output for output in job["outputs"] if output["name"] == "glb"]
    assert one["shrinkd_job"] == job["id"] and one["shrinkd_sha256"] == output["sha256"]
    mesh = one.data
    # the vertices of the chart: the seam is there twice
    assert len(mesh.vertices) == vertices and len(mesh.polygons) == job["metrics"]["triangles"], (len(mesh.vertices), vertices)

    # the ellipsoid, +y up turned to +z up
    points = array(mesh.vertices, "co", 3) @ numpy.array(one.matrix_world)[:3, :3].T
    x, y, z = points.T
    level = (x / RADII[0]) ** 2 + (y / RADII[2]) ** 2 + (z / RADII[1]) ** 2
    assert abs(level - 1).max() < 1e-3, abs(level - 1).max()

    (layer,) = mesh.uv_layers
    uv = array(layer.data, "uv", 2)
    assert uv.min() >= -1e-6 and uv.max() <= 1 + 1e-6 and numpy.ptp(uv, axis=0).min() > 0.999
    # one sheet without a fold: all triangles turn one way, and together they are the square
    corners = uv.reshape(-1, 3, 2).astype(numpy.float64)
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / 2
    assert (abs(area) > 0).all() and len(set(numpy.sign(area))) == 1, "the chart folds over"

    assert all(polygon.use_smooth for polygon in mesh.polygons)
    # the field's normals came along: those of the ellipsoid at the corners
    normals = array(mesh.corner_normals, "vector", 3)
    at = points[[loop.vertex_index for loop in mesh.loops]]
    true = at / numpy.array((RADII[0], RADII[2], RADII[1])) ** 2
    true /= numpy.linalg.norm(true, axis=1, keepdims=True)
    assert ((normals * true).sum(axis=1)).min() > 0.999, "the normals are not the field's"

    (material,) = mesh.materials
    (node,) = [node for node in material.node_tree.nodes if node.type == "TEX_IMAGE"]
    assert node.interpolation == "Closest" and node.image.packed_file and node.image.size[0] > 0
    scene = bpy.context.scene
    seen = [world_to_camera_view(scene, scene.camera, one.matrix_world @ Vector(point)) for point in one.bound_box]
    assert all(0 <= place.x <= 1 and 0 <= place.y <= 1 and place.z > 0 for place in seen), seen
    assert max(place.y for place in seen) - min(place.y for place in seen) > 0.3, "the picture is mostly empty"
    return abs(area).sum()


def main():
    with tempfile.TemporaryDirectory() as made, tempfile.TemporaryDirectory() as data:
        folder = pathlib.Path(made)
        with Service(sys.argv[1], data) as service:
            areas = {}
            for name, lattice in SIDES.items():
                request = {
                    "field": {"scene": {"ellipsoid": {"radii": list(RADII)}}},
                    "shrink": {"lattice": lattice},
                    "outputs": ["glb"],
                }
                job = post(service, request)
                assert job["state"] == "succeeded", job
                code, told, wrong = run(service.url + "/", job["id"], "--save", str(folder / f"{name}.blend"))
                assert code == 0, (told, wrong)
                document = gltf(service.get(f"/v1/jobs/{job['id']}/outputs/glb"))
                accessor = document["meshes"][0]["primitives"][0]["attributes"]["TEXCOORD_0"]
                areas[name] = check_file(folder / f"{name}.blend", job, document["accessors"][accessor]["count"])
            # at each pole of the lat-long chart a triangle of every sector is missing: half of the first and last row
            assert abs(areas["octahedral"] - 1) < 1e-3 and abs(areas["latlong"] - (1 - 1 / 24)) < 1e-3, areas

            proxy = Proxy(service.address)
            size = next(output["bytes"] for output in job["outputs"])
            head = b"HTTP/1.1 200 OK\r\nconnection: close\r\ncontent-length: %d\r\n\r\n" % size
            proxy.faults = [Fault(f"GET /v1/jobs/{job['id']}/outputs", answer=head + bytes(size))]
            refused("not those of the job's record", proxy.url, job["id"])
            assert not proxy.faults
            refused("404 unknown_job", service.url, "00000000-0000-7000-8000-000000000000")
            ring = post(service, {**request, "field": {"scene": {"torus": {"major": 0.5, "minor": 0.2}}}})
            assert ring["state"] == "failed" and ring["problem"]["code"] == "genus", ring
            assert not ring["outputs"], ring["outputs"]
            refused(f"job {ring['id']} (failed) has no glb: {ring['problem']['detail']}", service.url, ring["id"])
            line = post(service, {"field": {"scene": {"circle": {"radius": 0.5}}}, "outputs": ["glb"]})
            code, told, wrong = run(service.url, line["id"])
            assert code == 0 and "imported" in told, (told, wrong)
        refused("fill in JOB", service.url)
        refused(service.url, service.url, job["id"])
        with Service(sys.argv[1], folder / "keys", {"SHRINKD_AUTH__MODE": "required"}) as service:
            key = service.key("--tenant", "a", "--scope", "read")
            assert "401 unauthenticated" in run(service.url, job["id"])[2]
            assert "404 unknown_job" in run(service.url, job["id"], SHRINKD_KEY=key)[2]
    print(f"Blender {bpy.app.version_string}: charts of both lattices, {areas}; a curve; what is no surface is refused")


def gltf(data):
    """The JSON of a GLB."""
    length = int.from_bytes(data[12:16], "little")
    return json.loads(data[20 : 20 + length])


if __name__ == "__main__":
    main()
