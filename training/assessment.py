"""Fit what the program predicts of its own results without a truth: the expected error of blocks and the PSNR of a snapshot.

    python assessment.py make --binary sci-recon-experiments --data DATA --scenes SCENES --out FOLDER
    python assessment.py fit --out FOLDER [--write ../core/src/recon/assessment.json]

`make` simulates snapshots of 128x128 pixels (photographs that a camera moves over, half of them with a part that moves by itself, and
clips; all kinds of masks, Cr 6 to 24, noise 0 to 10) and has them reconstructed. It goes on where it was stopped. `fit` fits both
regressions to all cases, and tells how they do on scenes that were left out (ten folds, no scene in two of them).
"""
import argparse
import glob
import json
import os
import subprocess

import cv2
import numpy as np
import scipy.io

SIDE, LONGEST = 128, 24
PATTERNS = 'iid', 'random-squares', 'rotating-circle'
RATIOS = 6, 8, 10, 10, 12, 16, 20, 24
SIGMAS = 0, 0, 0, 2, 5, 10
ALGORITHMS = 'pnp-tv-fastdvdnet', 'gap-tv'
FARTHEST = 3.0      # as the program has it
BEST = 40.0         # dB: better is not told apart, here and in the program
SPARE = 4.0         # dB that the map may lie above it
FOLDS = 10


# ---------------------------------------------------------------- scenes
def pictures(folder):
    files = sorted(glob.glob(f'{folder}/*.jpg') + glob.glob(f'{folder}/*.png'))
    return np.stack([cv2.imread(f, cv2.IMREAD_GRAYSCALE) for f in files])


