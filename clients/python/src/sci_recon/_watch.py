"""A watched folder on any operating system: each new file in the folder becomes a job.

The folder is listed every second. Its file `.sci-recon-watch.json` records the processed files. A file is identified by its
name, size and modification time. The idempotency keys of requests are derived from these and from the calibration, so that
each file becomes a single job even if the program is restarted. The key of the calibration is derived from its masks.
"""

from __future__ import annotations

import hashlib
import inspect
import json
import os
import time
import unicodedata
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from ._client import Client, Job, Result, describe_all
from ._errors import ApiError, JobFailed, SciReconError

ENDINGS = {".npy", ".npz", ".tif", ".tiff", ".png", ".zip", ".tar", ".mat", ".h5", ".hdf5"}
# Further endings of packed pixels without a header.
PACKED_ENDINGS = {".raw", ".bin"}
LEDGER = ".sci-recon-watch.json"
# Longest name of a file in bytes. File systems allow 255, and names of results are longer than that of the file.
MAX_NAME = 230
# The ledger of `sci-recon watch-folder`.
OTHER_LEDGER = ".sci-recon.ledger"
ENDED = {"succeeded", "failed", "cancelled"}
FILES = ("frames.npy", "stack.tif", "manifest.json")

# Submits a file with an idempotency key.
Submit = Callable[[Path, str], Job]


def digest(*parts: object) -> str:
    """An idempotency key that is derived from these parts."""
    return "watch-" + hashlib.sha256(" ".join(map(str, parts)).encode()).hexdigest()


def identity(path: Path) -> str:
    """Identifies a file and its present content. The text is empty for an empty file."""
    meta = path.stat()
    return f"{path.name} {meta.st_size} {meta.st_mtime_ns}" if meta.st_size else ""


