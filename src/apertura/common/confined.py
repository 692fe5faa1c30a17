"""Paths of a campaign folder: every access below the folder is relative to a descriptor and follows no link.

A campaign folder comes from a stranger, and other processes may write to it at any time. So no file of it is opened by
its whole name, in which the kernel would follow links: each component is opened relative to the descriptor of the one
before with ``O_NOFOLLOW`` (openat(2)), and only plain files and folders are accepted. The path of the campaign folder
itself belongs to the user and may lead through links.
"""

import errno
import json
import os
import shutil
import stat
from collections.abc import Generator, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from fnmatch import fnmatchcase
from pathlib import Path, PosixPath
from types import MappingProxyType
from typing import IO, Any, NoReturn

from apertura.common.errors import CampaignError, quoted

LARGEST_READ = 1 << 30
"""Bytes that a file may have to be read at once, as chunks of arrays are; documents have lower limits of their own."""

_FOLDER = os.O_PATH | os.O_DIRECTORY | os.O_CLOEXEC
_BELOW = _FOLDER | os.O_NOFOLLOW
_FILE = os.O_NOFOLLOW | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC  # a FIFO that nobody writes to does not block
_MODES = {
    "r": os.O_RDONLY,
    "r+": os.O_RDWR,
    "w": os.O_WRONLY | os.O_CREAT | os.O_TRUNC,
    "w+": os.O_RDWR | os.O_CREAT | os.O_TRUNC,
    "a": os.O_WRONLY | os.O_CREAT | os.O_APPEND,
    "a+": os.O_RDWR | os.O_CREAT | os.O_APPEND,
}
_WRITES = os.O_WRONLY | os.O_RDWR
_KINDS = {stat.S_IFIFO: "a named pipe", stat.S_IFSOCK: "a socket", stat.S_IFBLK: "a device", stat.S_IFCHR: "a device"}
_DESCRIPTORS = Path("/proc/self/fd")
_EXPECTED = "a plain file or folder: nothing in a campaign folder is read, written or deleted through a link"
_REMEDY = "Remove it. The campaign folder itself may be a link, and `raw_root` in the config may name another raw/."


