"""Sends each file of a folder of small inputs on which the service once failed, and checks what the service says.

Usage: shared_cases.py FOLDER, with the service in SCI_RECON_URL. The folder's README.md describes the files.
"""

import re
import subprocess
import sys
import tempfile
import warnings
from pathlib import Path

import numpy as np
import tifffile
from PIL import Image
from sci_recon import ApiError, Client

FOLDER = Path(sys.argv[1])
MASKS = np.load(FOLDER / "masks_12x64x64.npy")
# Files that are read without a conversion, with the masks that other programs read in them.
SAME = {
    "masks_12x64x64.npy": MASKS,
    "masks_img1_to_img12_and_readme.zip": MASKS,
    "masks_lz4_filter_32004.h5": MASKS,
    "masks_user_block_1024.h5": MASKS,
    "masks_1bit_fillorder2.tif": tifffile.imread(FOLDER / "masks_1bit_fillorder2.tif"),
    "ome_planes_stored_in_reverse.ome.tif": tifffile.imread(FOLDER / "ome_planes_stored_in_reverse.ome.tif") > 0,
}
# Files that are read, or refused with a line that converts them.
CONVERTED = ("masks_palette.tif", "masks_grey_alpha.tif")


def refusal(call, *arguments, **options):
    try:
        call(*arguments, **options)
    except ApiError as error:
        return str(error)
    raise AssertionError(f"{arguments} is accepted")


def convert(path, detail):
    """Runs the line of a refusal, and returns the file that it writes."""
    line = re.search(r'python -c "([^"]+)"', detail)
    assert line, f"{path.name} is refused without a line: {detail}"
    folder = Path(tempfile.mkdtemp(prefix="cases-"))
    # Lines name the file by its kind.
    name = re.search(r"['\"](in\.[a-z0-9]+)['\"]", line[1])
    (folder / (name[1] if name else path.name)).write_bytes(path.read_bytes())
    subprocess.run([sys.executable, "-c", line[1]], cwd=folder, check=True)
    return next(folder.glob("out.*"))


def codes(thing):
    return [finding["code"] for finding in thing.warnings]


def main():
    client = Client()
    checked = {"README.md", "truth_12x64x64.npy"}
    for name, masks in SAME.items():
        calibration = client.calibrate(FOLDER / name)
        assert np.array_equal(calibration.masks(), masks.astype("f4")), f"{name} is read wrongly"
        checked.add(name)
    for name in CONVERTED:
        try:
            calibration = client.calibrate(FOLDER / name)
        except ApiError as error:
            calibration = client.calibrate(convert(FOLDER / name, str(error)))
        assert np.array_equal(calibration.masks(), MASKS), f"{name} has other values"
        checked.add(name)
    grouped = FOLDER / "masks_in_group_exchange_data.h5"
    # The file has one array, which needs no name.
    assert np.array_equal(client.calibrate(grouped).masks(), MASKS)
    assert np.array_equal(client.calibrate(grouped, array="exchange/data").masks(), MASKS)
    checked.add(grouped.name)

    calibration = client.calibrate(FOLDER / "masks_12x64x64.npy")
    plain = client.measure(calibration, FOLDER / "meas_float.npy")
    assert not {"saturated", "bad_pixels"} & set(codes(plain)), codes(plain)
    colours = FOLDER / "meas_16bit_rgb_all_equal.png"
    out = convert(colours, refusal(client.measure, calibration, colours))
    values = np.load(out) if out.suffix == ".npy" else np.asarray(Image.open(out))
    expected = np.load(FOLDER / "meas_float.npy") / 12 * 65535
    assert np.abs(values.squeeze() - expected).max() <= 1, "the line keeps 16 bits"
    client.measure(calibration, out, full_scale=65535 / 12)
    clipped = FOLDER / "meas_12bit_clipped_at_4095_state_full_scale_1671.npy"
    saturated = client.measure(calibration, clipped, full_scale=1671)
    assert "saturated" in codes(saturated), codes(saturated)
    hot = client.measure(calibration, FOLDER / "meas_one_hot_pixel.npy")
    assert "bad_pixels" in codes(hot), codes(hot)
    other = client.calibrate(FOLDER / "ome_planes_stored_in_reverse.ome.tif")
    client.measure(other, FOLDER / "meas_12bit_packed.tif")
    # Pixels that are hot or saturated are left out: the frames have no trace of a hot one, and do not depend on the numbers
    # of saturated ones.
    values = np.load(clipped)
    louder = client.measure(
        calibration, np.where(values == 4095, 6000, values).astype("<u2"), full_scale=1671, saturation=4095
    )
    warnings.simplefilter("ignore")
    frames = [client.submit(one, "gap-tv").wait().result().frames for one in (plain, hot, saturated, louder)]
    truth = np.load(FOLDER / "truth_12x64x64.npy")
    errors = [np.sqrt(np.mean((one - truth) ** 2)) for one in frames]
    assert errors[1] < 1.1 * errors[0], errors
    assert np.abs(frames[2] - frames[3]).max() < 1e-4, np.abs(frames[2] - frames[3]).max()
    checked |= {"meas_float.npy", colours.name, clipped.name, "meas_one_hot_pixel.npy", "meas_12bit_packed.tif"}
    assert checked == {path.name for path in FOLDER.iterdir()}, checked ^ {path.name for path in FOLDER.iterdir()}


main()
