"""`apertura init CAMPAIGN FILES`: a campaign folder from recordings and flight logs.

Formats are recognised as by `apertura inspect`; recordings and logs are assigned by times and names; the waveform
follows from headers, from the transmitted signal and from the samples (docs/theory/recordings.md, eqs. 3 to 9). Values
that no file contains are requested, or written to the config as commented keys.
"""

import fcntl
import os
import re
import shlex
import shutil
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from apertura.campaign.config import CLOCK_COLUMNS, CLOCKS, CONFIG, validated
from apertura.campaign.config.template import commented_yaml
from apertura.check import print_findings
from apertura.common.errors import CampaignError, number_of, quoted, shown
from apertura.common.provenance import hashes_of_file
from apertura.formats.campaign_files import new_folder, write_flights, write_meta
from apertura.formats.names import PHASE_HISTORIES, TRACKS
from apertura.tools.init.assignment import assign as assign_files
from apertura.tools.init.contents import describe_nodes, describe_scene, describe_waveform
from apertura.tools.init.draft import SIDE, Ask, Draft, Question
from apertura.tools.init.files import TYPES, Found, FoundRecording, recognised

Rows = list[tuple[str, str, str, list[str]]]
"""Lines of flights.tsv: flight, kind, transmitter, nodes."""

Place = Callable[[Path, Path], None]


@dataclass(frozen=True)
class CreatedCampaign:
    """Campaign folder created from files.

    Attributes
    ----------
    folder
        Campaign folder.
    lines
        Assignment of each file, and files that are not used.
    questions
        Questions to the user.
    open_keys
        Keys of the config that are left open.
    unaligned
        Flight and node of recordings without UTC.
    """

    folder: Path
    lines: tuple[str, ...]
    questions: tuple[Question, ...]
    open_keys: tuple[str, ...]
    unaligned: tuple[tuple[str, str], ...]


def campaign_from_files(
    directory: str | Path,
    files: Sequence[str | Path],
    *,
    settings: Mapping[str, str] | None = None,
    assign: Mapping[str | Path, str] | None = None,
    transmitter: str | None = None,
    side: str | None = None,
    kind: str | None = None,
    copy: bool = False,
    ask: Ask | None = None,
) -> CreatedCampaign:
    """Create a campaign folder from recordings, flight logs, and the file of the transmitted signal.

    Parameters
    ----------
    directory
        Folder to create.
    files
        Files, and folders whose files are used.
    settings
        Key of the config, such as scene.height_m → value as text.
    assign
        File → node or flight/node, where names and times are ambiguous.
    transmitter
        Node that transmits, if several nodes may transmit.
    side
        Side of a straight track on which the scene lies, in flight direction: left, right or both.
    kind
        Kind of waveform of recordings without a file of the transmitted signal: ofdm or samples.
    copy
        Copy all files. Otherwise files on the same file system are cloned or hard-linked, which takes no space.
    ask
        Function that asks the user; None: values that no file contains are left open.

    Raises
    ------
    CampaignError
        If the folder exists, a file cannot be read, files cannot be assigned, or a value is not valid. Nothing is
        written in these cases.

    Examples
    --------
    >>> campaign_from_files("new", ["nowhere.iq"])
    Traceback (most recent call last):
    ...
    apertura.common.errors.CampaignError: nowhere.iq: no such file or folder; expected recordings and flight logs. ...
    """
    directory, draft, paths = Path(directory), Draft(settings or {}, ask), [Path(path) for path in files]
    if side is not None:
        draft.value(SIDE, side)
    if kind not in {None, "ofdm", "samples"}:
        remedy = "Omit --kind: the files of other radars determine it."
        raise CampaignError(f"kind {quoted(kind)}", "init", "ofdm or samples, for recorded samples", remedy)
    with new_folder(directory) as root:
        found = recognised(paths)
        if not found.recordings:
            names = ", ".join(shown(path.name) for path in paths)
            problem = CampaignError(f"no recording in {names}", directory, "at least one recording", "Name its files.")
            raise problem
        assign_files(found, {Path(path): target for path, target in (assign or {}).items()}, draft)
        found.recordings.sort(key=lambda recording: recording.flight)
        draft.set("campaign", re.sub(r"[^\w .-]", "_", directory.absolute().name), "name of the folder")
        placed = describe_waveform(draft, found, kind)
        flights = _flights(draft, found, transmitter)
        describe_nodes(draft, found)
        placed |= describe_scene(draft, found, side)
        document = draft.document()
        if draft.is_complete():
            validated(document, where=CONFIG)
        (root / CONFIG).write_text(commented_yaml(document, draft.comments, draft.open), encoding="utf-8")
        write_flights(root, flights)
        zones = [
            f"{one.flight}\t{one.node}\t{one.zone_s:.0f}\t\t" for one in found.recordings if one.zone_s is not None
        ]
        if zones:
            (root / CLOCKS).write_text("\n".join(["\t".join(CLOCK_COLUMNS), *zones, ""]), encoding="utf-8")
        _write_raw(root, found, placed, draft, partial(_place, copy=copy))
    unaligned = [(one.flight, one.node) for one in found.recordings if one.span is None and not one.has_positions]
    return CreatedCampaign(
        directory, tuple(_lines(found, flights)), tuple(draft.questions), tuple(draft.open), tuple(unaligned)
    )


