"""Commands that the bubble adds to ``en4dvar`` (entry points of group ``en4dvar.commands``)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import click

from en4dvar.plumbing.errors import En4dvarError
from en4dvar.plumbing.user_file import is_from_file

if TYPE_CHECKING:
    from en4dvar_bubble.laws import ConstitutiveLaw


def completed_law(context: click.Context, parameter: click.Parameter, typed: str) -> list[str]:
    """Names of laws that the shell offers."""
    from en4dvar_bubble.laws.loading import available

    return [name for name in available() if name.startswith(typed)]


@click.command()
@click.argument("names", nargs=-1, metavar="[LAW]...", shell_complete=completed_law)
@click.option("--check", is_flag=True, help="Run the checks that every law must pass.")
def laws(names: tuple[str, ...], check: bool) -> None:
    """List constitutive laws with parameters and units, or check them.

    LAW is a name from the list, my_law.py:ClassName or package.module:ClassName; default is every registered law.

    \b
    Example:
      en4dvar laws --check my_law.py:MyLaw
    """
    from en4dvar_bubble.laws.loading import available, get_law

    kinds = () if names else available().values()
    broken = [str(kind) for kind in kinds if isinstance(kind, En4dvarError)]
    chosen = [get_law(name) for name in names] or [kind() for kind in kinds if not isinstance(kind, En4dvarError)]
    if check:
        broken += _check(chosen)
    else:
        click.echo("\n\n".join(_description(law, in_full=bool(names)) for law in chosen))
    if broken:
        raise En4dvarError("\n".join(broken))


def _check(chosen: Sequence[ConstitutiveLaw]) -> list[str]:
    """Print the battery's findings; return a line for each law that fails."""
    from en4dvar_bubble.battery import run_battery, small_strain

    failing = []
    for law in chosen:
        findings = run_battery(law)
        wrong = list(filter(None, findings.values()))
        click.echo(f"{law.name}: {len(findings) - len(wrong)} of {len(findings)} checks pass")
        for words, reason in findings.items():
            click.echo(f"  {'FAIL' if reason else 'ok  '}  {words}")
            if reason:
                click.echo(f"        {reason}")
        click.echo(f"  At small strain: {small_strain(law)}")
        if "limits" not in type(law).__dict__ and is_from_file(type(law)):
            click.echo("  No parent law is declared (limits): a wrong factor or unit shows in the line above alone")
        if wrong:
            failing.append(f"{law.name}: {len(wrong)} of {len(findings)} checks fail")
    return failing


def _description(law: ConstitutiveLaw, in_full: bool) -> str:
    from en4dvar.plumbing.tables import table

    rows = [
        (f"  {p.name}", p.unit, f"{p.bounds[0]:g} … {p.bounds[1]:g}", p.transform, p.label, p.source)
        for p in law.parameters
    ]
    parts = [f"{law.name}: {law.title}"]
    if in_full and type(law).__doc__:
        parts += [f"  {line.strip()}" for line in (type(law).__doc__ or "").strip().splitlines()]
    return "\n".join([*parts, table(rows)])
