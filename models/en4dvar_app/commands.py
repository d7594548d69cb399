"""``en4dvar app``. Heavy imports stay inside the command."""

from __future__ import annotations

from pathlib import Path

import click

from en4dvar.commands.common import echo


@click.command()
@click.argument("folder", type=click.Path(exists=True, path_type=Path), default=".")
@click.option("--port", type=click.IntRange(0, 65535), default=0, help="Port of this computer; default: a free one.")
@click.option("--no-browser", is_flag=True, help="Only print the address.")
def app(folder: Path, port: int, no_browser: bool) -> None:
    """Open a page in the browser that leads from a movie to an estimate.

    FOLDER, or the folder of a FILE, holds the movies; only files below it are read and written. Every step shows the
    command line that repeats it. The address is for this computer only and holds a secret.

    \b
    Example:
      en4dvar app my_movies
    """
    try:
        from en4dvar_app.server import serve
    except ImportError:
        raise click.UsageError("en4dvar app needs tornado: pip install 'en4dvar[app]'") from None
    root = (folder if folder.is_dir() else folder.parent).resolve()

    def ready(address: str) -> None:
        echo(f"{address}\nCtrl-C ends the page; commands that run go on, and the page finds them again.")
        if not no_browser:
            import webbrowser

            webbrowser.open(address)

    serve(root, port, ready)
