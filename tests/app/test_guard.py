"""What the server refuses, asked by plain sockets and by HTTP, without a browser."""

from __future__ import annotations

import errno
import json
import shutil
import socket
from pathlib import Path

import pytest

from en4dvar.plumbing.errors import OutputError
from en4dvar_app import job

CONFIG = "name: a\nmodel: {name: bubble, law: neo-hookean-kelvin-voigt}\ndata: {path: a.csv}\n"


@pytest.fixture(scope="module")
def process(serve, tmp_path_factory):
    """One server for all tests: it holds nothing, the folder does."""
    folder = tmp_path_factory.mktemp("app") / "movies"
    folder.mkdir()
    return serve(folder)


@pytest.fixture
def server(process):
    folder, outside = process.folder, process.folder.parent
    shutil.rmtree(folder)
    folder.mkdir()
    (outside / "secret.html").write_text("secret")
    (outside / "secret.csv").write_text("t,R\n1,1\n2,2\n3,3\n")
    (folder / "way.html").symlink_to(outside / "secret.html")
    (folder / "way.csv").symlink_to(outside / "secret.csv")
    (folder / "fine.html").write_text("fine")
    (folder / "a.csv").write_text("t,R\n1,1\n2,2\n3,3\n")
    (folder / "a.yaml").write_text(CONFIG)
    (folder / "a.mp4").write_bytes(b"")
    return process


def test_the_page_and_files_of_the_folder_are_served(server):
    status, _ = server.ask(server.secret, Cookie="")
    assert status == 302
    for name in ("", "app.js", "movie.js", "plot.js", "app.css", "state", "look/laws"):
        assert server.ask(f"/{name}")[0] == 200, name
    assert server.ask("/file/fine.html") == (200, b"fine")


@pytest.mark.parametrize("path", ["/", "/state", "/wrong/", "/app.js", "/file/fine.html", "/look/table?table=a.csv"])
@pytest.mark.parametrize("cookie", ["", "en4dvar=x", "en4dvar-{port}=wrong", "en4dvar-{port}=\u00e9"])
def test_without_the_secret_there_is_nothing(server, path, cookie):
    assert server.ask(path, Cookie=cookie.format(port=server.port))[0] == 404


@pytest.mark.parametrize(
    "name", ["../secret.html", "..%2fsecret.html", "way.html", "%2fetc%2fpasswd", "a.mp4", "a.yaml", "%00", "-x.html"]
)
def test_files_outside_and_of_other_kinds_are_not_served(server, name):
    status, content = server.ask(f"/file/{name}")
    assert status == 404
    assert b"secret" not in content


def test_another_host_or_origin_is_refused(server):
    assert server.ask("/", Host="evil.example")[0] == 403
    assert server.ask(server.secret, Host="evil.example")[0] == 403
    assert server.ask("/state", Origin="http://evil.example")[0] == 403
    assert server.ask("/state", Sec_Fetch_Site="cross-site")[0] == 403
    body = json.dumps({"config": "a.yaml", "before": CONFIG, "text": "name: b"})
    for origin in ("", "null", "http://evil.example", f"https://127.0.0.1:{server.port}"):
        assert server.ask("/keep", "POST", body, Origin=origin)[0] == 403
    assert (server.folder / "a.yaml").read_text() == CONFIG
    assert server.ask("/keep", "POST", body)[0] == 200
    assert (server.folder / "a.yaml").read_text() == "name: b"


def test_it_listens_on_the_loopback_only(server):
    own = socket.gethostbyname(socket.gethostname())
    if own.startswith("127."):
        pytest.skip("this machine has no other address")
    with pytest.raises(OSError, match="refused"):
        socket.create_connection((own, server.port), timeout=5)


@pytest.mark.parametrize("name", ["../a.mp4", "--help", "-x.mp4", "", "a\0.mp4", "movies/../../a", "/etc/passwd", "."])
def test_hostile_names_start_nothing(server, name):
    for step, key in (("track", "movie"), ("init", "table"), ("validate", "config")):
        status, words = server.post(step, **{key: name, "proposal": "x", "run": "x"})
        assert status == 400, words
    for step, key in (("run", "run"), ("init", "proposal")):
        status, words = server.post(step, **{"config": "a.yaml", "table": "a.csv", key: f"{name}/"})
        assert status == 400, words
    assert not (server.folder / ".en4dvar_app").exists()


