"""Decodes a job's movies and compares them frame by frame with the PNGs of its frames.

Usage: read_movies.py URL JOB SNAPSHOTS, with SCI_RECON_TOKEN. Prints one JSON line.
"""

import io
import json
import os
import sys
import time
import urllib.request

import av
import numpy as np
from PIL import Image


def main():
    url, job, count = sys.argv[1], sys.argv[2], int(sys.argv[3])
    headers = {"Authorization": f"Bearer {os.environ['SCI_RECON_TOKEN']}"}

    def get(path):
        with urllib.request.urlopen(urllib.request.Request(f"{url}/v1/jobs/{job}{path}", headers=headers)) as answer:
            return answer.status, answer.headers, answer.read()

    def made(path):
        while True:
            status, fields, content = get(path)
            if status == 200:
                assert fields["Content-Type"] == "video/mp4" and int(fields["Content-Length"]) == len(content)
                return content
            assert status == 202 and int(fields["Retry-After"]) > 0
            body = json.loads(content)
            assert body["state"] in ("waiting", "running") and 0 <= body["percent"] <= 100, body
            time.sleep(0.2)

    def pictures(snapshot):
        files = json.loads(get(f"/snapshots/{snapshot}")[2])["files"]
        frames = sum(file["name"].startswith("png/") for file in files)
        for frame in range(1, frames + 1):
            yield levels(Image.open(io.BytesIO(get(f"/snapshots/{snapshot}/frames/{frame}.png")[2])))

    clips = {f"/snapshots/{index}": np.stack(list(pictures(index))) for index in range(count)}
    clips["/sequence"] = np.concatenate(list(clips.values()))
    told = {"psnr_db": [], "bytes": {}}
    for place, expected in clips.items():
        content = made(f"{place}/movie.mp4")
        with av.open(io.BytesIO(content)) as movie:
            stream = movie.streams.video[0]
            assert stream.codec_context.name == "libdav1d" and stream.average_rate == 10
            assert stream.frames == len(expected) and stream.duration * stream.time_base * 10 == len(expected)
            assert (stream.codec_context.height, stream.codec_context.width) == expected.shape[1:3]
            # BT.709 with limited range.
            assert (stream.codec_context.colorspace, stream.codec_context.color_range) == (1, 1)
            told["title"] = stream.metadata.get("handler_name")
            found = [frame.to_ndarray(format="rgb24") for frame in movie.decode(stream)]
        assert len(found) == len(expected)
        for frame, picture in zip(found, expected, strict=True):
            error = np.square(frame - picture.reshape(*frame.shape[:2], -1).astype(float)).mean()
            told["psnr_db"].append(round(10 * np.log10(255**2 / max(error, 1e-9)), 2))
        told["bytes"][place] = len(content)
    assert min(told["psnr_db"]) > 40, told
    print(json.dumps(told))


def levels(picture):
    """A 16-bit image reduced to 8 bits. PIL reduces colour images when it reads them."""
    values = np.asarray(picture)
    return values if values.dtype == np.uint8 else np.round(values / 257.0)


main()
