"""docs/api.md: where mkdocstrings puts what the public names say of themselves."""

import apertura

_HEAD = """# Python

Every public name, with shape, unit and frame of what it takes and gives. The examples run as tests. Written by
`make pages`.
"""

_GROUPS = {
    "Images": "An image from echoes, and its derivative.",
    "Geometry and ground": "Where antennas, pixels and the ground are.",
    "Campaigns": "Folders: made, written, opened.",
}
_OF = {
    "backproject": "Images",
    "judge": "Images",
    "gradient": "Images",
    "range_compress": "Images",
    "PhaseHistory": "Images",
    "Profiles": "Images",
    "simulate": "Campaigns",
    "open_campaign": "Campaigns",
    "write_campaign": "Campaigns",
    "RecordedFlight": "Campaigns",
    "RecordedNode": "Campaigns",
}
_GIVEN = {"open_campaign": "apertura.tools.open_campaign.OpenCampaign"}
"""Public function → what it returns, which is made by nobody else."""

_OTHERS = "Geometry and ground"


def api_page() -> str:
    """Return docs/api.md."""
    parts = [_HEAD]
    for group, what in _GROUPS.items():
        parts.append(f"\n## {group}\n\n{what}\n")
        names = dict.fromkeys(name for name in (*_OF, *apertura.__all__) if _OF.get(name, _OTHERS) == group)
        parts += [f"\n::: {_place(name)}\n" for name in names]
        parts += [f"\n::: {_GIVEN[name]}\n" for name in names if name in _GIVEN]
    return "".join(parts)


def _place(name: str) -> str:
    """Return where a public name is defined."""
    value = getattr(apertura, name)
    return f"{value.__module__}.{value.__qualname__}"
