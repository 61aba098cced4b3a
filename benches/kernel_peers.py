"""Microseconds per point of JAX (value and input gradient) and ONNX Runtime (value) on the networks of benches/kernels.rs, as far as they are installed."""

import time

try:
    import numpy as np
except ImportError:
    raise SystemExit("peers: numpy is not installed, nothing to compare with")

POINTS = 20_000
ROUNDS = 7
NETS = {
    "SIREN 4x256": ([256] * 4, "sin"),
    "DeepSDF 8x512": ([512] * 8, "relu"),
    "ELU 8x64": ([64] * 8, "elu"),
    "IDR 8x256": ([256] * 8, "softplus"),
}


def layers(widths, activation):
    random = np.random.default_rng(1)
    sizes = [3, *widths, 1]
    gain = 2.4 / 30 if activation == "sin" else 1.8
    return [
        ((random.uniform(-1, 1, (a, b)) * gain / np.sqrt(a)).astype(np.float32), random.uniform(-0.1, 0.1, b).astype(np.float32))
        for a, b in zip(sizes, sizes[1:])
    ]


def micros(work):
    work()
    best = float("inf")
    for _ in range(ROUNDS):
        start = time.perf_counter()
        work()
        best = min(best, time.perf_counter() - start)
    return best * 1e6 / POINTS


points = np.random.default_rng(0).uniform(-1, 1, (POINTS, 3)).astype(np.float32)

try:
    import jax
    import jax.numpy as jnp

    for name, (widths, activation) in NETS.items():
        stack = [(jnp.array(w), jnp.array(b)) for w, b in layers(widths, activation)]
        act = {
            "sin": lambda h: jnp.sin(30 * h),
            "relu": jax.nn.relu,
            "elu": jax.nn.elu,
            "softplus": lambda h: jax.nn.softplus(100 * h) / 100,
        }[activation]

        def value(point):
            for w, b in stack[:-1]:
                point = act(point @ w + b)
            w, b = stack[-1]
            return (point @ w + b)[0]

        both = jax.jit(jax.vmap(jax.value_and_grad(value)))
        there = jnp.array(points)
        print(f"JAX {jax.__version__}, value and gradient, {name}: {micros(lambda: jax.block_until_ready(both(there))):.2f} us/point", flush=True)
except ImportError:
    print("JAX is not installed")

try:
    import onnxruntime
    from onnx import TensorProto, helper, numpy_helper

    for name, (widths, activation) in NETS.items():
        nodes, constants, last = [], [], "x"

        def node(kind, inputs, output):
            nodes.append(helper.make_node(kind, inputs, [output]))
            return output

        def constant(value, called):
            constants.append(numpy_helper.from_array(np.asarray(value, np.float32), called))
            return called

        stack = layers(widths, activation)
        for i, (w, b) in enumerate(stack):
            last = node("Gemm", [last, constant(w, f"w{i}"), constant(b, f"b{i}")], f"g{i}")
            if i + 1 == len(stack):
                break
            if activation == "sin":
                last = node("Sin", [node("Mul", [last, constant(30, f"s{i}")], f"m{i}")], f"a{i}")
            elif activation == "softplus":
                soft = node("Softplus", [node("Mul", [last, constant(100, f"s{i}")], f"m{i}")], f"p{i}")
                last = node("Mul", [soft, constant(0.01, f"t{i}")], f"a{i}")
            else:
                last = node({"relu": "Relu", "elu": "Elu"}[activation], [last], f"a{i}")
        x = helper.make_tensor_value_info("x", TensorProto.FLOAT, ["n", 3])
        y = helper.make_tensor_value_info(last, TensorProto.FLOAT, ["n", 1])
        model = helper.make_model(helper.make_graph(nodes, "net", [x], [y], constants), opset_imports=[helper.make_opsetid("", 17)])
        model.ir_version = 9
        session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
        print(f"ONNX Runtime {onnxruntime.__version__}, value, {name}: {micros(lambda: session.run(None, {'x': points})):.2f} us/point", flush=True)
except ImportError:
    print("ONNX Runtime is not installed")
