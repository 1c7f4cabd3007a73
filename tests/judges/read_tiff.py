"""Opens TIFF files as libtiff and ImageJ do, and compares them with the frames [frame, row, column].

Usage: read_tiff.py FRAMES.npy STACK.tif, with Debian's packages libtiff-tools and imagej.
"""

import subprocess
import sys

import jpype
import numpy as np


def main():
    frames, path = np.load(sys.argv[1]), sys.argv[2]
    info = subprocess.run(["tiffinfo", path], capture_output=True, text=True, check=True)
    assert not info.stderr, info.stderr
    assert info.stdout.count("TIFF Directory") == len(frames), info.stdout
    assert info.stdout.count("ImageDescription") == 1, info.stdout
    jpype.startJVM("-Djava.awt.headless=true", classpath=["/usr/share/java/ij.jar"])
    image = jpype.JClass("ij.IJ").openImage(path)
    assert image is not None, "ImageJ does not open the file"
    stack = image.getStack()
    pages = [np.array(stack.getPixels(1 + k)).reshape(frames.shape[1:]) for k in range(stack.getSize())]
    assert (np.array(pages) == frames).all()


main()
