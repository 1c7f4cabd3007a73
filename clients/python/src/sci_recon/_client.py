"""The client: calibrations, measurements, jobs and results."""

from __future__ import annotations

import base64
import html
import io
import json
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
from ._errors import ApiError, CalibrationFailed, FindingWarning, JobFailed
from ._transfer import Source

Record = dict[str, Any]
Snapshots = Literal["all"] | int | tuple[int, int]
ENDED = {"succeeded", "failed", "cancelled"}
# Side of the blocks of error.npy in pixels.
BLOCK = 16
# Files that the service composes on demand, and their exports.
EXPORTS = {"stack.tif": "tiff", "stack-sigma.exr": "exr?layers=sigma"}


class Client:
    """A connection to a service.

    The defaults of `url` and `token` are SCI_RECON_URL and SCI_RECON_TOKEN. With `progress`, uploads, jobs and downloads
    show a progress bar (needs tqdm).

    Methods raise `ApiError` if the service rejects a request, and `SciReconError` if it is unreachable for about five
    minutes.
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
            raise ValueError(
                "the address of the service is missing: use Client('http://server.lab:8080'), or set SCI_RECON_URL"
            )
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
        dispersion: Mapping[str, Any] | None = None,
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
        registration: str | Mapping[str, float | Sequence[float]] | None = None,
        priority: int = 0,
        truth: Source | None = None,
        label: str | None = None,
        webhook: str | None = None,
        key: str | None = None,
        folder: str | os.PathLike[str] | None = None,
    ) -> Result:
        """Uploads the files, submits a job, waits for it, and downloads the frames.

        `masks` are [B, H, W] and `measurement` is [H, W] or [S, H, W]; both may be arrays or file names. Full scale is the
        stored number that means 1. Its default is the maximum of an integer type, and 1 for floats. If several orders of
        the axes fit, state "row-column-frame", "column-row-frame" or "frame-column-row". A colour sensor has a `mosaic`:
        "rggb", "bggr", "grbg" or "gbrg". The average of the `dark` captures is subtracted. The other arguments are those
        of `calibrate`, `measure` and `submit`. The frames are saved in `folder`, by default a temporary folder that exists
        as long as the result. Findings of the checks are issued as Python warnings (`FindingWarning`), with their remedies.
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
                dispersion=dispersion,
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
            registration=registration,
            priority=priority,
            truth=truth,
            label=label,
            webhook=webhook,
            key=key,
        ).wait()
        job.warn(stacklevel=3)
        return Result(job, folder)

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
        dispersion: Mapping[str, Any] | None = None,
        bad_pixels: Source | None = None,
        name: str | None = None,
        key: str | None = None,
    ) -> Calibration:
        """Creates a calibration from masks [B, H, W]. A colour sensor has a `mosaic`.

        A spectral camera has one mask [H, W] and a `dispersion` with `axis` ("column" or "row"), `offsets` (pixels of each
        band), optionally `wavelengths` (nm), and `mask`: "scene" if the mask has the size of a band, or "measurement".

        `array` is the name of the masks in a file of several arrays. `crop` selects a window with `row`, `column`, `height`
        and `width`. `frames` selects the first and the last mask, counted from 0. `packing` is "mono12p" or "mono12packed"
        if two 12-bit pixels are stored in 3 bytes. `bad_pixels` [H, W] is nonzero at bad pixels. A repeated request with the
        same `key` returns the calibration of the first one.
        """
        given: Record = {
            "full_scale": full_scale,
            "array": array,
            "axes": axes,
            "crop": crop,
            "frames": frames,
            "packing": packing,
            "mosaic": mosaic,
            "dispersion": dispersion,
            "name": name,
            "bad_pixels": None if bad_pixels is None else self.upload(bad_pixels),
        }
        record = self._create("calibrations", key=key, masks=self.upload(masks), **given)
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
        """Creates a calibration from raw captures, and waits until its masks are computed.

        `masks` has a capture of each aperture pattern, in the order of the patterns. A capture may be a list of repeats.
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
        """Creates a measurement from snapshots [H, W] or [S, H, W] that were taken with a calibration.

        `crop` and `packing` are as for masks, and apply to `dark`, too. `sequence` is "contiguous" if the snapshots follow
        each other without a gap, otherwise "separate". By default it is derived from `camera_fps` and `exposure_s`.
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
        registration: str | Mapping[str, float | Sequence[float]] | None = None,
        priority: int = 0,
        truth: Source | None = None,
        label: str | None = None,
        webhook: str | None = None,
        key: str | None = None,
    ) -> Job:
        """Submits a job without waiting for it.

        `snapshots` is "all", an index from 0, or (first, last), both included. `registration` "auto", the default,
        corrects masks that have moved since the calibration; {"shift": (rows, columns), "rotation": degrees, "scale":
        factor} states the motion about the centre of the sensor, rotations clockwise; "off" uses the calibrated masks. `truth` [B, H, W] has the true frames, if they are known: the dashboard shows PSNR
        and SSIM against them. A repeated request with the same `key` returns the job of the first one. The service notifies
        `webhook`, an address, when the job ends.
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
                registration=registration,
                priority=priority,
                truth=None if truth is None else self.upload(truth),
                label=label,
                webhook=webhook,
            ),
        )

    def repeat(
        self,
        manifest: Record | str | os.PathLike[str],
        files: Sequence[str | os.PathLike[str]] = (),
        *,
        priority: int = 0,
        label: str | None = None,
        webhook: str | None = None,
        key: str | None = None,
    ) -> Job:
        """Repeats the job of a manifest, with the same calibration, measurement and settings.

        `manifest` is `Result.manifest`, or the manifest.json of a job. `files` are the inputs that the service lacks, in any
        order. Raises `ValueError` with the hashes of those that are missing. `Job.differences` compares the frames.
        """
        whole = read_manifest(manifest)
        requests, run = whole["content"]["inputs"], whole["run"]
        held = {transfer.sha256(Path(file)): file for file in files}
        network = whole["content"]["models"][0]["sha256"] if run["model"] else None
        inputs = {"calibration": dict(hashes(requests["calibration"], "masks"))}
        inputs["measurement"] = dict(hashes(requests["measurement"], "measurement"))
        inputs["model"] = {network: "network"} if network else {}
        ready = {kind: bool(run[kind]) and self._exists(f"/v1/{kind}s/{run[kind]}") for kind in inputs}
        missing = []
        if not ready["calibration"] and not {"masks", "captures"} & requests["calibration"].keys():
            missing.append(f"calibration {run['calibration']}, which only the service that moved its masks has")
        for kind, of_kind in inputs.items():
            for sha256, role in of_kind.items():
                if ready[kind]:
                    continue
                if sha256 in held:
                    self.upload(held[sha256])
                elif not self._exists(f"/v1/blobs/{sha256}"):
                    missing.append(f"{role} with the SHA-256 {sha256}")
        if missing:
            raise ValueError(f"the service lacks inputs of the manifest: {'; '.join(missing)}. Add their files")
        calibration, measurement, job = run["calibration"], run["measurement"], dict(whole["content"]["request"])
        if not ready["calibration"]:
            calibration = Calibration(self, self._create("calibrations", **requests["calibration"])).ready().id
        if not ready["measurement"]:
            body = {**requests["measurement"], "calibration": calibration}
            measurement = Measurement(self, self._create("measurements", key=key, **body)).ready().id
        if network:
            model = None if ready["model"] else self._create("models", key=key, calibration=calibration, file=network)
            job["model"] = model["id"] if model else run["model"]
        own = {"priority": priority, "label": label or run["label"], "webhook": webhook}
        return Job(self, self._create("jobs", key=key, measurement=measurement, **job, **own))

    def calibration(self, identifier: str) -> Calibration:
        """An existing calibration, created by this client or another."""
        return Calibration(self, self._get(f"/v1/calibrations/{identifier}"))

    def job(self, identifier: str) -> Job:
        """An existing job, submitted by this client or another."""
        return Job(self, self._get(f"/v1/jobs/{identifier}"))

    def jobs(self, **filters: str) -> Iterator[Job]:
        """All jobs, newest first. `filters` are query parameters of the API, such as `state="running"`."""
        for record in self._pages("/v1/jobs", filters):
            yield Job(self, record)

    def upload(self, source: Source) -> str:
        """Uploads an array or a file, and resumes after a lost connection. Returns its SHA-256, which identifies it in requests."""
        name = "array" if isinstance(source, np.ndarray) else os.path.basename(source)
        with transfer.as_file(source) as path, self._bar(f"upload {name}") as bar:
            return transfer.upload(self.http, path, bar)

    def _uploads(self, sources: Source | Sequence[Source]) -> list[str]:
        if isinstance(sources, (str, os.PathLike, np.ndarray)):
            return [self.upload(sources)]
        return [self.upload(source) for source in sources]

    def _create(self, collection: str, *, key: str | None = None, **body: Any) -> Record:
        stated = {name: value for name, value in body.items() if value is not None}
        headers = {"Idempotency-Key": key or str(uuid.uuid4())}
        record: Record = transfer.send(self.http, "POST", f"/v1/{collection}", json=stated, headers=headers).json()
        return record

    def _get(self, path: str, **parameters: Any) -> Record:
        record: Record = transfer.send(self.http, "GET", path, params=parameters).json()
        return record

    def _exists(self, path: str) -> bool:
        try:
            return bool(self._get(path).get("state", "ready") == "ready")
        except ApiError as error:
            if error.status == 404:
                return False
            raise

    def _get_waiting(self, path: str, wait: float) -> Record:
        """Gets a record. The service answers once the work has ended, or after `wait` seconds."""
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
    """A resource of the service. `record` is its last known state."""

    client: Client = field(repr=False)
    record: Record = field(repr=False)

    @property
    def id(self) -> str:
        return str(self.record["id"])

    def __str__(self) -> str:
        return self.id

    @property
    def warnings(self) -> list[Record]:
        """Findings of the checks. Each has a `code`, a `severity`, a `detail` and a `remedy`."""
        return list(self.record.get("warnings", []))

    def _ready(self, collection: str) -> None:
        with self.client._bar(f"{self.__class__.__name__.lower()} {self.id}", "%") as bar:
            while self.record.get("state") == "preparing":
                bar(int(self.record.get("percent", 0)), 100)
                self.record = self.client._get_waiting(f"/v1/{collection}/{self.id}", 2)
        if problem := self.record.get("problem"):
            raise ApiError(problem["status"], problem)
        if self.record.get("state") == "failed":
            raise CalibrationFailed(self.record.get("error") or "no reason was given")


@dataclass
class Calibration(Entity):
    """Masks [B, H, W] of an optical setup."""

    def ready(self) -> Calibration:
        """Waits until the masks are ready."""
        self._ready("calibrations")
        return self

    def masks(self) -> npt.NDArray[np.float32]:
        """The masks [B, H, W] on [0, 1], as jobs use them. Bad pixels are NaN.

        A spectral camera has one mask for each band, as it lies on the sensor.
        """
        with TemporaryDirectory(prefix="sci-recon-") as folder:
            path = Path(folder) / "masks.npy"
            with self.client._bar("download masks") as bar:
                transfer.download(self.client.http, f"/v1/calibrations/{self.id}/masks", path, progress=bar)
            masks: npt.NDArray[np.float32] = np.load(path)
        return masks

    def report(self) -> Record:
        """The report on the masks: a grade, and findings with remedies."""
        return self.client._get(f"/v1/calibrations/{self.id}/report")


@dataclass
class Measurement(Entity):
    """Snapshots [S, H, W] taken with a calibration."""

    def ready(self) -> Measurement:
        """Waits until the measurement is checked."""
        self._ready("measurements")
        return self


@dataclass
class Job(Entity):
    """A reconstruction."""

    @property
    def findings(self) -> list[Record]:
        """Findings of the checks, and those of the assessment that are not among them."""
        reasons = (self.record.get("assessment") or {}).get("reasons", [])
        known = {finding["code"] for finding in self.warnings}
        return self.warnings + [reason for reason in reasons if reason["code"] not in known]

    @property
    def verdict(self) -> str:
        """The service's verdict on the frames in a line, with the expected PSNR if it can be predicted. `record["verdict"]`
        has the word alone. The text is empty until the job has succeeded."""
        return self.record.get("verdict_text") or ""

    @property
    def state(self) -> str:
        return str(self.record["state"])

    def refresh(self) -> Job:
        """Reads the state of the job again."""
        self.record = self.client._get(f"/v1/jobs/{self.id}")
        return self

    def wait(self, timeout: float | None = None) -> Job:
        """Waits until the job has ended.

        Raises `JobFailed` if the job failed or was cancelled, and `TimeoutError` after `timeout` seconds.
        """
        end = None if timeout is None else time.monotonic() + timeout
        with self.client._bar(f"job {self.id[:8]}", "%") as bar:
            while self.state not in ENDED:
                bar(int(self.record["progress"]["percent"]), 100)
                if end is not None and time.monotonic() >= end:
                    raise TimeoutError(f"job {self.id} is {self.state} after {timeout} s")
                asked = time.monotonic()
                # The service answers once the job has ended, but immediately if too many requests of the lab wait.
                longest = 2.0 if self.client.progress else 20.0
                wait = longest if end is None else max(0.0, min(longest, end - asked))
                self.record = self.client._get_waiting(f"/v1/jobs/{self.id}", round(wait, 3))
                if time.monotonic() - asked < 0.2:
                    transfer.pause(2)
            bar(100, 100)
        if self.state != "succeeded":
            raise JobFailed(self.record)
        return self

    def corrected_calibration(self, name: str | None = None) -> Calibration:
        """Creates a calibration from the masks of this job, which its registration has moved.

        Raises `ApiError` if the job has not succeeded, or if its masks were not moved.
        """
        record = self.client._create("calibrations", registration_of=self.id, name=name)
        return Calibration(self.client, record).ready()

    def cancel(self) -> Job:
        """Cancels the job. Running tasks stop after their current iteration."""
        self.record = transfer.send(self.client.http, "POST", f"/v1/jobs/{self.id}/cancel").json()
        return self

    def retry(self) -> Job:
        """Continues a failed or cancelled job. Finished tiles are kept."""
        self.record = transfer.send(self.client.http, "POST", f"/v1/jobs/{self.id}/retry").json()
        return self

    def delete(self) -> None:
        """Deletes the job and its results."""
        transfer.send(self.client.http, "DELETE", f"/v1/jobs/{self.id}")

    def differences(self, manifest: Record | str | os.PathLike[str]) -> list[int]:
        """The snapshots with other frames than those of a manifest: none if the job repeats it exactly."""
        whole = self.client._get(f"/v1/jobs/{self.id}/exports/manifest")
        mine, other = frames_of(whole), frames_of(read_manifest(manifest))
        return sorted(index for index in mine.keys() | other.keys() if mine.get(index) != other.get(index))

    def result(self, folder: str | os.PathLike[str] | None = None) -> Result:
        """The results of the job. Files are downloaded on first use into `folder`, by default a temporary folder.

        The findings are issued as Python warnings (`FindingWarning`), with their remedies.
        """
        self.warn(stacklevel=3)
        return Result(self, folder)

    def warn(self, stacklevel: int = 2) -> None:
        """Issues the findings as Python warnings."""
        for line in describe_all(self.findings):
            warnings.warn(line, FindingWarning, stacklevel=stacklevel)


class Result:
    """The results of a succeeded job."""

    def __init__(self, job: Job, folder: str | os.PathLike[str] | None = None) -> None:
        self.job = job
        # Windows can't remove files that are mapped to memory.
        temporary = TemporaryDirectory(prefix="sci-recon-", ignore_cleanup_errors=True) if folder is None else None
        self._temporary = temporary
        self.folder = Path(temporary.name if temporary else folder or "")
        # Exports that this object has downloaded.
        self._exported: set[Path] = set()

    def __repr__(self) -> str:
        shape = self.job.record["shape"]
        frames = len(self.snapshots) * shape["frames"]
        name = self.job.record.get("label") or self.job.id
        codes = ", ".join(dict.fromkeys(f"{finding['severity']} {finding['code']}" for finding in self.job.findings))
        found = f"; {codes}" if codes else ""
        return f"<Result {name!r}: {self.job.verdict}{found}; {frames} frames of {shape['height']}x{shape['width']}>"

    def _repr_html_(self) -> str:
        """HTML for Jupyter: name, verdict, findings, and an animated preview if Pillow is installed."""
        findings = "".join(f"<li>{html.escape(line)}</li>" for line in describe_all(self.job.findings))
        text = f"<p>{html.escape(repr(self))}</p>" + (f"<ul>{findings}</ul>" if findings else "")
        try:
            picture = preview(self.snapshot(self.snapshots[0]), self.white_level)
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
        """The frames of all snapshots in order: float32 [B * S, H, W], or [B * S, H, W, 3] for a colour sensor.

        A single snapshot is a memory map of the downloaded file. Several snapshots are an array in memory.
        """
        parts = [self.snapshot(index) for index in self.snapshots]
        return parts[0] if len(parts) == 1 else np.concatenate(parts)

    def snapshot(self, index: int) -> npt.NDArray[np.float32]:
        """The frames [B, H, W] of a snapshot, as a memory map of the downloaded file."""
        frames: npt.NDArray[np.float32] = np.load(self.download("frames.npy", index), mmap_mode="r")
        return frames

    @property
    def assessment(self) -> Record | None:
        """The predicted quality of the frames: `grade`, `psnr_db` between `psnr_low_db` and `psnr_high_db`, and `reasons`.

        Returns None if no prediction is possible. The figures are None if a finding questions the scale, the dark frame or the masks.
        """
        return self.job.record.get("assessment")

    def expected_error(self, index: int) -> npt.NDArray[np.float32]:
        """The expected error of the frames of a snapshot, [B, H, W]: the root mean square error of each block of 16x16 pixels,
        on the scale of the frames. Raises `KeyError` if no prediction is possible (`assessment` is None). While the findings
        withhold the expected PSNR, the map has no meaning either."""
        blocks: npt.NDArray[np.float32] = np.load(self.download("error.npy", index))
        height, width = self.snapshot(index).shape[1:3]
        return blocks.repeat(BLOCK, axis=1).repeat(BLOCK, axis=2)[:, :height, :width]

    def download(self, name: str, snapshot: int | None = None) -> Path:
        """Downloads a file such as `stack.exr`, `stack.tif`, `frames.npy` or `frames/frame_0001.exr`, unless the folder has it."""
        index = self.snapshots[0] if snapshot is None else snapshot
        if export := EXPORTS.get(name):
            return self._export(f"snapshots/{index}/exports/{export}", self.folder / f"snapshot_{index:04d}" / name)
        listed = self.job.client._get(f"/v1/jobs/{self.job.id}/snapshots/{index}")["files"]
        files = {file["name"]: file for file in listed if file["href"]}
        if name not in files:
            raise KeyError(f"snapshot {index} has no file {name!r}; its files are {', '.join([*files, *EXPORTS])}")
        file = files[name]
        path = self.folder / f"snapshot_{index:04d}" / name
        if not (path.is_file() and transfer.sha256(path) == file["sha256"]):
            with self.job.client._bar(f"download {name}") as bar:
                # Relative to the address of the list.
                href = f"/v1/jobs/{self.job.id}/snapshots/{file['href']}"
                transfer.download(self.job.client.http, href, path, file["sha256"], bar)
        return path

    def movie(self, snapshot: int | None = None, format: str = "mp4") -> Path:
        """Creates and downloads the movie of a snapshot, or of all snapshots in order, at ten frames per second.

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

    def _export(self, href: str, path: Path) -> Path:
        """Downloads a file that the service composes of stored ones. Its bytes have no recorded hash, so that an existing
        file can't be compared."""
        if not (path in self._exported and path.is_file()):
            with self.job.client._bar(f"download {path.name}") as bar:
                transfer.download(self.job.client.http, f"/v1/jobs/{self.job.id}/{href}", path, progress=bar)
            self._exported.add(path)
        return path

    @cached_property
    def manifest(self) -> Record:
        """The manifest of the job: inputs, parameters and results."""
        return self.job.client._get(f"/v1/jobs/{self.job.id}/exports/manifest")

    @property
    def white_level(self) -> float:
        """The value that pictures show as white: the 99.9th percentile of all frames of the job."""
        return white_level_of(self.manifest)


