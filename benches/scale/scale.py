"""One job of any size through the real service: time by stage, memory and disk.

    python scale.py SCI_RECON_BINARY IMAGE [--size 3200] [--frames 10] [--snapshots 1] [--algorithm gap-tv] [--device cuda:0] ...

IMAGE, panned by a few pixels per frame, is the scene; masks and snapshots are simulated (random squares). All requests
use HTTP: upload, calibration, measurement, job, download. Prints its progress. The last line is JSON: seconds by stage,
peak resident memory of the server and of each worker (VmHWM), the first estimate of the remaining time and the true one,
disk and quality.
"""
import argparse
import json
import pathlib
import shutil
import subprocess
import sys
import tempfile
import time
import urllib.request

import numpy as np
from service import Service
from skimage import io, transform


def pan(image, frames, size, step=(3, 5)):
    """Frames [B,size,size], uint8: a window that moves over the grey image, which is enlarged if necessary."""
    need = [size + frames * s for s in step]
    gray = image[..., :3].mean(-1) if image.ndim == 3 else image.astype(float)
    factor = max(1, *(n / extent for n, extent in zip(need, gray.shape)))
    if factor > 1:
        gray = transform.rescale(gray, factor * 1.001, preserve_range=True)
    gray = gray.clip(0, 255).astype(np.uint8)
    return np.stack([gray[k * step[0]:k * step[0] + size, k * step[1]:k * step[1] + size] for k in range(frames)])


def psnr_by_frame(path, truth):
    """Mean PSNR (dB) over the frames of a .npy file."""
    frames = np.load(path, mmap_mode='r')
    errors = [np.mean((frame - true / np.float32(255)) ** 2, dtype=np.float64) for frame, true in zip(frames, truth)]
    return float(np.mean(-10 * np.log10(errors)))


def main():
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument('binary')
    p.add_argument('image')
    p.add_argument('--size', type=int, default=3200)
    p.add_argument('--frames', type=int, default=10)
    p.add_argument('--snapshots', type=int, default=1, help='consecutive snapshots, reconstructed jointly')
    p.add_argument('--algorithm', default='gap-tv')
    p.add_argument('--schedule', help='a schedule as JSON [default: the algorithm\'s own]')
    p.add_argument('--workers', type=int, default=2)
    p.add_argument('--tile', type=int, help='tile size [default: the service\'s]')
    p.add_argument('--overlap', type=int, default=32)
    p.add_argument('--device', help='for example cuda:0 [default: the CPU]')
    p.add_argument('--folder', help='folder for the files, which are kept [default: a temporary folder]')
    a = p.parse_args()
    folder = pathlib.Path(a.folder or tempfile.mkdtemp(prefix='sci-recon-scale-'))
    folder.mkdir(parents=True, exist_ok=True)
    seconds, began = {}, time.monotonic()

    def lap(name):
        nonlocal began
        seconds[name], began = round(time.monotonic() - began, 1), time.monotonic()
        print(f'{name}: {seconds[name]} s', flush=True)

    truth = pan(io.imread(a.image), a.frames * a.snapshots, a.size)
    np.save(folder / 'frames.npy', truth)
    subprocess.run([a.binary, 'simulate', '--frames', folder / 'frames.npy', '--compression-ratio', str(a.frames), '--pattern', 'random-squares',
                    '--snapshots', str(a.snapshots), '--seed', '1', '--out', folder / 'snapshot'], check=True, stdout=subprocess.DEVNULL)
    (folder / 'frames.npy').unlink()
    lap('simulate')
    service = Service(a.binary, folder / 'service', ['--workers', str(a.workers), *(['--device', a.device] if a.device else [])])
    try:
        masks = service.upload(folder / 'snapshot' / 'masks.npy')
        measured = service.upload(folder / 'snapshot' / 'measurement.npy')
        lap('upload')
        calibration = service.call('POST', '/v1/calibrations', {'masks': masks})['id']
        while service.call('GET', f'/v1/calibrations/{calibration}').get('state', 'ready') == 'preparing':
            time.sleep(.2)
        measurement = service.call('POST', '/v1/measurements', {'calibration': calibration, 'data': measured})['id']
        lap('calibration and check')
        wanted = {'measurement': measurement, 'algorithm': a.algorithm, 'snapshots': 'all'}
        if a.schedule:
            wanted['schedule'] = json.loads(pathlib.Path(a.schedule).read_text())
        if a.tile:
            wanted['tile'] = {'size': a.tile, 'overlap': a.overlap}
        job = service.call('POST', '/v1/jobs', wanted)['id']
        started, promise, preview, report = time.monotonic(), None, None, 0
        while (state := service.call('GET', f'/v1/jobs/{job}'))['state'] in ('queued', 'running'):
            service.look()
            elapsed, eta = time.monotonic() - started, state['progress']['eta_seconds']
            if preview is None and state['progress']['previews_done']:
                preview = round(elapsed, 1)
            if promise is None and eta is not None and elapsed > min(60, 5 + .05 * eta):
                promise = (elapsed, eta)
            if elapsed > report:
                print(f"  {elapsed:.0f} s: {state['progress']['percent']} %, {eta} s to go", flush=True)
                report = elapsed + 30
            time.sleep(.25)
        lap('job')
        if state['state'] != 'succeeded':
            sys.exit(f"the job {state['state']}: {state['error']}")
        total = time.monotonic() - started
        manifest = service.call('GET', f'/v1/jobs/{job}/exports/manifest')
        result, quality = folder / 'result.npy', []
        for snapshot, true in enumerate(truth.reshape(a.snapshots, a.frames, a.size, a.size)):
            urllib.request.urlretrieve(f'{service.url}/v1/jobs/{job}/snapshots/{snapshot}/exports/npy', result)
            quality.append(psnr_by_frame(result, true))
        lap('download')
        service.look()
        disk = sum(path.stat().st_size for path in (folder / 'service').rglob('*') if path.is_file())
        memory = service.memory
        print(json.dumps({
            'target': 'bench-scale', 'size': a.size, 'frames': a.frames, 'snapshots': a.snapshots, 'algorithm': a.algorithm, 'workers': a.workers, 'device': a.device,
            'seconds': seconds, 'run': manifest['run'], 'memory_bytes': memory, 'memory_sum_bytes': sum(memory.values()),
            'preview_seconds': preview, 'promised_seconds': promise and round(sum(promise), 1), 'true_seconds': round(total, 1), 'disk_bytes': disk,
            'psnr_db': round(float(np.mean(quality)), 3)}))
    finally:
        service.process.terminate()
        service.process.wait()
        if not a.folder:
            shutil.rmtree(folder)


if __name__ == '__main__':
    main()
