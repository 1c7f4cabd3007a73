"""Uses a service with the client that openapi-python-client generates: upload, calibration, measurement, job, wait, result.

    python round_trip.py ADDRESS TOKEN MASKS MEASUREMENT    CERTIFICATE names the authority of HTTPS

ADDRESS ends in a slash. The result is written to standard output.
"""

import io
import os
import pathlib
import ssl
import sys

from sci_recon_client import AuthenticatedClient
from sci_recon_client.api.blobs import create_blob
from sci_recon_client.api.calibrations import create_calibration
from sci_recon_client.api.jobs import create_job, get_job
from sci_recon_client.api.measurements import create_measurement
from sci_recon_client.api.results import get_snapshot_export
from sci_recon_client.models import Algorithm, GetSnapshotExportFormat, JobRequest, MeasurementRequest, Problem
from sci_recon_client.types import File


def done(answer):
    """The content of an answer that is no problem."""
    if answer is None or isinstance(answer, Problem):
        sys.exit(f"refused: {answer}")
    return answer


def main():
    address, token, *files = sys.argv[1:]
    trusted = ssl.create_default_context(cafile=os.environ.get("CERTIFICATE"))
    client = AuthenticatedClient(address, token, timeout=60, verify_ssl=trusted)
    uploads = [File(io.BytesIO(pathlib.Path(file).read_bytes())) for file in files]
    masks, data = (done(create_blob.sync(client=client, body=upload)).sha256 for upload in uploads)
    calibration = done(create_calibration.sync(client=client, body={"masks": masks}, prefer="wait=20")).id
    request = MeasurementRequest(calibration=calibration, data=data)
    measurement = done(create_measurement.sync(client=client, body=request, prefer="wait=20")).id
    job = done(create_job.sync(client=client, body=JobRequest(algorithm=Algorithm.GAP_TV, measurement=measurement)))
    while job.state in ("queued", "running"):
        job = done(get_job.sync(job.id, client=client, prefer="wait=20"))
    if job.state != "succeeded":
        sys.exit(f"the job is {job.state}: {job.error}")
    result = done(get_snapshot_export.sync(job.id, 0, GetSnapshotExportFormat.NPY, client=client))
    sys.stdout.buffer.write(result.payload.read())


main()
