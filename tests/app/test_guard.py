"""What the server refuses, asked by plain sockets and by HTTP, without a browser."""

from __future__ import annotations

import http.client
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

import pytest

pytest.importorskip("tornado")
from en4dvar_app.server import names_code


@pytest.fixture
def server(tmp_path: Path) -> Iterator[tuple[str, int, str, Path]]:
    """Host, port, path with the secret, folder."""
    folder = tmp_path / "movies"
    folder.mkdir()
    (tmp_path / "secret.html").write_text("secret")
    (folder / "way.html").symlink_to(tmp_path / "secret.html")
    (folder / "fine.html").write_text("fine")
    (folder / "a.mp4").write_bytes(b"")
    process = subprocess.Popen(
        [sys.executable, "-m", "en4dvar.cli", "app", str(folder), "--no-browser"], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    address = urlsplit(process.stdout.readline().strip())
    yield "127.0.0.1", address.port or 0, address.path, folder
    process.terminate()
    process.wait()
    process.stdout.close()


def asked(server, path, method="GET", body=None, **headers):
    connection = http.client.HTTPConnection(server[0], server[1], timeout=20)
    connection.request(method, path, body, {k.replace("_", "-"): v for k, v in headers.items()})
    answer = connection.getresponse()
    content = answer.read()
    connection.close()
    return answer.status, content


def test_the_page_and_files_of_the_folder_are_served(server):
    assert asked(server, server[2])[0] == 200
    assert asked(server, server[2] + "file/fine.html") == (200, b"fine")


@pytest.mark.parametrize("path", ["/", "/state", "/wrong/", "/wrong/state", "/app.js"])
def test_without_the_secret_there_is_nothing(server, path):
    assert asked(server, path)[0] == 404


@pytest.mark.parametrize("name", ["../secret.html", "..%2fsecret.html", "way.html", "%2fetc%2fpasswd", "a.mp4", "%00"])
def test_files_outside_and_of_other_kinds_are_not_served(server, name):
    status, content = asked(server, server[2] + "file/" + name)
    assert status == 404
    assert b"secret" not in content


def test_another_host_or_origin_is_refused(server):
    own = f"http://127.0.0.1:{server[1]}"
    assert asked(server, server[2], Host="evil.example")[0] == 403
    assert asked(server, server[2] + "state", Origin="http://evil.example")[0] == 403
    post = server[2] + "keep"
    body = '{"movie": "a.mp4", "config": "name: a"}'
    assert asked(server, post, "POST", body)[0] == 403
    assert asked(server, post, "POST", body, Origin="null")[0] == 403
    assert not (server[3] / "a.yaml").exists()
    assert asked(server, post, "POST", body, Origin=own)[0] == 200
    assert (server[3] / "a.yaml").read_text() == "name: a"


@pytest.mark.parametrize("movie", ["../a.mp4", "--help", "-x.mp4", "", "a\\u0000.mp4", "way.html/../a.mp4"])
def test_hostile_names_start_nothing(server, movie):
    own = f"http://127.0.0.1:{server[1]}"
    assert asked(server, server[2] + "track", "POST", f'{{"movie": "{movie}"}}', Origin=own)[0] == 404
    assert not (server[3] / ".en4dvar_app").exists()


def test_ten_gigabytes_are_refused_by_their_length(server):
    with socket.create_connection(server[:2], timeout=20) as link:
        head = f"POST {server[2]}keep HTTP/1.1\r\nHost: 127.0.0.1:{server[1]}\r\nContent-Length: 10000000000\r\n\r\n"
        link.sendall(head.encode())
        assert b"200" not in link.recv(100)[:20]


def test_a_configuration_that_names_code_is_not_run(server):
    own = f"http://127.0.0.1:{server[1]}"
    (server[3] / "a.yaml").write_text("model: {name: bubble, law: evil.py:Law}")
    status, content = asked(server, server[2] + "run", "POST", '{"movie": "a.mp4"}', Origin=own)
    assert status == 403
    assert b"evil.py:Law" in content
    assert not (server[3] / ".en4dvar_app").exists()


@pytest.mark.parametrize(
    "text", ["model: {name: command}", "model: {name: x.py:M}", "a: 1", "model: {name: bubble, law: 'pkg.mod:Law'}"]
)
def test_only_configurations_without_code_pass(text):
    assert names_code(text)
    assert not names_code("model: {name: bubble, law: neo-hookean-kelvin-voigt}\ndata: {path: a.csv}")
