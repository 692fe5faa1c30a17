"""Antennas of a pair: from what the config states of them to the beams that weigh its pulses."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from apertura.common.errors import CampaignError
from apertura.common.provenance import sha256_file
from apertura.core.antenna.beam import Beam, Beams
from apertura.core.antenna.illumination import Illumination, illuminate
from apertura.core.antenna.pattern import LIMITS_RAD, antenna_axes, gaussian_cut, sampled_cut
from apertura.core.geometry.aperture import Aperture
from apertura.formats.beam_pattern import read_beam_pattern
from apertura.pipeline.campaign import Campaign
from apertura.pipeline.config import Antenna
from apertura.pipeline.opening.scene import OpenScene

_STAGED = {"radar_tx": "tx_axes", "radar_rx": "rx_axes"}
_POINTS = 33


def body_axes(echo: xr.Dataset) -> dict[str, NDArray[np.float64]]:
    """Return what an echo stage holds of the bodies' attitude: radar_tx, radar_rx → (pulse, axis, body)."""
    return {point: echo[name].values for point, name in _STAGED.items() if name in echo}


def beams_of(campaign: Campaign, pair: str, axes: Mapping[str, NDArray[np.float64]]) -> Beams | None:
    """Return the beams of a pair; None where its antennas are isotropic.

    Parameters
    ----------
    campaign, pair
        Which.
    axes
        radar_tx, radar_rx → (pulse, axis, body), forward, right and down of the body in the frame of the pixels.
    """
    stated = campaign.antennas(pair)
    if not stated:
        return None
    patterns = campaign.pattern_files(pair)
    files = {point: patterns.get(f"nodes.{node}.antennas.{point}.pattern") for point, (node, _) in stated.items()}
    found = {point: _beam(antenna, files[point], axes[point]) for point, (_, antenna) in stated.items()}
    return Beams(found.get("radar_tx"), found.get("radar_rx"))


def pattern_digests(campaign: Campaign, pair: str) -> dict[str, str]:
    """Return key of the config → sha256 of each sampled pattern of a pair's antennas, for provenance."""
    return {key: sha256_file(path) for key, path in campaign.pattern_files(pair).items()}


def _beam(antenna: Antenna, pattern: Path | None, axes: NDArray[np.float64]) -> Beam:
    if antenna.beamwidth_deg is None:
        if pattern is None:
            raise TypeError("an antenna has a beamwidth or a pattern")
        sampled = read_beam_pattern(pattern)
        cuts = tuple(sampled_cut(*samples, cutoff_db=antenna.cutoff_db) for samples in sampled)
    else:
        widths = zip(antenna.beamwidth_deg, LIMITS_RAD.values(), strict=True)
        azimuth, elevation = (
            gaussian_cut(width, cutoff_db=antenna.cutoff_db, limit_rad=limit) for width, limit in widths
        )
        cuts = azimuth, elevation
    return Beam(antenna_axes(axes, antenna.boresight_deg), *cuts[0], *cuts[1])


def antennas_report(campaign: Campaign, pair: str, illumination: Illumination | None) -> dict[str, Any]:
    """Return what image.json says of a pair's antennas: what was stated, and how many pulses see the scene."""
    stated = {point: {"node": node, **beam.model_dump()} for point, (node, beam) in campaign.antennas(pair).items()}
    if illumination is None or not stated:
        return {}
    return {"antennas": {**stated, "pulses_seeing": {**illumination.counts, "of": illumination.pulses}}}


def lit(
    campaign: Campaign,
    pair: str,
    beams: Beams | None,
    scene: OpenScene,
    aperture: Aperture,
) -> Illumination | None:
    """Return how many pulses see each point of the scene; None without beams.

    Parameters
    ----------
    campaign, pair
        Which.
    beams
        Of the pair.
    scene
        The campaign's.
    aperture
        Of the pair.

    Raises
    ------
    CampaignError
        If no pulse sees anything of the scene.
    """
    if beams is None:
        return None
    points = scene.grid.sample_points(_POINTS, scene.level.height_m)
    illumination = illuminate(beams, aperture, points.reshape(-1, 3))
    if illumination.unseen == 1:
        _refuse(campaign, pair, beams, points[points.shape[0] // 2, points.shape[1] // 2], aperture)
    return illumination


def _refuse(
    campaign: Campaign,
    pair: str,
    beams: Beams,
    middle_m: NDArray[np.float64],
    aperture: Aperture,
) -> None:
    """Raise with how far off each boresight the middle of the scene lies, at the pulse where that is least."""
    stated = campaign.antennas(pair)
    keys, lines = [f"nodes.{node}.antennas.{point}" for point, (node, _) in stated.items()], []
    legs = {"radar_tx": (beams.transmit, aperture.tx_m), "radar_rx": (beams.receive, aperture.rx_m)}
    for point, (node, _) in stated.items():
        beam, place = legs[point]
        if beam is None:
            continue
        azimuth, elevation = beam.angles(place, middle_m[None])[..., 0]
        off = np.degrees(np.arccos(np.cos(azimuth) * np.cos(elevation)))
        best = int(off.argmin())
        side, up, *ends = np.degrees([azimuth[best], elevation[best], beam.azimuth_rad[-1], beam.elevation_rad[-1]])
        lines.append(
            f"{off[best]:.0f}° from the boresight of {node}'s {point} at best: azimuth {side:+.0f}°, elevation "
            f"{up:+.0f}°, while its pattern ends at {ends[0]:.0f}° and {ends[1]:.0f}°"
        )
    raise CampaignError(
        f"zero pulses in the beam: the middle of the scene lies {'; and '.join(lines)}",
        where=f"config/config.yaml: {', '.join(keys)}",
        expected="a scene that both antennas of some pulse see",
        remedy="Check boresight_deg (azimuth clockwise from forward: right is +90; elevation: down is negative), the "
        "log's yaw (clockwise from north) and scene.bounds_m.",
    )
