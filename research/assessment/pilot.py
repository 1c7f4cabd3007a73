"""Measure the gain of each heuristic of an adaptive schedule on simulated snapshots.

    python pilot.py run SCI_RECON_BINARY --data DATA --out FOLDER [--algorithm NAME...] [--without NAME+NAME...]
    python pilot.py report --out FOLDER

`run` simulates the snapshots of `training/assessment.py make` at 128x128 pixels and reconstructs each with the full
schedule, and with one heuristic switched off at a time. `--without` adds combinations. The results are appended to
FOLDER/results.jsonl, so an interrupted run continues where it stopped. `report` prints a Markdown table.
"""
import argparse
import json
import os
import pathlib
import subprocess
import sys
import tempfile

import numpy as np

HERE = pathlib.Path(__file__).resolve().parent
# Heuristics of the pilot, as in the field `disabled` of a schedule.
PILOT = ('early_stopping', 'temporal_variation', 'temporal_shrinkage', 'static_scene', 'static_regions', 'static_variance',
         'noise_term')
# Heuristics of the nonlocal prior: the field, and its value without the heuristic.
NONLOCAL = {'motion_compensation': False, 'outlier_limit': None}
LARGE_LOSS = 1.0    # dB
TAIL = .1           # share of the cases in the worst tenth


def without(schedule, names):
    """The schedule with these heuristics switched off."""
    schedule = json.loads(json.dumps(schedule))
    schedule['disabled'] = [name for name in names if name in PILOT]
    for stage in schedule['stages']:
        if stage['prior'] == 'nonlocal':
            stage.update({name: NONLOCAL[name] for name in names if name in NONLOCAL})
    return schedule


def applies(schedule, name):
    """True if a heuristic can change the results of a schedule."""
    priors = {stage['prior'] for stage in schedule['stages']}
    if name == 'temporal_variation':
        return any(stage.get('temporal_weight') for stage in schedule['stages'])
    if name == 'early_stopping':
        return bool(priors - {'tv'})
    return 'nonlocal' in priors


def unchanged(name, decisions):
    """True if the pilot, which accepted none of a heuristic's candidates, decides the same without it."""
    changed = lambda field: any(decided['stage'].get(field) != decided['planned'].get(field) for decided in decisions)
    static = any(decided['stage'].get('static_shrinkage') is not None for decided in decisions)
    return {
        'early_stopping': not changed('iterations'),
        'temporal_variation': not changed('temporal_weight'),
        'temporal_shrinkage': not changed('temporal_shrinkage') and not static,
        'static_scene': not static,
        'static_regions': not static,
        'static_variance': not changed('static_variance'),
        'noise_term': not changed('gamma'),
    }.get(name, False)


class Bench:
    def __init__(self, a):
        self.binary, self.path = a.binary, pathlib.Path(a.out[0]) / 'results.jsonl'
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self.results = {(row['case'], row['algorithm'], row['without']): row for row in read(a.out)}

    def reconstruct(self, folder, scene, schedule):
        """PSNR in dB, and the decisions of the pilot."""
        (folder / 'schedule.json').write_text(json.dumps(schedule))
        command = [self.binary, 'reconstruct', '--masks', scene / 'masks.npy', '--measurement', scene / 'measurement.npy',
                   '--truth', scene / 'truth.npy', '--algorithm', 'pnp-tv-fastdvdnet', '--schedule', folder / 'schedule.json',
                   '--threads', '1', '--json', '--out', folder / 'out']
        done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        report = json.loads(done.stdout) if done.stdout else sys.exit(f'a reconstruction failed: {done.stderr}')
        return report['psnr_db'], (report['pilot'] or {}).get('stages', [])

    def add(self, row):
        self.results[row['case'], row['algorithm'], row['without']] = row
        with open(self.path, 'a') as f:
            f.write(json.dumps(row) + '\n')

    def case(self, about, scene, algorithms, combinations):
        for algorithm, schedule in algorithms.items():
            names = [name for name in (*PILOT, *NONLOCAL) if applies(schedule, name)]
            for variant in ('', *names, *combinations):
                key = about['case'], algorithm, variant
                if key in self.results:
                    continue
                base = self.results.get((*key[:2], ''))
                if variant and all(unchanged(name, base['decisions']) for name in variant.split('+')):
                    row = {'psnr_db': base['psnr_db'], 'decisions': None}
                else:
                    with tempfile.TemporaryDirectory() as folder:
                        psnr, decisions = self.reconstruct(pathlib.Path(folder), scene, without(schedule, variant.split('+')))
                    row = {'psnr_db': psnr, 'decisions': decisions}
                self.add(about | {'algorithm': algorithm, 'without': variant} | row)


