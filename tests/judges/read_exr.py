"""Reads a result folder with the official OpenEXR package and compares it bit for bit.

usage: read_exr.py FOLDER [--attribute NAME]...

FOLDER holds frames.npy (float32, [frame, row, column], or of colours [frame, row, column, 3]),
frames/frame_0001.exr and so on, and stack.exr with one part a frame. Every EXR part must have the one
channel Y, or R, G and B, float32, with the bits of its frame. With --attribute every part must carry that string attribute, not empty.
Prints one line; exit status 1 on any difference.

Needs the PyPI packages OpenEXR (3.5) and numpy.
"""

import argparse
import pathlib
import sys

import numpy
import OpenEXR


def differences(part, expected, attributes, where):
    """Says what is wrong with one part."""
    names = ["Y"] if expected.ndim == 2 else ["R", "G", "B"]
    if sorted(part.channels) != sorted(names):
        yield f"{where}: channels {list(part.channels)}, expected {names}"
        return
    channels = [part.channels[name].pixels for name in names]
    pixels = channels[0] if expected.ndim == 2 else numpy.stack(channels, axis=-1)
    if pixels.dtype != numpy.float32 or pixels.shape != expected.shape:
        yield f"{where}: {pixels.dtype} {pixels.shape}, expected float32 {expected.shape}"
    elif not numpy.array_equal(pixels.view(numpy.uint32), expected.view(numpy.uint32)):
        wrong = numpy.count_nonzero(pixels.view(numpy.uint32) != expected.view(numpy.uint32))
        yield f"{where}: {wrong} of {expected.size} values differ"
    for name in attributes:
        value = part.header.get(name)
        if not isinstance(value, str) or not value:
            yield f"{where}: attribute {name} is {value!r}"


def judge(folder, attributes):
    """All differences between the EXR files of a folder and its frames.npy."""
    frames = numpy.ascontiguousarray(numpy.load(folder / "frames.npy"))
    if frames.dtype != numpy.float32 or frames.ndim not in (3, 4):
        return [f"frames.npy: {frames.dtype} {frames.shape}"], 0
    found = []
    names = [f"frame_{k + 1:04d}" for k in range(len(frames))]
    files = sorted(path.name for path in (folder / "frames").glob("*.exr"))
    if files != [f"{name}.exr" for name in names]:
        found.append(f"frames/: {files}")
        return found, len(frames)
    for name, frame in zip(names, frames):
        parts = OpenEXR.File(str(folder / "frames" / f"{name}.exr"), separate_channels=True).parts
        if len(parts) != 1:
            found.append(f"{name}.exr: {len(parts)} parts")
        found.extend(differences(parts[0], frame, attributes, f"{name}.exr"))
    stack = OpenEXR.File(str(folder / "stack.exr"), separate_channels=True).parts
    if [part.header.get("name") for part in stack] != names:
        found.append(f"stack.exr: parts {[part.header.get('name') for part in stack]}")
        return found, len(frames)
    for name, part, frame in zip(names, stack, frames):
        found.extend(differences(part, frame, attributes, f"stack.exr {name}"))
    return found, len(frames)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=pathlib.Path)
    parser.add_argument("--attribute", action="append", default=[])
    arguments = parser.parse_args()
    found, frames = judge(arguments.folder, arguments.attribute)
    for difference in found:
        print(difference)
    verdict = "equal" if not found else f"{len(found)} differences"
    print(f"{frames} frames, each as a file and as a part of the stack: {verdict}")
    sys.exit(1 if found else 0)


if __name__ == "__main__":
    main()
