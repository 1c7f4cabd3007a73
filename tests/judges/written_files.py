"""Writes files of every format in `docs/DATA.md` and `conversions.md` to FOLDER, with the libraries that labs use.

`index.json` in FOLDER lists, for each file, its row in the tables and the fields of its request. A file holds masks
[4, 48, 64] of 0 and 1, or snapshots [2, 48, 64] from 0 to 250.
"""

import contextlib
import gzip
import io
import json
import pathlib
import struct
import sys
import tarfile
import zipfile
import zlib

import h5py
import hdf5plugin
import imagecodecs
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


def octave(place, name, values, kind):
    """Writes a variable as Octave does: a group with its type and its value, whose axes are in reverse."""
    with h5py.File(place, "w") as file:
        group = file.create_group(name)
        group.attrs["OCTAVE_NEW_FORMAT"] = np.uint8(1)
        group.create_dataset("type", data=np.bytes_(kind))
        group.create_dataset("value", data=np.ascontiguousarray(values.T))


# A placeholder that `retag` turns into a tag that tifffile does not write.
TAG = {"metadata": None, "software": False, "extratags": [(65000, 3, 1, 7, False)]}
REVERSED = np.array([int(f"{byte:08b}"[::-1], 2) for byte in range(256)], "u1")


def retag(place, tag, value, change=None):
    """Replaces the placeholder of each page by a tag, and changes the bytes of the pixels."""
    data = bytearray(place.read_bytes())
    pages = [(page.offset, page.dataoffsets, page.databytecounts) for page in tifffile.TiffFile(place).pages]
    for offset, starts, lengths in pages:
        count = int.from_bytes(data[offset : offset + 2], "little")
        entries = [bytes(data[offset + 2 + 12 * k : offset + 14 + 12 * k]) for k in range(count)]
        new = struct.pack("<HHIHH", tag, 3, 1, value, 0)
        entries = [new if entry[:2] == struct.pack("<H", 65000) else entry for entry in entries]
        entries.sort(key=lambda entry: int.from_bytes(entry[:2], "little"))
        data[offset + 2 : offset + 2 + 12 * count] = b"".join(entries)
    # A contiguous stack has one range for all pages.
    for start, length in {(start, length) for _, starts, lengths in pages for start, length in zip(starts, lengths)}:
        if change:
            data[start : start + length] = change(np.frombuffer(data[start : start + length], "u1")).tobytes()
    place.write_bytes(data)


def packed(values, bits):
    """Rows of samples of `bits` bits, most significant bit first, each from a whole byte."""
    digits = (values[..., None] >> np.arange(bits)[::-1]) & 1
    return np.packbits(digits.reshape(*values.shape[:-1], -1).astype("u1"), axis=-1)


def camera(values, packing):
    """Packs two pixels of 12 bits into three bytes, as the standards of cameras describe."""
    first, second = values[..., ::2], values[..., 1::2]
    if packing == "mono12p":
        three = [first & 255, first >> 8 | (second & 15) << 4, second >> 4]
    else:
        three = [first >> 4, first & 15 | (second & 15) << 4, second >> 4]
    return np.stack(three, axis=-1).astype("u1").reshape(*values.shape[:-1], -1)


def grey_png(place, values, bits):
    """Writes a grey PNG of a bit depth that Pillow does not write."""
    chunk = lambda name, data: struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
    head = struct.pack(">IIBBBBB", values.shape[1], values.shape[0], bits, 0, 0, 0, 0)
    rows = b"".join(b"\0" + row.tobytes() for row in packed(values, bits))
    parts = [(b"IHDR", head), (b"IDAT", zlib.compress(rows)), (b"IEND", b"")]
    place.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(chunk(*part) for part in parts))


def packed_tiff(place, values, bits):
    """Writes a TIFF with samples of this many bits."""
    rows = packed(values, bits)
    height, width = values.shape[1:]
    data = bytearray(b"II*\0\0\0\0\0")
    link = 4
    for page in rows:
        start = len(data)
        data += page.tobytes()
        data += b"\0" * (len(data) % 2)
        tags = [(256, width), (257, height), (258, bits), (259, 1), (262, 1), (273, start), (277, 1), (278, height), (279, page.size)]
        data[link : link + 4] = struct.pack("<I", len(data))
        data += struct.pack("<H", len(tags)) + b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in tags)
        link = len(data)
        data += b"\0\0\0\0"
    place.write_bytes(data)


