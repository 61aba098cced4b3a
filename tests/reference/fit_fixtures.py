"""Makes the small networks in tests/fixtures/networks with `shrinkd fit`, and writes reference values beside them.

    pip install numpy
    python3 tests/reference/fit_fixtures.py target/release/shrinkd tests/fixtures/networks

The shapes are analytic scenes that `shrinkd extract` makes meshes of, so nothing else is needed. All files are renewed together: the
references belong to the weights.

    blob.safetensors           SIREN 3 x 48 of a body with a head and a tail
    morph.safetensors          auto-decoder of five shapes, stout or long, head low or high: softplus 4 x 48, codes of 2
    blob.npz                   ELU 4 x 32 of the first shape, in the layout of neural-implicit-queries
    *.reference.npy            [200, 7] float64: point, value and gradient; for morph.safetensors the code is its row 2
"""
import json
import pathlib
import subprocess
import sys
import tempfile

import numpy as np

BLOB = ["--layers", "3", "--width", "48", "--w0", "12"]
MORPH = ["--layers", "4", "--width", "48", "--activation", "softplus", "--latent-size", "2"]
MORPH += ["--learning-rate", "0.003", "--epochs", "40"]
NPZ = ["--layers", "4", "--width", "32", "--activation", "elu", "--learning-rate", "0.005", "--epochs", "40"]


def ball(center, radius):
    return {"translate": {"by": center, "of": {"sphere": {"radius": radius}}}}


def joined(k, *shapes):
    return {"smooth_union": {"k": k, "of": list(shapes)}}


def blob():
    body = joined(0.2, ball([0, -0.15, 0], 0.45), ball([0.25, 0.42, 0.05], 0.27))
    return joined(0.15, body, {"capsule": {"from": [-0.3, -0.2, 0], "to": [-0.72, 0.15, 0.1], "radius": 0.11}})


def morph(long, high):
    half = 0.2 + 0.15 * long
    body = {"capsule": {"from": [-half, 0, 0], "to": [half, 0, 0], "radius": 0.38 - 0.06 * long}}
    return joined(0.2, body, ball([0.25 + 0.1 * long, 0.35 + 0.12 * high, 0], 0.22))


class Network:
    """shrinkd's own file, evaluated in double precision."""

    def __init__(self, path):
        data = path.read_bytes()
        size = int.from_bytes(data[:8], "little")
        header = json.loads(data[8 : 8 + size])
        self.architecture = json.loads(header.pop("__metadata__")["architecture"])
        assert self.architecture.get("encoding", "identity") == "identity"
        tensors = {}
        for name, at in header.items():
            begin, end = (8 + size + offset for offset in at["data_offsets"])
            tensors[name] = np.frombuffer(data[begin:end], "<f4").reshape(at["shape"]).astype(np.float64)
        self.codes = tensors.get("latent_codes", np.zeros((1, 0)))
        self.layers = []
        for i, layer in enumerate(self.architecture["layers"]):
            wb = tensors[f"layers.{i}.weight"], tensors[f"layers.{i}.bias"]
            self.layers.append((*wb, layer.get("activation", "identity"), layer.get("skip")))

    def __call__(self, points, code):
        """Value and gradient by the point, forward along the three axes."""
        x = np.concatenate([np.broadcast_to(code, (len(points), len(code))), points], axis=1)
        dx = np.zeros((3, *x.shape))
        for axis in range(3):
            dx[axis, :, len(code) + axis] = 1
        h, dh = x, dx
        for weight, bias, activation, skip in self.layers:
            if skip:
                h, dh = (skip["scale"] * np.concatenate(both, axis=-1) for both in ((h, x), (dh, dx)))
            z, dz = h @ weight.T + bias, dh @ weight.T
            h, slope = activate(activation, z)
            dh = slope * dz
        return h[:, 0], dh[:, :, 0].T


def activate(activation, z):
    name, parameters = next(iter(activation.items())) if isinstance(activation, dict) else (activation, {})
    if name == "sine":
        return np.sin(parameters["w0"] * z), parameters["w0"] * np.cos(parameters["w0"] * z)
    if name == "softplus":
        return np.logaddexp(0, parameters["beta"] * z) / parameters["beta"], 1 / (1 + np.exp(-parameters["beta"] * z))
    if name == "elu":
        return np.where(z > 0, z, np.expm1(np.minimum(z, 0))), np.exp(np.minimum(z, 0))
    assert name == "identity", name
    return z, np.ones_like(z)


def reference(path, network, row=0):
    points = np.random.default_rng(1).uniform(-1, 1, (200, 3)).astype(np.float32).astype(np.float64)
    value, gradient = network(points, network.codes[row])
    np.save(path.with_name(path.name + ".reference.npy"), np.column_stack([points, value, gradient]))


def as_npz(path, network):
    arrays = {}
    for i, (weight, bias, activation, _) in enumerate(network.layers):
        arrays[f"{2 * i:04d}.dense.A"] = weight.T.astype(np.float32)
        arrays[f"{2 * i:04d}.dense.b"] = bias.astype(np.float32)
        arrays[f"{2 * i + 1:04d}.{'squeeze_last' if activation == 'identity' else activation}._"] = np.zeros(0, np.float32)
    np.savez_compressed(path, **arrays)


def main():
    shrinkd, folder = sys.argv[1], pathlib.Path(sys.argv[2])
    run = lambda *arguments: subprocess.run([shrinkd, *map(str, arguments)], check=True)
    with tempfile.TemporaryDirectory() as temporary:
        temporary = pathlib.Path(temporary)

        def mesh(name, scene):
            source, made = temporary / f"{name}.json", temporary / f"{name}.glb"
            source.write_text(json.dumps(scene))
            run("extract", source, "-o", made, "--lattice", "octahedral:72")
            return made

        shape = mesh("blob", blob())
        shapes = [mesh(f"morph{i}", morph(*at)) for i, at in enumerate([(-1, -1), (1, -1), (-1, 1), (1, 1), (0, 0)])]
        run("fit", shape, "-o", folder / "blob.safetensors", *BLOB)
        run("fit", *shapes, "-o", folder / "morph.safetensors", *MORPH)
        run("fit", shape, "-o", temporary / "elu.safetensors", *NPZ)
        for name, row in (("blob", 0), ("morph", 2)):
            path = folder / f"{name}.safetensors"
            reference(path, Network(path), row)
        elu = Network(temporary / "elu.safetensors")
        as_npz(folder / "blob.npz", elu)
        reference(folder / "blob.npz", elu)


if __name__ == "__main__":
    main()
