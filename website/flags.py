"""docs/flags.md, from the table of flags."""

import re

from apertura.common.flag_table import FLAGS

_HEAD = """# Flags

A flag says that a limit of a method was crossed, and what was measured; it stops no run. It stands in `image.json`,
`image.attrs["flags"]`, the tag `APERTURA_FLAGS`, below quicklooks and in `apertura summary`. Here: *what was measured*;
what it means → what to look at first. All limits on one page: [limitations](limitations.md). Written by `make pages`.

"""

_PAGE = re.compile(r"\bdocs/([\w/]*?(\w+)\.md)")
_NAME = re.compile(r"(?<![\w/(.-])((?:[\w]+[./])+[\w<>]+(?:\.[\w<>]+)*|\w+_\w+|--[\w-]+)(?![\w/)])")


def flags_page() -> str:
    """Return docs/flags.md."""
    return _HEAD + "".join(
        f"- **`{name}`** *{_marked(flag.measured)}*; {_marked(flag.means)} → {_marked(flag.look)}\n"
        for name, flag in FLAGS.items()
    )


def _marked(text: str) -> str:
    """Return a text with its names as code and its pages as links."""
    pages = [_NAME.sub(r"`\1`", part) for part in re.split(r"docs/[\w/]+\.md", text)]
    links = [f"[{found[2].replace('_', ' ')}]({found[1]})" for found in _PAGE.finditer(text)]
    return pages[0] + "".join(link + part for link, part in zip(links, pages[1:], strict=True))
