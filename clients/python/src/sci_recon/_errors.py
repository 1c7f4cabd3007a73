"""Errors of this package. All of them are subclasses of `SciReconError`."""

from __future__ import annotations

from typing import Any


class SciReconError(Exception):
    """The service, a job, or the connection to the service failed."""


class FindingWarning(UserWarning):
    """A check of the service found a problem of the masks, the measurement or the result."""


class ConnectionWarning(UserWarning):
    """The service can't be reached. The request is repeated for about five minutes."""


class ApiError(SciReconError):
    """The service rejected a request.

    `status` is the HTTP status, and `problem` the whole answer (RFC 9457). The API description lists the values of `code`,
    which never change.
    """

    def __init__(self, status: int, problem: dict[str, Any]) -> None:
        self.status = status
        self.problem = problem
        self.code: str = problem.get("code", "")
        self.retryable = bool(problem.get("retryable"))
        detail = problem.get("detail") or problem.get("title") or ""
        errors = problem.get("errors", [])
        # The message omits the detail if an error repeats it.
        summary = [] if any(detail in error["detail"] for error in errors) else [detail]
        parts = summary + [f"{error['pointer']}: {error['detail']}" for error in errors]
        super().__init__(f"{status} {self.code}".strip() + ": " + " ".join(part for part in parts if part))


class CalibrationFailed(SciReconError):
    """The service could not compute masks from the captures. The message has the reason."""


class JobFailed(SciReconError):
    """The job failed or was cancelled. `job` is its last record."""

    def __init__(self, job: dict[str, Any]) -> None:
        self.job = job
        reason = job.get("error") or "it was cancelled"
        super().__init__(f"job {job['id']} ({job['state']}): {reason}")
