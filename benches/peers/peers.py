"""CPU seconds of sci-recon, compared with the usual Python libraries in one run, each on one thread.

    python peers.py SCI_RECON_BINARY [--short]

The Python side is GAP in numpy with scikit-image's total variation, and FFDNet and FastDVDNet in PyTorch as
published: frame by frame, so that FastDVDNet runs four blocks per frame. Both sides get the same float32
masks and measurement, and run the same number of iterations. The cost of an iteration or pass is the
difference of two runs, without start, input and output. Content does not affect the time, so these frames are
random. Then a whole job on the demo clip: our default algorithm, compared with those of its stages that exist
in Python, with the same weights; and a pass of BM4D, compared with one of our nonlocal prior. Prints tables;
the last line is JSON with all figures.
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

import bm4d
import imageio.v3 as imageio
import numpy as np
import torch
from skimage.restoration import denoise_tv_chambolle

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[2] / 'training'))
import export
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
def gap(masks, y, v, denoise, iterations):
    """Accelerated GAP from the frames `v`, with `denoise(v, iteration)` as prior."""
    gram = (masks * masks).sum(0)
    gram[gram == 0] = 1   # dead pixels
    y1 = np.zeros_like(y)
    for iteration in range(iterations):
        seen = (masks * v).sum(0)
        y1 += y - seen
        v = denoise(v + masks * ((y1 - seen) / gram), iteration)
    return v


def total_variation(v, _):
    """Total variation of each frame."""
    return np.stack([denoise_tv_chambolle(frame, weight=TV_WEIGHT, eps=0, max_num_iter=DUAL_UPDATES + 1) for frame in v])


def gap_tv(masks, y, iterations):
    return gap(masks, y, np.zeros_like(masks), total_variation, iterations)


def pnp_tv_fastdvdnet(masks, y, net, stages):
    """The stages of total variation, then those of the network with evenly falling levels."""
    v = np.zeros_like(masks)
    for stage in stages:
        levels = np.linspace(*stage['sigma'], stage['iterations'], dtype=np.float32) if stage.get('sigma') else None
        denoise = total_variation if levels is None else lambda v, i: fastdvdnet_pass(net, torch.from_numpy(v), float(levels[i]))
        v = gap(masks, y, v, denoise, stage['iterations'])
    return v


@torch.no_grad()
def fastdvdnet_pass(net, x, level=.1):
    """One pass over a clip [B,H,W]; five frames in, one out."""
    last = len(x) - 1
    sigma = torch.full((1, 1, 1, 1), level)
    windows = ([abs(i) if i <= last else 2 * last - i for i in range(k - 2, k + 3)] for k in range(len(x)))
    return torch.cat([net(x[window][None], sigma)[0] for window in windows]).numpy()


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


def psnr(frames, truth):
    """Mean over the frames, range 1."""
    error = ((frames.clip(0, 1) - truth) ** 2).mean((1, 2))
    return float((-10 * np.log10(error)).mean())


# ---------------------------------------------------------------- a whole job
def whole_job(binary, size=256, frames=8):
    """Rows (name, CPU seconds, PSNR): the default and its parts, ours and in Python, on the demo clip behind
    random squares."""
    root = pathlib.Path(__file__).resolve().parents[2]
    clip = np.stack([imageio.imread(path) for path in sorted(root.glob('demo/clip/frame_*.png'))[:frames]])
    top, left = ((extent - size) // 2 for extent in clip.shape[1:])
    run = lambda *arguments: json.loads(subprocess.run([binary, *map(str, arguments)], stdout=subprocess.PIPE, check=True).stdout)
    with tempfile.TemporaryDirectory() as folder:
        folder = pathlib.Path(folder)
        np.save(folder / 'clip.npy', clip[:, top:top + size, left:left + size])
        subprocess.run([binary, 'simulate', '--frames', folder / 'clip.npy', '--compression-ratio', str(frames), '--pattern', 'random-squares',
                        '--seed', '1', '--out', folder], stdout=subprocess.DEVNULL, check=True)
        masks, y, truth = (np.load(folder / f'{name}.npy').astype(np.float32) for name in ('masks', 'measurement', 'truth'))
        y = y.reshape(masks.shape[1:])
        files = [argument for name in ('masks', 'measurement', 'truth') for argument in (f'--{name}', folder / f'{name}.npy')]

        def ours(what, schedule=None):
            arguments = ['--algorithm', 'pnp-tv-fastdvdnet', '--threads', 1, '--json']
            if schedule:
                (folder / 'schedule.json').write_text(json.dumps(schedule))
                arguments += ['--schedule', folder / 'schedule.json']
            report = run('reconstruct', *files, *arguments)
            return {'what': what, 'cpu_s': round(report['cpu_seconds'], 1), 'psnr_db': round(report['psnr_unit_db'], 2)}

        default = run('schedule', '--algorithm', 'pnp-tv-fastdvdnet')
        parts = [stage for stage in default['stages'] if stage['prior'] == 'tv' or stage['prior'].startswith('fastdvdnet')]
        exact = [{**stage, 'prior': stage['prior'].removesuffix('-int8')} for stage in parts]
        yield ours('sci-recon, default')
        yield ours('sci-recon, its stages of TV and FastDVDNet', {**default, 'adaptive': False, 'stages': parts})
        yield ours('the same in floating point', {**default, 'adaptive': False, 'stages': exact})
        net = export.weights_of(root / 'models/fastdvdnet-gray')
        began = time.process_time()
        found = pnp_tv_fastdvdnet(masks, y, net, parts)
        yield {'what': 'Python: scikit-image TV, PyTorch FastDVDNet, these stages', 'cpu_s': round(time.process_time() - began, 1),
               'psnr_db': round(psnr(found, truth), 2)}
        volume = np.ascontiguousarray(found.transpose(1, 2, 0))
        theirs = cpu_seconds(bm4d.bm4d, volume, 10 / 255)
        stage = lambda count: {'stages': [parts[0], {**default['stages'][-1], 'iterations': count}]}
        few, many = (ours('', stage(count))['cpu_s'] for count in (4, 24))
        yield {'what': 'a pass of the nonlocal prior, sci-recon', 'cpu_s': round((many - few) / 20, 3)}
        yield {'what': 'a pass of BM4D', 'cpu_s': round(theirs, 1)}


def least(measure, few, many, repeats):
    """CPU seconds of one iteration: the difference of two runs, each the minimum of several, because a busy
    machine only adds time."""
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
    jobs = []
    if not a.short:
        print(f"\n{'a whole job, 256x256x8, one thread':60}{'CPU s':>10}{'PSNR dB':>10}")
        for job in whole_job(a.binary):
            jobs.append(job)
            print(f"{job['what']:60}{job['cpu_s']:10.2f}{job.get('psnr_db', ''):>10}", flush=True)
    cpu = next((line.split(':')[1].strip() for line in open('/proc/cpuinfo') if line.startswith('model name')), platform.processor())
    print(json.dumps({'target': 'bench-peers', 'cpu': cpu, 'cores': os.cpu_count(), 'rows': rows, 'jobs': jobs}))


main()
