"""Incremental reading of a node's growing recording and log: complete captures and lines only."""

import time
import zlib
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, cast

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from apertura.campaign.folder import Campaign
from apertura.common.arrays import Times
from apertura.common.errors import CampaignError
from apertura.common.units import nanoseconds
from apertura.core.echo.frame_codes import frame_numbers
from apertura.formats.names import GROWING, TRACKS, log_format
from apertura.formats.reading import open_recording, read_track
from apertura.formats.recordings.recording import Captures, Recording
from apertura.stages.acquisition import Acquisition, Captured
from apertura.stages.ingest import captures_of
from apertura.stages.node_log import shortest_wave
from apertura.stages.transmitted import Transmitted

_MARGIN_S = 60.0  # margin of the log around the pulses of a block; epochs farther away do not affect the spline
_KNOWN_BYTES = 4096  # number of bytes compared at either end of the samples read, to detect a restarted recording
_EPOCHS = 4  # epochs required after a pulse: end effects of a spline decrease to 0.27⁴ over this number of epochs


class NotFollowedError(CampaignError):
    """A recording that cannot be read while it is being written."""


class NodeSoFar:
    """Recording and log of a node up to the present time, without incomplete captures and lines.

    Data read earlier are discarded if the files no longer begin with these data, which means that the recorder was
    restarted with the same file names. Only the first and last bytes of the samples are compared: other changes are not
    detected here, but by the workflow, which reads all samples.

    Parameters
    ----------
    campaign, flight, node
        Campaign, name of the flight and name of the node.
    sent
        The transmitted waveform.
    follow
        True if the files still grow; formats that cannot be read during the recording are refused.
    """

    def __init__(self, campaign: Campaign, flight: str, node: str, sent: Transmitted, *, follow: bool) -> None:
        self.name, self.waits = node, ""
        self.grown_at: float | None = None
        """Time of the last growth, in the clock `time.monotonic`."""
        self.restart = ""
        """Message on a restarted recording or log, until the caller clears it."""
        self._campaign, self._flight, self._sent, self._follow = campaign, flight, sent, follow
        self._forget()

    def _forget(self) -> None:
        self.time: Times = np.zeros(0, "datetime64[ns]")
        self.frame: NDArray[np.int64] = np.zeros(0, np.int64)
        self.track: xr.Dataset | None = None
        self.ended = False
        self._recording: Recording | None = None
        self._found: xr.Dataset | None = None  # captures found in a continuous recording
        self._growing: Any = None
        self._known = 0, b"", b""  # size, first and last bytes of the samples read
        self._log_size, self._log_bytes, self._log_crc = -1, 0, 0  # file size; size and CRC of its complete lines

    def _restart(self, path: Path, change: str) -> None:
        """Discard the data read earlier, because a file no longer begins with these data."""
        self._forget()
        file = path.relative_to(self._campaign.root)
        self.restart = f"{file}: {change}: images of {self._flight} {self.name} are restarted from the new files"

    def read(self) -> bool:
        """Read new data of recording and log; return True if there were new data."""
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
                self.waits = str(error)  # a file that is missing, not readable at present, or incomplete
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
            complete = open_recording(files)
            self._recording, self._found = complete, captures_of(complete, self._campaign, node=self.name)
            recorded, self.frame = self._found.time.values, self._found.frame.values
        elif self._growing.runs_through:
            raise NotFollowedError(
                "apertura:framing: a continuous recording, in which pulses are found only after its end",
                files[0],
                "one capture segment per trigger for --follow",
                "Use apertura preview without --follow after the end of the recording.",
            )
        else:
            recording = growing if growing or self._follow else open_recording(files)
            if changed := self._changed(recording, files[-1]):
                self._restart(files[-1], changed)
                return
            if recording is None or (self._recording and len(recording.captures.start) < len(self.time)):
                return  # no complete capture yet, or the metadata are being rewritten
            self._known = _ends(files[-1], files[-1].stat().st_size)
            self._recording = recording
            recorded, self.frame = recording.captures.time, recording.captures.frame
        self.time = self._campaign.clock(self._flight, self.name).utc(recorded)
        self.ended = self._growing.ended

    def _changed(self, recording: Recording | None, path: Path) -> str:
        """Describe the change of captures or samples since the last reading; empty without a change."""
        if self._recording is None or not path.is_file():
            return ""
        earlier = self._recording.captures.time
        present = earlier[:0] if recording is None else recording.captures.time
        common = min(len(present), len(earlier))
        if not np.array_equal(present[:common], earlier[:common]):
            return "the capture times changed"
        if (size := path.stat().st_size) < self._known[0]:
            return f"the file size decreased from {self._known[0]} to {size} bytes"
        return "" if _ends(path, self._known[0]) == self._known else "samples that were already read changed"

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
                    f"a log of format {kind}, which cannot be read while it is being written",
                    path,
                    f"a line-oriented text format ({by_lines}) for --follow",
                    "Use apertura preview without --follow after the end of the log, or record the log as text.",
                )
            self.track = read_track(path, node=self.name, options=options)
        else:
            lines = path.read_bytes()
            lines = lines[: lines.rfind(b"\n") + 1]
            if self._log_bytes > 0 and zlib.crc32(lines[: self._log_bytes]) != self._log_crc:
                self._restart(path, "log lines that were already read changed")
                return
            with TemporaryDirectory() as folder:
                complete_lines = Path(folder) / path.name
                complete_lines.write_bytes(lines)
                self.track = read_track(complete_lines, node=self.name, options=options)
            self._log_bytes, self._log_crc = len(lines), zlib.crc32(lines)
        self._log_size = size

    def known_until(self, *, ended: bool) -> np.datetime64:
        """Return the time until which positions are available: `_EPOCHS` before the end of a log that still grows."""
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
        """True if the recording is declared complete and the log covers it."""
        return bool(self.ended and len(self.time) and self.known_until(ended=True) >= self.time[-1])

    @property
    def missing(self) -> str:
        """Description of the data missing for `complete`."""
        if not self.ended:
            return f"the metadata of {self.name} do not contain the hash of the samples, or samples are missing"
        return "" if self.complete else f"the log of {self.name} ends before its last capture"

    def acquisition(self, captures: NDArray[np.int64]) -> Acquisition:
        """Return paired captures, renumbered with frame numbers from 0, and the part of the log around their times."""
        if self._recording is None or self.track is None:
            raise TypeError("no recording or log has been read yet")
        if self._found is not None:
            raw = self._found.isel(pulse=captures)
        else:
            recorded = self._recording.captures
            selected = Captures(
                recorded.start[captures], recorded.length, recorded.time[captures], recorded.frame[captures]
            )
            raw = self._recording.cut(selected, node=self.name)
        raw = raw.assign(time=("pulse", self.time[captures]), frame=("pulse", np.arange(len(captures))))
        margin = np.timedelta64(round(_MARGIN_S * 1e9), "ns")
        epochs = self.track.time.values
        near = (epochs >= raw.time.values[0] - margin) & (epochs <= raw.time.values[-1] + margin)
        log = str(self._campaign.track_file(self._flight, self.name))
        if not near.any():
            raise CampaignError(
                f"no epoch within {_MARGIN_S:g} s of the captures that start at {raw.time.values[0]}",
                log,
                "a log of the same flight, and clocks that agree",
                "Provide the log of this flight, or enter the clock offset in config/clocks.tsv.",
            )
        files = Path("raw") / self._flight / self.name
        order = self._campaign.settings.iq_of(self.name)
        captured = Captured.of(raw, self._recording.samples.path, files, str(files), self._sent, order=order)
        every = frame_numbers(nanoseconds(self.time), self.frame, interval_s=1 / self._sent.waveform.prf_hz)
        captured = replace(captured, frames=replace(every, numbers=every.numbers[captures]))
        settings = self._campaign.node(self._flight, self.name)
        wave_m = shortest_wave(self._sent.numerology.frequency_hz)
        return Acquisition(self.name, settings, self.track.isel(epoch=near), log, wave_m, **vars(captured))


def _ends(path: Path, size: int) -> tuple[int, bytes, bytes]:
    """Return `size`, and the first and last bytes of the leading `size` bytes of a file."""
    with path.open("rb") as stream:
        head = stream.read(min(size, _KNOWN_BYTES))
        stream.seek(max(0, size - _KNOWN_BYTES))
        return size, head, stream.read(min(size, _KNOWN_BYTES))
