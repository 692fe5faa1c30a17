"""Access to a campaign from Python: flights, pairs and results by name."""

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
"""Stages of a node in a flight, of a flight, and of the campaign; all others are of a pair in a flight."""


_LISTED = 8
"""Maximum number of flights in the text of a campaign."""


@dataclass(frozen=True)
class OpenCampaign:
    """A validated campaign folder with its results, which are read on access.

    Attributes
    ----------
    campaign
        Settings, flights and paths of the campaign.
    """

    campaign: Campaign

    def __repr__(self) -> str:
        """Return the folder and the pairs of the first image flights, in at most ten lines.

        Examples
        --------
        >>> from apertura.simulation import preset, simulate
        >>> from tempfile import TemporaryDirectory
        >>> with TemporaryDirectory() as folder:
        ...     _ = simulate(f"{folder}/campaign", preset("demo", pulses=4), seed=1)
        ...     print(str(open_campaign(f"{folder}/campaign")).replace(folder, "folder"))
        <OpenCampaign tandem_demo in folder/campaign
          f01: uav1-uav1, uav1-uav2>
        """
        lines = [f"{flight}: {', '.join(names)}" for flight, names in self.pairs.items()] or ["no image flights"]
        if len(lines) > _LISTED:
            lines = [*lines[: _LISTED - 1], f"and {len(lines) - _LISTED + 1} more flights"]
        return "\n  ".join([f"<OpenCampaign {self.campaign.settings.campaign} in {self.campaign.root}", *lines]) + ">"

    @property
    def pairs(self) -> dict[str, tuple[str, ...]]:
        """Image flight → names of its pairs, transmitter-receiver."""
        return {flight.name: flight.pairs for flight in self.campaign.image_flights}

    @property
    def scene(self) -> OpenScene:
        """Common grid of all rasters, and terrain."""
        return open_scene(self.campaign)

    def stage(self, name: str, *where: str) -> "xr.Dataset":
        """Open a finished stage lazily; `transfer` of an echo stage is computed from the recording on access.

        Parameters
        ----------
        name
            A key of `apertura.common.contracts.STAGES`, such as 'echo'.
        *where
            Flight and node (raw, track), flight and pair (echo, profile, image), flight (refined_track), or no argument
            (cube, terrain).

        Raises
        ------
        CampaignError
            If the stage, flight, node or pair does not exist, or the stage is not finished or was modified.
        """
        _check_name(name, "stage", STAGES, where="campaign.stage")
        if name in _OF_THE_CAMPAIGN:
            _check_count(where, 0, name, "no further arguments for a stage of the whole campaign")
        elif name in _OF_FLIGHTS:
            _check_count(where, 1, name, "a flight")
            self.campaign.flight(where[0])
        else:
            kind = "node" if name in _OF_NODES else "pair"
            _check_count(where, 2, name, f"a flight and a {kind}")
            flight = self.campaign.flight(where[0])
            known = flight.recorded if kind == "node" else flight.pairs
            _check_name(where[1], kind, known, where=f"campaign.stage({name!r}, {flight.name!r})")
        if name == "echo":
            return PairEcho.cleaned(self.campaign, where[0], where[1]).stage
        return open_stage(self.campaign.stage(name, *where), name)

    def image(self, flight: str, pair: str) -> "xr.DataArray":
        """Open a pair's focused image, (y, x) complex64, with its CRS in the coordinate spatial_ref."""
        image: xr.DataArray = self.stage("image", flight, pair).image
        return image

    def report(self, flight: str, pair: str) -> dict[str, Any]:
        """Read image.json of a pair or of 'fused': engine, models and reasons, errors, measures, flags."""
        _check_name(pair, "pair", self.campaign.flight(flight).images, where=f"campaign.report({flight!r})")
        return report_of(self.campaign, flight, pair)

    def flags(self, flight: str, pair: str) -> dict[str, str]:
        """Return the flags of an image, name → measurement in one line."""
        flags: dict[str, str] = self.report(flight, pair)["flags"]
        return flags


def _check_name(name: str, kind: str, names: Iterable[str], *, where: object) -> None:
    if name not in names:
        raise CampaignError(
            f"no {kind} {name!r}", where=where, expected=f"one of {', '.join(names)}", remedy=f"Correct the {kind}."
        )


def _check_count(arguments: tuple[str, ...], count: int, stage: str, expected: str) -> None:
    if len(arguments) != count:
        raise CampaignError(
            f"arguments: {', '.join(arguments) or 'none'}",
            where=f"campaign.stage({stage!r})",
            expected=expected,
            remedy="Correct the arguments after the stage name.",
        )


def open_campaign(path: str | Path) -> OpenCampaign:
    """Open a campaign folder with its results.

    Parameters
    ----------
    path
        A campaign folder; its config is read and validated.

    Raises
    ------
    CampaignError
        If the argument is not a path, or the config is invalid.

    Examples
    --------
    >>> open_campaign("nowhere")
    Traceback (most recent call last):
    ...
    apertura.common.errors.CampaignError: nowhere/config/config.yaml: no such file; ...
    """
    if not isinstance(path, str | Path):
        expected = "the path of a campaign folder, which contains config/config.yaml"
        raise CampaignError(quoted(path), "open_campaign: path", expected, "Use a string or a pathlib.Path.")
    return OpenCampaign(Campaign.load(path))
