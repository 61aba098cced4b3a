"""Writes the PyTorch checkpoints under tests/fixtures/networks/torch, with the real writer.

    python tests/reference/write_torch.py tests/fixtures/networks/torch

needs PyTorch 2 (the CPU build of PyPI or Debian will do) and numpy. Every case is written twice: NAME.pth is the zip archive of
version 1.6 and later, NAME.legacy.pth the stream of before, and NAME.json what both hold: every tensor's shape and its numbers as
`torch.load` gives them, converted to float32 by PyTorch ("nan", "inf" and "-inf" are text). Names are dictionary keys and indices joined
by dots. Cases without a JSON are to be refused. Streams name their storages by addresses, so they differ from one run to the next.
"""

import argparse
import collections
import json
import math
import pathlib
import sys
import warnings

import numpy
import parametrized
import torch
from torch import nn

warnings.filterwarnings("ignore")


def flatten(value, name=""):
    """The tensors of a checkpoint by name, written independently of the reader that they are to test."""
    if isinstance(value, torch.Tensor):
        yield name, value
    elif isinstance(value, dict):
        for key, member in value.items():
            if isinstance(key, str) or type(key) is int:
                yield from flatten(member, f"{name}.{key}" if name else str(key))
    elif isinstance(value, (list, tuple)):
        for index, member in enumerate(value):
            yield from flatten(member, f"{name}.{index}" if name else str(index))


def number(value):
    return value if math.isfinite(value) else str(value)


class Decoder(nn.Module):
    """The layers of a small DeepSDF decoder, under its names."""

    def __init__(self, normalize):
        super().__init__()
        sizes = [4 + 3, 6, 6, 1]
        for index, (inputs, outputs) in enumerate(zip(sizes, sizes[1:])):
            layer = nn.Linear(inputs, outputs)
            last = index == len(sizes) - 2
            setattr(self, f"lin{index}", layer if last else normalize(layer))

    def forward(self, x):
        x = torch.relu(self.lin0(x))
        return self.lin2(torch.relu(self.lin1(x)))


class Single(nn.Module):
    """A module that a file of the module itself would need; the stream even holds this source."""

    def __init__(self):
        super().__init__()
        self.weight = nn.Parameter(torch.ones(2))


def sine_layers():
    """The names of the original SIREN code: `net.net.{i}.0.weight`."""
    net = nn.Sequential(*[nn.Sequential(nn.Linear(i, o)) for i, o in [(3, 8), (8, 8), (8, 1)]])
    return nn.ModuleDict({"net": nn.ModuleDict({"net": net})})


def trained(model):
    """The model after a step of Adam, with the optimizer that has state now."""
    optimizer = torch.optim.Adam(model.parameters(), lr=1e-3)
    model(torch.randn(5, 7)).abs().sum().backward()
    optimizer.step()
    return optimizer


def views():
    base = torch.arange(60, dtype=torch.float32) * 0.5 - 3
    matrix = base[:12].reshape(3, 4)
    return {
        "offset": base[7:19],
        "strided": base[1::3],
        "transposed": matrix.t(),
        "permuted": base.reshape(3, 4, 5).permute(2, 0, 1),
        "window": base.reshape(6, 10)[1:5, 2:9:2],
        "expanded": base[:3].expand(4, 3),
        "column": base.reshape(6, 10)[:, 3:4],
        "scalar": torch.tensor(2.5),
        "one": base[59],
        "empty": torch.zeros(0, 3),
        "parameter": nn.Parameter(torch.tensor([[1.0, -2.0]])),
        "tied": matrix,
        "tied_again": matrix,
    }


def types():
    edge = [0.0, -0.0, 1.0, -2.5, 65504.0, 6.1e-5, 6.0e-8, -3.1e-6, 0.1, math.inf, -math.inf, math.nan]
    return {
        "half": torch.tensor(edge, dtype=torch.float16),
        "bfloat16": torch.tensor([*edge, 3e38, 1e-39], dtype=torch.bfloat16),
        "float": torch.tensor([*edge, 1e-42, 3.4e38], dtype=torch.float32),
        "double": torch.tensor([*edge, math.pi, 1e300, 1e-300, 16777217.0], dtype=torch.float64),
        "long": torch.tensor([0, -1, 2**62 + 12345, -(2**63), 16777217], dtype=torch.int64),
        "int": torch.tensor([0, -1, 2**31 - 1, -(2**31)], dtype=torch.int32),
        "short": torch.tensor([-32768, 32767], dtype=torch.int16),
        "char": torch.tensor([-128, 127], dtype=torch.int8),
        "byte": torch.tensor([0, 255], dtype=torch.uint8),
        "bool": torch.tensor([True, False, True]),
    }


