"""Evaluates ONNX models at many points with the reference evaluator of the `onnx` package, for `src/field/network/onnx/tests.rs`.

    pip install onnx numpy
    python tests/reference/evaluate_onnx.py tests/fixtures/networks/onnx OUT 1000
    SHRINKD_ONNX=OUT cargo test --release --lib onnx -- --nocapture values_and_gradients

For every model of the first folder, OUT gets a `NAME.json` with the values and the gradients at so many points.
The evaluator runs the graph with every single-precision type in it made double. It has no derivatives: gradients are
differences over four places an axis (error of the fourth order), taken with two steps. Left out are points at which the two do
not agree to 1e-7 (there is the kink of a ReLU within the step, or of an ELU's slope, and single precision may be on either side
of it), and points at which the evaluator's own single precision is off by 3e-5; how many they are is printed.
"""

import json
import sys
from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper
from onnx.reference import ReferenceEvaluator

SINGLE, DOUBLE = TensorProto.FLOAT, TensorProto.DOUBLE
STEP = 1e-4
AGREEMENT = 1e-7
ROUNDING = 3e-5
# values this much smaller than the largest count as that large, as in the test
SMALL = 2e-2


def doubled(tensor):
    """The tensor with doubles in place of single-precision numbers."""
    if tensor.data_type == SINGLE:
        tensor.CopyFrom(numpy_helper.from_array(numpy_helper.to_array(tensor).astype(np.float64), tensor.name))


def in_double_precision(model):
    graph = model.graph
    del graph.value_info[:]
    for value in [*graph.input, *graph.output]:
        if value.type.tensor_type.elem_type == SINGLE:
            value.type.tensor_type.elem_type = DOUBLE
    for tensor in graph.initializer:
        doubled(tensor)
    for node in graph.node:
        for attribute in node.attribute:
            if attribute.type == onnx.AttributeProto.TENSOR:
                doubled(attribute.t)
            if node.op_type == "Cast" and attribute.name == "to" and attribute.i == SINGLE:
                attribute.i = DOUBLE
            if node.op_type == "Constant" and attribute.name in ("value_float", "value_floats"):
                numbers = attribute.f if attribute.name == "value_float" else list(attribute.floats)
                attribute.CopyFrom(helper.make_attribute("value", numpy_helper.from_array(np.array(numbers, np.float64))))
    return model


def function_of(model, latent, kind):
    """The values of the model at points [n, 3], for one latent code, in numbers of a kind."""
    evaluator = ReferenceEvaluator(model)
    inputs = model.graph.input

    def values(points):
        n = len(points)
        given = {}
        for value in inputs:
            shape = value.type.tensor_type.shape.dim
            width, fixed = shape[-1].dim_value, shape[0].dim_value
            if width == 3:
                rows = points
            elif width == len(latent):
                rows = np.tile(latent, (1 if fixed == 1 else n, 1))
            else:
                rows = np.concatenate([np.tile(latent, (n, 1)), points], 1)
            given[value.name] = (rows[None] if len(shape) == 3 else rows).astype(kind)
        (found,) = evaluator.run(None, given)
        assert found.dtype == kind, found.dtype
        return found.reshape(-1).astype(np.float64)

    return values


def gradients(values, points, step):
    columns = []
    for axis in np.eye(3):
        at = lambda k: values(points + k * step * axis)
        columns.append((8 * (at(1) - at(-1)) - (at(2) - at(-2))) / (12 * step))
    return np.stack(columns, 1)


def main():
    source, out, count = Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3])
    out.mkdir(parents=True, exist_ok=True)
    for path in sorted(source.glob("*.onnx")):
        latent = np.array(json.loads(path.with_suffix(".json").read_text())["latent"])
        single = function_of(onnx.load(path), latent, np.float32)
        values = function_of(in_double_precision(onnx.load(path)), latent, np.float64)
        generator = np.random.default_rng(len(path.stem))
        kept, at_kinks, rounded = np.empty((0, 3)), 0, 0
        while len(kept) < count:
            points = generator.uniform(-1, 1, (count, 3)).astype(np.float32).astype(np.float64)
            fine, coarse = gradients(values, points, STEP / 2), gradients(values, points, STEP)
            agree = np.linalg.norm(fine - coarse, axis=1) <= AGREEMENT * np.linalg.norm(fine, axis=1)
            exact = values(points)
            size = np.maximum(np.abs(exact), SMALL * np.abs(exact).max())
            is_exact = np.abs(single(points) - exact) <= ROUNDING * size
            good = agree & is_exact
            missing = count - len(kept)
            tried = slice(0, np.searchsorted(np.cumsum(good), missing) + 1)
            at_kinks += int((~agree[tried]).sum())
            rounded += int((agree & ~is_exact)[tried].sum())
            kept = np.concatenate([kept, points[good][:missing]])
        document = {
            "latent": latent.tolist(),
            "points": kept.tolist(),
            "values": values(kept).tolist(),
            "gradients": gradients(values, kept, STEP / 2).tolist(),
        }
        (out / f"{path.stem}.json").write_text(json.dumps(document) + "\n")
        print(f"{path.stem}: left out {at_kinks} at kinks, {rounded} that single precision rounds")


if __name__ == "__main__":
    main()
