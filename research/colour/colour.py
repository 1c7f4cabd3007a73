"""Quality of frames behind a Bayer mosaic, compared with the same scenes in grey.

usage: colour.py PROGRAM FOLDER

Photographs from scikit-image (astronaut, coffee, chelsea) are panned by 3.3 columns and 1.7 rows per frame: clips of 8
frames of 256x256 pixels, in colour and in grey (mean of the three channels). Both are measured through random-squares
masks and through independent ones, and reconstructed by gap-tv and by the default. Behind a mosaic each colour is
reconstructed at half the size, so the grey clip is also reconstructed from every second pixel of every second row.
Prints a table of PSNR in dB; in colour it covers all samples of red, green and blue.

Needs the PyPI packages scikit-image and scipy.
"""

import json
import pathlib
import subprocess
import sys

import numpy
import skimage.data
from scipy.ndimage import shift

SIDE, FRAMES = 256, 8
ALGORITHMS = ["gap-tv", "pnp-tv-fastdvdnet"]


def clip(name):
    """A panned photograph [frame, row, column, 3], uint8."""
    photograph = getattr(skimage.data, name)()[..., :3].astype(float)
    row, column = ((side - SIDE) // 2 for side in photograph.shape[:2])
    frames = []
    for frame in range(FRAMES):
        moved = shift(photograph, (1.7 * (frame - FRAMES / 2), 3.3 * (frame - FRAMES / 2), 0), mode="mirror")
        frames.append(moved[row : row + SIDE, column : column + SIDE])
    return numpy.clip(numpy.stack(frames), 0, 255).round().astype(numpy.uint8)


def main():
    program, folder = sys.argv[1], pathlib.Path(sys.argv[2])
    folder.mkdir(parents=True, exist_ok=True)

    def run(*arguments):
        done = subprocess.run([program, *map(str, arguments)], check=True, capture_output=True, text=True)
        return done.stdout

    print("| clip | masks | grey: gap-tv | default | gain | grey at half size: gap-tv | default | gain | colour: gap-tv | default | gain |")
    print("|" + " --- |" * 11)
    for name in ["astronaut", "coffee", "chelsea"]:
        colours = clip(name)
        numpy.save(folder / "colours.npy", colours)
        grey = colours.mean(axis=-1).round().astype(numpy.uint8)
        numpy.save(folder / "grey.npy", grey)
        numpy.save(folder / "half.npy", grey[:, ::2, ::2])
        for pattern in ["random-squares", "iid"]:
            row = []
            for frames, mosaic in [("grey.npy", []), ("half.npy", []), ("colours.npy", ["--mosaic", "rggb"])]:
                made = folder / "sim"
                run("simulate", "--frames", folder / frames, *mosaic, "--compression-ratio", FRAMES, "--pattern", pattern,
                    "--seed", 1, "--out", made)
                files = [f"--{what}={made / what}.npy" for what in ["masks", "measurement", "truth"]]
                psnr = [json.loads(run("reconstruct", *files, *mosaic, "--algorithm", algorithm, "--json"))["psnr_unit_db"]
                        for algorithm in ALGORITHMS]
                row += [*psnr, psnr[1] - psnr[0]]
            print(f"| {name} | {pattern} | " + " | ".join(f"{value:.2f}" for value in row) + " |", flush=True)


main()