def read_manifest(manifest: Record | str | os.PathLike[str]) -> Record:
    """The manifest of a job. Raises `ValueError` for other files."""
    whole: Record = dict(manifest) if isinstance(manifest, Mapping) else json.loads(Path(manifest).read_bytes())
    if whole.get("schema") != "sci-recon/job/1" or "request" not in whole["content"]:
        raise ValueError("this is not the manifest.json of a job, or an earlier version has written it")
    return whole


def white_level_of(manifest: Record) -> float:
    """The white level of a manifest, and 1 for black frames."""
    return float(manifest["content"]["scale"]["white_level"]) or 1.0


def frames_of(manifest: Record) -> dict[int, str]:
    """The hash of the frames of each snapshot."""
    files = ((entry["snapshot"], file) for entry in manifest["content"]["snapshots"] for file in entry["files"])
    return {snapshot: file["sha256"] for snapshot, file in files if file["name"] == "frames.npy"}


def hashes(value: Any, role: str) -> Iterator[tuple[str, str]]:
    """The uploads that a request names, with their roles."""
    if isinstance(value, str) and len(value) == 64:
        yield value, role
    elif isinstance(value, Mapping):
        for name, part in value.items():
            yield from hashes(part, role if name in ("masks", "data") else f"{name.replace('_', ' ')} of the {role}")
    elif isinstance(value, list):
        for part in value:
            yield from hashes(part, role)


