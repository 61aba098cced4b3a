"""Writes weight files as the training code of published families does, and what PyTorch says of them.

    python tests/reference/write_families.py OUT [POINTS]

Every model is built here from its published description (see src/field/network/family.rs), with random weights, and saved with
torch.save in the layout of the family's own code. Beside NAME.pth (or NAME.zip, an experiment folder of DeepSDF) comes NAME.json: options,
points, values and input gradients by autograd in double precision. The files in tests/fixtures/networks/families
were written with 50 points; `.ci/run` writes them anew with 1,000. One model is trained here, for half a minute, because an extraction
needs a shape.
needs a shape.
"""

import io
import json
import math
import pathlib
import sys
import zipfile

import parametrized
import torch
from torch import nn

OUT = pathlib.Path(sys.argv[1])
COUNT = int(sys.argv[2]) if len(sys.argv) > 2 else 50
# how well single and double precision agree at a point that is kept
AGREED = 3e-5
torch.manual_seed(7)
torch.set_default_dtype(torch.float32)


def linear(inputs, outputs, gain=1.0):
    layer = nn.Linear(inputs, outputs)
    with torch.no_grad():
        layer.weight.normal_(0.0, gain / math.sqrt(inputs))
        layer.bias.normal_(0.0, 0.1)
    return layer


def normed(layer, new):
    norm = parametrized.weight_norm if new else nn.utils.weight_norm
    layer = norm(layer)
    with torch.no_grad():
        (layer.parametrizations.weight.original0 if new else layer.weight_g).mul_(1.3)
    return layer


class DeepSdf(nn.Module):
    """facebookresearch/DeepSDF and DeepSDFStruct: [code, xyz] in, joined again before some layers."""

    def __init__(self, latent, width, depth, skip, *, struct=False, use_tanh=False, xyz_in_all=False, norm=True, layer_norms=()):
        super().__init__()
        self.layer_norms = layer_norms
        self.skip, self.depth, self.struct, self.use_tanh, self.xyz = skip, depth, struct, use_tanh, xyz_in_all
        start = latent + 3
        widths = [start] + [width] * depth + [1]
        for l in range(depth + 1):
            outputs = widths[l + 1]
            if l + 1 in skip:
                outputs -= start
            elif xyz_in_all and l < depth:
                outputs -= 3
            layer = linear(widths[l], outputs, 1.4)
            setattr(self, f"lin{l}", normed(layer, struct) if norm and (l < depth or struct) else layer)
            if l in layer_norms:
                setattr(self, f"bn{l}", nn.LayerNorm(outputs))

    def forward(self, latent, x):
        joined = torch.cat([latent, x], 1)
        h = joined
        for l in range(self.depth + 1):
            if l in self.skip:
                h = torch.cat([h, joined], 1)
            elif l > 0 and self.xyz:
                h = torch.cat([h, x], 1)
            h = getattr(self, f"lin{l}")(h)
            if l < self.depth:
                # a norm of the last layer is in the file and goes unused
                h = torch.relu(getattr(self, f"bn{l}")(h) if l in self.layer_norms else h)
            elif self.use_tanh:
                h = torch.tanh(h)
        return h if self.struct else torch.tanh(h)


def stirred(model):
    """Layer norms begin as scales of one and shifts of zero, which would hide what is done with them."""
    for name, part in model.named_children():
        if name.startswith("bn"):
            with torch.no_grad():
                part.weight.normal_(1.0, 0.3)
                part.bias.normal_(0.0, 0.2)
    return model


def two_lobes(points, size):
    """The distance to two balls that run into each other, nearly; `size` from -1 to 1 makes the second one larger."""
    one = (points - torch.tensor([-0.2, 0.0, 0.0])).norm(dim=1, keepdim=True) - 0.45
    other = (points - torch.tensor([0.35, 0.2, 0.1])).norm(dim=1, keepdim=True) - (0.3 + 0.06 * size)
    k = 0.2
    h = (k - (one - other).abs()).clamp(min=0) / k
    return torch.minimum(one, other) - h * h * k / 4