class Watch:
    """Watches `folder`. `submit` creates a job from file NAME. Its result `files` and a REPORT.txt are saved in NAME.result.

    If the job fails, NAME.failed.txt has the reason. Files in `own`, such as masks, are not submitted. With `packed`, files
    of packed pixels without a header are submitted, too.
    """

    def __init__(
        self,
        client: Client,
        folder: str | os.PathLike[str],
        submit: Submit,
        *,
        files: Sequence[str] = FILES,
        own: Sequence[str | os.PathLike[str]] = (),
        settle_seconds: float = 3.0,
        packed: bool = False,
    ) -> None:
        self.client = client
        self.folder = Path(folder)
        self.submit = submit
        self.files = files
        self.endings = ENDINGS | PACKED_ENDINGS if packed else ENDINGS
        self.own = {Path(file).resolve() for file in own}
        self.settle_seconds = settle_seconds
        self.failed = 0
        self.bad = 0
        if (self.folder / OTHER_LEDGER).exists():
            raise SciReconError(
                f"{self.folder} is watched by `sci-recon watch-folder`: use one of both, or remove {OTHER_LEDGER}"
            )
        self.done = self._ledger()
        self.jobs: dict[str, tuple[Path, Job]] = {}
        # Names of skipped files that were reported.
        self.skipped: set[str] = set()
        # Files that may still change, with the time at which they were first listed.
        self.settling: dict[str, float] = {}

    def _ledger(self) -> dict[str, str]:
        """The processed files of earlier runs."""
        ledger = self.folder / LEDGER
        if not ledger.exists():
            return {}
        try:
            done: dict[str, str] = dict(json.loads(ledger.read_text("utf-8")))
        except (ValueError, TypeError) as error:
            raise SciReconError(
                f"{ledger} is damaged ({error}): remove it, and move files that have results out of the folder"
            ) from None
        return done

    def run(self, once: bool = False) -> None:
        """Watches until it is interrupted. With `once` it returns when all files are processed; `failed` and `bad` are
        the numbers of files that failed, and of those with a bad verdict."""
        while True:
            self.look()
            if once and not self.jobs and not self.settling:
                return
            time.sleep(min(1.0, max(self.settle_seconds, 0.05)))

    def look(self) -> None:
        """Submits files that no longer change, and downloads the results of finished jobs."""
        now, settling = time.monotonic(), {}
        for path in sorted(self.folder.iterdir(), key=lambda path: path.name):
            key = self._key(path)
            if key is None or key in self.done or key in self.jobs or path.resolve() in self.own:
                continue
            since = self.settling.get(key, now)
            if now - since < self.settle_seconds:
                settling[key] = since
                continue
            self._step(key, path, partial(self._submit, key, path))
        self.settling = settling
        for key, (path, job) in list(self.jobs.items()):
            self._step(key, path, partial(self._advance, key, path, job))

    def _step(self, key: str, path: Path, step: Callable[[], None]) -> None:
        """Runs a step for a file. If the service is busy or unreachable, the step is repeated at the next look."""
        try:
            step()
        except ApiError as error:
            if error.status in {401, 403}:
                raise
            if not error.retryable:
                self._fail(key, path, error)
        except SciReconError as error:
            print(f"waiting: {error}", flush=True)

    def _submit(self, key: str, path: Path) -> None:
        job = self.submit(path, key)
        self.jobs[key] = (path, job)
        print(f"{path.name} is job {job.id}", flush=True)

    def _key(self, path: Path) -> str | None:
        """The key of a file and its present content. Paths that are not files of snapshots have no key."""
        if (
            path.name.startswith(".")
            or path.suffix.lower() not in self.endings
            or path.is_symlink()
            or not path.is_file()
        ):
            return None
        trouble = self._trouble(path.name)
        if trouble is not None:
            if path.name not in self.skipped:
                self.skipped.add(path.name)
                shown = "".join(c if c.isprintable() else "\ufffd" for c in path.name)
                print(f"{shown} is skipped: {trouble}; rename the file", flush=True)
            return None
        try:
            text = identity(path)
        except FileNotFoundError:
            return None
        return digest(text) if text else None

    @staticmethod
    def _trouble(name: str) -> str | None:
        """The reason why a file of this name is never submitted."""
        try:
            size = len(name.encode())
        except UnicodeEncodeError:
            return "the name is not UTF-8"
        if any(unicodedata.category(character) == "Cc" for character in name):
            return "the name has control characters"
        return f"the name has more than {MAX_NAME} bytes" if size > MAX_NAME else None

    def _advance(self, key: str, path: Path, job: Job) -> None:
        if job.refresh().state not in ENDED:
            return
        if job.state != "succeeded":
            self._fail(key, path, JobFailed(job.record))
            return
        # The folder is renamed once it is complete.
        draft = path.with_name(f".{job.id}.part")
        result = Result(job, draft)
        for snapshot in result.snapshots:
            for name in self.files:
                result.download(name, snapshot)
        findings = describe_all(job.findings)
        lines = [f"{path.name}: {job.verdict}", "", *findings, "", f"job {job.id}"]
        draft.mkdir(exist_ok=True)
        (draft / "REPORT.txt").write_text("\n".join(lines) + "\n", "utf-8")
        folder = draft.rename(self._unused(path, ".result"))
        print(f"{path.name} is in {folder.name}: {job.verdict}", flush=True)
        for line in findings:
            print(f"    {line}", flush=True)
        self.bad += job.record.get("verdict") == "bad"
        self._record(key, folder.name)

    def _fail(self, key: str, path: Path, error: Exception) -> None:
        self.failed += 1
        report = self._unused(path, ".failed.txt")
        report.write_text(f"{path.name}: {error}\n\nTo try again, save the file again.\n", "utf-8")
        print(f"{path.name} has failed: {error}", flush=True)
        self._record(key, report.name)

    def _unused(self, path: Path, ending: str) -> Path:
        """An unused path in the folder of a file, with its name and this ending."""
        names = (f"{path.name}{number}{ending}" for number in ["", *(f".{k}" for k in range(2, 10_000))])
        return next(unused for unused in map(path.with_name, names) if not unused.exists())

    def _record(self, key: str, output: str) -> None:
        self.jobs.pop(key, None)
        self.done[key] = output
        draft = self.folder / f"{LEDGER}.part"
        draft.write_text(json.dumps(self.done, indent=1), "utf-8")
        draft.replace(self.folder / LEDGER)


def submitter(client: Client, masks: str, options: dict[str, Any]) -> Submit:
    """Creates the calibration, and returns a function that submits files. `options` are keywords of `Client.reconstruct`."""
    shared = ("full_scale", "array", "axes", "crop", "frames", "packing", "name")
    mask_options = {f"masks_{keyword}": keyword for keyword in shared}
    given = {name: options.pop(name, None) for name in ("mosaic", "dispersion", "bad_pixels")}
    given |= {keyword: options.pop(option, None) for option, keyword in mask_options.items()}
    # A restarted program continues with the same calibration.
    files = [identity(Path(file)) for file in (masks, given["bad_pixels"]) if file is not None]
    calibration = client.calibrate(masks, key=digest(files, sorted(given.items())), **given)
    job_options = set(inspect.signature(Client.submit).parameters) - {"self", "measurement", "sequence", "key"}
    job = {name: value for name, value in options.items() if name in job_options}
    measurement = {name: value for name, value in options.items() if name not in job_options}

    def submit(path: Path, key: str) -> Job:
        # The body of a request with this key names the calibration.
        key = digest(key, calibration.id)
        taken = client.measure(calibration, path, key=key, **measurement)
        return client.submit(taken, key=key, **{"label": path.name[:200], **job})

    return submit
