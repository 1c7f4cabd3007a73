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

    def get(path, body=None):
        address = f"{url}/v1/jobs/{job}{path}"
        content = {"Content-Type": "application/json"} if body else {}
        request = urllib.request.Request(address, data=body and json.dumps(body).encode(), headers=headers | content)
        with urllib.request.urlopen(request) as answer:
            return answer.status, answer.headers, answer.read()

    def made(place, snapshot, movie_format, media_type):
        file = f"{place}/exports/{movie_format}"
        status, fields, _ = get("/exports", {"format": movie_format, "snapshot": snapshot})
        assert status in (200, 202) and fields["Location"] == file.lstrip("/"), fields
        while True:
            status, fields, content = get(file)
            if status == 200:
                assert fields["Content-Type"] == media_type and int(fields["Content-Length"]) == len(content)
                return content
            assert status == 202 and int(fields["Retry-After"]) > 0
            body = json.loads(content)
            assert body["state"] in ("waiting", "running") and 0 <= body["percent"] <= 100, body
            time.sleep(0.2)

    def pictures(snapshot):
        files = json.loads(get(f"/snapshots/{snapshot}")[2])["files"]
        frames = sum(file["name"].startswith("png/") for file in files)
        for frame in range(1, frames + 1):
            yield levels(Image.open(io.BytesIO(get(f"/snapshots/{snapshot}/exports/frames/{frame}.png")[2])))

    clips = {index: np.stack(list(pictures(index))) for index in range(count)}
    clips[None] = np.concatenate(list(clips.values()))
    told = {"psnr_db": [], "bytes": {}}
    for snapshot, expected in clips.items():
        place = "" if snapshot is None else f"/snapshots/{snapshot}"
        content = made(place, snapshot, "mp4", "video/mp4")
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
        compare_gif(made(place, snapshot, "gif", "image/gif"), expected)
    assert min(told["psnr_db"]) > 40, told
    print(json.dumps(told))


def compare_gif(content, expected):
    """Grey levels are exact; rounding to 16 bits first may differ by one. A frame of colours has 256 of them."""
    with av.open(io.BytesIO(content)) as movie:
        stream = movie.streams.video[0]
        assert stream.codec_context.name == "gif" and stream.average_rate == 10, stream
        assert sum(1 for _ in movie.decode(stream)) == len(expected)
    with Image.open(io.BytesIO(content)) as movie:
        assert movie.n_frames == len(expected) and movie.info["loop"] == 0
        for index, picture in enumerate(expected):
            movie.seek(index)
            assert movie.info["duration"] == 100
            error = np.abs(np.asarray(movie.convert("RGB"), float) - picture.reshape(*picture.shape[:2], -1))
            psnr_db = 10 * np.log10(255**2 / max(np.square(error).mean(), 1e-9))
            assert error.max() <= 1 if picture.ndim == 2 else psnr_db > 28, (psnr_db, error.max())


def levels(picture):
    """A 16-bit image reduced to 8 bits. PIL reduces colour images when it reads them."""
    values = np.asarray(picture)
    return values if values.dtype == np.uint8 else np.round(values / 257.0)


main()
