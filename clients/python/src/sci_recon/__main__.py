"""`python -m sci_recon watch FOLDER --masks FILE`: a hot folder on any system."""

from __future__ import annotations

import argparse
import inspect
import json
import sys
from pathlib import Path
from typing import Any

from ._client import Client
from ._watch import FILES, Watch, submitter

# Keywords of `Client.reconstruct` that are not options of the command.
OTHERS = {"self", "masks", "measurement", "folder", "key"}
TYPES = {"float": float, "int": int}


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
        elif name == "schedule":
            watch.add_argument(option, type=lambda path: json.loads(Path(path).read_text("utf-8")), metavar="FILE")
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
    """Returns the exit status: 1 if files failed, 3 if the checks found errors, as `sci-recon watch-folder` does."""
    arguments = parser().parse_args(line)
    with Client(arguments.url, arguments.token) as client:
        submit = submitter(client, arguments.masks, options(vars(arguments)))
        own = [arguments.masks, *(arguments.dark or [])]
        files = arguments.file or FILES
        watch = Watch(client, arguments.folder, submit, files=files, own=own, settle_seconds=arguments.settle_seconds)
        watch.run(arguments.once)
    if watch.failed:
        print(f"{watch.failed} files have failed; see their .failed.txt", file=sys.stderr)
        return 1
    return 3 if watch.doubtful else 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except KeyboardInterrupt:
        pass
