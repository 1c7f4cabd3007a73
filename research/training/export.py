"""Write a trained model as ONNX and check it against PyTorch.

    python export.py run/full.pt ../../models/fastdvdnet-gray      # stage1.onnx, stage2.onnx
    python export.py run/ffdnet.pt ../../models/ffdnet-gray        # model.onnx
    python export.py run/loop.pt ../../models/fastdvdnet-gray run/mean       # the mean of two

The graphs are built node by node: they hold only what the runtime needs.
"""
import argparse
import os

import numpy as np
import onnx
import torch
from onnx import TensorProto, helper, numpy_helper

import model

OPSET = 17


class Graph:
    """Nodes and constants in the order of the calls; every method returns the name of its output."""

    def __init__(self):
        self.nodes, self.constants, self.count = [], [], 0

    def constant(self, value, name=None):
        name = name or f'c{len(self.constants)}'
        self.constants.append(numpy_helper.from_array(np.asarray(value, order='C'), name))
        return name

    def add(self, op, *inputs, **attributes):
        self.count += 1
        name = f'{op.lower()}{self.count}'
        self.nodes.append(helper.make_node(op, list(inputs), [name], name, **attributes))
        return name

    def conv(self, x, weight, bias, stride=1, relu=True):
        y = self.add('Conv', x, self.constant(weight), self.constant(bias), kernel_shape=[3, 3],
                     strides=[stride, stride], pads=[1, 1, 1, 1])
        return self.add('Relu', y) if relu else y

    def layer(self, x, module, relu=True, sign=1.):
        return self.conv(x, sign * module.weight.numpy(), sign * module.bias.numpy(), module.stride[0], relu)

    def sequence(self, x, modules):
        """Convolutions, each followed by its ReLU or pixel shuffle."""
        modules = list(modules)
        for m, after in zip(modules, modules[1:] + [None]):
            if isinstance(m, torch.nn.Conv2d):
                x = self.layer(x, m, relu=isinstance(after, torch.nn.ReLU))
            elif isinstance(m, torch.nn.PixelShuffle):
                x = self.add('DepthToSpace', x, blocksize=2, mode='CRD')
        return x

    def noise_map(self, x, sigma):
        """The scalar sigma as one channel of the size of x."""
        shape = self.add('Shape', x)
        size = self.add('Concat', self.add('Slice', shape, *map(self.ints, ([0], [1]))), self.ints([1]),
                        self.add('Slice', shape, *map(self.ints, ([2], [4]))), axis=0)
        return self.add('Expand', sigma, size)

    def ints(self, values):
        return self.constant(np.array(values, np.int64))

    def save(self, path, result, axes, notes, output=('denoised', 1, 'height', 'width')):
        name, *sides = output
        self.nodes.append(helper.make_node('Identity', [result], [name]))
        frames, denoised = axes
        graph = helper.make_graph(
            self.nodes, 'denoiser',
            [helper.make_tensor_value_info('frames', TensorProto.FLOAT, [frames, 1, 'height', 'width']),
             helper.make_tensor_value_info('sigma', TensorProto.FLOAT, [])],
            [helper.make_tensor_value_info(name, TensorProto.FLOAT, [denoised, *sides])],
            self.constants)
        m = helper.make_model(graph, opset_imports=[helper.make_opsetid('', OPSET)], ir_version=8, producer_name='sci-recon training')
        m.doc_string = notes
        onnx.checker.check_model(m, full_check=True)
        onnx.save(m, path)


def padded_to_16(weight, bias, following):
    """Zero channels up to a multiple of 16 between two layers: the runtime's blocked kernels want whole blocks."""
    extra = -len(weight) % 16
    return (np.pad(weight, ((0, extra), (0, 0), (0, 0), (0, 0))), np.pad(bias, (0, extra)),
            np.pad(following, ((0, 0), (0, extra), (0, 0), (0, 0))))


def encoding_half(g, block):
    """The middle frames of all triplets of frames [n+2,1,H,W] and sigma, and the features of a block at each of its
    three scales."""
    last = np.iinfo(np.int64).max
    f = [g.add('Slice', 'frames', g.ints([start]), g.ints([end]), g.ints([0])) for start, end in ((0, -2), (1, -1), (2, last))]
    x = g.add('Concat', *f, g.noise_map(f[1], 'sigma'), axis=1)
    first, second = block.inc[0], block.inc[2]
    w, b, w2 = padded_to_16(first.dense().numpy(), first.bias.numpy(), second.weight.numpy())
    x0 = g.conv(g.conv(x, w, b), w2, second.bias.numpy())
    x1 = g.sequence(x0, block.d0)
    return f[1], x0, x1, g.sequence(x1, block.d1)


def block_graph(block):
    """One block over a clip: frames [n+2,1,H,W] and sigma -> the middle frames of all triplets, [n,1,H,W]."""
    g = Graph()
    middle, x0, x1, x2 = encoding_half(g, block)
    x1 = g.add('Add', g.sequence(x2, block.u2), x1)
    x0 = g.add('Add', g.sequence(x1, block.u1), x0)
    # The network predicts the noise. With the sign in the last weights, the residual is an addition, which runtimes
    # fuse.
    y = g.layer(g.layer(x0, block.out[0]), block.out[2], relu=False, sign=-1.)
    return g, g.add('Add', y, middle)


