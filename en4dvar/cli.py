"""The command line. Its commands are in ``en4dvar.commands``; application packages add theirs by entry point.

Exit codes: 0 done; 1 the run failed, or some data sets of a campaign; 2 usage, configuration, data or output directory;
3 too few surviving members (in a campaign: nothing else failed); 130 interrupted, to be continued with --resume.
"""

import errno
import io
import os
import sys
import threading
from contextlib import suppress
from typing import Any

try:
    import click

    from en4dvar.commands.common import Failed, give_up_output, printable, require_words, tell, to_continue
    from en4dvar.commands.plugins import COMMANDS, PluginCommand, models, schema, warm_up
    from en4dvar.commands.results import compare, export, joint, population, report, rerun
    from en4dvar.commands.run import run, validate
    from en4dvar.commands.synthetic import calibrate, design, simulate, sweep_twin
    from en4dvar.plumbing.called import typed
    from en4dvar.plumbing.errors import En4dvarError
    from en4dvar.plumbing.installed import installed
    from en4dvar.runs.interrupt import heeded, terminate_as_interrupt
except KeyboardInterrupt:  # before there is a command that would tell it
    print("interrupted", file=sys.stderr)
    sys.exit(130)

# Told by what writes; here is what is left
OF_THE_DEVICE = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EROFS)


class Commands(click.Group):
    """Adds the commands of application packages; turns errors of ours and Ctrl-C into messages and exit codes."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return sorted({*super().list_commands(ctx), *installed(COMMANDS)})

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        built_in = super().get_command(ctx, cmd_name)
        plugin = None if built_in else installed(COMMANDS).get(cmd_name)
        return PluginCommand(plugin) if plugin else built_in

    def main(self, *args: Any, **options: Any) -> Any:
        """Run as click does, but do not wait for code of a model that was stopped and does not end."""
        _settle_surroundings()
        try:
            return super().main(*args, **options)
        except SystemExit as end:
            if any(thread.name.startswith("en4dvar") and not thread.daemon for thread in threading.enumerate()):
                give_up_output()
                os._exit(end.code if isinstance(end.code, int) else 1)
            raise

    def make_context(self, *args: Any, **options: Any) -> click.Context:
        """Stopped before a command has begun, the program ends as it does later."""
        try:
            return super().make_context(*args, **options)
        except KeyboardInterrupt:
            raise Failed("interrupted", 130) from None

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        if not ctx.resilient_parsing:  # as a shell that completes a line
            require_words(args)
        return super().parse_args(ctx, args)

    def invoke(self, ctx: click.Context) -> Any:
        output = _output()
        try:
            with typed(tell), heeded(_end), terminate_as_interrupt():
                value = super().invoke(ctx)
            sys.stdout.flush()
            if _output() != output:  # what was printed is nowhere, or in a file that has its number now
                raise _closed_output()
            return value
        except En4dvarError as error:
            raise Failed(str(error), error.exit_code) from error
        except SystemExit as end:  # of a model or law: click ends in another way; another package's command may
            if ctx.invoked_subcommand in installed(COMMANDS):
                raise
            from en4dvar.plumbing.user_code import describe

            raise Failed(f"the code of a model ended the program: {describe(end)}", 1) from None
        except (KeyboardInterrupt, click.Abort) as interrupt:
            raise Failed(str(interrupt) or "interrupted", 130) from None
        except (OSError, ValueError) as error:
            if _output() != output:
                raise _closed_output() from error
            if isinstance(error, PermissionError) and error.filename:  # as of a folder that others may not look into
                raise Failed(f"{error.filename}: {error.strerror}", 2) from error
            if isinstance(error, OSError) and error.errno in OF_THE_DEVICE:
                if error.filename is None:  # or what is left of it is tried again, and told, when the interpreter ends
                    give_up_output()
                words = f"{error.filename or 'standard output'}: cannot be written: {error.strerror}"
                raise Failed(words, 2) from error
            raise


def _settle_surroundings() -> None:
    """Standard streams that were closed lead nowhere, or a file would get their number; what is set wrongly is told."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            handle = os.open(os.devnull, os.O_RDWR)
            if handle != number:
                os.dup2(handle, number)
                os.close(handle)
            setattr(sys, name, os.fdopen(number, "r" if name == "stdin" else "w", encoding="utf-8", closefd=False))
    for stream in (sys.stdout, sys.stderr):  # a console that lacks a sign shows another
        if isinstance(stream, io.TextIOWrapper):
            with suppress(OSError):  # of a stream that was led elsewhere since it was opened
                stream.reconfigure(errors="backslashreplace")
    epoch = os.environ.get("SOURCE_DATE_EPOCH")
    if epoch is not None and not epoch.isdecimal():  # what draws figures would raise
        click.echo(f"SOURCE_DATE_EPOCH={printable(epoch)}: not a number of seconds; unset it", err=True)
        sys.exit(2)


def _end(kept: str) -> None:
    """End the process, which does not answer a signal; ``kept``: what a run has kept, in words."""
    to_continue(kept).show()
    os._exit(130)


def _output() -> object:
    """Which file standard output is; None where it is closed."""
    try:
        status = os.fstat(1)
    except OSError:
        return None
    return None if sys.stdout is None or sys.stdout.closed else (status.st_dev, status.st_ino)


def _closed_output() -> Failed:
    sys.stdout = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115  for what is written as Python ends
    return Failed("standard output was closed, by a model perhaps; what was computed is kept", 1)


@click.group(cls=Commands, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.version_option(package_name="en4dvar")
def main() -> None:
    """Estimate the parameters of a model from time series, with an ensemble (En4D-Var).

    \b
    Example:
      en4dvar run configs/quickstart.yaml
    """


for command in (
    calibrate, compare, design, export, joint, models, population, report, rerun, run, schema, simulate,
    sweep_twin, validate, warm_up,
):  # fmt: skip
    main.add_command(command)

if __name__ == "__main__":
    main(prog_name="en4dvar")
