"""Snapshot compressive imaging on small batches: masks, measurement, accelerated GAP with TV or a network.

Clips and masks are [N,B,H,W] on [0,1], measurements [N,1,H,W]: y = sum_k C_k * x_k + noise. B is the compression ratio.
"""
import math

import numpy as np
import torch


# ---------------------------------------------------------------- masks
def shifted_sum(base, offsets, weights):
    """Sum of a mask [H,W] shifted by fractions of a pixel. A sensor pixel integrates, so a fraction mixes two
    neighbours."""
    out = np.zeros_like(base)
    for (dy, dx), w in zip(offsets, weights):
        iy, ix = math.floor(dy), math.floor(dx)
        fy, fx = dy - iy, dx - ix
        for sy, sx, part in ((0, 0, (1 - fy) * (1 - fx)), (1, 0, fy * (1 - fx)), (0, 1, (1 - fy) * fx), (1, 1, fy * fx)):
            if part > 1e-6:
                out += (w * part) * np.roll(base, (iy + sy, ix + sx), (0, 1))
    return out


def random_squares(r, base, b):
    """Hybrid coded aperture: the lithography mask through sub-apertures one mask pixel apart, half of them open per
    frame."""
    rows, columns = (3, 4) if b <= 12 else (4, 5) if b <= 20 else (5, 6)
    offsets = [(y, x) for y in range(rows) for x in range(columns)]
    n = len(offsets)
    for _ in range(100):   # the multiplexing matrix should have full rank; random draws nearly always do
        opened = np.stack([r.permutation(n) < n // 2 for _ in range(b)]).astype(np.float32)
        if np.linalg.matrix_rank(opened) == min(b, n):
            break
    return np.stack([shifted_sum(base, offsets, row) for row in opened])


def rotating_circle(r, base, b):
    """Hybrid coded aperture with one open off-axis circle that rotates by 360/B degrees per frame; lengths in mask
    pixels."""
    radius, off_axis, start = r.uniform(.6, 1.6), r.uniform(.6, 1.6), r.uniform(0, 2 * math.pi)
    grid = [(y, x) for y in np.linspace(-1, 1, 7) for x in np.linspace(-1, 1, 7) if y * y + x * x <= 1]
    def frame(angle):
        return [(radius * y + off_axis * math.sin(angle), radius * x + off_axis * math.cos(angle)) for y, x in grid]
    return np.stack([shifted_sum(base, frame(start + 2 * math.pi * k / b), [1.] * len(grid)) for k in range(b)])


def draw_masks(r, kind, b, size):
    """Masks [B,size,size] on [0,1] of one kind: iid, squares, circle or grey."""
    if kind == 'iid':
        c = (r.random((b, size, size)) < .5).astype(np.float32)
    elif kind == 'grey':
        c = r.random((b, size, size), np.float32) ** r.uniform(.5, 2)
    else:
        base = (r.random((size, size)) < .5).astype(np.float32)
        c = (random_squares if kind == 'squares' else rotating_circle)(r, base, b)
    return (c / c.max()).astype(np.float32)


def random_masks(r, b, size):
    """Masks of every kind that the product supports: with a doubling relay, slight blur, and dead pixels."""
    kind = r.choice(['iid', 'squares', 'circle', 'grey'], p=[.35, .35, .2, .1])
    double = r.random() < .15
    c = draw_masks(r, kind, b, size // 2 if double else size)
    if double:
        c = c.repeat(2, 1).repeat(2, 2)
    if r.random() < .15:
        blur = r.uniform(.02, .12)
        c = (1 - 4 * blur) * c + blur * sum(np.roll(c, s, axis) for s in (1, -1) for axis in (1, 2))
    if r.random() < .1:
        c = c * (r.random((size, size)) > .003)
    return np.ascontiguousarray(c, np.float32)


# ---------------------------------------------------------------- solver
def measure(x, masks):
    return (x * masks).sum(1)[:, None]


class Gap:
    """Accelerated generalised alternating projection. The Gram diagonal is the sum of squares; pixels where it is zero
    carry no information."""

    def __init__(self, y, masks, memory=1.):
        """memory: the share of the accumulated residual that is kept. 1 is accelerated GAP, 0 plain GAP. A network that
        removes part of the projection never explains the measurement fully; with memory 1 the residual then grows
        without bound."""
        self.y, self.masks, self.memory = y, masks, memory
        gram = (masks * masks).sum(1, keepdim=True)
        self.inverse = torch.where(gram > 0, 1 / gram.clamp_min(1e-12), torch.zeros_like(gram))
        self.excess = -y   # the accumulated residual, which is added to y

    def project(self, v):
        """The estimate v, projected to the accumulated measurement."""
        seen = measure(v, self.masks)
        self.excess = self.memory * (self.excess + self.y - seen)
        return v + self.masks * (self.inverse * (self.y + self.excess - seen))


def tv(x, weight, iterations=5):
    """Isotropic total variation of each frame, Chambolle's dual projection; x [...,H,W]."""
    py, px, out = torch.zeros_like(x), torch.zeros_like(x), x
    for _ in range(iterations):
        gy, gx = torch.zeros_like(x), torch.zeros_like(x)
        gy[..., :-1, :] = out[..., 1:, :] - out[..., :-1, :]
        gx[..., :-1] = out[..., 1:] - out[..., :-1]
        norm = 1 + (.25 / weight) * (gy * gy + gx * gx + 1e-20).sqrt()   # the root of 0 has no gradient, and flat areas have 0
        py, px = (py - .25 * gy) / norm, (px - .25 * gx) / norm
        out = x - py - px
        out[..., 1:, :] += py[..., :-1, :]
        out[..., 1:] += px[..., :-1]
    return out


def temporal_tv(x, weight, updates=4):
    """Total variation along time, pixel by pixel: projected gradient on the dual; x [N,B,H,W]. A single frame has no
    neighbour."""
    p, out = torch.zeros_like(x[:, 1:]), x
    for _ in range(updates if x.shape[1] > 1 else 0):
        p = (p - .25 * (out[:, 1:] - out[:, :-1])).clamp(-weight, weight)
        out = x.clone()
        out[:, :-1] -= p
        out[:, 1:] += p
    return out


@torch.no_grad()
def start(y, masks, iterations=40, weight=.1, temporal=0.):
    """The TV iterations from zero; returns the solver's state and the estimate."""
    gap, v = Gap(y, masks), torch.zeros_like(masks)
    for _ in range(iterations):
        x = gap.project(v)
        v = tv(temporal_tv(x, temporal) if temporal else x, weight)
    return gap, v


def geometric(first, last, passes):
    """Noise levels (/255 given, on [0,1] returned) that fall by a constant factor."""
    return [float(s) / 255 for s in np.geomspace(first, last, passes)]


@torch.no_grad()
def passes(gap, v, net, sigmas, tv_weight=0., momentum=0.):
    """The deep iterations; yields the estimate after each."""
    start = v
    for sigma in sigmas:
        x = gap.project(start)
        if tv_weight:
            x = tv(x, tv_weight)
        output = net.clips(x, torch.full((len(x), 1, 1, 1), sigma, device=x.device))
        start, v = output + momentum * (output - v), output
        yield v
