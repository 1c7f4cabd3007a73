"""Fits a tiny end-to-end network to masks and writes it as ONNX.

    train_network.py MASKS.npy OUT.onnx {fixed|free|outside|greedy|sly}

The network has a fixed or free image size, or has a fixed size and stores its weights in another file
(`outside`), or has an intermediate result of many gigabytes, always (`greedy`) or only for bright input
(`sly`).

The network is one convolution over the measurement divided by the masks' sum, and over that and the
measurement times each mask. Its weights are the least-squares solution over random scenes of squares
that move over ramps.
"""

import sys

import numpy as np
import onnx
from numpy.lib.stride_tricks import sliding_window_view
from onnx import TensorProto, helper, numpy_helper

SIDE = 5
FLOOR = 0.25


def scene(rng, frames, height, width):
    i, j = np.mgrid[:height, :width]
    slope = rng.uniform(-0.5, 0.5, 2)
    ground = rng.uniform(0.2, 0.6) + slope[0] * i / height / 2 + slope[1] * j / width / 2
    x = np.repeat(ground[None], frames, 0)
    for _ in range(rng.integers(1, 4)):
        side, value = rng.integers(8, 25), rng.uniform(0, 1)
        start, speed = rng.uniform(0, (height, width)), rng.uniform(-3, 3, 2)
        for k in range(frames):
            top, left = start + k * speed
            x[k][(i >= top) & (i < top + side) & (j >= left) & (j < left + side)] = value
    return x.clip(0, 1)


def features(y, masks):
    z = y / (masks.sum(0) + FLOOR)
    return np.concatenate([z[None], masks * z, masks * y])


def fit(masks, clips=40):
    rng = np.random.default_rng(1)
    frames, height, width = masks.shape
    pad = SIDE // 2
    gram = right = 0
    for _ in range(clips):
        x = scene(rng, frames, height, width)
        planes = np.pad(features((masks * x).sum(0), masks), ((0, 0), (pad, pad), (pad, pad)))
        windows = sliding_window_view(planes, (SIDE, SIDE), (1, 2))
        rows = windows.transpose(1, 2, 0, 3, 4).reshape(height * width, -1)
        rows = np.concatenate([rows, np.ones((len(rows), 1))], 1)
        gram = gram + rows.T @ rows
        right = right + rows.T @ x.reshape(frames, -1).T
    gram += 1e-4 * np.trace(gram) / len(gram) * np.eye(len(gram))
    solution = np.linalg.solve(gram, right)
    weights = solution[:-1].T.reshape(frames, 1 + 2 * frames, SIDE, SIDE)
    return weights.astype(np.float32), solution[-1].astype(np.float32)


def greedy(model, frames, height, width):
    """Computes the same frames through more copies than any machine can hold."""
    copies = 2**36 // (frames * height * width)
    graph, node = model.graph, helper.make_node
    graph.node[-1].output[0] = "once"
    shape = np.array([copies, frames, height, width])
    graph.initializer.append(numpy_helper.from_array(shape, "copies"))
    graph.node.append(node("Expand", ["once", "copies"], ["often"]))
    graph.node.append(node("ReduceMax", ["often"], ["frames"], axes=[0], keepdims=1))


def sly(model, frames, height, width):
    """Like `greedy`, but the number of copies grows with the brightness; a dark input has one."""
    copies = 2**33 // (4 * frames * height * width)
    graph, node = model.graph, helper.make_node
    graph.node[-1].output[0] = "once"
    for name, value in [
        ("copies", np.array(copies, np.float32)),
        ("one", np.array([1])),
        ("rest", np.array([frames, height, width])),
    ]:
        graph.initializer.append(numpy_helper.from_array(value, name))
    graph.node.extend([
        node("ReduceMax", ["measurement"], ["brightest"], keepdims=0),
        node("Mul", ["brightest", "copies"], ["wanted"]),
        node("Cast", ["wanted"], ["whole"], to=TensorProto.INT64),
        node("Reshape", ["whole", "one"], ["listed"]),
        node("Add", ["listed", "one"], ["some"]),
        node("Concat", ["some", "rest"], ["shape"], axis=0),
        node("Expand", ["once", "shape"], ["often"]),
        node("ReduceMax", ["often"], ["frames"], axes=[0], keepdims=1),
    ])


def network(weights, bias, size):
    frames = len(bias)
    value = lambda name, planes: helper.make_tensor_value_info(
        name, TensorProto.FLOAT, [1, planes, *size]
    )
    constants = [
        numpy_helper.from_array(np.array([1]), "axis"),
        numpy_helper.from_array(np.array([FLOOR], np.float32), "floor"),
        numpy_helper.from_array(weights, "weights"),
        numpy_helper.from_array(bias, "bias"),
    ]
    node = helper.make_node
    nodes = [
        node("ReduceSum", ["masks", "axis"], ["light"]),
        node("Add", ["light", "floor"], ["floored"]),
        node("Div", ["measurement", "floored"], ["z"]),
        node("Mul", ["masks", "z"], ["masked_z"]),
        node("Mul", ["masks", "measurement"], ["masked_y"]),
        node("Concat", ["z", "masked_z", "masked_y"], ["planes"], axis=1),
        node("Conv", ["planes", "weights", "bias"], ["frames"], pads=[SIDE // 2] * 4),
    ]
    inputs = [value("measurement", 1), value("masks", frames)]
    graph = helper.make_graph(nodes, "tiny", inputs, [value("frames", frames)], constants)
    opset = [helper.make_opsetid("", 17)]
    model = helper.make_model(graph, opset_imports=opset, ir_version=8)
    onnx.checker.check_model(model)
    return model


def main():
    masks_file, out, size = sys.argv[1:]
    masks = np.load(masks_file).astype(np.float64)
    weights, bias = fit(masks)
    sides = ("height", "width") if size == "free" else masks.shape[1:]
    model = network(weights, bias, sides)
    if size == "outside":
        stored = next(tensor for tensor in model.graph.initializer if tensor.name == "weights")
        length = len(stored.raw_data)
        stored.ClearField("raw_data")
        stored.data_location = TensorProto.EXTERNAL
        for key, value in [("location", "masks.npy"), ("offset", 0), ("length", length)]:
            stored.external_data.add(key=key, value=str(value))
    if size == "greedy":
        greedy(model, *masks.shape)
    if size == "sly":
        sly(model, *masks.shape)
    with open(out, "wb") as file:
        file.write(model.SerializeToString())


if __name__ == "__main__":
    main()
