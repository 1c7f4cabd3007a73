"""Test whether masks that moved since their calibration are found and corrected, and whether others are left alone.

    python registration.py run SCI_RECON_BINARY --data DATA --out FOLDER [--cases 40] [--first 0] [--algorithm gap-tv]
           [--side 128] [--rotation 0.3] [--growth 0.3] [--only-motion]
    python registration.py report --out FOLDER [--markdown]

DATA has photographs in photos/train and photos/val. A camera moves over them behind masks of four kinds, Cr 8 to 20, with
noise of 0 to 10. A pixel of a mask is the mean of the light on its area. So masks are simulated on five times as many
pixels, moved by whole ones of these, and averaged; `--motion spline` moves the masks by cubic splines instead. With
`--rotation` and `--growth` the fine light is also turned and magnified about the centre. Errors of a motion are root mean
squares of the displacement over the picture. `--only-motion` estimates the drift alone, without PSNR. Each case
is reconstructed with the masks of the calibration, registered ones and the true ones. Right masks and flipped ones must be
left alone. PSNR leaves out the border, for which moved masks are unknown. `run` appends a line to a file in FOLDER for this
binary: an interrupted run continues where it stopped. The last line of a report is JSON.
"""
import argparse
import concurrent.futures
import json
import os
import pathlib
import subprocess
import sys
import tempfile

import cv2
import numpy as np
from scipy import ndimage

from wrong_inputs import Runs, panned, read

KINDS = 'iid', 'iid-blurred', 'random-squares', 'rotating-circle'
RATIOS = 8, 10, 12, 16, 20
SIGMAS = 0, 2, 5, 10
STEPS = 0, .3, 1, 2
REACH = 4       # pixels
FINE = 5        # cells of a pixel; the grids of the search have steps of 1/8
BORDER = 16     # pixels around a picture, into which masks move
WORSE = .1      # dB that an unnecessary correction may cost


# ---------------------------------------------------------------- cases
def fine(binary, kind, ratio, blur, side, rng):
    """The light [B,n,n] of masks on cells, FINE to a pixel, as a lens blurs it."""
    if kind.startswith('iid'):
        light = (rng.random((ratio, side, side)) < .5).astype(np.float32).repeat(FINE, 1).repeat(FINE, 2)
    else:
        light = simulated(binary, kind, ratio, side * FINE, int(rng.integers(1 << 30)))
    return np.stack([cv2.GaussianBlur(frame, (0, 0), blur * FINE) for frame in light]) if blur else light


