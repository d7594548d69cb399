"""Servers of the page, ended after the tests of a file."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from page_server import Server, start


@pytest.fixture(scope="module")
def serve() -> Iterator[Callable[..., Server]]:
    """``serve(folder, *options)``."""
    pytest.importorskip("tornado")
    servers = []

    def started(folder: Path, *options: str) -> Server:
        servers.append(start(folder, *options))
        return servers[-1]

    yield started
    for server in servers:
        server.end()
