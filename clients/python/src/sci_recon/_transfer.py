"""Files to the service and back, over connections that break."""

from __future__ import annotations

import hashlib
import os
import random
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import httpx
import numpy as np
import numpy.typing as npt
import requests
from tusclient.client import TusClient
from tusclient.exceptions import TusCommunicationError, TusUploadFailed

from ._errors import ApiError, SciReconError

Source = str | os.PathLike[str] | npt.NDArray[Any]
Progress = Callable[[int, int], None]

PIECE = 4 << 20
# About five minutes until the last try.
TRIES = 16
# Statuses of a service that is starting, stopping or full, of a proxy before it, and of an upload whose piece
# before the cut is still being written.
PASSING = {408, 423, 429, 502, 503, 504}


def pause(attempt: int, retry_after: str | None = None) -> None:
    """Waits as long as the service says, or twice as long each time up to 30 s; not all clients at once."""
    if retry_after and retry_after.isdigit():
        time.sleep(min(int(retry_after), 60))
    else:
        time.sleep(min(0.1 * 2**attempt, 30) * random.uniform(0.5, 1))


def address(http: httpx.Client, path: str) -> str:
    """A path of the service, which may be below another one of a proxy."""
    return str(http.base_url).rstrip("/") + path


def refused(response: httpx.Response) -> ApiError:
    """The error of an answer that has been read."""
    try:
        problem = response.json()
    except ValueError:
        problem = {}
    if not isinstance(problem, dict) or "detail" not in problem:
        problem = {"detail": response.text[:200] or response.reason_phrase}
    return ApiError(response.status_code, problem)


def send(http: httpx.Client, method: str, path: str, **options: Any) -> httpx.Response:
    """One request, again after a cut or a passing refusal; it must do no harm when it arrives twice."""
    for attempt in range(TRIES):
        last = attempt == TRIES - 1
        try:
            response = http.request(method, path, **options)
        except httpx.TransportError as error:
            if last or isinstance(error, httpx.UnsupportedProtocol):
                raise SciReconError(f"{method} {address(http, path)}: {error}") from error
            pause(attempt)
            continue
        if response.is_success or response.status_code == 304:
            return response
        refusal = refused(response)
        if last or response.status_code not in PASSING or refusal.problem.get("retryable") is False:
            raise refusal
        pause(attempt, response.headers.get("Retry-After"))
    raise AssertionError("unreachable")


@contextmanager
def as_file(source: Source) -> Iterator[Path]:
    """The file itself, or an array as an npy file that goes away afterwards."""
    if isinstance(source, np.ndarray):
        # In a folder: Windows can't open a temporary file twice.
        with TemporaryDirectory(prefix="sci-recon-") as folder:
            path = Path(folder, "array.npy")
            np.save(path, np.ascontiguousarray(source))
            yield path
    else:
        path = Path(source)
        if not path.is_file():
            raise FileNotFoundError(f"{path} is no file")
        yield path


def upload(http: httpx.Client, path: Path, progress: Progress | None = None) -> str:
    """Sends a file in pieces, going on where it was after each cut. Gives its SHA-256."""
    size = path.stat().st_size
    digest = sha256(path)
    try:
        send(http, "GET", f"/v1/blobs/{digest}")
        return digest
    except ApiError as error:
        if error.status != 404:
            raise
    authorization = {name: http.headers[name] for name in ("Authorization",) if name in http.headers}
    tus = TusClient(address(http, "/v1/uploads"), headers=authorization)
    uploader: Any = None
    attempt = 0
    while uploader is None or uploader.offset < size:
        try:
            if uploader is None:
                metadata = {"filename": path.name, "sha256": digest}
                uploader = tus.uploader(str(path), chunk_size=PIECE, metadata=metadata)
            elif attempt:
                before = uploader.offset
                uploader.offset = uploader.get_offset()
                # A piece that was cut counts as far as it came.
                attempt = 1 if uploader.offset > before else attempt
            while uploader.offset < size:
                uploader.upload_chunk()
                attempt = 0
                if progress:
                    progress(uploader.offset, size)
        except (TusCommunicationError, TusUploadFailed, requests.RequestException) as error:
            status = getattr(error, "status_code", None)
            if status in {404, 410}:  # What had come is gone: from the beginning.
                uploader, status = None, None
            if status == 409:  # An answer was lost, not its piece: the service says where to go on.
                status = None
            attempt += 1
            if attempt == TRIES or status not in PASSING | {None}:
                raise upload_refused(error) from None
            pause(attempt)
    return digest


def upload_refused(error: Exception) -> SciReconError:
    status, content = getattr(error, "status_code", None), getattr(error, "response_content", None)
    if status is None:
        return SciReconError(f"upload: {error}")
    return refused(httpx.Response(status, content=content or b""))


def sha256(path: Path) -> str:
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


def download(http: httpx.Client, href: str, path: Path, expected: str, progress: Progress | None = None) -> None:
    """Fetches a result, going on where it was after each cut, and checks its SHA-256."""
    path.parent.mkdir(parents=True, exist_ok=True)
    # A cut may have been in another process: the hash in its name tells whose beginning it is.
    part = path.with_name(f".{path.name}.{expected[:16]}.part")
    attempt = 0
    while True:
        have = part.stat().st_size if part.exists() else 0
        headers = {"Accept-Encoding": "identity"}
        if have:
            headers |= {"Range": f"bytes={have}-", "If-Range": f'"{expected}"'}
        try:
            with http.stream("GET", href, headers=headers) as response:
                if response.status_code == 416:  # All of it had come.
                    break
                if not response.is_success:
                    response.read()
                    error = refused(response)
                    if response.status_code not in PASSING:
                        raise error
                    raise httpx.ReadError(str(error))
                resumed = response.status_code == 206
                total = int(response.headers["Content-Length"]) + (have if resumed else 0)
                with part.open("ab" if resumed else "wb") as file:
                    for block in response.iter_raw():
                        file.write(block)
                        attempt = 0
                        if progress:
                            progress(file.tell(), total)
                break
        except httpx.TransportError as error:
            attempt += 1
            if attempt == TRIES:
                raise SciReconError(f"GET {href}: {error}") from error
            pause(attempt)
    found = sha256(part)
    if found != expected:
        part.unlink()
        raise SciReconError(f"{href}: the file's SHA-256 is {found}, not {expected}")
    part.replace(path)
