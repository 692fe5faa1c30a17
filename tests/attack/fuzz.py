"""Fuzzing of all parsers: every malformed file is refused with one message or read without harm.

``python -m tests.attack.fuzz --inputs 5000``, or ``--seconds 600`` per parser, prints a table and saves harmful inputs.
Files are read in a child process with bounded memory and time, so that a crash, a hang or excessive use of memory is
detected and reported.
"""

import argparse
import json
import os
import resource
import signal
import sys
import time
import traceback
import zlib
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from apertura.common.errors import CampaignError

from .difference import kinds, leaves
from .mutators import mutated
from .parsers import PARSERS, Parser

SECONDS = 5.0
"""Time limit per file, in seconds."""

MEMORY_BYTES = 2 << 30
"""Memory limit for reading a file, in addition to the memory of the libraries, bytes."""

LONGEST_MESSAGE = 3000

_AT_ONCE = 500  # inputs between two checks of the time

REGRESSIONS = Path(__file__).parent / "regressions"
"""Inputs that were harmful in the past: <parser>/<name>."""

HARM = ("traceback", "hang", "crash", "memory", "message")
"""Kinds of harm; `message`: the message is too long or contains control characters."""


@dataclass
class Tally:
    """Outcomes of the inputs of one parser."""

    parser: str
    results: Counter[str] = field(default_factory=Counter)
    different: Counter[str] = field(default_factory=Counter)
    examples: dict[str, int] = field(default_factory=dict)
    harmful: list[tuple[int, str, str]] = field(default_factory=list)
    peak_mb: float = 0.0
    seconds: float = 0.0

    @property
    def harm(self) -> int:
        """Number of harmful inputs."""
        return sum(self.results[kind] for kind in HARM)


def inputs_of(name: str, seed: int) -> "Inputs":
    """Return the unlimited inputs of a parser, each generated from the seed and its number."""
    row = zlib.crc32(name.encode())  # from the name, so that a new parser does not change the inputs of others
    return Inputs(PARSERS[name], PARSERS[name].seeds(), seed, row)


@dataclass(frozen=True)
class Inputs:
    """Inputs of a parser by number."""

    parser: Parser
    seeds: Sequence[bytes]
    seed: int
    row: int

    def __getitem__(self, number: int) -> bytes:
        generator = np.random.default_rng([self.seed, self.row, number])
        return mutated(self.seeds, generator, tokens=self.parser.words, structure=self.parser.structure)


def fuzz(name: str, count: int, *, seed: int = 1) -> Tally:
    """Read `count` malformed files with a parser and return the outcomes."""
    source = inputs_of(name, seed)
    return read_all(name, count, source.__getitem__, seeds=source.seeds)


def fuzz_for(name: str, seconds: float, *, seed: int = 1) -> Tally:
    """Read malformed files with a parser for a time in seconds and return the outcomes."""
    source, total = inputs_of(name, seed), Tally(name)
    while total.seconds < seconds:
        first = sum(total.results.values())
        part = read_all(name, _AT_ONCE, lambda number, first=first: source[first + number], seeds=source.seeds)
        total.results += part.results
        total.different += part.different
        total.examples |= {kind: first + number for kind, number in part.examples.items()} | total.examples
        total.harmful += [(first + number, kind, text) for number, kind, text in part.harmful]
        total.peak_mb, total.seconds = max(total.peak_mb, part.peak_mb), total.seconds + part.seconds
    return total


def read_all(name: str, count: int, source, *, seeds: Sequence[bytes]) -> Tally:
    """Read inputs 0 to `count` in child processes; after a crash, the next process continues with the next input."""
    tally, done, start_s = Tally(name), 0, time.perf_counter()
    with TemporaryDirectory(prefix="fuzz-") as folder:
        while done < count:
            pending = done
            for line in _child(PARSERS[name], range(done, count), source, seeds, Path(folder)):
                _count(tally, json.loads(line), PARSERS[name])
                done += 1
            if done == pending:  # the valid files could not be read
                raise RuntimeError(f"{name}: the child process ended before its first input")
    tally.seconds = time.perf_counter() - start_s
    return tally


def _count(tally: Tally, result: dict, parser: Parser) -> None:
    kind = result["kind"]
    if parser.may_die and kind in {"crash", "hang", "memory"}:
        kind = "refused"
        tally.different["(refused: its reader died or was stopped)"] += 1
    tally.results[kind] += 1
    tally.peak_mb = max(tally.peak_mb, result["mb"])
    if kind in HARM:
        tally.harmful.append((result["number"], kind, result["text"]))
    for difference in result.get("differences", ()):
        tally.different[difference] += 1
        tally.examples.setdefault(difference, result["number"])


