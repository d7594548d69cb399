"""``en4dvar app``. Heavy imports stay inside the command."""

from pathlib import Path

import click

from en4dvar.commands.common import echo, trust_option


@click.command()
@click.argument("path", metavar="[FILE or FOLDER]", type=click.Path(exists=True, path_type=Path), default=".")
@click.option("--port", type=click.IntRange(0, 65535), default=0, help="Port on this computer; default: a free one.")
@click.option("--no-browser", is_flag=True, help="Only print the address.")
@trust_option
def app(path: Path, port: int, no_browser: bool, trust: bool) -> None:
    """Go from a movie or a table to an estimate, in the browser.

    It reads and writes only in the folder, or in the folder of the file. Every step shows the command line that
    repeats it. The address is for this computer only and holds a secret.

    \b
    Example:
      en4dvar app configs/data
    """
    try:
        from en4dvar_app.server import serve
    except ImportError as error:
        missing = (error.name or "tornado").partition(".")[0]
        raise click.UsageError(f"en4dvar app needs {missing}: pip install '.[app]'") from None
    root = (path if path.is_dir() else path.parent).resolve()

    def ready(address: str) -> None:
        echo(f"{address}\nCtrl-C ends the page; commands go on, and the page shows them again.")
        if not no_browser:
            import webbrowser

            webbrowser.open(address)

    serve(root, port, trust, ready)
