"""Reads a result folder with the official OpenEXR package and compares it bit for bit.

Usage: read_exr.py FOLDER [--attribute NAME]... [--sigma FILE]

FOLDER holds frames.npy (float32, [frame, row, column], or [frame, row, column, 3] in colour),
frames/frame_0001.exr and so on, and stack.exr with one part per frame. Every EXR part must have the float32
channel Y, or R, G and B, with the bits of its frame. With --attribute, every part must have that string
attribute, not empty. With --sigma, FILE must be the same stack with the additional channel sigma.Y, which has
the values of error.npy ([frame, row, column] of blocks of 16x16 pixels).

Prints one line. Exits with 1 on any difference.

Needs the PyPI packages OpenEXR (3.5) and numpy.
"""

import argparse
import pathlib
import sys

import numpy
import OpenEXR


def differences(part, expected, attributes, where, sigma=None):
    """Differences of one part."""
    names = ["Y"] if expected.ndim == 2 else ["R", "G", "B"]
    layer = [] if sigma is None else ["sigma.Y"]
    if sorted(part.channels) != sorted(names + layer):
        yield f"{where}: channels {list(part.channels)}, expected {names + layer}"
        return
    channels = [part.channels[name].pixels for name in names]
    yield from unequal(channels[0] if expected.ndim == 2 else numpy.stack(channels, axis=-1), expected, where)
    if sigma is not None:
        yield from unequal(part.channels["sigma.Y"].pixels, sigma, f"{where} sigma")
    for name in attributes:
        value = part.header.get(name)
        if not isinstance(value, str) or not value:
            yield f"{where}: attribute {name} is {value!r}"


def unequal(pixels, expected, where):
    """Differences of the values of a part."""
    if pixels.dtype != numpy.float32 or pixels.shape != expected.shape:
        yield f"{where}: {pixels.dtype} {pixels.shape}, expected float32 {expected.shape}"
    elif not numpy.array_equal(pixels.view(numpy.uint32), expected.view(numpy.uint32)):
        wrong = numpy.count_nonzero(pixels.view(numpy.uint32) != expected.view(numpy.uint32))
        yield f"{where}: {wrong} of {expected.size} values differ"


def judge(folder, attributes, sigma=None):
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
    found.extend(stack_differences(folder / "stack.exr", names, frames, attributes))
    if sigma is not None:
        errors = numpy.load(folder / "error.npy").repeat(16, axis=1).repeat(16, axis=2)
        errors = numpy.ascontiguousarray(errors[:, : frames.shape[1], : frames.shape[2]])
        found.extend(stack_differences(sigma, names, frames, attributes, errors))
    return found, len(frames)


def stack_differences(path, names, frames, attributes, sigma=None):
    """All differences between a stack and its frames."""
    parts = OpenEXR.File(str(path), separate_channels=True).parts
    if [part.header.get("name") for part in parts] != names:
        yield f"{path.name}: parts {[part.header.get('name') for part in parts]}"
        return
    for k, (name, part, frame) in enumerate(zip(names, parts, frames)):
        layer = None if sigma is None else sigma[k]
        yield from differences(part, frame, attributes, f"{path.name} {name}", layer)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=pathlib.Path)
    parser.add_argument("--attribute", action="append", default=[])
    parser.add_argument("--sigma", type=pathlib.Path)
    arguments = parser.parse_args()
    found, frames = judge(arguments.folder, arguments.attribute, arguments.sigma)
    for difference in found:
        print(difference)
    verdict = "equal" if not found else f"{len(found)} differences"
    print(f"{frames} frames, each as a file and as a part of the stack: {verdict}")
    sys.exit(1 if found else 0)


if __name__ == "__main__":
    main()
