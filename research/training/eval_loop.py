"""Judge the released program in its loop, on snapshots with known true frames and with networks trained in different
ways.

    python eval_loop.py --binary ../../target/release/sci-recon --data DATA --scenes SCENES --white white.pt [--full] [--json]

`make eval-loop` runs it. Each row is one `sci-recon simulate` (or a scene with its own masks) and one `sci-recon
reconstruct` on one thread. Schedules and hashes of models come from the program's manifest. Rows computed earlier are
taken from the output folder: the key contains everything that a row depends on, including the sources of solver and
optics.
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
TV, FFDNET, WHITE, LOOP, INT8, TWICE, DEFAULT, FIXED = ALGORITHMS = (
    'gap-tv', 'pnp-ffdnet', 'fastdvdnet, white noise', 'fastdvdnet, in the loop', 'fastdvdnet, in the loop, 8 bits',
    'fastdvdnet, in the loop, passes doubled', 'pnp-tv-fastdvdnet', 'pnp-tv-fastdvdnet, without a pilot')


TURNS = (TV,), (DEFAULT, FIXED), (WHITE, LOOP), (INT8,), (TWICE,), (FFDNET,)   # order of the work: the most informative first
NETWORKS = TV, FFDNET, WHITE, LOOP, INT8, TWICE, DEFAULT   # compared on the settings of the networks
PREDICTED = TV, DEFAULT                             # have a quality model
PLANS = TV, INT8, FIXED, DEFAULT                    # compared on the cases of the schedules; INT8 is the default up to its nonlocal stage
LOST = 0.1          # dB; a case that loses more counts as lost


@dataclasses.dataclass(frozen=True)
class Setting:
    """One snapshot: a square clip and its settings."""
    scene: str
    masks: str          # 'own' or a --pattern of `sci-recon simulate`
    cr: int
    sigma: int = 0      # noise of the measurement, on the scale of 255
    size: int = 256
    snapshot: int = 0   # for own masks
    twice: bool = dataclasses.field(default=False, compare=False)   # also with the passes doubled
    half: str = dataclasses.field(default='', compare=False)        # 'tuning' or 'held out'
    blur: float = 0     # blur of the masks by a lens: standard deviation in pixels
    leak: float = 0     # transmission of closed mask pixels, relative to open ones

    def __str__(self):
        return f'{self.scene} {self.size}' + (f' snapshot {self.snapshot}' if self.masks == 'own' else '')

    def kind(self):
        """Kind of masks, with blur and leak."""
        return self.masks + (f', blur {self.blur}' if self.blur else '') + (f', leak {self.leak}' if self.leak else '')


# Each kind of masks, compression ratio and noise; the most informative first.
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

# Cases that judge schedules: clips and masks of all kinds. No constant was chosen with the held-out ones.
CASE_SIZE = 128
CASES = {
    'tuning': (
        ('traffic', 'iid', 8, 0), ('traffic', 'random-squares', 10, 0), ('traffic', 'rotating-circle', 30, 0),
        ('street', 'random-squares', 10, 0), ('street', 'iid', 20, 5), ('street', 'random-squares', 20, 0),
        ('bird', 'iid', 10, 0), ('bird', 'rotating-circle', 10, 5), ('bird', 'iid', 6, 10),
        ('sunset', 'iid', 8, 0), ('sunset', 'random-squares', 10, 5),
        ('architecture', 'iid', 10, 0), ('architecture', 'random-squares', 8, 0),
        ('shapes', 'iid', 16, 0), ('canyon', 'random-squares', 8, 5)),
    'held out': (
        ('city', 'iid', 8, 5), ('city', 'rotating-circle', 8, 0), ('city', 'random-squares', 10, 10),
        ('flower', 'random-squares', 20, 5), ('flower', 'iid', 8, 0), ('flower', 'iid', 24, 0),
        ('chamomile', 'iid', 8, 0), ('chamomile', 'random-squares', 10, 0),
        ('lighthouse', 'iid', 8, 5), ('lighthouse', 'rotating-circle', 6, 0),
        ('portrait', 'iid', 12, 10), ('portrait', 'random-squares', 8, 0),
        ('still', 'iid', 8, 0), ('still', 'random-squares', 20, 5),
        ('gratings', 'iid', 10, 0)),
}


# Held-out scenes behind masks as real optics make them: (blur in pixels, share of light through closed pixels).
SOFTENED = (
    ('chamomile', 'iid', 8, 0, .6, 0), ('chamomile', 'random-squares', 10, 0, .5, 0), ('city', 'iid', 8, 5, .5, .1), ('city', 'iid', 10, 0, .7, 0),
    ('city', 'rotating-circle', 8, 0, .5, 0), ('flower', 'iid', 24, 0, .6, .1), ('flower', 'iid', 8, 5, 0, .3), ('flower', 'rotating-circle', 12, 5, 0, .2),
    ('lighthouse', 'iid', 6, 0, .7, 0), ('portrait', 'iid', 12, 0, .5, .1), ('still', 'iid', 16, 5, .8, 0), ('gratings', 'iid', 10, 0, .6, .1))


# Additional cases that judge predictions: the same scenes, larger. Masks, ratio and noise of each case follow its own
# ones in these lists.
FOLLOWING = ('iid', 'random-squares', 'rotating-circle'), (6, 8, 10, 12, 16, 20, 24, 30), (0, 5, 10)
TOLERANCE = 1.5          # dB; a prediction with a larger error counts as wrong
ERRORS_FOUND = 3    # exit code of a reconstruction with findings that are errors
BEST = 40.0         # dB; the program does not distinguish higher values


def cases():
    return [Setting(*case, size=CASE_SIZE, half=half) for half, those in CASES.items() for case in those]


def softened():
    return [Setting(*case, size=CASE_SIZE, blur=blur, leak=leak) for *case, blur, leak in SOFTENED]


def following(lengths):
    """The cases of CASES with the next settings of FOLLOWING; `lengths` are those of the clips."""
    for case in cases():
        masks, cr, sigma = (values[(values.index(own) + 1) % len(values)] for values, own in zip(FOLLOWING, (case.masks, case.cr, case.sigma)))
        yield Setting(case.scene, masks, cr if cr <= lengths[case.scene] else FOLLOWING[1][0], sigma)


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


def seen(photo, centre, turned, size):
    """The view of a camera above a photograph, at `centre` (x, y) and rotated by `turned` degrees."""
    matrix = cv2.getRotationMatrix2D(centre, turned, 1)
    matrix[:, 2] += size / 2 - np.array(centre)
    return cv2.warpAffine(photo, matrix, (size, size), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)


def panned(file, scale, step, light=1.0, turn=0.0, count=24, size=CASE_SIZE):
    """A camera that moves over a photograph: `step` pixels (x, y) and `turn` degrees from frame to frame."""
    photo = cv2.imread(file, cv2.IMREAD_GRAYSCALE)
    if photo is None:
        raise SystemExit(f'there is no photograph {file}')
    photo = cv2.resize(photo.astype(np.float32), None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    times = np.arange(count) - (count - 1) / 2
    centre = lambda time: tuple(extent / 2 + time * by for extent, by in zip(photo.shape[::-1], step))
    return (np.stack([seen(photo, centre(time), turn * time, size) for time in times]) * light).clip(0, 255).round().astype(np.uint8)


def drawn(frame, count=24, size=CASE_SIZE):
    """A clip from the formula `frame`, in grey values."""
    i, j = np.mgrid[:size, :size].astype(np.float32)
    return np.stack([frame(k, i, j, size) for k in range(count)]).clip(0, 255).round().astype(np.uint8)


def shapes(k, i, j, size):
    """Discs of all sizes that cross each other in front of a slope."""
    grey = 60 + 80 * i / size
    for n in range(6):
        row, column = (size * (0.15 + 0.15 * n) + (n - 2.5) * 1.2 * k) % size, (size * (0.8 - 0.12 * n) + (2.5 - n) * 1.7 * k + 13 * n) % size
        grey = grey + 90 * (-1) ** n * np.clip(6.5 + 2 * n - np.hypot(i - row, j - column), 0, 1)
    return grey


def gratings(k, i, j, size):
    """Fine stripes, two ways."""
    upper, lower = (i + 0.7 * k) / 5.3 + j / 17, (j - 1.3 * k) / 7.1 - i / 23
    return 128 + 50 * np.sin(2 * np.pi * np.where(i < size / 2, upper, lower))


# Smooth and almost static; fine and static; fine stripes; fast; dark; rotating; without any motion.
PANNED = {
    'sunset': ('budgie-backgrounds__budgie_beacon-street-sunset', 0.25, (0.3, 0.1)),
    'chamomile': ('gh-BuddiesOfBudgie__fragrant-chamomile', 0.25, (0.4, 0.5)),
    'architecture': ('gh-elementary__brown_architecture', 0.5, (2, 0.5)),
    'canyon': ('gh-BuddiesOfBudgie__tunnel-zion-park', 0.5, (6, 2)),
    'lighthouse': ('gh-elementary__william_bout_lighthouse', 0.35, (1, 0), 0.25),
    'portrait': ('gh-elementary__sam_henderson', 0.3, (0.5, 0), 1, 0.8),
    'still': ('gh-elementary__tomasz_smal', 0.25, (0, 0)),
}


FILMED = {'flower': 'gh-mdn__flower', 'bird': 'gh-intel__asl_bird'}


def judged():
    """Names of the footage and cases that judge predictions; no prediction is fitted to them."""
    return {'traffic', 'street', 'city', *FILMED.values()} | {f'{photo}.jpg' for photo, *_ in PANNED.values()}


def filmed(a):
    """Name -> frames [count,H,W], uint8, of clips. No network was trained on them."""
    for path in (a.traffic, a.street):
        if not os.path.isfile(path):
            raise SystemExit(f'there is no scene {path}: --scenes (make: SCENES=folder) names the folder of the scenes')
    with np.load(a.street) as archive:
        street = next(archive[k] for k in archive.files if archive[k].ndim == 3)
    return {
        'traffic': scipy.io.loadmat(a.traffic)['orig'].transpose(2, 0, 1).round().astype(np.uint8),
        'street': street if street.dtype == np.uint8 else (street * 255).round().astype(np.uint8),
        'city': pictures(os.path.join(HERE, '../../demo/clip')),
    } | {name: pictures(os.path.join(a.data, 'clips/val', folder)) for name, folder in FILMED.items()}


def made(a, size):
    """Photographs below a moving camera, and drawn clips, as [count,size,size] by name."""
    return {'shapes': drawn(shapes, size=size), 'gratings': drawn(gratings, size=size)} | {
        name: panned(os.path.join(a.data, f'photos/val/{photo}.jpg'), *how, size=size) for name, (photo, *how) in PANNED.items()}


def middle(frames, count, size):
    top, left = ((extent - size) // 2 for extent in frames.shape[1:])
    return np.ascontiguousarray(frames[:count, top:top + size, left:left + size])


# ---------------------------------------------------------------- the program
class Program:
    def __init__(self, binary):
        self.binary = binary

    def run(self, *arguments):
        done = subprocess.run([self.binary, *map(str, arguments)], capture_output=True, text=True)
        if done.returncode not in (0, ERRORS_FOUND):
            raise SystemExit(f"sci-recon {' '.join(map(str, arguments))}\n{done.stderr.strip()}")
        return done.stdout

    def simulate(self, frames, setting, folder):
        """Files of one simulated snapshot of these frames, as arguments of `reconstruct`."""
        clip = os.path.join(folder, 'clip.npy')
        np.save(clip, frames)
        self.run('simulate', '--frames', clip, '--compression-ratio', setting.cr, '--pattern', setting.masks, '--blur', setting.blur, '--leak', setting.leak, '--seed', SEED,
                 '--noise-sigma', setting.sigma, '--out', folder)
        return [f'--{name}={folder}/{name}.npy' for name in ('masks', 'measurement', 'truth')]

    def schedule(self, algorithm):
        """The schedule of an algorithm."""
        return json.loads(self.run('schedule', '--algorithm', algorithm))

    def models(self, arguments, frames):
        """The models that `reconstruct` uses with these arguments, from the manifest of a small snapshot."""
        with tempfile.TemporaryDirectory() as folder:
            inputs = self.simulate(middle(frames, 8, 64), Setting('any', 'iid', 8), folder)
            self.run('reconstruct', *inputs, *arguments, '--threads', 1, '--out', f'{folder}/result')
            with open(f'{folder}/result/manifest.json') as f:
                return json.load(f)['content']['models']


@dataclasses.dataclass
class Way:
    """One way to reconstruct: the program's arguments, and what the result depends on."""
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
    """Name -> Way. Networks are compared in the deep stage of the default schedule, without the later stages, in
    floating point; INT8 is the 8-bit network in the same stage. FIXED is the default schedule without early stopping."""
    own = ['--models', a.models] if a.models else []
    white = exported(a.white, a.out)
    default = program.schedule(DEFAULT)
    deep = [i for i, stage in enumerate(default['stages']) if 'fastdvdnet' in stage['prior']]
    if not deep:
        raise SystemExit(f'the schedule of {DEFAULT} has no stage of the network')
    first, last = default['stages'][deep[0]], {**default['stages'][deep[-1]], 'prior': 'fastdvdnet'}
    count = sum(default['stages'][i]['iterations'] for i in deep)

    def cut(*stages):
        return {**default, 'adaptive': False, 'stages': default['stages'][:deep[0]] + list(stages)}

    def whole(iterations):
        return cut({**last, 'iterations': iterations, 'sigma': [first['sigma'][0], last['sigma'][1]]})

    int8 = cut(*(default['stages'][i] for i in deep))
    # The test for convergence ends the run.
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
                 way(DEFAULT, DEFAULT, own), way(FIXED, DEFAULT, own, {**default, 'adaptive': False})])


