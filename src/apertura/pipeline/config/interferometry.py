"""Section `interferometry`: which images are compared in phase, two by two, for coherence and heights."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from pydantic import Field, field_validator

from apertura.common.errors import CampaignError, quoted
from apertura.pipeline.config.section import Name, Section

LEAST_WINDOW_PX = 3
"""Any two pixels are coherent: a window must hold several."""

_IMAGE = r"([A-Za-z0-9_.]+)/([A-Za-z0-9_.]+-[A-Za-z0-9_.]+)"


class Interferometry(Section):
    """Phase between two images of one scene."""

    pairs: Mapping[Name, tuple[str, str]] = Field(
        default_factory=dict,
        description="name → two images, [flight/transmitter-receiver, flight/transmitter-receiver], such as "
        "two_tracks: [f01/uav1-uav1, f02/uav1-uav1]; none by default",
    )
    window_px: int = Field(
        15, ge=LEAST_WINDOW_PX, le=255, description="side of the square that coherence and phase are means of, odd"
    )

    @field_validator("pairs")
    @classmethod
    def _two_images(cls, pairs: Mapping[str, tuple[str, str]]) -> Mapping[str, tuple[str, str]]:
        for name, images in pairs.items():
            for image in images:
                if not re.fullmatch(_IMAGE, image):
                    raise ValueError(f"{name}: {quoted(image)} is not flight/transmitter-receiver")
            if images[0] == images[1]:
                raise ValueError(f"{name}: {images[0]} is named twice: an image has no phase against itself")
        return pairs

    @field_validator("window_px")
    @classmethod
    def _has_a_middle(cls, side: int) -> int:
        if side % 2 == 0:
            raise ValueError("must be odd, so that a pixel is in its middle")
        return side

    def images(self, name: str) -> tuple[tuple[str, str], tuple[str, str]]:
        """Return flight and pair of the two images of an interferogram.

        Examples
        --------
        >>> Interferometry(pairs={"two": ("f01/a-a", "f02/a-b")}).images("two")
        (('f01', 'a-a'), ('f02', 'a-b'))
        """
        first, second = ((flight, pair) for flight, _, pair in (one.partition("/") for one in self.pairs[name]))
        return first, second


def check_interferometry(asked: Interferometry, known: Sequence[str], *, where: Path) -> None:
    """Raise CampaignError unless every image named is one of the campaign's.

    Parameters
    ----------
    asked
        The section.
    known
        Images of the campaign, flight/pair.
    where
        The config.
    """
    for name, images in asked.pairs.items():
        for image in images:
            if image not in known:
                raise CampaignError(
                    f"no image {quoted(image)}",
                    where=f"{where}: interferometry.pairs.{name}",
                    expected=f"two of {', '.join(known) or 'no image at all'}",
                    remedy="Correct the flight or the pair, or add them to flights.tsv.",
                )
