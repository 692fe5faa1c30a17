"""Confined paths of a campaign folder: access below the folder is relative to a descriptor and follows no link.

A campaign folder is untrusted, and other processes may write to it at any time. Files in the folder are therefore never
opened by full path, in which the kernel follows links. Instead, each component is opened with ``O_NOFOLLOW`` relative
to the descriptor of its parent (openat(2)), and only regular files and folders are accepted. The path of the campaign
folder itself is trusted and may contain links.
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
"""Maximum size of a file that is read as a whole, such as an array chunk, bytes; documents have lower limits."""

_FOLDER = os.O_PATH | os.O_DIRECTORY | os.O_CLOEXEC
_BELOW = _FOLDER | os.O_NOFOLLOW
_FILE = os.O_NOFOLLOW | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC  # do not block on a FIFO without a writer
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
_EXPECTED = "a regular file or folder: nothing in a campaign folder is read, written or deleted through a link"
_REMEDY = (
    "Remove this entry. The campaign folder itself may be a link; `raw_root` in the config may name a folder elsewhere "
    "that replaces raw/."
)


class ConfinedPath(PosixPath):
    """Path in a campaign folder, through which no file outside the folder can be accessed.

    The class has the methods of `pathlib.Path` that apertura uses. `CampaignError` is raised on reading and writing
    through a symbolic link, and on opening anything other than a regular file or folder. Removing a link does not
    affect its target. Paths derived from a confined path are confined, too. The class does not implement `os.PathLike`:
    for libraries that open files by name, use `on_disk`.

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
            The root folder; its path may be or contain a link.
        elsewhere
            Name of a subfolder → folder outside the root that replaces the subfolder; access to it is confined, too.
        """
        if isinstance(folder, ConfinedPath):
            return folder
        root = cls(folder)
        root._top, root._elsewhere = Path(folder), MappingProxyType(dict(elsewhere or {}))
        return root

    @classmethod
    def of(cls, path: Path) -> "ConfinedPath":
        """Return a path from the user or a caller as a confined path whose parent folder is trusted."""
        return path if isinstance(path, ConfinedPath) else cls.at(path.parent) / path.name

    def with_elsewhere(self, elsewhere: Mapping[str, Path]) -> "ConfinedPath":
        """Return the same path with the subfolders of the root replaced; see `at`."""
        return ConfinedPath.at(self._top, elsewhere=elsewhere) / self.relative_to(self._top)

    def named(self, name: str, *, where: object) -> "ConfinedPath":
        """Return the path of a file named in a document of the campaign.

        Parameters
        ----------
        name
            Path relative to this folder, with slashes.
        where
            Document and key that contain the name, for the error message.

        Raises
        ------
        CampaignError
            If the name is absolute, leads out of the folder, or contains a backslash or control characters.

        Examples
        --------
        >>> ConfinedPath.at("campaign").named("raw/codes.npy", where="config.yaml").as_posix()
        'campaign/raw/codes.npy'
        """
        wrong = None
        if not name.isprintable() or "\\" in name or not name.strip():
            wrong = "is empty or contains a backslash or control characters"
        elif name.startswith("/") or ".." in name.split("/"):
            wrong = "leads out of the campaign folder"
        if wrong:
            raise CampaignError(
                f"path {quoted(name)} {wrong}",
                where,
                "a relative path to a file inside the campaign folder",
                "Copy the file into the folder and state its path relative to the folder.",
            )
        return self / name

    # ---- Derived paths ----------------------------------------------------------------------------------------------

    def _bound(self, path: Any) -> "ConfinedPath":
        path._top, path._elsewhere = self._top, self._elsewhere
        return path  # type: ignore[no-any-return]

    def __truediv__(self, key: Any) -> "ConfinedPath":
        return self._bound(super().__truediv__(key))

    def joinpath(self, *names: Any) -> "ConfinedPath":
        """Override `pathlib.Path.joinpath`."""
        return self._bound(super().joinpath(*names))

    def with_name(self, name: str) -> "ConfinedPath":
        """Override `pathlib.Path.with_name`."""
        return self._bound(super().with_name(name))

    def with_stem(self, stem: str) -> "ConfinedPath":
        """Override `pathlib.Path.with_stem`."""
        return self._bound(super().with_stem(stem))

    def with_suffix(self, suffix: str) -> "ConfinedPath":
        """Override `pathlib.Path.with_suffix`."""
        return self._bound(super().with_suffix(suffix))

    @property
    def parent(self) -> "ConfinedPath":
        """Override `pathlib.Path.parent`."""
        return self._bound(super().parent)

    @property
    def parents(self) -> Any:
        """Override `pathlib.Path.parents`."""
        return tuple(map(self._bound, super().parents))

    def relative_to(self, other: Any, /, *more: Any, **how: Any) -> Path:  # type: ignore[override]
        """Return the path relative to another, as an unconfined path."""
        return Path(self).relative_to(other, *more, **how)

    def is_relative_to(self, other: Any, /, *more: Any) -> bool:
        """Override `pathlib.Path.is_relative_to`."""
        return Path(self).is_relative_to(other, *more)

    def absolute(self) -> "ConfinedPath":
        """Override `pathlib.Path.absolute`; links are not resolved."""
        top = self._top.absolute()
        return ConfinedPath.at(top, elsewhere=self._elsewhere) / self.relative_to(self._top)

    @property
    def location(self) -> Path:
        """Actual path, with subfolders replaced as stated in `at`; for display only, not for opening."""
        first, *rest = self.parts[len(self._top.parts) :] or ("",)
        return self._elsewhere[first].joinpath(*rest) if first in self._elsewhere else Path(self)

    def real(self) -> Path:
        """Return the resolved path on this machine, unconfined; for display and comparison only."""
        top, parts = self._components()
        return top.resolve().joinpath(*parts)

    def __reduce__(self) -> Any:
        return _restored, (self._top, dict(self._elsewhere), self.relative_to(self._top).as_posix())

    def __fspath__(self) -> NoReturn:
        raise TypeError(f"{self}: a confined path cannot be opened by name; use on_disk()")

    # ---- Access by descriptors --------------------------------------------------------------------------------------

    def _refused(self, found: str) -> CampaignError:
        return CampaignError(found, where=self, expected=_EXPECTED, remedy=_REMEDY)

    def _components(self) -> tuple[Path, tuple[str, ...]]:
        """Return the trusted folder and the path components below it."""
        count = len(self._top.parts)
        if "\0" in str(self):
            raise CampaignError(
                "a path with a null byte", where=self, expected="the name of a file", remedy="Correct the path."
            )
        parts = self.parts[count:]
        if self.parts[:count] != self._top.parts or ".." in parts or "/" in parts:
            raise self._refused("leads out of the campaign folder")
        if parts and parts[0] in self._elsewhere:
            return self._elsewhere[parts[0]], parts[1:]
        return self._top, parts

    @contextmanager
    def _within(self, *, make: bool = False) -> Iterator[tuple[int, str]]:
        """Yield a descriptor of the parent folder, and the name of the entry; create missing folders if `make`."""
        top, parts = self._components()
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
            if not str(error.filename or "").startswith(os.sep):  # a name relative to the parent folder
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
        """Open a regular file with the flags of `os.open`, and return its descriptor.

        Raises
        ------
        CampaignError
            If the path is or contains a symbolic link, or is not a regular file; also if a file with further hard links
            is opened for writing, because this would change a file outside the folder.
        """
        with self._within() as (folder, name):
            try:
                opened = os.open(name, flags & ~os.O_TRUNC | _FILE, 0o666, dir_fd=folder)
            except OSError as error:
                if error.errno == errno.ELOOP:
                    raise self._refused("a symbolic link") from None
                if error.errno == errno.ENXIO:
                    kind = stat.S_IFMT(os.stat(name, dir_fd=folder, follow_symlinks=False).st_mode)
                    raise self._refused(_KINDS.get(kind, "not a regular file")) from None
                raise
        try:
            state = os.fstat(opened)
            kind = stat.S_IFMT(state.st_mode)
            if kind == stat.S_IFDIR:
                raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(self))
            if kind != stat.S_IFREG:
                raise self._refused(_KINDS.get(kind, "not a regular file"))
            if flags & _WRITES and state.st_nlink > 1:
                raise self._refused(f"a file with {state.st_nlink} hard links")
            if flags & os.O_TRUNC:
                os.ftruncate(opened, 0)
        except BaseException:
            os.close(opened)
            raise
        return opened

    @contextmanager
    def folder(self) -> Iterator[int]:
        """Yield a descriptor of a folder, for the functions of `os` with a parameter ``dir_fd``."""
        with self._within() as (folder, name):
            entered = self._entered(folder, name)
        try:
            yield entered
        finally:
            os.close(entered)

    def copy_to(self, target: Path, *, link: bool = False) -> None:
        """Copy a file; with `link`, create a hard link instead where possible."""
        if link:
            with (
                suppress(OSError),
                self._within() as (folder, name),
            ):  # fails on another disk, or for other users' files
                os.link(name, target, src_dir_fd=folder, follow_symlinks=False)
                return
        with self.open("rb") as source, target.open("wb") as copy:
            shutil.copyfileobj(source, copy, 1 << 20)

    def link_or_copy_to(self, target: "ConfinedPath") -> None:
        """Create a hard link to a regular file, or a copy if the file system does not permit links."""
        target.parent.mkdir(parents=True, exist_ok=True)
        if not stat.S_ISREG(self.lstat().st_mode):
            raise self._refused("not a regular file")
        with suppress(OSError), self._within() as (folder, name), target._within() as (other, new):
            os.link(name, new, src_dir_fd=folder, dst_dir_fd=other, follow_symlinks=False)
            return
        target.write_bytes(self.read_bytes())

    def reference(self) -> str:
        """Serialize the path as text for another process, see `referenced`."""
        return json.dumps([str(self._top.absolute()), self.relative_to(self._top).as_posix()])

    @classmethod
    def referenced(cls, text: str) -> "ConfinedPath":
        """Restore a path from the text returned by `reference`."""
        top, name = json.loads(text)
        return cls.at(top).joinpath(name)

    @contextmanager
    def on_disk(self) -> Iterator[Path]:
        """Yield an ordinary path to this file or folder, for libraries that open files by name.

        The path is valid in this process and its forks until the context exits. The access of a library to the content
        of a folder is not confined. Therefore apertura only passes files, and folders that it has just created.
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
        """Override `pathlib.Path.stat`; raise CampaignError for a link if links are to be followed."""
        with self._within() as (folder, name):
            state = os.stat(name, dir_fd=folder, follow_symlinks=False)
        if follow_symlinks and stat.S_ISLNK(state.st_mode):
            raise self._refused("a symbolic link")
        return state

    def lstat(self) -> os.stat_result:
        """Override `pathlib.Path.lstat`."""
        return self.stat(follow_symlinks=False)

    def _mode(self, *, follow_symlinks: bool = True) -> int:
        try:
            return self.stat(follow_symlinks=follow_symlinks).st_mode
        except (FileNotFoundError, NotADirectoryError):
            return 0

    def exists(self, *, follow_symlinks: bool = True) -> bool:
        """Override `pathlib.Path.exists`; raise CampaignError at a link."""
        return self._mode(follow_symlinks=follow_symlinks) != 0

    def is_file(self, *, follow_symlinks: bool = True) -> bool:
        """Override `pathlib.Path.is_file`; raise CampaignError at a link."""
        return stat.S_ISREG(self._mode(follow_symlinks=follow_symlinks))

    def is_dir(self, *, follow_symlinks: bool = True) -> bool:
        """Override `pathlib.Path.is_dir`; raise CampaignError at a link."""
        return stat.S_ISDIR(self._mode(follow_symlinks=follow_symlinks))

    def is_symlink(self) -> bool:
        """Override `pathlib.Path.is_symlink`."""
        return stat.S_ISLNK(self._mode(follow_symlinks=False))

    def permits(self, mode: int) -> bool:
        """Check access permissions of the file, as `os.access` does."""
        with self._within() as (folder, name):
            return os.access(name, mode, dir_fd=folder, follow_symlinks=False)

    def free_bytes(self) -> int:
        """Return the free disk space below a folder in bytes."""
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
        """Override `pathlib.Path.open`; see `descriptor` for errors."""
        opened = self.descriptor(_MODES[mode.replace("b", "").replace("t", "")])
        return os.fdopen(opened, mode, buffering, encoding, errors, newline)

    def read_bytes(self, largest: int = LARGEST_READ) -> bytes:
        """Read the bytes of a file; raise CampaignError if it is larger than `largest`."""
        with self.open("rb", buffering=0) as stream:
            size = os.fstat(stream.fileno()).st_size
            if size > largest:
                raise CampaignError(
                    f"{size} bytes",
                    self,
                    f"a file of at most {largest} bytes",
                    "Remove the file if it is the wrong file.",
                )
            return stream.read()  # type: ignore[no-any-return]

    def read_text(self, encoding: str | None = None, errors: str | None = None, newline: str | None = None) -> str:
        """Override `pathlib.Path.read_text`, with the limit of `read_bytes`."""
        text = self.read_bytes().decode(encoding or "utf-8", errors or "strict")
        return text if newline == "" else text.replace("\r\n", "\n").replace("\r", "\n")

    def _opened_folder(self) -> int:
        with self._within() as (folder, name):
            os.close(self._entered(folder, name))  # raises CampaignError at a link
            return os.open(name, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC, dir_fd=folder)

    def _entries(self) -> list[tuple[str, bool]]:
        """List the sorted entries of a folder: name, and True if a folder; empty if the folder does not exist."""
        try:
            opened = self._opened_folder()
        except (FileNotFoundError, NotADirectoryError):
            return []
        try:
            with os.scandir(opened) as entries:
                return sorted((entry.name, entry.is_dir(follow_symlinks=False)) for entry in entries)
        finally:
            os.close(opened)

    def iterdir(self) -> Generator["ConfinedPath", None, None]:
        """Yield the entries of a folder, sorted; links are not followed."""
        self.stat()
        yield from (self / name for name, _ in self._entries())

    def walk(self, *_: Any, **__: Any) -> Iterator[tuple["ConfinedPath", list[str], list[str]]]:
        """Yield this folder and all folders below it, with sorted names of subfolders and other entries.

        Links are not followed. Nothing is yielded for a missing folder.
        """
        entries = self._entries()
        if not entries and not self.is_dir():
            return
        folders, files = ([name for name, is_folder in entries if is_folder is kind] for kind in (True, False))
        yield self, folders, files
        for name in folders:
            yield from (self / name).walk()

    def rglob(self, pattern: str, **_: Any) -> Iterator["ConfinedPath"]:  # type: ignore[override]
        """Yield entries at any depth whose name matches a pattern, sorted in each folder; links are not followed."""
        for folder, folders, files in self.walk():
            yield from (folder / name for name in sorted((*folders, *files)) if fnmatchcase(name, pattern))

    def glob(self, pattern: str, **_: Any) -> Iterator["ConfinedPath"]:  # type: ignore[override]
        """Yield the paths below a folder that match a pattern with wildcards; ``**`` is not supported."""
        first, *rest = pattern.split("/", 1)
        for name, is_folder in self._entries():
            if fnmatchcase(name, first):
                if not rest:
                    yield self / name
                elif is_folder:
                    yield from (self / name).glob(rest[0])

    # ---- Writing ----------------------------------------------------------------------------------------------------

    def write_bytes(self, data: Any) -> int:
        """Override `pathlib.Path.write_bytes`."""
        with self.open("wb") as stream:
            return stream.write(data)

    def write_text(  # type: ignore[override]
        self, data: str, encoding: str | None = None, errors: str | None = None
    ) -> int:
        """Override `pathlib.Path.write_text`; UTF-8 by default, newlines unchanged."""
        return self.write_bytes(data.encode(encoding or "utf-8", errors or "strict"))

    def mkdir(self, mode: int = 0o777, parents: bool = False, exist_ok: bool = False) -> None:
        """Override `pathlib.Path.mkdir`."""
        with self._within(make=parents) as (folder, name):
            try:
                os.mkdir(name, mode, dir_fd=folder)
            except FileExistsError:
                if not exist_ok:
                    raise
                with suppress(FileNotFoundError):  # another process has removed the folder meanwhile
                    os.close(self._entered(folder, name))

    def unlink(self, missing_ok: bool = False) -> None:
        """Override `pathlib.Path.unlink`: a link is removed, but its target remains."""
        try:
            with self._within() as (folder, name):
                os.unlink(name, dir_fd=folder)
        except FileNotFoundError:
            if not missing_ok:
                raise

    def rmdir(self) -> None:
        """Override `pathlib.Path.rmdir`."""
        with self._within() as (folder, name):
            os.rmdir(name, dir_fd=folder)

    def remove(self) -> None:
        """Remove a file, or a folder with its contents, if it exists; targets of links remain."""
        with suppress(FileNotFoundError), self._within() as (folder, name):
            if stat.S_ISDIR(os.stat(name, dir_fd=folder, follow_symlinks=False).st_mode):
                shutil.rmtree(name, dir_fd=folder)
            else:
                os.unlink(name, dir_fd=folder)

    def rename(self, target: Any) -> "ConfinedPath":
        """Rename a file or folder within the campaign; an existing file or empty folder at `target` is replaced."""
        renamed = ConfinedPath.of(target)
        with self._within() as (folder, name), renamed._within() as (other, new):
            os.rename(name, new, src_dir_fd=folder, dst_dir_fd=other)
        return renamed

    replace = rename

    def set_times(self, *, accessed_ns: int, modified_ns: int) -> None:
        """Set the access and modification times of a file."""
        with self._within() as (folder, name):
            os.utime(name, ns=(accessed_ns, modified_ns), dir_fd=folder, follow_symlinks=False)

    def synchronise(self) -> None:
        """Flush a regular file, or a folder with all regular files below it, to disk."""
        mode = self._mode(follow_symlinks=False)
        if stat.S_ISREG(mode):
            self._synchronised(self.descriptor(os.O_RDONLY))
        elif stat.S_ISDIR(mode):
            for name, _ in self._entries():
                (self / name).synchronise()
            self.synchronise_folder()

    def synchronise_folder(self) -> None:
        """Flush the entries of a folder to disk."""
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
    """Return `ConfinedPath.on_disk` of a confined path; for other paths, a context with the path itself."""
    return path.on_disk() if isinstance(path, ConfinedPath) else nullcontext(path)


def _restored(top: Path, elsewhere: Mapping[str, Path], name: str) -> ConfinedPath:
    return ConfinedPath.at(top, elsewhere=elsewhere) / name
