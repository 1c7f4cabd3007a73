"""Compares the keywords of clients/python with the requests of the contract.

Usage: python_options.py CONTRACT, a JSON object with the names of the properties of each request.
"""

import contextlib
import inspect
import io
import json
import sys
import tempfile
from pathlib import Path

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
    objects()


def objects():
    """Options that are objects in the API are parsed, and others end with the form that is expected."""
    line = ["watch", "folder", "--masks=m"]
    with tempfile.TemporaryDirectory() as folder:
        bands, text = Path(folder) / "bands.json", Path(folder) / "text.json"
        bands.write_text('{"axis": "column", "offsets": [0, 2]}')
        text.write_text('"auto"')
        stated = ["--crop=1,2,30,40", "--masks-crop=5,6,30,40", "--masks-frames=2-9", f"--dispersion={bands}"]
        given = options(vars(parser().parse_args([*line, *stated, "--registration=0.5,-1.2,0.1"])))
        window = {"row": 1, "column": 2, "height": 30, "width": 40}
        moved = {"shift": (0.5, -1.2), "rotation": 0.1, "scale": 1.0}
        assert given == {
            "crop": window,
            "masks_crop": window | {"row": 5, "column": 6},
            "masks_frames": (2, 9),
            "dispersion": {"axis": "column", "offsets": [0, 2]},
            "registration": moved,
        }, given
        for words, parsed in {
            "auto": "auto",
            "off": "off",
            "-1,2": moved | {"shift": (-1.0, 2.0), "rotation": 0.0},
            "1,2,3,0.9": {"shift": (1.0, 2.0), "rotation": 3.0, "scale": 0.9},
        }.items():
            given = options(vars(parser().parse_args([*line, f"--registration={words}"])))
            assert given == {"registration": parsed}, given
        for wrong, form in {
            "--crop=1,2,30": "ROW,COLUMN,HEIGHT,WIDTH",
            "--masks-frames=3": "FIRST-LAST",
            "--registration=1": "ROWS,COLUMNS",
            "--registration=1,2,3,4,5": "ROWS,COLUMNS",
            f"--dispersion={text}": "no JSON object",
            "--schedule=nothing.json": "nothing.json",
        }.items():
            errors = io.StringIO()
            with contextlib.redirect_stderr(errors), contextlib.suppress(SystemExit):
                parser().parse_args([*line, wrong])
                raise AssertionError(f"{wrong} is accepted")
            assert form in errors.getvalue(), errors.getvalue()


main()