def ome_tiff(place, pages, order="XYCZT", along="T", **attributes):
    """Writes the masks so that plane k, along this dimension, is page `pages[k]`."""
    sizes = "".join(f' Size{axis}="{4 if axis == along else 1}"' for axis in "CZT")
    planes = "".join(
        f'<TiffData First{along}="{plane}" IFD="{page}" PlaneCount="1"/>' for plane, page in enumerate(pages)
    )
    text = (
        '<?xml version="1.0" encoding="UTF-8"?><OME xmlns="http://www.openmicroscopy.org/Schemas/OME/2016-06">'
        f'<Image ID="Image:0"><Pixels ID="Pixels:0" DimensionOrder="{order}" Type="uint8" SizeX="64" SizeY="48"{sizes}>'
        f"{attributes.get('planes', planes)}</Pixels></Image>{attributes.get('more', '')}</OME>"
    )
    stored = np.empty_like(EIGHT)
    stored[pages] = EIGHT
    tifffile.imwrite(place, stored, photometric="minisblack", description=text, metadata=None)


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
    # Integers that are all 0 or 1 mean closed and open.
    for code in ["?", "u1", "<u2", "<i2", ">i4", "<i8", "u8", "i1", "<f2", ">f4"]:
        np.save(path(row, "a.npy"), MASKS.astype(code))
    np.save(path(row, "a.npy", axes="row-column-frame"), np.moveaxis(MASKS, 0, -1).astype("f4"))
    np.save(path(row, "a.npy", axes="column-row-frame"), MASKS.T.astype("f4"))
    snapshots = {"measurement": True, "full_scale": 250}
    np.save(path(row, "a.npy", **snapshots), SNAPSHOTS.astype("<u2"))
    # The masks have 48x64 pixels, so only one order fits.
    np.save(path(row, "a.npy", read_axes="row-column-frame", **snapshots), np.moveaxis(SNAPSHOTS, 0, -1).astype("u1"))
    np.save(path(row, "a.npy", read_axes="column-row-frame", **snapshots), SNAPSHOTS.T.astype("u1"))
    row = "12-bit packed pixels, with `packing`"
    for packing in ["mono12p", "mono12packed"]:
        masks = camera(MASKS * 4095, packing)
        np.save(path(row, "a.npy", packing=packing, read_axes="frame-row-column"), masks)
        tifffile.imwrite(path(row, "a.tif", packing=packing), masks, photometric="minisblack")
        shots = camera(SNAPSHOTS, packing)
        np.save(path(row, "a.npy", packing=packing, read_axes="frame-row-column", **snapshots), shots)
        path(row, "a.raw", packing=packing, **snapshots).write_bytes(shots.tobytes())
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
    for code in ["<u4", "<i2", ">i4", "i1", "<f2"]:
        tifffile.imwrite(path(row, "a.tif"), MASKS.astype(code), photometric="minisblack")
    tifffile.imwrite(path(row, "a.tif", **snapshots), SNAPSHOTS.astype("<u4"), photometric="minisblack")
    for compression in ["zlib", "lzw"]:
        tifffile.imwrite(path(row, "a.tif"), MASKS.astype("f4"), photometric="minisblack", compression=compression, predictor=3)
        tifffile.imwrite(path(row, "a.tif"), EIGHT, photometric="minisblack", compression=compression, predictor=2, tile=(32, 32))
    for file in [path(row, "a.tif"), path(row, "a.tif")]:
        page = EIGHT if len(index) % 2 else (MASKS * 65535).astype("<u2")
        # Bits in reverse order, as some scanners store them.
        tifffile.imwrite(file, page.view("u1").reshape(4, 48, -1) if page.itemsize == 1 else page, photometric="minisblack", **TAG)
        retag(file, 266, 2, lambda data: REVERSED[data])
    tifffile.imwrite(path(row, "a.tif"), MASKS.astype(bool), photometric="minisblack", **TAG)
    retag(FOLDER / index[-1]["file"], 266, 2, lambda data: REVERSED[data])
    for bits in [2, 4, 10, 12, 14]:
        packed_tiff(path(row, "a.tif"), MASKS * (2**bits - 1), bits)
    # A palette of greys in proportion to the stored numbers.
    ramp = np.repeat((np.arange(256) * 257).astype("u2")[None], 3, axis=0)
    tifffile.imwrite(path(row, "a.tif"), EIGHT, photometric="palette", colormap=ramp)
    # A smaller copy of the first page, as microscopes add it.
    with tifffile.TiffWriter(path(row, "a.tif")) as file:
        for frame in EIGHT:
            file.write(frame, photometric="minisblack", contiguous=False)
            file.write(frame[::4, ::4], photometric="minisblack", subfiletype=1)
    with tifffile.TiffWriter(path(row, "a.tif")) as file:
        for frame in EIGHT:
            file.write(frame, photometric="minisblack", subifds=1, contiguous=False)
            file.write(frame[::2, ::2], photometric="minisblack", subfiletype=1)
    row = "OME-TIFF"
    for order, sizes in [("XYCZT", "TZC"), ("XYZTC", "ZTC"), ("XYTCZ", "ZTC")]:
        ome_tiff(path(row, "a.tif"), list(range(4)), order, sizes[0])
        ome_tiff(path(row, "a.tif"), [3, 2, 1, 0], order, sizes[1])
        ome_tiff(path(row, "a.tif"), [2, 0, 3, 1], order, sizes[2])
    row = "ImageJ stack, also above 4 GB"
    tifffile.imwrite(path(row, "a.tif"), EIGHT, photometric="minisblack", truncate=True)
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
    beside = [(name, b"") for name in ["README.txt", "Thumbs.db", "desktop.ini", "scan.xml"]]
    zipped(path(row, "a.zip"), [*beside, *[(f"img{k + 8}.png", png(frame)) for k, frame in enumerate(EIGHT)]])
    timed = [(f"shot{k + 8}_{250 * k}ms.png", png(frame)) for k, frame in enumerate(EIGHT)]
    zipped(path(row, "a.zip"), timed[::-1])
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
    scipy.io.savemat(path(row, "a.mat", name="y", measurement=True), {"y": (meas / 250).astype("f4")})
    scipy.io.savemat(path(row, "a.mat", name="C"), {"C": (mask * 255).astype("u1")})
    # At most 64 masks are allowed, and no sensor has 4 rows, so the frames must come first.
    scipy.io.savemat(path(row, "a.mat", read_axes="frame-row-column"), {"mask": MASKS.astype("u1")})
    row = "`.mat` level 7.3 (`save -v7.3`)"
    matlab73(path(row, "a.mat"), mask=(mask.astype("u1"), "logical"), meas=(meas.astype("f8"), "double"))
    matlab73(path(row, "a.mat", measurement=True, full_scale=250), meas=(meas.astype("u2"), "uint16"))
    matlab73(path(row, "a.mat", name="y", measurement=True), y=(meas / 250, "double"))
    matlab73(path(row, "a.mat", axes="frame-row-column"), mask=(MASKS.astype("f4"), "single"))
    row = "HDF5"
    with h5py.File(path(row, "a.h5"), "w") as file:
        file["mask"] = MASKS.astype(bool)
    with h5py.File(path(row, "a.h5"), "w", libver="latest") as file:
        file.create_dataset("mask", data=MASKS.astype(">f4"), chunks=(1, 48, 64), compression="gzip", shuffle=True)
    with h5py.File(path(row, "a.h5", name="run/masks", axes="row-column-frame"), "w") as file:
        file.create_dataset("run/masks", data=mask.astype("<i4"), chunks=(16, 16, 2), fletcher32=True)
    for arguments in [
        {"compression": "lzf"},
        {"compression": "lzf", "shuffle": True, "fletcher32": True},
        {"compression": "szip"},
        {"scaleoffset": 0},
        hdf5plugin.LZ4(),
        {**hdf5plugin.LZ4(nbytes=1024), "shuffle": True},
    ]:
        with h5py.File(path(row, "a.h5"), "w") as file:
            file.create_dataset("mask", data=MASKS.astype("<u2"), chunks=(1, 48, 64), **arguments)
    for size in [512, 1024, 65536]:
        place = path(row, "a.h5")
        with h5py.File(place, "w", userblock_size=size) as file:
            file["mask"] = MASKS.astype("f4")
        with place.open("r+b") as file:
            file.write(b"a text in the user block")
    row = "HDF5 of Octave (`save -hdf5`)"
    octave(path(row, "a.h5", read_axes="row-column-frame"), "mask", mask.astype("f8"), "matrix")
    octave(path(row, "a.h5", name="shots", read_axes="row-column-frame"), "shots", mask.astype("u1"), "bool matrix")
    octave(path(row, "a.h5", name="shots/value", read_axes="row-column-frame"), "shots", mask.astype("i4"), "int32 matrix")
    octave(path(row, "a.h5", read_axes="row-column-frame", **snapshots), "meas", meas.astype("<u2"), "uint16 matrix")
    row = "HDF5"
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
    for mode in ["LA", "RGBA"]:
        Image.fromarray(colours).convert(mode).save(path(row, "in.png", frames=1))
    for channels in [2, 3, 4]:
        sixteen = np.repeat((MASKS[0] * 65535).astype("u2")[..., None], channels, axis=2)
        path(row, "in.png", frames=1).write_bytes(imagecodecs.png_encode(sixteen))
    for bits in [2, 4]:
        grey_png(path(row, "in.png", frames=1), MASKS[0] * (2**bits - 1), bits)
    Image.fromarray(EIGHT[0]).quantize(2).save(path(row, "in.png", frames=1))
    row = "animated PNG"
    pages = [Image.fromarray(frame) for frame in EIGHT]
    pages[0].save(path(row, "in.png"), save_all=True, append_images=pages[1:])
    sixteen = [Image.fromarray((frame * 65535).astype("u2")) for frame in MASKS]
    sixteen[0].save(path(row, "in.png"), save_all=True, append_images=sixteen[1:])
    row = "colour TIFF"
    tifffile.imwrite(path(row, "in.tif", frames=1), colours, photometric="rgb")
    four = np.repeat(EIGHT[..., None], 3, axis=3)
    tifffile.imwrite(path(row, "in.tif"), (four / 255).astype("f4"), photometric="rgb")
    tifffile.imwrite(path(row, "in.tif"), four.astype("<u2") * 257, photometric="rgb", compression="zlib")
    opaque = np.concatenate([four, np.full_like(four[..., :1], 255)], axis=3)
    tifffile.imwrite(path(row, "in.tif"), opaque, photometric="rgb", extrasamples=["unassalpha"])
    row = "colour TIFF in separate planes"
    tifffile.imwrite(path(row, "in.tif"), np.moveaxis(four, -1, 1).astype("<u2") * 257, photometric="rgb", planarconfig="separate")
    row = "TIFF with grey and transparency"
    tifffile.imwrite(path(row, "in.tif"), opaque[..., 2:], photometric="minisblack", extrasamples=["unassalpha"])
    tifffile.imwrite(path(row, "in.tif"), (opaque[..., 2:] / 255).astype("f4"), photometric="minisblack", extrasamples=["assocalpha"])
    row = "TIFF with grey and transparency in separate planes"
    planes = np.moveaxis(opaque[..., 2:], -1, 1)
    tifffile.imwrite(path(row, "in.tif"), planes, photometric="minisblack", planarconfig="separate", extrasamples=["unassalpha"])
    row = "TIFF with all frames in the samples of a pixel"
    samples = np.moveaxis(MASKS, 0, -1).astype("f4")
    tifffile.imwrite(path(row, "in.tif"), samples, photometric="minisblack", planarconfig="contig")
    row = "TIFF with all frames as planes of a page"
    tifffile.imwrite(path(row, "in.tif"), MASKS.astype("f4"), photometric="minisblack", planarconfig="separate")
    row = "TIFF with a palette of colours"
    palette = np.random.default_rng(2).integers(0, 65536, (3, 256)).astype("u2")
    palette[:, 7], palette[:, 9] = 0, 65535
    tifffile.imwrite(path(row, "in.tif"), np.where(MASKS > 0, 9, 7).astype("u1"), photometric="palette", colormap=palette)
    row = "TIFF with a palette for display only"
    palette[:, 7], palette[:, 9] = 100, 200
    tifffile.imwrite(path(row, "in.tif"), EIGHT, photometric="palette", colormap=palette)
    row = "CMYK TIFF"
    Image.fromarray(colours).convert("CMYK").save(path(row, "in.tif", frames=1))
    row = "TIFF with another sample type"
    packed_tiff(path(row, "in.tif", full_scale=2**24 - 1), MASKS * (2**24 - 1), 24)
    row = "TIFF with samples of an undefined type"
    tifffile.imwrite(path(row, "in.tif"), (MASKS * 65535).astype("<u2"), photometric="minisblack", **TAG)
    retag(FOLDER / index[-1]["file"], 339, 4)
    row = "TIFF in which 0 is white"
    tifffile.imwrite(path(row, "in.tif"), 255 - EIGHT, photometric="miniswhite")
    tifffile.imwrite(path(row, "in.tif"), 65535 - (MASKS * 65535).astype("<u2"), photometric="miniswhite")
    tifffile.imwrite(path(row, "in.tif"), MASKS == 0, photometric="miniswhite")
    row = "TIFF of floats in which 0 is white"
    tifffile.imwrite(path(row, "in.tif"), MASKS.astype("f4"), photometric="miniswhite")
    row = "TIFF with another compression"
    for compression in ["zstd", "lzma", "png", "jpeg2000", "lerc"]:
        arguments = {"compressionargs": {"level": 0}} if compression == "jpeg2000" else {}
        tifffile.imwrite(path(row, "in.tif"), EIGHT, photometric="minisblack", compression=compression, **arguments)
    pages[0].convert("1").save(path(row, "in.tif"), save_all=True, append_images=[page.convert("1") for page in pages[1:]], compression="group4")
    row = "TIFF that turns or mirrors its pictures"
    tifffile.imwrite(path(row, "in.tif"), EIGHT, photometric="minisblack", extratags=[(274, 3, 1, 3, True)])
    row = "TIFF with a predictor but no compression"
    tifffile.imwrite(path(row, "in.tif"), EIGHT, photometric="minisblack", **TAG)
    retag(FOLDER / index[-1]["file"], 317, 2)
    row = "TIFF with its frames in sub-images"
    with tifffile.TiffWriter(path(row, "in.tif")) as file:
        file.write(EIGHT[0, ::4, ::4], photometric="minisblack", subifds=4, subfiletype=1)
        for frame in EIGHT:
            file.write(frame, photometric="minisblack", contiguous=False)
    row = "ImageJ stack with converted numbers"
    converted = {"c0": -32768.0, "c1": 1.0, "cf": 0}
    tifffile.imwrite(path(row, "in.tif"), (MASKS + 32768).astype("u2"), imagej=True, metadata=converted)
    row = "OME-TIFF of several images"
    sizes = 'DimensionOrder="XYCZT" Type="uint8" SizeX="64" SizeY="48" SizeC="1" SizeZ="1" SizeT="1"'
    more = f'<Image ID="Image:1"><Pixels ID="Pixels:1" {sizes}><TiffData IFD="0" PlaneCount="1"/></Pixels></Image>'
    ome_tiff(path(row, "in.tif"), [0, 1, 2, 3], more=more)
    row = "OME-TIFF whose description does not fit its pages"
    ome_tiff(path(row, "in.tif"), [0, 1, 2, 3], planes='<TiffData IFD="0" PlaneCount="3"/>')
    ome_tiff(path(row, "in.tif"), [0, 1, 2, 3], planes='<TiffData IFD="2" PlaneCount="4"/>')
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
    row = "PNM"
    for frame in [EIGHT[0], np.stack([EIGHT[0]] * 3, -1), (MASKS[0] * 65535).astype("u2")]:
        Image.fromarray(frame).save(path(row, "in.pgm", frames=1), "ppm")
    row = "JPEG 2000"
    for codec in ["jp2", "j2k"]:
        data = imagecodecs.jpeg2k_encode((MASKS[0] * 65535).astype("u2"), level=0, codecformat=codec)
        path(row, "in.jp2", frames=1).write_bytes(data)
    row = "gzip"
    place = path(row, "in.gz")
    with gzip.open(place, "wb") as file:
        np.save(file, MASKS.astype("f4"))
    row = "ZIP with missing numbers or other files"
    # In natural order these are 1, 2, 10, 11; as texts 1, 10, 11, 2.
    some = [(f"shot_{k}.png", png(frame)) for k, frame in zip([1, 2, 10, 11], EIGHT)]
    zipped(path(row, "in.zip"), some)
    numbered = [(f"shot_{k + 8}.png", png(frame)) for k, frame in enumerate(EIGHT)]
    zipped(path(row, "in.zip"), [*numbered, ("overview.jpg", b"picture"), ("__MACOSX/._shot_8.png", b"")])
    tiffs = []
    for k, frame in zip([1, 2, 10, 11], MASKS):
        file = io.BytesIO()
        tifffile.imwrite(file, (frame * 65535).astype("u2"), photometric="minisblack")
        tiffs.append((f"run/{k}.TIF", file.getvalue()))
    zipped(path(row, "in.zip"), tiffs)
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
    # Lines of Python have the name of the array that was asked for.
    for name in [None, "shots"]:
        write_arrays(name or "mask", {"name": name} if name else {})
    row = "HDF5 whose array is in a group"
    with h5py.File(path(row, "in.h5", reason="missing_array", again={"name": "exchange/data"}), "w") as file:
        file["exchange/data"], file["exchange/dark"] = MASKS.astype("f4"), MASKS[:1]
    row = "`.mat` 7.3 with a struct"
    with level73(path(row, "in.mat", reason="missing_array", again={"name": "mask/data"})) as file:
        file.create_dataset("mask/data", data=np.moveaxis(MASKS, 0, -1).T).attrs["MATLAB_class"] = np.bytes_("double")
        file["mask/exposure"] = np.ones((1, 1))
        file["mask"].attrs["MATLAB_class"] = np.bytes_("struct")
    row = "integers without a stated full scale"
    np.save(path(row, "in.npy", measurement=True, reason="invalid_full_scale", again={"full_scale": 250}), SNAPSHOTS.astype("<i4"))


