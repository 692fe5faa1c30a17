"""What a simulated campaign has beside files like any other: RTKLIB logs, and the truth for those who judge it."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.random import default_rng
from numpy.typing import NDArray

from apertura.common.arrays import Floats
from apertura.common.leap_seconds import gps_from_utc
from apertura.core.geometry.geodesy import projected_from_ecef
from apertura.simulation.continuous import pulse_samples
from apertura.simulation.observation import Observation
from apertura.simulation.recording import full_scale
from apertura.simulation.scene import Origin, PointTarget, Target, scatterers
from apertura.simulation.specification import DrawnCampaign, SimulatedFlight

_POS_HEADER = """\
% program   : RTKPOST ver.2.4.3
% pos mode  : Kinematic
%
% (lat/lon/height=WGS84/ellipsoidal,Q=1:fix,2:float,3:sbas,4:dgps,5:single,6:ppp,ns=# of satellites)
%  {system:<22}latitude(deg) longitude(deg)  height(m)   Q  ns   sdn(m)   sde(m)   sdu(m)  sdne(m)  sdeu(m)  sdun(m) \
age(s)  ratio
"""
_POS_QUALITY = "   1  18   0.0050   0.0050   0.0100   0.0000   0.0000   0.0000   0.00  100.0"


def write_pos_log(path: Path, time_utc: NDArray[np.datetime64], geodetic: Floats, *, system: str = "GPST") -> None:
    """Write an RTKLIB solution, .pos, of latitude, longitude and ellipsoidal height, in `system` GPST or UTC.

    Notes
    -----
    Source: RTKLIB manual 2.4.2, appendix B.1 "Positioning solution file".
    """
    stated = gps_from_utc(time_utc) if system == "GPST" else time_utc
    lines = []
    for time, (latitude, longitude, height) in zip(stated, geodetic, strict=True):
        text = np.datetime_as_string(time, "ms").replace("-", "/").replace("T", " ")
        lines.append(f"{text}   {latitude:14.11f} {longitude:15.11f} {height:11.5f}{_POS_QUALITY}")
    path.write_text(_POS_HEADER.format(system=system) + "\n".join(lines) + "\n", encoding="utf-8")


def targets_truth(origin: Origin, targets: tuple[Target, ...], crs: str) -> dict[str, Any]:
    """Return point targets in a projected CRS with ellipsoidal heights, and what else there is in words."""
    points = tuple(target for target in targets if isinstance(target, PointTarget))
    others = [repr(target) for target in targets if not isinstance(target, PointTarget)]
    placed = scatterers(origin, points, default_rng(0))
    columns = np.column_stack(
        [projected_from_ecef(crs, placed.position_m), np.abs(placed.amplitude), np.angle(placed.amplitude)]
    )
    listed = [dict(zip(("x", "y", "height_m", "amplitude", "phase_rad"), row, strict=True)) for row in columns.tolist()]
    return {"crs": crs, "targets": listed} | ({"extended": others} if others else {})


def flight_truth(
    campaign: DrawnCampaign, flight: SimulatedFlight, recordings: Mapping[str, Observation]
) -> dict[str, Any]:
    """Return everything that was drawn of a flight, node by node."""
    specification = campaign.specification
    truth: dict[str, Any] = {"pulses": flight.pulses, "kind": flight.kind, "nodes": {}}
    if flight.targets is not None:
        truth |= targets_truth(specification.origin, flight.targets, specification.scene.crs)
    for name, recording in recordings.items():
        node, draw, radar = specification.nodes[name], recording.draw, recording.channels["radar"]
        truth["nodes"][name] = {
            "kept": None if draw.kept.all() else np.flatnonzero(draw.kept).tolist(),
            "cfo_hz": radar.cfo_hz,
            "sfo_hz": radar.sfo_hz,
            "path_offset_m": dict(node.path_offset_m),
            "phase_rad": _series(draw.phase_rad),
            "start_s": _series(draw.start_s),
            "tag_error_s": _series(draw.tag_error_s),
            "blocked": np.flatnonzero(draw.blocked).tolist(),
            "position_error_m": draw.position_error_m.tolist() if draw.position_error_m.any() else 0.0,
            "channels": {
                own: {"noise_variance": one.noise_variance, "full_scale": full_scale(one, node.impairments.adc)}
                for own, one in recording.channels.items()
            },
            "impairments": repr(node.impairments),
        }
        if flight.continuous:
            truth["nodes"][name]["pulse_start_sample"] = pulse_samples(radar, campaign.pulse_times(flight)).tolist()
    return truth


def _series(values: Floats) -> list[float] | float:
    """Return a constant as one number, anything else pulse by pulse."""
    return float(values[0]) if (values == values[0]).all() else values.tolist()
