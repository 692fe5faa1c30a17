"""Modification of a campaign folder of two nodes in place: config, recordings, logs and codes."""

import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from spoiling.logs import Log, read_log, write_log

TX, RX = "uav1", "uav2"
"""Transmitting and receiving node, with a CSV log with attitude; receiving node, with a .pos log."""

Captures = NDArray[np.int16]
Document = dict[str, Any]


@dataclass(frozen=True)
class Folder:
    """Copy of a campaign with one flight f01 of nodes `TX` and `RX`."""

    root: Path

    def edit_config(self, change: Callable[[Document], object]) -> None:
        """Change the document in config.yaml."""
        path = self.root / "config" / "config.yaml"
        document = yaml.safe_load(path.read_text(encoding="utf-8"))
        change(document)
        path.write_text(yaml.safe_dump(document, sort_keys=False), encoding="utf-8")

    def edit_codes(self, change: Callable[[NDArray[np.complex64]], NDArray[Any]]) -> None:
        """Replace the code symbols, (subcarrier,) complex64."""
        path = self.root / "raw" / "codes.npy"
        np.save(path, change(np.load(path)).astype(np.complex64))

    def edit_meta(self, node: str, change: Callable[[Document], object]) -> None:
        """Change the SigMF metadata of a node."""
        path = self._raw(f"{node}.sigmf-meta")
        meta = json.loads(path.read_text(encoding="utf-8"))
        change(meta)
        path.write_text(json.dumps(meta), encoding="utf-8")

    def edit_captures(self, node: str, change: Callable[[Captures], NDArray[Any]]) -> None:
        """Replace the samples of a node, (capture, sample, channel, 2) counts of I and Q; captures may be removed.

        Counts are rounded and clipped to int16; metadata of removed captures remain until `edit_meta` removes them.
        """
        path = self._raw(f"{node}.sigmf-data")
        meta = json.loads(self._raw(f"{node}.sigmf-meta").read_text(encoding="utf-8"))
        shape = (len(meta["captures"]), -1, meta["global"]["core:num_channels"], 2)
        changed = change(np.fromfile(path, "<i2").reshape(shape))
        np.clip(np.rint(changed), -32768, 32767).astype("<i2").tofile(path)
        digest = hashlib.sha512(path.read_bytes()).hexdigest()
        self.edit_meta(node, lambda meta: meta["global"].update({"core:sha512": digest}))

    def log(self, node: str) -> Log:
        """Read the flight log of a node."""
        return read_log(self._log_path(node))

    def edit_log(self, node: str, change: Callable[[Log], Log]) -> None:
        """Change the flight log of a node."""
        write_log(self._log_path(node), change(self.log(node)))

    def _log_path(self, node: str) -> Path:
        return next((self.root / "raw" / "f01").glob(f"{node}.track.*"))

    def _raw(self, name: str) -> Path:
        return self.root / "raw" / "f01" / name


FolderChange = Callable[[Folder], None]


@dataclass(frozen=True)
class Mistake:
    """Mistake in a campaign.

    Attributes
    ----------
    words
        Short description.
    apply
        Function that introduces the mistake.
    cause
        Cause of the expected hypothesis: one of `CAUSES`, or empty if no tested hypothesis applies.
    control
        True for a change without effect on the image: a flag raised for the change is a false alarm.
    alike
        Bases in which the mistake displaces the whole scene, which is not observable within the campaign.
    """

    words: str
    apply: FolderChange
    cause: str = ""
    control: bool = False
    alike: tuple[str, ...] = ()


CAUSES = ("offset", "time", "height", "arm", "channels", "tracks", "range", "prefix", "carrier_is", "attitude")
