"""The error budget of a pair: what the config, the logs and the echo say of each cause, before and after imaging."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.core.echo.compression import centre_frequency
from apertura.core.quality.budget import BudgetLine, expected, noise_loss, offset_line, position_lines
from apertura.core.quality.path_errors import Effect, PointPaths
from apertura.pipeline.campaign import Campaign
from apertura.pipeline.config import SampledWaveform
from apertura.pipeline.opening.pair import OpenPair
from apertura.pipeline.opening.scene import OpenScene

_MS, _CM, _PPM = 1e-3, 1e-2, 1e-6


def budget_of(campaign: Campaign, pair: OpenPair, scene: OpenScene) -> list[BudgetLine]:
    """Return what is expected to spoil an image of a pair, but for arithmetic: one line per cause.

    Parameters
    ----------
    campaign, pair, scene
        What is known; before the echo is formed, what the config and the logs say.

    Notes
    -----
    Source: docs/theory/focus.md, "Budget". The effects are those on a point in the middle of the scene.
    """
    paths = paths_to_middle(pair, scene)
    monostatic, sidelink = pair.monostatic, pair.report.get("sidelink", {})
    lines = [
        *_positions(campaign, pair, paths),
        offset_line(
            paths, "heights", -paths.gradient[:, 2], campaign.settings.scene.height_std_m, unit="m", common=True
        ),
        offset_line(
            paths,
            "time tags",
            -_MS * paths.rate_m_s,
            _stated_tags_ms(campaign, pair),
            unit="ms",
            common=True,
        ),
        offset_line(
            paths,
            "calibration",
            np.full(len(paths.time_s), _CM),
            _scaled(pair.report, "calibration", "std_m", _CM),
            unit="cm of path",
        ),
        _sampling(pair.report.get("pulses", {})),
        _antenna(pair),
    ]
    if not monostatic:
        total = paths.aperture.path(paths.point_m)
        lines.append(offset_line(paths, "clock", _PPM * total, _scaled(pair.report, "clock", "std_ppm", 1), unit="ppm"))
        if "snr_db" in sidelink:
            lines += _sidelink(sidelink, subcarriers=len(pair.frequency_hz))
    if isinstance(campaign.settings.waveform, SampledWaveform):
        effect = paths.of_offset(campaign.settings.waveform.middle_s * paths.rate_m_s)
        lines.append(BudgetLine("stop and go", f"{np.abs(paths.rate_m_s).max():.2g} m/s of path at most", effect))
    return [*lines, *_between_epochs(paths, pair)]


def positions_loss_db(campaign: Campaign, pair: OpenPair, scene: OpenScene) -> float:
    """Return what errors of position that somebody stated are expected to cost an image of a pair, dB, 0 or less."""
    return expected(_positions(campaign, pair, paths_to_middle(pair, scene))).loss_db


def paths_to_middle(pair: OpenPair, scene: OpenScene) -> PointPaths:
    """Return the paths of a pair to the middle of the scene."""
    return PointPaths.of(
        pair.aperture,
        pair.time_s,
        point_m=scene.middle_m,
        axes=scene.axes,
        wavelength_m=SPEED_OF_LIGHT_M_S / centre_frequency(pair.frequency_hz),
    )


def _positions(campaign: Campaign, pair: OpenPair, paths: PointPaths) -> list[BudgetLine]:
    if pair.left is not None:
        return [BudgetLine("positions", "what the refined tracks leave", pair.left)]
    sidelink = not pair.monostatic and isinstance(campaign.settings.waveform, SampledWaveform)
    return position_lines(paths, pair.positions, sidelink=sidelink)


def _between_epochs(paths: PointPaths, pair: OpenPair) -> list[BudgetLine]:
    """Return what the spline between the epochs of the logs errs by: noise that lasts an epoch."""
    stated = pair.report.get("positions", {})
    errors = [stated.get(leg, {}).get("interpolation_m") for leg in ("tx", "rx")[: len(pair.positions)]]
    if any(error is None for error in errors):
        return []
    slopes = paths.by_node(same=len(errors) == 1, sidelink=not pair.monostatic)
    parts = [(np.linalg.norm(slope, axis=1) * error, 0.0) for slope, error in zip(slopes, errors, strict=True)]
    words = " and ".join(f"{1e3 * error:.2g} mm" for error in errors)
    return [BudgetLine("between epochs", f"{words} rms", paths.of_noise(*parts))]


def arithmetic_line(error_db: float) -> BudgetLine:
    """Return what the numerical error measured costs."""
    return BudgetLine(
        "arithmetic", f"{error_db:.1f} dB measured", Effect(10 * np.log10(1 - 10 ** (error_db / 10)), 0, 0)
    )


def _scaled(report: Mapping[str, Any], section: str, name: str, unit: float) -> float | None:
    value = (report.get(section) or {}).get(name)
    return None if value is None else float(value) / unit


def _stated_tags_ms(campaign: Campaign, pair: OpenPair) -> float | None:
    """Return the deviation of the pulses' tags, milliseconds; None where the config has only its default."""
    tx, rx = pair.name.split("-")
    sampled = isinstance(campaign.settings.waveform, SampledWaveform)
    name = tx if sampled else rx  # who tagged the pulses
    if name not in campaign.settings.nodes:
        return None
    node = campaign.node(pair.flight, name)
    return node.time_tag_std_s / _MS if "time_tag_std_s" in node.model_fields_set else None


def _sampling(pulses: Mapping[str, Any]) -> BudgetLine:
    used, dropped = pulses.get("used"), pulses.get("dropped", 0)
    stated = None if used is None else f"{dropped} of {used + dropped} pulses missing"
    return BudgetLine("missing pulses", stated, Effect(0.0, 0.0, 0.0), "nothing known")


def _antenna(pair: OpenPair) -> BudgetLine:
    """Return the line of the antennas: beams stated weigh the pulses; one that is not shades the aperture."""
    stated = None if pair.beams is None else "weighed by the beams stated"
    return BudgetLine("antenna", stated, Effect(0.0, 0.0, 0.0), "a beam without a phase of its own")


def _sidelink(report: Mapping[str, Any], *, subcarriers: int) -> list[BudgetLine]:
    """Return noise of the sidelink as phase noise of each pulse, and what an echo in it turns the phase by at most."""
    noise = noise_loss(10 ** (-report["snr_db"] / 10) / (2 * subcarriers))
    echo = 10 ** (report["echo_db"] / 20)
    return [
        BudgetLine("sidelink noise", f"{report['snr_db']:.1f} dB per subcarrier", noise),
        BudgetLine(
            "sidelink echo", f"at most {report['echo_db']:.1f} dB", Effect(0.0, 0.0, float(np.arcsin(min(1.0, echo))))
        ),
    ]