# ---------------------------------------------------------------- rows
def source_hash():
    """Hash of the code and the quality models that a row depends on."""
    files = sorted(f for part in ('crates/reconstruction/src/**/*.rs', 'models/quality/*.onnx', 'crates/optics/src/**/*.rs')
                   for f in glob.glob(os.path.join(HERE, '../..', part), recursive=True))
    digest = hashlib.sha256()
    for f in files:
        with open(f, 'rb') as content:
            digest.update(content.read())
    return digest.hexdigest()


class Rows:
    def __init__(self, program, a, footage):
        """`footage` maps sizes to clips by name."""
        self.program, self.a, self.footage, self.source = program, a, footage, source_hash()
        self.folder = os.path.join(a.out, 'rows')
        os.makedirs(self.folder, exist_ok=True)

    def frames(self, setting):
        size = min(setting.size, max(self.footage))     # larger ones are of clips alone
        return middle(self.footage[size][setting.scene], setting.cr, setting.size)

    def key(self, setting, way):
        parts = [dataclasses.asdict(setting), SEED, hashlib.sha256(self.frames(setting)).hexdigest(), way.algorithm, way.schedule, way.models, self.source]
        del parts[0]['twice'], parts[0]['half']
        return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()

    def row(self, setting, name, way):
        """The row; none if it is not stored and only stored rows are wanted."""
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
                inputs = self.program.simulate(self.frames(setting), setting, folder)
            report = json.loads(self.program.run('reconstruct', *inputs, *way.arguments, '--threads', 1, '--json'))
        assessment = report['assessment'] or {}
        row = {'scene': str(setting), 'masks': setting.kind(), 'cr': setting.cr, 'sigma': setting.sigma, 'half': setting.half, 'algorithm': name,
               'psnr_db': round(report['psnr_unit_db'], 2), 'psnr_white_db': round(report['psnr_db'], 2), 'ssim': round(report['ssim'], 4), 'passes': report['denoiser_passes'],
               'cpu_seconds': round(report['cpu_seconds'], 1), 'predicted': [assessment.get(end) for end in ('psnr_low_db', 'psnr_db', 'psnr_high_db')], 'models': {m['name']: m['sha256'] for m in way.models}}
        with open(path + '.part', 'w') as f:
            json.dump(row, f)
        os.replace(path + '.part', path)
        return row

    def all(self, tasks, report):
        """Rows, setting by setting; `report` is called with each."""
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
            lost = sum(value < -LOST for value in values) / len(values)
            yield {'what': what, 'mean_db': round(sum(values) / len(values), 2), 'worst_db': round(min(values), 2),
                   'lost_percent': round(100 * lost), 'snapshots': len(values), 'aim': aim}

    squares = lambda cr: lambda s: s[1:3] == ('random-squares', cr)
    halves = {(r['scene'], r['masks'], r['cr'], r['sigma']): r['half'] for r in rows}
    half = lambda which: lambda s: halves[s] == which
    return [
        *line(gains(LOOP, WHITE), 'mean 1.0, worst -0.1', 'network trained in the loop over the same trained on white noise'),
        *line(gains(TWICE, LOOP), 'worst -0.1', 'passes doubled over the schedule\'s own number'),
        *line(gains(INT8, LOOP), 'worst -0.05', '8 bits over floating point'),
        *line(gains(DEFAULT, TV, squares(10)), 'mean 3.0', f'{DEFAULT} over gap-tv, random squares, Cr 10'),
        *line(gains(DEFAULT, TV, squares(20)), 'mean 3.0', f'{DEFAULT} over gap-tv, random squares, Cr 20'),
        *line(gains(DEFAULT, TV, lambda s: ', ' in s[1]), 'worst 0', f'{DEFAULT} over gap-tv, masks blurred or with light through closed pixels'),
        *line(gains(DEFAULT, INT8), 'worst 0', f'{DEFAULT} over its stages up to the network (the nonlocal stage)'),
        *(entry for which in CASES for entry in line(gains(DEFAULT, TV, half(which)), 'worst 0', f'{DEFAULT} over gap-tv, cases {which}')),
        *(entry for which in CASES for entry in line(gains(DEFAULT, FIXED, half(which)), 'mean 0.1, worst -0.1',
                                                     f'{DEFAULT}: the pilot over the plan to its end, cases {which}')),
    ]


