"""Train a network that corrects the frames of the default algorithm, conditioned on masks and measurement.

    python correction.py make --binary sci-recon --data DATA --pairs PAIRS --count 400 [--part 0/2]
    python correction.py baseline --pairs PAIRS
    python correction.py train --pairs PAIRS --out run/correction --cpu-minutes 120
    python correction.py evaluate --pairs PAIRS --out run/correction
    python correction.py scene --out run/correction --scene scene.mat --result frames.npy

`make` simulates snapshots of the training split and reconstructs them. Every eighth pair is for validation, from clips
and photographs that no other pair contains. `baseline` prints the gain of a projection and of one more pass of FastDVDNet
over the reconstruction, `train` the gain of the network, which unfolds two iterations. `train` continues from its
checkpoint, and uses pairs that are added while it runs. `evaluate` prints the gain over other pairs, for example those of
`make --passes 6 --part 0/8`, which are the validation pairs with half of the passes of FastDVDNet. `scene` corrects the
reconstruction of a benchmark scene.
"""
import argparse
import collections
import glob
import json
import math
import os
import subprocess
import tempfile
import time

import numpy as np
import torch
import torch.nn as nn
import torch.nn.functional as F

import export
import solver
import train
from data import Footage
from evaluate import psnr
from model import conv

HELD_OUT = 8        # one of so many pairs, and of so many photographs, is for validation
HELD_OUT_CLIPS = 'gh-intel__car-detection', 'gh-intel__one-by-one-person-detection'
RATIOS = 6, 8, 8, 8, 10, 10, 12, 16, 20
NOISY = .2          # share of pairs with noise of up to sigma 10 (/255)
FAST = .05          # rms change from frame to frame, relative to the white level; faster pairs are reported separately
FLOOR = 1e-5        # squared error below which a smaller one counts little


# ---------------------------------------------------------------- pairs
def scenes(a, validation):
    """Footage of the training split, divided into scenes for training and for validation."""
    footage = Footage(a.data, 'train', 0)
    names = [os.path.basename(folder) for folder in sorted(glob.glob(f'{a.data}/clips/train/*'))]
    chosen = [k for k, name in enumerate(names) if (name in HELD_OUT_CLIPS) == validation]
    footage.clips = [footage.clips[k] for k in chosen]
    footage.weight = footage.weight[chosen] / footage.weight[chosen].sum()
    footage.photos = [photo for k, photo in enumerate(footage.photos) if (k % HELD_OUT == 0) == validation]
    return footage


def make(a):
    part, parts = (int(number) for number in a.part.split('/'))
    os.makedirs(a.pairs, exist_ok=True)
    sources = {validation: scenes(a, validation) for validation in (False, True)}
    schedule = json.loads(subprocess.run([a.binary, 'schedule'], check=True, capture_output=True, text=True).stdout)
    if a.passes:
        schedule['stages'][1]['iterations'] = a.passes
    for index in range(part, a.count, parts):
        path = f'{a.pairs}/{index:05d}.npz'
        if os.path.exists(path):
            continue
        r = np.random.default_rng([59, index])
        footage, frames = sources[index % HELD_OUT == 0], int(r.choice(RATIOS))
        footage.random = r
        truth = footage.sample(a.size, frames)
        masks = solver.random_masks(r, frames, a.size)
        sigma = r.uniform(1, 10) / 255 if r.random() < NOISY else 0.
        y = ((truth * masks).sum(0) + r.normal(0, 1, masks.shape[1:]) * sigma).astype(np.float32)
        # The pilot costs twice as much as the solver, and matters with noise.
        schedule['adaptive'] = sigma > 0
        with tempfile.TemporaryDirectory() as folder:
            for name, values in ('masks', masks), ('measurement', y[None]):
                np.save(f'{folder}/{name}.npy', values)
            with open(f'{folder}/schedule.json', 'w') as f:
                json.dump(schedule, f)
            done = subprocess.run([a.binary, 'reconstruct', '--masks', f'{folder}/masks.npy', '--measurement', f'{folder}/measurement.npy',
                                   '--schedule', f'{folder}/schedule.json', '--registration', 'off', '--threads', '1', '--out', f'{folder}/out', '--json'],
                                  capture_output=True, text=True)
            if done.returncode not in (0, 3):
                raise SystemExit(f'{path}: {done.stderr}')
            x = np.load(f'{folder}/out/frames.npy').reshape(truth.shape)
            seconds = json.loads(done.stdout)['cpu_seconds']
        half = lambda values: values.astype(np.float16)
        np.savez(path + '.part.npz', truth=half(truth), masks=half(masks), y=y, x=half(x), sigma=np.float32(sigma))
        os.replace(path + '.part.npz', path)
        print(f'{index}: Cr {frames}, sigma {sigma * 255:.1f}, {psnr(torch.from_numpy(x), torch.from_numpy(truth)):.2f} dB, {seconds:.1f} CPU seconds', flush=True)


