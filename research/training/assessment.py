"""Fit the quality model, which predicts the error of blocks and the PSNR of a snapshot without true frames.

    python assessment.py make --binary sci-recon-experiments --data DATA [--more FOLDER] --out FOLDER
    python assessment.py fit --out FOLDER... [--write ../../models/quality/model.onnx]

`make` simulates snapshots of 128x128 and, twice as many, of 256x256 pixels and has them reconstructed. The scenes are
photographs below a moving camera, half of them with independently moving parts, and clips. Masks are of every kind,
half of them blurred or with light through closed pixels; Cr is 6 to 24, noise 0 to 10. An interrupted run can be
continued, and at any time its cases are a mixture of all kinds. `fit` fits small networks to all cases, and reports
their error by cross-validation over scenes. It writes the file after each model, so that an interrupted one can be
continued with --model. The scenes of `eval_loop.py`, which judges the networks, are in no fit.
"""
import argparse
import copy
import glob
import hashlib
import json
import os
import subprocess

import cv2
import numpy as np
import onnx
import torch
from onnx import TensorProto, helper, numpy_helper
from torch import nn

import eval_loop
import export

SIDES, LONGEST, BLOCK = (128, 256, 256), 24, 16      # BLOCK as in the program
PATTERNS = eval_loop.FOLLOWING[0]
RATIOS = 6, 8, 10, 10, 12, 16, 20, 24
SIGMAS = 0, 0, 0, 2, 5, 10
# Pixels per frame. Static and fast scenes are frequent, because there the pilot removes most temporal changes, rightly
# or wrongly.
SPEEDS = 0, 0, 0, .3, 1, 2, 4, 7, 7, 7
ALGORITHMS = 'gap-tv', 'pnp-tv-fastdvdnet'
# Quality models: name -> (algorithm, whether temporal changes were shrunk by more than SHRUNK), as in the program.
MODELS = {'gap-tv': ('gap-tv', False), 'pnp-tv-fastdvdnet': ('pnp-tv-fastdvdnet', False), 'pnp-tv-fastdvdnet-shrunk': ('pnp-tv-fastdvdnet', True)}
SHRUNK = 1.0
# The next five lines repeat constants of crates/reconstruction/src/assessment.rs and quality.rs.
FEATURES, CHANNELS, SIGNS = 26, 128, 8  # features of a block, channels of the encoder, estimates from hold-out pixels
MOTION_DB, MOTION_WIDTH_DB, MIN_SHARE = 3.0, .3, .1     # see `first_run_estimate`
MAX_DEVIATION = 3.0             # largest scaled input
CONTRAST, GRADIENT = 11, 12     # indices of the features of the masks
APERTURE_CONTRAST, APERTURE_SHARPNESS = (-1.6, -1.0), .28
BEST = eval_loop.BEST
MARGIN = 10.0       # dB above BEST up to which the fit follows the true PSNR
COMPONENTS = 64     # principal components of the encoder's features
TOLERANCE = eval_loop.TOLERANCE   # dB; the weight of larger misses saturates in the fit
MIN_CASES = 5       # cases below BEST that an interval needs in each half
BLOCKS_PER_STEP = 64  # blocks of a case in a training step, each in all frames
WHOLE = slice(14, 17)  # features of the whole frame
# The white level in dB is an input of the fit only: the stated full scale of a measurement must not change a relative
# error, so the program uses its mean.
WHITE, WHITE_SCALE, WHITE_INPUT = -5.5, 5., 4 * FEATURES
JOINED = .6         # share of cases that are joined to a part of another case
WHITE_TOLERANCE = 6.0  # dB between the white levels of two cases that may be joined


# ---------------------------------------------------------------- scenes
def grey(file, smaller, least):
    """A photograph, smaller by a factor, but no side of it below `least` pixels."""
    photo = cv2.imread(file, cv2.IMREAD_GRAYSCALE).astype(np.float32)
    factor = max(smaller, least / min(photo.shape))
    return cv2.resize(photo, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)