@pytest.mark.slow
def test_a_name_that_a_shell_would_obey_is_quoted(server):
    (server.folder / "$(touch pwned);x.csv").write_text("t,R\n1,1\n2,2\n3,3\n")
    fields = {"table": "$(touch pwned);x.csv", "time-unit": "us", "radius-unit": "um", "proposal": "p.yaml"}
    assert server.post("init", **fields)[0] == 200
    assert "'--data=$(touch pwned);x.csv'" in server.last()["line"]
    assert not (server.folder / "pwned").exists()


def test_ten_gigabytes_are_refused_by_their_length(server):
    with socket.create_connection(("127.0.0.1", server.port), timeout=20) as link:
        head = f"POST /keep HTTP/1.1\r\nHost: 127.0.0.1:{server.port}\r\nContent-Length: 10000000000\r\n\r\n"
        link.sendall(head.encode())
        assert not link.recv(100).startswith(b"HTTP/1.1 200")
    status, _ = server.ask("/state")
    assert status == 200


def test_what_somebody_edited_is_never_replaced(server):
    status, words = server.post("init", table="a.csv", proposal="a.yaml")
    assert (status, words) == (400, "a.yaml: exists and is not replaced; give the new proposal another name")
    status, words = server.post("track", movie="a.mp4", pixel="1 um")
    assert status == 400
    assert "was not read from a movie" in words
    (server.folder / "runs" / "a").mkdir(parents=True)
    status, words = server.post("run", config="a.yaml", run="a")
    assert status == 400
    assert "exists and is not replaced" in words
    status, words = server.post("keep", config="a.yaml", before="what another window read", text="mine")
    assert status == 400
    assert "another window or program has changed it" in words
    assert (server.folder / "a.yaml").read_text() == CONFIG


@pytest.mark.slow
@pytest.mark.parametrize(
    "path", ["../secret.csv", "{outside}", "way.csv", "../*.csv", "*.csv", "sub", "~/secret.csv", "{outside}/../*.csv"]
)
def test_a_configuration_reads_nothing_outside_of_the_folder(server, path):
    outside = server.folder.parent / "secret.csv"
    (server.folder / "sub").mkdir()
    (server.folder / "sub" / "way.csv").symlink_to(outside)
    (server.folder / "a.yaml").write_text(CONFIG.replace("a.csv", f"'{path.format(outside=outside)}'"))
    assert server.post("validate", config="a.yaml")[0] == 200
    ended = server.last()
    assert ended["state"] == "failed"
    assert "outside of the folder" in ended["output"]


