"""`apertura step`: one command per rule of the workflow, for a person to paste; the rows of the rules say which."""

import pkgutil
from collections.abc import Callable
from inspect import Parameter, Signature
from pathlib import Path
from typing import Annotated, Any

import typer

from apertura.common.processes import as_typed, given
from apertura.common.progress import progress_path, reporting_to
from apertura.workflow.rules import RULES, Rule

app = typer.Typer(no_args_is_help=True, help="One step of the pipeline, as the workflow runs it.")

Directory = Annotated[Path, typer.Option("--campaign", help="campaign folder")]
Threads = Annotated[int, typer.Option(min=1, help="tiles formed at once")]

_OPTIONS: dict[str, tuple[Any, Any]] = {
    "threads": (Threads, 1),
    "seconds": (float, 60.0),
    "repeats": (Annotated[int, typer.Option(min=1)], 3),
}
"""Option of a step → its type and its default."""


def _command_of(rule: Rule) -> Callable[..., None]:
    """Return the command of a rule: its arguments, the campaign folder and its options."""

    def command(campaign: Path, **stated: Any) -> None:
        from apertura.campaign.folder import Campaign

        opened, words = Campaign.load(given(campaign)), [stated.pop(name) for name in rule.arguments]
        with reporting_to(opened.result(*progress_path([rule.command, *words]))):
            written = pkgutil.resolve_name(rule.step)(opened, *words, **stated)
        for path in [written] if isinstance(written, Path) else written:
            print(as_typed(path))

    kinds: dict[str, tuple[Any, Any]] = dict.fromkeys(rule.arguments, (str, Parameter.empty))
    kinds |= {"campaign": (Directory, Path()), **{name: _OPTIONS[name] for name in rule.options}}
    command.__doc__ = rule.help
    command.__annotations__ = {name: kind for name, (kind, _) in kinds.items()}
    command.__signature__ = Signature(  # type: ignore[attr-defined]
        [
            Parameter(name, Parameter.POSITIONAL_OR_KEYWORD, default=default, annotation=kind)
            for name, (kind, default) in kinds.items()
        ]
    )
    return command


_named: dict[str, Rule] = {}
for _row in RULES.values():
    if _named.setdefault(_row.command, _row) is _row:  # `export` serves two rules
        app.command(_row.command)(_command_of(_row))
