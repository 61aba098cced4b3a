"""Fits the small networks in tests/fixtures/networks to analytic shapes, and writes reference values beside them.

    python3 tests/reference/fit_fixture.py tests/fixtures/networks

Needs only numpy, and is seeded; another version of numpy may still change the last bits, so renew all files together:

    blob.safetensors           SIREN 3 x 48 of a body with a head and a tail
    morph.safetensors          softplus 3 x 48 with a skip and a latent code of 2: stout to long, head low to high
    blob.npz                   ELU 4 x 32 of the first shape, in the layout of neural-implicit-queries
    *.reference.npy            [200, 7] float64: point, value and gradient; for morph.safetensors the code is its row 2

Every zero set is checked on a grid of 64: one component inside, one outside, Euler characteristic 2, within the box.
"""
import json
import os
import struct
import sys

import numpy as np

GRID = 64


def smooth_min(a, b, k):
    h = np.maximum(k - np.abs(a - b), 0) / k
    return np.minimum(a, b) - h * h * k / 4


def capsule(p, a, b, radius):
    along = b - a
    t = np.clip(((p - a) * along).sum(1) / (along * along).sum(-1), 0, 1)
    return np.linalg.norm(p - a - t[:, None] * along, axis=1) - radius


def blob(p, z=None):
    body = np.linalg.norm(p - [0.0, -0.15, 0.0], axis=1) - 0.45
    head = np.linalg.norm(p - [0.25, 0.42, 0.05], axis=1) - 0.27
    tail = capsule(p, np.array([-0.3, -0.2, 0.0]), np.array([-0.72, 0.15, 0.1]), 0.11)
    return smooth_min(smooth_min(body, head, 0.2), tail, 0.15)


def morph(p, z):
    half = 0.2 + 0.15 * z[:, :1] * [[1.0, 0.0, 0.0]]
    ends = half * [[1.0, 0.0, 0.0]]
    along = 2 * ends
    t = np.clip(((p + ends) * along).sum(1) / (along * along).sum(1), 0, 1)
    body = np.linalg.norm(p + ends - t[:, None] * along, axis=1) - (0.38 - 0.06 * z[:, 0])
    center = np.stack([0.25 + 0.1 * z[:, 0], 0.35 + 0.12 * z[:, 1], 0 * z[:, 0]], axis=1)
    return smooth_min(body, np.linalg.norm(p - center, axis=1) - 0.22, 0.2)


class Sine:
    def __init__(self, w0):
        self.w0, self.name = w0, {"sine": {"w0": w0}}

    def value(self, x):
        return np.sin(self.w0 * x)

    def slope(self, x):
        return self.w0 * np.cos(self.w0 * x)


class Softplus:
    def __init__(self, beta):
        self.beta, self.name = beta, {"softplus": {"beta": beta}}

    def value(self, x):
        t = self.beta * x
        return (np.maximum(t, 0) + np.log1p(np.exp(-np.abs(t)))) / self.beta

    def slope(self, x):
        e = np.exp(-np.abs(self.beta * x))
        return np.where(x > 0, 1, e) / (1 + e)


class Elu:
    name = "elu"

    def value(self, x):
        return np.where(x > 0, x, np.expm1(np.minimum(x, 0)))

    def slope(self, x):
        return np.where(x > 0, 1, np.exp(np.minimum(x, 0)))


