"""Reads and writes pictures with Pillow.

Usage: pictures.py read FOLDER compares picture.webp and picture.jpeg with picture.png, and prints JSON. pictures.py write
FOLDER writes the frames of truth.npy as 8-bit values: truth8.npy, jpg.zip, bmp.zip, pgm.zip, and the first as frame.jpg.
"""

import io
import json
import pathlib
import sys
import zipfile

import numpy as np
from PIL import Image


def read(folder):
    report = {}
    reference = np.asarray(Image.open(folder / "picture.png"), "f4")
    for kind in ("png", "webp", "jpeg"):
        picture = Image.open(folder / f"picture.{kind}")
        grey = np.asarray(picture.convert("L"), "f4")
        report[kind] = [picture.format, *picture.size, picture.mode, float(abs(grey - reference).max())]
    print(json.dumps(report))


def write(folder):
    levels = (np.load(folder / "truth.npy") * 255).round().astype("u1")
    np.save(folder / "truth8.npy", levels)
    for kind, options in (("jpg", {"format": "jpeg", "quality": 95}), ("bmp", {"format": "bmp"}), ("pgm", {"format": "ppm"})):
        with zipfile.ZipFile(folder / f"{kind}.zip", "w") as archive:
            for k, frame in enumerate(levels):
                file = io.BytesIO()
                Image.fromarray(frame).save(file, **options)
                archive.writestr(f"frame_{k}.{kind}", file.getvalue())
    Image.fromarray(levels[0]).save(folder / "frame.jpg")


{"read": read, "write": write}[sys.argv[1]](pathlib.Path(sys.argv[2]))