def areas(light, cells):
    """Masks as means over the areas of pixels, after the light moved down and to the right by cells."""
    frames, side, _ = light.shape
    return np.roll(light, cells, (1, 2)).reshape(frames, side // FINE, FINE, side // FINE, FINE).mean((2, 4))


def warped(light, shift, rotation, scale):
    """The light [B,n,n] after it moved by pixels down and to the right, turned clockwise by degrees, and grew, about its centre."""
    centre, angle = (np.array(light.shape[2:0:-1]) - 1) / 2, np.deg2rad(rotation)
    turn = scale * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    matrix = np.c_[turn, centre - turn @ centre + FINE * np.array(shift[::-1])]
    return np.stack([cv2.warpAffine(frame, matrix, frame.shape[::-1], flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT) for frame in light])


class Case:
    def __init__(self, a, files, index):
        rng, side = np.random.default_rng([11, index]), a.side
        self.kind, self.ratio, self.sigma = KINDS[index % 4], int(rng.choice(RATIOS)), float(SIGMAS[index // 4 % 4])
        self.step, scale = float(rng.choice(STEPS)), float(rng.choice([.3, .5, .8]))
        self.blur = float(rng.uniform(.6, .8)) if self.kind == 'iid-blurred' else 0
        # A third of the shifts is shorter than a pixel.
        reach = 1 if index // 4 % 3 == 1 else REACH
        cells = rng.integers(-reach * FINE, reach * FINE + 1, 2)
        cells[0] = cells[0] or 3
        self.shift, file = (cells / FINE).tolist(), files[index % len(files)]
        photo = cv2.imread(file, cv2.IMREAD_GRAYSCALE)
        self.photo, self.frames = pathlib.Path(file).stem, panned(photo, self.ratio, side, self.step, scale).astype(np.float32)
        light = fine(a.binary, self.kind, self.ratio, self.blur, side + 2 * BORDER, rng)
        still = areas(light, [0, 0])
        turns = np.random.default_rng([13, index])
        self.side, self.rotation, self.scale = side, float(turns.uniform(-1, 1) * a.rotation), float(1 + turns.uniform(-1, 1) * a.growth / 100)
        if a.rotation or a.growth:
            light, cells = warped(light, self.shift, self.rotation, self.scale), [0, 0]
        moved = areas(light, cells) if a.motion == 'areas' else np.stack([ndimage.shift(mask, self.shift, mode='mirror') for mask in still]).clip(0, 1)
        self.calibrated, self.moved = (masks[:, BORDER:-BORDER, BORDER:-BORDER] for masks in (still, moved))
        self.noise = (self.sigma / 255 * rng.standard_normal((side, side))).astype(np.float32)

    def about(self):
        return {'kind': self.kind, 'ratio': self.ratio, 'sigma': self.sigma, 'shift': self.shift, 'rotation': self.rotation, 'scale': self.scale, 'side': self.side, 'blur': self.blur, 'step': self.step, 'photo': self.photo[:30]}


def simulated(binary, kind, ratio, side, seed):
    """Masks [B,side,side] of the optics, with FINE sensor pixels to a pixel of the lithography mask."""
    with tempfile.TemporaryDirectory() as folder:
        folder = pathlib.Path(folder)
        np.save(folder / 'scene.npy', np.full((ratio, side, side), 128, np.uint8))
        (folder / 'optics.toml').write_text(f'[relay]\nmagnification = {FINE}\n')
        subprocess.run([binary, 'simulate', '--frames', folder / 'scene.npy', '--compression-ratio', str(ratio), '--pattern', kind,
                        '--seed', str(seed), '--optics', folder / 'optics.toml', '--out', folder / 'out'], check=True, stdout=subprocess.DEVNULL)
        return np.load(folder / 'out/masks.npy')


# ---------------------------------------------------------------- runs
class Bench(Runs):
    def __init__(self, a):
        super().__init__(a, lambda row: row['case'])

    def case(self, index):
        if index in self.done:
            return
        case = Case(self.a, self.files, index)
        runs = {}
        for drift, true in (('drift', case.moved), ('none', case.calibrated))[:1 if self.a.only_motion else 2]:
            y = (true * case.frames).sum(0) + case.noise
            arms = [('calibrated', case.calibrated, 'off'), ('registered', case.calibrated, 'auto')]
            arms += [('true', true, 'off')] if drift == 'drift' else []
            if drift == 'none':
                arms += [('flipped', case.calibrated[:, :, ::-1], 'off'), ('flipped_registered', case.calibrated[:, :, ::-1], 'auto')]
            if self.a.only_motion:
                arms = arms[1:2]
            runs[drift] = {name: self.reconstruct(masks, y, case.frames, option) for name, masks, option in arms}
        self.keep({'case': index} | case.about() | runs)

    def reconstruct(self, masks, y, truth, option):
        with tempfile.TemporaryDirectory() as folder:
            folder = pathlib.Path(folder)
            for name, array in {'masks': masks, 'measurement': y / len(masks), 'truth': truth}.items():
                np.save(folder / f'{name}.npy', array.astype(np.float32))
            done = subprocess.run([self.a.binary, 'reconstruct', '--masks', folder / 'masks.npy', '--measurement', folder / 'measurement.npy', '--truth', folder / 'truth.npy',
                                   '--truth-full-scale', '1', '--measurement-full-scale', str(1 / len(masks)), '--algorithm', self.a.algorithm, '--registration', option,
                                   *(['--iterations', '2'] if self.a.only_motion else []), '--threads', '1', '--json', '--out', folder / 'out'], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
            if done.returncode not in (0, 3):
                sys.exit(f'a reconstruction failed: {done.stderr}')
            report, manifest = json.loads(done.stdout), json.loads((folder / 'out/manifest.json').read_text())
            error = (np.load(folder / 'out/frames.npy').reshape(truth.shape) - truth)[:, REACH:-REACH, REACH:-REACH]
        return {'psnr_db': float(-10 * np.log10((error ** 2).mean())), 'whole_db': report['psnr_unit_db'], 'cpu_s': report['cpu_seconds'], 'registration': manifest['content'].get('registration')}


def run(a):
    bench = Bench(a)
    with concurrent.futures.ThreadPoolExecutor(a.parallel) as pool:
        for future in [pool.submit(bench.case, index) for index in range(a.first, a.first + a.cases)]:
            future.result()
    report(a)


# ---------------------------------------------------------------- report
def error(row):
    """Error of the estimated displacement in pixels, a root mean square over the picture; `None` if no correction was applied."""
    found = row['drift']['registered']['registration']
    shift = np.subtract(found['shift'], row['shift'])
    turn, growth = np.deg2rad(found['rotation'] - row['rotation']), found['scale'] - row['scale']
    return float(np.sqrt((shift ** 2).sum() + (turn ** 2 + growth ** 2) * row['side'] ** 2 / 6)) if found['applied'] else None


def motion(one):
    return f'{np.round(one["shift"], 3).tolist()} {one["rotation"]:.3f} deg {100 * (one["scale"] - 1):.3f} %'


def limit(row):
    """Largest acceptable error of the shift in pixels."""
    fine = .05 if row['sigma'] <= 5 and row['ratio'] <= 10 else .1
    return fine + .05 if row['kind'] == 'rotating-circle' else fine


def gain(arms, one='registered', other='calibrated'):
    return arms[one]['psnr_db'] - arms[other]['psnr_db']


def median(values):
    return round(float(np.median(values)), 2) if len(values) else None


def summary(rows):
    errors = [error(row) for row in rows]
    applied = [(row, error) for row, error in zip(rows, errors) if error is not None]
    complete = [row for row in rows if 'true' in row['drift']]
    psnr = lambda name: median([row['drift'][name]['psnr_db'] for row in complete])
    return {'cases': len(rows), 'applied': len(applied), 'within_limit': sum(error <= limit(row) for row, error in applied),
            'within_0_05': sum(error <= .05 for _, error in applied), 'within_0_1': sum(error <= .1 for _, error in applied),
            'calibrated_db': psnr('calibrated'), 'registered_db': psnr('registered'), 'true_db': psnr('true'),
            'lost_to_true_db': median([gain(row['drift'], 'true', 'registered') for row, _ in applied if 'true' in row['drift']]),
            'made_worse': sum(gain(row[drift]) < -WORSE for row in complete for drift in ('drift', 'none') if drift in row)
                          + sum(gain(row['none'], 'flipped_registered', 'flipped') < -WORSE for row in rows if 'none' in row),
            'false_corrections': [sum(row['none'][arm]['registration']['applied'] for row in rows if 'none' in row) for arm in ('registered', 'flipped_registered')]}


def report(a):
    rows = sorted(read(a.out), key=lambda row: row['case'])
    table = {kind: summary([row for row in rows if row['kind'] == kind]) for kind in KINDS if any(row['kind'] == kind for row in rows)}
    table['all'] = summary(rows)
    if not a.markdown:
        for row in rows:
            found, off = row['drift']['registered']['registration'], error(row)
            psnr = ' '.join(f'{row["drift"][name]["psnr_db"]:.2f}' for name in ('calibrated', 'registered', 'true') if name in row['drift'])
            print(f'{row["case"]:3} {row["kind"]:15} Cr {row["ratio"]:2} sigma {row["sigma"]:g} motion {motion(row)} found {motion(found)} '
                  f'{"not applied" if off is None else f"off by {off:.3f}"}{"" if off is None or off <= limit(row) else " !"} dB {psnr} {(found["reason"] or "")[:40]}', end='')
            if 'none' in row:
                still = row['none']['registered']['registration']
                print(f'; no drift: {motion(still)} {"APPLIED" if still["applied"] else "left"} {gain(row["none"]):+.2f}; '
                      f'flipped: {"APPLIED" if row["none"]["flipped_registered"]["registration"]["applied"] else "left"}', end='')
            print()
        print()
    print('| masks | corrected | within the limit | within 0.05 and 0.1 pixels | calibrated, registered, true masks, dB | below true masks, dB | corrections of right masks, of flipped ones | made worse |')
    print('| --- | --- | --- | --- | --- | --- | --- | --- |')
    for kind, one in table.items():
        print(f'| {kind} | {one["applied"]} of {one["cases"]} | {one["within_limit"]} | {one["within_0_05"]}, {one["within_0_1"]} | {one["calibrated_db"]}, {one["registered_db"]}, {one["true_db"]}'
              f' | {one["lost_to_true_db"]} | {", ".join(map(str, one["false_corrections"]))} | {one["made_worse"]} |')
    complete = [row for row in rows if 'true' in row['drift']]
    runs = [(row['ratio'], row[drift]) for row in complete for drift in ('drift', 'none') if drift in row]
    cost = [(ratio, arms['registered']['cpu_s'] - arms['calibrated']['cpu_s']) for ratio, arms in runs]
    cpu = {'cpu_s_per_frame': median([seconds / ratio for ratio, seconds in cost]), 'largest_cpu_s': round(max(seconds for _, seconds in cost), 2)} if cost else {}
    print()
    print(json.dumps(table | cpu))


def main():
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = p.add_subparsers(dest='what', required=True)
    runs = commands.add_parser('run')
    runs.add_argument('binary', metavar='SCI_RECON_BINARY', type=os.path.abspath)
    runs.add_argument('--data', required=True)
    runs.add_argument('--cases', type=int, default=40)
    runs.add_argument('--first', type=int, default=0, help='number of the first case; use others than the first 40 for tuning')
    runs.add_argument('--motion', choices=['areas', 'spline'], default='areas')
    runs.add_argument('--algorithm', default='gap-tv')
    runs.add_argument('--side', type=int, default=128, help='side of the images in pixels')
    runs.add_argument('--rotation', type=float, default=0, help='largest rotation in degrees')
    runs.add_argument('--growth', type=float, default=0, help='largest change of the magnification in percent')
    runs.add_argument('--only-motion', action='store_true', help='estimate the motion of moved masks alone, without PSNR')
    runs.add_argument('--parallel', type=int, default=os.cpu_count(), help='reconstructions at the same time')
    for command in (runs, commands.add_parser('report')):
        command.add_argument('--out', required=True, help='the folder of the results')
        command.add_argument('--markdown', action='store_true', help='print the table alone')
    a = p.parse_args()
    {'run': run, 'report': report}[a.what](a)


if __name__ == '__main__':
    main()
