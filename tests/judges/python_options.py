"""Compares the keywords of clients/python with the requests of the contract.

Usage: python_options.py CONTRACT, a JSON object with the names of the properties of each request.
"""

import inspect
import json
import sys

from sci_recon import Client
from sci_recon.__main__ import options, parser

PREFIXED = {name: f"masks_{name}" for name in ["array", "axes", "crop", "frames", "packing", "full_scale", "name"]}


def keywords(method):
    return set(inspect.signature(method).parameters) - {"self", "key"}


def main():
    contract = {schema: set(names) for schema, names in json.loads(sys.argv[1]).items()}
    calibration = contract["CalibrationRequest"] - {"captures", "registration_of"}
    measurement = contract["MeasurementRequest"]
    # The measurement names the calibration.
    job = contract["JobRequest"] - {"calibration"}
    assert keywords(Client.calibrate) == calibration, keywords(Client.calibrate) ^ calibration
    assert keywords(Client.measure) == measurement, keywords(Client.measure) ^ measurement
    assert keywords(Client.submit) == job, keywords(Client.submit) ^ job
    of_masks = {PREFIXED.get(name, name) for name in calibration}
    expected = of_masks | measurement - {"calibration", "data"} | job | {"measurement", "folder"}
    assert keywords(Client.reconstruct) == expected, keywords(Client.reconstruct) ^ expected
    # So are the options of the hot folder.
    given = vars(parser().parse_args(["watch", "folder", "--masks", "masks.npy"]))
    assert not options(given) and expected - {"measurement"} <= set(given), expected - set(given)
    line = ["watch", "folder", "--masks=m", "--dark=a", "--dark=b", "--saturation=9", "--tile", "64", "8"]
    given = options(vars(parser().parse_args([*line, "--full-scale=4095", "--snapshots", "0", "3"])))
    tile = {"size": 64, "overlap": 8}
    assert given == {"dark": ["a", "b"], "saturation": 9, "full_scale": 4095.0, "tile": tile, "snapshots": (0, 3)}


main()
