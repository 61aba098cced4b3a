"""Trains a SIREN, has the service wrap it, and shows the surface and its derivatives.

    SHRINKD_URL=http://127.0.0.1:8080 python3 examples/python/siren.py

The cells (`# %%`) run one by one in an editor that knows them, or the file as a whole in about a minute. Needs torch, numpy, safetensors,
matplotlib and requests. Files go to the folder in SHRINKD_OUT (siren-out): the network, its surface, and siren.png.
"""

# %% Where the service is
from __future__ import annotations

import math
import os
import pathlib
from typing import Any

import numpy as np
import torch
from matplotlib import cm, colors
from matplotlib import pyplot as plt
from safetensors.numpy import load_file
from shrinkd_client import Client
from torch import nn

client = Client(os.environ.get("SHRINKD_URL", "http://127.0.0.1:8080"), os.environ.get("SHRINKD_KEY"))
folder = pathlib.Path(os.environ.get("SHRINKD_OUT", "siren-out"))
folder.mkdir(parents=True, exist_ok=True)
torch.manual_seed(0)


# %% What it learns: three balls that flow into each other, as a signed distance in the cube of half extent 1
BALLS = [((-0.15, -0.2, 0.0), 0.45), ((0.35, 0.15, 0.15), 0.3), ((-0.3, 0.4, -0.1), 0.25)]
BLEND = 0.2


def balls(points: torch.Tensor) -> torch.Tensor:
    """Signed distances `[n, 1]` at `[n, 3]`; less than the distance where the balls blend, as a smooth union is."""
    distance = torch.full((len(points), 1), math.inf)
    for center, radius in BALLS:
        one = (points - torch.tensor(center)).norm(dim=1, keepdim=True) - radius
        blend = (BLEND - (distance - one).abs()).clamp(min=0) / BLEND
        distance = torch.minimum(distance, one) - blend**2 * BLEND / 4
    return distance


# %% The network: hidden layers of sin(w0 (W x + b)), initialised as Sitzmann et al. (2020) do
W0 = 20.0


class Sine(nn.Module):
    """sin(w0 x)."""

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return torch.sin(W0 * x)


class Siren(nn.Module):
    """A multilayer perceptron from a point to a signed distance. The names of its tensors, `net.{i}.0`, are those by which shrinkd
    knows a SIREN."""

    def __init__(self, width: int = 64, hidden: int = 3) -> None:
        super().__init__()
        sizes = [3] + [width] * hidden + [1]
        layers = []
        for i, (inputs, outputs) in enumerate(zip(sizes, sizes[1:])):
            linear = nn.Linear(inputs, outputs)
            bound = 1 / inputs if i == 0 else math.sqrt(6 / inputs) / W0
            nn.init.uniform_(linear.weight, -bound, bound)
            layers.append(nn.Sequential(linear) if i == hidden else nn.Sequential(linear, Sine()))
        self.net = nn.Sequential(*layers)

    def forward(self, points: torch.Tensor) -> torch.Tensor:
        return self.net(points)  # type: ignore[no-any-return, unused-ignore]


