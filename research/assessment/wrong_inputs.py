"""Test whether wrong inputs are flagged by a finding that names their cause, and whether right ones are not.

    python wrong_inputs.py run SCI_RECON_BINARY --data DATA --out FOLDER [--scenes 20] [--good 60]
        [--kinds TEXT...] [--registration off]
    python wrong_inputs.py report --out FOLDER [--markdown] [--write WRONG_INPUTS.md]

DATA has photographs in photos/train and photos/val. A camera moves over them by at most 4 pixels per frame, behind
masks of every kind, Cr 6 to 24, with noise of 0 to 10 and given dark frames. Clips in clips/train and clips/val,
folders of frames, test for false alarms in real motion. `run` gives each kind of input of each scene to `sci-recon
reconstruct`, which runs the checks of the service, and appends the results to a file in FOLDER for this binary: an
interrupted run continues where it stopped. `report` reads the newest file. It counts, for each kind, how many inputs
are flagged at all, and for how many the first finding names the cause. The last line of a report is JSON.
"""
import argparse
import concurrent.futures
import dataclasses
import glob
import hashlib
import json
import os
import pathlib
import re
import subprocess
import sys
import tempfile
import threading

import cv2
import numpy as np

PATTERNS = 'iid', 'random-squares', 'rotating-circle'
RATIOS = 6, 8, 10, 12, 16, 20, 24
SIGMAS = 0, 0, 0, 2, 5, 10
STEPS = 0, .3, 1, 2, 4
# Offset that the camera adds, as a share of the mean, and the brightest pixel as a share of the largest number.
DARK, HEADROOM = .1, .8
SIXTEEN = 65535
LOSS = 3.0      # dB that a harmful input costs
SEEN = .5       # dB that a wrong order costs where the scene shows it
BAD = 22.0      # dB, as in the program
UNEVEN = 1.0    # dB that a part is worse, if `uneven_error` is right


# ---------------------------------------------------------------- scenes
def photographs(data):
    files = sorted(glob.glob(f'{data}/photos/val/*.jpg') + glob.glob(f'{data}/photos/train/*.jpg'))
    return files or sys.exit(f'no photographs in {data}/photos')


def panned(photo, frames, side, step, scale):
    """Frames [frames,side,side] on [0,1] of a camera that moves by `step` pixels per frame over a grey photograph."""
    scale = max(scale, (side + 2) / min(photo.shape))
    photo = cv2.resize(photo, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA).astype(np.float32) / 255
    middle = np.array(photo.shape[::-1]) / 2 - side / 2
    matrix = lambda k: np.float32([[1, 0, -middle[0] - (k - frames / 2) * step], [0, 1, -middle[1]]])
    return np.stack([cv2.warpAffine(photo, matrix(k), (side, side), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT) for k in range(frames)]).clip(0, 1)


