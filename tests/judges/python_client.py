"""Runs a lab's workflow with clients/python, from the files in FOLDER to the downloaded frames.

Usage: python_client.py FOLDER, with SCI_RECON_URL and SCI_RECON_TOKEN. Prints one JSON line.
"""

import io
import json
import os
import re
import socket
import sys
import uuid
import warnings
from base64 import b64decode
from pathlib import Path

import httpx
import npe2
import numpy as np
import sci_recon
from PIL import Image
from sci_recon import ApiError, Client


def napari(result):
    """Opens the job by its addresses, and a folder of results, as napari does."""
    manager = npe2.PluginManager.instance()
    manifest = npe2.PluginManifest.from_file(Path(sci_recon.__file__).parent / "napari.yaml")
    manifest.validate_imports()
    manager.register(manifest)
    folder = result.download("frames.npy", result.snapshots[0]).parent
    (folder / "manifest.json").write_text(json.dumps(result.manifest))
    url, job = os.environ["SCI_RECON_URL"], result.job
    expected = {
        f"{url}/v1/jobs/{job.id}": result.frames,
        f"{url}/#/jobs/{job.id}": result.frames,
    }
    expected[str(folder)] = result.snapshot(result.snapshots[0])
    for path, frames in expected.items():
        [(data, settings, kind)] = npe2.read([path], stack=False)
        assert kind == "image" and np.array_equal(data, frames), path
        white = result.manifest["content"]["scale"]["white_level"]
        assert not settings["rgb"] and settings["contrast_limits"] == (0.0, white), settings
    try:
        npe2.read([str(folder / "frames.npy")], stack=False)
        raise AssertionError("a file of another plugin was opened")
    except ValueError:
        pass


def jupyter(result):
    """The preview that a notebook shows."""
    text = result._repr_html_()
    assert result.job.verdict in text, text
    picture = Image.open(io.BytesIO(b64decode(re.search(r"base64,([^\"]+)", text)[1])))
    frames = result.snapshot(result.snapshots[0])
    height, width = frames.shape[1:3]
    assert picture.n_frames == len(frames) and 64 <= max(picture.size) <= 384, picture
    assert abs(picture.width / picture.height - width / height) < 0.02, picture
    step = max(1, round(max(height, width) / 256))
    white = result.manifest["content"]["scale"]["white_level"]
    expected = np.uint8(np.clip(frames[0][::step, ::step] / white, 0, 1) * 255)
    assert np.array_equal(np.asarray(picture.convert("L")), expected), "white is the white level of the job"


def unreachable():
    """A service that is down is named before the request is repeated."""
    sci_recon._transfer.TRIES = 2
    with (
        warnings.catch_warnings(record=True) as issued,
        Client("http://127.0.0.1:9") as client,
    ):
        warnings.simplefilter("always")
        try:
            list(client.jobs())
            raise AssertionError("there is no service")
        except sci_recon.SciReconError as error:
            assert "127.0.0.1:9" in str(error), error
    found = [str(warning.message) for warning in issued if warning.category is sci_recon.ConnectionWarning]
    assert len(found) == 1 and "127.0.0.1:9" in found[0], issued


def concurrent(client, calibration, shots):
    """The example of the README for asyncio."""
    text = Path("clients/python/README.md").read_text()
    [example] = [block for block in re.findall(r"```python\n(.*?)```", text, re.S) if "asyncio" in block]
    names = {"client": client, "calibration": calibration, "shots": shots}
    exec(example, names)
    return names["results"]


def repeated(client, result, folder):
    """A job that is repeated from its manifest has the same frames; missing inputs are named."""
    again = client.repeat(result.manifest, label="again").wait()
    assert again.id != result.job.id and again.record["label"] == "again"
    assert again.differences(result.manifest) == []
    unknown = json.loads(json.dumps(result.manifest))
    unknown["run"]["calibration"] = unknown["run"]["measurement"] = str(uuid.uuid4())
    unknown["content"]["inputs"]["measurement"]["data"] = "0" * 64
    try:
        client.repeat(unknown, [folder / "masks.npy"])
        raise AssertionError("a job without its measurement was submitted")
    except ValueError as error:
        assert "measurement with the SHA-256 " + "0" * 64 in str(error) and "masks with" not in str(error), error
    other = json.loads(json.dumps(result.manifest))
    [file] = [file for file in other["content"]["snapshots"][1]["files"] if file["name"] == "frames.npy"]
    file["sha256"] = "0" * 64
    assert again.differences(other) == [1]
    again.delete()


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
        error, blocks = (
            result.expected_error(1),
            np.load(result.download("error.npy", snapshot=1)),
        )
        k, i, j = np.indices(result.snapshot(1).shape)
        assert (error == blocks[k, i // 16, j // 16]).all()
        assert result.assessment == client.job(result.job.id).record["assessment"] is not None
        assert result.movie(format="gif").read_bytes()[:6] == b"GIF89a"
        for movie in (result.movie(), result.movie(snapshot=1)):
            assert movie.read_bytes()[4:8] == b"ftyp" and movie.parent.parent == folder / "result"
        assert not list(stack.parent.glob("*.part"))
        assert result.manifest["content"]["schedule"]
        text = repr(result)
        assert result.job.verdict in text and f"{len(frames)} frames of {frames.shape[1]}x{frames.shape[2]}" in text, (
            text
        )
        napari(result)
        jupyter(result)
        tiff = result.download("stack.tif", snapshot=1)
        content = tiff.read_bytes()
        assert content[:2] == b"II"
        # Neither a file of another job nor an incomplete file is taken for the export.
        tiff.write_bytes(bytes(len(content)))
        etag = client.http.head(f"/v1/jobs/{result.job.id}/snapshots/1/exports/tiff").headers["ETag"].strip('"')
        tiff.with_name(f".stack.tif.{etag[:16]}.part").write_bytes(bytes(1000))
        again = sci_recon.Result(result.job, folder / "result")
        assert again.download("stack.tif", snapshot=1) == tiff and tiff.read_bytes() == content
        assert (client.calibration(result.job.record["calibration"]).masks() == masks).all()
        with warnings.catch_warnings(record=True) as issued:
            warnings.simplefilter("always")
            wrong = client.reconstruct(masks[:, ::-1], measurement, "gap-tv")
        found = [str(warning.message) for warning in issued if warning.category is sci_recon.FindingWarning]
        assert found and all("Remedy: " in text for text in found), issued
        assert len({text.split(":")[0] for text in found}) == len(found), "a line for each finding"
        code = wrong.job.findings[0]["code"]
        assert code in found[0] and code in repr(wrong) and code in wrong._repr_html_(), (found, wrong)
        wrong.job.delete()
        # A rejection raises the service's message, without a retry.
        try:
            client.reconstruct(masks * 3, measurement, "gap-tv")
            raise AssertionError("masks above their full scale were accepted")
        except ApiError as error:
            assert error.code == "invalid_content" and "full_scale" in str(error), error
            assert str(error).count("above the full scale") == 1, error
        repeated(client, result, folder)
        calibration = client.calibration(result.job.record["calibration"])
        found = concurrent(client, calibration, list(measurement))
        assert [len(one.frames) for one in found] == [count] * snapshots
        for one in found:
            one.job.delete()
        # Another process can continue with the job's identifier.
        later = client.job(result.job.id).wait(timeout=10)
        assert later.state == "succeeded" and later.id in [job.id for job in client.jobs()]
        unreachable()
        print(json.dumps({"job": later.id, "frames": list(frames.shape)}))


main()
