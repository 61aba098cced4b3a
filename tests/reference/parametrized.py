"""PyTorch's newer weight norm, which keeps a weight as `parametrizations.weight.original0` (lengths) and `original1` (directions)."""

import torch
from torch import nn
from torch.nn.utils import parametrize


class _WeightNorm(nn.Module):
    def forward(self, length, direction):
        return length * direction / direction.norm(dim=1, keepdim=True)

    def right_inverse(self, weight):
        return weight.norm(dim=1, keepdim=True), weight


def weight_norm(layer):
    """PyTorch's own from 2.1 on; before, the same by hand, so that Debian's PyTorch writes the same names."""
    own = getattr(nn.utils.parametrizations, "weight_norm", None)
    if own is not None:
        return own(layer)
    parametrize.register_parametrization(layer, "weight", _WeightNorm())
    return layer
