"""examples/python/siren.py against the real program: python siren.py PROGRAM

Needs torch, numpy, safetensors, matplotlib and requests. The script holds its derivatives against finite differences itself; here it is run
from the beginning, and what it leaves and tells is looked at. Exits 0 when all of it is right.
"""

import os
import pathlib
import re
import subprocess
import sys
import tempfile

import numpy
import torch
from matplotlib.image import imread
from safetensors.numpy import load_file
from support import ROOT, Service

PATIENCE_S = 600


def told(output, pattern):
    """The numbers in a line of the output."""
    found = re.search(pattern, output)
    assert found, (pattern, output)
    return [float(number) for number in found.groups()]


def main():
    with tempfile.TemporaryDirectory() as made, tempfile.TemporaryDirectory() as data, Service(sys.argv[1], data) as service:
        command = [sys.executable, str(ROOT / "examples" / "python" / "siren.py")]
        variables = {"SHRINKD_URL": service.url, "SHRINKD_OUT": made, "MPLBACKEND": "agg"}
        ended = subprocess.run(
            command, env={**os.environ, **variables}, capture_output=True, text=True, timeout=PATIENCE_S, check=False
        )
        assert ended.returncode == 0, (ended.stdout, ended.stderr)
        folder = pathlib.Path(made)

        assert "family siren" in ended.stdout, ended.stdout
        (volume,) = told(ended.stdout, r"volume ([\d.]+); its gradient")
        (off,) = told(ended.stdout, r"predicted change [\d.]+, found [\d.]+: ([+-][\d.]+) %")
        assert abs(off) < 2, off
        # the three balls and a little where they blend
        assert abs(volume / enclosed() - 1) < 0.05, (volume, enclosed())

        state, slopes = torch.load(folder / "siren.pth"), load_file(folder / "slopes.safetensors")
        assert [tuple(t.shape) for t in state.values()] == [(64, 3), (64,), (64, 64), (64,), (64, 64), (64,), (1, 64), (1,)]
        # a last bias that is higher raises the value everywhere, and takes from the volume what it sweeps
        surface = load_file(folder / "siren.safetensors")
        assert slopes["layers.3.bias"].shape == (1,) and slopes["layers.3.bias"][0] < 0
        assert surface["positions"].shape == (49, 97, 3) and (folder / "siren.glb").read_bytes()[:4] == b"glTF"
        assert abs(slopes["layers.3.bias"][0] + swept(surface)) < 0.02 * swept(surface)

        picture = imread(folder / "siren.png")[..., :3]
        colours = numpy.unique((picture * 15).astype(int).reshape(-1, 3), axis=0)
        painted = (picture.min(axis=2) < 0.9).mean()
        assert picture.shape[1] >= 1000 and len(colours) > 100 and 0.1 < painted < 0.9, (picture.shape, len(colours), painted)
    print(f"volume {volume}, its derivative {off:+} % off; a picture of {len(colours)} colours")


def enclosed():
    """The volume of the example's union without its blends, by points."""
    balls = [((-0.15, -0.2, 0.0), 0.45), ((0.35, 0.15, 0.15), 0.3), ((-0.3, 0.4, -0.1), 0.25)]
    points = numpy.random.default_rng(1).uniform(-1, 1, (200_000, 3))
    inside = [numpy.linalg.norm(points - numpy.array(center), axis=1) < radius for center, radius in balls]
    return 8 * numpy.any(inside, axis=0).mean()


def swept(surface):
    """The area of the surface, every piece over the slope of the field there: what one unit of the value sweeps."""
    vertex = surface["vertex"].ravel()
    count = vertex.max() + 1
    points, slope = numpy.zeros((count, 3)), numpy.zeros(count)
    points[vertex], slope[vertex] = surface["positions"].reshape(-1, 3), surface["gradient_norm"].ravel()
    a, b, c = (points[surface["triangles"][:, k]] for k in range(3))
    area = numpy.linalg.norm(numpy.cross(b - a, c - a), axis=1) / 2
    return (area / slope[surface["triangles"]].mean(axis=1)).sum()


if __name__ == "__main__":
    main()
