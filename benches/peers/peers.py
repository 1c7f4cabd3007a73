"""CPU seconds of sci-recon beside the usual Python way, in one run, each on one thread.

    python peers.py SCI_RECON_BINARY [--short]

The Python way is GAP in numpy with scikit-image's total variation, and FFDNet and FastDVDNet in PyTorch as they were published: frame by
frame, so that FastDVDNet runs four blocks a frame. Both sides get the same masks and measurement in float32 and do the same number of
iterations. The cost of one iteration or pass is the difference of two runs, which leaves out starting, reading and writing. Prints a
table and ends with its figures as one JSON line. Content does not change the time, so the frames are random.
"""
import os

for name in ('OMP_NUM_THREADS', 'MKL_NUM_THREADS', 'OPENBLAS_NUM_THREADS'):
    os.environ[name] = '1'   # before numpy and torch look

import argparse
import json
import pathlib
import platform
import subprocess
import sys
import tempfile
import time

import numpy as np
import torch
from skimage.restoration import denoise_tv_chambolle

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[2] / 'training'))
import model   # the networks' layouts; weights don't change the time

TV_WEIGHT = 0.1
DUAL_UPDATES = 4   # scikit-image's max_num_iter counts one more


def snapshot(frames, size):
    """Frames, masks [B,H,W] and the measurement [H,W], float32."""
    rng = np.random.default_rng(1)
    x = rng.random((frames, size, size), np.float32)
    masks = (rng.random(x.shape) < .5).astype(np.float32)
    masks[0][masks.sum(0) == 0] = 1   # no dead pixels
    return x, masks, (x * masks).sum(0)


# ---------------------------------------------------------------- the Python way
def gap_tv(masks, y, iterations):
    """Accelerated GAP with the total variation of each frame."""
    gram = (masks * masks).sum(0)
    v, y1 = np.zeros_like(masks), np.zeros_like(y)
    for _ in range(iterations):
        seen = (masks * v).sum(0)
        y1 += y - seen
        v = v + masks * ((y1 - seen) / gram)
        for k in range(len(v)):
            v[k] = denoise_tv_chambolle(v[k], weight=TV_WEIGHT, eps=0, max_num_iter=DUAL_UPDATES + 1)
    return v


@torch.no_grad()
def fastdvdnet_pass(net, x):
    """One pass over a clip [B,H,W]; five frames in, one out."""
    last = len(x) - 1
    sigma = torch.full((1, 1, 1, 1), .1)
    for k in range(len(x)):
        window = [abs(i) if i <= last else 2 * last - i for i in range(k - 2, k + 3)]
        net(x[window][None], sigma)


@torch.no_grad()
def ffdnet_pass(net, x):
    """One pass over a clip [B,H,W], frame by frame."""
    sigma = torch.full((1, 1, 1, 1), .1)
    for frame in x:
        net(frame[None, None], sigma)


def cpu_seconds(work, *arguments):
    began = time.process_time()
    work(*arguments)
    return time.process_time() - began


# ---------------------------------------------------------------- ours
class Ours:
    def __init__(self, binary, folder, masks, y):
        self.binary, self.folder = binary, pathlib.Path(folder)
        np.save(self.folder / 'masks.npy', masks)
        np.save(self.folder / 'measurement.npy', y)

    def cpu_seconds(self, *arguments):
        command = [self.binary, 'reconstruct', '--masks', self.folder / 'masks.npy', '--measurement', self.folder / 'measurement.npy',
                   '--threads', '1', '--json', *arguments]
        done = subprocess.run(command, stdout=subprocess.PIPE, check=True)
        return json.loads(done.stdout)['cpu_seconds']

    def gap_tv(self, iterations):
        return self.cpu_seconds('--algorithm', 'gap-tv', '--iterations', str(iterations))

    def passes(self, network, count):
        path = self.folder / f'{network}.json'
        stage = {'prior': network, 'iterations': count, 'sigma': [.1, .1]}
        path.write_text(json.dumps({'stages': [stage]}))
        return self.cpu_seconds('--algorithm', f'pnp-{network}', '--schedule', path)


def least(measure, few, many, repeats):
    """CPU seconds of one iteration: the difference of two runs, each the least of a few (a busy machine only adds)."""
    runs = {n: min(measure(n) for _ in range(repeats)) for n in (few, many)}
    return (runs[many] - runs[few]) / (many - few)


def main():
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument('binary')
    p.add_argument('--short', action='store_true', help='only 256x256x8 GAP-TV')
    a = p.parse_args()
    torch.set_num_threads(1)
    rows = []

    def row(what, voxels, theirs, ours):
        rows.append({'what': what, 'python_cpu_s': round(theirs, 4), 'ours_cpu_s': round(ours, 4), 'ratio': round(theirs / ours, 1),
                     'python_ns_per_voxel': round(1e9 * theirs / voxels, 2), 'ours_ns_per_voxel': round(1e9 * ours / voxels, 2)})
        print(f"{what:38}{theirs:12.4f}{ours:12.4f}{theirs / ours:9.1f}x{1e9 * theirs / voxels:12.2f}{1e9 * ours / voxels:10.2f}", flush=True)

    print(f"{'CPU seconds, one thread':38}{'Python':>12}{'sci-recon':>12}{'ratio':>10}{'ns/voxel':>12}{'ns/voxel':>10}")
    for frames, size, few, many in ((8, 256, 4, 24), (10, 1024, 1, 3)):
        _, masks, y = snapshot(frames, size)
        with tempfile.TemporaryDirectory() as folder:
            ours = Ours(a.binary, folder, masks, y)
            theirs = least(lambda n: cpu_seconds(gap_tv, masks, y, n), few, many, 2)
            row(f'GAP-TV iteration, {size}x{size}x{frames}', y.size * frames, theirs, least(ours.gap_tv, 10 * few, 10 * many if size > 256 else 400, 3))
        if a.short:
            break
    if not a.short:
        x, masks, y = snapshot(10, 256)
        clip = torch.from_numpy(x)
        with tempfile.TemporaryDirectory() as folder:
            ours = Ours(a.binary, folder, masks, y)
            for network, work, net in (('ffdnet', ffdnet_pass, model.FFDNet()), ('fastdvdnet', fastdvdnet_pass, model.FastDVDnet())):
                theirs = min(cpu_seconds(work, net.eval(), clip) for _ in range(2))
                row(f'{network} pass, 256x256x10', x.size, theirs, least(lambda n: ours.passes(network, n), 1, 3, 2))
    cpu = next((line.split(':')[1].strip() for line in open('/proc/cpuinfo') if line.startswith('model name')), platform.processor())
    print(json.dumps({'target': 'bench-peers', 'cpu': cpu, 'cores': os.cpu_count(), 'rows': rows}))


main()
