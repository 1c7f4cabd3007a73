"""A napari reader: opens the frames of a job, or of a folder of results, as a layer."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ._client import Client, white_level_of

# A layer of napari: data, keywords of the layer, and kind.
Layer = tuple[Any, dict[str, Any], str]
Reader = Callable[[str], list[Layer]]
# The address of a job in the API, or of its page in the dashboard.
ADDRESS = re.compile(r"(?P<url>https?://.+?)/(?:v1|#)/jobs/(?P<job>[0-9a-f-]{36})/?$")


def get_reader(path: str | list[str]) -> Reader | None:
    """The reader for a path, or None if another plugin should open it.

    Supported paths are addresses of jobs, with the token in SCI_RECON_TOKEN, and folders with `frames.npy` and
    `manifest.json`, such as the results in a watched folder.
    """
    if not isinstance(path, str):
        return None
    if ADDRESS.match(path):
        return read_job
    folder = Path(path)
    if (folder / "frames.npy").is_file() and (folder / "manifest.json").is_file():
        return read_folder
    return None


def read_job(path: str) -> list[Layer]:
    """Downloads the frames of a job."""
    address = ADDRESS.match(path)
    if address is None:
        raise ValueError(f"{path} is not the address of a job")
    job = Client(address["url"]).job(address["job"])
    # The frames are mapped from a temporary file. The layer keeps a reference to the result, so that the file stays.
    result = job.result()
    name, metadata = job.record.get("label") or job.id, {"verdict": job.verdict, "result": result}
    return [layer(result.frames, name, result.white_level, metadata)]


def read_folder(path: str) -> list[Layer]:
    """Opens the frames of a folder of results."""
    folder = Path(path)
    manifest = json.loads((folder / "manifest.json").read_text("utf-8"))
    frames = np.load(folder / "frames.npy", mmap_mode="r")
    return [layer(frames, folder.name, white_level_of(manifest), {"manifest": manifest})]


def layer(frames: npt.NDArray[np.float32], name: str, white: float, metadata: dict[str, Any]) -> Layer:
    """A layer of frames [B, H, W] or [B, H, W, 3], shown from 0 to the white level of their job."""
    settings = {
        "name": name,
        "rgb": frames.ndim == 4,
        "contrast_limits": (0.0, white),
        "metadata": metadata,
    }
    return (frames, settings, "image")