class ConfinedPath(PosixPath):
    """A path in a campaign folder, by which no file outside can be reached.

    It has the methods of `pathlib.Path` that apertura uses. Reading and writing through a symbolic link, and opening
    what is neither a file nor a folder, raise `CampaignError`; removing a link removes the link alone. Paths that are
    derived from it are confined, too. It is no `os.PathLike`: a library that opens files by name gets `on_disk`.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     root = ConfinedPath.at(Path(folder))
    ...     os.symlink("/etc", Path(folder) / "link")
    ...     (root / "link" / "passwd").read_text()
    Traceback (most recent call last):
    ...
    apertura.common.errors.CampaignError: ...passwd: leads through a symbolic link; expected ...
    """

    _top: Path
    _elsewhere: Mapping[str, Path]

    @classmethod
    def at(cls, folder: Path | str, *, elsewhere: Mapping[str, Path] | None = None) -> "ConfinedPath":
        """Return a folder as the root of confined paths.

        Parameters
        ----------
        folder
            It may lie behind links, and may be one.
        elsewhere
            Name of a folder in it → folder that takes its place, under the same rules.
        """
        if isinstance(folder, ConfinedPath):
            return folder
        root = cls(folder)
        root._top, root._elsewhere = Path(folder), MappingProxyType(dict(elsewhere or {}))
        return root

    @classmethod
    def of(cls, path: Path) -> "ConfinedPath":
        """Return a path that a user typed or a caller gave as a confined one: the folder it lies in is trusted."""
        return path if isinstance(path, ConfinedPath) else cls.at(path.parent) / path.name

    def with_elsewhere(self, elsewhere: Mapping[str, Path]) -> "ConfinedPath":
        """Return the same path where folders of the root lie elsewhere, as `at` takes them."""
        return ConfinedPath.at(self._top, elsewhere=elsewhere) / self.relative_to(self._top)

    def named(self, name: str, *, where: object) -> "ConfinedPath":
        """Return the path of a file that a document of the campaign names.

        Parameters
        ----------
        name
            Relative to this folder, with slashes.
        where
            Document and key that hold the name, for the message.

        Raises
        ------
        CampaignError
            If the name is absolute, leads out of the folder, or holds a backslash or control characters.

        Examples
        --------
        >>> ConfinedPath.at("campaign").named("raw/codes.npy", where="config.yaml").as_posix()
        'campaign/raw/codes.npy'
        """
        wrong = None
        if not name.isprintable() or "\\" in name or not name.strip():
            wrong = "is no plain name of a file"
        elif name.startswith("/") or ".." in name.split("/"):
            wrong = "leads out of the campaign folder"
        if wrong:
            raise CampaignError(
                f"path {quoted(name)} {wrong}",
                where,
                "a relative path to a file inside the campaign folder",
                "Copy the file into the folder and name it from there.",
            )
        return self / name

    # ---- Derived paths ----------------------------------------------------------------------------------------------

    def _bound(self, path: Any) -> "ConfinedPath":
        path._top, path._elsewhere = self._top, self._elsewhere
        return path  # type: ignore[no-any-return]

    def __truediv__(self, key: Any) -> "ConfinedPath":
        return self._bound(super().__truediv__(key))

    def joinpath(self, *names: Any) -> "ConfinedPath":
        """As `pathlib.Path.joinpath`."""
        return self._bound(super().joinpath(*names))

    def with_name(self, name: str) -> "ConfinedPath":
        """As `pathlib.Path.with_name`."""
        return self._bound(super().with_name(name))

    def with_stem(self, stem: str) -> "ConfinedPath":
        """As `pathlib.Path.with_stem`."""
        return self._bound(super().with_stem(stem))

    def with_suffix(self, suffix: str) -> "ConfinedPath":
        """As `pathlib.Path.with_suffix`."""
        return self._bound(super().with_suffix(suffix))

    @property
    def parent(self) -> "ConfinedPath":
        """As `pathlib.Path.parent`."""
        return self._bound(super().parent)

    @property
    def parents(self) -> Any:
        """As `pathlib.Path.parents`."""
        return tuple(map(self._bound, super().parents))

    def relative_to(self, other: Any, /, *more: Any, **how: Any) -> Path:  # type: ignore[override]
        """Return the path relative to another: a name, not confined."""
        return Path(self).relative_to(other, *more, **how)

    def is_relative_to(self, other: Any, /, *more: Any) -> bool:
        """As `pathlib.Path.is_relative_to`."""
        return Path(self).is_relative_to(other, *more)

    def absolute(self) -> "ConfinedPath":
        """As `pathlib.Path.absolute`; links stay as they are."""
        top = self._top.absolute()
        return ConfinedPath.at(top, elsewhere=self._elsewhere) / self.relative_to(self._top)

    @property
    def location(self) -> Path:
        """Path that it leads to, a folder that lies elsewhere taken into account; to be shown, not to be opened."""
        first, *rest = self.parts[len(self._top.parts) :] or ("",)
        return self._elsewhere[first].joinpath(*rest) if first in self._elsewhere else Path(self)

    def real(self) -> Path:
        """Return the path that it leads to on this machine, not confined: to be shown and compared alone."""
        top, parts = self._way()
        return top.resolve().joinpath(*parts)

    def __reduce__(self) -> Any:
        return _restored, (self._top, dict(self._elsewhere), self.relative_to(self._top).as_posix())

    def __fspath__(self) -> NoReturn:
        raise TypeError(f"{self}: a confined path has no name by which a library may open it; use on_disk()")

    # ---- Access by descriptors --------------------------------------------------------------------------------------

    def _refused(self, found: str) -> CampaignError:
        return CampaignError(found, where=self, expected=_EXPECTED, remedy=_REMEDY)

    def _way(self) -> tuple[Path, tuple[str, ...]]:
        """Return a trusted folder, and the components from there."""
        count = len(self._top.parts)
        if "\0" in str(self):
            raise CampaignError(
                "a path with a null byte", where=self, expected="the name of a file", remedy="Correct it."
            )
        parts = self.parts[count:]
        if self.parts[:count] != self._top.parts or ".." in parts or "/" in parts:
            raise self._refused("leads out of the campaign folder")
        if parts and parts[0] in self._elsewhere:
            return self._elsewhere[parts[0]], parts[1:]
        return self._top, parts

    @contextmanager
    def _within(self, *, make: bool = False) -> Iterator[tuple[int, str]]:
        """Yield a descriptor of the folder that holds the path, and the name there; `make` missing folders."""
        top, parts = self._way()
        try:
            folder = os.open(top, _FOLDER)
            try:
                for part in parts[:-1]:
                    if make:
                        with suppress(FileExistsError):
                            os.mkdir(part, dir_fd=folder)
                    below = self._entered(folder, part)
                    os.close(folder)
                    folder = below
                yield folder, parts[-1] if parts else "."
            finally:
                os.close(folder)
        except OSError as error:
            if not str(error.filename or "").startswith(os.sep):  # a name in its folder alone
                error.filename = str(self)
            raise

    def _entered(self, folder: int, name: str) -> int:
        try:
            return os.open(name, _BELOW, dir_fd=folder)
        except NotADirectoryError:
            if stat.S_ISLNK(os.stat(name, dir_fd=folder, follow_symlinks=False).st_mode):
                last = name == self.name
                raise self._refused("a symbolic link" if last else "leads through a symbolic link") from None
            raise

    def descriptor(self, flags: int) -> int:
        """Open a plain file as `os.open` does, and return its descriptor.

        Raises
        ------
        CampaignError
            If it is or leads through a symbolic link, is no plain file, or is to be written and has another name: a
            hard link, by which a file outside would be written.
        """
        with self._within() as (folder, name):
            try:
                opened = os.open(name, flags & ~os.O_TRUNC | _FILE, 0o666, dir_fd=folder)
            except OSError as error:
                if error.errno == errno.ELOOP:
                    raise self._refused("a symbolic link") from None
                if error.errno == errno.ENXIO:
                    kind = stat.S_IFMT(os.stat(name, dir_fd=folder, follow_symlinks=False).st_mode)
                    raise self._refused(_KINDS.get(kind, "no plain file")) from None
                raise
        try:
            state = os.fstat(opened)
            kind = stat.S_IFMT(state.st_mode)
            if kind == stat.S_IFDIR:
                raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(self))
            if kind != stat.S_IFREG:
                raise self._refused(_KINDS.get(kind, "no plain file"))
            if flags & _WRITES and state.st_nlink > 1:
                raise self._refused(f"a file of {state.st_nlink} names (hard links)")
            if flags & os.O_TRUNC:
                os.ftruncate(opened, 0)
        except BaseException:
            os.close(opened)
            raise
        return opened

    @contextmanager
    def folder(self) -> Iterator[int]:
        """Yield a descriptor of a folder, for the calls of `os` that take one as ``dir_fd``."""
        with self._within() as (folder, name):
            entered = self._entered(folder, name)
        try:
            yield entered
        finally:
            os.close(entered)

    def copy_to(self, target: Path, *, link: bool = False) -> None:
        """Copy a file; as a hard link where that is wanted and possible."""
        if link:
            with suppress(OSError), self._within() as (folder, name):  # another disk, or a file of somebody else's
                os.link(name, target, src_dir_fd=folder, follow_symlinks=False)
                return
        with self.open("rb") as source, target.open("wb") as copy:
            shutil.copyfileobj(source, copy, 1 << 20)

    def reference(self) -> str:
        """Return a text for another process, from which `referenced` makes the path."""
        return json.dumps([str(self._top.absolute()), self.relative_to(self._top).as_posix()])

    @classmethod
    def referenced(cls, text: str) -> "ConfinedPath":
        """Return the path that a text of `reference` states."""
        top, name = json.loads(text)
        return cls.at(top).joinpath(name)

    @contextmanager
    def on_disk(self) -> Iterator[Path]:
        """Yield a name for libraries that open files themselves; it leads to this very file or folder.

        It holds in this process and its forks until the block ends. What such a library reads from a folder, it reads
        by names of its own: apertura hands it files alone, and folders that it has just made.
        """
        if self.is_dir():
            with self.folder() as opened:
                yield _DESCRIPTORS / str(opened)
            return
        opened = self.descriptor(os.O_RDONLY)
        try:
            yield _DESCRIPTORS / str(opened)
        finally:
            os.close(opened)

    # ---- Reading ----------------------------------------------------------------------------------------------------

    def stat(self, *, follow_symlinks: bool = True) -> os.stat_result:
        """As `pathlib.Path.stat`; a link is refused where it would be followed."""
        with self._within() as (folder, name):
            state = os.stat(name, dir_fd=folder, follow_symlinks=False)
        if follow_symlinks and stat.S_ISLNK(state.st_mode):
            raise self._refused("a symbolic link")
        return state

    def lstat(self) -> os.stat_result:
        """As `pathlib.Path.lstat`."""
        return self.stat(follow_symlinks=False)

    def _mode(self, *, follow_symlinks: bool = True) -> int:
        try:
            return self.stat(follow_symlinks=follow_symlinks).st_mode
        except (FileNotFoundError, NotADirectoryError):
            return 0

    def exists(self, *, follow_symlinks: bool = True) -> bool:
        """As `pathlib.Path.exists`; CampaignError at a link."""
        return self._mode(follow_symlinks=follow_symlinks) != 0

    def is_file(self, *, follow_symlinks: bool = True) -> bool:
        """As `pathlib.Path.is_file`; CampaignError at a link."""
        return stat.S_ISREG(self._mode(follow_symlinks=follow_symlinks))

    def is_dir(self, *, follow_symlinks: bool = True) -> bool:
        """As `pathlib.Path.is_dir`; CampaignError at a link."""
        return stat.S_ISDIR(self._mode(follow_symlinks=follow_symlinks))

    def is_symlink(self) -> bool:
        """As `pathlib.Path.is_symlink`."""
        return stat.S_ISLNK(self._mode(follow_symlinks=False))

    def permits(self, mode: int) -> bool:
        """Test the access to the file, as `os.access` does."""
        with self._within() as (folder, name):
            return os.access(name, mode, dir_fd=folder, follow_symlinks=False)

    def free_bytes(self) -> int:
        """Return the number of bytes that can still be written below a folder."""
        with self.folder() as opened:
            state = os.fstatvfs(opened)
            return state.f_bavail * state.f_frsize

    def open(  # type: ignore[override]
        self,
        mode: str = "r",
        buffering: int = -1,
        encoding: str | None = None,
        errors: str | None = None,
        newline: str | None = None,
    ) -> IO[Any]:
        """As `pathlib.Path.open`; see `descriptor` for what is refused."""
        opened = self.descriptor(_MODES[mode.replace("b", "").replace("t", "")])
        return os.fdopen(opened, mode, buffering, encoding, errors, newline)

    def read_bytes(self, largest: int = LARGEST_READ) -> bytes:
        """Return the bytes of a file; CampaignError if they are more than `largest`."""
        with self.open("rb", buffering=0) as stream:
            size = os.fstat(stream.fileno()).st_size
            if size > largest:
                raise CampaignError(
                    f"{size} bytes", self, f"a file of at most {largest} bytes", "Is it the right file? Remove it."
                )
            return stream.read()  # type: ignore[no-any-return]

    def read_text(self, encoding: str | None = None, errors: str | None = None, newline: str | None = None) -> str:
        """As `pathlib.Path.read_text`, with the limit of `read_bytes`."""
        text = self.read_bytes().decode(encoding or "utf-8", errors or "strict")
        return text if newline == "" else text.replace("\r\n", "\n").replace("\r", "\n")

    def _opened_folder(self) -> int:
        with self._within() as (folder, name):
            os.close(self._entered(folder, name))  # for its error at a link
            return os.open(name, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC, dir_fd=folder)

    def _entries(self) -> list[tuple[str, bool]]:
        """Return the names in a folder, sorted, and whether each is a folder; none where there is no folder."""
        try:
            opened = self._opened_folder()
        except (FileNotFoundError, NotADirectoryError):
            return []
        try:
            with os.scandir(opened) as found:
                return sorted((entry.name, entry.is_dir(follow_symlinks=False)) for entry in found)
        finally:
            os.close(opened)

    def iterdir(self) -> Generator["ConfinedPath", None, None]:
        """Yield what lies in a folder, sorted; links as such."""
        self.stat()
        yield from (self / name for name, _ in self._entries())

    def walk(self, *_: Any, **__: Any) -> Iterator[tuple["ConfinedPath", list[str], list[str]]]:
        """Yield each folder, this one first, with the sorted names of its folders and of all else; none behind links.

        Of a folder that is not there nothing is yielded.
        """
        entries = self._entries()
        if not entries and not self.is_dir():
            return
        folders, files = ([name for name, is_folder in entries if is_folder is kind] for kind in (True, False))
        yield self, folders, files
        for name in folders:
            yield from (self / name).walk()

    def rglob(self, pattern: str, **_: Any) -> Iterator["ConfinedPath"]:  # type: ignore[override]
        """Yield what lies below a folder and has such a name, sorted folder by folder; links as such."""
        for folder, folders, files in self.walk():
            yield from (folder / name for name in sorted((*folders, *files)) if fnmatchcase(name, pattern))

    def glob(self, pattern: str, **_: Any) -> Iterator["ConfinedPath"]:  # type: ignore[override]
        """Yield what lies below a folder at such a path, whose components hold wildcards; ``**`` is not known."""
        first, *rest = pattern.split("/", 1)
        for name, is_folder in self._entries():
            if fnmatchcase(name, first):
                if not rest:
                    yield self / name
                elif is_folder:
                    yield from (self / name).glob(rest[0])

    # ---- Writing ----------------------------------------------------------------------------------------------------

    def write_bytes(self, data: Any) -> int:
        """As `pathlib.Path.write_bytes`."""
        with self.open("wb") as stream:
            return stream.write(data)

    def write_text(  # type: ignore[override]
        self, data: str, encoding: str | None = None, errors: str | None = None
    ) -> int:
        """As `pathlib.Path.write_text`; UTF-8 unless stated, newlines as they are."""
        return self.write_bytes(data.encode(encoding or "utf-8", errors or "strict"))

    def mkdir(self, mode: int = 0o777, parents: bool = False, exist_ok: bool = False) -> None:
        """As `pathlib.Path.mkdir`."""
        with self._within(make=parents) as (folder, name):
            try:
                os.mkdir(name, mode, dir_fd=folder)
            except FileExistsError:
                if not exist_ok:
                    raise
                with suppress(FileNotFoundError):  # another process has removed it since
                    os.close(self._entered(folder, name))

    def unlink(self, missing_ok: bool = False) -> None:
        """As `pathlib.Path.unlink`: of a link, the link alone is removed."""
        try:
            with self._within() as (folder, name):
                os.unlink(name, dir_fd=folder)
        except FileNotFoundError:
            if not missing_ok:
                raise

    def rmdir(self) -> None:
        """As `pathlib.Path.rmdir`."""
        with self._within() as (folder, name):
            os.rmdir(name, dir_fd=folder)

    def remove(self) -> None:
        """Remove a file, or a folder with its contents, if there is one; of links, the links alone."""
        with suppress(FileNotFoundError), self._within() as (folder, name):
            if stat.S_ISDIR(os.stat(name, dir_fd=folder, follow_symlinks=False).st_mode):
                shutil.rmtree(name, dir_fd=folder)
            else:
                os.unlink(name, dir_fd=folder)

    def rename(self, target: Any) -> "ConfinedPath":
        """Give a file or folder another name in the campaign; a file or empty folder of that name is replaced."""
        there = ConfinedPath.of(target)
        with self._within() as (folder, name), there._within() as (other, new):
            os.rename(name, new, src_dir_fd=folder, dst_dir_fd=other)
        return there

    replace = rename

    def set_times(self, *, accessed_ns: int, modified_ns: int) -> None:
        """Set the times of a file."""
        with self._within() as (folder, name):
            os.utime(name, ns=(accessed_ns, modified_ns), dir_fd=folder, follow_symlinks=False)

    def synchronise(self) -> None:
        """Bring a plain file, or a folder with all plain files below it, to the disk."""
        mode = self._mode(follow_symlinks=False)
        if stat.S_ISREG(mode):
            self._synchronised(self.descriptor(os.O_RDONLY))
        elif stat.S_ISDIR(mode):
            for name, _ in self._entries():
                (self / name).synchronise()
            self.synchronise_folder()

    def synchronise_folder(self) -> None:
        """Bring the names in a folder to the disk."""
        self._synchronised(self._opened_folder())

    def _synchronised(self, opened: int) -> None:
        try:
            os.fsync(opened)
        except OSError as error:
            error.filename = str(self)
            raise
        finally:
            os.close(opened)


def on_disk(path: Path) -> AbstractContextManager[Path]:
    """Return a context of a name for libraries, as `ConfinedPath.on_disk`; of another path, that path."""
    return path.on_disk() if isinstance(path, ConfinedPath) else nullcontext(path)


def _restored(top: Path, elsewhere: Mapping[str, Path], name: str) -> ConfinedPath:
    return ConfinedPath.at(top, elsewhere=elsewhere) / name