def value_and_gradient(network: nn.Module, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Values `[n, 1]` and gradients `[n, 3]`, both differentiable by the weights."""
    points = points.detach().requires_grad_(True)
    value = network(points)
    (gradient,) = torch.autograd.grad(value.sum(), points, create_graph=True)
    return value, gradient


# %% Training: the value, and a gradient of length 1 (eikonal)
STEPS, BATCH, EIKONAL = 500, 768, 0.03
NEAR = 0.05


def samples() -> torch.Tensor:
    """Points `[BATCH, 3]`: half of them all over the cube, half about the balls' surfaces."""
    direction = nn.functional.normalize(torch.randn(BATCH // 2, 3), dim=1)
    ball = torch.randint(len(BALLS), (BATCH // 2,))
    centers, radii = torch.tensor([c for c, _ in BALLS])[ball], torch.tensor([r for _, r in BALLS])[ball]
    about = centers + direction * (radii[:, None] + NEAR * torch.randn(BATCH // 2, 1))
    return torch.cat([2 * torch.rand(BATCH - BATCH // 2, 3) - 1, about])


siren = Siren()
optimizer = torch.optim.Adam(siren.parameters(), lr=2e-3)
schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, STEPS)
for step in range(STEPS):
    points = samples()
    value, gradient = value_and_gradient(siren, points)
    error = (value - balls(points)).abs().mean()
    loss = error + EIKONAL * ((gradient.norm(dim=1) - 1) ** 2).mean()
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()
    schedule.step()
    if step % 100 == 0 or step == STEPS - 1:
        print(f"step {step}: mean error {error.item():.4f}, loss {loss.item():.4f}")


# %% Posting it, as PyTorch saves it. No file of a SIREN says its w0, so upload and job do.
torch.save(siren.state_dict(), folder / "siren.pth")
uploaded = client.upload(folder / "siren.pth", w0=W0)
about = uploaded["description"]
print(f"{uploaded['id'][:15]}…: family {about['family']} ({about['because']}), layers {about['layers']}")

LATTICE = {"latlong": {"n_theta": 96, "n_phi": 48}}
job = client.submit(
    {"input": uploaded["id"], "w0": W0}, shrink={"lattice": LATTICE}, outputs=["glb", "surface"], labels={"example": "siren"}
)
for event in client.follow(job["id"]):
    if event.kind == "progress":
        print(f"{100 * event.data['fraction']:3.0f} % {event.data['stage']}")
job = client.wait(job["id"])
client.download(job, "glb", folder / "siren.glb")
surface = load_file(client.download(job, "surface", folder / "siren.safetensors"))
positions, normals, uv = surface["positions"], surface["normals"], surface["uv"]
print(f"surface: {positions.shape[0]} rows (phi) of {positions.shape[1]} columns (theta)")


# %% The service evaluates the same network: its values and unit gradients at the vertices are PyTorch's
def at_vertices(network: nn.Module) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """Values `[rows, columns]` and gradients `[rows, columns, 3]` at the points of the grid."""
    value, gradient = value_and_gradient(network, torch.from_numpy(positions).reshape(-1, 3))
    return value.detach().numpy().reshape(positions.shape[:2]), gradient.detach().numpy().reshape(positions.shape)


values, gradients = at_vertices(siren)
lengths = np.linalg.norm(gradients, axis=-1)
value_error = np.abs(surface["value"] - values).max()
normal_error = np.abs(normals - gradients / lengths[..., None]).max()
print(f"values differ by {value_error:.1e} at most, normals by {normal_error:.1e}; largest |value| {np.abs(values).max():.1e}")
assert value_error < 1e-4 and normal_error < 1e-3


# %% dv/dtheta: central differences along the rows (the last column repeats the first), and what the first form says of them
def along_theta(v: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """The derivative by theta of what the grid holds, per radian, without the last column."""
    ring = v[:, :-1].astype(np.float64)
    return (np.roll(ring, -1, axis=1) - np.roll(ring, 1, axis=1)) / (2 * 2 * np.pi / ring.shape[1])


tangent = along_theta(positions)
speed = np.linalg.norm(tangent, axis=-1)
# at a pole theta is no coordinate
inner = slice(1, -1)
first_e = surface["first_form"][:, :-1, 0]
form_error = np.abs(speed**2 - first_e)[inner].max() / first_e.max()
lean = np.abs((tangent * normals[:, :-1]).sum(axis=-1))[inner] / speed[inner]
print(
    f"|dv/dtheta|^2 and E differ by {form_error:.1e} of the largest E; dv/dtheta leans {lean.mean():.3f} off the tangent plane"
)
assert form_error < 1e-4 and lean.mean() < 0.05


# %% The derivative by the network: of the volume that the surface encloses, by every weight
def volume(v: np.ndarray[Any, Any], triangles: np.ndarray[Any, Any]) -> tuple[float, np.ndarray[Any, Any]]:
    """The volume inside of welded vertices `[n, 3]`, and its derivatives by them."""
    a, b, c = (v[triangles[:, k]].astype(np.float64) for k in range(3))
    gradient = np.zeros_like(v, dtype=np.float64)
    for corner, cross in enumerate((np.cross(b, c), np.cross(c, a), np.cross(a, b))):
        np.add.at(gradient, triangles[:, corner], cross / 6)
    return float((a * np.cross(b, c)).sum() / 6), gradient


def welded(tensors: dict[str, Any]) -> np.ndarray[Any, Any]:
    """The vertices `[n, 3]` that the points of a grid are."""
    vertex = tensors["vertex"].ravel()
    v = np.zeros((vertex.max() + 1, 3), dtype=np.float32)
    v[vertex] = tensors["positions"].reshape(-1, 3)
    return v


enclosed, by_vertex = volume(welded(surface), surface["triangles"])
derived = client.wait(client.sensitivity(job["id"], by_vertex)["id"])
slopes = load_file(client.download(derived, "sensitivity", folder / "slopes.safetensors"))
# `layers.i` of the answer are the linear layers in order; in the state they are net.i.0
slope = {f"net.{i}.0.{kind}": torch.from_numpy(slopes[f"layers.{i}.{kind}"]) for i in range(4) for kind in ("weight", "bias")}
state = siren.state_dict()
assert {name: tensor.shape for name, tensor in slope.items()} == {name: tensor.shape for name, tensor in state.items()}
square = sum(float((tensor.double() ** 2).sum()) for tensor in slope.values())
print(
    f"volume {enclosed:.5f}; its gradient by {sum(t.numel() for t in slope.values())} weights has length {math.sqrt(square):.3f}"
)


# %% Is it true? Weights moved along it both ways, so that the volume should change by 1 %, and the surfaces made again from the one before
CHANGE, TOLERANCE = 0.01, 0.02
step_size = CHANGE * enclosed / square


def moved(sign: float) -> tuple[Siren, dict[str, Any]]:
    """The network with moved weights, and its surface: every vertex at its old place on the sphere."""
    network = Siren()
    network.load_state_dict({name: tensor + sign * step_size * slope[name] for name, tensor in state.items()})
    path = folder / f"siren{sign:+.0f}.pth"
    torch.save(network.state_dict(), path)
    field = {"input": client.upload(path, w0=W0)["id"], "w0": W0}
    nudged = client.submit(field, shrink={"lattice": LATTICE}, outputs=["surface"], warm_start=job["id"])
    return network, load_file(client.download(client.wait(nudged["id"]), "surface", path.with_suffix(".safetensors")))


(grown, grown_surface), (shrunk, shrunk_surface) = moved(+1.0), moved(-1.0)
volumes = [volume(welded(tensors), tensors["triangles"])[0] for tensors in (grown_surface, shrunk_surface)]
found = (volumes[0] - volumes[1]) / 2
volume_error = found / (CHANGE * enclosed) - 1
print(f"predicted change {CHANGE * enclosed:.6f}, found {found:.6f}: {100 * volume_error:+.2f} %")
assert abs(volume_error) < TOLERANCE, "the derivative by the network is not what the surface does"

# the same for every vertex: dv = -n df / |grad f|, df from PyTorch
predicted = -(at_vertices(grown)[0] - at_vertices(shrunk)[0]) / 2 / lengths
motion = (((grown_surface["positions"] - shrunk_surface["positions"]) / 2) * normals).sum(axis=-1)
motion_error = np.linalg.norm(motion - predicted) / np.linalg.norm(predicted)
print(f"the vertices' motions along the normals differ from the predicted ones by {100 * motion_error:.1f} %")
assert motion_error < 0.05

# %% The picture
LIGHT = np.array([0.0, 0.6, 0.8])
hue = colors.hsv_to_rgb(np.dstack([uv[..., 0] % 1, np.full_like(uv[..., 0], 0.65), 0.55 + 0.4 * uv[..., 1]]))
tiles = (np.floor(uv[..., 0] * 24 + 1e-4) + np.floor(uv[..., 1] * 12 + 1e-4)) % 2
checkerboard = hue * (0.45 + 0.55 * tiles[..., None])
full_speed = np.concatenate([speed, speed[:, :1]], axis=1)
reach = np.abs(motion).max()
panels = [
    ("the surface, with its UVs as a checkerboard", checkerboard, None),
    ("|dv/dθ|, scene units per radian", None, cm.ScalarMappable(colors.Normalize(0, full_speed.max()), "viridis")),
    ("motion along the normal when the weights move", None, cm.ScalarMappable(colors.Normalize(-reach, reach), "coolwarm")),
]
figure = plt.figure(figsize=(15, 5.5), layout="constrained")
for k, ((title, facecolors, scale), shown) in enumerate(zip(panels, (None, full_speed, motion))):
    axes = figure.add_subplot(1, 3, k + 1, projection="3d")
    # +y is up in the scene, +z in matplotlib
    x, y, z = positions[..., 0], -positions[..., 2], positions[..., 1]
    painted = facecolors if scale is None else scale.to_rgba(shown)[..., :3]
    lit = 0.5 + 0.5 * np.clip(normals @ LIGHT, 0, 1)[..., None]
    axes.plot_surface(x, y, z, facecolors=lit * painted, shade=False, rcount=100, ccount=100, linewidth=0, antialiased=False)
    axes.set_box_aspect([np.ptp(one) for one in (x, y, z)], zoom=1.2)
    axes.set_axis_off()
    axes.set_title(title)
    axes.view_init(elev=20, azim=-60)
    if scale is not None:
        figure.colorbar(scale, ax=axes, shrink=0.6)
figure.suptitle(
    f"volume {enclosed:.4f}; weights along its gradient: {100 * CHANGE:.2f} % predicted, {100 * found / enclosed:.3f} % found"
)
figure.savefig(folder / "siren.png", dpi=100)
print(f"{folder / 'siren.png'}")
