"""Uploads and downloads that continue after a lost connection."""

from __future__ import annotations

import hashlib
import os
import random
import socket
import ssl
import time
import warnings
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

from ._errors import ApiError, ConnectionWarning, SciReconError

Source = str | os.PathLike[str] | npt.NDArray[Any]
Progress = Callable[[int, int], None]

# Bytes of a piece of an upload.
PIECE = 4 << 20
# Attempts without progress; they take about five minutes.
TRIES = 16
# Statuses that are temporary: the service or a proxy is starting, stopping or overloaded, or the service still writes the
# previous piece of the upload.
PASSING = {408, 423, 429, 502, 503, 504}


def pause(attempt: int, retry_after: str | None = None) -> None:
    """Waits for the time in `Retry-After`, or for a random time that doubles with each attempt, up to 30 s."""
    if retry_after and retry_after.isdigit():
        time.sleep(min(int(retry_after), 60))
    else:
        time.sleep(min(0.1 * 2**attempt, 30) * random.uniform(0.5, 1))


def address(http: httpx.Client, path: str) -> str:
    """The address of a path of the service. A proxy may serve it below a prefix."""
    return str(http.base_url).rstrip("/") + path


def refused(response: httpx.Response) -> ApiError:
    """The error in an answer whose body has been read."""
    try:
        problem = response.json()
    except ValueError:
        problem = {}
    if not isinstance(problem, dict) or "detail" not in problem:
        problem = {"detail": response.text[:200] or response.reason_phrase}
    return ApiError(response.status_code, problem)


def send(http: httpx.Client, method: str, path: str, **options: Any) -> httpx.Response:
    """Sends a request, again after lost connections and temporary errors. The request must be safe to repeat."""
    for attempt in range(TRIES):
        last = attempt == TRIES - 1
        try:
            response = http.request(method, path, **options)
        except httpx.TransportError as error:
            if last or isinstance(error, httpx.UnsupportedProtocol) or is_lasting(error):
                raise SciReconError(f"{method} {address(http, path)}: {error}") from error
            if attempt == 0:
                text = f"{http.base_url} can't be reached ({error}); the request is repeated for about five minutes"
                warnings.warn(text, ConnectionWarning, stacklevel=4)
            pause(attempt)
            continue
        if response.is_success or response.status_code == 304:
            return response
        rejection = refused(response)
        if last or response.status_code not in PASSING or rejection.problem.get("retryable") is False:
            raise rejection
        pause(attempt, response.headers.get("Retry-After"))
    raise AssertionError("unreachable")


def is_lasting(error: BaseException | None) -> bool:
    """True if a repetition would fail, too: the host is unknown, or its certificate is not trusted."""
    while error is not None:
        if isinstance(error, ssl.SSLCertVerificationError):
            return True
        if isinstance(error, socket.gaierror) and error.errno != socket.EAI_AGAIN:
            return True
        error = error.__cause__ or error.__context__
    return False


@contextmanager
def as_file(source: Source) -> Iterator[Path]:
    """The path of a file, or of a temporary npy file with an array."""
    if isinstance(source, np.ndarray):
        # A folder is used because Windows can't open a temporary file twice.
        with TemporaryDirectory(prefix="sci-recon-") as folder:
            path = Path(folder, "array.npy")
            np.save(path, np.ascontiguousarray(source))
            yield path
    else:
        path = Path(source)
        if not path.is_file():
            raise FileNotFoundError(f"{path} does not exist or is not a file")
        yield path


def upload(http: httpx.Client, path: Path, progress: Progress | None = None) -> str:
    """Sends a file in pieces, and resumes after a lost connection. Returns its SHA-256."""
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
                # Counts attempts again from 1 if the service kept a part of the last piece.
                attempt = 1 if uploader.offset > before else attempt
            while uploader.offset < size:
                uploader.upload_chunk()
                attempt = 0
                if progress:
                    progress(uploader.offset, size)
        except (TusCommunicationError, TusUploadFailed, requests.RequestException) as error:
            status = getattr(error, "status_code", None)
            if status in {404, 410}:  # The upload expired or is damaged: start again.
                uploader, status = None, None
            if status == 409:  # The answer to a stored piece was lost: ask for the offset.
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


def download(
    http: httpx.Client,
    href: str,
    path: Path,
    expected: str | None = None,
    progress: Progress | None = None,
) -> None:
    """Downloads a file, resumes after a lost connection, and checks its SHA-256 `expected`. None stands for a file that
    the service composes, for which no hash is recorded."""
    path.parent.mkdir(parents=True, exist_ok=True)
    etag = expected or send(http, "HEAD", href).headers["ETag"].strip('"')
    # The name identifies the content, so that another process can resume its download.
    part = path.with_name(f".{path.name}.{etag[:16]}.part")
    if expected is None:
        # Without a hash nothing could verify the bytes of another process.
        part.unlink(missing_ok=True)
    attempt = 0
    while True:
        received = part.stat().st_size if part.exists() else 0
        headers = {"Accept-Encoding": "identity"}
        if received:
            headers |= {"Range": f"bytes={received}-", "If-Range": f'"{etag}"'}
        try:
            with http.stream("GET", href, headers=headers) as response:
                if response.status_code == 416:  # The file was complete already.
                    break
                if not response.is_success:
                    response.read()
                    error = refused(response)
                    if response.status_code not in PASSING:
                        raise error
                    raise httpx.ReadError(str(error))
                resumed = response.status_code == 206
                total = int(response.headers["Content-Length"]) + (received if resumed else 0)
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
    if expected is not None and (actual := sha256(part)) != expected:
        part.unlink()
        raise SciReconError(f"{href}: the downloaded file has the SHA-256 {actual}, not {expected}; download it again")
    part.replace(path)