def ffdnet_graph(net):
    """frames [n,1,H,W] and sigma -> [n,1,H,W]."""
    g = Graph()
    half = g.add('SpaceToDepth', 'frames', blocksize=2)   # one channel: the same order as PyTorch's pixel_unshuffle
    x = g.add('Concat', half, g.noise_map(half, 'sigma'), axis=1)
    layers = list(net.body)
    x = g.sequence(x, layers[:-1])
    y = g.add('DepthToSpace', g.layer(x, layers[-1], relu=False, sign=-1.), blocksize=2, mode='CRD')
    return g, g.add('Add', y, 'frames')


def weights_of(folder):
    """The model of exported graphs, from which training can continue."""
    def layers(name):
        graph = onnx.load(os.path.join(folder, name)).graph
        constants = {c.name: numpy_helper.to_array(c).copy() for c in graph.initializer}
        return [(constants[n.input[1]], constants[n.input[2]]) for n in graph.node if n.op_type == 'Conv']

    def fill(module, pairs):
        convs = [m for m in module.modules() if isinstance(m, torch.nn.Conv2d)]
        pairs[-1] = tuple(-a for a in pairs[-1])   # the exporter moved the residual's sign into the last layer
        for m, (weight, bias) in zip(convs, pairs, strict=True):
            m.load_state_dict({'weight': torch.from_numpy(weight), 'bias': torch.from_numpy(bias)})

    if os.path.exists(os.path.join(folder, 'model.onnx')):
        net = model.FFDNet()
        fill(net, layers('model.onnx'))
        return net
    net = model.FastDVDnet()
    for block, name in zip((net.t1, net.t2), STAGES):
        pairs = layers(name)
        (dense, bias), (second, second_bias) = pairs[:2]
        dense = dense[:90].reshape(3, 30, 4, 3, 3)
        grouped = np.stack([dense[k][:, [k, 3]] for k in range(3)]).reshape(90, 2, 3, 3)
        pairs[:2] = [(grouped, bias[:90]), (np.ascontiguousarray(second[:, :90]), second_bias)]
        fill(block, pairs)
    return net.eval()


def session(path, threads=1):
    import onnxruntime as ort
    o = ort.SessionOptions()
    o.intra_op_num_threads = threads
    return ort.InferenceSession(path, o, providers=['CPUExecutionProvider'])


STAGES = 'stage1.onnx', 'stage2.onnx'


class Exported:
    """A FastDVDnet computed by its ONNX files; `seen` collects the inputs of each file."""

    def __init__(self, folder, seen=None):
        self.stages = [session(os.path.join(folder, name)) for name in STAGES]
        self.seen = seen

    def clips(self, x, sigma):
        """A clip x [1,B,H,W] and sigma [1,1,1,1] -> [1,B,H,W]."""
        b, level = x.shape[1], sigma.numpy().reshape(())
        frames = x[0, [2, 1, *range(b), b - 2, b - 3], None].numpy()
        for k, stage in enumerate(self.stages):
            inputs = {'frames': frames, 'sigma': level}
            if self.seen is not None:
                self.seen[k].append(inputs)
            frames = stage.run(None, inputs)[0]
        return torch.from_numpy(frames[None, :, 0])


@torch.no_grad()
def export(net, folder, notes=''):
    """Write the graphs and return the greatest difference from PyTorch over clips of several sizes and lengths."""
    os.makedirs(folder, exist_ok=True)
    path = lambda name: os.path.join(folder, name)
    if isinstance(net, model.FFDNet):
        g, y = ffdnet_graph(net)
        g.save(path('model.onnx'), y, ('frames', 'frames'), notes)
    else:
        for name, block in zip(STAGES, (net.t1, net.t2)):
            g, y = block_graph(block)
            g.save(path(name), y, ('frames_and_two', 'frames'), notes)
    worst = 0.
    for b, h, w, sigma in ((3, 32, 48, 50 / 255), (8, 64, 64, 6 / 255), (10, 36, 20, 100 / 255)):
        x = torch.rand(1, b, h, w, generator=torch.Generator().manual_seed(b))
        level = torch.full((1, 1, 1, 1), sigma)
        if isinstance(net, model.FFDNet):
            frames = session(path('model.onnx')).run(None, {'frames': x[0, :, None].numpy(), 'sigma': np.array(sigma, np.float32)})[0]
            got = torch.from_numpy(frames[None, :, 0])
        else:
            got = Exported(folder).clips(x, level)
        worst = max(worst, float((got - net.clips(x, level)).abs().max()))
    return worst


def load(path):
    """The network of a checkpoint, or of a folder with exported ONNX files."""
    return weights_of(path) if os.path.isdir(path) else model.load(path)


def mean(nets):
    """The network with the mean of these networks' weights. Runs from the same initial weights end in one valley, and
    their mean has less of the noise of small batches than each of them (Wortsman and others, "Model soups", 2022)."""
    states = [net.state_dict() for net in nets]
    nets[0].load_state_dict({k: sum(state[k] for state in states) / len(states) for k in states[0]})
    return nets[0]


def main():
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument('weights', nargs='+', help='a checkpoint or a folder with exported ONNX files; of several, the mean of their weights')
    p.add_argument('folder')
    a = p.parse_args()
    worst = export(mean([load(path) for path in a.weights]), a.folder)
    print(f'greatest difference from PyTorch: {worst:.1e}')
    if worst > 1e-5:
        raise SystemExit('the ONNX graph does not compute what PyTorch does')


if __name__ == '__main__':
    main()
