"""The server of the page: loopback only, a secret in the address, files below one folder."""

import asyncio
import json
import secrets
import threading
from collections.abc import Callable
from contextlib import suppress
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import tornado.web
from tornado.httpserver import HTTPServer
from tornado.netutil import bind_sockets

from en4dvar.plumbing.errors import En4dvarError
from en4dvar_app import job, pictures, steps
from en4dvar_app.trusted import below
from en4dvar_movie.frames import IMAGES, MOVING, TIFF

HERE = Path(__file__).parent
LARGEST = 1_000_000  # bytes of a request: a configuration or corrections, never a movie
MOVIES = (*MOVING, ".raw")
FRAMES, CONFIGS = (*TIFF, *IMAGES), (".yaml", ".yml")
TABLES = (".csv", ".txt", ".dat", ".tsv", ".xlsx", ".mat")
MOST = 2000  # names of a folder
_turn = threading.Lock()  # of two windows that write, one reads what the other wrote
KINDS = {
    ".html": "text/html; charset=utf-8", ".css": "text/css", ".js": "text/javascript", ".png": "image/png",
    ".csv": "text/plain; charset=utf-8",
}  # fmt: skip
OWN = "; ".join((
    "default-src 'none'", "script-src 'self'", "style-src 'self'", "connect-src 'self'", "img-src 'self' data:",
    "base-uri 'none'", "form-action 'none'", "frame-ancestors 'none'",
))  # fmt: skip
RESULT = "; ".join((
    "sandbox allow-scripts allow-popups", "default-src 'none'", "img-src data:", "style-src 'unsafe-inline'",
    "script-src 'unsafe-inline'", "font-src data:", "base-uri 'none'", "form-action 'none'",
))  # fmt: skip


class Guarded(tornado.web.RequestHandler):
    """Requests from elsewhere are refused before anything is read."""

    def initialize(self, root: Path, secret: str, port: int, trust: bool) -> None:
        self.root, self.secret, self.cookie, self.trust = root, secret, f"en4dvar-{port}", trust
        self.hosts = {f"127.0.0.1:{port}", f"localhost:{port}"}

    def prepare(self) -> None:
        headers, own = self.request.headers, {f"http://{host}" for host in self.hosts}
        if self.request.host not in self.hosts:
            raise tornado.web.HTTPError(403)
        if (headers.get("Origin") or self.request.method != "GET") and headers.get("Origin") not in own:
            raise tornado.web.HTTPError(403)
        self.require_secret()

    def require_secret(self) -> None:
        """Raises :class:`tornado.web.HTTPError` 404, as if nothing were here."""
        if not secrets.compare_digest((self.get_cookie(self.cookie) or "").encode(), self.secret.encode()):
            raise tornado.web.HTTPError(404)
        if self.request.headers.get("Sec-Fetch-Site", "none") not in ("same-origin", "none"):
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
        self.finish(getattr(error, "log_message", None) or "refused")

    async def made(self, call: Callable[[], Any]) -> Any:
        """What a call in another thread returns; its error as an answer that the page shows."""
        try:
            return await asyncio.get_running_loop().run_in_executor(None, call)
        except (En4dvarError, OSError, UnicodeError) as error:
            self.set_status(400)
            self.set_header("Content-Type", "text/plain; charset=utf-8")
            self.finish(str(error).replace("(data.sheet)", "in the field Sheet"))
            return None


class Enter(Guarded):
    """The address that was printed: its secret becomes a cookie, and leaves the line of addresses."""

    def require_secret(self) -> None:
        """The address has it."""

    def get(self) -> None:
        self.set_cookie(self.cookie, self.secret, httponly=True, samesite="Lax", path="/")
        self.redirect("/")


class Own(Guarded):
    def get(self, name: str) -> None:
        path = HERE / (name or "page.html")
        self.set_header("Content-Type", KINDS[path.suffix])
        self.write(path.read_bytes())


class Files(Guarded):
    """Pages that commands wrote. They run apart from ours: they cannot speak to the server."""

    def require_secret(self) -> None:
        if self.request.headers.get("Sec-Fetch-Mode", "navigate") == "navigate":
            self.request.headers["Sec-Fetch-Site"] = "none"  # a link from one of them to another
        super().require_secret()

    def get(self, name: str) -> None:
        try:
            path = below(self.root, name)
        except En4dvarError:
            raise tornado.web.HTTPError(404) from None
        if path.suffix not in KINDS or path.suffix in (".js", ".css") or not path.is_file():
            raise tornado.web.HTTPError(404)
        self.set_header("Content-Type", KINDS[path.suffix])
        self.set_header("Content-Security-Policy", RESULT)
        self.write(path.read_bytes())


class State(Guarded):
    """What the folder holds and what runs, from files alone."""

    async def get(self) -> None:
        if (state := await self.made(partial(_state, self.root))) is not None:
            self.write(state)


def _state(root: Path) -> dict[str, Any]:
    paths = sorted(p for p in root.iterdir() if not p.name.startswith("."))[:MOST]
    folders = {p.name: _suffixes(p) for p in paths if p.is_dir() and p.name not in ("runs", "comparisons")}
    runs = sorted((root / "runs").iterdir()) if (root / "runs").is_dir() else []
    pages = [p.relative_to(root).as_posix() for p in (*root.glob("*.html"), *root.glob("comparisons/*/*.html"))]
    return {
        "folder": str(root),
        "movies": _named(paths, MOVIES) + [name for name, held in folders.items() if held & {*FRAMES}],
        "tables": _named(paths, TABLES) + [name for name, held in folders.items() if held & {*TABLES}],
        "configs": _named(paths, CONFIGS),
        "runs": [{"name": p.name, "done": (p / "report.html").is_file()} for p in runs[:MOST] if p.is_dir()],
        "pages": pages,
        "jobs": job.every(root),
    }


