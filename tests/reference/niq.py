"""Reference values of a neural-implicit-queries network, in float64.

    python3 tests/reference/niq.py NETWORK.npz OUT.npy [COUNT]

Writes an array [COUNT, 7] of float64: a point in the cube of half extent 1, the value there and its gradient, by forward
mode through every operation. The Rust tests compare `bunny.npz` with the file that the environment variable
NIQ_REFERENCE names:

    NIQ_REFERENCE=OUT.npy cargo test --release --lib real_networks
"""
import sys

import numpy as np

ACTIVATIONS = {
    "relu": (lambda x: np.maximum(x, 0), lambda x: (x > 0).astype(x.dtype)),
    "elu": (lambda x: np.where(x > 0, x, np.expm1(np.minimum(x, 0))), lambda x: np.where(x > 0, 1, np.exp(np.minimum(x, 0)))),
    "tanh": (np.tanh, lambda x: 1 - np.tanh(x) ** 2),
    "sin": (np.sin, np.cos),
}


def evaluate(path, points):
    arrays = np.load(path)
    h = points
    jacobian = np.broadcast_to(np.eye(3), (len(points), 3, 3))  # [point, feature, axis]
    for key in sorted({".".join(name.split(".")[:2]) for name in arrays.files}):
        operation = key.split(".")[1]
        if operation == "dense":
            a, b = arrays[key + ".A"].astype(np.float64), arrays[key + ".b"].astype(np.float64)
            h = h @ a + b
            jacobian = np.einsum("io,pix->pox", a, jacobian)
        elif operation in ACTIVATIONS:
            value, slope = ACTIVATIONS[operation]
            jacobian = slope(h)[:, :, None] * jacobian
            h = value(h)
        elif operation != "squeeze_last":
            raise SystemExit(f"unknown operation {operation}")
    return h[:, 0], jacobian[:, 0, :]


def main():
    path, out = sys.argv[1:3]
    count = int(sys.argv[3]) if len(sys.argv) > 3 else 1000
    # float32 points, because that is what the field is asked at
    points = np.random.default_rng(7).uniform(-1, 1, (count, 3)).astype(np.float32).astype(np.float64)
    values, gradients = evaluate(path, points)
    np.save(out, np.column_stack([points, values, gradients]))


if __name__ == "__main__":
    main()
