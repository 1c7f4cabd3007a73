"""Train a denoiser on a CPU or one CUDA GPU.

    python train.py --data DATA --out run/block.pt --stage block  --minutes 45                          # one block as a 3-frame denoiser
    python train.py --data DATA --out run/full.pt  --stage full   --minutes 45 --init run/block.pt      # both blocks jointly
    python train.py --data DATA --out run/loop.pt  --stage loop   --minutes 90 --init run/full.pt       # half white noise, half solver iterates
    python train.py --data DATA --out run/ffdnet.pt --stage ffdnet --minutes 45
    python train.py --data DATA --out run/ff-loop.pt --stage ffdnet-loop --minutes 45 --init run/ffdnet.pt                # as loop

The checkpoint at --out holds the whole state: the same command continues an interrupted run. --minutes counts the
training time of all runs.
"""
import argparse
import collections
import json
import math
import multiprocessing as mp
import os
import random
import time

import numpy as np
import torch

import evaluate
import export
import model
import solver
from data import Footage

# Each stage's module, and the number of frames that its network uses.
STAGES = {'block': ('block', 3), 'full': ('fastdvdnet', 5), 'loop': ('fastdvdnet', 5), 'ffdnet': ('ffdnet', 1), 'ffdnet-loop': ('ffdnet', 1)}

# The program's default schedules: first and last level (/255), passes, memory, momentum.
TV_STAGE = 60, .15, .004   # iterations, weight, temporal weight (which the program omits if it does not reduce the error)
DEFAULTS = {'loop': (25, 5.3, 12, .85, .5), 'ffdnet-loop': (15, 3, 30, .95, 0)}


# ---------------------------------------------------------------- producers
def produce_clips(queue, root, seed, clips, frames, size):
    footage = Footage(root, 'train', seed)
    while True:
        queue.put(footage.batch(clips, frames, size))


def produce_snapshots(queue, root, seed, voxels, size):
    """Simulated snapshots: truth and masks [N,B,size,size], measurement [N,1,size,size]."""
    footage, r = Footage(root, 'train', seed), np.random.default_rng(seed)
    while True:
        b = int(r.choice([6, 8, 8, 10, 10, 12, 16, 20, 30]))
        n = max(1, round(voxels / (b * size * size)))
        x = footage.batch(n, b, size)
        masks = np.stack([solver.random_masks(r, b, size) for _ in range(n)])
        y = solver.measure(x, masks)
        if r.random() < .4:
            y = y + r.normal(0, r.uniform(0, 10 / 255), y.shape)
        queue.put((x, masks, y.astype(np.float32)))


def random_levels(rng):
    """A random schedule, as a job may name it. After TV the error is 10 to 40 (/255); a much higher level would remove
    details."""
    between = lambda low, high: math.exp(rng.uniform(math.log(low), math.log(high)))
    return solver.geometric(between(12, 60), between(4, 10), rng.choice([4, 6, 8, 12, 12, 16, 16, 24, 32]))


