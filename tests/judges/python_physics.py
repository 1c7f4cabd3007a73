"""Checks the forward model of the Python client in numpy, torch and deepinv.

Usage: python_physics.py [URL CALIBRATION FILE]. The masks of the calibration, read from the service, must be those of the
npy file. The last line is JSON: errors, which must be at rounding level.
"""

import json
import sys

import numpy as np
import torch
from deepinv.physics import LinearPhysics
from sci_recon import Client
from sci_recon.physics import Sensing, deepinv_physics

SHAPE = (8, 24, 40)


def masks():
    values = np.random.default_rng(1).random(SHAPE).astype(np.float32)
    # A pixel that no mask opens.
    values[:, 3, 4] = 0
    return values


def operators(convert, errors, name):
    random = np.random.default_rng(2)
    sensing = Sensing(convert(masks().astype(np.float64)))
    frames, snapshots = (convert(random.random((2, *shape))) for shape in (SHAPE, SHAPE[1:]))
    left, right = (sensing.A(frames) * snapshots).sum(), (frames * sensing.A_adjoint(snapshots)).sum()
    errors[f"{name} adjoint"] = abs(float(left - right)) / float(left)
    seen = sensing.A(frames)
    errors[f"{name} pseudo-inverse"] = float(abs(sensing.A(sensing.A_dagger(seen)) - seen).max())
    errors[f"{name} projection"] = float(abs(sensing.A(sensing.project(frames * 0, seen)) - seen).max())


def deepinv(errors):
    torch.manual_seed(3)
    physics = deepinv_physics(masks())
    frames, start = torch.rand(2, *SHAPE), torch.rand(2, *SHAPE)
    snapshots = physics(frames)
    assert snapshots.shape == (2, 1, *SHAPE[1:]), snapshots.shape
    errors["deepinv adjoint"] = float(physics.adjointness_test(img_size=(1, *SHAPE)))
    errors["deepinv pseudo-inverse"] = float((physics.A(physics.A_dagger(snapshots)) - snapshots).abs().max())
    solved = LinearPhysics.prox_l2(physics, start, snapshots, 0.7, max_iter=200, tol=1e-7)
    errors["deepinv proximal operator"] = float((physics.prox_l2(start, snapshots, 0.7) - solved).abs().max())


def refusals():
    for wrong in (np.zeros((4, 4)), np.zeros((1, 2, 4, 4))):
        try:
            Sensing(wrong)
        except ValueError as error:
            assert "[B, H, W]" in str(error)
        else:
            raise AssertionError(f"masks of the shape {wrong.shape} are taken")
    try:
        Sensing(masks()).A(np.zeros((8, 40, 24), np.float32))
    except ValueError as error:
        assert "(8, 24, 40)" in str(error)
    else:
        raise AssertionError("transposed frames are taken")


def main():
    errors = {}
    operators(lambda values: values, errors, "numpy")
    operators(torch.from_numpy, errors, "torch")
    deepinv(errors)
    refusals()
    if len(sys.argv) > 1:
        url, calibration, file = sys.argv[1:]
        client = Client(url)
        sent = np.load(file).astype(np.float32)
        known = Sensing.of(client.calibration(calibration)).masks
        errors["masks of the service"] = float(abs(known - sent).max())
    print(json.dumps({"ok": all(error < 1e-4 for error in errors.values()), **errors}))
    assert all(error < 1e-4 for error in errors.values()), errors


main()
