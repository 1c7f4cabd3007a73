"""`python -m sci_recon watch FOLDER --masks FILE`: a hot folder on any system."""

from __future__ import annotations

import argparse
import inspect
import io
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ._client import Client
from ._errors import SciReconError
from ._watch import FILES, Watch, submitter

# Keywords of `Client.reconstruct` that are not options of the command.
OTHERS = {"self", "masks", "measurement", "folder", "key"}
TYPES = {"float": float, "int": int}
# Options that name files which belong to every snapshot.
OWN = ("masks", "bad_pixels", "truth")


def whole_numbers(text: str, separator: str, form: str) -> list[int]:
    """Whole numbers from 0, one for each name of the form."""
    parts = text.split(separator)
    if len(parts) != form.count(separator) + 1 or not all(part.strip().isdecimal() for part in parts):
        raise argparse.ArgumentTypeError(f"{text!r}; give {form} in whole numbers from 0")
    return [int(part) for part in parts]


def crop(text: str) -> dict[str, int]:
    values = whole_numbers(text, ",", "ROW,COLUMN,HEIGHT,WIDTH")
    return dict(zip(("row", "column", "height", "width"), values, strict=True))


def frames(text: str) -> tuple[int, int]:
    first, last = whole_numbers(text, "-", "FIRST-LAST")
    return first, last


def registration(text: str) -> str | dict[str, Any]:
    if text in ("auto", "off"):
        return text
    try:
        rows, columns, *more = [float(number) for number in text.split(",")]
        rotation, scale = [*more, *(0.0, 1.0)[len(more) :]]
    except ValueError:
        form = "off, auto, or ROWS,COLUMNS[,DEGREES[,SCALE]], such as 0.5,-1.2 for a shift in pixels"
        raise argparse.ArgumentTypeError(f"{text!r}; give {form}") from None
    return {"shift": (rows, columns), "rotation": rotation, "scale": scale}


def json_file(path: str) -> dict[str, Any]:
    try:
        value = json.loads(Path(path).read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise argparse.ArgumentTypeError(f"{path}: {error}") from None
    if not isinstance(value, dict):
        raise argparse.ArgumentTypeError(f"{path} has no JSON object")
    return value


# Parsers of the keywords that are no single text or number, with their placeholders and help.
PARSERS: dict[str, tuple[Callable[[str], Any], str, str]] = {
    "crop": (crop, "ROW,COLUMN,HEIGHT,WIDTH", "window of the snapshots"),
    "masks_crop": (crop, "ROW,COLUMN,HEIGHT,WIDTH", "window of the masks"),
    "masks_frames": (frames, "FIRST-LAST", "the masks to use, counted from 0"),
    "dispersion": (json_file, "FILE", "JSON with axis, offsets, wavelengths and mask of a spectral camera"),
    "schedule": (json_file, "FILE", "a schedule as JSON"),
    "registration": (registration, "WHICH", "off, auto, or ROWS,COLUMNS[,DEGREES[,SCALE]] of masks that have moved"),
}


def parser() -> argparse.ArgumentParser:
    """The parser of the command line. Its options include the keywords of `Client.reconstruct`."""
    program = argparse.ArgumentParser("python -m sci_recon", description=__doc__)
    watch = program.add_subparsers(dest="command", required=True).add_parser(
        "watch", help="turn each file that appears in a folder into a job"
    )
    watch.add_argument(
        "folder", help="folder to watch; the results of file NAME are saved in NAME.result, with a REPORT.txt"
    )
    watch.add_argument("--masks", required=True, metavar="FILE", help="masks [frame, row, column]")
    watch.add_argument("--url", help="address of the service; by default SCI_RECON_URL")
    watch.add_argument("--token", help="token of the lab; by default SCI_RECON_TOKEN")
    watch.add_argument("--file", action="append", metavar="NAME", help="result file to download; may be repeated")
    watch.add_argument(
        "--settle-seconds", type=float, default=3.0, help="seconds without a change before a file is submitted"
    )
    watch.add_argument("--once", action="store_true", help="exit when all files are processed")
    for name, parameter in inspect.signature(Client.reconstruct).parameters.items():
        option = "--" + name.replace("_", "-")
        if name == "dark":
            watch.add_argument(option, action="append", metavar="FILE", help="dark capture; may be repeated")
        elif name in PARSERS:
            parse, metavar, text = PARSERS[name]
            watch.add_argument(option, type=parse, metavar=metavar, help=text)
        elif name == "tile":
            watch.add_argument(option, type=int, nargs=2, metavar=("SIZE", "OVERLAP"), help="in pixels")
        elif name == "snapshots":
            watch.add_argument(option, type=int, nargs="+", metavar="N", help="one index, or the first and the last")
        elif name not in OTHERS:
            kind = str(parameter.annotation).split(" ")[0]
            watch.add_argument(option, type=TYPES.get(kind, str), help=f"keyword {name} of Client.reconstruct")
    return program


def options(arguments: dict[str, Any]) -> dict[str, Any]:
    """The keywords of `Client.reconstruct` that the command line states."""
    names = set(inspect.signature(Client.reconstruct).parameters) - OTHERS
    given = {name: value for name, value in arguments.items() if name in names and value is not None}
    if tile := given.get("tile"):
        given["tile"] = {"size": tile[0], "overlap": tile[1]}
    if snapshots := given.get("snapshots"):
        given["snapshots"] = snapshots[0] if len(snapshots) == 1 else tuple(snapshots)
    return given


def main(line: list[str] | None = None) -> int:
    """Returns the exit status: 1 if files failed, 3 if a verdict is bad, as `sci-recon watch-folder` does."""
    arguments = parser().parse_args(line)
    with Client(arguments.url, arguments.token) as client:
        submit = submitter(client, arguments.masks, options(vars(arguments)))
        own = [file for name in OWN if (file := getattr(arguments, name))] + (arguments.dark or [])
        files = arguments.file or FILES
        settle, packed = arguments.settle_seconds, arguments.packing is not None
        watch = Watch(client, arguments.folder, submit, files=files, own=own, settle_seconds=settle, packed=packed)
        watch.run(arguments.once)
    if watch.failed:
        print(f"{watch.failed} files have failed; see their .failed.txt", file=sys.stderr)
        return 1
    return 3 if watch.bad else 0


if __name__ == "__main__":
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            # Consoles with a legacy code page lack characters of names.
            stream.reconfigure(errors="backslashreplace")
    try:
        sys.exit(main())
    except KeyboardInterrupt:
        pass
    except (SciReconError, OSError) as error:
        sys.exit(f"sci_recon: {error}")