def filmed(clips, index, count, side):
    """Frames [count,side,side] on [0,1] of a clip, where most of it moves. Every eighth of a clip is a scene."""
    clip = clips[index % len(clips)]
    files = sorted(glob.glob(f'{clip}/*'))
    start = (len(files) - count) * (index // len(clips) % 8) // 7
    frames = np.stack([cv2.imread(file, cv2.IMREAD_GRAYSCALE) for file in files[start:start + count]]).astype(np.float32) / 255
    change = cv2.boxFilter(np.abs(np.diff(frames, axis=0)).mean(0), -1, (side, side))
    half = side // 2
    row, column = np.unravel_index(np.argmax(change[half:-half, half:-half]), np.subtract(change.shape, 2 * half))
    return frames[:, row:row + side, column:column + side]


class Scene:
    """A scene, its masks and its snapshot. `variant` is ''; 'steady' or 'static' for independent masks and a motion of 1.5
    or 0 pixels per frame; 'squares' for random squares and a motion of 1.5; 'grey' for masks with values between 0 and 1;
    'balanced' for independent masks, each followed by its inverse, and a motion of 1.5; 'filmed' for a clip behind
    independent masks, and no camera motion."""

    def __init__(self, binary, files, clips, index, variant, side):
        self.name, self.index, self.rng = f'{index}{variant}', index, np.random.default_rng([3, index])
        file, rng = files[index % len(files)], self.rng
        photo = cv2.imread(file, cv2.IMREAD_GRAYSCALE)
        ratio, self.pattern, self.sigma = int(rng.choice(RATIOS)), PATTERNS[index % 3], float(rng.choice(SIGMAS))
        step, scale = float(rng.choice(STEPS)), float(rng.choice([.3, .5, .8]))
        if variant == 'grey':
            self.pattern = PATTERNS[1 + index % 2]
        elif variant:
            self.pattern = 'random-squares' if variant == 'squares' else 'iid'
            step, ratio = 0 if variant == 'static' else 1.5, min(ratio, 10)
        self.photo, self.step = pathlib.Path(file).stem, step
        frames = panned(photo, ratio, side, step, scale)
        if variant == 'filmed':
            self.photo, self.step, ratio = pathlib.Path(clips[index % len(clips)]).name, 0, 8
            frames = filmed(clips, index, ratio, side)
        with tempfile.TemporaryDirectory() as folder:
            folder = pathlib.Path(folder)
            np.save(folder / 'scene.npy', frames.astype(np.float32))
            for seed, name in ((1, 'one'), (2, 'other')):
                subprocess.run([binary, 'simulate', '--frames', folder / 'scene.npy', '--compression-ratio', str(ratio), '--pattern', self.pattern,
                                '--noise-sigma', str(self.sigma), '--seed', str(seed), '--out', folder / name], check=True, stdout=subprocess.DEVNULL)
            self.masks, self.other = (np.load(folder / name / 'masks.npy') for name in ('one', 'other'))
            self.clean, self.truth = np.load(folder / 'one/measurement.npy').reshape(side, side), np.load(folder / 'one/truth.npy')
        moved = panned(photo, ratio, side, 10, scale)
        self.noise = self.clean - self.light(self.truth)
        if variant == 'balanced':
            for masks in self.masks, self.other:
                masks[1::2] = 1 - masks[::2]
            self.clean = self.light(self.truth) + self.noise
        self.fast, self.fast_truth = self.light(moved) + self.noise, moved
        self.dark = np.float32(DARK * self.clean.mean()) * (1 + .1 * rng.standard_normal(self.clean.shape, np.float32))

    def light(self, frames):
        return (self.masks * frames).sum(0)

    def describe(self):
        return f'{self.photo[:30]} {self.pattern} Cr {len(self.masks)} sigma {self.sigma:g} step {self.step:g}'


@dataclasses.dataclass
class Input:
    """The files and options of a reconstruction. `y` and `dark` are light; a camera stores them with `scale` counts per
    unit, up to `limit`; floats are cut at `cut`. The stated full scale is `stated` times the true one."""
    masks: np.ndarray
    y: np.ndarray
    dark: np.ndarray = None
    limit: int = SIXTEEN
    scale: float = None
    stated: float = 1
    full: float = None          # the stated full scale itself
    whole: bool = True          # the camera stores whole numbers
    cut: float = np.inf
    truth: np.ndarray = None
    options: tuple = ()

    def stored(self, values):
        counts = values * self.counts()
        kind = np.uint8 if self.limit == 255 else np.uint16
        return counts.round().clip(0, self.limit).astype(kind) if self.whole else np.minimum(counts, self.cut).astype(np.float32)

    def counts(self):
        return self.scale if self.scale else HEADROOM * self.limit / np.nanmax(self.y)


# ---------------------------------------------------------------- kinds of inputs
RIGHT, WRONG, HIDDEN = 'right', 'wrong', 'hidden'


@dataclasses.dataclass
class Kind:
    """`causes` are codes of findings that name the cause, or `code: text` if the finding must contain a text, or
    `refused: text` for an error. Codes of a right kind are no false alarms. A hidden kind can't be seen in one snapshot."""
    name: str
    causes: tuple
    make: callable
    what: str = WRONG
    variant: str = ''
    masks: bool = False         # the masks are wrong
    harmful: float = 0          # counts only where it costs this many dB


def taken(scene, **changes):
    """The right input of a 16-bit camera with a dark frame, with changes."""
    return Input(**(dict(masks=scene.masks.astype(np.float32), y=scene.clean + scene.dark, dark=scene.dark, truth=scene.truth) | changes))


def with_masks(masks):
    return lambda scene: taken(scene, masks=np.ascontiguousarray(masks(scene)).astype(np.float32))


def clipped(share, limit, whole=True):
    def make(scene):
        y = scene.clean + scene.dark
        return taken(scene, limit=limit, scale=limit / np.quantile(y, 1 - share), whole=whole, cut=limit)
    return make


def with_pixels(change, whole=True):
    """Changes the stored snapshot: `change(y, rng)` where the largest number is 1."""
    def make(scene):
        given = taken(scene, whole=whole)
        y = given.y * given.counts() / given.limit
        change(y, np.random.default_rng([4, scene.index]))
        return dataclasses.replace(given, y=y * given.limit / given.counts(), scale=given.counts())
    return make


def scattered(value):
    def change(y, rng):
        y.flat[rng.choice(y.size, 20, replace=False)] = value if np.isscalar(value) else rng.uniform(*value, 20)
    return change


def lines(value):
    def change(y, rng):
        y[:, rng.integers(10, y.shape[1] - 10)] = value
    return change


def cluster(value):
    def change(y, rng):
        for _ in range(3):
            row, column = rng.integers(5, y.shape[0] - 8, 2)
            y[row:row + 3, column:column + 3] = value
    return change


def area(change):
    """Changes the light of 40 rows and columns: `change(y, light, rng)`, where light is that of the scene without masks."""
    def make(scene):
        given, rng = taken(scene), np.random.default_rng([8, scene.index])
        row, column = rng.integers(8, scene.clean.shape[0] - 48, 2)
        place = np.s_[row:row + 40, column:column + 40]
        y = given.y.copy()
        y[place] = change(y[place], scene.truth.sum(0)[place] / 2, rng)
        return dataclasses.replace(given, y=y, scale=given.counts())
    return make


def frozen(y, light, rng):
    return y.mean() * (1 + .01 * rng.standard_normal(y.shape))


def unmasked(y, light, rng):
    return light * (1 + .01 * rng.standard_normal(y.shape))


def nearly_black(scene):
    """One value in 40 rows and columns, a little above the dark."""
    level = scene.clean.mean() * (DARK + np.random.default_rng([9, scene.index]).uniform(.05, .09))
    return area(lambda y, light, rng: np.full_like(y, level))(scene)


def stray_light(peak):
    """A smooth spot of light that did not pass the masks. `peak` is relative to the mean of the measurement."""
    def make(scene):
        rng, side = np.random.default_rng([10, scene.index]), len(scene.clean)
        (row, column), width = rng.uniform(.2, .8, 2) * side, rng.uniform(.06, .2) * side
        rows, columns = np.mgrid[:side, :side]
        spot = np.exp(-((rows - row) ** 2 + (columns - column) ** 2) / (2 * width ** 2))
        return taken(scene, y=scene.clean + scene.dark + peak * scene.clean.mean() * spot)
    return make


def moved(masks, rows, columns):
    """Masks that are displaced by a fraction of a pixel."""
    matrix = np.float32([[1, 0, columns], [0, 1, rows]])
    size = masks.shape[:0:-1]
    return np.stack([cv2.warpAffine(mask.astype(np.float32), matrix, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT) for mask in masks])


def exchanged(scene):
    masks, count = scene.masks.copy(), len(scene.masks)
    first, second = count // 4, count - 1 - count // 4
    masks[[first, second]] = masks[[second, first]]
    return masks


def shuffled(scene):
    return scene.masks[np.random.default_rng([6, scene.index]).permutation(len(scene.masks))]


def moved_in_half(scene):
    """Masks that moved by a pixel in the lower half."""
    masks, half = scene.masks.copy(), scene.masks.shape[1] // 2
    masks[:, half:] = np.roll(masks, 1, axis=2)[:, half:]
    return masks


def zoomed(masks, factor):
    """Masks that are resampled by a factor about the middle of the picture."""
    height, width = masks.shape[1:]
    matrix = np.float32([[factor, 0, (1 - factor) * (width - 1) / 2], [0, factor, (1 - factor) * (height - 1) / 2]])
    return np.stack([cv2.warpAffine(mask.astype(np.float32), matrix, (width, height), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT) for mask in masks])


def gamma_encoded(masks):
    """The values of pictures in sRGB with 8 bits."""
    encoded = np.where(masks <= .0031308, 12.92 * masks, 1.055 * np.maximum(masks, 1e-9) ** (1 / 2.4) - .055)
    return (255 * encoded).round().astype(np.uint8)


def turned_strip(scene):
    """A measurement of the upper three quarters, and masks of the same part that are turned."""
    rows = scene.clean.shape[0] * 3 // 4
    given = taken(scene, masks=np.ascontiguousarray(np.rot90(scene.masks[:, :rows], axes=(1, 2))).astype(np.float32))
    return dataclasses.replace(given, y=given.y[:rows], dark=given.dark[:rows], truth=given.truth[:, :rows])


def gamma_pictures(scene):
    return dataclasses.replace(taken(scene), masks=gamma_encoded(scene.masks))


def without_mask(place):
    def make(scene):
        left_out = {'first': 0, 'middle': len(scene.masks) // 2, 'last': -1}[place]
        masks, truth = (np.delete(array, left_out, axis=0) for array in (scene.masks, scene.truth))
        return taken(scene, masks=masks.astype(np.float32), truth=truth)
    return make


def one_mask(value):
    def masks(scene):
        masks, k = scene.masks.copy(), len(scene.masks) // 2
        masks[k] = masks[k - 1] if value is None else value
        return masks
    return masks


def tinted(gains):
    """A mosaic of RGGB behind a scene with a tint, or with complementary tints that change over the picture."""
    def make(scene):
        height, width = scene.clean.shape
        rows, columns = np.mgrid[:height, :width]
        if callable(gains):
            red, blue = gains(rows / height, columns / width)
        else:
            red, blue = gains
        gain = np.select([(rows % 2 == 0) & (columns % 2 == 0), (rows % 2 == 1) & (columns % 2 == 1)], [red * np.ones(rows.shape), blue * np.ones(rows.shape)], 1)
        return taken(scene, y=scene.light(scene.truth) * gain + scene.noise + scene.dark)
    return make


def complementary(rows, columns):
    hue = .4 * np.sin(2 * np.pi * rows) * np.cos(2 * np.pi * columns)
    return 1 + hue, 1 - hue


def halves(rows, columns):
    left = columns < .5
    return np.where(left, 1.35, .65), np.where(left, .65, 1.35)


def noisy(scene):
    noise = 50 / 255 * np.random.default_rng([7, scene.index]).standard_normal(scene.clean.shape)
    return taken(scene, y=scene.clean + noise + scene.dark)


def without_a_pattern(scene):
    k = len(scene.masks) // 2
    return taken(scene, y=scene.clean - scene.masks[k] * scene.truth[k] + scene.dark)


def integers(most, kind):
    return lambda scene: taken(scene, masks=(scene.masks * most).round().astype(kind))


def right(scene, **changes):
    return taken(scene, **changes)


KINDS = [
    Kind('right: 16-bit camera with a dark', (), right, RIGHT),
    Kind('right: float files without an offset', (), lambda s: taken(s, y=s.clean, dark=None, limit=1, scale=1 / len(s.masks), whole=False), RIGHT),
    Kind('right: 12-bit camera with a dark', (), lambda s: taken(s, limit=4095), RIGHT),
    Kind('right: masks in uint8, 0 and 1 for binary ones', (), lambda s: integers(1 if s.pattern == 'iid' else 255, np.uint8)(s), RIGHT),
    Kind('right: steady motion', (), right, RIGHT, 'steady'),
    Kind('right: steady motion, random squares', (), right, RIGHT, 'squares'),
    Kind('right: grey masks', (), right, RIGHT, 'grey'),
    Kind('right: static scene', (), right, RIGHT, 'static'),
    Kind('right: masks with a constant sum', ('unfamiliar_masks',), right, RIGHT, 'balanced'),
    Kind('right: noise of sigma 50', (), noisy, RIGHT),
    Kind('right: clips', ('fast_motion',), right, RIGHT, 'filmed'),

    Kind('full scale of the measurement ten times too large', ('level',), lambda s: taken(s, stated=10)),
    Kind('full scale of the measurement ten times too small', ('level',), lambda s: taken(s, stated=.1)),
    Kind('full scale of the measurement three times too large', ('level',), lambda s: taken(s, stated=3), HIDDEN),
    Kind('12 bits in 16, full scale 65535', ('right_aligned',), lambda s: taken(s, limit=4095, full=SIXTEEN)),
    Kind('12-bit masks in uint16, full scale 65535', ('mask_scale',), integers(4095, np.uint16)),
    Kind('4-bit masks in uint8, full scale 255', ('mask_scale',), integers(15, np.uint8)),
    Kind('float masks divided by 255', ('mask_scale',), with_masks(lambda s: s.masks / 255)),
    Kind('float masks from 0 to 255', ('refused: full',), with_masks(lambda s: s.masks * 255)),
    Kind('masks of -1 and 1', ('refused: two exposures',), with_masks(lambda s: 2 * (s.masks > s.masks.mean()) - 1)),
    Kind('no dark', ('no_dark',), lambda s: taken(s, dark=None)),
    Kind('dark of three times the exposure', ('wrong_dark', 'negative'), lambda s: taken(s, dark=3 * s.dark)),
    Kind('dark of half the exposure', ('wrong_dark',), lambda s: taken(s, dark=s.dark / 2)),
    Kind('dark subtracted twice', ('wrong_dark', 'negative'), lambda s: taken(s, y=s.clean)),
    Kind('too much subtracted before the upload', ('negative_offset', 'negative'), lambda s: taken(s, y=s.clean - s.dark, dark=None, limit=1, scale=1 / len(s.masks), whole=False)),
    Kind('1 % saturated, 16 bits', ('saturated',), clipped(.01, SIXTEEN)),
    Kind('3 % saturated, 8 bits', ('saturated',), clipped(.03, 255)),
    Kind('13 % saturated, 12 bits', ('saturated',), clipped(.13, 4095)),
    Kind('13 % saturated, 14 bits', ('saturated',), clipped(.13, 16383)),
    Kind('13 % saturated, float', ('saturated',), clipped(.13, 1, False)),
    Kind('30 % saturated, 12 bits', ('saturated',), clipped(.3, 4095)),
    Kind('20 hot pixels at the largest number', ('bad_pixels', 'saturated'), with_pixels(scattered(1))),
    Kind('20 hot pixels, each with another value', ('bad_pixels',), with_pixels(scattered((3, 9)), False)),
    Kind('20 dead pixels', ('bad_pixels',), with_pixels(scattered(0))),
    Kind('20 pixels of NaN', ('bad_pixels',), with_pixels(scattered(np.nan), False)),
    Kind('a hot column', ('bad_pixels', 'saturated'), with_pixels(lines(1))),
    Kind('a dead column', ('bad_pixels',), with_pixels(lines(0))),
    Kind('clusters of 3x3 hot pixels', ('bad_pixels', 'saturated'), with_pixels(cluster(1))),
    Kind('a part of the sensor with noise alone', ('unmodulated_area',), area(frozen)),
    Kind('a part of the picture without masks', ('unmodulated_area',), area(unmasked)),
    Kind('a part of the sensor with one value near black', ('unmodulated_area', 'bad_pixels'), nearly_black),
    Kind('stray light with a peak of 3 times the mean', ('unmodulated_area',), stray_light(3)),
    Kind('stray light with a peak of 1.5 times the mean', ('unmodulated_area',), stray_light(1.5)),
    Kind('stray light with a peak of the mean', ('unmodulated_area',), stray_light(1)),
    Kind('stray light with a peak of 0.7 times the mean', ('unmodulated_area',), stray_light(.7)),
    Kind('a snapshot of 0', ('refused: 0',), lambda s: taken(s, y=s.dark)),
    Kind('a mask instead of the snapshot', ('binary_measurement', 'foreign_masks'), lambda s: taken(s, y=s.masks[0], dark=None)),

    Kind('masks of another calibration', ('foreign_masks',), with_masks(lambda s: s.other), masks=True),
    Kind('masks of another calibration, masks with a constant sum', ('foreign_masks',), with_masks(lambda s: s.other), HIDDEN, 'balanced', masks=True),
    Kind('inverted masks (1 - C)', ('inverted_masks',), with_masks(lambda s: 1 - s.masks), masks=True),
    Kind('masks flipped from left to right', ('turned_masks',), with_masks(lambda s: s.masks[:, :, ::-1]), masks=True),
    Kind('masks flipped upside down', ('turned_masks',), with_masks(lambda s: s.masks[:, ::-1]), masks=True),
    Kind('masks turned by 180 degrees', ('turned_masks',), with_masks(lambda s: s.masks[:, ::-1, ::-1]), masks=True),
    Kind('masks turned by 90 degrees in a picture that is not square', ('refused: 90 degrees',), turned_strip, masks=True),
    Kind('masks turned by 90 degrees', ('turned_masks',), with_masks(lambda s: np.rot90(s.masks, axes=(1, 2))), masks=True),
    Kind('masks with rows and columns exchanged', ('turned_masks',), with_masks(lambda s: s.masks.transpose(0, 2, 1)), masks=True),
    Kind('masks shifted by 1 pixel', ('shifted_masks',), with_masks(lambda s: np.roll(s.masks, 1, axis=1)), masks=True),
    Kind('masks shifted by 2 pixels', ('shifted_masks',), with_masks(lambda s: np.roll(s.masks, 2, axis=2)), masks=True),
    Kind('masks shifted by 3 rows and 4 columns', ('shifted_masks',), with_masks(lambda s: np.roll(s.masks, (3, -4), axis=(1, 2))), masks=True),
    Kind('crop that begins 8 rows and 20 columns away', ('shifted_masks',), with_masks(lambda s: np.roll(s.masks, (-8, 20), axis=(1, 2))), masks=True),
    Kind('masks shifted by 1 pixel in one half', ('partly_moved_masks',), with_masks(moved_in_half), masks=True),
    Kind('drift by half a pixel', ('drifted_masks',), with_masks(lambda s: moved(s.masks, 0, .5)), masks=True),
    Kind('drift by 0.35 rows and 0.35 columns', ('drifted_masks',), with_masks(lambda s: moved(s.masks, .35, .35)), masks=True),
    Kind('masks resampled by 1 %', ('resampled_masks',), with_masks(lambda s: zoomed(s.masks, 1.01)), masks=True),
    Kind('masks resampled by 5 %', ('resampled_masks',), with_masks(lambda s: zoomed(s.masks, .95)), masks=True),
    Kind('masks resampled from 100x100 to 128x128 pixels', ('resampled_masks',), with_masks(lambda s: zoomed(s.masks, 1.28)), masks=True),
    Kind('masks as 8-bit pictures in sRGB', ('mask_values',), gamma_pictures, variant='grey', masks=True),
    Kind('grey masks made binary', ('mask_values',), with_masks(lambda s: s.masks > .5), variant='grey', masks=True),
    Kind('the first mask missing, independent masks', ('missing_mask',), without_mask('first'), variant='steady', masks=True),
    Kind('a mask in the middle missing, independent masks', ('missing_mask',), without_mask('middle'), variant='steady', masks=True),
    Kind('the last mask missing, independent masks', ('missing_mask',), without_mask('last'), variant='steady', masks=True),
    Kind('the first mask missing, masks that resemble one another', ('missing_mask',), without_mask('first'), HIDDEN, 'grey', masks=True),
    Kind('a mask in the middle missing, masks that resemble one another', ('missing_mask',), without_mask('middle'), HIDDEN, 'grey', masks=True),
    Kind('the last mask missing, masks that resemble one another', ('missing_mask',), without_mask('last'), HIDDEN, 'grey', masks=True),
    Kind('one mask twice', ('bad_calibration: repeated_pattern',), with_masks(one_mask(None)), masks=True),
    Kind('one mask black', ('refused: open pixels',), with_masks(one_mask(0)), masks=True),
    Kind('a pattern that was not shown, independent masks', ('missing_pattern',), without_a_pattern, variant='steady'),
    Kind('a pattern that was not shown, masks that resemble one another', ('missing_pattern',), without_a_pattern, HIDDEN, 'grey'),
    Kind('two masks exchanged, steady motion, independent masks', ('exchanged_masks',), with_masks(exchanged), variant='steady', masks=True, harmful=SEEN),
    Kind('masks shuffled, steady motion, independent masks', ('exchanged_masks',), with_masks(shuffled), variant='steady', masks=True, harmful=SEEN),
    Kind('two masks exchanged, steady motion, random squares', ('exchanged_masks',), with_masks(exchanged), HIDDEN, 'squares', masks=True),
    Kind('masks shuffled, steady motion, random squares', ('exchanged_masks',), with_masks(shuffled), HIDDEN, 'squares', masks=True),
    Kind('two masks exchanged, any scene', ('exchanged_masks', 'bad_calibration: swapped_order'), with_masks(exchanged), HIDDEN, masks=True),
    Kind('two masks exchanged, static scene', ('exchanged_masks', 'bad_calibration: swapped_order'), with_masks(exchanged), HIDDEN, 'static', masks=True),
    Kind('masks in reverse order', ('exchanged_masks',), with_masks(lambda s: s.masks[::-1]), HIDDEN, 'steady', masks=True),
    Kind('masks begin with the second', ('exchanged_masks',), with_masks(lambda s: np.roll(s.masks, -1, axis=0)), HIDDEN, 'steady', masks=True),
    Kind('Bayer mosaic as grey, one tint', ('mosaic',), tinted((.7, .8))),
    Kind('Bayer mosaic as grey, complementary tints', ('mosaic',), tinted(complementary)),
    Kind('Bayer mosaic as grey, two halves of complementary tints', ('mosaic',), tinted(halves)),
    Kind('motion of 10 pixels a frame', ('fast_motion',), lambda s: taken(s, y=s.fast + s.dark, truth=s.fast_truth), harmful=LOSS),
]

# The right input of each variant of the scenes.
REFERENCE = {'': KINDS[0].name, 'steady': 'right: steady motion', 'squares': 'right: steady motion, random squares', 'grey': 'right: grey masks',
             'static': 'right: static scene', 'balanced': 'right: masks with a constant sum', 'filmed': 'right: clips'}


# ---------------------------------------------------------------- runs
class Runs:
    """Resumable runs of a program, whose rows are in a file for this binary. `key` identifies the run of a row."""

    def __init__(self, a, key):
        with open(a.binary, 'rb') as file:
            name = hashlib.file_digest(file, 'sha256').hexdigest()[:12]
        self.a, self.path, self.lock = a, pathlib.Path(a.out) / f'{name}.jsonl', threading.Lock()
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self.path.touch()
        self.done = {key(row) for row in read(a.out)}
        self.files = photographs(a.data)
        self.clips = sorted(glob.glob(f'{a.data}/clips/*/*/'))

    def keep(self, row):
        with self.lock, open(self.path, 'a') as file:
            file.write(json.dumps(row) + '\n')


class Bench(Runs):
    def __init__(self, a):
        super().__init__(a, lambda row: (row['kind'], row['scene']))

    def wanted(self, index, variant):
        for kind in KINDS:
            count = self.a.good if kind.variant == 'filmed' or kind is KINDS[0] else self.a.scenes
            count = 0 if kind.variant == 'filmed' and not self.clips else count
            chosen = not self.a.kinds or any(text in kind.name for text in self.a.kinds)
            if kind.variant == variant and index < count and chosen and (kind.name, index) not in self.done:
                yield kind

    def scene(self, index):
        for variant in REFERENCE:
            kinds = list(self.wanted(index, variant))
            if not kinds:
                continue
            scene = Scene(self.a.binary, self.files, self.clips, index, variant, self.a.side)
            for kind in kinds:
                row = {'kind': kind.name, 'scene': index, 'about': scene.describe()} | self.reconstruct(kind.make(scene))
                self.keep(row)

    def reconstruct(self, given):
        with tempfile.TemporaryDirectory() as folder:
            folder = pathlib.Path(folder)
            arrays = {'masks': given.masks, 'measurement': given.stored(given.y), 'truth': given.truth.astype(np.float32)}
            options = []
            if given.dark is not None:
                arrays['dark'] = given.stored(given.dark)
                options = ['--dark', folder / 'dark.npy']
            for name, array in arrays.items():
                np.save(folder / f'{name}.npy', array)
            command = [self.a.binary, 'reconstruct', '--masks', folder / 'masks.npy', '--measurement', folder / 'measurement.npy', '--truth', folder / 'truth.npy',
                       '--truth-full-scale', '1', '--full-scale', str(given.full or given.counts() * given.stated), '--algorithm', self.a.algorithm,
                       '--registration', self.a.registration, '--threads', '1', '--json', '--out', folder / 'out', *options, *given.options]
            done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
            if done.returncode == 2:
                return {'refused': done.stderr.strip()}
            if done.returncode not in (0, 3):
                sys.exit(f'a reconstruction failed: {done.stderr}')
            report = json.loads(done.stdout)
            errors = ((np.load(folder / 'out/frames.npy') - given.truth) ** 2).mean(0)
        assessment = report['assessment'] or {}
        return {'findings': [[one['code'], one['detail']] for one in report['findings']], 'grade': report['verdict'], 'order': assessment.get('order'),
                'expected_db': assessment.get('psnr_db'), 'true_db': report['psnr_db'], 'unit_db': report['psnr_unit_db'], 'parts_db': parts(errors)}


def parts(errors):
    """PSNR of each ninth of the picture, less that of the whole picture."""
    height, width = errors.shape
    thirds = lambda length: [0, length // 3, length - length // 3, length]
    rows, columns = thirds(height), thirds(width)
    relative = lambda part: round(-10 * float(np.log10(part.mean() / errors.mean())), 2)
    return [[relative(errors[rows[i]:rows[i + 1], columns[j]:columns[j + 1]]) for j in range(3)] for i in range(3)]


def read(folder):
    """The rows of the binary that was run last."""
    files = sorted(pathlib.Path(folder).glob('*.jsonl'), key=os.path.getmtime)
    return [json.loads(line) for line in files[-1].read_text().splitlines()] if files else []


def run(a):
    bench = Bench(a)
    with concurrent.futures.ThreadPoolExecutor(a.parallel) as pool:
        for future in [pool.submit(bench.scene, index) for index in range(max(a.scenes, a.good))]:
            future.result()
    report(a)


# ---------------------------------------------------------------- report
PARTS = [f'{row}{column}' for row in ('top ', '', 'bottom ') for column in ('left', 'centre', 'right')]


def is_right_about_part(row, detail):
    """True if the part that `uneven_error` names is worse than the picture."""
    named = re.match(r'the (top |bottom |)(left|centre|right) ', detail)
    part = PARTS.index(named[1] + named[2])
    return row['parts_db'][part // 3][part % 3] < -UNEVEN


def alarms(row):
    """The findings that doubt an input. `uneven_error` counts where the part is no worse than the picture."""
    if 'refused' in row:
        return ['refused']
    return [code for code, detail in row['findings'] if code != 'uneven_error' or not is_right_about_part(row, detail)]


def is_too_low(row):
    """True if a result is graded `bad` though it is not."""
    return row.get('grade') == 'bad' and row['true_db'] > BAD


def names_cause(row, causes):
    """True if the first finding names one of the causes."""
    if 'refused' in row:
        return any(cause.startswith('refused') and cause.split(': ')[1] in row['refused'] for cause in causes)
    findings = [one for one in row['findings'] if one[0] != 'uneven_error']
    if not findings:
        return False
    code, detail = findings[0]
    return any(cause == code or cause.startswith(f'{code}: ') and cause.split(': ')[1] in detail for cause in causes)


def loss(row, right):
    """PSNR in dB that an input costs; `None` where it is not known."""
    return right['unit_db'] - row['unit_db'] if right and 'unit_db' in row and 'unit_db' in right else None


PAGE = """\
<!-- Generated by `wrong_inputs.py report --write WRONG_INPUTS.md`. Edit the script instead. -->

# Wrong inputs

`make eval-wrong-inputs` tries each kind of wrong input on many scenes. The table states the
[finding](../../docs/FINDINGS.md) that names its cause, how many inputs are flagged at all, and for how many the first
finding names the cause. The last column counts results that lose more than 3 dB by wrong masks and are graded better
than `doubtful`. An order counts where it costs 0.5 dB or more, fast motion where it costs 3 dB.
[BENCHMARKS.md](../../docs/BENCHMARKS.md#are-wrong-inputs-noticed) states the conditions and a summary.

"""


def markdown(table):
    """Lines of the tables of wrong and of right inputs."""
    yield '| wrong input | finding that names the cause | flagged | cause named first | better than doubtful in spite of a loss above 3 dB |'
    yield '| --- | --- | --- | --- | --- |'
    for name, (kind, count, flagged, named, praised) in table.items():
        if kind.what != RIGHT:
            said = ' or '.join('an error' if cause.startswith('refused') else f'`{cause}`' for cause in kind.causes)
            shown = '' if praised is None else f'{praised[0]} of {praised[1]}'
            yield f'| {name}{" (not visible in one snapshot)" if kind.what == HIDDEN else ""} | {said} | {flagged} of {count} | {named} of {count} | {shown} |'
    yield ''
    yield '| right input | false alarms | graded `bad` above 22 dB |'
    yield '| --- | --- | --- |'
    for name, (kind, count, flagged, low, _) in table.items():
        if kind.what == RIGHT:
            yield f'| {name.removeprefix("right: ")} | {flagged} of {count} | {low} of {count} |'


def report(a):
    rows, table, out = read(a.out), {}, {}
    of = {(row['kind'], row['scene']): row for row in rows}
    false = []
    for kind in KINDS:
        own = sorted((row for row in rows if row['kind'] == kind.name), key=lambda row: row['scene'])
        right_of = lambda row: of.get((REFERENCE[kind.variant], row['scene']))
        if kind.harmful:
            own = [row for row in own if (loss(row, right_of(row)) or 0) > kind.harmful]
        if not own:
            continue
        if kind.what == RIGHT:
            found = [(row, [code for code in alarms(row) if code not in kind.causes]) for row in own]
            false += [f'{kind.name}, {row["scene"]} {row["about"]}: {found}' for row, found in found if found]
            table[kind.name] = (kind, len(own), sum(bool(found) for _, found in found), sum(map(is_too_low, own)), None)
            continue
        named = [names_cause(row, kind.causes) for row in own]
        flagged = [bool(alarms(row)) or named for row, named in zip(own, named)]
        harmful = [row for row in own if (loss(row, right_of(row)) or 0) > LOSS] if kind.masks else []
        praised = [row for row in harmful if row['grade'] not in ('doubtful', 'bad')]
        table[kind.name] = (kind, len(own), sum(flagged), sum(named), (len(praised), len(harmful)) if kind.masks else None)
        out[kind.name] = {'of': len(own), 'flagged': sum(flagged), 'named_first': sum(named)}
        if not a.markdown:
            for row, named in zip(own, named):
                if not named:
                    codes = [code for code, _ in row['findings']] if 'findings' in row else row['refused'][:150]
                    lost = loss(row, right_of(row))
                    print(f'  {kind.name}, {row["scene"]} {row["about"]}: {codes} {row.get("grade")} expected {row.get("expected_db")} true {row.get("true_db") or 0:.1f}'
                          f' loss {lost if lost is None else round(lost, 1)}')
    lines = list(markdown(table))
    print(*lines, sep='\n')
    if a.write:
        pathlib.Path(a.write).write_text('\n'.join([PAGE + lines[0], *lines[1:], '']))
    judged = [row for row in rows if row['kind'] == KINDS[0].name and row.get('expected_db') is not None]
    errors = np.array([min(row['true_db'], 40) - min(row['expected_db'], 40) for row in judged])
    print()
    if not a.markdown:
        print(*false, sep='\n')
    print(json.dumps({'kinds': out, 'false_alarms': false, 'good': sum(count for kind, count, *_ in table.values() if kind.what == RIGHT),
                      'prediction_off_by_db': round(float(np.abs(errors).mean()), 2), 'within_1_5_db': round(float((np.abs(errors) < 1.5).mean()), 2)}))


def main():
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = p.add_subparsers(dest='what', required=True)
    runs = commands.add_parser('run')
    runs.add_argument('binary', metavar='SCI_RECON_BINARY', type=os.path.abspath)
    runs.add_argument('--data', required=True)
    runs.add_argument('--good', type=int, default=60, help='scenes of the first right input')
    runs.add_argument('--scenes', type=int, default=20, help='scenes of each other input')
    runs.add_argument('--algorithm', default='gap-tv')
    runs.add_argument('--registration', default='off', choices=('off', 'auto'), help='whether a job may move the masks')
    runs.add_argument('--side', type=int, default=128, help='side of the images in pixels')
    runs.add_argument('--kinds', nargs='*', help='only inputs with one of these texts in their names [default: all inputs]')
    runs.add_argument('--parallel', type=int, default=os.cpu_count(), help='reconstructions at the same time')
    for command in (runs, commands.add_parser('report')):
        command.add_argument('--out', required=True, help='the folder of the results')
        command.add_argument('--markdown', action='store_true', help='print the tables alone')
        command.add_argument('--write', metavar='FILE', help='the page to write, with the tables')
    a = p.parse_args()
    {'run': run, 'report': report}[a.what](a)


if __name__ == '__main__':
    main()
