"""A server of the page in a process of its own."""

from __future__ import annotations

import http.client
import json
import os
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

PATIENCE = 120  # s until a command of a test has ended


@dataclass
class Server:
    """``folder`` is served; ``secret`` is the path of the address that was printed."""

    folder: Path
    process: subprocess.Popen[str]
    port: int
    secret: str

    def ask(self, path: str, method: str = "GET", body: Any = None, **headers: str) -> tuple[int, bytes]:
        """Status and content; with the cookie and the own origin unless ``headers`` say otherwise."""
        sent = {"Cookie": f"en4dvar-{self.port}={self.secret.strip('/')}"}
        if method == "POST":
            sent["Origin"] = f"http://127.0.0.1:{self.port}"
        sent |= {key.replace("_", "-"): value for key, value in headers.items()}
        link = http.client.HTTPConnection("127.0.0.1", self.port, timeout=60)
        link.request(method, path, body, {key: value for key, value in sent.items() if value})
        answer = link.getresponse()
        content = answer.read()
        link.close()
        return answer.status, content

    def post(self, step: str, **fields: str) -> tuple[int, str]:
        status, content = self.ask(f"/{step}", "POST", json.dumps(fields))
        return status, content.decode()

    def state(self) -> dict[str, Any]:
        return json.loads(self.ask("/state")[1])

    def last(self) -> dict[str, Any]:
        """The last job, once it has ended."""
        end = time.monotonic() + PATIENCE
        while (job := self.state()["jobs"][-1])["state"] == "running":
            assert time.monotonic() < end, job
            time.sleep(0.1)
        return job

    def end(self) -> None:
        self.process.kill()
        self.process.wait()
        self.process.stdout.close()


def start(folder: Path, *options: str, **variables: str) -> Server:
    """``en4dvar app FOLDER``, with further variables of the environment."""
    words = [sys.executable, "-m", "en4dvar.cli", "app", str(folder), "--no-browser", *options]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True, env={**os.environ, **variables})
    address = urlsplit(process.stdout.readline().strip())
    return Server(folder, process, address.port, address.path)
