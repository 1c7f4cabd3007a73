"""Judge a model on held-out footage, as a white-noise denoiser and inside the solver's loop.

    python evaluate.py --data DATA run/loop.pt [more.pt ...] [--scene scene.mat]

Prints one JSON object per model: mean PSNR (dB) of the middle frame per sigma, and in the loop the mean PSNR of the
clip after TV and after the deep passes.
"""
import argparse
import json

import numpy as np
import torch

import export
import model
import solver
from data import Footage


def psnr(x, truth):
    """Mean over frames of each frame's PSNR; tensors [...,H,W] on [0,1]."""
    return float((-10 * ((x - truth) ** 2).mean((-2, -1)).log10()).mean())


@torch.no_grad()
def white(net, root, device='cpu', count=32, size=96):
    frames = 3 if isinstance(net, model.Block) else 5
    clips = torch.from_numpy(Footage(root, 'val', 7).batch(count, frames, size))
    noise = torch.randn(clips.shape, generator=torch.Generator().manual_seed(3))
    middle, rows = clips[:, frames // 2:frames // 2 + 1], {}
    for s in (10, 25, 50):
        x = (clips + noise * s / 255).to(device)
        rows[f'sigma {s}'] = round(psnr(denoise(net, x, torch.full((count, 1, 1, 1), s / 255, device=device)).cpu().clamp(0, 1), middle), 3)
    return rows


def denoise(net, x, sigma):
    """The middle frames of x [N,F,H,W]."""
    if isinstance(net, model.FastDVDnet):
        return net(x, sigma)
    if isinstance(net, model.FFDNet):
        return net(x[:, x.shape[1] // 2][:, None], sigma)
    return net(*x.split(1, 1), sigma.expand(len(x), 1, *x.shape[2:]))


def scene_crop(path, size=128):
    """The first snapshot of a .mat scene (meas, mask, orig; 0 to 255), cropped at its centre: truth and masks
    [1,B,size,size]."""
    import scipy.io
    m = scipy.io.loadmat(path)
    masks, truth = (m[k].astype(np.float32).transpose(2, 0, 1) for k in ('mask', 'orig'))
    top, left = ((extent - size) // 2 for extent in masks.shape[1:])
    cut = lambda a: torch.from_numpy(a[None, :len(masks), top:top + size, left:left + size].copy())
    return cut(truth) / 255, cut(masks)


class LoopScenes:
    """Fixed held-out snapshots with their TV start, which is independent of the network and computed once."""

    def __init__(self, root, scene=None, size=96, device='cpu'):
        val, r = Footage(root, 'val', 11, video=1.), np.random.default_rng(5)
        truths = [torch.from_numpy(val.batch(1, 8, size)) for _ in range(2)]
        cases = [(f'val{i} {kind}', x, torch.from_numpy(solver.draw_masks(r, kind, 8, size)[None]))
                 for i, x in enumerate(truths) for kind in ('iid', 'squares')]
        if scene:
            x, masks = scene_crop(scene)
            hca = torch.from_numpy(solver.draw_masks(r, 'squares', *masks.shape[1:3])[None])
            cases += [('scene own masks', x, masks), ('scene squares', x, hca)]
        self.cases = []
        for name, x, masks in cases:
            x, masks = x.to(device), masks.to(device)
            self.cases.append((name, x, *solver.start(solver.measure(x, masks), masks)))

    def tv(self):
        return {name: round(psnr(v, x), 2) for name, x, gap, v in self.cases}

    def run(self, net, sigmas, tv_weight=0., memory=1.):
        """PSNR after the last pass."""
        rows = {}
        for name, x, gap, v in self.cases:
            again = solver.Gap(gap.y, gap.masks, memory)
            again.excess = gap.excess
            for y in solver.passes(again, v, net, sigmas, tv_weight):
                pass
            rows[name] = round(psnr(y, x), 2)
        rows['mean'] = round(sum(rows.values()) / len(rows), 3)
        return rows


def main():
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument('weights', nargs='+', help='checkpoints or folders with exported ONNX files')
    p.add_argument('--data', required=True)
    p.add_argument('--scene', help='a .mat scene as one more held-out clip')
    p.add_argument('--passes', type=int, default=12)
    p.add_argument('--first', type=float, default=20, help='first sigma (/255)')
    p.add_argument('--last', type=float, default=6, help='last sigma (/255)')
    p.add_argument('--tv-weight', type=float, default=0, help='TV before each deep pass')
    p.add_argument('--memory', type=float, default=.7, help='of the accumulated residual in the deep passes: 1 accelerated, 0 plain GAP')
    p.add_argument('--size', type=int, default=96, help='sides of the held-out clips, in pixels')
    p.add_argument('--no-white', action='store_true')
    a = p.parse_args()
    scenes = LoopScenes(a.data, a.scene, a.size)
    print(json.dumps({'model': 'tv', 'loop': scenes.tv()}), flush=True)
    for path in a.weights:
        net = export.load(path)
        row = {'model': path} if a.no_white else {'model': path, 'white': white(net, a.data, size=a.size)}
        if not isinstance(net, model.Block):
            row['loop'] = scenes.run(net, solver.geometric(a.first, a.last, a.passes), a.tv_weight, a.memory)
        print(json.dumps(row), flush=True)


if __name__ == '__main__':
    main()
