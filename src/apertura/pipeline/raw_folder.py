"""Files of raw/ in a campaign folder, by the names of flights and nodes."""

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from apertura.common.confined import ConfinedPath
from apertura.common.errors import CampaignError
from apertura.formats.names import PHASE_HISTORIES, log_suffixes, recording_files
from apertura.pipeline.config import FLIGHTS, SampledWaveform, Settings

_OF_RAW = ("track.manifest.json", "echo.manifest.json")
"""Manifests that name logs and phase histories among their sources."""


@dataclass(frozen=True)
class RawFolder:
    """The folder raw/ of a campaign.

    Attributes
    ----------
    root
        The campaign folder.
    settings
        Its config.
    """

    root: ConfinedPath
    settings: Settings

    def __post_init__(self) -> None:
        """Confine the paths of the folder, and of raw/ where the config states that it lies elsewhere."""
        elsewhere = getattr(self.settings, "raw_root", None)
        root = ConfinedPath.at(self.root)
        object.__setattr__(self, "root", root.with_elsewhere({"raw": Path(elsewhere)}) if elsewhere else root)

    def raw_files(self, flight: str, node: str) -> dict[str, ConfinedPath]:
        """Return role → file of everything recorded by `node` in `flight`, whether it is there or not."""
        if isinstance(self.settings.waveform, SampledWaveform):
            recorded = {path.suffix: path for path in self.promised_files(flight, node)}
            return {**recorded, "track": self.track_file(flight, node)}
        folder = self.flight_folder(flight)
        files = self.history_files(flight, node)
        history = {f"history.{path.relative_to(folder).as_posix()}": path for path in files}
        return {**history, **({"track": self.track_file(flight, node)} if self.logged(flight, node) else {})}

    def promised_files(self, flight: str, node: str) -> tuple[ConfinedPath, ...]:
        """Return the files that `recording_files` does, whether they are there or not."""
        return tuple(self._recorded(flight, path.name) for path in recording_files(self.flight_folder(flight), node))

    def recording_files(self, flight: str, node: str) -> tuple[ConfinedPath, ...]:
        """Return the files of the recording of `node` in `flight`, in the order of their row of `RECORDERS`."""
        return tuple(self._raw_file(flight, node, path) for path in self.promised_files(flight, node))

    def history_files(self, flight: str, node: str) -> list[ConfinedPath]:
        """Return the files of a node's phase history, in the order of their names; of a folder all that it holds."""
        suffix = PHASE_HISTORIES[self.settings.waveform.format].suffix  # type: ignore[union-attr]
        folder = self.flight_folder(flight)
        named = [path for path in sorted(folder.glob(f"{node}*{suffix}")) if path.name[len(node)] == "."]
        found = [file for path in named if not _is_log(path, node) for file in _files(path)]
        own = [path.relative_to(folder).as_posix() for path in found]
        own = own or [name for name in self._made_from(flight, node) if not _is_log(Path(name), node)]
        if not own:
            raise CampaignError(
                "no such file",
                where=folder / f"{node}.*{suffix}",
                expected=f"the phase history of node {node} in flight {flight}",
                remedy=f"Copy the {suffix} files there, named <node>{suffix} or <node>.<anything>{suffix}.",
            )
        return [self._recorded(flight, name) for name in own]

    def logged(self, flight: str, node: str) -> bool:
        """Return whether a flight log of a node lies there, or lay there when results were made."""
        return bool(self._logs(flight, node))

    def track_file(self, flight: str, node: str) -> ConfinedPath:
        """Return the one raw/<flight>/<node>.track.* file."""
        logs = self._logs(flight, node)
        if len(logs) == 1:
            return self._recorded(flight, logs[0])
        raise CampaignError(
            f"{len(logs)} track files {logs}",
            where=self.flight_folder(flight) / f"{node}.track.*",
            expected=f"exactly one flight log of node {node}",
            remedy=f"Copy the log there, named <node>.track.<{'|'.join(log_suffixes())}>.",
        )

    def _logs(self, flight: str, node: str) -> list[str]:
        there = sorted(path.name for path in self.flight_folder(flight).glob(f"{node}.track.*"))
        return there or [name for name in self._made_from(flight, node) if _is_log(Path(name), node)]

    def _made_from(self, flight: str, node: str) -> list[str]:
        """Return the files of a node that results say they were made from, where none is there: raw/ stayed behind."""
        from apertura.pipeline.store import read_manifest  # loads arrays, which no config needs

        sources, folder = set[str](), f"raw/{flight}/"
        if any(self.flight_folder(flight).glob(f"{node}.*")):
            return []
        for path in self.root.named(f"results/{flight}", where=self.root).glob("*/*.manifest.json"):
            if path.name in _OF_RAW:
                with suppress(CampaignError):
                    sources |= read_manifest(path).get("sources", {}).keys()
        return sorted(name.removeprefix(folder) for name in sources if name.startswith(f"{folder}{node}."))

    def flight_folder(self, flight: str) -> ConfinedPath:
        """Return raw/<flight>."""
        return self.root.named(f"raw/{flight}", where=self.root)

    def _recorded(self, flight: str, name: str) -> ConfinedPath:
        return self.root.named(f"raw/{flight}/{name}", where=self.root)

    def _raw_file(self, flight: str, node: str, path: ConfinedPath) -> ConfinedPath:
        """Return a file of a node, which must exist."""
        if not path.is_file():
            raise CampaignError(
                "no such file",
                where=path,
                expected=f"the recording of node {node} in flight {flight}",
                remedy=f"Copy it there, or take {node} out of the nodes of {flight} in {FLIGHTS}.",
            )
        return path


def size_of(path: ConfinedPath) -> int:
    """Return the bytes of a file; 0 where it is not there."""
    return path.stat().st_size if path.is_file() else 0


def _is_log(path: Path, node: str) -> bool:
    return path.name.startswith(f"{node}.track.")


def _files(path: ConfinedPath) -> list[ConfinedPath]:
    """Return a file itself, or those of a folder; raise CampaignError at a link."""
    inside_it = list(path.rglob("*")) if path.is_dir() else [path]
    return [file for file in inside_it if not file.is_dir()]
