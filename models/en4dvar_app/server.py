"""The server of the page: loopback only, a secret in the address, files below one folder."""

from __future__ import annotations

import asyncio
import json
import re
import secrets
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import tornado.web
import yaml
from tornado.httpserver import HTTPServer
from tornado.netutil import bind_sockets

from en4dvar.plumbing.errors import En4dvarError
from en4dvar.plumbing.files import write_text
from en4dvar_app import job

HERE = Path(__file__).parent
LARGEST = 1_000_000  # bytes of a request: a configuration, never a movie
MOVIES = (".mp4", ".avi", ".mov", ".mkv", ".tif", ".tiff")
KINDS = {".html": "text/html; charset=utf-8", ".css": "text/css", ".js": "text/javascript", ".png": "image/png"}
OWN = "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"  # noqa: E501
RESULT = "sandbox allow-scripts; default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'; font-src data:"  # noqa: E501
CODE = re.compile(r"\.py\b|^[\w.]+:\w+$")


def below(root: Path, name: str) -> Path:
    """The file ``name`` of the folder. Raises :class:`tornado.web.HTTPError` 404 where it leads out of it."""
    try:
        path = (root / name).resolve()
    except (OSError, ValueError):
        raise tornado.web.HTTPError(404) from None
    if "\0" in name or not path.is_relative_to(root) or job.JOBS in path.parts:
        raise tornado.web.HTTPError(404)
    return path


def names_code(text: str) -> str:
    """Why a configuration is not run from the page, "" where it may: it names code or a program."""
    try:
        loaded = yaml.safe_load(text)
    except (yaml.YAMLError, RecursionError):
        return ""  # `validate` says where
    model = loaded.get("model") if isinstance(loaded, dict) else None
    if not isinstance(model, dict) or model.get("name") != "bubble":
        return "the page runs only 'model: {name: bubble}'; run others by the command line"
    found = next((s for s in _strings(loaded) if CODE.search(s)), None)
    return f"{found!r} names code: read it, and run this configuration by the command line" if found else ""


def _strings(value: Any) -> list[str]:
    if isinstance(value, dict):
        return [s for part in value.values() for s in _strings(part)]
    if isinstance(value, list):
        return [s for part in value for s in _strings(part)]
    return [value] if isinstance(value, str) else []


class Guarded(tornado.web.RequestHandler):
    """Requests from elsewhere are refused before anything is read."""

    def initialize(self, root: Path) -> None:
        self.root = root

    def prepare(self) -> None:
        hosts = self.settings["hosts"]
        if self.request.host not in hosts:
            raise tornado.web.HTTPError(403)
        origin = self.request.headers.get("Origin")
        if (origin or self.request.method != "GET") and origin not in {f"http://{host}" for host in hosts}:
            raise tornado.web.HTTPError(403)

    def set_default_headers(self) -> None:
        for name, value in (
            ("Content-Security-Policy", OWN), ("X-Content-Type-Options", "nosniff"), ("Cache-Control", "no-store"),
            ("Referrer-Policy", "no-referrer"), ("Cross-Origin-Resource-Policy", "same-origin"), ("Server", "en4dvar"),
        ):  # fmt: skip
            self.set_header(name, value)

    def write_error(self, status_code: int, **kwargs: Any) -> None:
        error = kwargs.get("exc_info", (None, None))[1]
        self.set_header("Content-Type", "text/plain; charset=utf-8")
        self.finish(str(error) if isinstance(error, En4dvarError) else getattr(error, "log_message", None) or "refused")


class Own(Guarded):
    """The page itself."""

    def get(self, name: str) -> None:
        path = HERE / (name or "page.html")
        if path.suffix not in KINDS or not path.is_file():
            raise tornado.web.HTTPError(404)
        self.set_header("Content-Type", KINDS[path.suffix])
        self.write(path.read_bytes())


class Files(Guarded):
    """Pages that commands wrote; they cannot speak to the server."""

    def get(self, name: str) -> None:
        path = below(self.root, name)
        if path.suffix not in (".html", ".png") or not path.is_file():
            raise tornado.web.HTTPError(404)
        self.set_header("Content-Type", KINDS[path.suffix])
        self.set_header("Content-Security-Policy", RESULT)
        self.write(path.read_bytes())


