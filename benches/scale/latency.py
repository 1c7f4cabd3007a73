"""Duration of a small job through the real service, from its POST to the last byte of its result.

    python latency.py SCI_RECON_BINARY [--size 64] [--frames 8] [--algorithm gap-tv] [--jobs 50]

A lab waits for each such job while it adjusts the optics. Each job has another snapshot, because a repeated
job would return the existing result. One connection is used: POST of the job, GET of its end (`Prefer: wait`), GET
of the frames as one EXR file. The last line is JSON: milliseconds of each part, median and slowest tenth.
"""
import argparse
import http.client
import json
import pathlib
import shutil
import subprocess
import tempfile
import time
import urllib.parse

import numpy as np

from service import Service


def scene(rng, frames, size):
    """Frames [B,size,size], uint8: a smooth random image that moves by two pixels per frame."""
    waves = rng.uniform(.05, .4, (6, 2))
    y, x = np.mgrid[:size, :size]
    return np.stack([127 + 20 * sum(np.sin(u * y + v * (x + 2 * k)) for u, v in waves) for k in range(frames)]).clip(0, 255).astype(np.uint8)


def main():
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument('binary')
    p.add_argument('--size', type=int, default=64)
    p.add_argument('--frames', type=int, default=8)
    p.add_argument('--algorithm', default='gap-tv')
    p.add_argument('--jobs', type=int, default=50)
    p.add_argument('--workers', type=int, default=2)
    a = p.parse_args()
    folder = pathlib.Path(tempfile.mkdtemp(prefix='sci-recon-latency-'))
    rng = np.random.default_rng(0)
    np.save(folder / 'frames.npy', np.concatenate([scene(rng, a.frames, a.size) for _ in range(a.jobs)]))
    subprocess.run([a.binary, 'simulate', '--frames', folder / 'frames.npy', '--compression-ratio', str(a.frames), '--snapshots', str(a.jobs), '--seed', '1',
                    '--out', folder / 'snapshot'], check=True, stdout=subprocess.DEVNULL)
    snapshots = np.load(folder / 'snapshot' / 'measurement.npy').reshape(-1, a.size, a.size)
    service = Service(a.binary, folder / 'service', ['--workers', str(a.workers)])
    laps = {'post': [], 'end': [], 'frames': [], 'all': []}
    try:
        masks = service.upload(folder / 'snapshot' / 'masks.npy')
        calibration = service.call('POST', '/v1/calibrations', {'masks': masks})['id']
        measurements = []
        for snapshot in snapshots:
            np.save(folder / 'one.npy', snapshot)
            measurements.append(service.call('POST', '/v1/measurements', {'calibration': calibration, 'data': service.upload(folder / 'one.npy')})['id'])
        connection = http.client.HTTPConnection(urllib.parse.urlsplit(service.url).netloc)

        def ask(method, path, body=None, wait=0):
            headers = {'Content-Type': 'application/json', 'Prefer': f'wait={wait}'}
            connection.request(method, path, body and json.dumps(body), headers)
            answer = connection.getresponse()
            content = answer.read()
            if answer.status >= 300:
                raise SystemExit(f'{method} {path}: {answer.status} {content[:500]!r}')
            return content

        for measurement in measurements:
            times = [time.perf_counter()]
            job = json.loads(ask('POST', '/v1/jobs', {'measurement': measurement, 'algorithm': a.algorithm}))['id']
            times.append(time.perf_counter())
            state = json.loads(ask('GET', f'/v1/jobs/{job}', wait=20))
            times.append(time.perf_counter())
            if state['state'] != 'succeeded':
                raise SystemExit(f"the job {state['state']}: {state['error']}")
            ask('GET', f'/v1/jobs/{job}/snapshots/0/exports/exr')
            times.append(time.perf_counter())
            for name, lap in zip(laps, [*np.diff(times), times[-1] - times[0]]):
                laps[name].append(lap * 1e3)
    finally:
        service.process.terminate()
        service.process.wait()
        shutil.rmtree(folder)
    print(json.dumps({'target': 'bench-latency', 'size': a.size, 'frames': a.frames, 'algorithm': a.algorithm, 'jobs': a.jobs, 'workers': a.workers,
                      'milliseconds': {name: {'median': round(float(np.median(lap)), 1), '90 %': round(float(np.quantile(lap, .9)), 1)}
                                       for name, lap in laps.items()}}))


main()