def describe_all(findings: Sequence[Record]) -> list[str]:
    """Findings as lines with their remedies. Findings with the same code about several snapshots share a line."""
    groups: dict[tuple[str, bool], list[Record]] = {}
    for finding in findings:
        groups.setdefault((finding["code"], finding.get("snapshot") is not None), []).append(finding)
    return [
        describe(group[0], [finding["snapshot"] for finding in group if finding.get("snapshot") is not None])
        for group in groups.values()
    ]


def describe(finding: Record, snapshots: Sequence[int]) -> str:
    numbers = ", ".join(map(str, snapshots[:9])) + (f" and {len(snapshots) - 9} more" if len(snapshots) > 9 else "")
    place = f"snapshot{'s' if len(snapshots) > 1 else ''} {numbers}: " if snapshots else ""
    detail, remedy = finding["detail"].rstrip("."), finding["remedy"].rstrip(".")
    return f"{finding['severity']} {finding['code']}: {place}{detail}. Remedy: {remedy}."


def preview(frames: npt.NDArray[np.float32], white: float, side: int = 256) -> bytes:
    """An animated PNG of frames [B, H, W] or [B, H, W, 3]: ten frames per second, displayed from 0 to `white`. The
    longer side is reduced to about `side` pixels."""
    from PIL import Image

    step = max(1, round(max(frames.shape[1:3]) / side))
    small = frames[:, ::step, ::step]
    pictures = [Image.fromarray(np.uint8(np.clip(frame / white, 0, 1) * 255)) for frame in small]
    file = io.BytesIO()
    pictures[0].save(file, "PNG", save_all=True, append_images=pictures[1:], duration=100, loop=0)
    return file.getvalue()


class Bar:
    """A progress bar of tqdm, which appears with the first progress. Does nothing unless `shown`."""

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