def parts(rng, others, wide):
    """Parts that move independently, as (image, mask, position, step per frame): none, one large part of another
    photograph, or many small rectangles and ellipses that cover one another."""
    kind = rng.random()
    sides = [[int(rng.integers(wide // 5, wide * 9 // 20))] * 2] if kind < .25 else \
        [rng.integers(8, wide // 4, 2).tolist() for _ in range(rng.integers(3, 3 + wide // 14))] if kind < .5 else []
    for height, width in sides:
        other = grey(others[rng.integers(len(others))], .25, max(height, width) + 1)
        row, column = (int(rng.integers(0, extent - side)) for extent, side in zip(other.shape, (height, width)))
        shape = np.ones((height, width), np.float32)
        if len(sides) > 1 and rng.random() < .5:
            i, j = np.mgrid[:height, :width]
            shape = ((2 * (i + .5) / height - 1) ** 2 + (2 * (j + .5) / width - 1) ** 2 < 1).astype(np.float32)
        way, speed = rng.uniform(0, 2 * np.pi), rng.uniform(0, 6)
        yield other[row:row + height, column:column + width], shape, rng.uniform(-width / 2, wide - width / 2, 2), speed * np.array([np.cos(way), np.sin(way)])


def panned(rng, file, others, wide):
    """A camera that moves over a photograph, perhaps with parts of other photographs that move independently."""
    photo = grey(file, rng.choice([.2, .3, .45, .7]), wide + 40)
    angle, speed, turn, light = rng.uniform(0, 2 * np.pi), rng.choice(SPEEDS), rng.choice([0, 0, .5]), rng.choice([1, 1, .6, .3])
    centre = [extent * (.5 + rng.uniform(-.2, .2)) for extent in photo.shape[::-1]]
    before, frames = list(parts(rng, others, wide)), []
    for time in np.arange(LONGEST) - (LONGEST - 1) / 2:
        above = centre[0] + time * speed * np.cos(angle), centre[1] + time * speed * np.sin(angle)
        frame = eval_loop.seen(photo, above, turn * time, wide)
        for part, shape, place, step in before:
            shift = np.float32([[1, 0, place[0] + time * step[0]], [0, 1, place[1] + time * step[1]]])
            cover, moved = (cv2.warpAffine(values, shift, (wide, wide), flags=cv2.INTER_LINEAR) for values in (shape, part * shape))
            frame = frame * (1 - cover) + moved
        frames.append(frame)
    return (np.stack(frames) * light).clip(0, 255).round().astype(np.uint8)


def cropped(rng, clip, wide):
    """A part of a clip, at its own or at half its size."""
    height, width = clip.shape[1:]
    side = int(wide * (rng.choice([1, 2]) if min(height, width) >= 2 * wide else 1))
    row, column = int(rng.integers(0, height - side + 1)), int(rng.integers(0, width - side + 1))
    first = int(rng.integers(0, max(1, len(clip) - LONGEST)))
    part = clip[first:first + LONGEST, row:row + side, column:column + side]
    return np.stack([cv2.resize(frame, (wide, wide), interpolation=cv2.INTER_AREA) for frame in part])


def softness(rng, pattern):
    """Blur of the masks by a lens (standard deviation in pixels) and the light that closed pixels let through, for half
    of the cases. With more blur, masks of the hybrid aperture carry no information on temporal changes."""
    if rng.random() < .5:
        return 0, 0
    most = 1.3 if pattern == 'iid' else .7
    blur, leak = (round(float(rng.uniform(least, greatest)), 2) if rng.random() < share else 0 for share, least, greatest in ((.75, .3, most), (.4, .05, .4)))
    return blur, leak


def cases(a):
    """Name, scene, frames [B,H,W] (uint8), kind of masks, their blur and leak, noise and seed of each case, in an order that mixes all of them."""
    photos = sorted(glob.glob(f'{a.data}/photos/train/*.jpg')) + sorted(glob.glob(f'{a.data}/photos/val/*.jpg'))
    clips = {os.path.basename(folder): eval_loop.pictures(folder) for folder in sorted(glob.glob(f'{a.data}/clips/*/*'))}
    if a.more:
        photos += sorted(glob.glob(f'{a.more}/*.jpg') + glob.glob(f'{a.more}/*.png'))
        clips |= {os.path.basename(file)[:-4]: np.load(file) for file in sorted(glob.glob(f'{a.more}/*.npy'))}
    judged = eval_loop.judged()
    photos, clips = [photo for photo in photos if os.path.basename(photo) not in judged], {name: clip for name, clip in clips.items() if name not in judged}
    all_of = [(photo, None) for photo in photos for _ in range(4)] + [(name, clip) for name, clip in clips.items() for _ in range(8)]
    sides = (a.side,) if a.side else SIDES
    for number, index in enumerate(np.random.default_rng(11).permutation(len(all_of))):
        (scene, clip), rng = all_of[index], np.random.default_rng([5, int(index)])
        fitting = [side for side in sides if clip is None or side <= min(clip.shape[1:])]
        if not fitting:     # a clip smaller than the pictures that are wanted
            continue
        wide = int(rng.choice(fitting))
        frames = panned(rng, scene, photos, wide) if clip is None else cropped(rng, clip, wide)
        ratio = int(rng.choice([ratio for ratio in RATIOS if ratio <= len(frames)]))
        pattern, sigma = PATTERNS[rng.integers(len(PATTERNS))], int(rng.choice(SIGMAS))
        seeds = {algorithm: int(rng.integers(1e6)) for algorithm in ALGORITHMS}
        seeds = {algorithm: seed for algorithm, seed in seeds.items() if a.algorithm in (None, algorithm)}
        yield f'c{number:04d}', os.path.basename(scene), frames[:ratio], pattern, softness(np.random.default_rng([7, int(index)]), pattern), sigma, seeds


def make(a):
    if len(a.out) > 1:
        raise SystemExit(f"make writes to one folder, and --out names {len(a.out)}: {', '.join(a.out)}")
    part, parts = (int(number) for number in a.part.split('/'))
    for number, (name, scene, frames, pattern, (blur, leak), sigma, seeds) in enumerate(cases(a)):
        folder = f'{a.out[0]}/{name}'
        if number % parts != part or os.path.exists(f'{folder}/scene.json'):
            continue
        os.makedirs(f'{folder}/clip', exist_ok=True)
        np.save(f'{folder}/clip/{name}.npy', frames)
        for algorithm, seed in seeds.items():
            subprocess.run([a.binary, 'assess', '--clips', f'{folder}/clip', '--pattern', pattern, '--blur', str(blur), '--leak', str(leak),
                            '--cr', str(len(frames)), '--noise-sigma', str(sigma),
                            '--algorithm', algorithm, '--scale', str(frames.shape[1]), '--seed', str(seed), '--out', f'{folder}/{algorithm}'], check=True)
        with open(f'{folder}/scene.json', 'w') as f:
            json.dump(scene, f)


# ---------------------------------------------------------------- networks
class Case:
    """The features of a reconstructed snapshot, and its true error."""

    def __init__(self, folder, algorithm):
        path = f'{folder}/{algorithm}/{os.path.basename(folder)}'
        with open(path + '.json') as f:
            about = json.load(f)
        with open(f'{folder}/scene.json') as f:
            self.scene, self.source = json.load(f), os.path.dirname(folder)
        # [features and the true error, frame, block]; an unknown feature has the mean value, as in the program.
        seen = np.load(path + '.npy').astype(np.float32)
        self.psnr, self.frames, self.side = about['psnr_db'], seen.shape[1], round(seen.shape[2] ** .5)
        self.white = 20 * np.log10(about['white'])
        values = lambda rows: torch.from_numpy(rows.reshape(len(rows), seen[0].size).T.copy())
        both = lambda rows: (values(rows[:FEATURES]), values(rows[FEATURES:]).half())
        one = FEATURES + CHANNELS if len(seen) > FEATURES + 1 else FEATURES
        self.features, self.encoded = both(seen[:one])
        # The first run of a stage that was run twice.
        self.first = self.distance = None
        if len(seen) > one + 1:
            self.first, self.distance = both(seen[one:2 * one]), 10 ** values(seen[2 * one:2 * one + 1])[:, 0]
        self.error = torch.from_numpy(np.log10(seen[-1].reshape(-1).clip(10 ** (-(BEST + MARGIN) / 10))))
        self.set_evidence(about['evidence'])
        self.first_evidence = about['evidence'].get('first')
        self.masks, self.noise = about['setting']['pattern'], about['setting']['noise_sigma']
        self.pattern, *softened = self.masks.split(', ')
        self.softened = bool(softened)
        # As `unfamiliar_masks` of the program has it.
        contrast, gradient = (float(self.features[:, feature].mean()) for feature in (CONTRAST, GRADIENT))
        least, greatest = APERTURE_CONTRAST
        self.unfamiliar = contrast < greatest and (contrast < least or gradient - contrast < APERTURE_SHARPNESS)
        # The default's pilot shrinks changes along time; gap-tv has none.
        stages = [decided['stage'] for decided in about['pilot']['stages']] if about.get('pilot') else []
        self.shrunk = any((stage.get('static_shrinkage') or stage.get('temporal_shrinkage', 0)) > SHRUNK for stage in stages)

    def set_evidence(self, evidence):
        self.signs = torch.tensor([self.white, *evidence['signs']], dtype=torch.float32)
        self.piece = torch.tensor(evidence['features'], dtype=torch.float32)

    def first_run(self):
        """The frames of the first run of a stage that was run twice, as a case without a true error."""
        case = copy.copy(self)
        case.features, case.encoded = self.first
        case.set_evidence(self.first_evidence)
        return case

    def first_run_estimate(self, first_errors):
        """Combine both runs of a stage, from `first_errors`, the decimal logarithms of the predicted errors of the
        first run. Returns the weight of this estimate, and the estimated errors of the result.

        If the scene is static, the second run has removed only errors. The distance of both results then equals the
        error of the first one. If it has removed motion, the first result is further from the truth, by the error that
        both share."""
        error = 10 ** first_errors
        result = torch.log10(torch.maximum(error - self.distance, MIN_SHARE * error))
        excess = 10 * torch.log10(error.mean() / self.distance.mean())
        return torch.sigmoid((excess - MOTION_DB) / MOTION_WIDTH_DB), result

    def psnr_of(self, errors):
        """PSNR from the decimal logarithms of the errors of blocks, with equally many blocks in each frame."""
        return (-10 * torch.log10((10 ** errors).reshape(self.frames, -1).mean(1))).mean() - self.white


def encoder():
    """SHA-256 of the encoder in the program: a model is fitted to the features of this encoder only."""
    with open(os.path.join(eval_loop.HERE, '../../models/fastdvdnet-gray-encoder/model.onnx'), 'rb') as f:
        return hashlib.sha256(f.read()).hexdigest()


def scaling(values, least):
    return values.mean(0), values.std(0).clamp_min(least)


def scaled(values, by):
    return ((values - by[0]) / by[1]).clamp(-MAX_DEVIATION, MAX_DEVIATION)


class Model:
    """Mean of several networks with two hidden layers, fitted to the same cases from different initial weights."""

    def __init__(self, cases, a, start=None, first=None):
        """Fit to cases, starting from the record of a model if one is given; `first` is the model of first runs."""
        self.first = first
        if start:
            self.scale_as(start)
        else:
            self.scale(cases)
        inputs, firsts, others = [self.inputs(case).half() for case in cases], [self.first_run_estimate(case) for case in cases], self.partners(cases)
        self.networks = []
        for seed, known in enumerate(self.layers(start) if start else [None] * a.networks):
            torch.manual_seed(seed)
            network = self.network(inputs[0].shape[1], known)
            if known is None:
                nn.init.constant_(network[-1].bias, float(torch.cat([case.error for case in cases]).mean()))
            self.networks.append(self.fitted(network, cases, inputs, firsts, others, a))

    @classmethod
    def read(cls, record, first=None):
        """The model of a record."""
        model = cls.__new__(cls)
        model.first = first
        model.scale_as(record)
        model.networks = [cls.network(len(known[0][0]), known).eval() for known in cls.layers(record)]
        return model

    @staticmethod
    def layers(record):
        """For each network its layers, as weights [input, neuron] and biases; the white level has the weight 0."""
        layers = [[torch.tensor(record[f'layer{number}/{part}']) for part in ('weights', 'bias')] for number in (1, 2, 3)]
        weights = layers[0][0]
        layers[0][0] = torch.cat([weights[:, :WHITE_INPUT], torch.zeros(len(weights), 1, weights.shape[2]), weights[:, WHITE_INPUT:]], 1)
        return [[(weights[index], bias[index, 0]) for weights, bias in layers] for index in range(len(weights))]

    def scale_as(self, record):
        by = lambda name: tuple(torch.tensor(record[f'{name}/{part}']) for part in ('mean', 'scale'))
        self.features = by('features')
        self.signs = self.with_white(by('signs'))
        self.encoding = (torch.tensor(record['encoder/mean']), torch.tensor(record['encoder/components']).T) if 'encoder/mean' in record else None

    @staticmethod
    def with_white(scaling):
        return tuple(torch.cat([torch.tensor([white]), values]) for white, values in zip((WHITE, WHITE_SCALE), scaling))

    def scale(self, cases):
        self.features = scaling(torch.cat([case.features for case in cases]), .05)
        self.signs = self.with_white(scaling(torch.stack([case.signs[1:] for case in cases]), 1e-3))
        self.encoding = self.principal(torch.cat([case.encoded[::37].float() for case in cases])) if cases[0].encoded.shape[1] else None

    @staticmethod
    def principal(seen):
        """The mean, and the weights of the principal components, scaled to unit variance."""
        mean, scale = scaling(seen, 1e-3)
        values, axes = torch.linalg.eigh(torch.cov(((seen - mean) / scale).T))
        values, axes = values.flip(0)[:COMPONENTS], axes.flip(1)[:, :COMPONENTS]
        return mean, (axes / values.sqrt()).T / scale

    def inputs(self, case):
        """Inputs of each block: its features, those of the blocks around it, their mean over the frames, those of the
        piece, and those of the encoder."""
        features = scaled(case.features, self.features)
        frames = features.reshape(case.frames, case.side, case.side, -1).permute(0, 3, 1, 2)
        around = nn.functional.avg_pool2d(frames, 3, 1, 1, count_include_pad=False)
        always = around.mean(0, keepdim=True).expand_as(around)
        around, always = (values.permute(0, 2, 3, 1).reshape(features.shape) for values in (around, always))
        rest = torch.cat([scaled(case.piece, self.features), scaled(case.signs, self.signs)])
        all_of = [features, around, always, rest.expand(len(features), -1)]
        if self.encoding:
            mean, components = self.encoding
            all_of.append(((case.encoded.float() - mean) @ components.T).clamp(-MAX_DEVIATION, MAX_DEVIATION))
        return torch.cat(all_of, 1)

    @staticmethod
    def network(count, known):
        network = nn.Sequential(nn.Linear(count, 64), nn.SiLU(), nn.Dropout(.15), nn.Linear(64, 16), nn.SiLU(), nn.Linear(16, 1))
        with torch.no_grad():
            for layer, known in zip([layer for layer in network if isinstance(layer, nn.Linear)], known or []):
                layer.weight.copy_(known[0].T)
                layer.bias.copy_(known[1])
        return network

    def first_run_estimate(self, case):
        """Estimate from the first run of a case: see `Case.first_run_estimate`."""
        if case.first is None or self.first is None:
            return torch.tensor(0.), torch.zeros_like(case.error)
        return case.first_run_estimate(self.first.errors(case.first_run()))

    def joined(self, one, other, share):
        """Inputs [frame, block, input] of an image that contains a share of the other's blocks, and the piece of the
        first one."""
        rest = slice(3 * FEATURES, 3 * FEATURES + FEATURES + len(self.signs[0]))
        other[:, :, rest] = one[:, :1, rest]
        mean, scale = (values[WHOLE] for values in self.features)
        energy = lambda of: 10 ** (of[:, 0, WHOLE] * scale + mean)
        whole = scaled(torch.log10((1 - share) * energy(one) + share * energy(other)), (mean, scale))
        both = torch.cat([one, other], 1)
        for kind, values in enumerate((whole, whole, whole.mean(0, keepdim=True))):     # the block, its neighbourhood, all frames
            both[:, :, kind * FEATURES + WHOLE.start:kind * FEATURES + WHOLE.stop] = values[:, None]
        return both

    def partners(self, cases):
        """Indices of the cases that may be joined to each case; none if first runs are used, because they concern whole
        images."""
        like = lambda one, other: (one.masks, one.frames, one.noise) == (other.masks, other.frames, other.noise) and abs(one.white - other.white) < WHITE_TOLERANCE
        return [[] if self.first else [place for place, other in enumerate(cases) if other is not case and like(case, other)] for case in cases]

    def fitted(self, network, cases, inputs, firsts, others, a):
        """Fit a network to cases from their inputs and the estimates of first runs, with some cases joined to similar
        ones."""
        count = inputs[0].shape[1]
        optimiser = torch.optim.AdamW(network.parameters(), a.rate, weight_decay=.05)
        batches = torch.arange(len(cases)).split(8)
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, a.rate, total_steps=a.epochs * len(batches))
        for _ in range(a.epochs):
            order = torch.randperm(len(cases))
            for batch in batches:
                drawn, seen, errors, by_first = [cases[index] for index in order[batch].tolist()], [], [], []
                for index, case in zip(order[batch].tolist(), drawn):
                    blocks = torch.randperm(case.side ** 2)[:BLOCKS_PER_STEP]
                    of = lambda index, values, blocks: values.reshape(cases[index].frames, cases[index].side ** 2, -1)[:, blocks].float()
                    if others[index] and torch.rand(()) < JOINED:
                        # In small images the piece covers half of the area; in large ones less, and the rest differs from it.
                        other, part = others[index][int(torch.randint(len(others[index]), ()))], int(BLOCKS_PER_STEP * torch.empty(()).uniform_(.2, .9))
                        blocks, there = blocks[part:], torch.randperm(cases[other].side ** 2)[:part]
                        given = self.joined(of(index, inputs[index], blocks), of(other, inputs[other], there), part / BLOCKS_PER_STEP)
                        error = torch.cat([of(index, case.error, blocks), of(other, cases[other].error, there)], 1)
                        estimate = torch.zeros_like(error)
                    else:
                        given, error, estimate = (of(index, values, blocks) for values in (inputs[index], case.error, firsts[index][1]))
                    # The cases of a fit resemble each other more than future cases do, so common noise is added.
                    seen.append(given.flatten(0, 1) + .1 * torch.randn(1, count))
                    errors.append(error.flatten())
                    by_first.append((firsts[index][0], estimate.flatten()))
                seen = torch.cat(seen)
                predictions = network(seen + .05 * torch.randn_like(seen))[:, 0].split([len(of_case) for of_case in errors])
                loss = 0
                for case, predicted, error, (share, estimate) in zip(drawn, predictions, errors, by_first):
                    predicted = share * estimate + (1 - share) * predicted
                    wanted = case.psnr_of(error).clamp(max=BEST + MARGIN)
                    # Welsch's loss, because unpredictable cases would outweigh the others.
                    off = case.psnr_of(predicted) - wanted
                    loss = loss + ((predicted - error) ** 2).mean() + 1.5 * (1 - torch.exp(-.5 * (off / TOLERANCE) ** 2))
                optimiser.zero_grad()
                (loss / len(batch)).backward()
                optimiser.step()
                schedule.step()
        return network.eval()

    def errors(self, case):
        """Decimal logarithms of the errors of the blocks."""
        with torch.no_grad():
            inputs = self.inputs(case)
            share, estimate = self.first_run_estimate(case)
            return share * estimate + (1 - share) * torch.stack([network(inputs)[:, 0] for network in self.networks]).mean(0)

    def __call__(self, case):
        """Errors of the blocks, and the PSNR."""
        errors = self.errors(case)
        return errors.numpy(), float(case.psnr_of(errors))

    def move(self, by):
        """Shift the predicted PSNR by `by` dB."""
        with torch.no_grad():
            for network in self.networks:
                network[-1].bias -= by / 10

    def record(self):
        """The arrays that the program needs, by their names in the file."""
        record = {f'{name}/{part}': values for name, scaling in (('features', self.features), ('signs', [values[1:] for values in self.signs]))
                  for part, values in zip(('mean', 'scale'), scaling)}
        if self.encoding:
            record |= {'encoder/mean': self.encoding[0], 'encoder/components': self.encoding[1].T}
        linear = zip(*([layer for layer in network if isinstance(layer, nn.Linear)] for network in self.networks))
        for number, layers in enumerate(linear, 1):
            record[f'layer{number}/weights'] = torch.stack([layer.weight.detach().T for layer in layers])
            record[f'layer{number}/bias'] = torch.stack([layer.bias.detach()[None] for layer in layers])
        record = {name: values.numpy() for name, values in record.items()}
        record['layer1/weights'] = np.delete(record['layer1/weights'], WHITE_INPUT, 1)
        return record


# ---------------------------------------------------------------- the file
def graph_of(g, model, record):
    """Nodes from the inputs of the file to the decimal logarithms of the errors [frames, rows, columns], the output `model`.
    NaN are unknown: then the crop is the whole picture, and other features are the means of the fit."""
    known = {name: g.constant(values.astype(np.float32), f'{model}/{name}') for name, values in record.items()}
    add, limits = g.add, [g.constant(np.float32(end)) for end in (-MAX_DEVIATION, MAX_DEVIATION)]
    scaled = lambda values, by: add('Clip', add('Div', add('Sub', values, known[f'{by}/mean']), known[f'{by}/scale']), *limits)
    last = lambda values: add('Transpose', values, perm=[0, 2, 3, 1])       # features or channels become the last axis
    or_else = lambda values, found, other: add('Where', add('IsNaN', values), other, found)
    own = scaled(last('features'), 'features')
    pooled = add('AveragePool', add('Transpose', own, perm=[0, 3, 1, 2]), kernel_shape=[3, 3], pads=[1, 1, 1, 1], count_include_pad=0)
    around = last(pooled)
    always = add('Expand', add('ReduceMean', around, axes=[0]), add('Shape', around))
    crop = or_else('crop', scaled('crop', 'features'), add('ReduceMean', own, axes=[0, 1, 2], keepdims=0))
    signs = or_else('signs', scaled('signs', 'signs'), g.constant(np.float32(0)))
    size = add('Slice', add('Shape', own), g.ints([0]), g.ints([3]))
    shared = add('Concat', crop, signs, axis=0)
    parts = [own, around, always, add('Expand', shared, add('Concat', size, add('Shape', shared), axis=0))]
    if 'encoder/mean' in record:
        encoded = last('encoded')
        shifted = or_else(encoded, add('Sub', encoded, known['encoder/mean']), g.constant(np.float32(0)))
        parts.append(add('Clip', add('MatMul', shifted, known['encoder/components']), *limits))
    values = add('Reshape', add('Concat', *parts, axis=3), g.ints([-1, record['layer1/weights'].shape[1]]))
    for number in (1, 2, 3):
        values = add('Add', add('MatMul', values, known[f'layer{number}/weights']), known[f'layer{number}/bias'])
        values = add('Mul', values, add('Sigmoid', values)) if number < 3 else values
    g.nodes.append(helper.make_node('Reshape', [add('ReduceMean', values, axes=[0]), size], [model]))


def write(path, models):
    """Write models as one ONNX file. The program reads its constants, and the misses of each model in the metadata."""
    g = export.Graph()
    for model, (record, _) in models.items():
        graph_of(g, model, record)
    tensor = lambda name, *sides: helper.make_tensor_value_info(name, TensorProto.FLOAT, sides)
    inputs = [tensor('features', 'frames', FEATURES, 'rows', 'columns'), tensor('encoded', 'frames', CHANNELS, 'rows', 'columns'),
              tensor('crop', FEATURES), tensor('signs', SIGNS)]
    graph = helper.make_graph(g.nodes, 'quality', inputs, [tensor(model, 'frames', 'rows', 'columns') for model in models], g.constants)
    m = helper.make_model(graph, opset_imports=[helper.make_opsetid('', export.OPSET)], ir_version=8, producer_name='sci-recon training')
    helper.set_model_props(m, {'encoder': encoder()} | {model: json.dumps(misses) for model, (_, misses) in models.items()})
    onnx.checker.check_model(m, full_check=True)
    onnx.save(m, path)


def read(path):
    """The record and the misses of each model of a file."""
    file = onnx.load(path)
    properties = {one.key: one.value for one in file.metadata_props}
    if properties.pop('encoder') != encoder():
        raise SystemExit(f'{path} was fitted to another encoder')
    arrays = {one.name: numpy_helper.to_array(one) for one in file.graph.initializer}
    part = lambda model: {name[len(model) + 1:]: values.copy() for name, values in arrays.items() if name.startswith(model + '/')}
    return {model: (part(model), json.loads(misses)) for model, misses in properties.items()}


def settle(true, predicted, half, unshifted, outside):
    """Offset of all predictions, and their interval, from cases in two halves. Also returns the remaining error of each
    case, and whether it is in the interval.

    Predicted errors of blocks are too even, so their mean is too small. Predictions are therefore shifted to the median
    error; each half uses the offset and interval of the other half. With `unshifted`, nothing is shifted. A share of
    `outside` of the cases lies beyond either end of the interval."""
    median = lambda chosen: 0 if unshifted else np.median((true - predicted)[chosen & (predicted < BEST)])
    wrong = true - (predicted + np.where(half == 0, median(half == 1), median(half == 0))).clip(max=BEST)
    ends = lambda chosen: np.quantile(wrong[chosen], [outside, 1 - outside])
    inside = np.zeros(len(true), bool)
    for k in (0, 1):
        low, high = ends(half != k)
        inside[half == k] = (wrong[half == k] >= low) & (wrong[half == k] <= high)
    return median(half >= 0), ends(half >= 0), wrong, inside


def fit(a):
    models, start = {}, None
    if not a.epochs and not a.start:
        raise SystemExit('--epochs 0 needs the models of a file: --start')
    if a.start:
        start = {name: record for name, (record, _) in read(a.start).items()}
    if a.write and os.path.exists(a.write):
        models = read(a.write)
    for name in [a.model] if a.model else MODELS:
        algorithm, shrunk = MODELS[name]
        paths, judged = [path for folder in a.out for path in sorted(glob.glob(f'{folder}/*/scene.json'))], eval_loop.judged()
        cases = [Case(os.path.dirname(path), algorithm) for path in paths]
        cases = [case for case in cases if case.shrunk == shrunk and case.scene not in judged]
        if not cases:
            raise SystemExit(f"{', '.join(a.out)} has no cases for the model of {name}")
        # Strongly shrunk cases are few, so their model can start from that of the other cases.
        known = start and start.get(name, start[algorithm])
        others = models[algorithm][0] if algorithm in models else start and start[algorithm]
        if shrunk and not others:
            raise SystemExit(f'{name} needs the model of {algorithm} first: fit that, or give a file that has it (--write, --start)')
        first = Model.read(others) if shrunk else None
        names = sorted({case.scene for case in cases})
        fold = {name: index % a.folds for index, name in enumerate(np.random.default_rng(1).permutation(names))}
        predicted, spread = np.zeros(len(cases)), []
        # With --epochs 0, no model was fitted to these cases, so one model predicts all of them.
        made = lambda of: Model(of, a, known, first) if a.epochs else Model.read(known, first)
        for k in range(a.folds):
            model = made([case for case in cases if fold[case.scene] != k])
            for index, case in enumerate(cases):
                if fold[case.scene] == k:
                    errors, predicted[index] = model(case)
                    spread.append(np.corrcoef(errors, case.error)[0, 1])
        true, half = np.array([min(case.psnr, BEST) for case in cases]), np.array([fold[case.scene] % 2 for case in cases])
        unfamiliar = np.array([case.unfamiliar for case in cases])
        wrong, inside, settled = np.zeros(len(cases)), np.zeros(len(cases), bool), []
        # A little wider than four of five cases of the fit, because other scenes have larger errors.
        outside = .08 if a.epochs else .1
        for of, moved in ((~unfamiliar, a.epochs and not first), (unfamiliar, True)):
            if any(sum(of & (half == k) & (predicted < BEST)) < MIN_CASES for k in (0, 1)):
                raise SystemExit(f'{name}: an interval needs {MIN_CASES} cases below {BEST:.0f} dB in each half of the scenes, both behind unfamiliar masks and '
                                 f'behind others; {sum(unfamiliar)} of {len(cases)} cases are behind unfamiliar masks: make more')
            # Estimates from first runs are mostly better than BEST, so their median carries no information.
            *by_all, wrong[of], inside[of] = settle(true[of], predicted[of], half[of], not moved, outside)
            settled.append(by_all)
        (by, interval), (by_unfamiliar, of_unfamiliar) = settled
        everywhere = np.ones(len(cases), bool)
        print(f'{name}: moved by {by:+.2f}; interval {interval.round(2)}; behind unfamiliar masks {by_unfamiliar:+.2f} and {of_unfamiliar.round(2)}; '
              f'correlation of the map {np.nanmedian(spread):.2f}')
        kinds = {f"all, of {len(names)} scenes, {'each left out' if a.epochs else 'in no fit'}": everywhere} | {pattern: [case.pattern == pattern for case in cases] for pattern in PATTERNS}
        kinds |= {'blurred or with light': [case.softened for case in cases], 'neither': [not case.softened for case in cases], 'unfamiliar': unfamiliar}
        kinds |= {f'{side}x{side}': [case.side * BLOCK == side for case in cases] for side in sorted(set(SIDES))}
        kinds |= {folder: [case.source == folder for case in cases] for folder in a.out if len(a.out) > 1}
        for kind, of in kinds.items():
            if np.any(of):
                found = eval_loop.accuracy(wrong[of], inside[of])
                print(f"  {kind}: {found['snapshots']} cases, {found['mean_db']} dB on average, 80 % within {found['four_of_five_db']}, "
                      f"{found['near_percent']} % within {TOLERANCE}, {found['inside_percent']} % in the interval")
        model = made(cases)
        model.move(by)
        rounded = lambda values: [round(float(value), 2) for value in values]
        models[name] = model.record(), {'interval': rounded(interval), 'unfamiliar': {'offset': rounded([by_unfamiliar - by])[0], 'interval': rounded(of_unfamiliar)}}
        if a.write:
            write(a.write, models)


def main():
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument('what', choices=('make', 'fit'))
    p.add_argument('--binary', default='sci-recon-experiments')
    p.add_argument('--data', default='../../../shared/training')
    p.add_argument('--more', help='a folder of further photographs (.jpg, .png) and clips (.npy, [frame, row, column] of uint8)')
    p.add_argument('--out', nargs='+', default=['assessment-output'], help='the folder of the cases; `fit` takes several')
    p.add_argument('--write', help='the file of the models')
    p.add_argument('--part', default='0/1', help='K/N: every Nth case from the Kth on, to divide the work')
    p.add_argument('--side', type=int, help='side of the images in pixels [default: a mixture]')
    p.add_argument('--epochs', type=int, default=24, help='0 keeps the models of --start, and fits only their intervals, to cases that they have not seen')
    p.add_argument('--start', help='a file of models to start from, if there are few cases')
    p.add_argument('--rate', type=float, default=5e-3, help='the highest learning rate; use a lower one with --start')
    p.add_argument('--algorithm', choices=ALGORITHMS, help='make cases of this algorithm only')
    p.add_argument('--model', choices=MODELS, help='fit this model only')
    p.add_argument('--folds', type=int, default=5, help='folds of the cross-validation')
    p.add_argument('--networks', type=int, default=3, help='networks that are averaged; with --start, as many as the file has')
    a = p.parse_args()
    {'make': make, 'fit': fit}[a.what](a)


if __name__ == '__main__':
    main()
