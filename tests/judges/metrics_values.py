"""Prints the reference values of the unit test in crates/reconstruction/src/metrics.rs.

    pip install scikit-image && python tests/judges/metrics_values.py
"""
import numpy as np
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

k, i, j = np.meshgrid(np.arange(3), np.arange(20), np.arange(31), indexing="ij")


def wave(phase):
    return (0.5 + 0.4 * np.sin(0.3 * i + 0.2 * j + k + phase) * np.cos(0.11 * i * j)).astype(np.float32)


truth, frames = wave(0.0).astype(np.float64), wave(0.25).astype(np.float64)
print("psnr", np.mean([peak_signal_noise_ratio(t, f, data_range=1) for t, f in zip(truth, frames)]))
print("ssim", np.mean([structural_similarity(t, f, data_range=1) for t, f in zip(truth, frames)]))
