"""Writes the seeds of the targets whose files are short enough to be written here: `python3 fuzz/seeds.py`, from the root
of the repository, with nothing but Python. The same seeds every time.

Seeds of archives are lists of their entries, which the targets make an archive of, so that checksums are no obstacle."""

import json
import struct
import zipfile
import zlib
from io import BytesIO
from pathlib import Path

ROOT = Path(__file__).resolve().parent
FIXTURES = ROOT.parent / "tests" / "fixtures" / "networks"
BETWEEN = b"\n----\n"


def put(target, name, data):
    folder = ROOT / "seeds" / target
    folder.mkdir(parents=True, exist_ok=True)
    (folder / name).write_bytes(data if isinstance(data, bytes) else data.encode())


def listed(entries):
    return BETWEEN.join(name.encode() + b"\n" + data for name, data in entries)


def floats(numbers, form="<f"):
    return b"".join(struct.pack(form, n) for n in numbers)


def npy(shape, numbers, descr="<f4", fortran=False, version=1):
    header = f"{{'descr': '{descr}', 'fortran_order': {fortran}, 'shape': ({', '.join(map(str, shape))},), }}".encode()
    length = struct.pack("<H" if version == 1 else "<I", len(header) + 1)
    form = descr[0] + {"f4": "f", "f8": "d"}.get(descr[1:], "f")
    return b"\x93NUMPY" + bytes([version, 0]) + length + header + b"\n" + floats(numbers, form)


def tensors(metadata, parts):
    header, data = ({"__metadata__": metadata} if metadata else {}), b""
    sizes = {"F32": "<f", "F64": "<d", "F16": "<e"}
    for name, shape, kind, numbers in parts:
        body = floats(numbers, sizes[kind]) if kind in sizes else bytes(numbers)
        header[name] = {"dtype": kind, "shape": shape, "data_offsets": [len(data), len(data) + len(body)]}
        data += body
    text = json.dumps(header).encode()
    return struct.pack("<Q", len(text)) + text + data


def wave(n):
    """Numbers that are neither round nor all alike."""
    return [((7 * i + 3) % 17 - 8) / 11 for i in range(n)]


