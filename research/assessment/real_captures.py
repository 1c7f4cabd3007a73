"""Compare the right masks of real spectral captures with wrong ones.

    python real_captures.py SCI_RECON_BINARY --data FOLDER [--algorithm NAME] [--capture NAME...] [--rows N] [--keep FOLDER]

FOLDER has the published files that CAPTURES lists. There is no truth. The judge is the program: it must find an error in
wrong masks, and none in the right ones; a shift along the dispersion counts as neither. A second judge is the hold-out
error: 5 % of the sensor's pixels are declared bad, and the frames predict them through the masks. The error is relative to
that of the mean of the eight pixels around each; `worse_by` is the mean difference of the squared errors to those behind
the right masks, in standard errors. Each row is printed as a JSON object; the last row of a capture is a summary. The
status is 1 if the program misses wrong masks or refuses the right ones.
"""
import argparse
import json
import pathlib
import subprocess
import sys
import tempfile

import numpy as np
import scipy.io

# Name: measurement and its array, mask and its array, number of bands, pixels from band to band.
CAPTURES = {
    'tsa_scene1': ('tsa_scene1.mat', 'meas_real', 'tsa_real_mask.mat', 'mask', 28, 2),
    'tsa_scene2': ('tsa_scene2.mat', 'meas_real', 'tsa_real_mask.mat', 'mask', 28, 2),
    'fern_root': ('SMEM_fern_root.mat', 'meas', 'SMEM_mask.mat', 'mask', 24, 2),
}
HELD_OUT = .05      # share of the pixels
# The dispersion is along the columns, so these masks look like other wavelengths, and are no error.
AMBIGUOUS = {'shifted by 1 column', 'shifted by 5 columns'}
# Findings that follow from the test itself: pixels are held out, and the full scale of the captures is not published.
EXPECTED = {'bad_pixels', 'level'}