def read(folders):
    files = [pathlib.Path(folder) / 'results.jsonl' for folder in folders]
    return [json.loads(line) for file in files if file.exists() for line in file.read_text().splitlines()]


def run(a):
    sys.path.insert(0, str(HERE.parent / 'training'))
    import assessment
    bench = Bench(a)
    printed = lambda name: subprocess.run([a.binary, 'schedule', '--algorithm', name], check=True, stdout=subprocess.PIPE).stdout
    algorithms = {name: json.loads(printed(name)) for name in a.algorithm}
    wanted = argparse.Namespace(data=a.data, more=None, side=a.side, algorithm='pnp-tv-fastdvdnet')
    part, parts = (int(number) for number in a.part.split('/'))
    for number, (name, scene, frames, pattern, (blur, leak), sigma, seeds) in enumerate(assessment.cases(wanted)):
        if number >= a.cases:
            break
        if number % parts != part:
            continue
        with tempfile.TemporaryDirectory() as folder:
            np.save(f'{folder}/clip.npy', frames)
            subprocess.run([a.binary, 'simulate', '--frames', f'{folder}/clip.npy', '--pattern', pattern, '--blur', str(blur),
                            '--leak', str(leak), '--compression-ratio', str(len(frames)), '--noise-sigma', str(sigma),
                            '--seed', str(seeds['pnp-tv-fastdvdnet']), '--out', f'{folder}/scene'],
                           check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
            about = {'case': name, 'scene': scene, 'cr': len(frames), 'pattern': pattern, 'blur': blur, 'leak': leak, 'noise_sigma': sigma}
            bench.case(about, pathlib.Path(folder) / 'scene', algorithms, a.without)


def report(a):
    rows = read(a.out)
    for algorithm in sorted({row['algorithm'] for row in rows}):
        own = {(row['case'], row['without']): row['psnr_db'] for row in rows if row['algorithm'] == algorithm}
        base = {case: psnr for (case, variant), psnr in own.items() if not variant}
        print(f'\n{algorithm}: {len(base)} cases, PSNR in dB\n')
        print('| without | cases | changed | mean loss | mean | worst tenth | worst case | cases that lose above 1 dB |')
        print('| --- | --- | --- | --- | --- | --- | --- | --- |')
        for variant in ['', *sorted({variant for _, variant in own if variant})]:
            pairs = np.array([(base[case], psnr) for (case, name), psnr in own.items() if name == variant and case in base])
            losses, psnrs = pairs[:, 0] - pairs[:, 1], np.sort(pairs[:, 1])
            tail = psnrs[:max(1, round(TAIL * len(psnrs)))].mean()
            print(f'| {variant.replace("+", ", ") or "nothing"} | {len(pairs)} | {(losses != 0).mean():.0%} | {losses.mean():+.3f} | {psnrs.mean():.2f} '
                  f'| {tail:.2f} | {-losses.max():+.2f} | {(losses > LARGE_LOSS).sum()} |')


def main():
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = p.add_subparsers(dest='what', required=True)
    runs = commands.add_parser('run')
    runs.add_argument('binary', metavar='SCI_RECON_BINARY', type=os.path.abspath)
    runs.add_argument('--data', required=True)
    runs.add_argument('--algorithm', nargs='+', default=['pnp-tv-fastdvdnet', 'gap-tv3d'])
    runs.add_argument('--without', nargs='*', default=[], help='combinations of heuristics, such as noise_term+static_scene')
    runs.add_argument('--cases', type=int, default=200)
    runs.add_argument('--side', type=int, default=128, help='side of the images in pixels')
    runs.add_argument('--part', default='0/1', help='K/N: every Nth case from the Kth on, to divide the work')
    for command in (runs, commands.add_parser('report')):
        command.add_argument('--out', nargs='+', required=True, help='the folder of the results; `report` takes several')
    a = p.parse_args()
    {'run': run, 'report': report}[a.what](a)


if __name__ == '__main__':
    main()