def safetensors():
    def own(layers, parts, **more):
        return tensors({"architecture": json.dumps({"version": 1, "layers": layers, **more})}, parts)

    def dense(i, outputs, inputs, kind="F32"):
        return [(f"layers.{i}.weight", [outputs, inputs], kind, wave(outputs * inputs)),
                (f"layers.{i}.bias", [outputs], kind, wave(outputs))]

    put("safetensors", "own_plane", own([{"outputs": 1}], dense(0, 1, 3, "F64"), metric="sign", lipschitz=2.0))
    put("safetensors", "own_sine", own([{"outputs": 4, "activation": {"sine": {"w0": 30}}}, {"outputs": 1}],
                                       dense(0, 4, 3) + dense(1, 1, 4)))
    skipped = [{"outputs": 4, "activation": {"softplus": {"beta": 100}}},
               {"outputs": 4, "activation": "elu", "skip": {"scale": 0.5}}, {"outputs": 1, "activation": "tanh"}]
    put("safetensors", "own_skip_latent", own(
        skipped, dense(0, 4, 11) + dense(1, 4, 15) + dense(2, 1, 4) + [("latent_codes", [2, 2], "F32", wave(4))],
        latent_size=2, encoding={"positional": {"frequencies": 1, "base": 3.14}},
        domain={"min": [-1, -1, -1], "max": [1, 1, 2]}))
    norm = [("layers.0.norm.scale", [4], "F32", wave(4)), ("layers.0.norm.shift", [4], "F64", wave(4))]
    put("safetensors", "own_layer_norm", own([{"outputs": 4, "layer_norm": {"epsilon": 1e-5}, "activation": "relu"}, {"outputs": 1}],
                                             dense(0, 4, 3) + norm + dense(1, 1, 4)))
    put("safetensors", "own_wrong_width", own([{"outputs": 4}, {"outputs": 1}], dense(0, 4, 3) + dense(1, 1, 5)))
    put("safetensors", "own_not_finite", own([{"outputs": 1}], [("layers.0.weight", [1, 3], "F32", [1, float("nan"), 0]),
                                                               ("layers.0.bias", [1], "F32", [0])]))

    def lin(prefix, widths, normed=None, skip=None):
        parts = []
        for i, (inputs, outputs) in enumerate(zip(widths, widths[1:])):
            inputs += widths[0] if i == skip else 0
            name = f"{prefix}lin{i}"
            if normed is None:
                parts.append((f"{name}.weight", [outputs, inputs], "F32", wave(outputs * inputs)))
            else:
                parts.append((name + normed[0], [outputs, 1], "F32", wave(outputs)))
                parts.append((name + normed[1], [outputs, inputs], "F32", wave(outputs * inputs)))
            parts.append((f"{name}.bias", [outputs], "F32", wave(outputs)))
        return parts

    old, new = (".weight_g", ".weight_v"), (".parametrizations.weight.original0", ".parametrizations.weight.original1")
    put("safetensors", "igr", tensors({}, lin("", [5, 4, 4, 1], skip=1)))
    put("safetensors", "deep_sdf", tensors({}, lin("decoder.", [5, 4, 4, 1], old, 1) + [("lat_vecs.weight", [2, 2], "F16", wave(4))]))
    put("safetensors", "deep_sdf_struct", tensors({}, lin("", [5, 4, 1], new)))
    norm = [("bn0.weight", [4], "F32", wave(4)), ("bn0.bias", [4], "F32", wave(4))]
    put("safetensors", "deep_sdf_layer_norm", tensors({}, lin("", [5, 4, 4, 1], skip=1) + norm))
    put("safetensors", "deep_sdf_half_a_norm", tensors({}, lin("", [3, 4, 1]) + norm[:1]))
    put("safetensors", "idr", tensors({}, lin("implicit_network.", [9, 4, 3], old)))
    put("safetensors", "vol_sdf", tensors({}, lin("implicit_network.", [9, 4, 3], new) + [("density.beta", [1], "F32", [0.1])]))
    put("safetensors", "neus", tensors({}, lin("sdf_network_fine.", [9, 4, 3], old)))
    put("safetensors", "siren", tensors({}, [("net.net.0.0.weight", [4, 3], "F32", wave(12)), ("net.net.0.0.bias", [4], "F32", wave(4)),
                                             ("net.net.1.0.weight", [1, 4], "F32", wave(4)), ("net.net.1.0.bias", [1], "F32", [0])]))
    put("safetensors", "siren_lucidrains", tensors({}, [
        ("layers.0.weight", [4, 3], "F32", wave(12)), ("layers.0.bias", [4], "F32", wave(4)),
        ("last_layer.weight", [1, 4], "F32", wave(4)), ("last_layer.bias", [1], "F32", [0])]))
    put("safetensors", "long_header", struct.pack("<Q", 1 << 60) + b"{}")
    put("safetensors", "overflowing_shape", struct.pack("<Q", 84) + json.dumps(
        {"a": {"dtype": "F32", "shape": [1 << 33, 1 << 33], "data_offsets": [0, 0]}}).encode().ljust(84))


def npz():
    def operations(*list_of):
        return [(f"{i:04}.{name}.npy", data) for i, entries in enumerate(list_of) for name, data in entries]

    def dense(inputs, outputs, fortran=False, descr="<f4"):
        return [("dense.A", npy([inputs, outputs], wave(inputs * outputs), descr, fortran)), ("dense.b", npy([outputs], wave(outputs)))]

    def apply(name):
        return [(f"{name}._", npy([1], [0]))]

    whole = operations(dense(3, 4), apply("elu"), dense(4, 4, True, ">f8"), apply("relu"), dense(4, 1), apply("squeeze_last"))
    put("npz", "elu_relu", listed(whole))
    put("npz", "sin_tanh", listed(operations(dense(3, 2), apply("sin"), dense(2, 2), apply("tanh"), dense(2, 1), apply("sigmoid"))))
    put("npz", "unknown_operation", listed(operations(dense(3, 2), apply("gelu"), dense(2, 1))))
    put("npz", "twice", listed(whole + whole[:1]))
    put("npz", "wrong_width", listed(operations(dense(3, 4), dense(5, 1))))
    for name, method in [("stored.zip", zipfile.ZIP_STORED), ("deflated.zip", zipfile.ZIP_DEFLATED)]:
        out = BytesIO()
        with zipfile.ZipFile(out, "w", method) as archive:
            for entry, data in whole:
                archive.writestr(zipfile.ZipInfo(entry), data, method)
        put("npz", name, out.getvalue())
    # a megabyte of zeros in a kilobyte
    packed = zlib.compressobj(9, zlib.DEFLATED, -15)
    body = packed.compress(bytes(1 << 20)) + packed.flush()
    name = b"0000.dense.A.npy"
    common = struct.pack("<5H3I2H", 20, 0, 8, 0, 33, zlib.crc32(bytes(1 << 20)), len(body), 1 << 20, len(name), 0)
    local = b"PK\x03\x04" + common + name + body
    directory = b"PK\x01\x02\x14\0" + common + bytes(10) + struct.pack("<I", 0) + name
    put("npz", "zeros.zip", local + directory + b"PK\x05\x06" + struct.pack("<4H2IH", 0, 0, 1, 1, len(directory), len(local), 0))


