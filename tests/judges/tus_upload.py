"""Uploads a file with the published tus client tuspy, over connections that are cut.

Usage: tus_upload.py URL FILE SHA256 [TOKEN]. Prints one JSON line.
"""

import json
import sys
import time

import requests
from tusclient.client import TusClient
from tusclient.exceptions import TusCommunicationError, TusUploadFailed


def main():
    url, path, sha256, *token = sys.argv[1:]
    headers = {"Authorization": f"Bearer {token[0]}"} if token else {}
    client = TusClient(url, headers=headers)
    cuts = 0
    uploader = None
    while True:
        try:
            if uploader is None:
                uploader = client.uploader(
                    path,
                    chunk_size=256 << 10,
                    metadata={"filename": "masks.npy", "sha256": sha256},
                    upload_checksum=True,
                )
            else:
                uploader.offset = uploader.get_offset()
            uploader.upload()
            break
        except (TusCommunicationError, TusUploadFailed, requests.RequestException) as error:
            if getattr(error, "status_code", None) not in (None, 423):
                raise
            cuts += 1
            if cuts > 2000:
                raise
            time.sleep(0.02)
    print(json.dumps({"cuts": cuts, "url": uploader.url, "offset": uploader.offset}))


main()
