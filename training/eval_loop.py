"""Judge the product in its loop: the released program on snapshots whose truth is known, with networks trained in different ways.

    python eval_loop.py --binary ../target/release/sci-recon --data DATA --scenes SCENES --white white.pt [--full] [--json]

`make eval-loop` does that. Each row is one `sci-recon simulate` (or a scene with its own masks) and one `sci-recon reconstruct` on one thread. Schedules
and hashes of models come from the program's own manifest. Rows that were computed before are taken from the output folder: the key is everything
that a row depends on, the source of solver and optics included.
"""
import argparse
import concurrent.futures
import dataclasses
import glob
import hashlib
import json
import os
import subprocess
import sys
import tempfile

import cv2
import numpy as np
import scipy.io

import export
import model

HERE = os.path.dirname(os.path.abspath(__file__))
SEED = 1
TV, FFDNET, WHITE, LOOP, INT8, TWICE, DEFAULT = ALGORITHMS = (
    'gap-tv', 'pnp-ffdnet', 'fastdvdnet, white noise', 'fastdvdnet, in the loop', 'fastdvdnet, in the loop, 8 bits first',
    'fastdvdnet, in the loop, passes doubled', 'pnp-tv-fastdvdnet')


TURNS = (TV,), (WHITE, LOOP), (DEFAULT,), (INT8,), (TWICE,), (FFDNET,)   # the order of the work: what tells most comes first


@dataclasses.dataclass(frozen=True)
class Setting:
    """One snapshot: a square clip and what is done to it."""
    scene: str
    masks: str          # 'own' or a --pattern of `sci-recon simulate`
    cr: int
    sigma: int = 0      # noise of the measurement, of 255
    size: int = 256
    snapshot: int = 0   # for own masks
    twice: bool = dataclasses.field(default=False, compare=False)   # also with the passes doubled

    def __str__(self):
        return f'{self.scene} {self.size}' + (f' snapshot {self.snapshot}' if self.masks == 'own' else '')


# Each kind of masks, compression ratio and noise; the most telling first.
DEFAULT_SETTINGS = (
    Setting('traffic', 'own', 8, twice=True),
    Setting('street', 'random-squares', 10, twice=True),
    Setting('traffic', 'random-squares', 10),
    Setting('city', 'random-squares', 10, 5),
    Setting('street', 'random-squares', 20),
    Setting('bird', 'rotating-circle', 10, 5, twice=True),
    Setting('flower', 'random-squares', 20, 5),
    Setting('street', 'iid', 10, 5),
    Setting('city', 'rotating-circle', 8),
    Setting('bird', 'iid', 10),
    Setting('city', 'iid', 8, 5),
    Setting('traffic', 'rotating-circle', 30),
)


def all_settings(lengths):
    """Every combination that the clips are long enough for, with the passes doubled throughout."""
    every = [Setting('traffic', 'own', 8, snapshot=n, twice=True) for n in range(6)]
    for size, scenes in ((256, lengths), (512, ('street', 'flower'))):
        every += [Setting(scene, masks, cr, sigma, size, twice=True)
                  for scene in scenes for masks in ('iid', 'random-squares', 'rotating-circle')
                  for cr in (8, 10, 20, 30) if cr <= lengths[scene] for sigma in (0, 5)]
    return every


# ---------------------------------------------------------------- footage
def pictures(folder):
    files = sorted(glob.glob(os.path.join(folder, '*.jpg')) + glob.glob(os.path.join(folder, '*.png')))
    if not files:
        raise SystemExit(f'no pictures in {folder}')
    return np.stack([cv2.imread(f, cv2.IMREAD_GRAYSCALE) for f in files])