def _named(paths: list[Path], suffixes: tuple[str, ...]) -> list[str]:
    return [p.name for p in paths if p.suffix.lower() in suffixes and p.is_file() and "corrections" not in p.name]


def _suffixes(folder: Path) -> set[str]:
    with suppress(OSError):
        return {p.suffix.lower() for p in folder.iterdir()}
    return set()


@lru_cache(maxsize=2)
def _pictures(path: Path, raw: str, changed: int) -> pictures.Pictures:
    return pictures.Pictures(path, raw or None)


def _opened(root: Path, fields: steps.Fields) -> pictures.Pictures:
    path = below(root, steps.existing(root, fields, "movie"))
    return _pictures(path, fields.get("raw", ""), path.stat().st_mtime_ns)


class Look(Guarded):
    """A movie, one of its frames, a table, or a text."""

    async def get(self, what: str) -> None:
        arguments = {key: self.get_query_argument(key) for key in self.request.query_arguments}
        shown = await self.made(partial(getattr(self, f"look_{what}"), arguments))
        if isinstance(shown, bytes):
            self.set_header("Content-Type", "image/bmp")
        if shown is not None:
            self.write(shown)

    def look_movie(self, arguments: dict[str, str]) -> dict[str, Any]:
        opened, name = _opened(self.root, arguments), arguments["movie"]
        height, width = opened.shape
        scale = {"pixel": opened.movie.pixel, "rate": opened.movie.rate}
        known = {key: value for key, value in scale.items() if value > 0}
        about: dict[str, Any] = {"count": opened.count, "width": width, "height": height, "readings": None, **known}
        with suppress(En4dvarError):
            about["readings"] = pictures.readings(below(self.root, steps.beside(name, steps.TABLE)))
        return about

    def look_frame(self, arguments: dict[str, str]) -> bytes:
        number = arguments.get("n", "")
        return _opened(self.root, arguments).bmp(int(number) if number.isdecimal() and len(number) < 9 else 0)

    def look_table(self, arguments: dict[str, str]) -> dict[str, Any]:
        path = below(self.root, steps.existing(self.root, arguments, "table"))
        return pictures.columns(path, arguments.get("sheet", ""))

    def look_text(self, arguments: dict[str, str]) -> dict[str, str]:
        return {"text": steps.text_of(self.root, arguments)}

    def look_live(self, arguments: dict[str, str]) -> dict[str, Any]:
        from en4dvar.report.live import bands, standings
        from en4dvar.report.svg import svg

        told = job.end_of(below(self.root, f"runs/{arguments.get('run', '')}/run.log"), 20 * job.LONGEST)
        sets, columns = standings(told), arguments.get("columns", "")
        side_by_side = int(columns) if columns in ("1", "2", "3") else 4
        chart = bands(next(iter(sets.values())), side_by_side) if len(sets) == 1 else None
        drawn = svg(chart, "live", "Median and middle 90 % of each parameter over the iterations") if chart else ""
        rows = sorted((name, each.at, each.estimate) for name, each in sets.items())
        return {"text": told[-job.LONGEST :], "bands": drawn, "sets": rows if len(rows) > 1 else []}

    def look_laws(self, arguments: dict[str, str]) -> dict[str, list[str]]:
        from en4dvar_bubble.laws.loading import available

        return {"laws": list(available())}


class Step(Guarded):
    """Begin a command, cancel it, or keep a text."""

    async def post(self, step: str) -> None:
        try:
            fields = {str(key): str(value) for key, value in json.loads(self.request.body).items()}
        except (ValueError, AttributeError):
            raise tornado.web.HTTPError(400) from None
        await self.made(partial(self._done, step, fields))

    def _done(self, step: str, fields: steps.Fields) -> None:
        with _turn:
            running = next((j for j in job.every(self.root) if j["state"] == "running"), None)
            if step == "cancel":
                if running:
                    job.cancel(self.root, running["number"])
            elif step == "keep":
                steps.kept(self.root, fields)
            elif step == "mask":
                steps.masked(self.root, fields, _opened(self.root, fields).shape)
            elif running:
                raise tornado.web.HTTPError(409, "another command is running: wait for it, or cancel it")
            else:
                words = steps.STEPS[step](self.root, fields)
                job.start(self.root, step, words[1], words, self.trust)


def serve(root: Path, port: int, trust: bool, ready: Callable[[str], None]) -> None:
    """Serve ``root`` on the loopback until Ctrl-C; ``ready`` is called with the address."""
    with suppress(KeyboardInterrupt):
        asyncio.run(_serve(root, port, trust, ready))


async def _serve(root: Path, port: int, trust: bool, ready: Callable[[str], None]) -> None:
    sockets = bind_sockets(port, "127.0.0.1")
    port, secret = sockets[0].getsockname()[1], secrets.token_urlsafe(24)
    common = {"root": root, "secret": secret, "port": port, "trust": trust}
    application = tornado.web.Application(
        [
            (rf"/{secret}/", Enter, common),
            (r"/(|plot\.js|app\.js|movie\.js|app\.css)", Own, common),
            (r"/file/(.+)", Files, common),
            (r"/state", State, common),
            (r"/look/(movie|frame|table|text|live|laws)", Look, common),
            (rf"/({'|'.join(steps.STEPS)}|cancel|keep|mask)", Step, common),
        ],
        log_function=lambda handler: None,
        default_handler_class=Guarded,
        default_handler_args=common,
    )
    HTTPServer(application, max_body_size=LARGEST, max_buffer_size=LARGEST).add_sockets(sockets)
    ready(f"http://127.0.0.1:{port}/{secret}/")
    await asyncio.Event().wait()