class Iterates:
    """Inputs of the network in the solver. Several runs are open; each step advances one of them by one or several
    passes.

    The forward pass of the training also advances the run, so iterates cost only the projection.
    """

    def __init__(self, queue, device, runs, default):
        """default: the schedule near which most runs stay."""
        self.queue, self.device, self.default = queue, device, default
        self.rng = random.Random(0)
        self.runs = [self.fresh() for _ in range(runs)]

    def fresh(self):
        x, masks, y = (torch.from_numpy(a).to(self.device) for a in self.queue.get())
        temporal = self.rng.choice([0, TV_STAGE[2]])
        if self.rng.random() < .3:
            gap, v = solver.start(y, masks, self.rng.randint(20, 50), self.rng.uniform(.07, .15), temporal)
            gap.memory = self.rng.choice([0, .5, .8, 1])   # for the deep passes
            levels, momentum, tv = random_levels(self.rng), 0, self.rng.choice([0, 0, 0, .02])
        else:
            gap, v = solver.start(y, masks, *TV_STAGE[:2], temporal)
            first, last, passes, gap.memory, momentum = self.default
            near = lambda value: value * math.exp(self.rng.uniform(-.2, .2))
            levels, tv = solver.geometric(near(first), near(last), round(near(passes))), 0
        return {'truth': x, 'gap': gap, 'v': v, 'start': v, 'levels': levels, 'momentum': momentum, 'tv': tv}

    def passes(self, most, denoise):
        """Advances one of the runs by up to `most` passes of denoise(x, sigma). Returns the rms error after each, with
        the gradient through projection, momentum and network back to the first pass."""
        i = self.rng.randrange(len(self.runs))
        run, errors = self.runs[i], []
        for _ in range(min(most, len(run['levels']))):
            x = run['gap'].project(run['start'])
            if run['tv']:
                x = solver.tv(x, run['tv'])
            output = denoise(x, torch.full((len(x), 1, 1, 1), run['levels'].pop(0), device=self.device))
            errors.append(rms_error(output, run['truth']))
            run['start'] = output + run['momentum'] * (output - run['v'])
            run['v'] = output
        run['gap'].excess, run['start'], run['v'] = (a.detach() for a in (run['gap'].excess, run['start'], run['v']))
        if not run['levels'] or not torch.isfinite(run['v']).all() or run['v'].abs().max() > 12:
            self.runs[i] = self.fresh()
        return errors


# ---------------------------------------------------------------- training
def rms_error(output, truth):
    """The root mean square error per clip, averaged. It lies between the squared error, where the noisiest clips
    dominate, and its logarithm, where clean clips do (tried: lost 3 dB on white noise)."""
    return (((output.float() - truth) ** 2).mean((1, 2, 3)) + 1e-6).sqrt().mean()


