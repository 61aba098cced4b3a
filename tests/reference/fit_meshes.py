"""Fits a SIREN of 4 layers of 128 (the paper's) to each mesh, for `shrinkd compare` to run on fields that are not distances.

    pip install jax libigl numpy
    python3 tests/reference/fit_meshes.py OUT MESH...
    shrinkd compare OUT

A mesh is scaled to 1.6 on its longest side and centred in the box [-1, 1]^3. The loss is the absolute error of the signed
distance (sign: fast winding number), half of the points near the surface; seeded. What is written is NAME.safetensors in
shrinkd's own layout, and for every mesh the mean error of the distance at points near the surface and in the box.
"""
import os
import sys
import time

import igl
import jax
import jax.numpy as jnp
import numpy as np

from fit_fixture import Sine, safetensors

W0, WIDTH, DEPTH = 30.0, 128, 4
STEPS, BATCH, POOL = 5000, 4096, 200_000


def start(rng):
    sizes, parameters = [3] + [WIDTH] * DEPTH + [1], []
    for i, (a, b) in enumerate(zip(sizes[:-1], sizes[1:])):
        bound = 1 / a if i == 0 else np.sqrt(6 / a) / W0
        parameters.append((rng.uniform(-bound, bound, (b, a)).astype("f4"), np.zeros(b, "f4")))
    return parameters


def forward(parameters, p):
    for w, b in parameters[:-1]:
        p = jnp.sin(W0 * (p @ w.T + b))
    w, b = parameters[-1]
    return (p @ w.T + b)[:, 0]


def samples(rng, vertices, faces):
    corners = vertices[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    on = corners[rng.choice(len(faces), POOL, p=area / area.sum())]
    a, b = np.sqrt(rng.random((POOL, 1))), rng.random((POOL, 1))
    on = (1 - a) * on[:, 0] + a * (1 - b) * on[:, 1] + a * b * on[:, 2]
    # half of those near the surface a tenth as far from it
    spread = np.where(rng.random((POOL, 1)) < 0.5, 0.005, 0.05)
    near = np.clip(on + spread * rng.normal(size=on.shape), -1, 1)
    return near, rng.uniform(-1, 1, (POOL, 3))


def distances(p, vertices, faces):
    return igl.signed_distance(p, vertices, faces, igl.SIGNED_DISTANCE_TYPE_FAST_WINDING_NUMBER)[0].astype("f4")


@jax.jit
def run(parameters, near, far, key):
    """All steps of Adam with a rate that falls along a cosine."""
    zeros = jax.tree.map(jnp.zeros_like, parameters)

    def loss(parameters, p, truth):
        return jnp.abs(forward(parameters, p) - truth).mean()

    def step(state, i):
        parameters, m, v, key = state
        key, one, two = jax.random.split(key, 3)
        pick = lambda key, part: [x[jax.random.randint(key, (BATCH // 2,), 0, POOL)] for x in part]
        (pn, dn), (pf, df) = pick(one, near), pick(two, far)
        g = jax.grad(loss)(parameters, jnp.concatenate([pn, pf]), jnp.concatenate([dn, df]))
        m = jax.tree.map(lambda m, g: 0.9 * m + 0.1 * g, m, g)
        v = jax.tree.map(lambda v, g: 0.999 * v + 0.001 * g * g, v, g)
        rate = 5e-4 * (1 + jnp.cos(jnp.pi * i / STEPS)) / 2 + 1e-7
        rate *= jnp.sqrt(1 - 0.999 ** (i + 1.0)) / (1 - 0.9 ** (i + 1.0))
        parameters = jax.tree.map(lambda p, m, v: p - rate * m / (jnp.sqrt(v) + 1e-8), parameters, m, v)
        return (parameters, m, v, key), None

    return jax.lax.scan(step, (parameters, zeros, zeros, key), jnp.arange(STEPS))[0][0]


class Fitted:
    """What `safetensors` asks of a network."""

    activation, skip = Sine(W0), None

    def __init__(self, parameters):
        self.parameters = parameters

    def layers(self):
        return [(np.asarray(w), np.asarray(b)) for w, b in self.parameters]


def main():
    out, meshes = sys.argv[1], sys.argv[2:]
    os.makedirs(out, exist_ok=True)
    for path in meshes:
        rng, clock = np.random.default_rng(1), time.time()
        vertices, faces = igl.read_triangle_mesh(path)
        low, high = vertices.min(0), vertices.max(0)
        vertices = (vertices - (low + high) / 2) * (1.6 / (high - low).max())
        near, far = [(p.astype("f4"), distances(p, vertices, faces)) for p in samples(rng, vertices, faces)]
        parameters = run(start(rng), near, far, jax.random.key(1))
        error = [float(jnp.abs(forward(parameters, p) - d).mean()) for p, d in (near, far)]
        name = os.path.splitext(os.path.basename(path))[0]
        with open(os.path.join(out, f"{name}.safetensors"), "wb") as file:
            file.write(safetensors(Fitted(parameters)))
        print(f"{name}: error {error[0]:.5f} near, {error[1]:.5f} in the box, {time.time() - clock:.0f} s", flush=True)


if __name__ == "__main__":
    main()
