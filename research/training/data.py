"""Footage -> random gray clips [frames, size, size], float32 on [0,1].

A data folder holds photos/{train,val}/*.jpg, clips/{train,val}/NAME/*.jpg and INDEX.tsv (columns `path` and `cuts_before_frame`).
"""
import csv
import glob
import math
import os

import cv2
import numpy as np

cv2.setNumThreads(1)   # several producers share the cores


def gray(path):
    return cv2.imread(path, cv2.IMREAD_GRAYSCALE)


class Footage:
    """Draws clips of one split: real video, and photographs under synthetic motion with occluding patches."""

    def __init__(self, root, split, seed, video=.5):
        self.random = np.random.default_rng(seed)
        self.lights = split == 'train'   # validation footage stays on [0,1] and unchanged
        self.photos = [gray(p) for p in sorted(glob.glob(f'{root}/photos/{split}/*.jpg'))]
        self.clips = []
        cuts = self.cuts(f'{root}/INDEX.tsv')
        for folder in sorted(glob.glob(f'{root}/clips/{split}/*')):
            frames = np.stack([gray(p) for p in sorted(glob.glob(folder + '/*.jpg'))])
            self.clips.append((frames, cuts.get(os.path.relpath(folder, root), [])))
        if not self.photos and not self.clips:
            raise SystemExit(f'no footage of the split {split!r} under {root}: README.md says how to get some')
        self.video = 0. if not self.clips else 1. if not self.photos else video
        weight = np.array([len(frames) for frames, _ in self.clips], float) ** .5
        self.weight = weight / max(weight.sum(), 1)

    @staticmethod
    def cuts(index):
        with open(index, encoding='utf8') as f:
            return {row['path'].rstrip('/'): [int(c) for c in (row['cuts_before_frame'] or '').split(',') if c]
                    for row in csv.DictReader(f, delimiter='\t')}

    def window(self, image, size, tries):
        """A crop of the last two axes: the one with the highest contrast among a few, because flat sky teaches nothing."""
        def pick():
            y, x = (int(self.random.integers(0, extent - size + 1)) for extent in image.shape[-2:])
            return image[..., y:y + size, x:x + size]
        return np.asarray(max((pick() for _ in range(tries)), key=np.std), np.float32) / 255

    def footage(self, size, count):
        """Consecutive frames of one shot, at one to three times its speed; None if the drawn shot is too short."""
        frames, cuts = self.clips[self.random.choice(len(self.clips), p=self.weight)]
        step = int(self.random.integers(1, 4))
        span = (count - 1) * step + 1
        if len(frames) < span or min(frames.shape[1:]) < size:
            return None
        start = int(self.random.integers(0, len(frames) - span + 1))
        if any(start < c < start + span for c in cuts):
            return None
        return self.window(frames[start:start + span:step], size, 2)

    def still(self, size):
        return self.window(self.photos[self.random.integers(len(self.photos))], size, 3)

    def motion(self, size, source, count, speed):
        """Affine maps of a camera that drifts, accelerates a little, turns and zooms over `count` frames."""
        r = self.random
        v, a = r.normal(0, speed, 2), r.normal(0, speed * .15, 2)
        turn, zoom, angle = r.normal(0, .01), r.normal(0, .008), r.uniform(-.2, .2)
        for t in range(count):
            u = t - count // 2
            c = math.cos(angle + turn * u) * (1 + zoom * u)
            s = math.sin(angle + turn * u) * (1 + zoom * u)
            m = np.array([[c, -s, 0], [s, c, 0]])
            m[:, 2] = source / 2 + v * u + a * u * u - m[:, :2] @ np.array([size / 2, size / 2])
            yield m

    def photograph(self, size, count):
        """A photograph under motion, with up to two independently moving patches of other photographs in front of it."""
        r, source = self.random, 2 * size
        def warp(image, m):
            return cv2.warpAffine(image, m, (size, size), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, borderMode=cv2.BORDER_REFLECT)
        background = self.still(source)
        x = np.stack([warp(background, m) for m in self.motion(size, source, count, abs(r.normal(0, 2.5)))])
        for _ in range(int(r.integers(0, 3))):
            patch, shape = self.still(source), np.zeros((source, source), np.float32)
            corners = source / 2 + r.normal(0, size * .25, 2) + r.normal(0, size * .28, (int(r.integers(3, 8)), 2))
            cv2.fillPoly(shape, [cv2.convexHull(corners.astype(np.int32))], 1.)
            shape = cv2.GaussianBlur(shape, (0, 0), .8)
            for t, m in enumerate(self.motion(size, source, count, abs(r.normal(0, 5)))):
                x[t] += warp(shape, m) * (warp(patch, m) - x[t])
        return x

    def sample(self, size, count):
        r, x = self.random, None
        while x is None:
            x = self.footage(size, count) if r.random() < self.video else self.photograph(size, count)
        if r.random() < .5: x = x[:, ::-1]
        if r.random() < .5: x = x[:, :, ::-1]
        if r.random() < .5: x = x.transpose(0, 2, 1)
        if r.random() < .5: x = x[::-1]
        if r.random() < .3:   # exposure: another level, which in some cases drifts over the clip
            gain = r.uniform(.6, 1.1) * np.linspace(1, r.uniform(.85, 1.15) if r.random() < .3 else 1, len(x))
            x = np.clip(x * gain[:, None, None], 0, 1)
        if self.lights and r.random() < .25:   # lights far above the white level, which the program estimates from the bulk of the measurement
            x = x + r.uniform(1, 6) * np.maximum(x - r.uniform(.4, .9), 0)
        return np.ascontiguousarray(x, np.float32)

    def batch(self, clips, count, size):
        return np.stack([self.sample(size, count) for _ in range(clips)])