def predict(net, stage, x, sigma):
    """The output, and the frames of x that it estimates."""
    if 'loop' in stage or stage == 'ffdnet':
        return net.clips(x, sigma), slice(None)
    return evaluate.denoise(net, x, sigma), slice(x.shape[1] // 2, x.shape[1] // 2 + 1)


class Training:
    def __init__(self, a, device):
        self.a, self.device = a, device
        self.net = model.KINDS[STAGES[a.stage][0]]()
        self.step, self.seconds = 0, 0.
        state = torch.load(a.out, map_location='cpu', weights_only=True) if os.path.exists(a.out) else None
        if state:
            self.net.load_state_dict(state['net'])
        elif a.init:
            self.net.load_state_dict(self.initial(a.init))
        self.net = self.net.to(device, memory_format=torch.channels_last)
        self.average = {k: v.clone() for k, v in self.net.state_dict().items()}
        self.optimizers = optimizers(self.net, a.lr, device)
        if state:
            self.average = {k: v.to(device) for k, v in state['average'].items()}
            for optimizer, saved in zip(self.optimizers, state['optimizers']):
                optimizer.load_state_dict(saved)
            self.step, self.seconds = state['step'], state['seconds']

    def initial(self, path):
        weights = export.load(path).state_dict()
        if isinstance(self.net, model.FastDVDnet) and 't1.inc.0.weight' not in weights:
            return {f'{t}.{k}': v for t in ('t1', 't2') for k, v in weights.items()}   # both stages start from the 3-frame denoiser
        return weights

    def save(self):
        state = {'net': self.net.state_dict(), 'average': self.average, 'optimizers': [o.state_dict() for o in self.optimizers],
                 'step': self.step, 'seconds': self.seconds}
        torch.save(state, self.a.out + '.part')
        os.replace(self.a.out + '.part', self.a.out)   # an interrupted save leaves the old checkpoint intact

    def averaged(self):
        net = type(self.net)()
        net.load_state_dict(self.average)
        return net.to(self.device, memory_format=torch.channels_last).eval()

    def denoise(self, x, sigma):
        """The output for a batch, and the frames of x that it estimates."""
        # In bf16 on a GPU; on the CPUs tried, bf16 was slower than float32.
        with torch.autocast(self.device, torch.bfloat16, enabled=self.device == 'cuda'):
            y, frames = predict(self.net, self.a.stage, x, sigma)
        return y.float(), frames

    def learn_white(self, truth):
        """Add the gradient of a batch of white noise; returns the loss."""
        y, frames = self.denoise(*self.white_noise(truth))
        loss = rms_error(y, truth[:, frames])
        loss.backward()
        return loss.detach()

    def learn_loop(self, loop):
        """Add the gradient of a few passes of the solver; returns their mean loss."""
        errors = loop.passes(self.a.unroll, lambda x, sigma: self.denoise(x, sigma)[0])
        loss = sum(errors) / len(errors)
        loss.backward()
        return loss.detach()

    def update(self):
        """One step of the optimizer with the gradients added so far."""
        progress = min(1., self.seconds / (60 * self.a.minutes))
        lr = self.a.lr * min(1, (self.step + 1) / 300) * (.5 * (1 + math.cos(math.pi * progress)) * .98 + .02)
        for optimizer in self.optimizers:
            for group in optimizer.param_groups:
                group['lr'] = lr * group['share']
        norm = torch.nn.utils.clip_grad_norm_(self.net.parameters(), .3)   # twice the usual norm
        if torch.isfinite(norm):
            for optimizer in self.optimizers:
                optimizer.step()
            self.step += 1
            keep = min(.999 if self.device == 'cuda' else .998, self.step / (self.step + 10))
            with torch.no_grad():
                torch._foreach_lerp_(list(self.average.values()), list(self.net.state_dict().values()), 1 - keep)
        self.net.zero_grad(set_to_none=True)
        return norm

    def white_noise(self, x):
        """The clips with noise of a level drawn per clip, sigma 3 to 100 (/255), log-uniform."""
        sigma = torch.empty(len(x), 1, 1, 1, device=self.device).uniform_(math.log(3), math.log(100)).exp() / 255
        return x + torch.randn_like(x) * sigma, sigma


class Muon(torch.optim.Muon):
    """Muon (Jordan and others, 2024) for convolutions. torch's version accepts only matrices: a kernel [out,in,h,w] is
    one [out,hwin]."""

    def __init__(self, kernels, lr):
        self.kernels = kernels
        self.matrices = [torch.nn.Parameter(self.matrix(k.detach())) for k in kernels]
        super().__init__([{'params': self.matrices, 'share': 1.}], lr, weight_decay=0, adjust_lr_fn='match_rms_adamw')

    @staticmethod
    def matrix(kernel):
        return kernel.permute(0, 2, 3, 1).flatten(1)

    @torch.no_grad()
    def step(self):
        for kernel, matrix in zip(self.kernels, self.matrices):
            matrix.copy_(self.matrix(kernel))
            matrix.grad = self.matrix(kernel.grad)
        super().step()
        for kernel, matrix in zip(self.kernels, self.matrices):
            out, channels, height, width = kernel.shape
            kernel.copy_(matrix.view(out, height, width, channels).permute(0, 3, 1, 2))


def optimizers(net, lr, device):
    """Muon for the kernels between hidden layers, AdamW at a lower rate for the rest. From the same weights of FFDNet,
    250 steps gained 0.4 to 1.0 dB with it, and 0.1 to 0.4 dB with AdamW alone."""
    hidden = [p for p in net.parameters() if p.ndim == 4 and min(p.shape[:2]) >= 16]
    rest = [p for p in net.parameters() if all(p is not q for q in hidden)]
    others = torch.optim.AdamW([{'params': rest, 'share': .3}], lr, betas=(.9, .99), weight_decay=1e-5, fused=device == 'cuda')
    return [Muon(hidden, lr), others]


def start_producers(target, count, *arguments):
    queue = mp.Queue(8)
    seed = time.time_ns() % 2 ** 31
    for i in range(count):
        mp.Process(target=target, args=(queue, arguments[0], seed + i, *arguments[1:]), daemon=True).start()
    return queue


def main():
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument('--data', required=True)
    p.add_argument('--out', required=True)
    p.add_argument('--stage', choices=STAGES, required=True)
    p.add_argument('--init', help='weights to start from: a checkpoint, or a folder with exported ONNX files')
    p.add_argument('--minutes', type=float, default=45, help='training time over all runs; the learning rate falls to its end')
    p.add_argument('--run-minutes', type=float, default=math.inf, help='stop this run after so many minutes')
    p.add_argument('--steps', type=int, help='stop this run after so many steps')
    p.add_argument('--frames', type=int, default=0, help='frames a batch (default: 16 on a CPU, 384 on a GPU)')
    p.add_argument('--crop', type=int, default=64)
    p.add_argument('--lr', type=float, default=2e-4)
    p.add_argument('--unroll', type=int, default=1, help='passes of the solver per step; the gradient goes through all of them')
    p.add_argument('--runs', type=int, default=12, help='open solver runs in the loop stages')
    p.add_argument('--workers', type=int, default=1, help='producer processes of each kind')
    p.add_argument('--threads', type=int, default=1)
    p.add_argument('--scene', help='a .mat scene that evaluation also runs')
    p.add_argument('--every', type=float, default=15, help='minutes between evaluations, the first before the first step and one at the end; 0 for none')
    p.add_argument('--evaluation-size', type=int, default=96, help='sides of the held-out clips, in pixels')
    a = p.parse_args()
    if a.unroll < 1:
        p.error(f'--unroll {a.unroll}: a step needs at least 1 pass')
    device = 'cuda' if torch.cuda.is_available() else 'cpu'
    torch.set_num_threads(a.threads)
    os.makedirs(os.path.dirname(os.path.abspath(a.out)), exist_ok=True)

    count = a.frames or (384 if device == 'cuda' else 16)
    frames = STAGES[a.stage][1]
    # Start producers before the GPU's context exists, because a process with a context must not fork.
    clips = start_producers(produce_clips, a.workers, a.data, max(1, count // frames), frames, a.crop)
    snapshots = start_producers(produce_snapshots, a.workers, a.data, count * a.crop ** 2, a.crop) if 'loop' in a.stage else None
    t = Training(a, device)
    loop, scenes = None, None
    if snapshots:
        loop = Iterates(snapshots, device, a.runs, DEFAULTS[a.stage])
    if a.stage != 'block' and a.every:
        scenes = evaluate.LoopScenes(a.data, a.scene, a.evaluation_size, device)
        print('TV', json.dumps(scenes.tv()), flush=True)

    def report():
        t.save()
        if not a.every:
            return
        net = t.averaged()
        row = {'step': t.step, 'minutes': round(t.seconds / 60, 1), 'white': evaluate.white(net, a.data, device, size=a.evaluation_size)}
        if scenes:
            row['loop'] = scenes.run(net, solver.geometric(20, 6, 12), memory=.7)
        print('evaluation', json.dumps(row), flush=True)

    evaluated, saved, sums = -1e9 if t.step == 0 else t.seconds, t.seconds, collections.defaultdict(float)
    n = 0
    last = t.step + a.steps if a.steps else math.inf
    end = min(60 * a.minutes, t.seconds + 60 * a.run_minutes)
    while t.seconds < end and t.step < last:
        if a.every and t.seconds - evaluated > 60 * a.every:
            evaluated = t.seconds
            report()
        began = time.monotonic()
        if not loop or t.step % 3 == 0:   # iterates are more diverse than white noise
            truth = torch.from_numpy(clips.get()).to(device, non_blocking=True)
            sums['white'] += t.learn_white(truth) * (3 if loop else 1)
        if loop:
            sums['loop'] += t.learn_loop(loop)
        sums['gradient norm'] += t.update()
        n += 1
        t.seconds += time.monotonic() - began
        if n == 50:
            print(f'{t.seconds / 60:.1f} min, step {t.step}, rms error and norm', {k: round(float(s) / n, 5) for k, s in sums.items()}, flush=True)
            n = 0
            sums.clear()
        if t.seconds - saved > 120:
            saved = t.seconds
            t.save()
    report()


if __name__ == '__main__':
    main()
