"""docs/cli.md, from the commands themselves."""

import re
from typing import Any

import typer
from typer.main import get_command

from apertura.cli import app

_HEAD = """# Command line

`apertura COMMAND --help` says the same. Exit codes: 0, done; 2, something for you to fix, in one message;
130, ended by a signal; 1, what `verify`, `diff` or `reproduce` compared is not the same, or a defect of apertura.
`[campaign]` is a campaign folder; default: the current directory. Written by `make pages` from the commands.
"""
_SAID_ABOVE = {"campaign folder, default: current directory"}
"""What the head says once for all commands."""


def cli_page() -> str:
    """Return docs/cli.md."""
    root = get_command(app)
    context = typer.Context(root, info_name="apertura")
    commands = {name: root.get_command(context, name) for name in root.list_commands(context)}
    shown = ((name, one) for name, one in commands.items() if not one.hidden)
    return _HEAD + "".join(_section(one, typer.Context(one, info_name=name, parent=context)) for name, one in shown)


def _section(command: Any, context: typer.Context) -> str:
    usage = " ".join(command.get_usage(context).split()).removeprefix("Usage: ").replace(" [OPTIONS]", "")
    params = [one for one in command.params if not getattr(one, "hidden", False)]
    lines = [_line(one, context) for one in params if getattr(one, "help", None) not in _SAID_ABOVE]
    return f"\n## `{usage}`\n\n{_told(command.help)}\n" + ("\n" + "".join(lines) if lines else "")


def _line(one: Any, context: typer.Context) -> str:
    names, told = one.get_help_record(context) or ("", "")
    if one.name == "cores":  # as many as the machine has, which is no property of the command
        told = re.sub(r"\[default: \d+", "[default: all of the machine", told)
    names = re.sub(r" <(?:path|str|int|(?:int|float) range)>", "", names)  # the text says what it is
    return f"- `{_one_line(names)}`: {_plain(told)}\n"


def _one_line(text: str) -> str:
    return " ".join(text.split())


def _plain(text: str) -> str:
    """Return a text that Markdown takes for nothing else."""
    return _one_line(text).replace("<", "&lt;").replace("[", "\\[")


def _told(text: str | None) -> str:
    """Return a docstring as Markdown, without the sections for readers of code."""
    told = re.split(r"\n\s*(?:Parameters|Raises|Returns|Examples)\n\s*-{3}", text or "")[0]
    return "\n\n".join(" ".join(part.split()).replace("<", "&lt;") for part in told.split("\n\n"))
