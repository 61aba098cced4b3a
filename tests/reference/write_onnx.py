"""Writes the ONNX fixtures of `src/field/network/onnx/tests.rs`.

    pip install torch onnx onnxscript
    python tests/reference/write_onnx.py tests/fixtures/networks/onnx

Every network is a PyTorch module in double precision. For each, `NAME.onnx` is what an exporter writes of it (in single
precision, as people do), and `NAME.json` holds the values and the gradients that PyTorch's autograd gives at 50 points. The weights
that the exporter sees are rounded to single precision first, so that both are the same function.
"""

import json
import math
import sys
import warnings
from pathlib import Path

import numpy as np
import onnx
import torch
from onnx import TensorProto, helper, numpy_helper
from torch import nn
from torch.nn import functional as F

POINTS = 50


class Sine(nn.Module):
    def __init__(self, w0):
        super().__init__()
        self.w0 = w0

    def forward(self, x):
        return torch.sin(self.w0 * x)


def siren(width=24, layers=3, w0=30.0):
    parts, inputs = [], 3
    for i in range(layers):
        linear = nn.Linear(inputs, width)
        bound = 1 / inputs if i == 0 else math.sqrt(6 / inputs) / w0
        nn.init.uniform_(linear.weight, -bound, bound)
        parts += [linear, Sine(w0)]
        inputs = width
    return nn.Sequential(*parts, nn.Linear(inputs, 1))


class DeepSdf(nn.Module):
    """The decoder of DeepSDF: [latent, xyz] in, ReLU, the input joined after the outputs, tanh at the end."""

    def __init__(self, latent=5, width=20, layers=5, skip=2, norm=False):
        super().__init__()
        self.skip = skip
        given = latent + 3
        sizes = [given] + [width] * layers + [1]
        for i in range(layers + 1):
            outputs = sizes[i + 1] - (given if i + 1 == skip else 0)
            linear = nn.Linear(sizes[i], outputs)
            if norm and i < layers:
                linear = nn.utils.weight_norm(linear)
            setattr(self, f"lin{i}", linear)
        self.layers = layers

    def forward(self, given):
        x = given
        for i in range(self.layers + 1):
            if i == self.skip:
                x = torch.cat([x, given], 1)
            x = getattr(self, f"lin{i}")(x)
            if i < self.layers:
                x = F.relu(x)
        return torch.tanh(x)


class Joined(nn.Module):
    """A decoder with the latent code as an input of its own, one row for all points or one row for each."""

    def __init__(self, decoder, one_row):
        super().__init__()
        self.decoder, self.one_row = decoder, one_row

    def forward(self, latent, xyz):
        if self.one_row == "expand":
            latent = latent.expand(xyz.shape[0], -1)
        elif self.one_row == "repeat":
            latent = latent.repeat(xyz.shape[0], 1)
        return self.decoder(torch.cat([latent, xyz], 1))


class Idr(nn.Module):
    """The implicit network of IDR: softplus of sharpness 100, a skip over sqrt 2, the first of several outputs."""

    def __init__(self, width=20, layers=4, skip=2, frequencies=0, features=3, norm=True):
        super().__init__()
        self.skip, self.frequencies, self.layers = skip, frequencies, layers
        given = 3 + 6 * frequencies
        sizes = [given] + [width] * layers + [1 + features]
        for i in range(layers + 1):
            outputs = sizes[i + 1] - (given if i + 1 == skip else 0)
            linear = nn.Linear(sizes[i], outputs)
            setattr(self, f"lin{i}", nn.utils.weight_norm(linear) if norm else linear)
        self.softplus = nn.Softplus(beta=100)

    def forward(self, xyz):
        given = [xyz]
        for k in range(self.frequencies):
            given += [torch.sin(xyz * 2.0**k), torch.cos(xyz * 2.0**k)]
        given = torch.cat(given, -1)
        x = given
        for i in range(self.layers + 1):
            if i == self.skip:
                x = torch.cat([x, given], 1) / math.sqrt(2)
            x = getattr(self, f"lin{i}")(x)
            if i < self.layers:
                x = self.softplus(x)
        return x[:, :1]