def clips(a):
    """Name -> frames [count,H,W], uint8. None of them was trained on."""
    for path in (a.traffic, a.street):
        if not os.path.isfile(path):
            raise SystemExit(f'there is no scene {path}: --scenes (make: SCENES=folder) names the folder of the scenes')
    with np.load(a.street) as archive:
        street = next(archive[k] for k in archive.files if archive[k].ndim == 3)
    return {
        'traffic': scipy.io.loadmat(a.traffic)['orig'].transpose(2, 0, 1).round().astype(np.uint8),
        'street': street if street.dtype == np.uint8 else (street * 255).round().astype(np.uint8),
        'city': pictures(os.path.join(HERE, '../demo/clip')),
        'flower': pictures(os.path.join(a.data, 'clips/val/gh-mdn__flower')),
        'bird': pictures(os.path.join(a.data, 'clips/val/gh-intel__asl_bird')),
    }


def middle(frames, count, size):
    top, left = ((extent - size) // 2 for extent in frames.shape[1:])
    return np.ascontiguousarray(frames[:count, top:top + size, left:left + size])


# ---------------------------------------------------------------- the program
class Program:
    def __init__(self, binary):
        self.binary = binary

    def run(self, *arguments):
        done = subprocess.run([self.binary, *map(str, arguments)], capture_output=True, text=True)
        if done.returncode:
            raise SystemExit(f"sci-recon {' '.join(map(str, arguments))}\n{done.stderr.strip()}")
        return done.stdout

    def simulate(self, frames, setting, folder):
        """Files of one snapshot of these frames, as arguments of `reconstruct`."""
        clip = os.path.join(folder, 'clip.npy')
        np.save(clip, frames)
        self.run('simulate', '--frames', clip, '--compression-ratio', setting.cr, '--pattern', setting.masks, '--seed', SEED,
                 '--noise-sigma', setting.sigma, '--out', folder)
        return [f'--{name}={folder}/{name}.npy' for name in ('masks', 'measurement', 'truth')]

    def schedule(self, algorithm):
        """The schedule of an algorithm."""
        return json.loads(self.run('schedule', '--algorithm', algorithm))

    def models(self, arguments, frames):
        """The models that `reconstruct` uses with these arguments, as the manifest of a small snapshot tells them."""
        with tempfile.TemporaryDirectory() as folder:
            inputs = self.simulate(middle(frames, 8, 64), Setting('any', 'iid', 8), folder)
            self.run('reconstruct', *inputs, *arguments, '--threads', 1, '--out', f'{folder}/result')
            with open(f'{folder}/result/manifest.json') as f:
                return json.load(f)['content']['models']


@dataclasses.dataclass
class Way:
    """One way to reconstruct: what to call the program with, and what the result depends on."""
    algorithm: str
    arguments: list
    schedule: dict
    models: list


def exported(checkpoint, out):
    """The checkpoint's network as a folder of models, made once."""
    with open(checkpoint, 'rb') as f:
        folder = os.path.join(out, 'white-' + hashlib.sha256(f.read()).hexdigest()[:16])
    if not os.path.isdir(folder):
        os.makedirs(out, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=out) as part:
            export.export(model.load(checkpoint), os.path.join(part, 'made', 'fastdvdnet-gray'))
            os.rename(os.path.join(part, 'made'), folder)
    return folder


def ways(program, a, frames, folder):
    """Name -> Way. Networks are compared in the deep stages of the default schedule, without what follows them, with all their iterations, and in
    floating point throughout; INT8 is the same as the schedule has it."""
    own = ['--models', a.models] if a.models else []
    white = exported(a.white, a.out)
    default = program.schedule(DEFAULT)
    deep = [i for i, stage in enumerate(default['stages']) if 'fastdvdnet' in stage['prior']]
    if not deep:
        raise SystemExit(f'the schedule of {DEFAULT} has no stage of the network')
    first, last = default['stages'][deep[0]], default['stages'][deep[-1]]
    count = sum(default['stages'][i]['iterations'] for i in deep)

    def cut(*stages):
        return {**default, 'adaptive': False, 'stages': default['stages'][:deep[0]] + list(stages)}

    def whole(iterations):
        return cut({**last, 'iterations': iterations, 'sigma': [first['sigma'][0], last['sigma'][1]]})

    int8 = cut(*(default['stages'][i] for i in deep))
    # As long as it needs: the test for convergence ends it.
    tv = program.schedule(TV)
    tv['stages'][-1]['iterations'] = 2000

    def way(name, algorithm, models, schedule=None):
        file = os.path.join(folder, f'{ALGORITHMS.index(name)}.json')
        arguments = ['--algorithm', algorithm, *models]
        if schedule:
            with open(file, 'w') as f:
                json.dump(schedule, f)
            arguments += ['--schedule', file]
        return name, Way(algorithm, arguments, schedule or program.schedule(algorithm), program.models(arguments, frames))

    return dict([way(TV, TV, own, tv), way(FFDNET, FFDNET, own), way(WHITE, DEFAULT, ['--models', white], whole(count)),
                 way(LOOP, DEFAULT, own, whole(count)), way(INT8, DEFAULT, own, int8), way(TWICE, DEFAULT, own, whole(2 * count)),
                 way(DEFAULT, DEFAULT, own)])


# ---------------------------------------------------------------- rows
def source_hash():
    """Of the code that a row depends on."""
    files = sorted(f for part in ('recon', 'optics') for f in glob.glob(os.path.join(HERE, '../src', part, '**/*.rs'), recursive=True))
    digest = hashlib.sha256()
    for f in files:
        with open(f, 'rb') as content:
            digest.update(content.read())
    return digest.hexdigest()


class Rows:
    def __init__(self, program, a, footage):
        self.program, self.a, self.footage, self.source = program, a, footage, source_hash()
        self.folder = os.path.join(a.out, 'rows')
        os.makedirs(self.folder, exist_ok=True)

    def key(self, setting, way):
        frames = middle(self.footage[setting.scene], setting.cr, setting.size)
        parts = [dataclasses.asdict(setting), SEED, hashlib.sha256(frames).hexdigest(), way.algorithm, way.schedule, way.models, self.source]
        parts[0].pop('twice')
        return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()

    def row(self, setting, name, way):
        """The row; none where only rows that are there already are wanted."""
        path = os.path.join(self.folder, self.key(setting, way) + '.json')
        if os.path.exists(path) and not self.a.fresh:
            with open(path) as f:
                return json.load(f)
        if self.a.cached:
            return None
        with tempfile.TemporaryDirectory() as folder:
            if setting.masks == 'own':
                inputs = ['--scene', self.a.traffic, '--snapshot', setting.snapshot]
            else:
                inputs = self.program.simulate(middle(self.footage[setting.scene], setting.cr, setting.size), setting, folder)
            report = json.loads(self.program.run('reconstruct', *inputs, *way.arguments, '--threads', 1, '--json'))
        row = {'scene': str(setting), 'masks': setting.masks, 'cr': setting.cr, 'sigma': setting.sigma, 'algorithm': name,
               'psnr_db': round(report['psnr_db'], 2), 'ssim': round(report['ssim'], 4), 'passes': report['denoiser_passes'],
               'cpu_seconds': round(report['cpu_seconds'], 1), 'models': {m['name']: m['sha256'] for m in way.models}}
        with open(path + '.part', 'w') as f:
            json.dump(row, f)
        os.replace(path + '.part', path)
        return row

    def all(self, tasks, report):
        """Rows, setting by setting; `report` sees each when it is there."""
        turn = lambda i: next(t for t, names in enumerate(TURNS) if tasks[i][1] in names)
        with concurrent.futures.ThreadPoolExecutor(self.a.jobs) as pool:
            pending = {pool.submit(self.row, *tasks[i]): i for i in sorted(range(len(tasks)), key=turn)}
            rows = [None] * len(tasks)
            try:
                for done in concurrent.futures.as_completed(pending):
                    row = rows[pending[done]] = done.result()
                    if row:
                        report(row)
            except BaseException:
                pool.shutdown(cancel_futures=True)
                raise
        return [row for row in rows if row]


# ---------------------------------------------------------------- what it says
def summary(rows):
    psnr = {((r['scene'], r['masks'], r['cr'], r['sigma']), r['algorithm']): r['psnr_db'] for r in rows}
    settings = list(dict.fromkeys(s for s, _ in psnr))

    def gains(better, worse, of=lambda s: True):
        return [psnr[s, better] - psnr[s, worse] for s in settings if of(s) and (s, better) in psnr and (s, worse) in psnr]

    def line(values, aim, what):
        if values:
            yield {'what': what, 'mean_db': round(sum(values) / len(values), 2), 'worst_db': round(min(values), 2), 'snapshots': len(values), 'aim': aim}

    squares = lambda cr: lambda s: s[1:3] == ('random-squares', cr)
    return [
        *line(gains(LOOP, WHITE), 'mean 1.0, worst -0.1', 'network trained in the loop over the same trained on white noise'),
        *line(gains(TWICE, LOOP), 'worst -0.1', 'passes doubled over the schedule\'s own number'),
        *line(gains(INT8, LOOP), 'worst -0.05', '8 bits in the first passes over floating point in all'),
        *line(gains(DEFAULT, TV, squares(10)), 'mean 3.0', f'{DEFAULT} over gap-tv, random squares, Cr 10'),
        *line(gains(DEFAULT, TV, squares(20)), 'mean 3.0', f'{DEFAULT} over gap-tv, random squares, Cr 20'),
        *line(gains(DEFAULT, INT8), 'none', f'{DEFAULT} over its stages up to the network (the nonlocal stage)'),
    ]


def table(rows, summed):
    yield '| scene | masks | Cr | noise | algorithm | PSNR dB | SSIM | passes | CPU s |'
    yield '| --- | --- | --- | --- | --- | --- | --- | --- | --- |'
    before = None
    for r in rows:
        setting = (r['scene'], r['masks'], r['cr'], r['sigma'])
        shown = setting if setting != before else [''] * 4
        before = setting
        yield f"| {' | '.join(map(str, shown))} | {r['algorithm']} | {r['psnr_db']:.2f} | {r['ssim']:.3f} | {r['passes']} | {r['cpu_seconds']:.0f} |"
    yield ''
    yield '| gain, dB | mean | worst | snapshots | aim |'
    yield '| --- | --- | --- | --- | --- |'
    for s in summed:
        yield f"| {s['what']} | {s['mean_db']:+.2f} | {s['worst_db']:+.2f} | {s['snapshots']} | {s['aim']} |"


def main():
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument('--binary', required=True, help='the released sci-recon')
    p.add_argument('--data', required=True, help='footage; clips of its validation split are used')
    p.add_argument('--scenes', required=True, help='folder with traffic48_cacti.mat and street_1024x1024x20.npz')
    p.add_argument('--white', required=True, help='checkpoint of the network trained on white noise alone')
    p.add_argument('--models', help='folder of models to be judged instead of those in the program')
    p.add_argument('--out', default='eval-output', help='folder for the rows')
    p.add_argument('--jobs', type=int, default=2, help='runs at the same time, one thread each')
    p.add_argument('--full', action='store_true', help='every combination, 512x512 too: days on two cores')
    p.add_argument('--fresh', action='store_true', help='compute every row again')
    p.add_argument('--cached', action='store_true', help='compute nothing: the rows that are there')
    p.add_argument('--json', action='store_true', help='one JSON object a row, and one with all rows at the end')
    a = p.parse_args()
    a.traffic, a.street = (os.path.join(a.scenes, name) for name in ('traffic48_cacti.mat', 'street_1024x1024x20.npz'))
    if not os.path.isfile(a.white):
        raise SystemExit(f'there is no checkpoint {a.white}: --white (make: WHITE=file) names weights trained on white noise, train.py --stage full')
    footage, program = clips(a), Program(a.binary)
    settings = all_settings({name: len(frames) for name, frames in footage.items()}) if a.full else DEFAULT_SETTINGS
    with tempfile.TemporaryDirectory() as folder:
        known = ways(program, a, footage['city'], folder)
        tasks = [(s, name, way) for s in settings for name, way in known.items() if name != TWICE or s.twice]
        report = lambda row: print(json.dumps(row), file=sys.stdout if a.json else sys.stderr, flush=True)
        rows = Rows(program, a, footage).all(tasks, report)
    summed = summary(rows)
    print(json.dumps({'rows': rows, 'summary': summed}) if a.json else '\n'.join(table(rows, summed)))


if __name__ == '__main__':
    main()
