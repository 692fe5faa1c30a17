"""A campaign from Python: its flights, pairs and results, by name."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from apertura.campaign.folder import Campaign
from apertura.campaign.store import open_stage
from apertura.common.contracts import STAGES
from apertura.common.errors import CampaignError, quoted
from apertura.stages.agreement import report_of
from apertura.stages.scene import OpenScene, open_scene
from apertura.stages.transfer import PairEcho

if TYPE_CHECKING:
    import xarray as xr


_OF_NODES = {"raw", "track"}
_OF_FLIGHTS = {"refined_track"}
_OF_THE_CAMPAIGN = {"cube", "terrain"}
"""Stages of a node in a flight, of a flight, and of the whole campaign; the others are of a pair in a flight."""


@dataclass(frozen=True)
class OpenCampaign:
    """A validated campaign folder with its results; everything is read on first use.

    Attributes
    ----------
    campaign
        Settings, flights and where everything lies.
    """

    campaign: Campaign

    def __repr__(self) -> str:
        """Return the folder, and the pairs of each flight."""
        pairs = "; ".join(f"{flight}: {', '.join(names)}" for flight, names in self.pairs.items())
        return (
            f"<OpenCampaign {self.campaign.settings.campaign} in {self.campaign.root}: {pairs or 'no image flights'}>"
        )

    @property
    def pairs(self) -> dict[str, tuple[str, ...]]:
        """Flight that becomes images → its pairs, transmitter-receiver."""
        return {flight.name: flight.pairs for flight in self.campaign.image_flights}

    @property
    def scene(self) -> OpenScene:
        """The grid of every raster and the ground under it."""
        return open_scene(self.campaign)

    def stage(self, name: str, *where: str) -> "xr.Dataset":
        """Return a finished stage, read lazily; `transfer` of an echo is formed from the recording where it is read.

        Parameters
        ----------
        name
            A key of `apertura.common.contracts.STAGES`, such as 'echo'.
        *where
            Flight and node (raw, track), flight and pair (echo, profile, image), flight (refined_track), nothing
            (cube, terrain).

        Raises
        ------
        CampaignError
            If there is no such stage, flight, node or pair, or it is not there as the workflow left it.
        """
        _check_name(name, "stage", STAGES, where="campaign.stage")
        if name in _OF_THE_CAMPAIGN:
            _check_count(where, 0, name, "the stage alone: it is of the whole campaign")
        elif name in _OF_FLIGHTS:
            _check_count(where, 1, name, "a flight")
            self.campaign.flight(where[0])
        else:
            kind = "node" if name in _OF_NODES else "pair"
            _check_count(where, 2, name, f"a flight and a {kind}")
            flight = self.campaign.flight(where[0])
            known = flight.nodes if kind == "node" else flight.pairs
            _check_name(where[1], kind, known, where=f"campaign.stage({name!r}, {flight.name!r})")
        if name == "echo":
            return PairEcho.cleaned(self.campaign, where[0], where[1]).stage
        return open_stage(self.campaign.stage(name, *where), name)

    def image(self, flight: str, pair: str) -> "xr.DataArray":
        """Return a pair's focused image, (y, x) complex64, with its CRS in the coordinate spatial_ref."""
        image: xr.DataArray = self.stage("image", flight, pair).image
        return image

    def report(self, flight: str, pair: str) -> dict[str, Any]:
        """Return image.json of a pair or of 'fused': engine, models and reasons, errors, measures, flags."""
        _check_name(pair, "pair", self.campaign.flight(flight).images, where=f"campaign.report({flight!r})")
        return report_of(self.campaign, flight, pair)

    def flags(self, flight: str, pair: str) -> dict[str, str]:
        """Return the limits that an image exceeds: name → what was measured, in one line."""
        flags: dict[str, str] = self.report(flight, pair)["flags"]
        return flags


def _check_name(name: str, kind: str, known: Iterable[str], *, where: object) -> None:
    if name not in known:
        raise CampaignError(
            f"no {kind} {name!r}", where=where, expected=f"one of {', '.join(known)}", remedy=f"Correct the {kind}."
        )


def _check_count(given: tuple[str, ...], count: int, stage: str, expected: str) -> None:
    if len(given) != count:
        raise CampaignError(
            f"given {', '.join(given) or 'nothing more'}",
            where=f"campaign.stage({stage!r})",
            expected=expected,
            remedy="Name these after the stage.",
        )


def open_campaign(path: str | Path) -> OpenCampaign:
    """Return a campaign folder with its results.

    Parameters
    ----------
    path
        A campaign folder; its config is read and validated.

    Raises
    ------
    CampaignError
        If that is no path, or the config is wrong.

    Examples
    --------
    >>> open_campaign("nowhere")
    Traceback (most recent call last):
    ...
    apertura.common.errors.CampaignError: nowhere/config/config.yaml: no such file; ...
    """
    if not isinstance(path, str | Path):
        expected = "the path of a campaign folder, which holds config/config.yaml"
        raise CampaignError(quoted(path), "open_campaign: path", expected, "Give it as text or a pathlib.Path.")
    return OpenCampaign(Campaign.load(path))