def _child(parser: Parser, numbers: range, source, seeds: Sequence[bytes], folder: Path) -> Iterator[str]:
    """Yield one line per input read in a child process, and one line for the input that ended the process."""
    receiver, sender = os.pipe()
    sys.stdout.flush()
    child = os.fork()
    if child == 0:
        os.close(receiver)
        status = 1
        try:
            _read_inputs(parser, numbers, source, seeds, folder, sender)
            status = 0
        except BaseException:
            traceback.print_exc()
        finally:
            os._exit(status)
    os.close(sender)
    read = 0
    with os.fdopen(receiver, encoding="utf-8") as lines:
        for line in lines:
            read += 1
            yield line
    _, status = os.waitpid(child, 0)
    if read < len(numbers) and read >= 0:
        if not os.WIFSIGNALED(status):
            raise RuntimeError(f"the child process ended with status {status} at input {numbers[read]}")
        name = signal.Signals(os.WTERMSIG(status)).name
        kind = "hang" if name == "SIGALRM" else "crash"
        yield json.dumps({"number": numbers[read], "kind": kind, "text": name, "mb": 0.0})


def _read_inputs(parser: Parser, numbers: range, source, seeds: Sequence[bytes], folder: Path, sender: int) -> None:
    path = folder / parser.file
    path.parent.mkdir(parents=True, exist_ok=True)
    valid = []
    for data in seeds:
        path.write_bytes(data)
        valid.append(dict(leaves(parser.read(path))))
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # messages of libraries
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY_BYTES, resource.RLIM_INFINITY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    floor_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for number in numbers:
        data = source(number)
        path.write_bytes(data)
        signal.setitimer(signal.ITIMER_REAL, SECONDS)
        result = _outcome(parser, path, valid)
        signal.setitimer(signal.ITIMER_REAL, 0)
        result["number"] = number
        result["mb"] = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - floor_kb) / 1024
        os.write(sender, (json.dumps(result) + "\n").encode())


def _outcome(parser: Parser, path: Path, valid: list[dict[str, object]]) -> dict:
    try:
        value = dict(leaves(parser.read(path)))
    except CampaignError as error:
        text = str(error)
        good = text.isprintable() and len(text) <= LONGEST_MESSAGE
        return {"kind": "refused" if good else "message", "text": text[:4000]}
    except MemoryError:
        return {"kind": "memory", "text": traceback.format_exc()[-2000:]}
    except Exception:
        return {"kind": "traceback", "text": traceback.format_exc()[-3000:]}
    found = min((kinds(one, value) for one in valid), key=len)
    return {"kind": "different" if found else "same", "text": "", "differences": sorted(found)}


def table(tallies: Sequence[Tally]) -> str:
    """Return the outcomes as a Markdown table, followed by the kinds of difference."""
    heads = ("parser", "inputs", "refused", "same", "different", *HARM, "peak MB", "s")
    rows = [heads, tuple("---" for _ in heads)]
    for tally in tallies:
        counts = (str(tally.results[kind]) for kind in ("refused", "same", "different", *HARM))
        total = str(sum(tally.results.values()))
        rows.append((tally.parser, total, *counts, f"{tally.peak_mb:.0f}", f"{tally.seconds:.0f}"))
    lines = ["| " + " | ".join(row) + " |" for row in rows]
    for tally in tallies:
        listed = "; ".join(f"{kind}: {count}" for kind, count in tally.different.most_common())
        lines += ["", f"{tally.parser}: {listed}"] if listed else []
    return "\n".join(lines)


def _arguments(words: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else None)
    parser.add_argument("--inputs", type=int, default=5000, help="inputs per parser")
    parser.add_argument("--seconds", type=float, help="time per parser instead of a number of inputs")
    parser.add_argument("--parser", action="append", choices=sorted(PARSERS), help="one parser, or several")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--save", type=Path, default=Path("build/fuzz"), help="folder for harmful inputs")
    return parser.parse_args(words)


def main(given: Sequence[str] | None = None) -> int:
    """Fuzz parsers and print a table; return 1 if an input was harmful."""
    arguments = _arguments(given)
    tallies = []
    for name in arguments.parser or PARSERS:
        timed = arguments.seconds is not None
        tally = (
            fuzz_for(name, arguments.seconds, seed=arguments.seed)
            if timed
            else fuzz(name, arguments.inputs, seed=arguments.seed)
        )
        tallies.append(tally)
        printed: set[str] = set()
        for number, kind, text in tally.harmful:
            last = text.strip().splitlines()[-1] if text.strip() else ""
            path = arguments.save / name / f"{arguments.seed}-{number}"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(inputs_of(name, arguments.seed)[number])
            if last[:60] not in printed:
                print(f"{name} input {number}: {kind}\n{text}", file=sys.stderr)
            printed.add(last[:60])
        print(f"{name}: {dict(tally.results)} in {tally.seconds:.0f} s", file=sys.stderr, flush=True)
    print(table(tallies))
    return int(any(tally.harm for tally in tallies))


if __name__ == "__main__":
    sys.exit(main())