def panned(rng, file, others):
    """A camera that moves over a photograph, perhaps with a part of another one that moves by itself."""
    photo = cv2.imread(file, cv2.IMREAD_GRAYSCALE).astype(np.float32)
    scale = max(rng.choice([.2, .3, .45, .7]), (SIDE + 40) / min(photo.shape))
    photo = cv2.resize(photo, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    angle, speed, turn, light = rng.uniform(0, 2 * np.pi), rng.choice([0, .3, 1, 2, 4, 7]), rng.choice([0, 0, .5]), rng.choice([1, 1, .6, .3])
    centre = [extent * (.5 + rng.uniform(-.2, .2)) for extent in photo.shape[::-1]]
    part = None
    if rng.random() < .5:
        other = cv2.imread(others[rng.integers(len(others))], cv2.IMREAD_GRAYSCALE).astype(np.float32)
        other = cv2.resize(other, None, fx=.25, fy=.25, interpolation=cv2.INTER_AREA)
        side = int(rng.integers(24, 56))
        row, column = (int(rng.integers(0, extent - side)) for extent in other.shape)
        part, place, step = other[row:row + side, column:column + side], rng.uniform(20, SIDE - 20 - side / 2, 2), rng.uniform(-4, 4, 2)
    frames = []
    for time in np.arange(LONGEST) - (LONGEST - 1) / 2:
        x, y = centre[0] + time * speed * np.cos(angle), centre[1] + time * speed * np.sin(angle)
        matrix = cv2.getRotationMatrix2D((x, y), turn * time, 1)
        matrix[:, 2] += SIDE / 2 - np.array((x, y))
        frame = cv2.warpAffine(photo, matrix, (SIDE, SIDE), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
        if part is not None:
            shift = np.float32([[1, 0, place[0] + time * step[0]], [0, 1, place[1] + time * step[1]]])
            cover = cv2.warpAffine(np.ones_like(part), shift, (SIDE, SIDE), flags=cv2.INTER_LINEAR)
            frame = frame * (1 - cover) + cv2.warpAffine(part, shift, (SIDE, SIDE), flags=cv2.INTER_LINEAR)
        frames.append(frame)
    return (np.stack(frames) * light).clip(0, 255).round().astype(np.uint8)


def cropped(rng, clip):
    """A part of a clip, at its own or at half its size."""
    height, width = clip.shape[1:]
    side = int(SIDE * (rng.choice([1, 2]) if min(height, width) >= 2 * SIDE else 1))
    row, column = int(rng.integers(0, height - side + 1)), int(rng.integers(0, width - side + 1))
    first = int(rng.integers(0, max(1, len(clip) - LONGEST)))
    part = clip[first:first + LONGEST, row:row + side, column:column + side]
    return np.stack([cv2.resize(frame, (SIDE, SIDE), interpolation=cv2.INTER_AREA) for frame in part])


def scenes(a, rng):
    """Name of the scene and frames [count,H,W], uint8, of each case."""
    photos = {part: sorted(glob.glob(f'{a.data}/photos/{part}/*.jpg')) for part in ('train', 'val')}
    every = photos['train'] + photos['val']
    for file in every:
        for _ in range(2 if file in photos['val'] else 1):
            yield os.path.basename(file), panned(rng, file, every)
    clips = {os.path.basename(folder): pictures(folder) for folder in sorted(glob.glob(f'{a.data}/clips/*/*'))}
    clips['traffic'] = scipy.io.loadmat(f'{a.scenes}/traffic48_cacti.mat')['orig'].transpose(2, 0, 1).round().astype(np.uint8)
    clips['city'] = pictures(os.path.join(os.path.dirname(os.path.abspath(__file__)), '../demo/clip'))
    with np.load(f'{a.scenes}/street_1024x1024x20.npz') as archive:
        street = next(archive[k] for k in archive.files if archive[k].ndim == 3)
    clips['street'] = street if street.dtype == np.uint8 else (street * 255).round().astype(np.uint8)
    for name, clip in clips.items():
        for _ in range(4):
            yield name, cropped(rng, clip)


def make(a):
    rng, groups, about = np.random.default_rng(7), {}, {}
    for index, (scene, frames) in enumerate(scenes(a, rng)):
        ratio = int(rng.choice([ratio for ratio in RATIOS if ratio <= len(frames)]))
        group = f'{PATTERNS[rng.integers(len(PATTERNS))]}_{ratio}_{int(rng.choice(SIGMAS))}'
        groups.setdefault(group, []).append((f'c{index:03d}', frames[:ratio]))
        about[f'c{index:03d}'] = scene
    for group, cases in groups.items():
        os.makedirs(f'{a.out}/clips/{group}', exist_ok=True)
        for name, frames in cases:
            np.save(f'{a.out}/clips/{group}/{name}.npy', frames)
    with open(f'{a.out}/scenes.json', 'w') as f:
        json.dump(about, f)
    for algorithm in ALGORITHMS:
        for group in sorted(groups, key=lambda group: int(group.split('_')[1])):
            pattern, ratio, sigma = group.split('_')
            out = f'{a.out}/{algorithm}/{group}'
            if not os.path.exists(f'{out}/done'):
                subprocess.run([a.binary, 'assess', '--clips', f'{a.out}/clips/{group}', '--pattern', pattern, '--cr', ratio, '--noise-sigma', sigma,
                                '--algorithm', algorithm, '--scale', str(SIDE), '--out', out], check=True)
                open(f'{out}/done', 'w').close()


# ---------------------------------------------------------------- regressions
class Regression:
    """A ridge regression on inputs that are shifted, scaled and bounded, and on their products if asked for."""

    def __init__(self, inputs, wanted, weight, products):
        self.mean, self.products = inputs.mean(0), products
        self.scale = np.maximum(inputs.std(0), 1e-3)
        terms = self.terms(inputs)
        penalty = weight * len(terms) * np.eye(terms.shape[1])
        penalty[0, 0] = 0
        self.coefficients = np.linalg.solve(terms.T @ terms + penalty, terms.T @ wanted)

    def terms(self, inputs):
        z = ((inputs - self.mean) / self.scale).clip(-FARTHEST, FARTHEST)
        all_terms = [np.ones(len(z)), *z.T]
        if self.products:
            all_terms += [z[:, i] * z[:, j] for i in range(z.shape[1]) for j in range(i, z.shape[1])]
        return np.stack(all_terms, 1)

    def __call__(self, inputs):
        return self.terms(inputs) @ self.coefficients

    def record(self):
        return {name: [float(f'{value:.6g}') for value in getattr(self, name)] for name in ('mean', 'scale', 'coefficients')}


class Case:
    def __init__(self, path, scene):
        with open(path[:-3] + 'json') as f:
            about = json.load(f)
        seen = np.load(path).astype(float)                  # [features and the true error, frame, block]
        self.scene, self.psnr, self.white, self.frames = scene, min(about['psnr_db'], BEST), about['white'], seen.shape[1]
        self.features = seen[:-1].reshape(len(seen) - 1, -1).T
        self.error = np.log10(seen[-1].reshape(-1).clip(10 ** (-(BEST + 2) / 10)))
        stages = (about['pilot'] or {}).get('stages', [])
        error = lambda stage: min(-20 * np.log10(max(stage['error_after'], 1e-6)), BEST + SPARE)
        self.known = [error(stages[0]) if stages else 0, error(stages[-1]) if stages else 0,
                      stages[-1]['iterations'] / stages[-1]['planned'] if stages else 1, np.log10(self.white)]
        self.setting = (about['setting']['pattern'], about['cr'], about['setting']['noise_sigma'])

    def inputs(self, block):
        # The program keeps quarters of a decibel.
        levels = (np.round(-40 * block(self.features)) / 4).clip(0, 63.75).reshape(self.frames, -1)
        of_map = np.mean(-10 * np.log10((10 ** (-levels / 10)).mean(1) * self.white ** 2))
        return np.array([min(of_map, BEST + SPARE), *self.known, *self.features.mean(0)])


def fitted(cases, a):
    block = Regression(np.concatenate([case.features for case in cases]), np.concatenate([case.error for case in cases]), a.ridge, True)
    snapshot = Regression(np.stack([case.inputs(block) for case in cases]), np.array([case.psnr for case in cases]), a.ridge_snapshot, False)
    return block, snapshot


def fit(a):
    models = {}
    with open(f'{a.out}/scenes.json') as f:
        about = json.load(f)
    for algorithm in ALGORITHMS:
        paths = sorted(glob.glob(f'{a.out}/{algorithm}/*/*.npy'))
        cases = [Case(path, about[os.path.basename(path)[:-4]]) for path in paths if os.path.exists(path[:-3] + 'json')]
        names = sorted({case.scene for case in cases})
        fold = {name: index % FOLDS for index, name in enumerate(np.random.default_rng(1).permutation(names))}
        told = np.zeros(len(cases))
        for k in range(FOLDS):
            block, snapshot = fitted([case for case in cases if fold[case.scene] != k], a)
            for index, case in enumerate(cases):
                if fold[case.scene] == k:
                    told[index] = min(snapshot(case.inputs(block)[None])[0], BEST)
        wrong = np.array([case.psnr for case in cases]) - told
        # Of each half the interval of the other half.
        half = np.array([fold[case.scene] % 2 for case in cases])
        # A little wider than four of five cases of the fit: other scenes are worse.
        ends = lambda chosen: np.quantile(wrong[chosen], [.08, .92])
        inside = np.zeros(len(cases), bool)
        for k in (0, 1):
            low, high = ends(half != k)
            inside[half == k] = (wrong[half == k] >= low) & (wrong[half == k] <= high)
        print(f'{algorithm}: {len(cases)} cases of {len(names)} scenes; error {np.abs(wrong).mean():.2f} dB in the mean, 80 % within {np.quantile(np.abs(wrong), .8):.2f}, '
              f'{100 * np.mean(np.abs(wrong) < 1.5):.0f} % within 1.5; interval {ends(slice(None)).round(2)}, held by {100 * inside.mean():.0f} % left out')
        for pattern in PATTERNS:
            of = np.array([case.setting[0] == pattern for case in cases])
            if of.any():
                print(f'  {pattern}: {of.sum()} cases, {np.abs(wrong[of]).mean():.2f} dB, {100 * inside[of].mean():.0f} % in the interval')
        block, snapshot = fitted(cases, a)
        models[algorithm] = {'block': block.record(), 'snapshot': snapshot.record(), 'interval': [round(float(end), 2) for end in ends(slice(None))]}
    if a.write:
        with open(a.write, 'w') as f:
            json.dump(models, f)
            f.write('\n')


def main():
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument('what', choices=('make', 'fit'))
    p.add_argument('--binary', default='sci-recon-experiments')
    p.add_argument('--data', default='../../shared/training')
    p.add_argument('--scenes', default='../../shared/scenes')
    p.add_argument('--out', default='assessment-output')
    p.add_argument('--write', help='the file of the models')
    p.add_argument('--ridge', type=float, default=1e-3)
    p.add_argument('--ridge-snapshot', type=float, default=.03)
    a = p.parse_args()
    {'make': make, 'fit': fit}[a.what](a)


if __name__ == '__main__':
    main()