def _flights(draft: Draft, found: Found, transmitter: str | None) -> Rows:
    """Return the lines of flights.tsv; the transmitter is the given node, the node without sidelink, or answered."""
    rows: Rows = []
    for flight in dict.fromkeys(recording.flight for recording in found.recordings):
        own = [recording for recording in found.recordings if recording.flight == flight]
        nodes = [recording.node for recording in own]
        single = [one.node for one in own if one.channels == 1 and one.kind in {"sigmf", "samples"}]
        sender = transmitter if transmitter in nodes else nodes[0] if len(nodes) == 1 else None
        sender = sender or (single[0] if len(single) == 1 else None)
        if sender is None:
            question = Question(("transmitter",), f"node that transmits in {flight}: {', '.join(nodes)}", nodes[0])
            answer = draft.answer(question, nodes)
            if answer is None:
                problem, remedy = f"nodes {', '.join(nodes)} in {flight}", f"Add --transmitter {nodes[0]}, or another."
                raise CampaignError(problem, own[0].path, "a known transmitter", remedy)
            sender = answer[0]
        rows.append((flight, "image", sender, [sender, *(node for node in nodes if node != sender)]))
    return rows


def _lines(found: Found, flights: Rows) -> Iterator[str]:
    senders = {flight: sender for flight, _, sender, _ in flights}
    for one in found.recordings:
        role = "transmits" if senders[one.flight] == one.node else "receives"
        log = "positions in the file" if one.has_positions else f"log {one.log.path.name}" if one.log else "no log"
        count = "" if one.times is None else f", {number_of(len(one.times), 'capture')}"
        yield f"{one.flight} {one.node} ({role}): {one.path.name}, {one.format}{count}; {log}"
        if one.zone_s is not None:
            yield f"note: recorder of {one.node} in {one.flight}: time zone {one.zone_s / 3600:+g} h, in {CLOCKS}"
    used = {id(one.log) for one in found.recordings}
    idle = {log.path: "log of no recording" for log in found.logs if id(log) not in used}
    for path, reason in (idle | found.unused).items():
        yield f"not used: {path.name}: {reason}"


# ---- Files of raw/ ---------------------------------------------------------------------------------------------------


def _write_raw(root: Path, found: Found, placed: Mapping[str, Path], draft: Draft, place: Place) -> None:
    for one in found.recordings:
        framing = one.content.framing if one.kind == "sigmf" else None
        name = Path(str(framing["preamble"])) if framing else None
        preamble = next((path for path in found.arrays if name and path.name == name.name), None)
        if name and preamble and not name.is_absolute() and ".." not in name.parts:
            placed = {**placed, name.as_posix(): preamble}
    for target, source in placed.items():
        place(source, root / target)
    for one in found.recordings:
        stem = root / "raw" / one.flight / one.node
        _write_recording(one, stem, draft, place)
        if one.log is not None:
            place(one.log.path, stem.with_name(f"{stem.name}.track{TRACKS[one.log.format].suffixes[0]}"))


