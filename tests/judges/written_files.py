"""Writes files of every format in `docs/DATA.md` to FOLDER, with the libraries that labs use.

`index.json` in FOLDER lists, for each file, its row in the tables and the fields of its request. A file holds masks
[4, 48, 64] of 0 and 1, or snapshots [2, 48, 64] from 0 to 250.
"""

import contextlib
import gzip
import io
import json
import pathlib
import sys
import tarfile
import zipfile

import h5py
import imageio.v3 as imageio
import numpy as np
import OpenEXR
import scipy.io
import scipy.sparse
import tifffile
from PIL import Image

FOLDER = pathlib.Path(sys.argv[1])
random = np.random.default_rng(1)
MASKS = random.integers(0, 2, (4, 48, 64))
SNAPSHOTS = random.integers(1, 251, (2, 48, 64))
EIGHT = (MASKS * 255).astype("u1")
index = []


def path(row, file, **asked):
    """Path of a new file for a row. It holds masks unless `measurement` is set. `asked` has the request's fields."""
    place = FOLDER / f"{len(index):02}" / file
    place.parent.mkdir()
    # Images have no axis order; arrays have the usual one of their format, unless `read_axes` is given.
    usual = {"npy": "frame-row-column", "npz": "frame-row-column", "h5": "frame-row-column", "mat": "row-column-frame"}
    asked = {"read_axes": usual.get(place.suffix[1:]), **asked}
    index.append({"row": row, "file": str(place.relative_to(FOLDER)), **asked})
    return place


def matlab73(place, **arrays):
    """Writes MATLAB's layout: axes in reverse, the class as an attribute."""
    with level73(place) as file:
        for name, (values, matlab) in arrays.items():
            dataset = file.create_dataset(name, data=np.ascontiguousarray(values.T), chunks=values.T.shape, compression="gzip")
            dataset.attrs["MATLAB_class"] = np.bytes_(matlab)


@contextlib.contextmanager
def level73(place):
    """Writes an HDF5 file after MATLAB's header of 512 bytes."""
    with h5py.File(place, "w", userblock_size=512) as file:
        yield file
    with place.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64 HDF5 schema 1.00 .".ljust(116) + b"\0" * 8 + b"\0\x02IM")


def png(values):
    file = io.BytesIO()
    Image.fromarray(values).save(file, "png")
    return file.getvalue()


def zipped(place, members, packing=zipfile.ZIP_STORED):
    with zipfile.ZipFile(place, "w", packing) as archive:
        for name, content in members:
            archive.writestr(name, content)


