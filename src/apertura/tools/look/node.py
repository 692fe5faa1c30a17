"""Recording and log of a node while they grow: complete captures and lines, read once."""

import time
import zlib
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, cast

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from apertura.campaign.folder import Campaign
from apertura.common.arrays import Times
from apertura.common.errors import CampaignError
from apertura.formats.names import GROWING, TRACKS, log_format
from apertura.formats.reading import open_recording, read_track
from apertura.formats.recordings.recording import Captures, Recording
from apertura.stages.acquisition import Acquisition, Captured
from apertura.stages.ingest import captures_of
from apertura.stages.node_log import shortest_wave
from apertura.stages.transmitted import Transmitted

_ABOUT_S = 60.0  # of the log about the pulses of a block: farther epochs do not move a spline
_KNOWN_BYTES = 4096  # at either end of the samples that were read, by which they are known again
_EPOCHS = 4  # that a log must be ahead of a pulse: those to come would move it by 0.27⁴ of its error at the end


class NotFollowedError(CampaignError):
    """A recording that cannot be read while it is written."""


class NodeSoFar:
    """Recording and log of a node so far; complete captures and lines alone.

    What was read is dropped where the files no longer begin with it: a recorder that is started again under the same
    name. A change in the middle of the samples is not seen; the run reads all of them.

    Parameters
    ----------
    campaign, flight, node
        Which.
    sent
        What was transmitted.
    follow
        Whether its files still grow: a kind that cannot be read meanwhile is refused.
    """

    def __init__(self, campaign: Campaign, flight: str, node: str, sent: Transmitted, *, follow: bool) -> None:
        self.name, self.waits = node, ""
        self.grown_at: float | None = None
        """When something was last found to have come, by the clock `time.monotonic`."""
        self.begun_anew = ""
        """Why all that was read has been dropped, until someone has taken note and emptied it."""
        self._campaign, self._flight, self._sent, self._follow = campaign, flight, sent, follow
        self._forget()

    def _forget(self) -> None:
        self.time: Times = np.zeros(0, "datetime64[ns]")
        self.frame: NDArray[np.int64] = np.zeros(0, np.int64)
        self.track: xr.Dataset | None = None
        self.ended = False
        self._recording: Recording | None = None
        self._found: xr.Dataset | None = None  # captures found in samples that never stopped
        self._growing: Any = None
        self._known = 0, b"", b""  # of the samples
        self._log_size, self._log_bytes, self._log_crc = -1, 0, 0  # of the file, of its whole lines

    def _begin_anew(self, path: Path, found: str) -> None:
        """Drop what was read: a file no longer begins with it."""
        self._forget()
        file = path.relative_to(self._campaign.root)
        self.begun_anew = f"{file}: {found}: what was shown of {self._flight} {self.name} is dropped, and begun anew"

    def read(self) -> bool:
        """Read what has come since; return whether anything has."""
        before = len(self.time), self._log_size
        self.waits = ""
        for read in (self._read_recording, self._read_log):
            try:
                read()
            except NotFollowedError:
                raise
            except (CampaignError, OSError) as error:
                if not self._follow:
                    raise
                self.waits = str(error)  # a file that is not there yet, or not now, or has only begun
        grown = (len(self.time), self._log_size) != before
        self.grown_at = time.monotonic() if grown else self.grown_at
        return grown

    def _read_recording(self) -> None:
        if self._found is not None:
            return
        files = self._campaign.recording_files(self._flight, self.name)
        if self._growing is None:
            row = next(row for row in GROWING if files[0].name.endswith(row[0]))
            self._growing = GROWING[row](*files)
        growing = self._growing.read()
        if self._growing.runs_through and not self._follow:
            whole = open_recording(files)
            self._recording, self._found = whole, captures_of(whole, self._campaign, node=self.name)
            recorded, self.frame = self._found.time.values, self._found.frame.values
        elif self._growing.runs_through:
            raise NotFollowedError(
                "apertura:framing: its recorder never stops",
                files[0],
                "one capture segment per trigger, in a recording that is followed",
                "Its pulses are found in all of its samples: look at it without --follow, or when it has ended.",
            )
        else:
            recording = growing if growing or self._follow else open_recording(files)
            if changed := self._changed(recording, files[-1]):
                self._begin_anew(files[-1], changed)
                return
            if recording is None or (self._recording and len(recording.captures.start) < len(self.time)):
                return  # it has only begun, or its metadata are being written anew
            self._known = _ends(files[-1], files[-1].stat().st_size)
            self._recording = recording
            recorded, self.frame = recording.captures.time, recording.captures.frame
        self.time = self._campaign.clock(self._flight, self.name).utc(recorded)
        self.ended = self._growing.ended

    def _changed(self, recording: Recording | None, path: Path) -> str:
        """Return the parts of captures and samples that differ from the earlier reading; empty: none."""
        if self._recording is None or not path.is_file():
            return ""
        known = self._recording.captures.time
        now = known[:0] if recording is None else recording.captures.time
        both = min(len(now), len(known))
        if not np.array_equal(now[:both], known[:both]):
            return "holds captures of other times than before"
        if (size := path.stat().st_size) < self._known[0]:
            return f"holds {size} bytes where there were {self._known[0]}"
        return "" if _ends(path, self._known[0]) == self._known else "does not hold the samples that were read"

    def _read_log(self) -> None:
        path = self._campaign.track_file(self._flight, self.name)
        options = self._campaign.settings.nodes[self.name].log.options
        size = path.stat().st_size
        if size == self._log_size:
            return
        kind = log_format(path, options)
        if not TRACKS[kind].by_lines:
            if self._follow:
                by_lines = ", ".join(name for name, row in TRACKS.items() if row.by_lines)
                raise NotFollowedError(
                    f"a log of format {kind}, which cannot be read while it is written",
                    path,
                    f"a log of lines of text ({by_lines}), where it is followed",
                    "Look without --follow when it has ended, or let the log be streamed as text.",
                )
            self.track = read_track(path, node=self.name, options=options)
        else:
            lines = path.read_bytes()
            lines = lines[: lines.rfind(b"\n") + 1]
            if self._log_bytes > 0 and zlib.crc32(lines[: self._log_bytes]) != self._log_crc:
                self._begin_anew(path, "does not begin with the lines that were read")
                return
            with TemporaryDirectory() as folder:
                whole = Path(folder) / path.name
                whole.write_bytes(lines)
                self.track = read_track(whole, node=self.name, options=options)
            self._log_bytes, self._log_crc = len(lines), zlib.crc32(lines)
        self._log_size = size

    def known_until(self, *, ended: bool) -> np.datetime64:
        """Return up to when positions are known: by some epochs less than the log, unless that has ended."""
        if self.track is None:
            return np.datetime64(0, "ns")
        epochs = self.track.time.values
        return cast("np.datetime64", epochs[-1 if ended else max(0, len(epochs) - 1 - _EPOCHS)])

    @property
    def has_read(self) -> bool:
        """True if captures and epochs of the log have been read."""
        return bool(len(self.time)) and self.track is not None

    @property
    def complete(self) -> bool:
        """True if the recording says that it has ended, and the log reaches as far."""
        return bool(self.ended and len(self.time) and self.known_until(ended=True) >= self.time[-1])

    @property
    def lacks(self) -> str:
        """Missing parts for `complete`, in words."""
        if not self.ended:
            return f"the metadata of {self.name} do not state the hash of its samples, or not all of these are there"
        return "" if self.complete else f"the log of {self.name} ends before its last capture"

    def acquisition(self, captures: NDArray[np.int64]) -> Acquisition:
        """Return some captures with the log about them; frames count them, as they are paired already."""
        if self._recording is None or self.track is None:
            raise TypeError("nothing is recorded or logged yet")
        if self._found is not None:
            raw = self._found.isel(pulse=captures)
        else:
            own = self._recording.captures
            some = Captures(own.start[captures], own.length, own.time[captures], own.frame[captures])
            raw = self._recording.cut(some, node=self.name)
        raw = raw.assign(time=("pulse", self.time[captures]), frame=("pulse", np.arange(len(captures))))
        about = np.timedelta64(round(_ABOUT_S * 1e9), "ns")
        epochs = self.track.time.values
        near = (epochs >= raw.time.values[0] - about) & (epochs <= raw.time.values[-1] + about)
        log = str(self._campaign.track_file(self._flight, self.name))
        if not near.any():
            raise CampaignError(
                f"no epoch within {_ABOUT_S:g} s of captures from {raw.time.values[0]} on",
                log,
                "the log of the same flight, and clocks that agree",
                "Give the log of this flight, or the clock's offset in config/clocks.tsv.",
            )
        files = Path("raw") / self._flight / self.name
        order = self._campaign.settings.iq_of(self.name)
        captured = Captured.of(raw, self._recording.samples.path, files, str(files), self._sent, order=order)
        settings = self._campaign.node(self._flight, self.name)
        wave_m = shortest_wave(self._sent.numerology.frequency_hz)
        return Acquisition(self.name, settings, self.track.isel(epoch=near), log, wave_m, **vars(captured))


def _ends(path: Path, size: int) -> tuple[int, bytes, bytes]:
    """Return a number of bytes of a file, and those at the begin and the end of that many."""
    with path.open("rb") as stream:
        head = stream.read(min(size, _KNOWN_BYTES))
        stream.seek(max(0, size - _KNOWN_BYTES))
        return size, head, stream.read(min(size, _KNOWN_BYTES))