def write_arrays(name, asked):
    """Writes files whose array has this name."""
    mask = np.moveaxis(MASKS, 0, -1).astype("f8")
    row = "`.mat` with a sparse matrix"
    scipy.io.savemat(path(row, "in.mat", frames=1, **asked), {name: scipy.sparse.csc_matrix(MASKS[0].astype("f8"))})
    row = "`.mat` with complex numbers"
    scipy.io.savemat(path(row, "in.mat", **asked), {name: mask.astype("c16")})
    scipy.io.savemat(path(row, "in.mat", frames=1, **asked), {name: MASKS[0].astype("c8")})
    row = "`.mat` with a cell array"
    cells = np.empty((1, 4), object)
    cells[0] = [frame.astype("f8") for frame in MASKS]
    scipy.io.savemat(path(row, "in.mat", **asked), {name: cells})
    row = "`.mat` with a struct"
    scipy.io.savemat(path(row, "in.mat", **asked), {name: {"data": mask, "date": "today"}})
    scipy.io.savemat(path(row, "in.mat", frames=1, **asked), {name: {"date": "today", "data": MASKS[0].astype("f8")}})
    row = "`.mat` with more than three axes"
    scipy.io.savemat(path(row, "in.mat", **asked), {name: mask.reshape(48, 64, 2, 2, order="F")})
    scipy.io.savemat(path(row, "in.mat", **asked), {name: mask[:, :, None]})
    row = "`.mat` 7.3 with a cell array"
    with level73(path(row, "in.mat", **asked)) as file:
        cells = [file.create_dataset(f"#refs#/{k}", data=frame.astype("f8").T).ref for k, frame in enumerate(MASKS)]
        dataset = file.create_dataset(name, data=np.array(cells, h5py.ref_dtype).reshape(4, 1))
        dataset.attrs["MATLAB_class"] = np.bytes_("cell")
    row = "`.mat` 7.3 with more than three axes"
    matlab73(path(row, "in.mat", **asked), **{name: (mask.reshape(48, 64, 2, 2, order="F"), "double")})
    row = "HDF5 with more than three axes"
    with h5py.File(path(row, "in.h5", **asked), "w") as file:
        file[name] = MASKS.reshape(2, 2, 48, 64)
    row = "`.mat` level 4 (`save -v4`)"
    scipy.io.savemat(path(row, "in.mat", frames=1, **asked), {name: MASKS[0].astype("f8")}, format="4")
    row = "HDF5 with another filter (Blosc, bitshuffle, Zstandard)"
    for plugin in [hdf5plugin.Blosc(), hdf5plugin.Bitshuffle(), hdf5plugin.Zstd()]:
        with h5py.File(path(row, "in.h5", **asked), "w") as file:
            file.create_dataset(name, data=MASKS, chunks=(1, 48, 64), **plugin)
    row = "HDF5 with records or complex numbers"
    with h5py.File(path(row, "in.h5", **asked), "w") as file:
        file[name] = MASKS.astype("c8")


accepted()
refused()
np.save(FOLDER / "masks.npy", MASKS.astype("f4"))
np.save(FOLDER / "snapshots.npy", (SNAPSHOTS / np.float32(250)).astype("f4"))
(FOLDER / "index.json").write_text(json.dumps(index))