class Network:
    """Dense layers over [latent, point]; before layer `skip` the input is joined and scaled by 1 / sqrt 2."""

    def __init__(self, rng, inputs, width, depth, activation, skip=None):
        self.activation, self.skip, self.inputs = activation, skip, inputs
        sizes = [inputs] + [width] * depth + [1]
        self.parameters = []
        for i, (a, b) in enumerate(zip(sizes[:-1], sizes[1:])):
            a += inputs if i == skip else 0
            if isinstance(activation, Sine):
                bound = 1 / a if i == 0 else np.sqrt(6 / a) / activation.w0
                weight = rng.uniform(-bound, bound, (b, a))
            else:
                weight = rng.normal(size=(b, a)) * np.sqrt(2 / a)
            self.parameters += [weight, np.zeros(b)]
        self.scale = 1 / np.sqrt(2)

    def layers(self):
        return list(zip(self.parameters[::2], self.parameters[1::2]))

    def forward(self, x):
        tape, h, layers = [], x, self.layers()
        for i, (w, b) in enumerate(layers):
            if i == self.skip:
                h = self.scale * np.concatenate([h, x], axis=1)
            z = h @ w.T + b
            tape.append((h, z))
            h = self.activation.value(z) if i + 1 < len(layers) else z
        return h[:, 0], tape

    def backward(self, tape, g):
        """Gradients of sum(g * value) for the parameters, and for every input."""
        layers, gradients, to_input = self.layers(), [], 0
        g = g[:, None]
        for i in reversed(range(len(layers))):
            h, z = tape[i]
            if i + 1 < len(layers):
                g = g * self.activation.slope(z)
            gradients = [g.T @ h, g.sum(0)] + gradients
            g = g @ layers[i][0]
            if i == self.skip:
                to_input = to_input + self.scale * g[:, -self.inputs :]
                g = self.scale * g[:, : -self.inputs]
        return gradients, g + to_input


