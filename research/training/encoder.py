"""Write the encoder for the quality model: the encoding half of the first stage of an exported FastDVDnet.

    python encoder.py ../../models/fastdvdnet-gray ../../models/fastdvdnet-gray-encoder

The 128 channels of its deepest layers, at a quarter of the image's sides, are averaged over blocks of 16x16 pixels, and
the logarithm is taken. Nothing is trained.
"""
import argparse
import hashlib
import os

import numpy as np
import onnx

import export

CELLS = 4       # pixels of the deepest layers per side of a block
FLOOR = .02     # about a twentieth of the mean


def write(source, path):
    """The encoder of the exported network in the folder `source`."""
    block = export.weights_of(source).requires_grad_(False).t1
    g = export.Graph()
    *_, deepest = export.encoding_half(g, block)
    mean = g.add('AveragePool', deepest, kernel_shape=[CELLS] * 2, strides=[CELLS] * 2)
    encoded = g.add('Log', g.add('Add', mean, g.constant(np.array(FLOOR, np.float32))))
    g.save(path, encoded, ('frames_and_two', 'frames'), 'The encoding half of the first stage.', ('encoded', block.d1[-2].out_channels, 'rows', 'columns'))
    network = onnx.load(path)
    with open(os.path.join(source, export.STAGES[0]), 'rb') as f:   # a mark by which weights are recognised that do not belong to this encoder
        onnx.helper.set_model_props(network, {'source_sha256': hashlib.sha256(f.read()).hexdigest()})
    onnx.save(network, path)


def main():
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument('source', help='folder with the exported FastDVDnet')
    p.add_argument('folder')
    a = p.parse_args()
    os.makedirs(a.folder, exist_ok=True)
    write(a.source, os.path.join(a.folder, 'model.onnx'))


if __name__ == '__main__':
    main()
