"""Train an end-to-end network for the masks of one calibration, for the algorithm `learned`.

    python calibrated.py --masks masks.npy --data DATA --out run/bench3 --minutes 480
    python calibrated.py --masks scene.mat --scene scene.mat --data DATA --out run/scene --minutes 480

The folder --out gets `network.onnx` with its model card `README.md`, the validation curve `curve.csv`, and
`checkpoint.pt`, from which the same command continues. It is written every minute, and when the command is interrupted.
--minutes counts the training time of all runs. --masks is npy [frame, row, column] on [0,1], or a .mat scene with `mask`
[row, column, frame]. --scene is a .mat scene behind these masks that is evaluated too.
"""
import argparse
import csv
import math
import os
import signal
import sys
import time

import numpy as np
import torch
import torch.nn as nn
import torch.nn.functional as F

import export
import train
from data import Footage
from evaluate import psnr
from model import conv

NOISE = .4, 10 / 255   # share of noisy measurements, and their largest sigma
PAUSE = 60             # seconds between two checkpoints, and between two lines of progress


class Residual(nn.Module):
    def __init__(self, width):
        super().__init__()
        self.first, self.second = conv(width, width), conv(width, width)

    def forward(self, x):
        return x + self.second(F.relu(self.first(x)))


class Prior(nn.Module):
    """A small U-Net over all frames at half and a quarter of the resolution. It takes projected frames, the mean
    picture and the features of the stage before, and returns corrected frames and its features."""

    def __init__(self, frames, width, first):
        super().__init__()
        self.enter = conv(4 * (frames + 1) + (0 if first else width), width)
        self.fine = nn.Sequential(Residual(width), Residual(width))
        self.down = conv(width, 2 * width, 2)
        self.coarse = nn.Sequential(*(Residual(2 * width) for _ in range(3)))
        self.up = conv(2 * width, 4 * width)
        self.last = Residual(width)
        self.leave = conv(width, 4 * frames)
        nn.init.zeros_(self.leave.weight)
        nn.init.zeros_(self.leave.bias)

    def forward(self, x, mean, features):
        half = F.pixel_unshuffle(torch.cat((x, mean), 1), 2)
        inputs = half if features is None else torch.cat((half, features), 1)
        fine = self.fine(F.relu(self.enter(inputs)))
        coarse = self.coarse(F.relu(self.down(fine)))
        features = self.last(fine + F.pixel_shuffle(self.up(coarse), 2))
        return x + F.pixel_shuffle(self.leave(features), 2), features


class Unfolded(nn.Module):
    """Generalised alternating projection with a trained prior in each of a few iterations: measurement [N,1,H,W] and
    masks [N,B,H,W] -> frames [N,B,H,W]. Each iteration projects with a trained step (Meng, Jalali and Yuan, GAP-net,
    2020), and passes its features on. Height and width are padded to multiples of 4."""

    def __init__(self, frames, stages=5, width=48):
        super().__init__()
        self.priors = nn.ModuleList(Prior(frames, width, first=k == 0) for k in range(stages))
        self.steps = nn.Parameter(torch.ones(stages))

    def forward(self, measurement, masks):
        height, width = measurement.shape[-2:]
        pads = (0, -width % 4, 0, -height % 4)
        return self.estimates(F.pad(measurement, pads, 'replicate'), F.pad(masks, pads, 'replicate'))[-1][..., :height, :width]

    def estimates(self, y, masks):
        """The frames after each iteration."""
        gram = (masks * masks).sum(1, keepdim=True).clamp_min(1e-3)
        mean = y / masks.sum(1, keepdim=True).clamp_min(1e-2)
        x, features, estimates = mean.expand_as(masks), None, []
        for prior, step in zip(self.priors, self.steps.unbind()):
            x = x + step * masks * ((y - (masks * x).sum(1, keepdim=True)) / gram)
            x, features = prior(x, mean, features)
            estimates.append(x)
        return estimates


def read_masks(path):
    if path.endswith('.mat'):
        import scipy.io
        masks = scipy.io.loadmat(path)['mask'].transpose(2, 0, 1)
    else:
        masks = np.load(path)
        if not isinstance(masks, np.ndarray):
            raise SystemExit(f'{path} has several arrays: save the masks alone with numpy.save')
    masks = masks.astype(np.float32)
    if masks.ndim != 3 or masks.min() < 0 or masks.max() > 1:
        raise SystemExit(f'{path}: the masks must be [frame, row, column] on [0,1], not {masks.shape} '
                         f'with values from {masks.min()} to {masks.max()}')
    return np.ascontiguousarray(masks)


