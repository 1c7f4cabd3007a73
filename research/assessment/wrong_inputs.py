"""Test whether wrong inputs are flagged, and correct ones are not, through the real service.

    python wrong_inputs.py SCI_RECON_BINARY --data DATA [--good 60] [--scenes 6] [--algorithm gap-tv] [--side 256]

DATA has photographs in photos/train and photos/val. A camera moves over them by at most 4 pixels per frame, behind
masks of every kind, Cr 6 to 24, with noise of 0 to 10 and given dark frames. A result is flagged if its assessment has
a finding about the input, is graded `bad` though its PSNR is above 22 dB, or is predicted 3 dB below that of the
correct input. The last line of the output is JSON.
"""
import argparse
import glob
import json
import pathlib
import shutil
import subprocess
import sys
import tempfile

import cv2
import numpy as np

HERE = pathlib.Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent.parent / 'benches' / 'scale'))
from service import Service  # noqa: E402

PATTERNS = 'iid', 'random-squares', 'rotating-circle'
RATIOS = 6, 8, 10, 12, 16, 20, 24
SIGMAS = 0, 0, 0, 2, 5, 10
# Offset that the camera adds, as a share of the mean, and the brightest pixel as a share of the largest number.
DARK, HEADROOM = .1, .8
# Findings about the scene, not about wrong inputs.
SCENE_FINDINGS = {'uneven_error'}
FALL = 3.0      # dB
BAD = 22.0      # dB, as in the program


def panned(photo, frames, side, step, scale):
    """Frames [frames,side,side] on [0,1] of a camera that moves by `step` pixels per frame over a grey photograph."""
    scale = max(scale, (side + 2) / min(photo.shape))
    photo = cv2.resize(photo, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA).astype(np.float32) / 255
    middle = np.array(photo.shape[::-1]) / 2 - side / 2
    matrix = lambda k: np.float32([[1, 0, -middle[0] - (k - frames / 2) * step], [0, 1, -middle[1]]])
    return np.stack([cv2.warpAffine(photo, matrix(k), (side, side), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT) for k in range(frames)]).clip(0, 1)


class Lab:
    def __init__(self, service, folder, algorithm):
        self.service, self.folder, self.algorithm = service, folder, algorithm

    def send(self, array):
        np.save(self.folder / 'one.npy', array)
        return self.service.upload(self.folder / 'one.npy')

    def job(self, masks, y, dark=None, full=65535 * HEADROOM, stated=1):
        """Assessment and frames of a job with 16-bit numbers, where `full` stands for the largest value of `y`, and the
        stated full scale is `stated` times the true one."""
        scale = full / y.max()
        counts = lambda values: self.send((values * scale).round().clip(0, 65535).astype(np.uint16))
        calibration = self.service.call('POST', '/v1/calibrations', {'masks': self.send(masks.astype(np.float32))})['id']
        body = {'calibration': calibration, 'data': counts(y), 'full_scale': float(scale * stated)} | ({'dark': [counts(dark)]} if dark is not None else {})
        measurement = self.service.call('POST', '/v1/measurements', body)['id']
        job = self.service.call('POST', '/v1/jobs', {'measurement': measurement, 'algorithm': self.algorithm})['id']
        while True:
            ended = self.service.call('GET', f'/v1/jobs/{job}?wait=20')
            if ended['state'] not in ('queued', 'running'):
                break
        if ended['state'] != 'succeeded':
            sys.exit(f'a job ended as {ended["state"]}: {ended}')
        return ended['assessment'], self.service.array(f'/v1/jobs/{job}/snapshots/0/frames.npy', self.folder / 'frames.npy')


