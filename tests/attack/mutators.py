"""Mutators of valid files: changes of bytes as in the fuzzer AFL, and changes of parts of known formats."""

import csv
import functools
import io
import json
import operator
import struct
from collections.abc import Callable, Sequence

import numpy as np
import yaml

Mutator = Callable[[bytes, np.random.Generator, Sequence[bytes]], bytes]

NUMBERS = ["nan", "inf", "-inf", "1e308", "-1e308", "1e-320", "-1", "0", "-0", "2147483648", "9223372036854775808"]
NUMBERS += ["-9223372036854775809", "1_0", "0x10", "1e5"]
WORDS = [
    b"\x1b[2J\x1b[31m",
    b"../../etc/passwd",
    b"/dev/zero",
    b"\x00",
    b"\xff\xfe",
    b"\xef\xbb\xbf",
    b"\r\n",
    b"'",
    b'"',
]
WORDS += [b"\xe2\x80\xae", b"A" * 3000, b"[" * 500, b"{" * 200, b"%s%n", *(number.encode() for number in NUMBERS)]
EDGES = [0, 1, -1, 127, -128, 255, 32767, -32768, 65535, 2**31 - 1, -(2**31), 2**32 - 1, 10**9, 2**63 - 1, -(2**63)]
LEAVES = [None, True, False, 0, -1, 1, 2**31, 2**63, 2**64, -(2**70), 1e308, -1e308, 1e-320, float("inf"), float("nan")]
LEAVES += [
    "",
    "text",
    "\x1b[2J",
    "../../x",
    "/etc/passwd",
    "a" * 3000,
    "nan",
    "99999-01-01T00:00:00Z",
    "auto",
    "EPSG:0",
]
LEAVES += [[], {}, [[]], [1, 2, 3], {"a": 1}, [None] * 300, {"": {"": {}}}, "0001-01-01T00:00:00Z", "nowZ", "NaT", "١٢"]


def _offset(data: bytes, generator: np.random.Generator) -> int:
    """Return a random offset, with probability 1/2 among the first bytes, which are the header of binary formats."""
    size = len(data)
    return int(generator.integers(0, min(size, 256) if generator.random() < 0.5 else size)) if size else 0


def flip(data: bytes, generator: np.random.Generator, tokens: Sequence[bytes]) -> bytes:
    """Flip a few bits."""
    changed = bytearray(data)
    for _ in range(int(generator.integers(1, 5)) if data else 0):
        changed[_offset(data, generator)] ^= 1 << int(generator.integers(8))
    return bytes(changed)


def edge(data: bytes, generator: np.random.Generator, tokens: Sequence[bytes]) -> bytes:
    """Overwrite bytes with an extreme value of a number type, in either byte order."""
    order = "<>"[int(generator.integers(2))]
    kind = "bhiqfd"[int(generator.integers(6))]
    if kind in "fd":
        value = [np.nan, np.inf, -np.inf, 1e30, -1e30, 1e-30, 0.0, -1.0][int(generator.integers(8))]
        number = struct.pack(order + kind, value)
    else:
        number = struct.pack(">q", EDGES[int(generator.integers(len(EDGES)))])[-struct.calcsize("=" + kind) :]
        number = number if order == ">" else number[::-1]
    place = _offset(data, generator)
    return data[:place] + number + data[place + len(number) :]


def cut(data: bytes, generator: np.random.Generator, tokens: Sequence[bytes]) -> bytes:
    """Truncate the data."""
    return data[: int(generator.integers(0, len(data) + 1))]


def block(data: bytes, generator: np.random.Generator, tokens: Sequence[bytes]) -> bytes:
    """Delete, duplicate or move a block."""
    first, last = sorted(int(place) for place in generator.integers(0, len(data) + 1, 2))
    last = min(last, first + int(generator.integers(1, 200)))
    at = int(generator.integers(0, len(data) + 1))
    piece, action = data[first:last], int(generator.integers(3))
    if action == 0:
        return data[:first] + data[last:]
    rest = data if action == 1 else data[:first] + data[last:]
    return rest[:at] + piece * int(generator.integers(1, 4)) + rest[at:]