def folder():
    specs = {"NetworkArch": "deep_sdf_decoder", "CodeLength": 4,
             "NetworkSpecs": {"dims": [8, 8], "latent_in": [1], "use_tanh": True, "weight_norm": True}}
    with zipfile.ZipFile(FIXTURES / "families" / "deep_sdf_xyz_in_all.zip") as archive:
        put("folder", "xyz_in_all", listed([(name, archive.read(name)) for name in archive.namelist()]))
    stream = (FIXTURES / "torch" / "deepsdf.legacy.pth").read_bytes()
    codes = (FIXTURES / "torch" / "latent_code.legacy.pth").read_bytes()
    text = json.dumps(specs).encode()
    put("folder", "streams", listed([("a/specs.json", text), ("a/ModelParameters/10.pth", stream),
                                     ("a/ModelParameters/9.pth", b""), ("a/LatentCodes/10.pth", codes)]))
    put("folder", "no_codes", listed([("specs.json", b"{}"), ("ModelParameters/latest.pth", stream)]))
    put("folder", "no_model", listed([("specs.json", text)]))
    put("folder", "broken_specs", listed([("specs.json", b'{"CodeLength": -1}'), ("ModelParameters/latest.pth", stream)]))


def grids():
    ramp = [x + 0.5 * y - 0.25 * z for x in range(-1, 2) for y in range(-1, 1) for z in range(-1, 1)]
    put("npy", "little", npy([3, 2, 2], ramp))
    put("npy", "big_fortran", npy([3, 2, 2], ramp, ">f8", True))
    put("npy", "version_2", npy([3, 2, 2], ramp, version=2))
    put("npy", "not_finite", npy([3, 2, 2], [float("inf")] * 12))
    put("npy", "huge_numbers", npy([2, 2, 2], [1e18, -1e18] * 4))
    put("npy", "two_axes", npy([3, 4], ramp))
    put("npy", "codes_fortran", npy([3, 1, 4], ramp, "<f8", True))
    put("npy", "no_columns", npy([1 << 40, 0], []))
    put("npy", "too_many", npy([1 << 40, 1 << 40, 2], []))
    put("npy", "cut", npy([3, 2, 2], ramp[:5]))
    put("npy", "integers", npy([2, 2, 2], ramp[:8], "<i4"))


