"""The whole pipeline with tiny settings and generated footage: pack, train every stage, resume, export, read back,
evaluate.

    python test_pipeline.py      (or through pytest; a minute or two on one core)
"""
import json
import os
import signal
import subprocess
import sys
import tempfile

import cv2
import numpy as np
import torch

import assessment
import export
import model
import solver

HERE = os.path.dirname(os.path.abspath(__file__))


def run(script, *arguments):
    done = subprocess.run([sys.executable, os.path.join(HERE, script), *map(str, arguments)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def texture(r, height, width):
    """Noise of several scales, with edges and fine detail."""
    return sum(cv2.resize(r.random((height // s + 1, width // s + 1)), (width, height)) for s in (2, 8, 32)) * 85


def make_footage(folder):
    """Two photographs and a drifting video per split, packed by pack.py."""
    r, raw = np.random.default_rng(0), os.path.join(folder, 'raw')
    os.makedirs(raw)
    for split in ('train', 'val'):
        for i in range(2):
            cv2.imwrite(f'{raw}/{split}{i}.png', texture(r, 220, 220).astype(np.uint8))
        scene = texture(r, 140, 180).astype(np.uint8)
        video = cv2.VideoWriter(f'{raw}/{split}.avi', cv2.VideoWriter_fourcc(*'MJPG'), 25, (140, 120))
        for t in range(30):
            video.write(cv2.cvtColor(scene[:120, t:t + 140], cv2.COLOR_GRAY2BGR))
        video.release()
        data = os.path.join(folder, 'data')
        run('pack.py', '--out', data, '--source', 'synthetic', '--licence', 'none', '--split', split,
            f'{raw}/{split}0.png', f'{raw}/{split}1.png', f'{raw}/{split}.avi')
    return data


def test_shared_first_stage():
    net = model.FastDVDnet().eval()
    for p in net.parameters():
        torch.nn.init.normal_(p, 0, .02)
    x, sigma = torch.rand(2, 7, 16, 16), torch.tensor([.1, .3]).view(2, 1, 1, 1)
    with torch.no_grad():
        whole = net.clips(x, sigma)
        for k in range(2, 5):
            assert (whole[:, k:k + 1] - net(x[:, k - 2:k + 3], sigma)).abs().max() < 1e-6


def test_projection_explains_the_measurement():
    r = np.random.default_rng(1)
    for kind in ('iid', 'squares', 'circle', 'grey'):
        masks = torch.from_numpy(solver.draw_masks(r, kind, 8, 24)[None])
        assert 0 <= masks.min() and masks.max() == 1
        masks[..., 3, 5] = 0   # a dead pixel
        x = torch.rand(1, 8, 24, 24)
        y = solver.measure(x, masks)
        v = solver.Gap(y, masks).project(torch.zeros_like(x))
        assert torch.isfinite(v).all() and (solver.measure(v, masks) - y).abs().max() < 1e-4
        gap, v = solver.start(y, masks, 5)
        assert torch.isfinite(v).all()


def test_gradients_go_through_total_variation():
    x = torch.rand(1, 4, 16, 16)
    x[..., 4:9, 4:9] = .5   # a flat area
    x.requires_grad_()
    (solver.tv(x, .02) * torch.rand(1, 4, 16, 16)).sum().backward()
    assert torch.isfinite(x.grad).all() and x.grad.abs().max() > 0


def test_pipeline():
    with tempfile.TemporaryDirectory() as folder:
        data = make_footage(folder)
        out = lambda name: os.path.join(folder, name)
        common = ('--data', data, '--crop', 32, '--frames', 8, '--steps', 3, '--every', 0)
        run('train.py', *common, '--stage', 'block', '--out', out('block.pt'))
        run('train.py', *common, '--stage', 'full', '--init', out('block.pt'), '--out', out('full.pt'))
        run('train.py', *common, '--stage', 'loop', '--init', out('full.pt'), '--out', out('loop.pt'), '--runs', 2, '--every', 15, '--evaluation-size', 32)   # one run, with evaluations
        run('train.py', *common, '--stage', 'ffdnet', '--out', out('white.pt'))
        run('train.py', *common, '--stage', 'ffdnet-loop', '--init', out('white.pt'), '--out', out('ffdnet.pt'), '--runs', 2)
        run('train.py', *common, '--stage', 'loop', '--out', out('loop.pt'), '--runs', 2, '--unroll', 2)
        assert torch.load(out('loop.pt'), weights_only=True)['step'] == 6, 'the second run continues the first'
        for name in ('loop', 'ffdnet'):
            run('export.py', out(f'{name}.pt'), out(name))
            for k, v in model.load(out(f'{name}.pt')).state_dict().items():
                assert torch.equal(v, export.weights_of(out(name)).state_dict()[k]), k
        run('export.py', out('loop.pt'), out('full.pt'), out('mean'))
        parts = [model.load(out(f'{name}.pt')).state_dict() for name in ('loop', 'full')]
        for k, v in export.weights_of(out('mean')).state_dict().items():
            assert torch.allclose(v, (parts[0][k] + parts[1][k]) / 2), k
        run('quantize.py', '--data', data, '--snapshots', 1, '--size', 32, '--quick', 2, out('loop'), out('int8'))
        exact, quick = export.Exported(out('loop')), export.Exported(out('int8'))
        x, sigma = torch.rand(1, 6, 32, 32), torch.full((1, 1, 1, 1), .1)
        change = (quick.clips(x, sigma) - exact.clips(x, sigma)).abs().max()
        assert 0 < change < .05, change
        size = lambda name: os.path.getsize(os.path.join(out(name), 'stage1.onnx'))
        assert size('int8') < .3 * size('loop')
        run('encoder.py', out('loop'), out('encoder'))
        block, clip = model.load(out('loop.pt')).t1, torch.rand(5, 1, 32, 32)
        noise = torch.full((3, 1, 32, 32), .1)
        with torch.no_grad():
            seen = block.d1(block.d0(block.inc(torch.cat([clip[:3], noise, clip[1:4], noise, clip[2:], noise], 1))))
        expected = torch.log(torch.nn.functional.avg_pool2d(seen, 4) + .02).numpy()
        encoded, = export.session(os.path.join(out('encoder'), 'model.onnx')).run(None, {'frames': clip.numpy(), 'sigma': np.array(.1, np.float32)})
        assert encoded.shape == (3, 128, 2, 2) and np.abs(encoded - expected).max() < 1e-4
        rows = [json.loads(line) for line in run('evaluate.py', '--data', data, out('loop'), out('ffdnet'), '--passes', 2, '--size', 32).splitlines()]
        assert [os.path.basename(r['model']) for r in rows] == ['tv', 'loop', 'ffdnet']
        assert all(np.isfinite(list(r['loop'].values())).all() for r in rows)


def test_network_for_one_calibration():
    with tempfile.TemporaryDirectory() as folder:
        masks, out, data = os.path.join(folder, 'masks.npy'), os.path.join(folder, 'bench'), make_footage(folder)
        np.save(masks, solver.draw_masks(np.random.default_rng(0), 'squares', 6, 50))
        train = lambda: run('calibrated.py', '--masks', masks, '--data', data, '--out', out, '--crop', 32,
                            '--clips', 2, '--width', 16, '--stages', 2, '--steps', 3, '--threads', 1)
        train()
        train()   # continues; the exported network is compared with PyTorch
        with open(os.path.join(out, 'curve.csv'), encoding='utf8') as f:
            assert [line.split(',')[1] for line in f][1:] == ['3', '6']
        line = [sys.executable, os.path.join(HERE, 'calibrated.py'), '--masks', masks, '--data', data, '--out', out,
                '--crop', '32', '--clips', '2', '--width', '16', '--stages', '2', '--threads', '1']
        with subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
            assert 'continues from step 6' in process.stdout.readline()
            assert 'step 7' in process.stdout.readline()
            process.send_signal(signal.SIGINT)
            assert 'interrupted at step' in process.communicate(timeout=120)[1] and process.returncode == 1
        assert torch.load(os.path.join(out, 'checkpoint.pt'), weights_only=True)['step'] > 6
        with open(os.path.join(out, 'README.md'), encoding='utf8') as f:
            assert '6 frames of 50x50 pixels' in f.read()
        frames, = export.session(os.path.join(out, 'network.onnx')).run(None, {
            'measurement': np.ones((1, 1, 50, 50), np.float32), 'masks': np.load(masks)[None]})
        assert frames.shape == (1, 6, 50, 50) and np.isfinite(frames).all()


def log_errors(path, name, *inputs):
    """Output of a quality model, for `features`, `encoded`, `crop` and `signs`."""
    names = 'features', 'encoded', 'crop', 'signs'
    return export.session(path).run([name], {key: np.asarray(values, np.float32) for key, values in zip(names, inputs)})[0]


def test_quality_model_predicts_what_the_program_does():
    """The figures are those of a test of crates/reconstruction/src/quality.rs, with the same inputs."""
    root = os.path.join(HERE, '../..')
    sample = lambda level, swing, *shape: np.fromfunction(lambda k, n, i, j: level + swing * np.sin(n + 2 * k + 3 * i + 5 * j), shape)
    known = [sample(-2, 2, 2, 26, 2, 3), sample(-1, 1, 2, 128, 2, 3), sample(-2, 2, 1, 26, 1, 1).ravel(), sample(-25, 8, 1, 8, 1, 1).ravel()]
    unknown = known[:1] + [np.full_like(values, np.nan) for values in known[1:]]
    with open(os.path.join(root, 'tests/data/quality.json'), encoding='utf8') as f:
        expected = json.load(f)
    assert list(expected) == list(assessment.MODELS)
    for name, cases in expected.items():
        for case, inputs in (('known', known), ('unknown', unknown)):
            found = log_errors(os.path.join(root, 'models/quality/model.onnx'), name, *inputs)
            assert found.shape == (2, 2, 3) and np.abs(found.ravel() - cases[case]).max() < 1e-4, (name, case, found)


def make_case(folder, number, algorithm):
    """A snapshot of 128x128 pixels with random features, as `assessment.py make` writes it."""
    r, name = np.random.default_rng(number), f'c{number:04d}'
    os.makedirs(f'{folder}/{name}/{algorithm}')
    rows = r.normal(-2, 1, (assessment.FEATURES + assessment.CHANNELS, 4, 64))
    rows[assessment.CONTRAST] = -.5 if number % 2 else -2.5     # half of the masks are unfamiliar
    np.save(f'{folder}/{name}/{algorithm}/{name}.npy', np.concatenate([rows, 10 ** rows[:1]]).astype(np.float32))
    about = {'psnr_db': 20 + r.random(), 'white': 1., 'setting': {'pattern': 'iid', 'noise_sigma': 0}, 'pilot': None,
             'evidence': {'signs': list(-20 - r.random(assessment.SIGNS)), 'features': list(rows[:assessment.FEATURES].mean((1, 2)))}}
    for path, content in ((f'{algorithm}/{name}.json', about), ('scene.json', name)):
        with open(f'{folder}/{name}/{path}', 'w', encoding='utf8') as f:
            json.dump(content, f)


def test_quality_model_is_fitted_and_continued():
    name = algorithm = 'pnp-tv-fastdvdnet'
    with tempfile.TemporaryDirectory() as folder:
        for number in range(32):
            make_case(folder, number, algorithm)
        path = os.path.join(folder, 'model.onnx')
        fit = lambda *options: run('assessment.py', 'fit', '--out', folder, '--write', path, '--model', name, '--folds', 2, '--epochs', 1, *options)
        fit('--networks', 2)
        fit('--start', path)
        record, misses = assessment.read(path)[name]
        assert record['layer1/weights'].shape[0] == 2 and misses['interval'][0] < misses['interval'][1]
        case, fitted = assessment.Case(f'{folder}/c0003', algorithm), assessment.Model.read(record)
        shaped = lambda values: values.float().reshape(4, 8, 8, -1).permute(0, 3, 1, 2)
        found = log_errors(path, name, shaped(case.features), shaped(case.encoded), case.piece, case.signs[1:])
        assert np.abs(found.ravel() - fitted.errors(case).numpy()).max() < 1e-3


if __name__ == '__main__':
    for name, test in list(globals().items()):
        if name.startswith('test_'):
            test()
            print(name, 'ok')
