"""Makes the files of this folder with the writers that labs use. Needs h5py, hdf5plugin, numpy, Pillow, SciPy,
tifffile.

Each holds the same numbers: masks [3, 4, 5] whose value is (frame + 2 row + 3 column) mod 2, or measurements
[2, 4, 5] whose value is 100 frame + 10 row + column. `bench73.mat` is a recording of a small camera.
`../ways` has the inputs of tests/WAYS.md.
"""

import pathlib

import h5py
import hdf5plugin
import numpy as np
import scipy.io
import tifffile
from PIL import Image

HERE = pathlib.Path(__file__).parent
MATLAB_HEAD = b"MATLAB 7.3 MAT-file, Platform: GLNXA64, of a test HDF5 schema 1.00 .".ljust(116) + b"\0" * 8 + b"\0\x02IM"


def bench():
    """The snapshot of a square of 0.95 that moves over a wave, in counts of 16 bits with a maximum of 61234, and the masks of
    0 and 1, under names of somebody's own. `matlab` of tests/e2e/drive.mjs has the same formula."""
    frame, row, column = np.indices((8, 64, 64))
    inside = (row >= 20) & (row < 36) & (column >= 4 + 5 * frame) & (column < 20 + 5 * frame)
    truth = np.where(inside, 0.95, 0.35 + 0.2 * np.sin(column / 9) * np.cos(row / 13))
    masks = np.random.default_rng(1).integers(0, 2, truth.shape, np.uint8)
    shot = (masks * truth).sum(0)
    path = HERE / "bench73.mat"
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values, matlab in [
            ("patterns", np.moveaxis(masks, 0, -1), "uint8"),
            ("shots", np.rint(shot / shot.max() * 61234).astype("<u2"), "uint16"),
        ]:
            written = np.ascontiguousarray(values.T)
            dataset = file.create_dataset(name, data=written, chunks=written.shape, compression="gzip", shuffle=True)
            dataset.attrs["MATLAB_class"] = np.bytes_(matlab)
    with path.open("r+b") as file:
        file.write(MATLAB_HEAD)


def ways():
    """Two snapshots that need every option of tests/data/ways/requests.json, as an array of an HDF5 file and as 12-bit pixels.

    The masks are larger than the snapshots of `shots.raw`, of another full scale, more than one exposure shows, and have moved
    by (2, -1) pixels. The counts contain an offset of the dark, clip from 3500 on, and column 37 of the window is stuck.
    """
    folder = HERE.parent / "ways"
    rng = np.random.default_rng(3)
    patterns = 1000 * rng.integers(0, 2, (10, 80, 80), np.uint16)
    moved = np.roll(patterns[1:9], (2, -1), (1, 2)) / 1000
    frame, row, column = np.indices((16, 80, 80))
    inside = (row >= 28) & (row < 44) & (column >= 12 + 3 * frame) & (column < 28 + 3 * frame)
    truth = np.where(inside, 0.95, 0.35 + 0.2 * np.sin(column / 9) * np.cos(row / 13)).reshape(2, 8, 80, 80)
    dark = (260 + 10 * (np.indices((80, 80))[1] % 9)).astype("<u2")
    limit = 3500 + rng.integers(0, 60, (2, 80, 80))
    shots = np.minimum(np.rint(900 * (moved * truth).sum(1)) + dark, limit).astype("<u2")
    shots[:, :, 45] = 40
    bad = np.zeros((64, 64), np.uint8)
    bad[:, 37] = 1
    with h5py.File(folder / "bench.h5", "w") as file:
        for name, values in [("optics/patterns", np.moveaxis(patterns, 0, -1)), ("camera/shots", shots.transpose(2, 1, 0))]:
            file.create_dataset(name, data=values, chunks=values.shape, compression="gzip", shuffle=True)
    np.save(folder / "dark.npy", dark)
    np.save(folder / "bad.npy", bad)
    for name, pixels in [("shots", shots), ("dark", dark)]:
        first, second = (pixels[..., 8:72, 8 + side : 72 : 2] for side in (0, 1))
        packed = np.stack([first & 255, first >> 8 | (second & 15) << 4, second >> 4], -1)
        packed.astype(np.uint8).tofile(folder / f"{name}.raw")