def token(data: bytes, generator: np.random.Generator, tokens: Sequence[bytes]) -> bytes:
    """Insert a token, or overwrite bytes with it."""
    known = [*tokens, *WORDS]
    word, place = known[int(generator.integers(len(known)))], int(generator.integers(0, len(data) + 1))
    return data[:place] + word + data[place + (len(word) if generator.random() < 0.5 else 0) :]


def noise(data: bytes, generator: np.random.Generator, tokens: Sequence[bytes]) -> bytes:
    """Overwrite some bytes with random bytes."""
    size = int(generator.integers(1, 40))
    place = _offset(data, generator)
    return data[:place] + generator.bytes(size) + data[place + size :]


def digit(data: bytes, generator: np.random.Generator, tokens: Sequence[bytes]) -> bytes:
    """Replace a digit, or a letter if there is no digit."""
    places = [place for place, byte in enumerate(data[:100_000]) if 48 <= byte <= 57] or [_offset(data, generator)]
    place = places[int(generator.integers(len(places)))]
    return data[:place] + b"%d" % generator.integers(10) + data[place + 1 :]


BYTES: tuple[Mutator, ...] = (flip, edge, cut, block, token, noise, digit)


def _tree(document: object, generator: np.random.Generator) -> object:
    """Replace, delete, duplicate or rename a random part of a document."""
    ways = list(_ways(document, ()))
    way = ways[int(generator.integers(len(ways)))]
    leaf = LEAVES[int(generator.integers(len(LEAVES)))]
    if not way:
        return leaf
    parent = document
    for step in way[:-1]:
        parent = parent[step]  # type: ignore[index]
    action = int(generator.integers(6))
    if action == 0:
        del parent[way[-1]]  # type: ignore[attr-defined]
    elif action == 1 and isinstance(parent, list):
        parent += parent[: int(generator.integers(1, 50))]
    elif action == 1 and isinstance(parent, dict):
        parent["x" + str(way[-1])] = parent[way[-1]]
    elif action == 2:
        other = ways[int(generator.integers(len(ways)))]
        source = document
        for step in other:
            source = source[step]  # type: ignore[index]
        parent[way[-1]] = json.loads(json.dumps(source, default=str))  # type: ignore[index]
    elif action == 3 and isinstance(parent[way[-1]], int | float):  # type: ignore[index]
        scale = [-1, 1e-9, 1e9, 1.0000001, 0.5, 1e300][int(generator.integers(6))]
        parent[way[-1]] = parent[way[-1]] * scale  # type: ignore[index]
    else:
        parent[way[-1]] = leaf  # type: ignore[index]
    return document


def _ways(document: object, way: tuple[object, ...]):
    yield way
    items = (
        document.items() if isinstance(document, dict) else enumerate(document) if isinstance(document, list) else ()
    )
    for key, part in items:
        yield from _ways(part, (*way, key))


def json_tree(data: bytes, generator: np.random.Generator, tokens: Sequence[bytes]) -> bytes:
    """Change a part of a JSON document, or bytes if the data are not valid JSON."""
    try:
        text = json.dumps(_tree(json.loads(data), generator))
    except (ValueError, RecursionError, TypeError, OverflowError):
        return flip(data, generator, tokens)
    return text.encode("utf-8", "surrogatepass")


def yaml_tree(data: bytes, generator: np.random.Generator, tokens: Sequence[bytes]) -> bytes:
    """Change a part of a YAML document or repeat it by an alias; change bytes if the data are not valid YAML."""
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    if b"&b" in data or data.count(b"[") > 200 or len(data) > 100_000:  # parsing would expand the aliases
        return token(data, generator, tokens)
    try:
        document = yaml.load(data, Loader=loader)
        return yaml.safe_dump(_tree(document, generator), allow_unicode=True).encode("utf-8", "surrogatepass")
    except Exception:
        return flip(data, generator, tokens)