class Mapped(nn.Module):
    """Latent columns taken from the input and sent through a layer of their own; a squeezed answer with its sign turned."""

    def __init__(self, latent=4, width=16):
        super().__init__()
        self.latent = latent
        self.map, self.first, self.last = nn.Linear(latent, 6), nn.Linear(9, width), nn.Linear(width, 1)

    def forward(self, given):
        code, xyz = given[:, : self.latent], given[:, self.latent :]
        code = torch.tanh(self.map(code))
        h = torch.tanh(self.first(torch.cat([xyz * 1.5 - 0.1, code], -1)))
        return -self.last(h).squeeze(-1)


class Batched(nn.Module):
    """The encoding of NeRF by broadcasting over a new axis, for points of shape [batch, n, 3]."""

    def __init__(self, frequencies=4, width=16):
        super().__init__()
        self.register_buffer("bands", 2.0 ** torch.arange(frequencies) * math.pi)
        self.net = nn.Sequential(
            nn.Linear(3 + 6 * frequencies, width), nn.ELU(), nn.Dropout(0.1), nn.Linear(width, width), nn.ELU(), nn.Linear(width, 1)
        )

    def forward(self, xyz):
        angles = (xyz[..., None] * self.bands).flatten(-2)
        return self.net(torch.cat([xyz, torch.sin(angles), torch.cos(angles)], -1))


def expected(model, widths, rows, seed):
    """Values and gradients at random points, and at the codes that belong to them (the same code for all)."""
    generator = torch.Generator().manual_seed(seed)
    latent_size = sum(widths) - 3
    latent = torch.randn(latent_size, generator=generator, dtype=torch.float64).float().double()
    points = (torch.rand(POINTS, 3, generator=generator, dtype=torch.float64) * 2 - 1).float().double()
    points.requires_grad_()
    if len(widths) == 2:
        given = (latent[None].expand(rows, -1), points)
    elif latent_size:
        given = (torch.cat([latent[None].expand(POINTS, -1), points], 1),)
    else:
        given = (points,)
    values = model(*given).reshape(-1)
    (gradients,) = torch.autograd.grad(values.sum(), points)
    return {
        "latent": latent.tolist(),
        "points": points.detach().tolist(),
        "values": values.detach().tolist(),
        "gradients": gradients.tolist(),
    }


def write(folder, name, model, dynamo, widths=(3,), rows=POINTS, batched=False, **options):
    """Rounds the weights to single precision, writes the answers of the module in double precision and its export in single."""
    model = model.eval().float().double()
    (folder / f"{name}.json").write_text(json.dumps(expected(model, widths, rows, len(name))) + "\n")
    model = model.float()
    given = [torch.rand(7 if i + 1 == len(widths) or rows > 1 else 1, w) for i, w in enumerate(widths)]
    names = ["xyz"] if len(widths) == 1 else ["latent", "xyz"]
    if batched:
        given = [g[None] for g in given]
    path = folder / f"{name}.onnx"
    settings = {"input_names": names, "output_names": ["sdf"], "verbose": False, **options}
    axis = 1 if batched else 0
    moving = {n: axis for n, g in zip(names, given) if g.shape[axis] > 1}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        if dynamo:
            n = torch.export.Dim("n")
            shapes = tuple({axis: n} if k in moving else {} for k in names)
            program = torch.onnx.export(model, tuple(given), dynamo=True, dynamic_shapes=shapes, **settings)
            proto = program.model_proto
        else:
            axes = {k: {a: "n"} for k, a in moving.items()}
            torch.onnx.export(model, tuple(given), str(path), dynamo=False, dynamic_axes=axes, **settings)
            proto = onnx.load(path)
    lean(proto.graph)
    onnx.checker.check_model(proto)
    onnx.save(proto, path)


def lean(graph):
    """Takes stack traces of the exporter's machine out: they say nothing and name its folders."""
    for part in [graph, *graph.node, *graph.value_info, *graph.input, *graph.output, *graph.initializer]:
        part.doc_string = ""
        if hasattr(part, "metadata_props"):
            del part.metadata_props[:]