def dark(y, side=16):
    """The level without light, which is not published: a low quantile of the means of blocks."""
    height, width = (length // side * side for length in y.shape)
    blocks = y[:height, :width].reshape(height // side, side, width // side, side)
    return np.percentile(blocks.mean((1, 3)), 1)


def array(folder, file, name):
    return scipy.io.loadmat(folder / file)[name].astype(np.float32)


def shifted(mask, rows, columns):
    """The mask displaced by whole pixels, mirrored at the edges."""
    padded = np.pad(mask, ((abs(rows),) * 2, (abs(columns),) * 2), mode='reflect')
    first = abs(rows) - rows, abs(columns) - columns
    return padded[first[0]:first[0] + mask.shape[0], first[1]:first[1] + mask.shape[1]]


def variants(mask, other):
    """The right mask first, then wrong ones of the same size."""
    return {
        'right': mask,
        'flipped left to right': mask[:, ::-1],
        'flipped upside down': mask[::-1],
        'turned by 180 degrees': mask[::-1, ::-1],
        'turned by 90 degrees': np.rot90(mask),
        'shifted by 1 row': shifted(mask, 1, 0),
        'shifted by 1 column': shifted(mask, 0, 1),
        'shifted by 5 rows': shifted(mask, 5, 0),
        'shifted by 5 columns': shifted(mask, 0, 5),
        'of another camera': other,
    }


def predicted(frames, mask, step):
    """The measurement that frames [band, row, column] give behind a mask."""
    bands, height, width = frames.shape
    y = np.zeros((height, width + step * (bands - 1)))
    for band, frame in enumerate(frames):
        y[:, step * band:step * band + width] += mask * frame
    return y


def around(y):
    """The mean of the eight pixels around each."""
    padded = np.pad(y, 1, mode='edge')
    height, width = y.shape
    windows = [padded[i:i + height, j:j + width] for i in range(3) for j in range(3) if (i, j) != (1, 1)]
    return np.mean(windows, 0)


def reconstruct(a, folder, mask, y, held_out, step, bands, full_scale):
    np.save(folder / 'mask.npy', np.ascontiguousarray(mask, np.float32))
    np.save(folder / 'y.npy', y)
    np.save(folder / 'held_out.npy', held_out.astype(np.uint8))
    out = folder / 'out'
    run = subprocess.run(
        [a.binary, 'reconstruct', '--masks', folder / 'mask.npy', '--measurement', folder / 'y.npy', '--bad-pixels',
         folder / 'held_out.npy', '--measurement-full-scale', str(full_scale), '--dispersion-offsets',
         f'0:{step}:{bands}', '--algorithm', a.algorithm, '--json', '--out', out], capture_output=True, text=True)
    if run.returncode not in (0, 3):
        raise SystemExit(run.stderr)
    return json.loads(run.stdout), np.load(out / 'frames.npy') * full_scale


def rows(a, name):
    file, key, mask_file, mask_key, bands, step = CAPTURES[name]
    y, mask = array(a.data, file, key), array(a.data, mask_file, mask_key)
    y = y - dark(y)
    other_file = next(entry[2] for entry in CAPTURES.values() if entry[2] != mask_file)
    other = array(a.data, other_file, 'mask')
    mask, other = (np.clip(one / one.max(), 0, 1) for one in (mask, other))
    # Bands are displaced along the columns, so a strip of rows is a complete problem.
    height = min(a.rows or len(y), len(y))
    first = (len(y) - height) // 2
    strip = slice(first, first + height)
    y = y[strip]
    held_out = np.random.default_rng(1).random(y.shape) < HELD_OUT
    # Only columns that all bands reach: at the ends a few bands suffice.
    reached = np.zeros(y.shape, bool)
    reached[:, step * (bands - 1):mask.shape[1]] = True
    judged = held_out & reached
    # A frame then has about half of its full scale in the brightest parts.
    full_scale = float(np.percentile(y, 99.9) / (.5 * mask.mean() * bands))
    neighbours = np.mean((y - around(y))[judged] ** 2)
    right = None
    for variant, wrong in variants(mask, other).items():
        wrong = wrong[strip]
        with tempfile.TemporaryDirectory() as folder:
            folder = pathlib.Path(folder)
            report, frames = reconstruct(a, folder, wrong, y, held_out, step, bands, full_scale)
            if a.keep and variant == 'right':
                a.keep.mkdir(parents=True, exist_ok=True)
                np.save(a.keep / f'{name}.npy', frames)
        squares = (y - predicted(frames, wrong, step))[judged] ** 2
        right = squares if right is None else right
        excess = squares - right
        worse_by = excess.mean() / max(excess.std() / np.sqrt(len(excess)), 1e-30)
        assessment = report['assessment'] or {}
        findings = {one['code']: one['severity'] for one in report['findings'] if one['code'] not in EXPECTED}
        yield {'capture': name, 'masks': variant, 'hold_out_error': round(float(np.sqrt(squares.mean() / neighbours)), 4),
               'worse_by': round(float(worse_by), 1), 'findings': findings, 'psnr_db': assessment.get('psnr_db'), 'cpu_seconds': round(report['cpu_seconds'], 1)}


def summary(name, found):
    right, wrong = found[0], found[1:]
    best = min(wrong, key=lambda row: row['worse_by'])
    clear = [row for row in wrong if row['masks'] not in AMBIGUOUS]
    unnoticed = [row['masks'] for row in clear if 'error' not in row['findings'].values()]
    refused = 'error' in right['findings'].values()
    return {'capture': name, 'right': right['hold_out_error'], 'best_wrong': best['hold_out_error'],
            'best_wrong_masks': best['masks'], 'worse_by': best['worse_by'], 'preferred': not unnoticed and not refused,
            'findings_behind_right_masks': sorted(right['findings']), 'unnoticed': unnoticed}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('binary')
    parser.add_argument('--data', type=pathlib.Path, required=True, help='folder with the published files')
    parser.add_argument('--algorithm', default='gap-tv')
    parser.add_argument('--capture', nargs='*', choices=CAPTURES, default=list(CAPTURES))
    parser.add_argument('--rows', type=int, help='height of the strip in the middle that is used [default: all rows]')
    parser.add_argument('--keep', type=pathlib.Path, help='folder for the bands behind the right masks, as npy')
    a = parser.parse_args()
    failed = False
    for name in a.capture:
        found = []
        for row in rows(a, name):
            found.append(row)
            print(json.dumps(row), flush=True)
        total = summary(name, found)
        print(json.dumps(total), flush=True)
        failed |= not total['preferred']
    sys.exit(failed)


if __name__ == '__main__':
    main()
