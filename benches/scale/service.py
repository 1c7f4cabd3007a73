"""A service in a new folder, used over HTTP."""
import json
import os
import pathlib
import subprocess
import sys
import threading
import urllib.error
import urllib.request

import numpy as np


class Service:
    def __init__(self, binary, folder, options):
        self.process = subprocess.Popen([binary, 'serve', '--data', folder, '--listen', '127.0.0.1:0', *options], stdout=subprocess.PIPE,
                                        stderr=subprocess.DEVNULL, text=True)
        self.url = json.loads(self.process.stdout.readline())['url']
        threading.Thread(target=self.process.stdout.read, daemon=True).start()
        self.memory = {}

    def call(self, method, path, body=None, headers=()):
        if isinstance(body, dict):
            body, headers = json.dumps(body).encode(), {'Content-Type': 'application/json'}
        request = urllib.request.Request(self.url + path, method=method, data=body, headers=dict(headers))
        try:
            with urllib.request.urlopen(request) as answer:
                return json.load(answer)
        except urllib.error.HTTPError as error:
            sys.exit(f'{method} {path}: {error.code} {error.read().decode()}')

    def upload(self, path):
        with open(path, 'rb') as file:   # streamed
            headers = {'Content-Type': 'application/octet-stream', 'Content-Length': os.path.getsize(path)}
            return self.call('POST', '/v1/blobs', file, headers)['sha256']

    def look(self):
        """Peak resident memory so far, by process."""
        children = pathlib.Path(f'/proc/{self.process.pid}/task').glob('*/children')
        workers = ' '.join(path.read_text() for path in children).split()
        for name, pid in [('server', self.process.pid), *((f'worker {pid}', pid) for pid in workers)]:
            try:
                line = next(line for line in open(f'/proc/{pid}/status') if line.startswith('VmHWM'))
            except (OSError, StopIteration):
                continue
            self.memory[name] = int(line.split()[1]) * 1024

    def array(self, path, file):
        """A .npy file that is downloaded to `file`."""
        with urllib.request.urlopen(self.url + path) as answer:
            pathlib.Path(file).write_bytes(answer.read())
        return np.load(file)
