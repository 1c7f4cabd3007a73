"""Runs a lab's workflow with clients/python, from the files in FOLDER to the downloaded frames.

Usage: python_client.py FOLDER, with SCI_RECON_URL and SCI_RECON_TOKEN. Prints one JSON line.
"""

import json
import sys
from pathlib import Path

import numpy as np
from sci_recon import ApiError, Client


def main():
    folder = Path(sys.argv[1])
    masks = np.load(folder / "masks.npy")
    with Client() as client:
        result = client.reconstruct(masks, folder / "measurement.npy", "gap-tv", folder=folder / "result")
        frames = result.frames
        snapshots, count = len(result.snapshots), len(masks)
        assert frames.shape == (snapshots * count, *masks.shape[1:]) and frames.dtype == np.float32
        measurement = np.load(folder / "measurement.npy")
        for snapshot in range(snapshots):
            again = (masks * frames[snapshot * count :][:count]).sum(axis=0)
            difference = np.linalg.norm(again - measurement[snapshot]) / np.linalg.norm(measurement[snapshot])
            assert difference < 0.05, f"snapshot {snapshot} does not fit its measurement: {difference}"
        stack = result.download("stack.exr", snapshot=1)
        assert stack.read_bytes()[:4] == bytes([0x76, 0x2F, 0x31, 0x01])
        error, blocks = result.expected_error(1), np.load(result.download("error.npy", snapshot=1))
        k, i, j = np.indices(result.snapshot(1).shape)
        assert (error == blocks[k, i // 16, j // 16]).all()
        assert result.assessment == client.job(result.job.id).record["assessment"] is not None
        for movie in (result.movie(), result.movie(snapshot=1)):
            assert movie.read_bytes()[4:8] == b"ftyp" and movie.parent.parent == folder / "result"
        assert not list(stack.parent.glob("*.part"))
        assert result.manifest["content"]["schedule"]
        text = repr(result)
        assert result.job.verdict in text and f"{len(frames)} frames of {frames.shape[1]}x{frames.shape[2]}" in text, text
        # A rejection raises the service's message, without a retry.
        try:
            client.reconstruct(masks * 3, measurement, "gap-tv")
            raise AssertionError("masks above their full scale were accepted")
        except ApiError as error:
            assert error.code == "invalid_content" and "full_scale" in str(error), error
            assert str(error).count("above the full scale") == 1, error
        # Another process can continue with the job's identifier.
        later = client.job(result.job.id).wait(timeout=10)
        assert later.state == "succeeded" and [job.id for job in client.jobs()] == [later.id]
        print(json.dumps({"job": later.id, "frames": list(frames.shape)}))


main()