def main():
    ways()
    frame, row, column = np.indices((3, 4, 5))
    masks = (frame + 2 * row + 3 * column) % 2
    frame, row, column = np.indices((2, 4, 5))
    snapshots = 100 * frame + 10 * row + column
    with h5py.File(HERE / "h5py.h5", "w") as file:
        file["mask"] = masks.astype(bool)
        file.create_dataset("meas", data=snapshots.astype("<u2"), chunks=(1, 3, 2), compression="gzip", shuffle=True)
        file.create_dataset("orig", data=snapshots.astype(">f4"), chunks=(2, 4, 5), fletcher32=True)
    with h5py.File(HERE / "types.h5", "w", libver="latest") as file:
        file["mask"] = masks.astype("<i8")
        file["meas"] = snapshots.astype("<f2")
        file["orig"] = snapshots.astype(complex)
    # MATLAB's layout has a block of 512 bytes before the file, reversed axes, and the class as an attribute.
    path = HERE / "matlab73.mat"
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values, matlab in [
            ("mask", masks.astype("u1"), "logical"),
            ("meas", snapshots.astype("f8"), "double"),
            ("orig", snapshots.astype("<i4"), "int32"),
        ]:
            written = np.ascontiguousarray(np.moveaxis(values, 0, -1).T)
            dataset = file.create_dataset(name, data=written, chunks=written.shape, compression="gzip")
            dataset.attrs["MATLAB_class"] = np.bytes_(matlab)
    with path.open("r+b") as file:
        file.write(MATLAB_HEAD)
    bench()
    for name, type in [("int64", "<i8"), ("int32-big", ">i4"), ("float16", "<f2"), ("int8", "i1")]:
        np.save(HERE / f"masks-{name}.npy", masks.astype(type))
    Image.fromarray(masks[0].astype(bool)).save(HERE / "mask-1-bit.png")
    Image.fromarray(masks[0].astype(bool)).save(HERE / "mask-1-bit.tif")
    tifffile.imwrite(HERE / "masks-bool.tif", masks.astype(bool), photometric="minisblack")
    tifffile.imwrite(HERE / "snapshots-float64.tif", snapshots.astype("f8"), photometric="minisblack")
    np.save(HERE / "snapshots-fortran.npy", np.asfortranarray(snapshots.astype("<u2")))
    with h5py.File(HERE / "names.h5", "w") as file:
        file["calibrated/masks"] = masks.astype("u1")
        file["shots"] = snapshots.astype("<u2")
    with h5py.File(HERE / "axes.h5", "w") as file:
        for axes, order in [("frame-row-column", (0, 1, 2)), ("row-column-frame", (1, 2, 0)), ("column-row-frame", (2, 1, 0)), ("frame-column-row", (0, 2, 1))]:
            values = snapshots.transpose(order).astype("<u2")
            file[axes] = values
            file.create_dataset(f"packed/{axes}", data=values, chunks=(2, 2, 2), compression="gzip")
            file[f"matlab/{axes}"] = np.ascontiguousarray(values.T)
            file[f"matlab/{axes}"].attrs["MATLAB_class"] = np.bytes_("uint16")
    for name, packing in [("lzf", {"compression": "lzf", "shuffle": True}), ("lz4", hdf5plugin.LZ4(nbytes=1024)), ("blosc", hdf5plugin.Blosc())]:
        with h5py.File(HERE / f"{name}.h5", "w") as file:
            file.create_dataset("mask", data=np.tile(masks, (1, 8, 8)).astype("<u2"), chunks=(2, 32, 40), **packing)
    with h5py.File(HERE / "user-block.h5", "w", userblock_size=1024) as file:
        file["mask"] = masks.astype("u1")
    with h5py.File(HERE / "groups.h5", "w") as file:
        file["exchange/data"], file["exchange/dark"] = masks.astype("u1"), masks[:1].astype("u1")
        # A group that contains itself.
        file["exchange/again"] = file["exchange"]
    # Octave stores a variable as a group with its type and its value, whose axes are in reverse.
    with h5py.File(HERE / "octave.h5", "w") as file:
        for name, values, kind in [("mask", masks.astype("u1"), "bool matrix"), ("meas", snapshots.astype("f8"), "matrix"), ("shots", snapshots.astype("f8"), "matrix")]:
            file.create_dataset(f"{name}/type", data=np.bytes_(kind))
            file[f"{name}/value"] = np.ascontiguousarray(np.moveaxis(values, 0, -1).T)
    scipy.io.savemat(HERE / "names.mat", {"shots": np.moveaxis(snapshots, 0, -1).astype("<u2")})


main()