def accuracy(off, inside):
    """Statistics of prediction errors `off` in dB; `inside` says which true values are in their interval."""
    off = np.abs(off)
    return {'mean_db': round(off.mean(), 2), 'four_of_five_db': round(np.quantile(off, .8), 2), 'near_percent': round(100 * np.mean(off <= TOLERANCE)),
            'inside_percent': round(100 * np.mean(inside)), 'snapshots': len(off)}


def predictions(rows, algorithm):
    """Error of the PSNR that an algorithm predicts, by size and masks."""
    rows = [r for r in rows if r['algorithm'] == algorithm]
    size = lambda r: r['scene'].split()[1]
    soft = [r for r in rows if ', ' in r['masks']]
    rows = [r for r in rows if r not in soft]
    groups = {'all': rows}
    for kind in (size, lambda r: r['masks']):
        groups |= {str(value): [r for r in rows if kind(r) == value] for value in sorted({kind(r) for r in rows})}
    groups['masks blurred or with light through closed pixels'] = soft
    for what, of in groups.items():
        known = [r for r in of if None not in r['predicted']]
        if known:
            predicted, true = np.array([r['predicted'] for r in known]), np.minimum([r['psnr_white_db'] for r in known], BEST)
            yield {'what': f'{algorithm}: {what}', **accuracy(true - predicted[:, 1], (predicted[:, 0] <= true) & (true <= predicted[:, 2])), 'untold': len(of) - len(known)}


