"""Untrusted names of files: resolved inside the folder only, through no link."""

from pathlib import Path

from apertura.common.errors import CampaignError, quoted


def inside(root: Path, name: str, *, where: object) -> Path:
    """Return the path of a file that a campaign names, which lies in its folder.

    Parameters
    ----------
    root
        The folder.
    name
        Relative to it, with slashes.
    where
        What names the file, for the message.

    Raises
    ------
    CampaignError
        If the name is absolute, leads out of the folder or through a link, or holds a backslash or control characters.

    Examples
    --------
    >>> inside(Path("campaign"), "raw/codes.npy", where="config.yaml").as_posix()
    'campaign/raw/codes.npy'
    """
    parts = name.split("/")
    way = [root.joinpath(*parts[: count + 1]) for count in range(len(parts))]
    wrong = None
    if not name.isprintable() or "\\" in name or not name.strip():
        wrong = "is no plain name of a file"
    elif name.startswith("/") or ".." in parts:
        wrong = "leads out of the campaign folder"
    elif any(path.is_symlink() for path in way):
        wrong = "leads through a symbolic link"
    if wrong:
        raise CampaignError(
            f"path {quoted(name)} {wrong}",
            where,
            "a relative path to a file inside the campaign folder",
            "Copy the file into the folder and name it from there.",
        )
    return way[-1]


def check_shell_name(root: Path) -> None:
    """Raise CampaignError if the path of a campaign holds what a shell would run between double quotes.

    Executors of Snakemake hand commands with that path to a shell: that of Slurm as ``sbatch --wrap="…"``.

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
            expected="a path that a shell takes as it stands, where steps run on other machines",
            remedy="Rename the folder.",
        )


def shipped() -> Path:
    """Return where the root Snakefile lies, with profiles and tables: in the installed package, or beside its sources.

    Examples
    --------
    >>> (shipped() / "Snakefile").is_file()
    True
    """
    package = Path(__file__).parents[1]
    return next(root for root in (package / "_workflow", package.parents[1]) if (root / "Snakefile").is_file())