def wrongs(masks, other, clean, dark, fast):
    """Name and job arguments of each wrong input; `fast` is the measurement of a fast motion."""
    gains = np.tile([[.7, 1.], [1., .8]], [extent // 2 for extent in clean.shape])
    y = clean + dark
    yield 'foreign masks', dict(masks=other, y=y, dark=dark)
    yield 'masks shifted by 2 pixels', dict(masks=np.roll(masks, 2, axis=2), y=y, dark=dark)
    yield '1 % saturated', dict(masks=masks, y=y, dark=dark, full=65535 * y.max() / np.quantile(y, .99))
    yield 'no dark', dict(masks=masks, y=y)
    yield 'a dark of another exposure', dict(masks=masks, y=y, dark=3 * dark)
    yield 'full scale wrong by ten', dict(masks=masks, y=y, dark=dark, stated=10)
    yield 'full scale wrong by a tenth', dict(masks=masks, y=y, dark=dark, stated=.1)
    yield 'a Bayer mosaic taken as grey', dict(masks=masks, y=clean * gains + dark, dark=dark)
    yield 'motion above 8 pixels a frame', dict(masks=masks, y=fast + dark, dark=dark)


def psnr(found, truth):
    """Relative to the white level of the frames, as the expected PSNR is."""
    peak = np.quantile(found, .999)
    return float(np.mean(-10 * np.log10(((found - truth) ** 2).mean((1, 2)) / peak ** 2)))


def shown(assessment):
    return '    -' if assessment['psnr_db'] is None else f"{assessment['psnr_db']:5.1f}"


def flags(assessment, right=None, true=None):
    """Reasons for which an assessment is a warning. The prediction counts only if that of the correct input is known."""
    found = [reason['code'] for reason in assessment['reasons'] if reason['code'] not in SCENE_FINDINGS]
    if right is not None and None not in (assessment['psnr_db'], right['psnr_db']) and assessment['psnr_db'] <= right['psnr_db'] - FALL:
        found.append('prediction')
    if assessment['grade'] == 'bad' and (true is None or true > BAD):
        found.append('bad')
    return found


def main():
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument('binary')
    p.add_argument('--data', required=True)
    p.add_argument('--good', type=int, default=60)
    p.add_argument('--scenes', type=int, default=6, help='scenes for each wrong input')
    p.add_argument('--algorithm', default='gap-tv')
    p.add_argument('--side', type=int, default=256)
    a = p.parse_args()
    folder = pathlib.Path(tempfile.mkdtemp(prefix='sci-recon-wrong-'))
    files = sorted(glob.glob(f'{a.data}/photos/val/*.jpg') + glob.glob(f'{a.data}/photos/train/*.jpg'))
    rng = np.random.default_rng(3)
    service = Service(a.binary, folder / 'service', ['--workers', '2'])
    lab, alarms, seen, errors = Lab(service, folder, a.algorithm), [], {}, []
    try:
        for index in range(a.good):
            file = files[index % len(files)]
            photo = cv2.imread(file, cv2.IMREAD_GRAYSCALE)
            ratio, pattern, sigma = int(rng.choice(RATIOS)), PATTERNS[index % 3], float(rng.choice(SIGMAS))
            step, scale = float(rng.choice([0, .3, 1, 2, 4])), float(rng.choice([.3, .5, .8]))
            frames = panned(photo, ratio, a.side, step, scale)
            np.save(folder / 'scene.npy', frames.astype(np.float32))
            for seed, name in ((1, 'one'), (2, 'other')):
                subprocess.run([a.binary, 'simulate', '--frames', folder / 'scene.npy', '--compression-ratio', str(ratio), '--pattern', pattern,
                                '--noise-sigma', str(sigma), '--seed', str(seed), '--out', folder / name], check=True, stdout=subprocess.DEVNULL)
            masks, other = (np.load(folder / name / 'masks.npy') for name in ('one', 'other'))
            clean, truth = np.load(folder / 'one/measurement.npy').reshape(a.side, a.side), np.load(folder / 'one/truth.npy')
            dark = np.float32(DARK * clean.mean()) * (1 + .1 * rng.standard_normal(clean.shape, np.float32))
            right, found = lab.job(masks, clean + dark, dark)
            true = psnr(found, truth)
            if right['psnr_db'] is not None:
                errors.append(min(true, 40) - min(right['psnr_db'], 40))
            what = flags(right, true=true)
            if what:
                alarms.append(f'{pathlib.Path(file).stem} {pattern} Cr {ratio} sigma {sigma:g}: {what}')
                print('   ', *(reason['detail'] for reason in right['reasons']), sep='\n    ')
            print(f'{pathlib.Path(file).stem[:30]:30} {pattern:16} {ratio:2} {sigma:4} true {true:5.1f} predicted {shown(right)} {right["grade"]} {what}', flush=True)
            if index < a.scenes:
                moved = panned(photo, ratio, a.side, 10, scale)
                fast = (masks * moved).sum(0) + clean - (masks * truth).sum(0)      # the same noise
                for name, wrong in wrongs(masks, other, clean, dark, fast):
                    got, frames = lab.job(**wrong)
                    what = flags(got, right)
                    if name.startswith('motion') and psnr(frames, moved) > true - FALL:
                        print(f'    {name:32} does no harm here: {psnr(frames, moved):.1f} dB')
                        continue
                    seen.setdefault(name, []).append(bool(what))
                    print(f'    {name:32} predicted {shown(got)} {got["grade"]:6} {what}', flush=True)
    finally:
        service.process.terminate()
        shutil.rmtree(folder, ignore_errors=True)
    errors = np.array(errors)
    print(json.dumps({'flagged': {name: f'{sum(of)} of {len(of)}' for name, of in seen.items()}, 'false_alarms': alarms, 'good': a.good,
                      'prediction_off_by_db': round(float(np.abs(errors).mean()), 2), 'within_1_5_db': round(float((np.abs(errors) < 1.5).mean()), 2)}))


if __name__ == '__main__':
    main()
