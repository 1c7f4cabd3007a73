"""The client: calibrations, measurements, jobs and their results."""

from __future__ import annotations

import base64
import html
import io
import os
import time
import uuid
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from types import TracebackType
from typing import Any, Literal, Self

import httpx
import numpy as np
import numpy.typing as npt

from . import _transfer as transfer
from ._errors import ApiError, CalibrationFailed, JobFailed
from ._transfer import Source

Record = dict[str, Any]
Snapshots = Literal["all"] | int | tuple[int, int]
ENDED = {"succeeded", "failed", "cancelled"}
# Side of the blocks of error.npy in pixels.
BLOCK = 16


class Client:
    """A connection to a service.

    `url` and `token` are taken from SCI_RECON_URL and SCI_RECON_TOKEN where they are left out. With `progress` uploads,
    jobs and downloads show a bar (needs tqdm).

    Methods raise `ApiError` for what the service refuses, and `SciReconError` when it can't be reached for
    about five minutes.
    """

    def __init__(
        self,
        url: str | None = None,
        token: str | None = None,
        *,
        progress: bool = False,
    ) -> None:
        url = url or os.environ.get("SCI_RECON_URL")
        if not url:
            raise ValueError("no address of a service: Client('http://server.lab:8080'), or set SCI_RECON_URL")
        token = token or os.environ.get("SCI_RECON_TOKEN")
        headers = {"Authorization": f"Bearer {token}"} if token else {}
        timeout = httpx.Timeout(60, connect=10)
        self.http = httpx.Client(base_url=url, headers=headers, timeout=timeout)
        self.progress = progress

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Closes all connections."""
        self.http.close()

    def reconstruct(
        self,
        masks: Source | Calibration,
        measurement: Source,
        algorithm: str = "pnp-tv-fastdvdnet",
        *,
        masks_full_scale: float | None = None,
        masks_array: str | None = None,
        masks_axes: str | None = None,
        masks_crop: Mapping[str, int] | None = None,
        masks_frames: tuple[int, int] | None = None,
        masks_packing: str | None = None,
        masks_name: str | None = None,
        mosaic: str | None = None,
        bad_pixels: Source | None = None,
        dark: Source | Sequence[Source] = (),
        saturation: int | None = None,
        full_scale: float | None = None,
        array: str | None = None,
        axes: str | None = None,
        crop: Mapping[str, int] | None = None,
        packing: str | None = None,
        camera_fps: float | None = None,
        exposure_s: float | None = None,
        sequence: str | None = None,
        name: str | None = None,
        snapshots: Snapshots = "all",
        schedule: Mapping[str, Any] | None = None,
        tile: Mapping[str, int] | None = None,
        model: str | None = None,
        priority: int = 0,
        label: str | None = None,
        key: str | None = None,
        folder: str | os.PathLike[str] | None = None,
    ) -> Result:
        """Uploads, submits, waits and downloads.

        `masks` are [B, H, W], `measurement` is [H, W] or [S, H, W]; arrays or file names. Their full scale, the stored
        number that means 1, is by default the maximum of an integer type, and 1 for floats. Axes in another order are
        stated where several fit: "row-column-frame", "column-row-frame" or "frame-column-row". A colour sensor has a
        `mosaic`: "rggb", "bggr", "grbg" or "gbrg". The average of the `dark` captures is subtracted.
        The other arguments are those of `calibrate`, `measure` and `submit`.
        The frames come into `folder`, by default one that goes away with the result.
        Errors that the checks found are issued as Python warnings, with their remedies.
        """
        if isinstance(masks, Calibration):
            calibration = masks
        else:
            calibration = self.calibrate(
                masks,
                full_scale=masks_full_scale,
                array=masks_array,
                axes=masks_axes,
                crop=masks_crop,
                frames=masks_frames,
                packing=masks_packing,
                mosaic=mosaic,
                bad_pixels=bad_pixels,
                name=masks_name,
            )
        taken = self.measure(
            calibration,
            measurement,
            dark=dark,
            saturation=saturation,
            full_scale=full_scale,
            array=array,
            axes=axes,
            crop=crop,
            packing=packing,
            camera_fps=camera_fps,
            exposure_s=exposure_s,
            sequence=sequence,
            name=name,
            key=key,
        )
        job = self.submit(
            taken,
            algorithm,
            snapshots=snapshots,
            schedule=schedule,
            tile=tile,
            model=model,
            priority=priority,
            label=label,
            key=key,
        ).wait()
        for finding in job.findings:
            if finding["severity"] == "error":
                warnings.warn(describe(finding), stacklevel=2)
        return job.result(folder)

    def calibrate(
        self,
        masks: Source,
        *,
        full_scale: float | None = None,
        array: str | None = None,
        axes: str | None = None,
        crop: Mapping[str, int] | None = None,
        frames: tuple[int, int] | None = None,
        packing: str | None = None,
        mosaic: str | None = None,
        bad_pixels: Source | None = None,
        name: str | None = None,
    ) -> Calibration:
        """Makes a calibration of masks [B, H, W]; of a colour sensor with a `mosaic`.

        `array` is their name in a file of several arrays. `crop` selects a window with `row`, `column`, `height` and
        `width`, and `frames` the first and the last mask, counted from 0. `packing` is "mono12p" or "mono12packed" for
        12-bit pixels in 3 bytes for 2. `bad_pixels` [H, W] is not 0 at bad pixels.
        """
        given: Record = {
            "full_scale": full_scale,
            "array": array,
            "axes": axes,
            "crop": crop,
            "frames": frames,
            "packing": packing,
            "mosaic": mosaic,
            "name": name,
            "bad_pixels": None if bad_pixels is None else self.upload(bad_pixels),
        }
        record = self._create("calibrations", masks=self.upload(masks), **given)
        return Calibration(self, record).ready()

    def calibrate_captures(
        self,
        masks: Sequence[Source | Sequence[Source]],
        white: Source | Sequence[Source],
        black: Source | Sequence[Source],
        *,
        black_with_mask: Source | Sequence[Source] | None = None,
        patterns: Source | None = None,
        saturation: int | None = None,
        mosaic: str | None = None,
        bad_pixels: Source | None = None,
        name: str | None = None,
    ) -> Calibration:
        """Makes a calibration of raw captures, and waits until its masks are there.

        `masks` has the captures of each aperture pattern in its order; each capture may be several repeats.
        """
        captures: Record = {
            "masks": [self._uploads(repeats) for repeats in masks],
            "white": self._uploads(white),
            "black": self._uploads(black),
            "saturation": saturation,
            "patterns": None if patterns is None else self.upload(patterns),
        }
        if black_with_mask is not None:
            captures["black_with_mask"] = self._uploads(black_with_mask)
        given: Record = {"mosaic": mosaic, "name": name}
        given["bad_pixels"] = None if bad_pixels is None else self.upload(bad_pixels)
        return Calibration(self, self._create("calibrations", captures=captures, **given)).ready()

    def measure(
        self,
        calibration: Calibration | str,
        data: Source,
        *,
        dark: Source | Sequence[Source] = (),
        full_scale: float | None = None,
        array: str | None = None,
        axes: str | None = None,
        crop: Mapping[str, int] | None = None,
        packing: str | None = None,
        saturation: int | None = None,
        camera_fps: float | None = None,
        exposure_s: float | None = None,
        sequence: str | None = None,
        name: str | None = None,
        key: str | None = None,
    ) -> Measurement:
        """Makes a measurement of snapshots [H, W] or [S, H, W] that were taken with a calibration.

        `crop` and `packing` are as for masks, and apply to `dark` too.
        `sequence` is "contiguous" if the snapshots follow one another without a gap, else "separate"; by default the
        camera's times decide.
        """
        record = self._create(
            "measurements",
            key=key,
            calibration=str(calibration),
            data=self.upload(data),
            dark=self._uploads(dark),
            full_scale=full_scale,
            array=array,
            axes=axes,
            crop=crop,
            packing=packing,
            saturation=saturation,
            camera_fps=camera_fps,
            exposure_s=exposure_s,
            sequence=sequence,
            name=name,
        )
        return Measurement(self, record).ready()

    def submit(
        self,
        measurement: Measurement | str,
        algorithm: str = "pnp-tv-fastdvdnet",
        *,
        snapshots: Snapshots = "all",
        sequence: str | None = None,
        schedule: Mapping[str, Any] | None = None,
        tile: Mapping[str, int] | None = None,
        model: str | None = None,
        priority: int = 0,
        label: str | None = None,
        key: str | None = None,
    ) -> Job:
        """Asks for a reconstruction, and does not wait for it.

        `snapshots` is "all", one by its index from 0, or (first, last) with both ends in. A second request with the same
        `key` is answered with the first one's job.
        """
        return Job(
            self,
            self._create(
                "jobs",
                key=key,
                measurement=str(measurement),
                algorithm=algorithm,
                snapshots=list(snapshots) if isinstance(snapshots, tuple) else snapshots,
                sequence=sequence,
                schedule=schedule,
                tile=tile,
                model=model,
                priority=priority,
                label=label,
            ),
        )

    def calibration(self, identifier: str) -> Calibration:
        """A calibration that was made before, by this client or another."""
        return Calibration(self, self._get(f"/v1/calibrations/{identifier}"))

    def job(self, identifier: str) -> Job:
        """A job that was submitted before, by this client or another."""
        return Job(self, self._get(f"/v1/jobs/{identifier}"))

    def jobs(self, **filters: str) -> Iterator[Job]:
        """All jobs, newest first; `filters` as in the contract, such as `state="running"`."""
        for record in self._pages("/v1/jobs", filters):
            yield Job(self, record)

    def upload(self, source: Source) -> str:
        """Sends an array or a file, in pieces that survive cuts. Gives its SHA-256, by which requests name it."""
        name = "array" if isinstance(source, np.ndarray) else os.path.basename(source)
        with transfer.as_file(source) as path, self._bar(f"upload {name}") as bar:
            return transfer.upload(self.http, path, bar)

    def _uploads(self, sources: Source | Sequence[Source]) -> list[str]:
        if isinstance(sources, (str, os.PathLike, np.ndarray)):
            return [self.upload(sources)]
        return [self.upload(source) for source in sources]

    def _create(self, what: str, *, key: str | None = None, **body: Any) -> Record:
        given = {name: value for name, value in body.items() if value is not None}
        headers = {"Idempotency-Key": key or str(uuid.uuid4())}
        record: Record = transfer.send(self.http, "POST", f"/v1/{what}", json=given, headers=headers).json()
        return record

    def _get(self, path: str, **parameters: Any) -> Record:
        record: Record = transfer.send(self.http, "GET", path, params=parameters).json()
        return record

    def _get_ended(self, path: str, wait: float) -> Record:
        """A record, answered when its work has ended, or after `wait` seconds."""
        record: Record = transfer.send(self.http, "GET", path, headers={"Prefer": f"wait={wait}"}).json()
        return record

    def _pages(self, path: str, filters: Mapping[str, str]) -> Iterator[Record]:
        parameters = dict(filters)
        while True:
            page = self._get(path, **parameters)
            yield from page["items"]
            if page["next_cursor"] is None:
                return
            parameters["cursor"] = page["next_cursor"]

    def _bar(self, text: str, unit: str = "B") -> Bar:
        return Bar(text, unit, self.progress)


@dataclass
class Entity:
    """Something that the service keeps. `record` is what it last said of it."""

    client: Client = field(repr=False)
    record: Record = field(repr=False)

    @property
    def id(self) -> str:
        return str(self.record["id"])

    def __str__(self) -> str:
        return self.id

    @property
    def warnings(self) -> list[Record]:
        """Findings of the checks: each has a `code`, a `severity`, a `detail` and a `remedy`."""
        return list(self.record.get("warnings", []))

    def _ready(self, collection: str) -> None:
        with self.client._bar(f"{self.__class__.__name__.lower()} {self.id}", "%") as bar:
            while self.record.get("state") == "preparing":
                bar(int(self.record.get("percent", 0)), 100)
                self.record = self.client._get_ended(f"/v1/{collection}/{self.id}", 2)
        if problem := self.record.get("problem"):
            raise ApiError(problem["status"], problem)
        if self.record.get("state") == "failed":
            raise CalibrationFailed(self.record.get("error") or "no reason was given")


@dataclass
class Calibration(Entity):
    """Masks [B, H, W] of an optical setting."""

    def ready(self) -> Calibration:
        """Waits until there are masks."""
        self._ready("calibrations")
        return self

    def masks(self) -> npt.NDArray[np.float32]:
        """The masks [B, H, W] on [0, 1], from the uploaded file. `ValueError` unless that is an npy file."""
        record, name = self.record, self.record["masks"]
        with TemporaryDirectory(prefix="sci-recon-") as folder:
            path = Path(folder) / "masks.npy"
            with self.client._bar("download masks") as bar:
                transfer.download(self.client.http, f"/v1/blobs/{name}/content", path, name, bar)
            with path.open("rb") as file:
                if file.read(6) != b"\x93NUMPY":
                    raise ValueError(f"the masks are a {record['format']} file; read it, and pass the array")
            stored = np.load(path)
        order = (record["axes"] or "frame-row-column").split("-")
        stored = stored.transpose([order.index(axis) for axis in ("frame", "row", "column")])
        masks: npt.NDArray[np.float32] = np.maximum(stored / np.float64(record["full_scale"]), 0).astype(np.float32)
        return masks

    def report(self) -> Record:
        """What is known of the masks: a grade, findings, and what to do."""
        return self.client._get(f"/v1/calibrations/{self.id}/report")


@dataclass
class Measurement(Entity):
    """Snapshots [S, H, W] taken with a calibration."""

    def ready(self) -> Measurement:
        """Waits until it is checked."""
        self._ready("measurements")
        return self


@dataclass
class Job(Entity):
    """A reconstruction."""

    @property
    def findings(self) -> list[Record]:
        """Findings of the checks, and further reasons of the assessment."""
        reasons = (self.record.get("assessment") or {}).get("reasons", [])
        known = {finding["code"] for finding in self.warnings}
        return self.warnings + [reason for reason in reasons if reason["code"] not in known]

    @property
    def verdict(self) -> str:
        """The grade of the frames, with the expected PSNR where it can be predicted."""
        if assessment := self.record.get("assessment"):
            grade, psnr, low, high = (assessment[key] for key in ("grade", "psnr_db", "psnr_low_db", "psnr_high_db"))
            if psnr is None:
                return f"{grade}, no expected PSNR"
            if psnr < 40:
                return f"{grade}, expected PSNR {psnr:.1f} dB ({low:.1f} to {high:.1f})"
            return f"{grade}, expected PSNR 40 dB or more" + (f" ({low:.1f} or more)" if low < 40 else "")
        return "bad" if any(finding["severity"] == "error" for finding in self.findings) else "not assessed"

    @property
    def state(self) -> str:
        return str(self.record["state"])

    def refresh(self) -> Job:
        """Asks for its state."""
        self.record = self.client._get(f"/v1/jobs/{self.id}")
        return self

    def wait(self, timeout: float | None = None) -> Job:
        """Waits until it has ended; `JobFailed` unless it has succeeded, `TimeoutError` after `timeout` seconds."""
        end = None if timeout is None else time.monotonic() + timeout
        with self.client._bar(f"job {self.id[:8]}", "%") as bar:
            while self.state not in ENDED:
                bar(int(self.record["progress"]["percent"]), 100)
                if end is not None and time.monotonic() >= end:
                    raise TimeoutError(f"job {self.id} is {self.state} after {timeout} s")
                asked = time.monotonic()
                # Answered when the job has ended; at once where too many of a lab wait.
                longest = 2.0 if self.client.progress else 20.0
                wait = longest if end is None else max(0.0, min(longest, end - asked))
                self.record = self.client._get_ended(f"/v1/jobs/{self.id}", round(wait, 3))
                if time.monotonic() - asked < 0.2:
                    transfer.pause(2)
            bar(100, 100)
        if self.state != "succeeded":
            raise JobFailed(self.record)
        return self

    def cancel(self) -> Job:
        """Stops it within an iteration."""
        self.record = transfer.send(self.client.http, "POST", f"/v1/jobs/{self.id}/cancel").json()
        return self

    def retry(self) -> Job:
        """Takes it up again after a failure or a cancel; tiles that are done stay so."""
        self.record = transfer.send(self.client.http, "POST", f"/v1/jobs/{self.id}/retry").json()
        return self

    def delete(self) -> None:
        """Removes it and its results."""
        transfer.send(self.client.http, "DELETE", f"/v1/jobs/{self.id}")

    def result(self, folder: str | os.PathLike[str] | None = None) -> Result:
        """Its results, downloaded as they are asked for, into `folder` or one that goes away with them."""
        return Result(self, folder)


class Result:
    """The results of a job that has succeeded."""

    def __init__(self, job: Job, folder: str | os.PathLike[str] | None = None) -> None:
        self.job = job
        # Windows can't remove files that are mapped to memory.
        temporary = TemporaryDirectory(prefix="sci-recon-", ignore_cleanup_errors=True) if folder is None else None
        self._temporary = temporary
        self.folder = Path(temporary.name if temporary else folder or "")

    def __repr__(self) -> str:
        shape = self.job.record["shape"]
        frames = len(self.snapshots) * shape["frames"]
        name = self.job.record.get("label") or self.job.id
        return f"<Result {name!r}: {self.job.verdict}; {frames} frames of {shape['height']}x{shape['width']}>"

    def _repr_html_(self) -> str:
        """What Jupyter shows: name, verdict, and an animated preview if Pillow is installed."""
        text = f"<p>{html.escape(repr(self))}</p>"
        try:
            picture = preview(self.snapshot(self.snapshots[0]))
        except ImportError:
            return text
        return f'{text}<img alt="frames" src="data:image/png;base64,{base64.b64encode(picture).decode()}">'

    @property
    def snapshots(self) -> range:
        """The snapshots of the measurement that were reconstructed."""
        chosen = self.job.record["snapshots"]
        return range(chosen["first"], chosen["first"] + chosen["count"])

    @cached_property
    def frames(self) -> npt.NDArray[np.float32]:
        """All frames, those of one snapshot after the other: [B * S, H, W], of a colour sensor
        [B * S, H, W, 3], float32.

        Of one snapshot it is a memory map of the downloaded file; of several an array in memory.
        """
        parts = [self.snapshot(index) for index in self.snapshots]
        return parts[0] if len(parts) == 1 else np.concatenate(parts)

    def snapshot(self, index: int) -> npt.NDArray[np.float32]:
        """The frames of one snapshot, [B, H, W], as a memory map of the downloaded file."""
        frames: npt.NDArray[np.float32] = np.load(self.download("frames.npy", index), mmap_mode="r")
        return frames

    @property
    def assessment(self) -> Record | None:
        """How good the frames are expected to be: `grade`, `psnr_db` between `psnr_low_db` and `psnr_high_db`, and `reasons`;
        None where nothing can be predicted. The figures are None where a finding puts scale, dark or masks in doubt."""
        return self.job.record.get("assessment")

    def expected_error(self, index: int) -> npt.NDArray[np.float32]:
        """The error expected in the frames of one snapshot, [B, H, W]: the root of the mean square of blocks of 16x16 pixels,
        on the scale of the frames. `KeyError` where nothing can be told (`assessment` is None)."""
        blocks: npt.NDArray[np.float32] = np.load(self.download("error.npy", index))
        height, width = self.snapshot(index).shape[1:3]
        return blocks.repeat(BLOCK, axis=1).repeat(BLOCK, axis=2)[:, :height, :width]

    def download(self, name: str, snapshot: int | None = None) -> Path:
        """Fetches a file such as `stack.exr`, `frames.npy` or `frames/frame_0001.exr`, unless it is here already."""
        index = self.snapshots[0] if snapshot is None else snapshot
        listed = self.job.client._get(f"/v1/jobs/{self.job.id}/snapshots/{index}")["files"]
        files = {file["name"]: file for file in listed if file["href"]}
        if name not in files:
            raise KeyError(f"no file {name!r} of snapshot {index}; there are {', '.join(files)}")
        file = files[name]
        path = self.folder / f"snapshot_{index:04d}" / name
        if not (path.is_file() and transfer.sha256(path) == file["sha256"]):
            with self.job.client._bar(f"download {name}") as bar:
                # Relative to the address of the list.
                href = f"/v1/jobs/{self.job.id}/snapshots/{file['href']}"
                transfer.download(self.job.client.http, href, path, file["sha256"], bar)
        return path

    def movie(self, snapshot: int | None = None, format: str = "mp4") -> Path:
        """Creates the movie of a snapshot, or of all in order, and fetches it.

        `format` is "mp4" (AV1) or "gif", which presentation programs play.
        """
        http = self.job.client.http
        base = f"/v1/jobs/{self.job.id}"
        transfer.send(http, "POST", f"{base}/exports", json={"format": format, "snapshot": snapshot})
        href = f"{base}/exports/{format}" if snapshot is None else f"{base}/snapshots/{snapshot}/exports/{format}"
        while (answer := transfer.send(http, "HEAD", href)).status_code == 202:
            transfer.pause(0, answer.headers.get("Retry-After"))
        sha256 = answer.headers["ETag"].strip('"')
        place = "sequence" if snapshot is None else f"snapshot_{snapshot:04d}"
        path = self.folder / place / f"movie.{format}"
        if not (path.is_file() and transfer.sha256(path) == sha256):
            with self.job.client._bar(f"download {path.name}") as bar:
                transfer.download(http, href, path, sha256, bar)
        return path

    @property
    def manifest(self) -> Record:
        """What went into the job and what came of it."""
        return self.job.client._get(f"/v1/jobs/{self.job.id}/exports/manifest")


def describe(finding: Record) -> str:
    """A finding as one line, with its remedy."""
    place = f"snapshot {finding['snapshot']}: " if finding.get("snapshot") is not None else ""
    detail, remedy = finding["detail"].rstrip("."), finding["remedy"].rstrip(".")
    return f"{finding['severity']} {finding['code']}: {place}{detail}. Remedy: {remedy}."


def preview(frames: npt.NDArray[np.float32], side: int = 256) -> bytes:
    """An animated PNG of frames [B, H, W] or [B, H, W, 3], ten a second, from 0 to the white level. Its sides have at most
    about `side` pixels."""
    from PIL import Image

    step = max(1, round(max(frames.shape[1:3]) / side))
    small, white = frames[:, ::step, ::step], white_level(frames)
    pictures = [Image.fromarray(np.uint8(np.clip(frame / white, 0, 1) * 255)) for frame in small]
    file = io.BytesIO()
    pictures[0].save(file, "PNG", save_all=True, append_images=pictures[1:], duration=100, loop=0)
    return file.getvalue()


def white_level(frames: npt.NDArray[np.float32]) -> float:
    """The 99.9th percentile of frames [B, H, W] or [B, H, W, 3]; 1 for black frames. It uses every n-th pixel of large
    frames."""
    step = max(1, int((frames.size / 4e6) ** 0.5))
    level = float(np.percentile(frames[:, ::step, ::step], 99.9))
    return level if level > 0 else 1.0


class Bar:
    """A bar of tqdm from the first progress on, or nothing."""

    def __init__(self, text: str, unit: str, shown: bool) -> None:
        self._make = None
        self._bar: Any = None
        if shown:
            from tqdm.auto import tqdm

            self._make = lambda: tqdm(desc=text, unit=unit, unit_scale=unit == "B")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.close()

    def __call__(self, done: int, total: int) -> None:
        if self._bar is None and self._make is not None:
            self._bar = self._make()
        if self._bar is not None:
            self._bar.total = total
            self._bar.update(done - self._bar.n)