def meshes():
    corners = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)]
    sides = [(0, 2, 1), (0, 1, 3), (1, 2, 3), (2, 0, 3)]
    text = lambda rows: "".join(" ".join(map(str, row)) + "\n" for row in rows)
    put("mesh", "tetrahedron.off", "OFF\n4 4 6\n" + text(corners) + text((3, *s) for s in sides))
    put("mesh", "square.off", "OFF # flat\n4 1 0\n" + text([(x, y, 0, 255, 0, 0, 1) for x, y in [(0, 0), (1, 0), (1, 1), (0, 1)]]) + "4 0 1 2 3\n")
    put("mesh", "tetrahedron.obj", "# by hand\no t\n" + text(("v", *c) for c in corners) + "vt 0 0\nvn 0 0 1\ng a\nf 1/1/1 3//1 2\nf 1 2 4\nf -3 -2 -1\nf 3 1 4\n")
    put("mesh", "pentagon.obj", text(("v", x, y, 0) for x, y in [(0, 0), (2, 0), (1, 0.5), (2, 2), (0, 2)]) + "f 1 2 3 4 5\n")
    put("mesh", "tetrahedron_text.stl", "solid t\n" + "".join(
        "facet normal 0 0 0\nouter loop\n" + text(("vertex", *corners[i]) for i in s) + "endloop\nendfacet\n" for s in sides) + "endsolid t\n")
    facets = b"".join(floats((0, 0, 0)) + b"".join(floats(corners[i]) for i in s) + b"\0\0" for s in sides)
    put("mesh", "tetrahedron.stl", b"by hand".ljust(80, b" ") + struct.pack("<I", 4) + facets)
    put("mesh", "too_long.stl", b"by hand".ljust(80, b" ") + struct.pack("<I", 1 << 31) + facets)
    head = "ply\nformat {} 1.0\ncomment x\nelement vertex 4\nproperty float x\nproperty float y\nproperty double z\nproperty uchar red\n" \
           "element face 4\nproperty list uchar int vertex_indices\nproperty float quality\nend_header\n"
    put("mesh", "text.ply", head.format("ascii") + text((*c, 7) for c in corners) + text((3, *s, 0.5) for s in sides))
    for name, order in [("little", "<"), ("big", ">")]:
        body = b"".join(struct.pack(order + "ffdB", *c, 7) for c in corners) + b"".join(struct.pack(order + "B3if", 3, *s, 0.5) for s in sides)
        put("mesh", f"{name}.ply", head.format(f"binary_{name}_endian").encode() + body)
    put("mesh", "too_many.ply", "ply\nformat ascii 1.0\nelement vertex 99999999999\nproperty float x\nend_header\n")

    def glb(document, body):
        document = {"asset": {"version": "2.0"}, "buffers": [{"byteLength": len(body)}], **document}
        chunk = json.dumps(document).encode()
        chunk += b" " * (-len(chunk) % 4)
        body += bytes(-len(body) % 4)
        size = 12 + 8 + len(chunk) + 8 + len(body)
        return b"glTF" + struct.pack("<2I", 2, size) + struct.pack("<I", len(chunk)) + b"JSON" + chunk + struct.pack("<I", len(body)) + b"BIN\0" + body

    positions, indices = b"".join(floats(c) for c in corners), struct.pack("<12H", *[i for s in sides for i in s])
    places = floats(wave(8))
    document = {
        "scene": 0, "scenes": [{"nodes": [0]}],
        "nodes": [{"children": [1], "scale": [2, 2, 2]}, {"mesh": 0, "translation": [0, 0, 1], "rotation": [0, 0, 0, 1]}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 2}, "indices": 1}]}],
        "bufferViews": [{"buffer": 0, "byteLength": 48}, {"buffer": 0, "byteOffset": 48, "byteLength": 24},
                        {"buffer": 0, "byteOffset": 72, "byteLength": 32, "byteStride": 8}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3", "min": [0, 0, 0], "max": [1, 1, 1]},
                      {"bufferView": 1, "componentType": 5123, "count": 12, "type": "SCALAR"},
                      {"bufferView": 2, "componentType": 5126, "count": 4, "type": "VEC2"}]}
    put("mesh", "tetrahedron.glb", glb(document, positions + indices + places))
    matrix = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 5, 0, 0, 1]
    soup = {"nodes": [{"mesh": 0, "matrix": matrix}], "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "mode": 4}]}],
            "bufferViews": [{"buffer": 0, "byteLength": 144}],
            "accessors": [{"bufferView": 0, "componentType": 5126, "count": 12, "type": "VEC3"}]}
    put("mesh", "soup.glb", glb(soup, b"".join(floats(corners[i]) for s in sides for i in s)))
    put("mesh", "own_child.glb", glb({**document, "nodes": [{"children": [0], "mesh": 0}]}, positions + indices + places))


def requests():
    scene = {"sphere": {"radius": 0.5}}
    blob = "sha256:" + "0123456789abcdef" * 4
    job = "018f6f3e-7b8a-7c3d-9e4f-0123456789ab"
    every = {
        "kind": "shrink",
        "field": {"input": blob, "latent": [0.1, -0.2], "level": 0.01, "domain": {"min": [-1, -1, -1], "max": [1, 1, 1]}},
        "shrink": {"method": "adaptive", "lattice": {"octahedral": {"n": 10}}, "density": "curvature", "on_topology": "wrap"},
        "budget": {"attempts": 2, "evaluations": 1000000},
        "outputs": ["glb", "surface", "report"],
        "labels": {"a": "b"},
        "webhook": {"url": "https://example.com/hook"},
        "warm_start": job,
        "deadline_s": 60,
    }
    put("request", "least", json.dumps({"field": {"scene": scene}}))
    put("request", "every", json.dumps(every))
    put("request", "stored", json.dumps(dict(every, warm_start={"job": job, "surface": blob}, latent_motion=True)))
    put("request", "weight", json.dumps({"field": {"scene": scene}, "weight": {"scene": scene}}))
    put("request", "paper", json.dumps({"field": {"scene": scene}, "shrink": {"method": "paper", "samples": 100, "lattice": {"latlong": {"n_theta": 8, "n_phi": 4}}}}))
    fit = {"kind": "fit", "meshes": [blob, blob], "fit": {"layers": 2, "width": 16, "activation": {"sine": {"w0": 30}}, "eikonal": 0.1}}
    put("request", "fit", json.dumps(fit))
    sensing = {"kind": "sensitivity", "of": job, "field": {"input": blob}, "surface": blob, "gradient": blob}
    put("request", "sensitivity", json.dumps(sensing))
    put("request", "faults", json.dumps({"kind": "x", "field": [], "shrink": {"lattice": {"latlong": {"n_theta": -1}}}, "deadline_s": 0}))