class Pair:
    """Tensors [B,H,W] and [1,H,W], divided by the white level that the program would estimate."""

    def __init__(self, truth, masks, y, x, sigma):
        lit = masks.sum(0) > .05
        self.white = white = max(float(np.percentile(y[lit] / masks.sum(0)[lit], 99.5)), .02)
        tensor = lambda values: torch.from_numpy(np.ascontiguousarray(values, np.float32))
        self.truth, self.masks, self.y, self.x = tensor(truth / white), tensor(masks), tensor(y[None] / white), tensor(x / white)
        self.sigma, self.speed = float(sigma) / white, float(np.sqrt((np.diff(truth / white, axis=0) ** 2).mean()))

    @classmethod
    def read(cls, path):
        with np.load(path) as of:
            return cls(*(of[name].astype(np.float32) for name in ('truth', 'masks', 'y', 'x', 'sigma')))


class Pairs:
    """The pairs of a folder; `refresh` adds new ones."""

    def __init__(self, folder, crop):
        self.folder, self.crop, self.random = folder, crop, np.random.default_rng(time.time_ns())
        self.known, self.training, self.validation = set(), collections.defaultdict(list), {}
        self.refresh()

    def refresh(self):
        for path in sorted(set(glob.glob(f'{self.folder}/[0-9][0-9][0-9][0-9][0-9].npz')) - self.known):
            self.known.add(path)
            pair, index = Pair.read(path), int(os.path.basename(path)[:-4])
            if index % HELD_OUT == 0:
                self.validation[index] = pair
            else:
                self.training[len(pair.truth)].append(pair)

    def batch(self, frames):
        """Windows of pairs with one compression ratio, of `frames` frames together: truth, masks, y, x, sigma."""
        r, groups = self.random, list(self.training)
        weights = np.array([len(self.training[b]) for b in groups], float)
        b = groups[r.choice(len(groups), p=weights / weights.sum())]
        rows = []
        for _ in range(max(1, round(frames / b))):
            pair = self.training[b][r.integers(len(self.training[b]))]
            top, left = (2 * int(r.integers(0, (side - self.crop) // 2 + 1)) for side in pair.y.shape[1:])
            row = [part[:, top:top + self.crop, left:left + self.crop] for part in (pair.truth, pair.masks, pair.y, pair.x)]
            axes = [axis for axis in (1, 2) if r.random() < .5]
            row = [part.flip(axes) for part in row]
            if r.random() < .5:
                row = [part.transpose(1, 2) for part in row]
            if r.random() < .5:
                row = [part.flip(0) for part in row]
            rows.append((*row, torch.tensor(pair.sigma).view(1, 1, 1)))
        return [torch.stack(parts) for parts in zip(*rows)]


# ---------------------------------------------------------------- network
def back_projection(x, masks, y):
    """C^T r / gram of the residual r of frames x [N,B,H,W]."""
    gram = (masks * masks).sum(1, keepdim=True)
    return masks * torch.where(gram > 1e-6, (y - solver.measure(x, masks)) / gram.clamp_min(1e-6), torch.zeros_like(gram))


def project(x, masks, y):
    return x + back_projection(x, masks, y)


class Residual(nn.Module):
    """Two convolutions of frames [N*B,C,H,W]. Before the first one, a quarter of the channels comes from the frame
    before and a quarter from the one after (Lin, Gan and Han, TSM, ICCV 2019)."""

    def __init__(self, width):
        super().__init__()
        self.first, self.second = conv(width, width), conv(width, width)

    def forward(self, x, earlier, later):
        """earlier and later: the index of each frame's neighbours."""
        part = x.shape[1] // 4
        shifted = torch.cat((x[:, :part].index_select(0, earlier), x[:, part:2 * part].index_select(0, later), x[:, 2 * part:]), 1)
        return x + self.second(F.relu(self.first(shifted.contiguous(memory_format=torch.channels_last))))


class Stage(nn.Module):
    """A small U-Net at half and a quarter of the resolution, over frames with their neighbours in time."""

    INPUTS = 9      # frame, four neighbours, mask, back-projected residual, mean residual, mean picture

    def __init__(self, width, first):
        super().__init__()
        self.enter = conv(4 * self.INPUTS + 1 + (0 if first else width), width)
        self.fine = nn.ModuleList(Residual(width) for _ in range(2))
        self.down = conv(width, 2 * width, 2)
        self.coarse = nn.ModuleList(Residual(2 * width) for _ in range(4))
        self.up = conv(2 * width, 4 * width)
        self.last = Residual(width)
        self.leave = conv(width, 4)
        nn.init.zeros_(self.leave.weight)
        nn.init.zeros_(self.leave.bias)

    def forward(self, x, masks, y, sigma, features):
        n, b = x.shape[:2]
        light = masks.sum(1, keepdim=True).clamp_min(.05)
        mean, residual = y / light, (y - solver.measure(x, masks)) / light
        frame = torch.arange(b)
        neighbour = lambda step: (frame + step).clamp(0, b - 1)
        near = [5 * (x[:, neighbour(step)] - x) for step in (-2, -1, 1, 2)]
        earlier, later = ((b * torch.arange(n)[:, None] + neighbour(step)).flatten() for step in (-1, 1))
        inputs = torch.stack((x, *near, masks, 10 * back_projection(x, masks, y), 10 * residual.expand_as(x), mean - x), 2)
        half = F.pixel_unshuffle(inputs.flatten(0, 1), 2)
        noise = (25 * sigma).expand(n, b, *half.shape[2:]).reshape(n * b, 1, *half.shape[2:])
        half = torch.cat([half, noise] + ([] if features is None else [features]), 1).contiguous(memory_format=torch.channels_last)
        fine = F.relu(self.enter(half))
        for layer in self.fine:
            fine = layer(fine, earlier, later)
        coarse = F.relu(self.down(fine))
        for layer in self.coarse:
            coarse = layer(coarse, earlier, later)
        features = self.last(fine + F.pixel_shuffle(self.up(coarse), 2), earlier, later)
        return x + .1 * F.pixel_shuffle(self.leave(features), 2).view_as(x), features


class Correction(nn.Module):
    def __init__(self, stages=2, width=32):
        super().__init__()
        self.stages = nn.ModuleList(Stage(width, k == 0) for k in range(stages))

    def forward(self, x, masks, y, sigma):
        """The frames after each stage; x and masks [N,B,H,W], y [N,1,H,W], sigma [N,1,1,1]."""
        features, estimates = None, []
        for stage in self.stages:
            x, features = stage(x, masks, y, sigma, features)
            estimates.append(x)
        return estimates


# ---------------------------------------------------------------- training
def report(gains, pairs):
    """Mean and worst gain in dB, and the mean over fast and noisy pairs."""
    gains, fast, noisy = np.array(gains), np.array([p.speed > FAST for p in pairs]), np.array([p.sigma > 0 for p in pairs])
    of = lambda some: round(float(gains[some].mean()), 3) if some.any() else None
    return {'before_db': round(float(np.mean([psnr(p.x, p.truth) for p in pairs])), 3), 'mean_db': of(gains == gains), 'worst_db': round(float(gains.min()), 3), 'median_db': round(float(np.median(gains)), 3),
            'fast_db': of(fast), 'noisy_db': of(noisy), 'fast': int(fast.sum()), 'noisy': int(noisy.sum()), 'pairs': len(gains)}


@torch.no_grad()
def gains(pairs, corrected):
    """Gain over the solver's frames of `corrected(x, masks, y, sigma)`, by pair."""
    result = []
    for pair in pairs:
        frames = corrected(pair.x[None], pair.masks[None], pair.y[None], torch.tensor(pair.sigma).view(1, 1, 1, 1))[0]
        result.append(psnr(frames, pair.truth) - psnr(pair.x, pair.truth))
    return result


def evaluated(net, pairs):
    """The report of the last stage, and its mean gain if a projection follows."""
    values = list(pairs.validation.values())
    last = lambda *inputs: net(*inputs)[-1]
    projected = lambda x, masks, y, sigma: project(last(x, masks, y, sigma), masks, y)
    return report(gains(values, last), values) | {'projected_db': round(float(np.mean(gains(values, projected))), 3)}


class Training:
    def __init__(self, a):
        self.a, self.path = a, os.path.join(a.out, 'checkpoint.pt')
        self.net = Correction(a.stages, a.width)
        self.step, self.seconds = 0, 0.
        state = torch.load(self.path, map_location='cpu', weights_only=True) if os.path.exists(self.path) else None
        if state:
            self.net.load_state_dict(state['net'])
        self.net = self.net.to(memory_format=torch.channels_last)
        self.average = {k: v.clone() for k, v in self.net.state_dict().items()}
        self.optimizers = train.optimizers(self.net, a.lr, 'cpu')
        if state:
            self.average = state['average']
            for optimizer, saved in zip(self.optimizers, state['optimizers']):
                optimizer.load_state_dict(saved)
            self.step, self.seconds = state['step'], state['seconds']

    def save(self):
        state = {'net': self.net.state_dict(), 'average': self.average, 'optimizers': [o.state_dict() for o in self.optimizers],
                 'step': self.step, 'seconds': self.seconds}
        torch.save(state, self.path + '.part')
        os.replace(self.path + '.part', self.path)

    def averaged(self):
        net = Correction(self.a.stages, self.a.width)
        net.load_state_dict(self.average)
        return net.to(memory_format=torch.channels_last).eval()

    def learn(self, truth, masks, y, x, sigma):
        """One step; returns the mean gain of the batch in dB."""
        before = ((x - truth) ** 2).mean((1, 2, 3)) + FLOOR
        with torch.autocast('cpu', torch.bfloat16, enabled=self.a.bf16):
            estimates = self.net(x, masks, y, sigma)
        logs = [torch.log10((((e - truth) ** 2).mean((1, 2, 3)) + FLOOR) / before).mean() for e in estimates]
        sum(log * .5 ** k for k, log in enumerate(reversed(logs))).backward()
        progress = min(1., self.seconds / (60 * self.a.cpu_minutes))
        lr = self.a.lr * min(1, (self.step + 1) / 100) * (.5 * (1 + math.cos(math.pi * progress)) * .98 + .02)
        for optimizer in self.optimizers:
            for group in optimizer.param_groups:
                group['lr'] = lr * group['share']
        if torch.isfinite(nn.utils.clip_grad_norm_(self.net.parameters(), .3)):
            for optimizer in self.optimizers:
                optimizer.step()
            keep = min(.995, self.step / (self.step + 10))
            with torch.no_grad():
                torch._foreach_lerp_(list(self.average.values()), list(self.net.state_dict().values()), 1 - keep)
        self.net.zero_grad(set_to_none=True)
        self.step += 1
        return float(-10 * logs[-1].detach())


def train_network(a):
    torch.set_num_threads(a.threads)
    os.makedirs(a.out, exist_ok=True)
    pairs, t = Pairs(a.pairs, a.crop), Training(a)
    print(f'{sum(p.numel() for p in t.net.parameters()):,} parameters, {len(pairs.known)} pairs', flush=True)
    gain, checked, last = 0., t.seconds, t.step + a.steps if a.steps else math.inf

    def check():
        print(json.dumps({'cpu_minutes': round(t.seconds / 60, 1), 'step': t.step, 'training_db': round(gain, 3), **evaluated(t.averaged(), pairs)}), flush=True)
        t.save()

    while t.seconds < 60 * a.cpu_minutes and t.step < last:
        began = time.process_time()
        one = t.learn(*pairs.batch(a.frames))
        gain = gain + (one - gain) * max(.02, 1 / t.step)
        t.seconds += time.process_time() - began
        if t.step % 50 == 0:
            pairs.refresh()
            print(f'{time.strftime("%H:%M:%S")} step {t.step}, {t.seconds / 60:.1f} CPU minutes, gain {gain:.3f} dB, {len(pairs.known)} pairs', flush=True)
        if t.seconds - checked > 60 * a.every:
            checked = t.seconds
            check()
    check()


def baseline(a):
    """Gain of a projection alone, and of one more pass of FastDVDNet with and without a projection before it."""
    torch.set_num_threads(a.threads)
    pairs = list(Pairs(a.pairs, a.crop).validation.values())
    net = export.load(os.path.join(os.path.dirname(os.path.abspath(__file__)), '../../models/fastdvdnet-gray'))
    projected = lambda x, masks, y, sigma: project(x, masks, y)
    ways = {'projection': projected}
    for level in a.levels:
        denoised = lambda x, level=level: net.clips(x, torch.full((1, 1, 1, 1), level / 255))
        ways[f'pass at {level}'] = lambda x, masks, y, sigma, d=denoised: d(x)
        ways[f'projection, pass at {level}'] = lambda x, masks, y, sigma, d=denoised: d(projected(x, masks, y, sigma))
    for name, way in ways.items():
        print(name, json.dumps(report(gains(pairs, way), pairs)), flush=True)


def evaluate(a):
    torch.set_num_threads(a.threads)
    print(json.dumps(evaluated(Training(a).averaged(), Pairs(a.pairs, a.crop))))


def scene(a):
    """PSNR of the result of a snapshot of a .mat scene before and after each stage."""
    import scipy.io
    torch.set_num_threads(a.threads)
    m = scipy.io.loadmat(a.scene)
    masks, truth = (m[name].astype(np.float32).transpose(2, 0, 1) for name in ('mask', 'orig'))
    first = a.snapshot * len(masks)
    truth, y = truth[first:first + len(masks)] / 255, m['meas'].astype(np.float32)[..., a.snapshot] / 255
    pair, net = Pair(truth, masks, y, np.load(a.result).reshape(truth.shape), 0), Training(a).averaged()
    began = time.process_time()
    with torch.no_grad():
        stages = net(pair.x[None], pair.masks[None], pair.y[None], torch.zeros(1, 1, 1, 1))
    seconds = time.process_time() - began
    decibels = lambda frames: round(psnr(pair.white * frames, torch.from_numpy(truth)), 3)
    print(json.dumps({'before_db': decibels(pair.x), 'stages_db': [decibels(frames[0]) for frames in stages], 'cpu_seconds': round(seconds, 1)}))


def main():
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument('what', choices=('make', 'baseline', 'train', 'evaluate', 'scene'))
    p.add_argument('--binary', default='sci-recon')
    p.add_argument('--data', help='data folder of pack.py')
    p.add_argument('--pairs', help='folder of the pairs')
    p.add_argument('--out', help='folder of the checkpoint')
    p.add_argument('--count', type=int, default=400)
    p.add_argument('--part', default='0/1', help='K/N: every Nth pair from the Kth on')
    p.add_argument('--size', type=int, default=96, help='sides of the snapshots that are simulated')
    p.add_argument('--passes', type=int, help='passes of FastDVDNet [default: as in the schedule]')
    p.add_argument('--crop', type=int, default=64, help='sides of the windows in training, a multiple of 4')
    p.add_argument('--frames', type=int, default=32, help='frames of a batch')
    p.add_argument('--stages', type=int, default=2)
    p.add_argument('--width', type=int, default=32, help='channels at half the resolution')
    p.add_argument('--lr', type=float, default=1e-3)
    p.add_argument('--bf16', action='store_true', help='needs 0.6 of the time on a CPU with AVX512-BF16')
    p.add_argument('--cpu-minutes', type=float, default=120, help='CPU time of all runs; the learning rate falls to its end')
    p.add_argument('--steps', type=int, default=0, help='stop this run after so many steps')
    p.add_argument('--every', type=float, default=4, help='CPU minutes between evaluations')
    p.add_argument('--threads', type=int, default=1)
    p.add_argument('--levels', type=float, nargs='+', default=[1.7, 3, 5.3], help='noise levels (/255) of the pass of FastDVDNet')
    p.add_argument('--scene', help='a .mat scene')
    p.add_argument('--snapshot', type=int, default=0)
    p.add_argument('--result', help='frames.npy of a reconstruction of --snapshot')
    a = p.parse_args()
    {'make': make, 'baseline': baseline, 'train': train_network, 'evaluate': evaluate, 'scene': scene}[a.what](a)


if __name__ == '__main__':
    main()
