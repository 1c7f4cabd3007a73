"""Reads a job's frames in every export format, and compares them bit for bit.

Usage: read_exports.py URL JOB SNAPSHOTS, with SCI_RECON_TOKEN. Prints one JSON line.
"""

import io
import json
import os
import sys
import tempfile
import urllib.request
import zipfile
from xml.etree import ElementTree

import numpy as np
import tifffile
import zarr
import zarr.storage
from ome_zarr_models.v05.image import Image


def main():
    url, job, count = sys.argv[1], sys.argv[2], int(sys.argv[3])
    headers = {"Authorization": f"Bearer {os.environ['SCI_RECON_TOKEN']}"}
    base = f"{url}/v1/jobs/{job}"

    def get(path, **more):
        with urllib.request.urlopen(urllib.request.Request(base + path, headers=headers | more)) as answer:
            return answer.read()

    snapshots = [np.load(io.BytesIO(get(f"/snapshots/{index}/exports/npy"))) for index in range(count)]
    clips = {f"/snapshots/{index}": frames for index, frames in enumerate(snapshots)}
    clips[""] = np.concatenate(snapshots)
    assert (np.load(io.BytesIO(get("/exports/npy"))) == clips[""]).all()
    intervals = {}
    for place, frames in clips.items():
        with tifffile.TiffFile(io.BytesIO(get(f"{place}/exports/tiff"))) as file:
            colours = frames.ndim == 4
            assert not file.is_bigtiff and file.is_ome and file.byteorder == "<"
            assert len(file.pages) == len(frames)
            found = file.asarray()
            assert found.dtype == np.float32 and found.shape == frames.shape and (found == frames).all()
            assert file.series[0].axes == ("TYXS" if colours else "TYX"), file.series[0].axes
            assert file.pages[0].photometric == (2 if colours else 1)
            pixels = ElementTree.fromstring(file.ome_metadata).find(".//{*}Pixels")
            assert int(pixels.get("SizeT")) == len(frames)
            interval = pixels.get("TimeIncrement")
            assert interval is None or pixels.get("TimeIncrementUnit") == "s"
            intervals[place] = interval and float(interval)
            planes = [float(plane.get("DeltaT")) for plane in pixels.findall("{*}Plane")]
            assert len(planes) in (0, len(frames)) and planes == sorted(planes)
        with tempfile.NamedTemporaryFile(suffix=".zarr.zip") as packed:
            packed.write(get(f"{place}/exports/zarr_zip"))
            packed.flush()
            over_http = {"client_kwargs": {"headers": headers}}
            check_zarr(zarr.open_group(f"{base}{place}/exports/zarr", mode="r", storage_options=over_http), frames)
            check_zarr(zarr.open_group(zarr.storage.ZipStore(packed.name, mode="r"), mode="r"), frames)
    archive = get("/exports/zip")
    with zipfile.ZipFile(io.BytesIO(archive)) as file:
        assert file.testzip() is None
        assert all(info.compress_type == zipfile.ZIP_STORED for info in file.infolist())
        names = file.namelist()
        assert len(set(names)) == len(names) and "manifest.json" in names
        for index, frames in enumerate(snapshots):
            assert (np.load(io.BytesIO(file.read(f"snapshot_{index:04d}/frames.npy"))) == frames).all()
    # An interrupted download can be continued.
    cut = len(archive) // 3
    assert archive[:cut] + get("/exports/zip", Range=f"bytes={cut}-") == archive
    print(json.dumps({"intervals": intervals, "members": len(names)}))


def check_zarr(group, frames):
    """Time, channel and space, as OME-Zarr orders them."""
    frames = frames if frames.ndim == 3 else frames.transpose(0, 3, 1, 2)
    image = Image.from_zarr(group).ome_attributes.multiscales[0]
    assert "".join(axis.name for axis in image.axes) == ("tyx" if frames.ndim == 3 else "tcyx")
    array = group["0"]
    assert array.shape == frames.shape and array.dtype == np.float32 and array.chunks == (1, *frames.shape[1:])
    assert (array[:] == frames).all() and (array[-1, ..., 3:5] == frames[-1, ..., 3:5]).all()


main()