def fit(network, shape, latent, steps, rng, rate=2e-3):
    moments = [(np.zeros_like(p), np.zeros_like(p)) for p in network.parameters]
    for step in range(steps):
        n = 2048
        z = rng.uniform(-1.1, 1.1, (n, latent))
        p = rng.uniform(-1, 1, (n, 3))
        # half of the points near the surface: along the numerical gradient onto it, then a little off
        near = p[: n // 2]
        zn = z[: n // 2]
        d = shape(near, zn)
        g = np.stack([shape(near + h, zn) - d for h in 1e-4 * np.eye(3)], axis=1) / 1e-4
        near -= d[:, None] * g / np.maximum((g * g).sum(1, keepdims=True), 0.25)
        near += rng.normal(size=near.shape) * 0.05
        p[: n // 2] = np.clip(near, -1, 1)
        truth = shape(p, z)
        value, tape = network.forward(np.concatenate([z, p], axis=1))
        error = value - truth
        gradients, _ = network.backward(tape, error / (np.abs(error) + 0.01) / n)
        lr = rate * 0.5 * (1 + np.cos(np.pi * step / steps)) + 1e-6
        for i, gradient in enumerate(gradients):
            m, v = moments[i]
            m += 0.1 * (gradient - m)
            v += 0.001 * (gradient**2 - v)
            correction = np.sqrt(1 - 0.999 ** (step + 1)) / (1 - 0.9 ** (step + 1))
            network.parameters[i] = network.parameters[i] - lr * correction * m / (np.sqrt(v) + 1e-8)
    network.parameters = [p.astype(np.float32).astype(np.float64) for p in network.parameters]
    return np.abs(error).mean()


def components(mask):
    """Number of face-connected parts of a boolean grid."""
    label = np.where(mask, np.arange(1, mask.size + 1).reshape(mask.shape), 0)
    while True:
        grown = label.copy()
        for axis in range(3):
            for shift in (1, -1):
                rolled = np.roll(label, shift, axis)
                edge = [slice(None)] * 3
                edge[axis] = 0 if shift == 1 else -1
                rolled[tuple(edge)] = 0
                grown = np.maximum(grown, rolled)
        grown[~mask] = 0
        if (grown == label).all():
            return len(np.unique(label[mask]))
        label = grown


def euler_of_surface(mask):
    """Euler characteristic of the boundary of the union of cubes: vertices - edges + faces of the boundary cells."""
    padded = np.pad(mask, 1).astype(np.int8)
    cells = 0
    for code in range(8):
        axes = [a for a in range(3) if code >> a & 1]
        # closed cells of dimension 3 - len(axes): present where any cube around them is
        around = padded
        for a in axes:
            around = np.maximum(np.take(around, range(around.shape[a] - 1), a), np.take(around, range(1, around.shape[a]), a))
        cells += (-1) ** (3 - len(axes)) * int(around.sum())
    return 2 * cells


def check(network, z):
    axis = np.linspace(-1, 1, GRID)
    p = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    value = network.forward(np.concatenate([np.broadcast_to(z, (len(p), len(z))), p], axis=1))[0]
    inside = value.reshape(GRID, GRID, GRID) < 0
    rim = np.ones_like(inside)
    rim[2:-2, 2:-2, 2:-2] = False
    found = components(inside), components(~inside), euler_of_surface(inside), bool((inside & rim).any())
    assert found == (1, 1, 2, False), found


def reference(network, z, rng):
    p = rng.uniform(-1, 1, (200, 3)).astype(np.float32).astype(np.float64)
    value, tape = network.forward(np.concatenate([np.broadcast_to(z, (len(p), len(z))), p], axis=1))
    _, gradient = network.backward(tape, np.ones(len(p)))
    return np.column_stack([p, value, gradient[:, len(z) :]])


def safetensors(network, latent_codes=None):
    layers = []
    for i, (w, _) in enumerate(network.layers()):
        layer = {"outputs": len(w)}
        if i + 1 < len(network.layers()):
            layer["activation"] = network.activation.name
        if i == network.skip:
            layer["skip"] = {"scale": float(np.float32(network.scale))}
        layers.append(layer)
    architecture = {"version": 1, "layers": layers, "metric": "bound"}
    tensors = {}
    for i, (w, b) in enumerate(network.layers()):
        tensors[f"layers.{i}.weight"], tensors[f"layers.{i}.bias"] = w, b
    if latent_codes is not None:
        architecture["latent_size"] = latent_codes.shape[1]
        tensors["latent_codes"] = latent_codes
    header, data = {"__metadata__": {"architecture": json.dumps(architecture)}}, b""
    for name, array in tensors.items():
        raw = array.astype("<f4").tobytes()
        header[name] = {"dtype": "F32", "shape": list(array.shape), "data_offsets": [len(data), len(data) + len(raw)]}
        data += raw
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    return struct.pack("<Q", len(text)) + text + data


def npz(network, path):
    arrays = {}
    for i, (w, b) in enumerate(network.layers()):
        arrays[f"{2 * i:04d}.dense.A"] = w.T.astype(np.float32)
        arrays[f"{2 * i:04d}.dense.b"] = b.astype(np.float32)
        last = i + 1 == len(network.layers())
        arrays[f"{2 * i + 1:04d}.{'squeeze_last' if last else network.activation.name}._"] = np.zeros(0, np.float32)
    np.savez_compressed(path, **arrays)


def main():
    folder = sys.argv[1]
    write = lambda name, data: open(os.path.join(folder, name), "wb").write(data)
    none = np.zeros(0)

    rng = np.random.default_rng(1)
    network = Network(rng, 3, 48, 3, Sine(12.0))
    print("blob.safetensors", fit(network, blob, 0, 2500, rng))
    check(network, none)
    write("blob.safetensors", safetensors(network))
    np.save(os.path.join(folder, "blob.safetensors.reference.npy"), reference(network, none, rng))

    rng = np.random.default_rng(2)
    network = Network(rng, 5, 48, 3, Softplus(20.0), skip=2)
    print("morph.safetensors", fit(network, morph, 2, 2500, rng))
    codes = np.array([[-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0], [1.0, 1.0], [0.0, 0.0]])
    for code in codes:
        check(network, code)
    write("morph.safetensors", safetensors(network, codes))
    np.save(os.path.join(folder, "morph.safetensors.reference.npy"), reference(network, codes[2], rng))

    rng = np.random.default_rng(3)
    network = Network(rng, 3, 32, 4, Elu())
    print("blob.npz", fit(network, blob, 0, 2500, rng))
    check(network, none)
    npz(network, os.path.join(folder, "blob.npz"))
    np.save(os.path.join(folder, "blob.npz.reference.npy"), reference(network, none, rng))


if __name__ == "__main__":
    main()