def _write_recording(one: FoundRecording, stem: Path, draft: Draft, place: Place) -> None:
    if one.kind == "sigmf":
        for source, suffix in zip((one.files[0], one.files[-1]), (".sigmf-meta", ".sigmf-data"), strict=True):
            place(source, stem.with_name(f"{stem.name}{suffix}"))
    elif one.kind == "samples" and one.times is not None:
        data = stem.with_name(f"{stem.name}.sigmf-data")
        place(one.path, data)
        dtype = np.dtype(TYPES.get(one.path.suffix, "int16")) if one.content is None else one.content.dtype
        header_bytes = 0 if one.content is None else one.path.stat().st_size - one.content.nbytes
        length = (one.path.stat().st_size - header_bytes) // (2 * dtype.itemsize * one.channels * len(one.times))
        frames = [None] * len(one.times) if one.frames is None else one.frames.tolist()
        write_meta(
            stem,
            zip((np.arange(len(one.times)) * length).tolist(), one.times, frames, strict=True),
            channels=("radar", "sidelink")[: one.channels],
            dtype=dtype.name,
            sha512=hashes_of_file(data, ["sha512"])["sha512"],
            sample_rate_hz=float(draft.values["waveform.sample_rate_hz"]),
            frequency_hz=draft.values.get("waveform.carrier_hz"),
            extra={},
            header_bytes=header_bytes,
        )
    else:
        suffix = PHASE_HISTORIES[one.format].suffix
        for source in one.files:
            part = "." + re.sub(r"\W", "_", source.name.removesuffix(suffix), flags=re.ASCII)
            place(source, stem.with_name(f"{stem.name}{part if len(one.files) > 1 else ''}{suffix}"))
        if one.format == "beat_npy" and one.times is not None:
            np.save(stem.with_name(f"{stem.name}.time.npy"), one.times)


_FICLONE = 0x40049409  # of ioctl(2): a copy that shares its blocks with the original


def _place(source: Path, target: Path, *, copy: bool) -> None:
    """Put a file or folder into the campaign as a clone, a hard link or a copy; links would be refused there."""
    target.parent.mkdir(parents=True, exist_ok=True)
    if source.is_dir():
        for file in sorted(path for path in source.rglob("*") if path.is_file()):
            _place(file, target / file.relative_to(source), copy=copy)
        return
    if not copy:
        with suppress(OSError), source.open("rb") as original, target.open("xb") as clone:
            fcntl.ioctl(clone, _FICLONE, original.fileno())
            return
        target.unlink(missing_ok=True)
        with suppress(OSError):
            os.link(source.resolve(), target)
            return
    shutil.copyfile(source, target)


# ---- Command ---------------------------------------------------------------------------------------------------------


def print_created(folder: Path, files: Sequence[Path], name: Path, **options: Any) -> int:
    """Create a campaign by `campaign_from_files`, print the assignment and the check; return 2 for problems, else 0.

    Questions are requested if the input is a terminal.

    Parameters
    ----------
    folder, files, options
        Arguments of `campaign_from_files`.
    name
        Name of the folder to print.
    """
    made = campaign_from_files(folder, files, **options, ask=_ask_on_terminal if sys.stdin.isatty() else None)
    typed = shlex.quote(str(name))
    print(*(shown(line, 300) for line in made.lines), sep="\n")
    print(f"created {shown(name, 300)}, after {number_of(len(made.questions), 'question')}")
    if made.open_keys:
        print(f"open keys in {typed}/{CONFIG}, each with its reason: {', '.join(made.open_keys)}")
    count = print_findings(folder)
    for flight, node in made.unaligned:
        print(f"The recorder of {node} has no UTC. First: apertura align {typed} {flight} {node} --write")
    return 2 if count else 0


def _ask_on_terminal(question: Question, problem: str) -> str:
    lines = [problem] if problem else []
    lines += [f"{', '.join(question.keys)}: {shown(question.text, 400)}"]
    lines += [f"for example {question.example}; empty: leave open"] if question.example else ["empty: leave open"]
    print(*lines, sep="\n")
    try:
        return input("> ")
    except EOFError:
        return ""