class State(Guarded):
    """What the folder holds and what runs, from files alone."""

    def get(self) -> None:
        names = sorted(p.name for p in self.root.iterdir() if p.suffix.lower() in MOVIES)
        stem = self.get_query_argument("stem", "")
        config = below(self.root, f"{stem}.yaml")
        text = config.read_text(encoding="utf-8", errors="replace") if config.is_file() else ""
        pages = {"track": f"{stem}.html", "run": f"runs/{stem}/report.html"}
        shown = {step: page for step, page in pages.items() if below(self.root, page).is_file()}
        jobs = [j for j in job.every(self.root) if j["step"].partition(" ")[2] == stem]
        self.write({"folder": str(self.root), "movies": names, "config": text, "pages": shown, "jobs": jobs})


class Step(Guarded):
    """Begin a command, cancel it, or keep the configuration."""

    def post(self, step: str) -> None:
        try:
            asked = json.loads(self.request.body)
            movie = str(asked["movie"])
        except (ValueError, KeyError, TypeError):
            raise tornado.web.HTTPError(400) from None
        if Path(movie).name != movie or movie.startswith("-") or not below(self.root, movie).is_file():
            raise tornado.web.HTTPError(404)
        stem = Path(movie).stem
        running = next((j for j in job.every(self.root) if j["state"] == "running"), None)
        if step == "cancel":
            if running:
                job.cancel(self.root / job.JOBS / str(running["number"]))
            return
        if running:
            raise tornado.web.HTTPError(409, "another command is running: wait for it, or cancel it")
        if step == "keep":
            write_text(below(self.root, f"{stem}.yaml"), str(asked.get("config", "")))
            return
        job.start(self.root, f"{step} {stem}", self._words(step, movie, stem, asked))

    def _words(self, step: str, movie: str, stem: str, asked: dict[str, Any]) -> list[str]:
        table, config, run = f"{stem}.csv", f"{stem}.yaml", f"runs/{stem}"
        if step == "track":
            scale = [f"--{key}={asked[key]}" for key in ("pixel", "frame-rate") if asked.get(key)]
            return ["track", movie, *scale, f"--out={table}", "--force"]
        if step == "init":
            return ["init", f"--data={table}", f"--out={config}", "--force"]
        path = below(self.root, config)
        if not path.is_file():
            raise tornado.web.HTTPError(404, "no configuration yet: propose one first")
        if why := names_code(path.read_text(encoding="utf-8", errors="replace")):
            raise tornado.web.HTTPError(403, why.replace("%", "%%"))
        end = {"validate": [], "run": [f"--out={run}", "--force"], "resume": [f"--out={run}", "--resume"]}[step]
        return ["validate" if step == "validate" else "run", config, *end]


def serve(root: Path, port: int, ready: Callable[[str], None]) -> None:
    """Serve ``root`` on the loopback until Ctrl-C; ``ready`` is called with the address."""
    with suppress(KeyboardInterrupt):
        asyncio.run(_serve(root, port, ready))


async def _serve(root: Path, port: int, ready: Callable[[str], None]) -> None:
    sockets = bind_sockets(port, "127.0.0.1")
    port, token = sockets[0].getsockname()[1], secrets.token_urlsafe(24)
    given = {"root": root}
    application = tornado.web.Application(
        [
            (rf"/{token}/(|app\.js|app\.css)", Own, given),
            (rf"/{token}/file/(.+)", Files, given),
            (rf"/{token}/state", State, given),
            (rf"/{token}/(track|init|validate|run|resume|cancel|keep)", Step, given),
        ],
        hosts={f"127.0.0.1:{port}", f"localhost:{port}"},
        log_function=lambda handler: None,
    )
    HTTPServer(application, max_body_size=LARGEST, max_buffer_size=LARGEST).add_sockets(sockets)
    ready(f"http://127.0.0.1:{port}/{token}/")
    await asyncio.Event().wait()
