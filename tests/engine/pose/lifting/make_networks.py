"""Make the tiny networks beside the tests; needs the extra `train`.

Run from the project folder: ``python tests/engine/pose/lifting/make_networks.py``.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from onnx import TensorProto, helper, numpy_helper

FOLDER = Path(__file__).with_name("data")
FLOAT, INT = TensorProto.FLOAT, TensorProto.INT64


def tensor(name, shape, kind=FLOAT):
    return helper.make_tensor_value_info(name, kind, shape)


def constant(name, values):
    return numpy_helper.from_array(np.array(values, dtype=np.int64), name)


def pick(source, start, stop, axis, out):
    """Return nodes and constants that take a slice."""
    names = [f"{out}_{part}" for part in ("start", "stop", "axis")]
    parts = [constant(n, [v]) for n, v in zip(names, (start, stop, axis), strict=True)]
    return helper.make_node("Slice", [source, *names], [out]), parts


def save(name, nodes, inputs, output, constants, opset=17):
    graph = helper.make_graph(nodes, name, inputs, [output], constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", opset)])
    model.ir_version = 8
    (FOLDER / f"{name}.onnx").write_bytes(model.SerializeToString())


def flat_lifter(name, frames, numbers, *, batch="batch", joints=17, middle=False):
    """Give x and y of the points, and 0 for the depth."""
    xy, parts = pick("points", 0, 2, 3, "xy")
    depth, more = pick("points", 0, 1, 3, "x")
    nodes = [xy, depth, helper.make_node("Sub", ["x", "x"], ["z"])]
    nodes.append(helper.make_node("Concat", ["xy", "z"], ["all" if middle else "joints"], axis=3))
    constants = parts + more
    if middle:
        node, cut = pick("all", frames // 2, frames // 2 + 1, 1, "joints")
        nodes, constants = [*nodes, node], [*constants, *cut]
    save(
        name,
        nodes,
        [tensor("points", [batch, frames, joints, numbers])],
        tensor("joints", [batch, 1 if middle else frames, joints, 3]),
        constants,
    )


def denoiser(name, frames, numbers):
    """Take x and y from the points and give no depth, whatever the noise."""
    xy, parts = pick("points", 0, 2, 3, "xy")
    depth, more = pick("noisy", 0, 1, 3, "x")
    nodes = [
        xy,
        depth,
        helper.make_node("Cast", ["step"], ["step_float"], to=FLOAT),
        helper.make_node("ReduceMax", ["step_float"], ["largest"], keepdims=0),
        helper.make_node("Sub", ["largest", "largest"], ["nothing"]),
        helper.make_node("Mul", ["x", "nothing"], ["z"]),
        helper.make_node("Concat", ["xy", "z"], ["joints"], axis=3),
    ]
    shape = ["batch", frames, 17]
    inputs = [tensor("points", [*shape, numbers]), tensor("noisy", [*shape, 3])]
    inputs.append(tensor("step", ["batch"], INT))
    save(name, nodes, inputs, tensor("joints", [*shape, 3]), parts + more)


def main():
    """Make them all."""
    FOLDER.mkdir(exist_ok=True)
    flat_lifter("lifter", 9, 3)
    flat_lifter("official_middle", 9, 2, middle=True)
    flat_lifter("official_all", 9, 2)
    denoiser("denoiser", 9, 3)
    denoiser("official_denoiser", 9, 2)
    flat_lifter("sixteen_joints", 9, 3, joints=16)
    flat_lifter("one_clip_only", 9, 3, batch=1)
    save(
        "too_new",
        [helper.make_node("Identity", ["points"], ["joints"])],
        [tensor("points", ["batch", 9, 17, 3])],
        tensor("joints", ["batch", 9, 17, 3]),
        [],
        opset=99,
    )


if __name__ == "__main__":
    main()