def nested():
    tensor = torch.linspace(-1, 1, 5)
    counts = collections.defaultdict(list)
    counts["a"].append(tensor[1:])
    return collections.OrderedDict(
        version=3,
        huge=2**80,
        negative=-(2**40),
        rate=1e-3,
        done=True,
        nothing=None,
        raw=b"bytes",
        text="grüße",
        tags={"x", "y"},
        frozen=frozenset([1]),
        size=torch.Size([2, 3]),
        dtype=torch.float32,
        device=torch.device("cpu"),
        array=numpy.arange(4.0),
        scalar=numpy.float32(0.25),
        path=pathlib.PurePosixPath("runs/1"),
        options=argparse.Namespace(width=8, tensor=tensor),
        counter=collections.Counter("abca"),
        grouped=counts,
        by_number={0: tensor, -7: tensor * 2, (1, 2): tensor * 3, 2.5: tensor * 4, None: tensor * 5},
        deep=[{"a": (tensor * 6, [tensor * 7])}, "x", [], ()],
        **{"grüße": tensor * 8, "with.dot": {"": tensor * 9}},
    )


def attributes():
    parameter = nn.Parameter(torch.tensor([1.5, 2.5]))
    parameter.note = "kept by training"
    plain = torch.tensor([3.5, 4.5])
    plain.note = {"a": 1}
    return {"parameter": parameter, "plain": plain}


def main(folder):
    torch.manual_seed(4)
    folder.mkdir(parents=True, exist_ok=True)

    def save(name, value, refused=False, protocol=2):
        torch.save(value, folder / f"{name}.pth", pickle_protocol=protocol)
        stream = folder / f"{name}.legacy.pth"
        torch.save(value, stream, pickle_protocol=protocol, _use_new_zipfile_serialization=False)
        # a pickled module comes with the place of its source, which is nobody's business
        own = str(pathlib.Path(__file__).resolve()).encode()
        stream.write_bytes(stream.read_bytes().replace(own, pathlib.Path(__file__).name.encode().rjust(len(own), b"/")))
        if not refused:
            loaded = torch.load(folder / f"{name}.pth", weights_only=False)
            entries = {
                key: {"shape": list(t.shape), "values": [number(v) for v in t.detach().to(torch.float32).flatten().tolist()]}
                for key, t in flatten(loaded)
            }
            (folder / f"{name}.json").write_text(json.dumps(entries, indent=None, separators=(",", ":")) + "\n")

    save("siren", sine_layers().state_dict())

    decoder = nn.DataParallel(Decoder(nn.utils.weight_norm))
    save("deepsdf", {"epoch": 2000, "model_state_dict": decoder.state_dict()})
    decoder = Decoder(parametrized.weight_norm)
    optimizer = trained(decoder)
    save(
        "parametrized",
        {
            "epoch": 1,
            "model_state_dict": decoder.state_dict(),
            "optimizer_state_dict": optimizer.state_dict(),
            "loss": numpy.float64(0.5),
            "args": argparse.Namespace(lr=1e-3, out=pathlib.PosixPath("runs")),
        },
    )

    codes = nn.Embedding(5, 4)
    save("latent_embedding", {"epoch": 2000, "latent_codes": codes.state_dict()})
    save("latent_tensor", {"epoch": 2000, "latent_codes": torch.randn(5, 1, 4)})
    save("latent_code", torch.randn(1, 1, 4))

    save("views", views())
    save("types", types())
    save("nested", nested())
    save("attributes", attributes())
    for protocol in (3, 4, 5):
        save(f"protocol_{protocol}", {"net": nn.Linear(3, 2).state_dict(), "half": torch.tensor([0.5]).half()}, protocol=protocol)

    save("whole_module", Single(), refused=True)
    save("complex", {"spectrum": torch.tensor([1 + 2j])}, refused=True)


if __name__ == "__main__":
    main(pathlib.Path(sys.argv[1]))
