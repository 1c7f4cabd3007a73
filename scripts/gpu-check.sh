#!/usr/bin/env bash
# Check a GPU against the CPU and measure its speed. Needs bash and Python 3 without packages, and no network.
#
#   scripts/gpu-check.sh [--device gpu] [--sizes 256,512,1024] [--large 3200] [--program FILE] [--library FILE] [--seconds 480]
#   scripts/gpu-check.sh --short      # every step with one scene of 16x16 pixels and few iterations, for software Vulkan
#
# Three small scenes are reconstructed on both devices: by total variation alone, with the nonlocal prior, and with the same
# network. Then the kernels of the solver, its loop, both priors, networks and default jobs are timed at each size. A last job
# of 3200x3200 runs if 150 s are left. The program must be built with --features gpu. Progress goes to standard error, one JSON object to standard output. Exit status: 0 if the results agree.
# In a folder that scripts/gpu-pack.sh packed, it uses the program, library and Vulkan loader of that folder.
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
export LD_LIBRARY_PATH="$here/vulkan${LD_LIBRARY_PATH:+:$LD_LIBRARY_PATH}"
if [ -e "$here/libonnxruntime.so.xz" ] && [ ! -e "$here/libonnxruntime.so" ]; then
  python3 -c 'import lzma, shutil, sys; shutil.copyfileobj(lzma.open(sys.argv[1]), open(sys.argv[2], "wb"))' \
    "$here/libonnxruntime.so.xz" "$here/libonnxruntime.so"
fi
exec python3 - "$here" "$@" <<'PY'
import argparse, array, json, math, os, random, struct, subprocess, sys, tempfile, time

here = sys.argv[1]
parser = argparse.ArgumentParser(prog='gpu-check.sh')
parser.add_argument('--device', default='gpu')
parser.add_argument('--sizes', help='sides in pixels [default: 256,512,1024]')
packed = os.path.exists(here + '/sci-recon')
parser.add_argument('--program', default=here + '/sci-recon' if packed else here + '/../target/release/sci-recon')
parser.add_argument('--library', default=here + ('/libonnxruntime.so' if packed else '/../runtime-gpu/libonnxruntime.so'))
parser.add_argument('--large', type=int, help='side of the last job; 0 for none [default: 3200]')
parser.add_argument('--seconds', type=float, default=480)
parser.add_argument('--short', action='store_true', help='try each step with one scene of 16x16 pixels and few iterations')
options = parser.parse_args(sys.argv[2:])
end = time.monotonic() + options.seconds
TOLERANCE = 1e-4
SCENES = ('disc',) if options.short else ('grating', 'disc', 'squares')
# Frames, side of the scenes, iterations and network passes of the comparison, and seconds that must be left for the last job.
FRAMES, SMALL, ITERATIONS, PASSES, LARGE_SECONDS = (3, 16, 4, 1, 0) if options.short else (8, 64, 40, 2, 150)
# Numbers of network passes and of iterations whose times differ by those of the iterations between.
PASS_COUNTS, ITERATION_COUNTS = ((1, 3), (10, 110)) if options.short else ((2, 10), (100, 1100))
sizes = [int(size) for size in (options.sizes or ('16' if options.short else '256,512,1024')).split(',')]
last_size = options.large if options.large is not None else 32 if options.short else 3200
if any(size % SMALL or not size for size in [*sizes, last_size or SMALL]):
    parser.error(f'--sizes and --large must be multiples of {SMALL}, the side of the scenes')
report = {'device': options.device, 'scenes': {}, 'kernels': None, 'speed': {}, 'skipped': []}


def program(*arguments):
    """Output of a command as JSON, or an exception with its message."""
    left = end - time.monotonic()
    if left < 5:
        raise TimeoutError
    try:
        done = subprocess.run([options.program, *map(str, arguments)], capture_output=True, text=True, timeout=left)
    except subprocess.TimeoutExpired:
        raise TimeoutError from None
    if not done.stdout.lstrip().startswith('{'):
        raise RuntimeError(f'{arguments[0]}: {done.stderr.strip()[-2000:]}')
    return json.loads(done.stdout)


def save(path, shape, values):
    header = f"{{'descr': '<f4', 'fortran_order': False, 'shape': {tuple(shape)}, }}"
    header += ' ' * (63 - (10 + len(header)) % 64) + '\n'
    with open(path, 'wb') as file:
        file.write(b'\x93NUMPY\x01\x00' + struct.pack('<H', len(header)) + header.encode())
        file.write(array.array('f', values).tobytes())


def load(path):
    with open(path, 'rb') as file:
        start = file.read(10)
        file.read(struct.unpack('<H', start[8:])[0])
        values = array.array('f')
        values.frombytes(file.read())
    return values