def trained(model, steps=6000, batch=1024):
    optimizer = torch.optim.Adam(model.parameters(), lr=4e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    for _ in range(steps):
        points, size = 2 * torch.rand(batch, 3) - 1, 2 * torch.rand(batch, 1) - 1
        with torch.no_grad():
            # half of them near the surface
            near = points[: batch // 2]
            near /= near.norm(dim=1, keepdim=True) / 0.5
            near += 0.15 * torch.randn(batch // 2, 3)
        wanted = torch.tanh(two_lobes(points, size))
        loss = ((model(size, points) - wanted) ** 2 / (0.01 + wanted**2)).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    print(f"two lobes: the loss is {loss.item():.1e} at the end")
    return model


class Siren(nn.Module):
    """vsitzmann/siren: net.net.{i}.0; mode="nerf" encodes the point and has ReLUs."""

    def __init__(self, width, hidden, nerf=False):
        super().__init__()
        self.nerf = nerf
        inputs = 3 + 6 * 10 if nerf else 3
        widths = [inputs] + [width] * (hidden + 1)
        gain = 1.4 if nerf else 2.4 / 30
        layers = [nn.Sequential(linear(a, b, gain)) for a, b in zip(widths, widths[1:])]
        block = nn.Module()
        block.net = nn.Sequential(*layers, nn.Sequential(linear(width, 1)))
        self.net = block

    def forward(self, latent, x):
        if self.nerf:
            parts = [x]
            for octave in range(10):
                for axis in range(3):
                    t = 2.0**octave * math.pi * x[:, axis : axis + 1]
                    parts += [torch.sin(t), torch.cos(t)]
            x = torch.cat(parts, 1)
        for layer in self.net.net[:-1]:
            x = torch.relu(layer(x)) if self.nerf else torch.sin(30 * layer(x))
        return self.net.net[-1](x)


class Lucidrains(nn.Module):
    """lucidrains/siren-pytorch: layers.{i}.weight, last_layer.weight; w0 30, then 1."""

    def __init__(self, width, depth, first=30.0, others=1.0):
        super().__init__()
        self.first, self.others = first, others
        self.layers = nn.ModuleList()
        for i in range(depth):
            self.layers.append(linear(3 if i == 0 else width, width, 0.08 if i == 0 else 1.8))
        self.last_layer = linear(width, 1)

    def forward(self, latent, x):
        for i, layer in enumerate(self.layers):
            x = torch.sin((self.first if i == 0 else self.others) * layer(x))
        return self.last_layer(x)


class Implicit(nn.Module):
    """IDR, VolSDF, NeuS, IGR: softplus 100, input joined before layer 4 and divided by sqrt 2, features after the distance."""

    def __init__(self, octaves, width, features, norm, new=False, skip=4, depth=6):
        super().__init__()
        self.octaves, self.skip, self.depth = octaves, skip, depth
        start = 3 + 6 * octaves
        widths = [start] + [width] * depth + [1 + features]
        for l in range(depth + 1):
            outputs = widths[l + 1] - (start if l + 1 == skip else 0)
            layer = linear(widths[l], outputs, 1.4)
            setattr(self, f"lin{l}", normed(layer, new) if norm else layer)

    def forward(self, latent, x):
        parts = [x]
        for k in range(self.octaves):
            parts += [torch.sin(2.0**k * x), torch.cos(2.0**k * x)]
        start = torch.cat(parts, 1)
        h = start
        for l in range(self.depth + 1):
            if l == self.skip:
                h = torch.cat([h, start], 1) / math.sqrt(2)
            h = getattr(self, f"lin{l}")(h)
            if l < self.depth:
                h = nn.functional.softplus(h, beta=100)
        return h[:, :1]


def saved(value, legacy=False):
    buffer = io.BytesIO()
    torch.save(value, buffer, _use_new_zipfile_serialization=not legacy)
    return buffer.getvalue()


def asked(model, code, points):
    points = points.clone().requires_grad_(True)
    values = model(code, points)[:, 0]
    return values.detach(), torch.autograd.grad(values.sum(), points)[0]


def put(name, model, data, suffix=".pth", options=None, latent=None, expected="", assumed=()):
    (OUT / f"{name}{suffix}").write_bytes(data)
    # at the kink of a ReLU a gradient is not defined to the last digit: points at which PyTorch's single and double precision
    # disagree are left out, whatever anyone else says there
    points = 2 * torch.rand(2 * COUNT, 3) - 1
    code = torch.zeros(2 * COUNT, 0) if latent is None else torch.tensor(latent).expand(2 * COUNT, -1)
    value, gradient = (part.double() for part in asked(model, code, points))
    values, gradients = asked(model.double(), code.double(), points.double())
    floor = 1e-2 * values.abs().max()
    agreed = (value - values).abs() < AGREED * torch.maximum(values.abs(), floor)
    agreed &= (gradient - gradients).norm(dim=1) < AGREED * gradients.norm(dim=1)
    kept = agreed.nonzero()[:COUNT, 0]
    assert len(kept) == COUNT, f"{name}: PyTorch agrees with itself at {len(kept)} points only"
    document = {
        "file": f"{name}{suffix}",
        "family": expected,
        "assumed": list(assumed),
        "options": options or {},
        "points": points[kept].tolist(),
        "values": values[kept].tolist(),
        "gradients": gradients[kept].tolist(),
    }
    (OUT / f"{name}.json").write_text(json.dumps(document))


def module(model):
    return {f"module.{k}": v for k, v in model.state_dict().items()}


def specs(latent, **arguments):
    return json.dumps({"CodeLength": latent, "NetworkArch": "deep_sdf_decoder", "NetworkSpecs": arguments})


def folder(text, model, codes):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("experiment/specs.json", text)
        archive.writestr("experiment/ModelParameters/1000.pth", saved(model))
        archive.writestr("experiment/LatentCodes/1000.pth", saved(codes))
    return buffer.getvalue()


OUT.mkdir(parents=True, exist_ok=True)
code = [0.5, -0.25, 0.125, 1.0]

m = DeepSdf(4, 24, 5, [3])
put("deep_sdf_bare", m, saved({"epoch": 9, "model_state_dict": module(m)}, legacy=True), options={"latent": code},
    latent=code, expected="deep_sdf", assumed=["ReLU", "tanh"])

m = DeepSdf(4, 24, 5, [3], use_tanh=True)
rows = torch.randn(3, 4)
put("deep_sdf_folder", m,
    folder(specs(4, latent_in=[3], use_tanh=True, weight_norm=True),
           {"epoch": 9, "model_state_dict": module(m)}, {"epoch": 9, "latent_codes": {"weight": rows}}),
    suffix=".zip", options={"latent_row": 2}, latent=rows[2].tolist(), expected="deep_sdf")

m = DeepSdf(4, 24, 4, [], xyz_in_all=True)
one = torch.randn(1, 1, 4)
put("deep_sdf_xyz_in_all", m,
    folder(specs(4, xyz_in_all=True), {"epoch": 9, "model_state_dict": module(m)}, one),
    suffix=".zip", latent=one[0, 0].tolist(), expected="deep_sdf")

m = DeepSdf(2, 24, 4, [2], struct=True)
put("deep_sdf_struct", m, saved({"epoch": 9, "model_state_dict": module(m)}), options={"latent": [0.3, -0.7]},
    latent=[0.3, -0.7], expected="deep_sdf_struct")

m = Siren(24, 3)
put("siren", m, saved(m.state_dict(), legacy=True), expected="siren", assumed=["w0"])

m = Siren(24, 3, nerf=True)
put("siren_nerf", m, saved(m.state_dict()), expected="siren_nerf")

m = Lucidrains(24, 4)
put("siren_lucidrains", m, saved(m.state_dict()), expected="siren_lucidrains", assumed=["w0"])

m = Lucidrains(24, 4, 20.0, 1.5)
put("siren_lucidrains_w0", m, saved(m.state_dict()), options={"w0": [20.0, 1.5]}, expected="siren_lucidrains")

m = Implicit(6, 48, 5, True)
put("idr", m, saved({"epoch": 2, "model_state_dict": {
    **{f"module.implicit_network.{k}": v for k, v in m.state_dict().items()},
    "module.rendering_network.lin0.weight": torch.zeros(4, 4), "module.rendering_network.lin0.bias": torch.zeros(4)}}),
    expected="idr", assumed=["softplus", "octaves", "sqrt 2"])

m = Implicit(6, 48, 5, True, new=True)
put("volsdf", m, saved({"model_state_dict": {
    **{f"implicit_network.{k}": v for k, v in m.state_dict().items()}, "density.beta": torch.tensor(0.1)}}),
    expected="vol_sdf")

m = Implicit(6, 48, 5, True)
put("neus", m, saved({"nerf": {"alpha_linear.weight": torch.zeros(1, 4)}, "sdf_network_fine": m.state_dict(),
    "color_network_fine": {"lin0.weight_g": torch.ones(4, 1)}, "iter_step": 300}), expected="neus")

m = Implicit(0, 24, 0, False)
put("igr", m, saved({"epoch": 5, "model_state_dict": module(m)}), expected="igr")

# what came later is below, so that the models above keep their numbers
m = stirred(DeepSdf(4, 25, 5, [3], norm=False, layer_norms=range(6)))
put("deep_sdf_layer_norm", m, saved({"epoch": 9, "model_state_dict": module(m)}), options={"latent": code}, latent=code,
    expected="deep_sdf", assumed=["ReLU", "tanh", "add 1e-5 to the variance", "norm of the last layer"])

m = stirred(DeepSdf(4, 26, 4, [2], norm=False, layer_norms=[0, 1, 3]))
rows = torch.randn(3, 4)
put("deep_sdf_layer_norm_folder", m,
    folder(specs(4, dims=[26] * 4, dropout=[0, 1, 2, 3], dropout_prob=0.2, norm_layers=[0, 1, 3], latent_in=[2],
                 xyz_in_all=False, use_tanh=False, latent_dropout=False, weight_norm=False),
           {"epoch": 9, "model_state_dict": module(m)}, {"epoch": 9, "latent_codes": {"weight": rows}}),
    suffix=".zip", options={"latent_row": 1}, latent=rows[1].tolist(), expected="deep_sdf",
    assumed=["add 1e-5 to the variance"])

m = trained(DeepSdf(1, 24, 3, [2], norm=False, layer_norms=[0, 1, 2]))
put("two_lobes", m, saved({"model_state_dict": module(m), "lat_vecs": {"weight": torch.tensor([[-1.0], [1.0]])}}),
    options={"latent_row": 0}, latent=[-1.0], expected="deep_sdf")

# two of the repository's own networks as others would have saved them, for extractions: their activation and w0 are not the usual
from safetensors.torch import load_file  # noqa: E402

OWN = pathlib.Path(__file__).resolve().parent.parent / "fixtures" / "networks"
morph, blob = load_file(OWN / "morph.safetensors"), load_file(OWN / "blob.safetensors")
state = {f"module.lin{name.removeprefix('layers.')}": v for name, v in morph.items() if name.startswith("layers.")}
state["module.homogen_network.scale"] = torch.ones(1)
codes = {"weight": morph["latent_codes"]}
(OUT / "morph_deep_sdf.pth").write_bytes(saved({"model_state_dict": state, "lat_vecs": codes}))
state = {f"net.net.{k.split('.')[1]}.0.{k.split('.')[2]}": v for k, v in blob.items()}
(OUT / "blob_siren.pth").write_bytes(saved(state, legacy=True))
