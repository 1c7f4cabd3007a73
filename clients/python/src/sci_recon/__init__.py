"""Python client of sci-recon.

>>> from sci_recon import Client
>>> result = Client("http://server.lab:8080").reconstruct(masks, measurement, algorithm="gap-tv")
>>> result.frames.shape  # [frame, row, column], float32
"""

from ._client import Calibration, Client, Job, Measurement, Result
from ._errors import ApiError, CalibrationFailed, ConnectionWarning, FindingWarning, JobFailed, SciReconError

__all__ = [
    "ApiError",
    "Calibration",
    "CalibrationFailed",
    "Client",
    "ConnectionWarning",
    "FindingWarning",
    "Job",
    "JobFailed",
    "Measurement",
    "Result",
    "SciReconError",
]