def bomb(data: bytes, generator: np.random.Generator, tokens: Sequence[bytes]) -> bytes:
    """Append aliases of aliases."""
    levels, width = int(generator.integers(1, 12)), int(generator.integers(2, 12))
    lines = ["b0: &b0 [x, y]", *(f"b{n + 1}: &b{n + 1} [{', '.join([f'*b{n}'] * width)}]" for n in range(levels))]
    return data + "\n".join(["", *lines, ""]).encode()


def cells(delimiter: str) -> Mutator:
    """Return a mutator of tables with a delimiter; a space means columns separated by white space."""

    def mutate(data: bytes, generator: np.random.Generator, tokens: Sequence[bytes]) -> bytes:
        lines = data.decode("utf-8", "surrogateescape").split("\n")
        rows = [line.split() if delimiter == " " else line.split(delimiter) for line in lines]
        row = int(generator.integers(len(rows)))
        column = int(generator.integers(len(rows[row]))) if rows[row] else 0
        action = int(generator.integers(7))
        known = [
            *NUMBERS,
            "",
            "NaT",
            "99999-01-01T00:00:00",
            "2025-02-30",
            "\x1b[2J",
            '"',
            "now",
            "a" * 200_000,
            "\x00",
        ]
        if action == 0:
            del rows[row]
        elif action == 1:
            rows.insert(int(generator.integers(len(rows))), rows[row])
        elif action == 2 and len(rows[row]) > 1:
            other = int(generator.integers(len(rows[row])))
            for line in rows:
                if max(column, other) < len(line):
                    line[column], line[other] = line[other], line[column]
        elif action == 3:
            rows[row] = [*rows[row], known[int(generator.integers(len(known)))]]
        elif action == 4:
            rows[row] = rows[row][:column]
        elif rows[row]:
            rows[row][column] = known[int(generator.integers(len(known)))]
        ending = "\r\n" if generator.random() < 0.1 else "\n"
        return ending.join(delimiter.join(line) for line in rows).encode("utf-8", "surrogateescape")

    return mutate


def resealed(data: bytes, generator: np.random.Generator, tokens: Sequence[bytes]) -> bytes:
    """Change cells of sentences and update their checksums, so that the reader parses the changed cells."""
    lines = cells(",")(data, generator, tokens).split(b"\n")
    for number, line in enumerate(lines):
        stamp, dollar, rest = line.partition(b"$")
        body, star, _ = rest.partition(b"*")
        if dollar and star:
            lines[number] = b"%s$%s*%02X\r" % (stamp, body, functools.reduce(operator.xor, body, 0))
    return b"\n".join(lines)


def quoted_cells(data: bytes, generator: np.random.Generator, tokens: Sequence[bytes]) -> bytes:
    """Rewrite a table with each cell in quotation marks."""
    text = data.decode("utf-8", "replace").replace("\x00", "")
    target = io.StringIO()
    try:
        csv.writer(target, quoting=csv.QUOTE_ALL).writerows(csv.reader(io.StringIO(text)))
    except csv.Error:
        return data
    return target.getvalue().encode("utf-8", "replace")


def mutated(
    seeds: Sequence[bytes], generator: np.random.Generator, *, tokens: Sequence[bytes], structure: Sequence[Mutator]
) -> bytes:
    """Return one of the seeds after one to four changes, mostly one; half of all changes are format-specific."""
    data = seeds[int(generator.integers(len(seeds)))]
    for _ in range(min(4, int(generator.geometric(0.7)))):
        known = structure and generator.random() < 0.5
        choice: Sequence[Mutator] = structure if known else BYTES
        data = choice[int(generator.integers(len(choice)))](data, generator, tokens)[:4_000_000]
    return data
