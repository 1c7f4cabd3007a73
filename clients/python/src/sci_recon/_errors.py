"""What can go wrong. All errors of this package are `SciReconError`."""

from __future__ import annotations

from typing import Any


class SciReconError(Exception):
    """The service, a job of it, or the way to it has failed."""


class ApiError(SciReconError):
    """The service has refused a request (RFC 9457).

    `status` is that of HTTP, `code` never changes and is listed in the contract, `problem` is the whole answer.
    """

    def __init__(self, status: int, problem: dict[str, Any]) -> None:
        self.status = status
        self.problem = problem
        self.code: str = problem.get("code", "")
        self.retryable = bool(problem.get("retryable"))
        detail = problem.get("detail") or problem.get("title") or ""
        errors = problem.get("errors", [])
        # A detail that the errors repeat is said once.
        summary = [] if any(detail in error["detail"] for error in errors) else [detail]
        parts = summary + [f"{error['pointer']}: {error['detail']}" for error in errors]
        super().__init__(f"{status} {self.code}".strip() + ": " + " ".join(part for part in parts if part))


class CalibrationFailed(SciReconError):
    """No masks could be made of the captures; the message has the reason."""


class JobFailed(SciReconError):
    """The job has failed or was cancelled. `job` is its last state."""

    def __init__(self, job: dict[str, Any]) -> None:
        self.job = job
        reason = job.get("error") or "it was cancelled"
        super().__init__(f"job {job['id']} ({job['state']}): {reason}")
