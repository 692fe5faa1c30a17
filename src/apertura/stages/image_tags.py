"""Descriptions of images as tags of files: attribution, acquisition, geometry, quality."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from apertura.campaign.config import is_monostatic, polarisation_of
from apertura.campaign.folder import Campaign
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.leap_seconds import GPS_EPOCH
from apertura.common.provenance import canonical_json
from apertura.common.raster import opened_raster
from apertura.common.units import frequency_band
from apertura.formats.export import product


def acquisition_tags(campaign: Campaign, views: Mapping[tuple[str, str], Mapping[str, Any]]) -> dict[str, str]:
    """Return attribution, time, frequency, polarisation and geometry of an image as tags that a person can read.

    Parameters
    ----------
    campaign
        Campaign of the image.
    views
        Flight and pair → `apertura.core.imaging.view.view_report`; several images for a sum or an interferogram. Angles
        and distances are those at the scene centre, or their means over several images.
    """
    each, flights, pairs = list(views.values()), *(list(dict.fromkeys(names)) for names in zip(*views, strict=True))
    first, last = min(view["first_utc"] for view in each), max(view["last_utc"] for view in each)
    centres = {view["centre_hz"] for view in each}
    low = min(view["centre_hz"] - view["band_hz"] / 2 for view in each)
    high = max(view["centre_hz"] + view["band_hz"] / 2 for view in each)
    centre_hz = centres.pop() if len(centres) == 1 else (low + high) / 2
    sides = {view["side"] for view in each}
    side = sides.pop() if len(sides) == 1 else "both"
    is_observable = any(view["side_observable"] for view in each)
    labels = {label for pair in pairs if (label := polarisation_of(campaign.settings.nodes, pair))}
    has_clock = np.datetime64(first) >= GPS_EPOCH  # times of a recording without a clock start in 1970

    def mean(name: str) -> str:
        return f"{np.mean([view[name] for view in each]):.2f}"

    def direction(name: str) -> str | None:
        """Return the direction of the mean unit vector, degrees; None if directions are unknown or cancel."""
        known = [np.exp(1j * np.radians(view[name])) for view in each if view[name] is not None]
        vector = np.mean(known) if known else 0.0
        return f"{np.degrees(np.angle(vector)) % 360:.2f}" if abs(vector) > _COMMON_DIRECTION else None

    tags = {
        "APERTURA_CAMPAIGN": campaign.settings.campaign,
        "APERTURA_FLIGHTS": ", ".join(flights),
        "APERTURA_PAIRS": ", ".join(pairs),
        "APERTURA_MODE": mode_of(pairs),
        "APERTURA_ACQUISITION_START": f"{first[:26]}Z" if has_clock else None,
        "APERTURA_ACQUISITION_END": f"{last[:26]}Z" if has_clock else None,
        "APERTURA_FREQUENCY_BAND": frequency_band(centre_hz),
        "APERTURA_CENTRE_FREQUENCY_HZ": f"{centre_hz:.12g}",
        "APERTURA_BANDWIDTH_HZ": f"{high - low:.12g}",
        "APERTURA_WAVELENGTH_M": f"{SPEED_OF_LIGHT_M_S / centre_hz:.6g}",
        "APERTURA_POLARISATION": ", ".join(sorted(labels)) or None,
        "APERTURA_LOOK_SIDE": side if side == "both" or is_observable else f"{side}, assumed",
        "APERTURA_LOOK_DIRECTION_DEG": direction("look_deg"),
        "APERTURA_HEADING_DEG": direction("heading_deg"),
        "APERTURA_DIRECTIONS": "clockwise from grid north, the y axis of the CRS",
        "APERTURA_LOOK_VECTOR_ECEF": _look_vector(each),
        "APERTURA_RANGE_M": mean("range_m"),
        "APERTURA_HEIGHT_ABOVE_TERRAIN_M": mean("height_m"),
        "APERTURA_INCIDENCE_DEG": mean("incidence_deg"),
        "APERTURA_BISTATIC_ANGLE_DEG": mean("bistatic_angle_deg"),
        "TIFFTAG_DATETIME": f"{first[:19].replace('-', ':').replace('T', ' ')}" if has_clock else None,
        **_attribution_tags(campaign, int(first[:4]) if has_clock else None),
    }
    return {name: value for name, value in tags.items() if value is not None}


def _look_vector(views: Sequence[Mapping[str, Any]]) -> str | None:
    """Return the unit vector from the antennas to the scene centre; None for several images or in a local frame."""
    vector = views[0]["look_vector_ecef"] if len(views) == 1 else None
    return None if vector is None else " ".join(f"{part:.6f}" for part in vector)


_COMMON_DIRECTION = 0.5
"""Minimum length of the mean of unit vectors for which their mean direction is stated."""


def mode_of(pairs: Sequence[str]) -> str:
    """Return the imaging mode of a pair, or of a sum of pairs: monostatic, bistatic or multistatic.

    Examples
    --------
    >>> mode_of(["a-a"]), mode_of(["a-b"]), mode_of(["a-a", "a-b"])
    ('monostatic', 'bistatic', 'multistatic')
    """
    if len(pairs) > 1:
        return "multistatic"
    return "monostatic" if is_monostatic(pairs[0]) else "bistatic"


def _attribution_tags(campaign: Campaign, year: int | None) -> dict[str, str | None]:
    """Return the section `metadata` of the config as tags; None for a value that is not stated."""
    stated = campaign.settings.metadata
    names = "; ".join(creator.name for creator in stated.creators)
    return {
        "APERTURA_TITLE": stated.title,
        "APERTURA_CREATORS": "; ".join(map(str, stated.creators)) or None,
        "APERTURA_INSTITUTION": stated.institution,
        "APERTURA_LICENCE": stated.licence,
        "APERTURA_PLATFORM": stated.platform,
        "APERTURA_INSTRUMENT": stated.instrument,
        "APERTURA_DOI": stated.doi,
        "APERTURA_CITATION": stated.citation(campaign.settings.campaign, year),
        "TIFFTAG_ARTIST": names or None,
        "TIFFTAG_COPYRIGHT": stated.licence,
    }


def angle_tags(campaign: Campaign, flight: str, pairs: Sequence[str]) -> dict[str, str]:
    """Return mean and range of the incidence and bistatic angles over the illuminated pixels of pairs as tags.

    The angles are those of step `layers`.
    """
    tags: dict[str, str] = {}
    for row in (product("incidence", "write_incidence"), product("bistatic_angle", "write_bistatic_angle")):
        total, count, lowest, highest = 0.0, 0, np.inf, -np.inf
        for pair in pairs:
            path = campaign.result(flight, pair, row.file)
            with opened_raster(path, expected="a raster of step layers", remedy="Run the workflow again.") as raster:
                for _, window in raster.block_windows(1):
                    angles = raster.read(1, window=window)
                    if (known := angles[np.isfinite(angles)]).size:
                        total, count = total + float(known.sum(dtype=np.float64)), count + known.size
                        lowest, highest = min(lowest, float(known.min())), max(highest, float(known.max()))
        if count:
            name = f"APERTURA_{row.source.upper()}"
            tags |= {f"{name}_MEAN_DEG": f"{total / count:.2f}", f"{name}_RANGE_DEG": f"{lowest:.2f} to {highest:.2f}"}
    return tags


def quality_tags(report: Mapping[str, Any]) -> dict[str, str]:
    """Return processing, error bound, focus, flags, models and error budget of an image as tags."""
    reports = {
        name: report[name] for name in ("budget", "budgets", "focus", "fusion", "recomputed") if report.get(name)
    }
    focus, budgets = report.get("focus", {}), [report.get("budget", ()), *report.get("budgets", {}).values()]
    lines, brightest = [line for budget in budgets for line in budget], report.get("brightest") or {}
    largest = max(lines, key=lambda line: line["shift_m"] or 0.0, default=None)
    readable = {
        "FOCUS_VERDICT": focus.get("verdict"),
        "PEAK_LOSS_DB": f"{abs(focus['loss_db']):.2f}" if "loss_db" in focus else None,
        "GEOLOCATION_METHOD": largest
        and f"predicted by the error budget; largest term: {largest['cause']}, {largest['stated']}",
        "GEOLOCATION_UNCERTAINTY_M": f"{focus['expected_shift_m']:.3g}" if "expected_shift_m" in focus else None,
        **{
            f"WIDTH_{axis.upper()}_M": f"{brightest[f'{axis}_width_m']:.3g}"  # -3 dB, of the brightest point
            for axis in ("cross_range", "ground_range")
            if brightest.get(f"{axis}_width_m")
        },
    }
    return {
        "APERTURA_PROCESSING": "time-domain backprojection"
        + (f", engine {report['engine']}" if "engine" in report else ""),
        "APERTURA_INSTRUCTION_SET": report["instruction_set"],
        "APERTURA_ERROR_DB": f"{report['numerical_error_db']:.2f}",
        "APERTURA_ERROR_CONFIDENCE": f"{report['numerical_error_confidence']:.2f}",
        **{f"APERTURA_{name}": value for name, value in readable.items() if value is not None},
        "APERTURA_FLAGS": canonical_json(report["flags"]),
        "APERTURA_MODELS": canonical_json(report["models"]),
        **{f"APERTURA_{name.upper()}": canonical_json(value) for name, value in reports.items()},
    }