def table(rows, summed, predicted):
    yield '| scene | masks | Cr | noise | algorithm | PSNR dB | SSIM | passes | CPU s |'
    yield '| --- | --- | --- | --- | --- | --- | --- | --- | --- |'
    before = None
    for r in rows:
        setting = (r['scene'], r['masks'], r['cr'], r['sigma'])
        shown = setting if setting != before else [''] * 4
        before = setting
        yield f"| {' | '.join(map(str, shown))} | {r['algorithm']} | {r['psnr_db']:.2f} | {r['ssim']:.3f} | {r['passes']} | {r['cpu_seconds']:.0f} |"
    yield ''
    yield f'| gain, dB | mean | worst | worse than -{LOST} | snapshots | aim |'
    yield '| --- | --- | --- | --- | --- | --- |'
    for s in summed:
        yield f"| {s['what']} | {s['mean_db']:+.2f} | {s['worst_db']:+.2f} | {s['lost_percent']} % | {s['snapshots']} | {s['aim']} |"
    yield ''
    yield f'| PSNR as predicted | mean error, dB | 80 % within, dB | within {TOLERANCE} dB (aim: 80 %) | in the interval (of 80 %) | snapshots | without |'
    yield '| --- | --- | --- | --- | --- | --- | --- |'
    for s in predicted:
        yield (f"| {s['what']} | {s['mean_db']:.2f} | {s['four_of_five_db']:.2f} | {s['near_percent']} % | {s['inside_percent']} % | "
               f"{s['snapshots']} | {s['untold']} |")


