"""Links of a chain: what lies in a campaign folder, compared with each hash that somebody has recorded of it."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from apertura.common.errors import CampaignError
from apertura.common.paths import inside
from apertura.common.provenance import sha256_file

State = Literal["changed", "missing", "same"]

_DIGITS = 12
_NAMED = 3


@dataclass
class Link:
    """One link of a chain.

    Attributes
    ----------
    name
        A file or stage relative to the campaign folder; or code, settings or tags, and of which.
    state
        Against what was recorded.
    why
        What differs, and who has recorded what it should be.
    """

    name: str
    state: State = "same"
    why: list[str] = field(default_factory=list)

    def add(self, state: State, why: str) -> None:
        """Note what is wrong with it; a second note adds to the first."""
        self.state = "missing" if "missing" in (state, self.state) else state
        if why not in self.why:
            self.why.append(why)


class Links:
    """Links by name, each file read once.

    Parameters
    ----------
    root
        The campaign folder.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     links = Links(Path(folder))
    ...     links.compare("raw/codes.npy", "4c", "results/f01/a-a/echo.manifest.json")
    False
    >>> [(link.name, link.state, link.why) for link in links]
    [('raw/codes.npy', 'missing', ['results/f01/a-a/echo.manifest.json was made from it'])]
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self._links: dict[str, Link] = {}
        self._digests: dict[str, str] = {}

    def __iter__(self) -> Iterator[Link]:
        """Yield the links in the order in which they were met."""
        yield from self._links.values()

    def of(self, name: str) -> Link:
        """Return the link of that name."""
        return self._links.setdefault(name, Link(name))

    def compare(self, name: str, was: str, by: str) -> bool:
        """Compare a file with a hash; return whether it is there.

        Parameters
        ----------
        name
            Relative to the campaign folder.
        was
            Its sha256 as recorded; empty: nobody has.
        by
            Who has recorded it.
        """
        link = self.of(name)
        if name not in self._digests:
            try:
                path = inside(self.root, name, where=by)
                self._digests[name] = sha256_file(path) if path.is_file() else ""
            except CampaignError as error:
                link.add("changed", error.found)
                return False
        now = self._digests[name]
        if not now:
            link.add("missing", f"{by} was made from it" if by else "not there")
        elif was and now != was:
            link.add("changed", f"{shortened(now)}, was {shortened(was)} for {by}")
        return bool(now)

    def compare_stage(self, name: str, recorded: Mapping[str, str], by: str) -> None:
        """Compare all files of a stage's folder, chunks among them, with their hashes; as `compare`."""
        link = self.of(name)
        try:
            folder = inside(self.root, name, where=by)
        except CampaignError as error:
            link.add("changed", error.found)
            return
        if not folder.is_dir():
            link.add("missing", f"{by} lists it")
        elif wrong := sorted(_differing(folder, recorded)):
            told = ", ".join(f"{file} {what}" for file, what in wrong[:_NAMED])
            more = f" and {len(wrong) - _NAMED} more" if len(wrong) > _NAMED else ""
            gone = all(what == "missing" for _, what in wrong)
            link.add("missing" if gone else "changed", f"{told}{more}, by {by}")


def _differing(folder: Path, recorded: Mapping[str, str]) -> Iterator[tuple[str, str]]:
    """Yield the files of a stage's folder that are not as they were recorded, and what is wrong with each."""
    there = {path.relative_to(folder).as_posix(): path for path in folder.rglob("*") if not path.is_dir()}
    yield from ((name, "is new") for name in there.keys() - recorded.keys())
    for name, was in recorded.items():
        path = there.get(name)
        if path is None:
            yield name, "missing"
        elif path.is_symlink() or not path.is_file():
            yield name, "is no file"
        elif sha256_file(path) != was:
            yield name, "changed"


def shortened(digest: str | None) -> str:
    """Return the first digits of a hash, for people.

    Examples
    --------
    >>> shortened("4cb8c29484fe402b113a"), shortened(None)
    ('4cb8c29484fe…', 'absent')
    """
    return f"{digest[:_DIGITS]}…" if digest else "absent"
