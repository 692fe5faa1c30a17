"""Page docs/cli.md, generated from the help texts of the commands."""

import re
from typing import Any

import typer
from typer.main import get_command

from apertura.cli import app

_HEADER = """# Command line

`apertura COMMAND --help` prints the text of a section. `[campaign]` is a campaign folder (default: current directory).
This page is generated from the commands by `make pages`.

| exit code | meaning |
|---|---|
| 0 | success |
| 1 | `verify`, `diff` or `reproduce` found a difference, or an internal error occurred |
| 2 | error in the input, described by a message |
| 130 | termination by a signal |
"""
_DESCRIBED_IN_HEADER = {"campaign folder, default: current folder", "campaign folder, default: current directory"}
"""Help texts that are stated in the header of the page instead of for each command."""


def cli_page() -> str:
    """Return the text of docs/cli.md."""
    root = get_command(app)
    context = typer.Context(root, info_name="apertura")
    commands = {name: root.get_command(context, name) for name in root.list_commands(context)}
    visible = ((name, command) for name, command in commands.items() if not command.hidden)
    return _HEADER + "".join(
        _section(command, typer.Context(command, info_name=name, parent=context)) for name, command in visible
    )


def _section(command: Any, context: typer.Context) -> str:
    usage = " ".join(command.get_usage(context).split()).removeprefix("Usage: ").replace(" [OPTIONS]", "")
    parameters = [parameter for parameter in command.params if not getattr(parameter, "hidden", False)]
    lines = [
        _line(parameter, context)
        for parameter in parameters
        if getattr(parameter, "help", None) not in _DESCRIBED_IN_HEADER
    ]
    return f"\n## `{usage}`\n\n{_description(command.help)}\n" + ("\n" + "".join(lines) if lines else "")


def _line(parameter: Any, context: typer.Context) -> str:
    names, description = parameter.get_help_record(context) or ("", "")
    if parameter.name == "cores":  # the default value depends on the machine
        description = re.sub(r"\[default: \d+", "[default: all of the machine", description)
    names = re.sub(r" <(?:path|str|int|(?:int|float) range)>", "", names)  # types are clear from the description
    return f"- `{_one_line(names)}`: {_escaped(description)}\n"


def _one_line(text: str) -> str:
    return " ".join(text.split())


def _escaped(text: str) -> str:
    """Escape the characters of a text that Markdown interprets as markup."""
    return _one_line(text).replace("<", "&lt;").replace("[", "\\[")


def _description(text: str | None) -> str:
    """Return a docstring as Markdown, without the sections on parameters, exceptions, results and examples."""
    prose = re.split(r"\n\s*(?:Parameters|Raises|Returns|Examples)\n\s*-{3}", text or "")[0]
    return "\n\n".join(" ".join(paragraph.split()).replace("<", "&lt;") for paragraph in prose.split("\n\n"))