def main():
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument('--binary', required=True, help='the released sci-recon')
    p.add_argument('--data', required=True, help='footage; clips of its validation split are used')
    p.add_argument('--scenes', required=True, help='folder with traffic48_cacti.mat and street_1024x1024x20.npz')
    p.add_argument('--white', required=True, help='checkpoint of the network trained on white noise alone')
    p.add_argument('--models', help='folder of models to judge in place of those in the program')
    p.add_argument('--out', default='eval-output', help='folder for the rows')
    p.add_argument('--jobs', type=int, default=2, help='concurrent runs, one thread each')
    p.add_argument('--full', action='store_true', help='every combination, 512x512 too: days on two cores')
    p.add_argument('--predictions', nargs='*', choices=PREDICTED, help=f'only the cases that judge predictions, by these algorithms [default: {" and ".join(PREDICTED)}]')
    p.add_argument('--fresh', action='store_true', help='compute every row again')
    p.add_argument('--cached', action='store_true', help='compute nothing: report the stored rows')
    p.add_argument('--json', action='store_true', help='one JSON object per row, and one with all rows at the end')
    a = p.parse_args()
    a.traffic, a.street = (os.path.join(a.scenes, name) for name in ('traffic48_cacti.mat', 'street_1024x1024x20.npz'))
    if not os.path.isfile(a.white):
        raise SystemExit(f'there is no checkpoint {a.white}: --white (make: WHITE=file) names weights trained on white noise, train.py --stage full')
    films, program = filmed(a), Program(a.binary)
    footage = {size: films | made(a, size) for size in (CASE_SIZE, Setting.size)}
    lengths = {name: len(frames) for name, frames in footage[CASE_SIZE].items()}
    settings = all_settings(lengths) if a.full else DEFAULT_SETTINGS
    with tempfile.TemporaryDirectory() as folder:
        known = ways(program, a, footage[CASE_SIZE]['city'], folder)
        tasks = [(s, name) for s in settings for name in NETWORKS if name != TWICE or s.twice]
        tasks += [(s, name) for s in cases() for name in PLANS] + [(s, name) for s in following(lengths) for name in PREDICTED]
        tasks += [(s, name) for s in softened() for name in PREDICTED]
        wanted = ALGORITHMS if a.predictions is None else a.predictions or PREDICTED
        tasks = [(s, name, known[name]) for s, name in dict.fromkeys(tasks) if name in wanted]
        report = lambda row: print(json.dumps(row), file=sys.stdout if a.json else sys.stderr, flush=True)
        rows = Rows(program, a, footage).all(tasks, report)
    summed, predicted = summary(rows), [line for algorithm in PREDICTED for line in predictions(rows, algorithm)]
    print(json.dumps({'rows': rows, 'summary': summed, 'predictions': predicted}) if a.json else '\n'.join(table(rows, summed, predicted)))


if __name__ == '__main__':
    main()