def accepted():
    row = "npy"
    np.save(path(row, "a.npy"), MASKS.astype("f4"))
    np.save(path(row, "a.npy"), np.asfortranarray(MASKS.astype("f8")))
    for code in ["?", "<i2", ">i4", "<i8", "u8", "i1", "<f2", ">f4"]:
        np.save(path(row, "a.npy"), MASKS.astype(code))
    np.save(path(row, "a.npy", axes="row-column-frame"), np.moveaxis(MASKS, 0, -1).astype("f4"))
    np.save(path(row, "a.npy", axes="column-row-frame"), MASKS.T.astype("f4"))
    snapshots = {"measurement": True, "full_scale": 250}
    np.save(path(row, "a.npy", **snapshots), SNAPSHOTS.astype("<u2"))
    # The masks have 48x64 pixels, so only one order fits.
    np.save(path(row, "a.npy", read_axes="row-column-frame", **snapshots), np.moveaxis(SNAPSHOTS, 0, -1).astype("u1"))
    np.save(path(row, "a.npy", read_axes="column-row-frame", **snapshots), SNAPSHOTS.T.astype("u1"))
    row = "npz"
    np.savez(path(row, "a.npz"), MASKS.astype("f4"))
    np.savez_compressed(path(row, "a.npz"), mask=MASKS, meas=SNAPSHOTS)
    np.savez_compressed(path(row, "a.npz", name="c"), c=MASKS.astype(bool), d=SNAPSHOTS)
    np.savez(path(row, "a.npz", **snapshots), mask=MASKS, meas=SNAPSHOTS)
    row = "TIFF, BigTIFF"
    tifffile.imwrite(path(row, "a.tif"), EIGHT, photometric="minisblack")
    tifffile.imwrite(path(row, "a.tif"), MASKS.astype(bool), photometric="minisblack")
    tifffile.imwrite(path(row, "a.tif"), (MASKS * 65535).astype(">u2"), photometric="minisblack", byteorder=">")
    tifffile.imwrite(path(row, "a.tif"), MASKS.astype("f4"), photometric="minisblack", bigtiff=True)
    tifffile.imwrite(path(row, "a.tif"), MASKS.astype("f8"), photometric="minisblack", ome=True)
    for compression in ["tiff_lzw", "tiff_adobe_deflate", "packbits"]:
        pages = [Image.fromarray(page) for page in EIGHT]
        pages[0].save(path(row, "a.tif"), save_all=True, append_images=pages[1:], compression=compression)
    imageio.imwrite(path(row, "a.tif"), EIGHT, is_batch=True, photometric="minisblack")
    row = "ImageJ stack, also above 4 GB"
    tifffile.imwrite(path(row, "a.tif"), EIGHT, imagej=True)
    tifffile.imwrite(path(row, "a.tif"), MASKS.astype("f4"), imagej=True, truncate=True)
    row = "PNG"
    Image.fromarray(MASKS[0].astype(bool)).save(path(row, "a.png", frames=1))
    Image.fromarray(EIGHT[0]).save(path(row, "a.png", frames=1))
    imageio.imwrite(path(row, "a.png", frames=1), (MASKS[0] * 65535).astype("u2"))
    row = "ZIP of images"
    numbered = [(f"shot_{k + 8}.png", png(frame)) for k, frame in enumerate(EIGHT)]
    zipped(path(row, "a.zip"), numbered[::-1])
    zipped(path(row, "a.zip"), numbered, zipfile.ZIP_DEFLATED)
    tiffs = []
    for k, frame in enumerate(EIGHT):
        file = io.BytesIO()
        tifffile.imwrite(file, frame, photometric="minisblack")
        tiffs.append((f"run 3/{k:04}.tif", file.getvalue()))
    zipped(path(row, "a.zip"), tiffs, zipfile.ZIP_DEFLATED)
    row = "tar of images"
    for form in [tarfile.PAX_FORMAT, tarfile.GNU_FORMAT, tarfile.USTAR_FORMAT]:
        with tarfile.open(path(row, "a.tar"), "w", format=form) as archive:
            for name, content in numbered:
                member = tarfile.TarInfo(f"bench/{name}")
                member.size, member.mtime = len(content), 1.5 if form == tarfile.PAX_FORMAT else 1
                archive.addfile(member, io.BytesIO(content))
    row = "`.mat` level 5 (`save -v7`)"
    mask, meas = np.moveaxis(MASKS, 0, -1), np.moveaxis(SNAPSHOTS, 0, -1)
    for packed in [False, True]:
        scipy.io.savemat(path(row, "a.mat"), {"meas": meas, "mask": mask.astype("f8")}, do_compression=packed)
    scipy.io.savemat(path(row, "a.mat", name="shots"), {"shots": mask.astype(bool)})
    scipy.io.savemat(path(row, "a.mat", measurement=True, full_scale=250), {"meas": meas.astype("u2")})
    # At most 64 masks are allowed, and no sensor has 4 rows, so the frames must come first.
    scipy.io.savemat(path(row, "a.mat", read_axes="frame-row-column"), {"mask": MASKS.astype("u1")})
    row = "`.mat` level 7.3 (`save -v7.3`)"
    matlab73(path(row, "a.mat"), mask=(mask.astype("u1"), "logical"), meas=(meas.astype("f8"), "double"))
    matlab73(path(row, "a.mat", measurement=True, full_scale=250), meas=(meas.astype("u2"), "uint16"))
    matlab73(path(row, "a.mat", axes="frame-row-column"), mask=(MASKS.astype("f4"), "single"))
    row = "HDF5"
    with h5py.File(path(row, "a.h5"), "w") as file:
        file["mask"] = MASKS.astype(bool)
    with h5py.File(path(row, "a.h5"), "w", libver="latest") as file:
        file.create_dataset("mask", data=MASKS.astype(">f4"), chunks=(1, 48, 64), compression="gzip", shuffle=True)
    with h5py.File(path(row, "a.h5", name="run/masks", axes="row-column-frame"), "w") as file:
        file.create_dataset("run/masks", data=mask.astype("<i4"), chunks=(16, 16, 2), fletcher32=True)
    # MATLAB's h5write of [row, column, frame] reverses the axes and writes no class.
    with h5py.File(path(row, "a.h5", axes="frame-column-row"), "w") as file:
        file["mask"] = mask.astype("f8").T
    with h5py.File(path(row, "a.h5", read_axes="frame-column-row", measurement=True, full_scale=250), "w") as file:
        file["meas"] = meas.astype("<u2").T
    with h5py.File(path(row, "a.h5", read_axes="row-column-frame", measurement=True, full_scale=250), "w") as file:
        file.create_dataset("meas", data=meas.astype("<u2"), chunks=(8, 64, 1), compression="gzip")