def read_scene(path, masks):
    """The first snapshot of a .mat scene (`orig` and `meas`, 0 to 255): truth [1,B,H,W] and measurement [1,1,H,W]."""
    import scipy.io
    m = scipy.io.loadmat(path)
    truth = m['orig'].astype(np.float32).transpose(2, 0, 1)[None, :len(masks)] / 255
    if truth.shape[1:] != masks.shape:
        raise SystemExit(f'{path}: frames of {truth.shape[1:]} do not fit masks of {masks.shape}')
    return torch.from_numpy(truth), torch.from_numpy(m['meas'].astype(np.float32)[None, None, ..., 0] / 255)


def produce(queue, root, seed, masks, clips, size):
    """Clips [N,B,size,size] with a window of the masks for each, and their measurements [N,1,size,size]."""
    footage, r = Footage(root, 'train', seed), np.random.default_rng(seed)
    while True:
        x = footage.batch(clips, len(masks), size)
        # Windows begin in even rows and columns, since the prior works on cells of 2x2 pixels.
        corners = [[2 * int(r.integers(0, (side - size) // 2 + 1)) for side in masks.shape[1:]] for _ in x]
        windows = np.stack([masks[:, top:top + size, left:left + size] for top, left in corners])
        sigma = np.where(r.random(clips) < NOISE[0], r.uniform(0, NOISE[1], clips), 0)[:, None, None, None]
        y = (x * windows).sum(1, keepdims=True) + r.normal(0, 1, (clips, 1, size, size)) * sigma
        queue.put((x, windows, y.astype(np.float32)))


class Validation:
    """Held-out clips behind the centre of the masks without noise, and the scene if there is one."""

    def __init__(self, root, masks, scene, count=8, size=128):
        size = min(size, *(side // 4 * 4 for side in masks.shape[1:]))
        top, left = ((side - size) // 4 * 2 for side in masks.shape[1:])
        self.truth = torch.from_numpy(Footage(root, 'val', 7).batch(count, len(masks), size))
        self.masks = torch.from_numpy(masks[None, :, top:top + size, left:left + size].copy())
        self.scene = (*read_scene(scene, masks), torch.from_numpy(masks[None])) if scene else None

    @torch.no_grad()
    def row(self, net, device):
        frames = lambda y, masks: net(y.to(device), masks.to(device)).cpu().clamp(0, 1)
        row = {'validation_db': round(float(np.mean([psnr(frames((x * self.masks).sum(1, keepdim=True), self.masks), x)
                                               for x in self.truth.split(1)])), 2)}
        if self.scene:
            truth, y, masks = self.scene
            row['scene_db'] = round(psnr(frames(y, masks), truth), 2)
        return row


class Training:
    def __init__(self, a, masks, device):
        self.a, self.device, self.path = a, device, os.path.join(a.out, 'checkpoint.pt')
        self.shape = {'frames': len(masks), 'stages': a.stages, 'width': a.width}
        self.step, self.seconds, self.curve = 0, 0., []
        state = torch.load(self.path, map_location='cpu', weights_only=True) if os.path.exists(self.path) else None
        if state and state['shape'] != self.shape:
            raise SystemExit(f'{self.path} has {state["shape"]}, not {self.shape}: choose another --out')
        self.net = Unfolded(**self.shape)
        if state:
            self.net.load_state_dict(state['net'])
        self.net = self.net.to(device, memory_format=torch.channels_last)
        self.average = {k: v.clone() for k, v in self.net.state_dict().items()}
        self.optimizers = train.optimizers(self.net, a.lr, device)
        if state:
            self.average = {k: v.to(device) for k, v in state['average'].items()}
            for optimizer, saved in zip(self.optimizers, state['optimizers']):
                optimizer.load_state_dict(saved)
            self.step, self.seconds, self.curve = state['step'], state['seconds'], state['curve']
            print(f'continues from step {self.step}, after {self.seconds / 60:.1f} minutes', flush=True)

    def save(self):
        state = {'shape': self.shape, 'net': self.net.state_dict(), 'average': self.average, 'step': self.step,
                 'optimizers': [o.state_dict() for o in self.optimizers], 'seconds': self.seconds, 'curve': self.curve}
        torch.save(state, self.path + '.part')
        os.replace(self.path + '.part', self.path)   # an interrupted save leaves the old checkpoint intact

    def learn(self, x, masks, y):
        """One step; returns the root mean square error of the last iteration."""
        x, masks, y = (torch.from_numpy(part).to(self.device, non_blocking=True) for part in (x, masks, y))
        with torch.autocast(self.device, torch.bfloat16, enabled=self.device == 'cuda'):
            errors = [train.rms_error(estimate, x) for estimate in self.net.estimates(y, masks)]
        # The earlier iterations count half of the one after each.
        sum(error * .5 ** k for k, error in enumerate(reversed(errors))).backward()
        progress = min(1., self.seconds / (60 * self.a.minutes))
        lr = self.a.lr * min(1, (self.step + 1) / 200) * (.5 * (1 + math.cos(math.pi * progress)) * .98 + .02)
        for optimizer in self.optimizers:
            for group in optimizer.param_groups:
                group['lr'] = lr * group['share']
        if torch.isfinite(torch.nn.utils.clip_grad_norm_(self.net.parameters(), 1.)):
            for optimizer in self.optimizers:
                optimizer.step()
            keep = min(.998, self.step / (self.step + 10))
            with torch.no_grad():
                torch._foreach_lerp_(list(self.average.values()), list(self.net.state_dict().values()), 1 - keep)
        self.net.zero_grad(set_to_none=True)
        self.step += 1
        return float(errors[-1].detach())

    def averaged(self):
        net = Unfolded(**self.shape)
        net.load_state_dict(self.average)
        return net.to(self.device).eval()

    def evaluate(self, validation):
        self.save()
        if self.curve and self.curve[-1]['step'] == self.step:
            return
        row = {'minutes': round(self.seconds / 60, 1), 'step': self.step, **validation.row(self.averaged(), self.device)}
        self.curve.append(row)
        print(' '.join(f'{name} {value}' for name, value in row.items()), flush=True)
        self.save()
        with open(os.path.join(self.a.out, 'curve.csv'), 'w', newline='', encoding='utf8') as f:
            table = csv.DictWriter(f, list(row))
            table.writeheader()
            table.writerows(self.curve)


def write_network(net, path):
    """Write the ONNX file, and return the greatest difference from PyTorch."""
    frames = net.priors[0].leave.out_channels // 4
    y, masks = torch.rand(1, 1, 32, 40), torch.rand(1, frames, 32, 40)
    sides = {2: 'height', 3: 'width'}
    torch.onnx.export(net, (y, masks), path, dynamo=False, opset_version=export.OPSET, input_names=['measurement', 'masks'],
                      output_names=['frames'], dynamic_axes={'measurement': sides, 'masks': sides, 'frames': sides})
    worst = 0.
    for height, width in (32, 40), (30, 37):
        y, masks = torch.rand(1, 1, height, width), torch.rand(1, frames, height, width)
        got = export.session(path).run(None, {'measurement': y.numpy(), 'masks': masks.numpy()})[0]
        with torch.no_grad():
            worst = max(worst, float((torch.from_numpy(got) - net(y, masks)).abs().max()))
    return worst


CARD = """# {name}

An end-to-end network for one set of masks ({frames} frames of {height}x{width} pixels), for `sci-recon reconstruct --algorithm learned`.
Generalised alternating projection, unfolded into {stages} iterations with a trained U-Net in each (GAP-net, Meng, Jalali and Yuan
2020); {parameters:,} parameters. Training command:

    {command}

{steps} steps of {clips} clips of {crop}x{crop} pixels in {minutes:.0f} minutes on {machine}; {share:.0%} of the measurements with noise of
up to sigma {sigma:.0f} (/255). The footage is listed in `INDEX.tsv` of the data folder.

PSNR in dB on held-out clips without noise behind the centre of the masks, and on the scene if one was named:

{curve}

Sides are free. Behind other masks, and far from the footage's contrast and noise, expect less: compare with `pnp-tv-fastdvdnet`.
"""


def write_card(t, masks):
    columns = list(t.curve[-1])
    rows = t.curve[::max(1, len(t.curve) // 12)]
    rows = rows if rows[-1] is t.curve[-1] else [*rows, t.curve[-1]]
    table = '\n'.join('| ' + ' | '.join(str(cell) for cell in line) + ' |'
                      for line in [columns, ['---'] * len(columns), *([row.get(c, '') for c in columns] for row in rows)])
    a, (frames, height, width) = t.a, masks.shape
    command = (f'python calibrated.py --masks {os.path.basename(a.masks)} --data DATA --out {os.path.basename(a.out)} --minutes {a.minutes:g} '
               f'--stages {a.stages} --width {a.width} --clips {a.clips} --crop {a.crop} --lr {a.lr:g}')
    machine = torch.cuda.get_device_name() if t.device == 'cuda' else f'{a.threads} threads of a CPU'
    with open(os.path.join(a.out, 'README.md'), 'w', encoding='utf8') as f:
        f.write(CARD.format(name=os.path.basename(os.path.abspath(a.out)), frames=frames, height=height, width=width, stages=a.stages,
                            parameters=sum(p.numel() for p in t.net.parameters()), command=command, steps=t.step, clips=a.clips,
                            crop=a.crop, minutes=t.seconds / 60, machine=machine, share=NOISE[0], sigma=NOISE[1] * 255, curve=table))


def main():
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument('--masks', required=True)
    p.add_argument('--data', required=True, help='data folder of pack.py')
    p.add_argument('--out', required=True, help='folder for checkpoint, curve, network and model card')
    p.add_argument('--scene', help='a .mat scene behind these masks that is evaluated too')
    p.add_argument('--minutes', type=float, default=480, help='training time over all runs; the learning rate falls to its end')
    p.add_argument('--run-minutes', type=float, default=math.inf, help='stop this run after so many minutes')
    p.add_argument('--steps', type=int, default=0, help='stop this run after so many steps')
    p.add_argument('--every', type=float, default=10, help='minutes between evaluations')
    p.add_argument('--stages', type=int, default=5, help='iterations of the network')
    p.add_argument('--width', type=int, default=48, help='channels at half the resolution')
    p.add_argument('--clips', type=int, default=0, help='clips per step (default: 4 on a CPU, 32 on a GPU)')
    p.add_argument('--crop', type=int, default=64, help='sides of the training clips, a multiple of 4')
    p.add_argument('--lr', type=float, default=2e-3)
    p.add_argument('--workers', type=int, default=1, help='processes that simulate measurements')
    p.add_argument('--threads', type=int, default=os.cpu_count())
    a = p.parse_args()
    device = 'cuda' if torch.cuda.is_available() else 'cpu'
    a.clips = a.clips or (32 if device == 'cuda' else 4)
    torch.set_num_threads(a.threads)
    os.makedirs(a.out, exist_ok=True)
    masks = read_masks(a.masks)
    if a.crop % 4 or a.crop > min(masks.shape[1:]):
        p.error(f'--crop {a.crop}: give a multiple of 4 up to the sides of the masks, {masks.shape[1]}x{masks.shape[2]}')

    if not os.path.exists(os.path.join(a.data, 'INDEX.tsv')):
        p.error(f'--data {a.data}: the folder has no INDEX.tsv; make it with pack.py')
    # Producers end with this process. An interruption is for this one alone.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # Start producers before the GPU's context exists, because a process with a context must not fork.
    batches = train.start_producers(produce, a.workers, a.data, masks, a.clips, a.crop)
    stopped = []
    for name in signal.SIGINT, signal.SIGTERM:
        signal.signal(name, lambda number, frame: stopped.append(number))
    validation = Validation(a.data, masks, a.scene)
    t = Training(a, masks, device)
    end, last = min(60 * a.minutes, t.seconds + 60 * a.run_minutes), t.step + a.steps if a.steps else math.inf
    evaluated, saved, loss = t.seconds, -math.inf, 0.
    while t.seconds < end and t.step < last:
        if stopped:
            t.save()
            sys.exit(f'interrupted at step {t.step}, after {t.seconds / 60:.1f} minutes; the same command continues')
        began = time.monotonic()
        error = t.learn(*batches.get())
        loss = error if not loss else .98 * loss + .02 * error
        t.seconds += time.monotonic() - began
        if t.seconds - saved > PAUSE:
            saved = t.seconds
            t.save()
            print(f'{t.seconds / 60:.1f} min, step {t.step}, rms error {loss:.4f}', flush=True)
        if t.seconds - evaluated > 60 * a.every:
            evaluated = t.seconds
            t.evaluate(validation)
    t.evaluate(validation)
    worst = write_network(t.averaged().cpu(), os.path.join(a.out, 'network.onnx'))
    if worst > 1e-4:
        raise SystemExit(f'the ONNX graph does not compute what PyTorch does: the greatest difference is {worst:.1e}')
    write_card(t, masks)
    print(f'{a.out}/network.onnx, greatest difference from PyTorch {worst:.1e}')


if __name__ == '__main__':
    main()
