"""docs/cli.md, from the commands themselves."""

import re
from collections.abc import Iterator
from typing import Any

import typer
from typer.main import get_command

from apertura.views.cli import app

_HEAD = """# Command line

`apertura COMMAND --help` says the same. Exit codes: 0, done; 2, something for you to fix, in one message;
130, ended by a signal; 1, what `verify`, `diff` or `reproduce` compared is not the same, or a defect of apertura.
`[campaign]` is a campaign folder; without it, the one in hand. Written by `make pages` from the commands.
"""
_SAID_ABOVE = {"campaign folder, else the one in hand"}
"""What the head says once for all commands."""


def cli_page() -> str:
    """Return docs/cli.md."""
    root = get_command(app)
    return _HEAD + "".join(_sections(root, typer.Context(root, info_name="apertura"), level=1))


def _sections(command: Any, context: typer.Context, level: int) -> Iterator[str]:
    """Yield a section for each command; those that have commands of their own come last, these as rows of a table."""
    if level > 2:
        told = _told(command.help).partition("\n")[0]
        yield f"| `{_usage(command, context)}` | {_cell(told)} |\n"
        return
    if level == 2:
        yield f"\n## {context.command_path}\n\n{_told(command.help)}\n\n    {_usage(command, context)}\n"
    names = command.list_commands(context) if hasattr(command, "list_commands") else ()
    commands = {name: command.get_command(context, name) for name in names}
    if level == 2 and commands:
        yield "\nOptions: `--help` of each.\n\n| command | what it does |\n|---|---|\n"
    shown = [] if commands else [one for one in command.params if not getattr(one, "hidden", False)]
    rows = [_row(one, context) for one in shown if getattr(one, "help", None) not in _SAID_ABOVE]
    if rows:
        yield "\n| argument or option | what it is |\n|---|---|\n" + "".join(rows)
    for name, one in sorted(commands.items(), key=lambda item: hasattr(item[1], "commands")):
        if not one.hidden:
            yield from _sections(one, typer.Context(one, info_name=name, parent=context), level + 1)


def _usage(command: Any, context: typer.Context) -> str:
    return " ".join(command.get_usage(context).split()).removeprefix("Usage: ")


def _row(one: Any, context: typer.Context) -> str:
    names, told = one.get_help_record(context) or ("", "")
    if one.name == "cores":  # as many as the machine has, which is no property of the command
        told = re.sub(r"\[default: \d+", "[default: all of the machine", told)
    return f"| `{_cell(names)}` | {_plain(told)} |\n"


def _cell(text: str) -> str:
    return " ".join(text.replace("|", "\\|").split())


def _plain(text: str) -> str:
    """Return a text that Markdown takes for nothing else."""
    return _cell(text).replace("<", "&lt;").replace("[", "\\[")


def _told(text: str | None) -> str:
    """Return a docstring as Markdown, without the sections for readers of code."""
    told = re.split(r"\n\s*(?:Parameters|Raises|Returns|Examples)\n\s*-{3}", text or "")[0]
    return "\n\n".join(" ".join(part.split()).replace("<", "&lt;") for part in told.split("\n\n"))
