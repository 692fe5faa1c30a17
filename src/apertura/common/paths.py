"""Check of campaign paths for use in shell commands, and location of the shipped workflow files."""

from pathlib import Path

from apertura.common.errors import CampaignError


def check_shell_name(root: Path) -> None:
    """Raise CampaignError if the path of a campaign contains characters that a shell interprets within double quotes.

    Snakemake executors pass commands that contain this path to a shell; for example, the Slurm executor calls
    ``sbatch --wrap="…"``.

    Examples
    --------
    >>> check_shell_name(Path("/data/a campaign's folder"))
    >>> check_shell_name(Path("/data/$(reboot)"))
    Traceback (most recent call last):
    ...
    apertura.common.errors.CampaignError: /data/$(reboot): a path with '$'; ...
    """
    active = next((mark for mark in '$`"\\' if mark in str(root)), None)
    if active or not str(root).isprintable():
        raise CampaignError(
            f"a path with {active!r}" if active else "a path with control characters",
            where=root,
            expected="a path without shell metacharacters, for steps that run on other machines",
            remedy="Rename the folder.",
        )


def shipped() -> Path:
    """Return the folder of the root Snakefile, profiles and tables, in the installed package or in the source tree.

    Examples
    --------
    >>> (shipped() / "Snakefile").is_file()
    True
    """
    package = Path(__file__).parents[1]
    return next(root for root in (package / "_workflow", package.parents[1]) if (root / "Snakefile").is_file())
