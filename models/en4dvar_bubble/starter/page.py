"""A proposal as the text of a YAML file."""

import json
import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields

from en4dvar.inputs.parts import ANY, Layout
from en4dvar_bubble.starter.proposal import Entry, Proposal

SCHEMA_FILE = "en4dvar.schema.json"
_PLAIN = re.compile(r"[A-Za-z_./][\w ./*-]*[\w./*]|[A-Za-z_]")
_WORDS = ("true", "false", "null", "yes", "no", "on", "off")


@dataclass(frozen=True)
class Source:
    """How the data are read: ``path`` as the file says it, the column (or constant step) of times, that of radii.

    ``errors``: columns of the standard deviations of radii and times, where the file states them. ``step_unit``: that
    of a constant step which is a scalar of the file. ``rate``: of the frames, that the times are compared with.
    """

    path: str
    time: tuple[str, str] | None
    time_step: str | None
    radius: tuple[str, str]
    layout: Layout = ANY
    errors: tuple[str, ...] = ()
    step_unit: str | None = None
    rate: str | None = None
    observable: str = "radius"

    @property
    def layout_entries(self) -> list[str]:
        """What is said about the layout, line by line."""
        told = {part.name: getattr(self.layout, part.name) for part in fields(Layout) if part.name != "since"}
        lines = [f"  {name}: {quoted(it)}" for name, it in told.items() if it is not None and it != getattr(ANY, name)]
        since = self.layout.since
        when = {"time": f"{1e6 * since.time:.9g} us", "maximum": "maximum", "top": "top", "end": "end"}
        return lines + [f"  since: {when.get(since.kind, f'{since.kind} {since.number}')}"] * (since != ANY.since)

    @property
    def time_entry(self) -> str:
        """The ``time`` column as YAML."""
        if self.step_unit is not None:
            return f"{{step: {quoted(self.time_step or '')}, unit: {quoted(self.step_unit)}}}"
        if self.time is None:
            return f"{{step: {quoted(self.time_step or '')}}}"
        rate = f", rate: {quoted(self.rate)}" if self.rate is not None else ""
        return f"{{name: {quoted(self.time[0])}, unit: {quoted(self.time[1])}{rate}}}"


# the table that 'en4dvar track' writes: its columns say their units
TRACKED = Source("", ("t_us", "us"), None, ("R_um", "um"), errors=("R_std_um", "t_std_us"))
TRACKED_COMMON = "R_common_um"  # the scalar that holds the std of what moves all radii alike
TRACKED_SHAPE = "R_shape_common"  # and that of the factor by which a lasting shape does


def quoted(text: str) -> str:
    """``text`` as a YAML scalar that is read as text, also inside braces."""
    plain = _PLAIN.fullmatch(text) and text.lower() not in _WORDS
    return text if plain else json.dumps(text, ensure_ascii=False)


def yaml_text(name: str, source: Source, proposal: Proposal, command: str) -> str:
    """The whole configuration with comments."""
    head = [
        f"# yaml-language-server: $schema={SCHEMA_FILE}",
        f"# Proposed by: {command}",
        *(f"# Seen: {line}" for line in proposal.remarks),
        *(f"# MIND: {line}" for line in proposal.warnings),
        "# Every value is a proposal; what was guessed from the data says so. Read, change, then:",
        "#   en4dvar validate THIS_FILE --plot        what would be estimated, and the prior over the data",
        "#   en4dvar run THIS_FILE",
        f"name: {quoted(name)}",
        "seed: 1 # the same seed gives the same bits",
        "data:",
        f"  path: {quoted(source.path)}",
        *source.layout_entries,
        "  columns:",
        f"    time: {source.time_entry}",
        f"    {source.observable}: {{name: {quoted(source.radius[0])}, unit: {quoted(source.radius[1])}}}",
    ]
    lines = [
        *head,
        *_section(proposal.data),
        "model:",
        *_section(proposal.model),
        *_comparison(name, proposal.simpler),
        *_longer(name) * proposal.longer,
        "parameters: # a prior is estimated, a quantity such as 'mu: 0.1 Pa s' is fixed",
        *_section(proposal.parameters),
        *proposal.population,
        "assimilation:",
        *_section(proposal.assimilation),
    ]
    return "\n".join(lines) + "\n"


def _comparison(name: str, simpler: Mapping[str, str]) -> list[str]:
    """How to compare with ``simpler`` physics; nothing where there is none."""
    if not simpler:
        return []
    options = " ".join(f"--set model.{key}={value}" for key, value in simpler.items())
    here, there = shlex.quote(f"runs/{name}"), shlex.quote(f"runs/{name}_{simpler['gas']}")
    return [
        f"  # A {simpler['gas']} gas is quicker, but makes R_eq and mu wrong, often without a warning. To compare:",
        f"  #   en4dvar run THIS_FILE {options} --out {there}",
        f"  #   en4dvar compare {here} {there}",
    ]


def _longer(name: str) -> list[str]:
    """How to fit one oscillation more."""
    options = "--set data.window.to='trough 3' --set model_error.gas='{at: maxima, std: 70 %}'"
    return [
        "  # The gas may change within the window, too. Where readings err by less than 2 % of R_max,",
        "  # one oscillation more often tells mu several times better (docs/physics.md):",
        f"  #   en4dvar run THIS_FILE {options} --out {shlex.quote(f'runs/{name}_gas')}",
    ]


def _section(entries: Sequence[Entry]) -> list[str]:
    bare = [f"  {entry.key}: {entry.value}".rstrip() for entry in entries]
    width = max(len(line) for line in bare if len(line) < 72)
    return [
        f"{line.ljust(width)} # {entry.comment}" if entry.comment else line
        for line, entry in zip(bare, entries, strict=True)
    ]
