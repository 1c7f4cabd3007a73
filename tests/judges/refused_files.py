"""Makes a file of each kind that is refused, into FOLDER: masks [4, 48, 64] and a picture of them."""

import pathlib
import sys

import numpy as np
import tifffile
from PIL import Image

folder = pathlib.Path(sys.argv[1])
masks = np.random.default_rng(1).integers(0, 2, (4, 48, 64)).astype("u1")
colours = np.repeat((masks[0] * 255)[..., None], 3, axis=2)
np.save(folder / "in.npy", np.moveaxis(masks.astype("f4"), 0, -1))
np.savez(folder / "in.npz", NAME=masks.astype("f4"))
Image.fromarray(colours).save(folder / "in.png")
tifffile.imwrite(folder / "in.tif", colours, photometric="rgb")