def strangers():
    for i, text in enumerate(
        [
            "shrinkd_0123456789ab_0123456789abcdef0123456789abcdef0123456789abcdef0123456789abcdef",
            "https://example.com:8443/hook?a=b",
            "http://2130706433/",
            "https://[::ffff:127.0.0.1]/",
            "https://user:secret@example.com/#x",
            "tenant.of-some_kind",
            "nats://user:secret@a:4222,b:4222?replicas=3&prefix=P",
            "tls://a?credentials=/etc/nats.creds",
            "whsec_b25lIHNlY3JldCBvZiB0aGUgY2hlY2sgb2Ygc2hyaW5rZA==",
        ]
    ):
        put("stranger", str(i), text)


def scenes():
    half = {"box": {"half_extents": [0.4, 0.3, 0.2]}}
    every = {
        "solids": {"union": {"of": [{"sphere": {"radius": 0.5}}, {"ellipsoid": {"radii": [0.5, 0.3, 0.2]}}, half,
                                    {"rounded_box": {"half_extents": [0.3, 0.3, 0.3], "radius": 0.1}},
                                    {"capsule": {"from": [0, 0, -0.5], "to": [0, 0.1, 0.5], "radius": 0.2}},
                                    {"cylinder": {"radius": 0.3, "half_height": 0.4}},
                                    {"cone": {"radius": 0.4, "top_radius": 0.1, "half_height": 0.3}},
                                    {"torus": {"major": 0.5, "minor": 0.1}}, {"octahedron": {"size": 0.5}},
                                    {"hex_prism": {"radius": 0.3, "half_height": 0.2}}]}},
        "operators": {"smooth_difference": {"k": 0.1, "of": [
            {"round": {"radius": 0.05, "of": half}}, {"shell": {"thickness": 0.05, "of": half}},
            {"displace": {"amplitude": 0.02, "frequency": [10, 5, 0], "of": half}}, {"half_space": {"normal": [0, 0, 1], "offset": 0.2}}]}},
        "moves": {"intersection": {"of": [
            {"translate": {"by": [0.1, 0, 0], "of": half}}, {"rotate": {"axis": [0, 0, 1], "angle": 30, "of": half}},
            {"scale": {"factor": 0.5, "of": half}}, {"mirror": {"axis": "x", "of": half}},
            {"repeat": {"spacing": [0.5, 0.5, 0.5], "count": [2, 1, 1], "of": {"sphere": {"radius": 0.1}}}}]}},
        "profiles": {"smooth_union": {"k": 0.2, "of": [
            {"extrude": {"polygon": [[0, 0], [0.5, 0], [0.2, 0.4]], "half_height": 0.2}},
            {"revolve": {"polygon": [[0.1, 0], [0.3, 0], [0.2, 0.4]], "offset": 0.1}}]}},
        "plane": {"difference": {"of": [
            {"circle": {"radius": 0.5}}, {"rectangle": {"half_extents": [0.2, 0.1]}},
            {"polygon": {"points": [[0, 0], [0.3, 0], [0.1, 0.2]]}}, {"rotate": {"angle": 20, "of": {"circle": {"radius": 0.1}}}}]}},
        "faults": {"sphere": {"radius": -1, "colour": "red"}},
        "numbers": {"sphere": {"radius": 1e-300}},
    }
    for name, scene in every.items():
        put("scene", name, json.dumps(scene))
    put("scene", "deep", '{"round": {"radius": 0, "of": ' * 40 + '{"sphere": {"radius": 1}}' + "}}" * 40)
    put("scene", "cut", '{"union": {"of": [{"sphere": {"radius":')


for write in [safetensors, npz, folder, grids, meshes, scenes, requests, strangers]:
    write()