def refused():
    colours = np.repeat(EIGHT[0][..., None], 3, axis=2)
    row = "masks with several possible axis orders"
    np.save(path(row, "in.npy", reason="axes_ambiguous"), np.moveaxis(MASKS, 0, -1).astype("f4"))
    row = "npy with extra axes of length 1"
    np.save(path(row, "in.npy"), MASKS[:, None].astype("f4"))
    row = "npy of objects (a pickle)"
    frames = np.empty(4, object)
    frames[:] = [frame.astype("f4") for frame in MASKS]
    np.save(path(row, "in.npy"), frames, allow_pickle=True)
    row = "npy of complex numbers"
    np.save(path(row, "in.npy"), MASKS.astype("c8"))
    row = "npz without the expected array name"
    np.savez(path(row, "in.npz", reason="missing_array", again={"name": "a"}), a=MASKS, b=SNAPSHOTS)
    row = "PNG with colour, transparency, or 2 or 4 bits"
    Image.fromarray(colours).save(path(row, "in.png", frames=1))
    Image.fromarray(colours).convert("LA").save(path(row, "in.png", frames=1))
    Image.fromarray(EIGHT[0]).quantize(2).save(path(row, "in.png", frames=1))
    row = "animated PNG"
    pages = [Image.fromarray(frame) for frame in EIGHT]
    pages[0].save(path(row, "in.png"), save_all=True, append_images=pages[1:])
    row = "colour TIFF"
    tifffile.imwrite(path(row, "in.tif", frames=1), colours, photometric="rgb")
    row = "TIFF with another sample type"
    for code in ["<u4", "<i2", "<f2"]:
        tifffile.imwrite(path(row, "in.tif"), MASKS.astype(code), photometric="minisblack")
    row = "TIFF in which 0 is white"
    tifffile.imwrite(path(row, "in.tif"), 255 - EIGHT, photometric="miniswhite")
    row = "TIFF with another compression"
    pages[0].save(path(row, "in.tif"), save_all=True, append_images=pages[1:], compression="zstd")
    row = "TIFF with pages of several sizes"
    with tifffile.TiffWriter(path(row, "in.tif")) as file:
        for frame in MASKS.astype("f4"):
            file.write(frame, photometric="minisblack", contiguous=False)
        file.write(MASKS[0, ::2, ::2].astype("f4"), photometric="minisblack")
    row = "EXR"
    parts = [OpenEXR.Part({}, {"Y": frame.astype("f4")}, str(k)) for k, frame in enumerate(MASKS)]
    OpenEXR.File(parts).write(str(path(row, "in.exr")))
    row = "GIF or BMP"
    pages[0].save(path(row, "in.gif"), save_all=True, append_images=pages[1:])
    Image.fromarray(EIGHT[0]).save(path(row, "in.gif", frames=1), "bmp")
    row = "JPEG"
    pages[0].save(path(row, "in.jpg"))
    row = "gzip"
    place = path(row, "in.gz")
    with gzip.open(place, "wb") as file:
        np.save(file, MASKS.astype("f4"))
    row = "ZIP with missing numbers or other files"
    some = [(f"shot_{k}.png", png(frame)) for k, frame in zip([1, 2, 4, 5], EIGHT)]
    zipped(path(row, "in.zip"), some)
    zipped(path(row, "in.zip"), [*some, ("read me.txt", b"text")])
    row = "tar with missing numbers or other files"
    with tarfile.open(path(row, "in.tar"), "w") as archive:
        for name, content in some:
            member = tarfile.TarInfo(name)
            member.size = len(content)
            archive.addfile(member, io.BytesIO(content))
    row = "ZIP with another compression"
    numbered = [(f"shot_{k}.png", png(frame)) for k, frame in enumerate(EIGHT)]
    zipped(path(row, "in.zip"), numbered, zipfile.ZIP_BZIP2)
    zipped(path(row, "in.zip"), numbered, zipfile.ZIP_LZMA)
    mask = np.moveaxis(MASKS, 0, -1).astype("f8")
    row = "`.mat` with a sparse matrix"
    scipy.io.savemat(path(row, "in.mat", frames=1), {"mask": scipy.sparse.csc_matrix(MASKS[0].astype("f8"))})
    row = "`.mat` with complex numbers"
    scipy.io.savemat(path(row, "in.mat"), {"mask": mask.astype("c16")})
    row = "`.mat` with a cell array"
    cells = np.empty((1, 4), object)
    cells[0] = [frame.astype("f8") for frame in MASKS]
    scipy.io.savemat(path(row, "in.mat"), {"mask": cells})
    row = "`.mat` with a struct"
    scipy.io.savemat(path(row, "in.mat"), {"mask": {"data": mask, "date": "today"}})
    row = "`.mat` with more than three axes"
    scipy.io.savemat(path(row, "in.mat"), {"mask": mask.reshape(48, 64, 2, 2, order="F")})
    scipy.io.savemat(path(row, "in.mat"), {"mask": mask[:, :, None]})
    row = "`.mat` 7.3 with a cell array"
    with level73(path(row, "in.mat")) as file:
        cells = [file.create_dataset(f"#refs#/{k}", data=frame.astype("f8").T).ref for k, frame in enumerate(MASKS)]
        dataset = file.create_dataset("mask", data=np.array(cells, h5py.ref_dtype).reshape(4, 1))
        dataset.attrs["MATLAB_class"] = np.bytes_("cell")
    row = "`.mat` 7.3 with a struct"
    with level73(path(row, "in.mat")) as file:
        file.create_dataset("mask/data", data=mask.T).attrs["MATLAB_class"] = np.bytes_("double")
        file["mask"].attrs["MATLAB_class"] = np.bytes_("struct")
    row = "`.mat` 7.3 with more than three axes"
    matlab73(path(row, "in.mat"), mask=(mask.reshape(48, 64, 2, 2, order="F"), "double"))
    row = "HDF5 with more than three axes"
    with h5py.File(path(row, "in.h5"), "w") as file:
        file["mask"] = MASKS.reshape(2, 2, 48, 64)
    row = "`.mat` level 4 (`save -v4`)"
    scipy.io.savemat(path(row, "in.mat", frames=1), {"mask": MASKS[0].astype("f8")}, format="4")
    row = "HDF5 with another filter (LZF, szip)"
    with h5py.File(path(row, "in.h5"), "w") as file:
        file.create_dataset("mask", data=MASKS, chunks=(1, 48, 64), compression="lzf")
    row = "HDF5 with records or complex numbers"
    with h5py.File(path(row, "in.h5"), "w") as file:
        file["mask"] = MASKS.astype("c8")
    row = "integers without a stated full scale"
    np.save(path(row, "in.npy", measurement=True, reason="invalid_full_scale", again={"full_scale": 250}), SNAPSHOTS.astype("<i4"))


accepted()
refused()
np.save(FOLDER / "masks.npy", MASKS.astype("f4"))
np.save(FOLDER / "snapshots.npy", (SNAPSHOTS / np.float32(250)).astype("f4"))
(FOLDER / "index.json").write_text(json.dumps(index))