def by_hand(folder):
    """ELU with MatMul and Add, as Keras' exporter writes dense layers; the numbers in every type that a tensor may have."""
    torch.manual_seed(11)
    sizes = [3, 12, 12, 12, 12, 1]
    linears = [nn.Linear(a, b) for a, b in zip(sizes, sizes[1:])]
    kinds = [TensorProto.FLOAT16, TensorProto.BFLOAT16, TensorProto.DOUBLE, TensorProto.FLOAT, TensorProto.FLOAT]
    types = [torch.float16, torch.bfloat16, torch.float64, torch.float32, torch.float32]
    nodes, tensors, name = [], [], "points"
    parts = []
    for i, (linear, kind, dtype) in enumerate(zip(linears, kinds, types)):
        linear = linear.double()
        for p in linear.parameters():
            p.data = p.data.to(dtype).double() if dtype != torch.float64 else p.data
        weight, bias = linear.weight.detach().T, linear.bias.detach()
        raw = i != 4
        for key, value in [("kernel", weight), ("bias", bias)]:
            array = value.to(torch.float32).contiguous().numpy()
            if kind == TensorProto.BFLOAT16:
                data = (array.view(np.uint32) >> 16).astype(np.uint16).tobytes()
                tensor = helper.make_tensor(f"{key}{i}", kind, array.shape, data, raw=True)
            elif kind == TensorProto.DOUBLE:
                # doubles in the typed field instead of the raw one
                tensor = helper.make_tensor(f"{key}{i}", kind, array.shape, value.flatten().tolist())
            elif kind == TensorProto.FLOAT16:
                tensor = numpy_helper.from_array(array.astype(np.float16), f"{key}{i}")
            elif raw:
                tensor = numpy_helper.from_array(array, f"{key}{i}")
            else:
                tensor = helper.make_tensor(f"{key}{i}", kind, array.shape, array.flatten().tolist())
            tensors.append(tensor)
            if kind != TensorProto.FLOAT:
                nodes.append(helper.make_node("Cast", [f"{key}{i}"], [f"{key}{i}_f"], f"cast_{key}{i}", to=TensorProto.FLOAT))
        cast = "_f" if kind != TensorProto.FLOAT else ""
        nodes.append(helper.make_node("MatMul", [name, f"kernel{i}{cast}"], [f"product{i}"], f"dense{i}/MatMul"))
        last = i + 1 == len(linears)
        nodes.append(helper.make_node("Add", [f"bias{i}{cast}", f"product{i}"], ["sdf" if last else f"sum{i}"], f"dense{i}/Add"))
        if not last:
            nodes.append(helper.make_node("Elu", [f"sum{i}"], [f"elu{i}"], f"dense{i}/Elu", alpha=1.0))
        name = f"elu{i}"
        parts += [linear] + ([] if last else [nn.ELU()])
    inputs = [helper.make_tensor_value_info("points", TensorProto.FLOAT, ["n", 3])]
    outputs = [helper.make_tensor_value_info("sdf", TensorProto.FLOAT, ["n", 1])]
    graph = helper.make_graph(nodes, "by_hand", inputs, outputs, tensors)
    proto = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    onnx.checker.check_model(proto)
    onnx.save(proto, folder / "elu_matmul.onnx")
    (folder / "elu_matmul.json").write_text(json.dumps(expected(nn.Sequential(*parts), (3,), POINTS, 3)) + "\n")


def main():
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    torch.manual_seed(7)
    write(folder, "siren", siren(), True)
    write(folder, "siren_torchscript", siren(), False)
    write(folder, "deepsdf", DeepSdf(), False, (8,))
    write(folder, "deepsdf_two_inputs", Joined(DeepSdf(), None), True, (5, 3))
    write(folder, "deepsdf_one_code", Joined(DeepSdf(), "expand"), False, (5, 3), rows=1)
    write(folder, "deepsdf_one_code_dynamo", Joined(DeepSdf(), "expand"), True, (5, 3), rows=1)
    write(folder, "deepsdf_repeated_code", Joined(DeepSdf(), "repeat"), True, (5, 3), rows=1)
    write(folder, "deepsdf_weight_norm", DeepSdf(norm=True), False, (8,), do_constant_folding=False)
    write(folder, "idr", Idr(), True)
    write(folder, "idr_unfolded", Idr(), False, do_constant_folding=False)
    write(folder, "idr_unoptimized", Idr(), True, optimize=False)
    write(folder, "idr_encoded", Idr(width=28, frequencies=3, norm=False), True)
    write(folder, "tanh_mapped", Mapped(), True, (7,))
    write(folder, "tanh_mapped_torchscript", Mapped(), False, (7,))
    write(folder, "nerf_elu", Batched(), True, batched=True)
    write(folder, "nerf_elu_torchscript", Batched(), False, batched=True)
    by_hand(folder)


if __name__ == "__main__":
    main()
