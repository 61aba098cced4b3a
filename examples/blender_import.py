"""Brings a job's surface into Blender, with its UVs and its checkerboard.

In Blender's text editor: fill in ADDRESS and JOB below and run it. Or from a shell:

    blender --background --python-exit-code 1 --python examples/blender_import.py -- http://127.0.0.1:8080 JOB [--save OUT.blend]

Needs Blender 4.2 or newer (also as the module `bpy`) and nothing else. A service that asks who its callers are gets the key in the variable
SHRINKD_KEY. Raises `ImportFailed` when the job has no surface, when the bytes are not those of the job's record, or when a mesh came in
without UVs. glTF's +y is up; Blender's importer turns that to +z, and turns v so that it runs upwards.
"""

import argparse
import hashlib
import json
import math
import os
import sys
import tempfile
import urllib.error
import urllib.parse
import urllib.request

import bpy
import mathutils

ADDRESS = "http://127.0.0.1:8080"
JOB = ""
OUTPUT = "glb"
TIMEOUT_S = 60


class ImportFailed(Exception):
    """The surface could not be brought in."""


def get(address):
    """The bytes of an answer."""
    key = os.environ.get("SHRINKD_KEY")
    request = urllib.request.Request(address, headers={"Authorization": f"Bearer {key}"} if key else {})
    try:
        with urllib.request.urlopen(request, timeout=TIMEOUT_S) as answer:
            return answer.read()
    except urllib.error.HTTPError as error:
        try:
            problem = json.load(error)
            text = f"{problem['code']}: {problem['detail']}"
        except (ValueError, KeyError, TypeError):
            text = error.reason
        raise ImportFailed(f"{address}: {error.code} {text}") from error
    except OSError as error:
        raise ImportFailed(f"{address}: {error}") from error


def surface(address, job):
    """The GLB of a job, checked against its record."""
    record = json.loads(get(f"{address}/v1/jobs/{urllib.parse.quote(job, safe='')}"))
    output = next((one for one in record["outputs"] if one["name"] == OUTPUT), None)
    if output is None:
        why = (record.get("problem") or {}).get("detail") or f"its outputs are {[one['name'] for one in record['outputs']]}"
        raise ImportFailed(f"job {job} ({record['state']}) has no {OUTPUT}: {why}")
    if not output.get("certified", True):
        print("the surface did not pass its checks: it is for looking at what went wrong")
    data = get(address + output["href"])
    if len(data) != output["bytes"]:
        raise ImportFailed(f"expected {output['bytes']} bytes, found {len(data)}")
    if hashlib.sha256(data).hexdigest() != output["sha256"]:
        raise ImportFailed("the bytes are not those of the job's record")
    return data


def imported(data, name):
    """The mesh objects that Blender makes of a GLB."""
    before = set(bpy.data.objects)
    with tempfile.TemporaryDirectory() as folder:
        path = os.path.join(folder, f"{name}.glb")
        with open(path, "wb") as file:
            file.write(data)
        bpy.ops.import_scene.gltf(filepath=path)
    # a 2-D field gives a line: edges, and no faces to unwrap
    made = [one for one in bpy.data.objects if one not in before and one.type == "MESH"]
    if not made:
        raise ImportFailed("there is no mesh in the file")
    return made


def check_uvs(mesh):
    """Raises unless every corner of the mesh has its place in the UV square."""
    if not mesh.polygons:
        return
    if not mesh.uv_layers:
        raise ImportFailed(f"{mesh.name} has no UV layer")
    uvs = [0.0] * (2 * len(mesh.loops))
    mesh.uv_layers[0].data.foreach_get("uv", uvs)
    # the importer's v is 1 - v in single precision
    if not all(-1e-6 <= place <= 1 + 1e-6 for place in uvs):
        raise ImportFailed(f"{mesh.name} has UVs outside of the unit square")


def shade(mesh):
    """Smooth, with the normals of the field that came along, and the checkerboard with sharp tiles."""
    mesh.polygons.foreach_set("use_smooth", [True] * len(mesh.polygons))
    for material in mesh.materials:
        for node in material.node_tree.nodes if material and material.use_nodes else []:
            if node.type == "TEX_IMAGE":
                node.interpolation = "Closest"
    mesh.update()


def frame(objects):
    """Points a camera at the objects, and every 3-D view where there are any."""
    corners = [one.matrix_world @ mathutils.Vector(corner) for one in objects for corner in one.bound_box]
    low, high = (mathutils.Vector(map(pick, zip(*corners))) for pick in (min, max))
    center, radius = (low + high) / 2, max((high - low).length / 2, 1e-6)
    scene = bpy.context.scene
    camera = bpy.data.objects.new("shrinkd camera", bpy.data.cameras.new("shrinkd camera"))
    scene.collection.objects.link(camera)
    # the ball about the objects touches the nearer edges of the picture; a twentieth is left free
    width, height = scene.render.resolution_x, scene.render.resolution_y
    half_angle = math.atan(math.tan(camera.data.angle / 2) * min(width, height) / max(width, height))
    distance = 1.05 * radius / math.sin(half_angle)
    direction = mathutils.Vector((0.6, -1.0, 0.5)).normalized()
    camera.location = center + distance * direction
    camera.rotation_euler = direction.to_track_quat("Z", "Y").to_euler()
    camera.data.clip_start, camera.data.clip_end = distance / 100, distance + 2 * radius
    scene.camera = camera
    if bpy.app.background:
        return
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                area.spaces.active.shading.type = "MATERIAL"
                region = next(region for region in area.regions if region.type == "WINDOW")
                with bpy.context.temp_override(window=window, area=area, region=region):
                    bpy.ops.view3d.view_selected()


def main():
    parser = argparse.ArgumentParser(prog="blender_import.py")
    parser.add_argument("address", nargs="?", default=ADDRESS, help="where the service is")
    parser.add_argument("job", nargs="?", default=JOB, help="the job whose surface is wanted")
    parser.add_argument("--save", metavar="FILE", help="a .blend file to write")
    # what stands before is Blender's own
    given = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else []
    arguments = parser.parse_args(given)
    if not arguments.job:
        raise ImportFailed("fill in JOB")
    data = surface(arguments.address.rstrip("/"), arguments.job)
    objects = imported(data, f"shrinkd {arguments.job}")
    for one in objects:
        check_uvs(one.data)
        shade(one.data)
        one["shrinkd_job"] = arguments.job
        one["shrinkd_sha256"] = hashlib.sha256(data).hexdigest()
    frame(objects)
    if arguments.save:
        # the checkerboard goes with it
        bpy.ops.file.pack_all()
        bpy.ops.wm.save_as_mainfile(filepath=os.path.abspath(arguments.save))
    told = ", ".join(f"{one.name} with {len(one.data.vertices)} vertices" for one in objects)
    print(f"imported {told}")


if __name__ == "__main__":
    main()
