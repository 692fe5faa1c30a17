"""A campaign folder of two nodes that may be spoilt: its config, recordings, logs and codes, each changed in place."""

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
"""The node that transmits and receives, whose log is a CSV with attitude; the one that receives, with a .pos."""

Captures = NDArray[np.int16]
Document = dict[str, Any]


@dataclass(frozen=True)
class Folder:
    """A copy of a campaign with one flight f01 of nodes `TX` and `RX`."""

    root: Path

    def edit_config(self, change: Callable[[Document], object]) -> None:
        """Change config.yaml as a document."""
        path = self.root / "config" / "config.yaml"
        document = yaml.safe_load(path.read_text(encoding="utf-8"))
        change(document)
        path.write_text(yaml.safe_dump(document, sort_keys=False), encoding="utf-8")

    def edit_codes(self, change: Callable[[NDArray[np.complex64]], NDArray[Any]]) -> None:
        """Replace the code symbols, (subcarrier,) complex64."""
        path = self.root / "raw" / "codes.npy"
        np.save(path, change(np.load(path)).astype(np.complex64))

    def edit_meta(self, node: str, change: Callable[[Document], object]) -> None:
        """Change what the SigMF metadata of a node say."""
        path = self._raw(f"{node}.sigmf-meta")
        meta = json.loads(path.read_text(encoding="utf-8"))
        change(meta)
        path.write_text(json.dumps(meta), encoding="utf-8")

    def edit_captures(self, node: str, change: Callable[[Captures], NDArray[Any]]) -> None:
        """Replace the samples of a node, (capture, sample, channel, 2) counts of I and Q; fewer captures may come back.

        Counts are rounded and clipped to int16; tags of captures that are gone stay until `edit_meta` removes them.
        """
        path = self._raw(f"{node}.sigmf-data")
        meta = json.loads(self._raw(f"{node}.sigmf-meta").read_text(encoding="utf-8"))
        shape = (len(meta["captures"]), -1, meta["global"]["core:num_channels"], 2)
        changed = change(np.fromfile(path, "<i2").reshape(shape))
        np.clip(np.rint(changed), -32768, 32767).astype("<i2").tofile(path)
        digest = hashlib.sha512(path.read_bytes()).hexdigest()
        self.edit_meta(node, lambda meta: meta["global"].update({"core:sha512": digest}))

    def log(self, node: str) -> Log:
        """Return the flight log of a node."""
        return read_log(self._log_path(node))

    def edit_log(self, node: str, change: Callable[[Log], Log]) -> None:
        """Change the flight log of a node."""
        write_log(self._log_path(node), change(self.log(node)))

    def _log_path(self, node: str) -> Path:
        return next((self.root / "raw" / "f01").glob(f"{node}.track.*"))

    def _raw(self, name: str) -> Path:
        return self.root / "raw" / "f01" / name


Spoil = Callable[[Folder], None]


@dataclass(frozen=True)
class Mistake:
    """One mistake that may be made with a campaign.

    Attributes
    ----------
    words
        What was done wrong, in a few words.
    spoil
        Makes it.
    cause
        Which cause a hypothesis should name: one of `CAUSES`, or empty where none of the cheap ones fits.
    control
        Nothing in it is wrong: the image must stay right, and a flag on it is a false alarm.
    alike
        Bases in which it moves everything alike: nothing inside the campaign can tell.
    """

    words: str
    spoil: Spoil
    cause: str = ""
    control: bool = False
    alike: tuple[str, ...] = ()


CAUSES = ("offset", "time", "height", "arm", "channels", "tracks", "range", "prefix", "carrier_is", "attitude")