def scene(name, k, i, j):
    """Brightness of a pixel of frame k."""
    i, j = i * 64 // SMALL, j * 64 // SMALL
    if name == 'grating':
        return .5 + .4 * math.sin((i + 2 * j) / 5 + k / 2)
    if name == 'disc':
        return .9 if math.hypot(i - 20 - 3 * k, j - 24 - 2 * k) < 10 else .1
    return (.2 + .6 * ((i // 8 + j // 8) % 2)) * (1 - .05 * k)


def inputs(folder, name, size):
    """Masks and a measurement of a scene that repeats every SMALL pixels."""
    os.makedirs(folder, exist_ok=True)
    masks, sums = array.array('f'), array.array('f', bytes(4 * size * size))
    source = random.Random(1)
    for k in range(FRAMES):
        mask = array.array('f', map(float, bin(source.getrandbits(size * size) | 1 << size * size)[3:]))
        masks.extend(mask)
        rows = [array.array('f', [scene(name, k, i, j) for j in range(SMALL)]) * (size // SMALL) for i in range(SMALL)]
        for at, open_ in enumerate(mask):
            if open_:
                sums[at] += rows[at // size % SMALL][at % size]
    save(folder + '/masks.npy', (FRAMES, size, size), masks)
    save(folder + '/measurement.npy', (1, size, size), sums)


def reconstruct(folder, device, schedule=None):
    """Report and frames of a reconstruction."""
    line = ['reconstruct', '--masks', folder + '/masks.npy', '--measurement', folder + '/measurement.npy', '--json',
            '--onnxruntime', options.library, '--device', device, '--out', folder + '/' + device]
    if schedule:
        with open(folder + '/schedule.json', 'w') as file:
            json.dump({'adaptive': False, 'stages': schedule}, file)
        line += ['--schedule', folder + '/schedule.json']
    return program(*line), folder + '/' + device + '/frames.npy'


def variation(iterations):
    return {'prior': 'tv', 'iterations': iterations, 'tv_weight': .15, 'temporal_weight': .004, 'tolerance': 0}


def nonlocal_passes(passes):
    return [variation(4), {'prior': 'nonlocal', 'iterations': passes, 'sigma': [.1, .05], 'tolerance': 0}]


def stages(passes):
    return [variation(4), {'prior': 'fastdvdnet', 'iterations': passes, 'sigma': [.1, .05], 'tolerance': 0}]


def step(name, action):
    print(f'gpu-check: {name}, {end - time.monotonic():.0f} s left', file=sys.stderr)
    try:
        return action()
    except TimeoutError:
        report['skipped'].append(name)


def compare(folder, name):
    inputs(folder, name, SMALL)
    largest = 0
    for schedule in [variation(ITERATIONS)], nonlocal_passes(PASSES), stages(PASSES):
        frames = [load(reconstruct(folder, device, schedule)[1]) for device in ('cpu', options.device)]
        assert len(frames[0]) == len(frames[1])
        largest = max(largest, *(abs(a - b) for a, b in zip(*frames)))
    report['scenes'][name] = {'max_difference': largest, 'agrees': largest <= TOLERANCE}


def measure(folder, size):
    inputs(folder, 'grating', size)
    voxels = FRAMES * size * size / 1e6
    def speed(schedule, few, many):
        """Megavoxels per second of one iteration."""
        seconds = [reconstruct(folder, options.device, schedule(count))[0]['seconds'] for count in (few, many)]
        difference = seconds[1] - seconds[0]
        return round((many - few) * voxels / difference, 4) if difference > 0 else None
    report['speed'][size] = {'network_mvoxel_per_s': speed(stages, *PASS_COUNTS),
                             'nonlocal_mvoxel_per_s': speed(nonlocal_passes, *PASS_COUNTS),
                             'variation_mvoxel_per_s': speed(lambda count: [variation(count)], *ITERATION_COUNTS)}
    report['speed'][size] |= job(folder, size)


def job(folder, size):
    """Speed of a default job."""
    voxels = FRAMES * size * size / 1e6
    whole = reconstruct(folder, options.device, stages(PASSES) if options.short else None)[0]
    return {'job_seconds': whole['seconds'], 'job_cpu_seconds': whole['cpu_seconds'],
            'job_mvoxel_per_s': round(voxels / whole['seconds'], 4)}


def large(folder, size):
    """A default job of the size of a large sensor, or a note that there is no time for it."""
    if end - time.monotonic() < LARGE_SECONDS:
        raise TimeoutError
    inputs(folder, 'grating', size)
    report['speed'][size] = job(folder, size)


with tempfile.TemporaryDirectory() as folder:
    try:
        report['devices'] = step('devices', lambda: program('devices', '--json', '--onnxruntime', options.library))
        for name in SCENES:
            step(f'scene {name}', lambda: compare(f'{folder}/{name}', name))
        kernels = step('kernels', lambda: program('devices', '--json', '--onnxruntime', options.library,
                                                  '--kernels', ','.join(map(str, sizes))))
        report['kernels'] = kernels and kernels['kernels']
        for size in sizes:
            step(f'size {size}', lambda: measure(f'{folder}/{size}', size))
        if last_size:
            step(f'size {last_size}', lambda: large(f'{folder}/{last_size}', last_size))
    except RuntimeError as error:
        report['error'] = str(error)
report['agrees'] = len(report['scenes']) == len(SCENES) and all(scene['agrees'] for scene in report['scenes'].values())
print(json.dumps(report))
sys.exit(0 if report['agrees'] and 'error' not in report else 1)
PY
