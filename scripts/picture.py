"""Joins images side by side in one grey PNG, such as the image of the README.

Usage: picture.py OUT.png FRAME FILE.npy [FILE.npy ...]

Each file holds float32, [H,W] or [frames,H,W]; frame FRAME (from 0) is shown. Values from 0 to 1 become black
to white; a measurement, which exceeds 1, is divided by its largest value. The README's image shows the demo
clip, computed without a server:

    sci-recon simulate --frames demo/clip --compression-ratio 8 --seed 1 --out sim
    for algorithm in gap-tv pnp-tv-fastdvdnet; do
        sci-recon reconstruct --masks sim/masks.npy --measurement sim/measurement.npy \\
            --algorithm $algorithm --out $algorithm
    done
    python3 scripts/picture.py docs/demo.png 4 sim/measurement.npy gap-tv/frames.npy \\
        pnp-tv-fastdvdnet/frames.npy sim/truth.npy
"""

import array
import ast
import struct
import sys
import zlib

GAP = 8  # white pixels between two images


def read(path, frame):
    """The rows of one image on [0,1]."""
    with open(path, "rb") as file:
        data = file.read()
    (length,) = struct.unpack_from("<H", data, 8)
    header = ast.literal_eval(data[10 : 10 + length].decode())
    if header["descr"] != "<f4" or header["fortran_order"]:
        sys.exit(f"{path}: little-endian float32 in C order is wanted")
    values = array.array("f", data[10 + length :])
    *frames, height, width = header["shape"]
    if frames:
        values = values[frame * height * width : (frame + 1) * height * width]
    top = max(1.0, max(values))
    scale = 255 / top if not frames else 255
    grey = bytes(min(255, max(0, round(value * scale))) for value in values)
    return [grey[row * width : (row + 1) * width] for row in range(height)]


def chunk(kind, body):
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def main():
    out, frame, *paths = sys.argv[1:]
    images = [read(path, int(frame)) for path in paths]
    rows = [(b"\xff" * GAP).join(parts) for parts in zip(*images, strict=True)]
    size = struct.pack(">IIBBBBB", len(rows[0]), len(rows), 8, 0, 0, 0, 0)
    # Filter 1 (the difference from the left neighbour) for every row.
    filtered = b"".join(
        b"\x01" + bytes((b - a) & 255 for a, b in zip(b"\x00" + row, row)) for row in rows
    )
    with open(out, "wb") as file:
        file.write(b"\x89PNG\r\n\x1a\n")
        for kind, body in [(b"IHDR", size), (b"IDAT", zlib.compress(filtered, 9)), (b"IEND", b"")]:
            file.write(chunk(kind, body))


main()
