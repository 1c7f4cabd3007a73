"""The forward model of a snapshot compressive camera, for numpy, torch and deepinv.

A snapshot is the sum of the frames, each multiplied by its mask: y = sum_k C_k x_k. The operator `A A^T` is diagonal,
with the entries `gram` = sum_k C_k^2, so the pseudo-inverse has a closed form.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

if TYPE_CHECKING:
    from ._client import Calibration

# An array of numpy, or a tensor of torch on any device.
Array: TypeAlias = Any


@dataclass(frozen=True)
class Sensing:
    """The linear operator of masks [B, H, W].

    Frames are [..., B, H, W] and snapshots [..., H, W]. Both have the array type of the masks.

    >>> sensing = Sensing(masks)
    >>> residual = measurement - sensing.A(frames)
    """

    masks: Array

    def __post_init__(self) -> None:
        shape = tuple(getattr(self.masks, "shape", ()))
        if len(shape) != 3:
            raise ValueError(f"masks are [B, H, W], but these have the shape {shape}")

    @classmethod
    def of(cls, calibration: Calibration) -> Sensing:
        """The operator of a calibration of the service, as a numpy array of float32. All masks are 0 at bad pixels."""
        return Sensing(np.nan_to_num(calibration.masks()))

    @property
    def gram(self) -> Array:
        """The diagonal of `A A^T`, [H, W]. It is 0 where all masks are closed."""
        return (self.masks * self.masks).sum(0)

    def A(self, frames: Array) -> Array:
        """The snapshots [..., H, W] of frames [..., B, H, W]."""
        self._check(frames.shape, tuple(self.masks.shape), "frames")
        return (self.masks * frames).sum(-3)

    def A_adjoint(self, snapshots: Array) -> Array:
        """The adjoint: frames [..., B, H, W] of snapshots [..., H, W]."""
        self._check(snapshots.shape, tuple(self.masks.shape)[1:], "snapshots")
        return self.masks * snapshots[..., None, :, :]

    def A_dagger(self, snapshots: Array) -> Array:
        """The pseudo-inverse: the frames of least norm that explain the snapshots. They are 0 where all masks are closed."""
        gram = self.gram
        return self.A_adjoint(snapshots / (gram + (gram == 0)))

    def project(self, frames: Array, snapshots: Array, weight: float | None = None) -> Array:
        """The point nearest to `frames` that explains the snapshots: x + A^T (y - A x) / gram.

        With a `weight` w it is the minimiser of w/2 |A z - y|^2 + 1/2 |z - x|^2, the proximal operator of the data term.
        """
        gram = self.gram
        scale = gram + (gram == 0) if weight is None else gram + 1 / weight
        return frames + self.A_adjoint((snapshots - self.A(frames)) / scale)

    @staticmethod
    def _check(shape: Any, expected: tuple[int, ...], what: str) -> None:
        if tuple(shape)[-len(expected) :] != expected:
            raise ValueError(f"{what} end with the shape {expected}, but these have {tuple(shape)}")


def deepinv_physics(masks: Any, **options: Any) -> Any:
    """The operator as `deepinv.physics.LinearPhysics`, for masks [B, H, W] (tensor or array).

    Images are [N, B, H, W]: the frames are the channels. Measurements are [N, 1, H, W]. The sum over the frames is not
    divided by their number; deepinv's own spectral imager divides it. `options` are those of `LinearPhysics`, such as
    `noise_model`.
    """
    import torch  # type: ignore[import-not-found, unused-ignore]
    from deepinv.physics import LinearPhysics  # type: ignore[import-not-found, import-untyped, unused-ignore]

    class SnapshotCompressiveImaging(LinearPhysics):  # type: ignore[misc, unused-ignore]
        """y = sum_k C_k x_k."""

        def __init__(self) -> None:
            tensor = torch.as_tensor(masks, dtype=torch.float32)
            super().__init__(img_size=tuple(tensor.shape), **options)
            self.register_buffer("masks", tensor)

        @property
        def sensing(self) -> Sensing:
            return Sensing(self.masks)

        def A(self, x: Any, **_: Any) -> Any:
            return self.sensing.A(x)[:, None]

        def A_adjoint(self, y: Any, **_: Any) -> Any:
            return self.sensing.A_adjoint(y[:, 0])

        def A_dagger(self, y: Any, **_: Any) -> Any:
            return self.sensing.A_dagger(y[:, 0])

        def prox_l2(self, z: Any, y: Any, gamma: Any, **_: Any) -> Any:
            return self.sensing.project(z, y[:, 0], gamma)

    return SnapshotCompressiveImaging()