LAW = (
    "import pathlib\npathlib.Path(__file__).with_name('ran').touch()\nfrom en4dvar_bubble.laws.kelvin_voigt import *\n"
)
NAMED = {
    "law": "model: {name: bubble, law: evil.py:Law}",
    "model": "model: {name: evil.py:Model}",
    "module": "model: {name: evil:Model}",
    "program": "model: {command: 'touch ran', parameters: {a: '1'}, templates: t, outputs: {y: {file: o, column: 1}}}",
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", NAMED)
def test_a_configuration_that_names_code_is_not_run(server, kind):
    for name in ("evil.py", "numpy.py", "click.py"):
        (server.folder / name).write_text(LAW)
    (server.folder / "t").write_text("")
    (server.folder / "a.yaml").write_text(f"name: a\n{NAMED[kind]}\ndata: {{path: a.csv}}\n")
    for step in ("validate", "run"):
        assert server.post(step, config="a.yaml", run="b")[0] == 200
        ended = server.last()
        assert ended["state"] == "failed"
        assert "--trust" in ended["output"] or kind == "module", ended["output"]
        assert not (server.folder / "ran").exists()


@pytest.mark.slow
def test_code_is_run_with_trust(serve, tmp_path):
    (tmp_path / "evil.py").write_text(LAW)
    (tmp_path / "a.csv").write_text("t,R\n1,1\n2,2\n3,3\n")
    (tmp_path / "a.yaml").write_text(f"name: a\n{NAMED['law']}\ndata: {{path: a.csv}}\n")
    server = serve(tmp_path, "--trust")
    assert server.post("validate", config="a.yaml")[0] == 200
    server.last()
    assert Path(tmp_path / "ran").exists()


def test_a_command_that_is_cancelled_before_it_begins_says_so(server):
    assert server.post("validate", config="a.yaml")[0] == 200
    server.post("cancel")
    ended = server.last()
    assert ended["state"] == "stopped"
    assert ended["output"] == "cancelled before the command had begun: nothing was done; click again to begin\n"


def test_a_link_to_elsewhere_in_place_of_the_jobs_is_refused(server, tmp_path):
    (tmp_path / "jobs").mkdir()
    (server.folder / ".en4dvar_app").symlink_to(tmp_path / "jobs")
    assert server.post("validate", config="a.yaml")[0] == 400
    assert list((tmp_path / "jobs").iterdir()) == []


def test_jobs_that_somebody_else_prepared_are_not_run(server):
    jobs = server.folder / ".en4dvar_app"
    for name, text in (("1", '{"step": "run", "subject": "", "words": ["--version"]}'), ("2", "[]"), ("x", "{}")):
        (jobs / name).mkdir(parents=True)
        (jobs / name / "command.json").write_text(text)
    assert [each["state"] for each in server.state()["jobs"]] == ["stopped"]
    assert not (jobs / "1" / "output").exists()


TRACKED = (
    "# en4dvar track, version 1: en4dvar track a.tif\n# movie: {}; pixel: 1 um; frame rate: 1 Hz\nframe,t_us,R_um\n"
)


@pytest.mark.parametrize("name", ["b.tif", "elsewhere/b.tif"])
def test_the_table_of_another_movie_of_that_name_is_not_taken_for_its_own(server, name):
    (server.folder / "b.mp4").write_bytes(b"")
    (server.folder / "b.csv").write_text(TRACKED.format(name))
    (server.folder / "b.corrections.txt").write_text("3 out\n")
    before = {path.name: path.read_bytes() for path in server.folder.glob("b.*")}
    told = b"b.csv: was read from b.tif, to which its corrections belong; give b.mp4 another name"
    assert server.ask("/look/movie?movie=b.mp4") == (400, told)
    assert server.ask("/look/text?movie=b.mp4") == (400, told)
    for step in ("track", "keep", "mask"):
        assert server.post(step, movie="b.mp4", before="3 out\n", text="4 out\n") == (400, told.decode())
    assert {path.name: path.read_bytes() for path in server.folder.glob("b.*")} == before
    (server.folder / "b.csv").write_text(TRACKED.format("films/b.mp4"))
    assert json.loads(server.ask("/look/text?movie=b.mp4")[1]) == {"text": "3 out\n"}


def test_a_text_that_is_not_changed_is_not_written(server):
    (server.folder / "a.yaml").write_bytes(CONFIG.replace("\n", "\r\n").encode())
    assert json.loads(server.ask("/look/text?config=a.yaml")[1]) == {"text": CONFIG}
    assert server.post("keep", config="a.yaml", before=CONFIG, text=CONFIG)[0] == 200
    assert (server.folder / "a.yaml").read_bytes().count(b"\r\n") == 3
    (server.folder / "a.yaml").write_text(CONFIG + "# of another program\n")
    status, words = server.post("keep", config="a.yaml", before=CONFIG, text=CONFIG)
    assert status == 400
    assert "another window or program has changed it" in words


def test_a_run_without_a_name_is_asked_for_one(server):
    assert server.post("run", config="a.yaml", run=" ") == (400, "give the run a name")
    assert server.post("run", config="a.yaml", run="a/b") == (400, "give the run a name without '/'")


def test_a_folder_in_which_nothing_can_be_written_is_told_with_what_to_do(tmp_path, monkeypatch):
    def refused(*_, **__):
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr(Path, "mkdir", refused)
    with pytest.raises(OutputError, match=r"no command can write into .*\(Read-only file system\); copy what is in it"):
        job.start(tmp_path, "validate", "a.yaml", ["validate", "a.yaml"], trust=False)
