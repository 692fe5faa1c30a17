"""Plan and error budget of each pair's image, from its echo or from the flight logs."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.filesize import decimal

from apertura.campaign.config import CONFIG, Node, OfdmWaveform, SampledWaveform
from apertura.campaign.config.processing import HEIGHT_DEFAULT
from apertura.campaign.folder import Campaign
from apertura.common.errors import CampaignError, number_of
from apertura.common.flags import Flags
from apertura.common.units import decibels
from apertura.core.antenna.beam import Beams
from apertura.core.backprojection.job import Integration, Job
from apertura.core.echo.compression import centre_frequency, range_step
from apertura.core.echo.symbol_filter import filter_of
from apertura.core.geometry.atmosphere import USUAL_N
from apertura.core.geometry.gate import EDGE_CELLS, RangeGate
from apertura.core.imaging.job import decide_integration, imaging_job
from apertura.core.imaging.range_profiles import GUARD_SAMPLES, RangeWindow
from apertura.core.planning.decisions import FEWEST, decide_accuracy
from apertura.core.planning.plan import Decision, Plan, memory_limit
from apertura.core.planning.planner import make_plan
from apertura.core.quality.budget import (
    NO_EFFECT,
    BudgetLine,
    NodeAttitude,
    antenna_line,
    attitude_lines,
    expected,
    height_line,
    noise_loss,
    offset_line,
    position_lines,
    summed,
)
from apertura.core.quality.path_errors import MOST_PULSES, Effect, PointPaths
from apertura.core.scene.clearance import check_antennas
from apertura.core.scene.swath import swath
from apertura.core.scene.terrain import GroundModels
from apertura.stages.pair import OpenPair, scene_illumination
from apertura.stages.scene import OpenScene
from apertura.stages.transmitted import transmitted

# ---- Error budget of a pair, from config, logs and echo -------------------------------------------------------------

_MS, _CM, _PPM = 1e-3, 1e-2, 1e-6
_OBSERVABLE_CELLS = 0.01
"""Smallest observable displacement of a point with 20 dB SNR, range cells (docs/theory/focus.md, eq. 6)."""


def budget_of(
    campaign: Campaign, pair: OpenPair, scene: OpenScene, *, place_m: NDArray[np.float64] | None = None
) -> list[BudgetLine]:
    """Return the expected degradation of a pair's image, one line per cause, without the arithmetic error.

    Parameters
    ----------
    campaign, pair, scene
        Campaign, pair and scene; before the echo is formed, config and logs determine the budget.
    place_m
        (3,) float64, metres in the frame of the pixels: point at which effects are computed (default: scene centre).

    Notes
    -----
    Source: docs/theory/focus.md, "Budget".
    """
    paths = paths_to(pair, scene, scene.middle_m if place_m is None else place_m)
    monostatic, sidelink = pair.monostatic, pair.report.get("sidelink", {})
    track_lines = [*_positions(campaign, pair, paths), *_attitude(campaign, pair, paths)]
    pulses = pair.report.get("pulses", {})
    used, dropped = pulses.get("used"), pulses.get("dropped", 0)
    stated = None if used is None else f"{dropped} of {used + dropped} pulses missing"
    lines = [
        *track_lines,
        height_line(paths, campaign.settings.scene.height_std_m, expected_db=expected(track_lines).loss_db),
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
            unit="cm",
            quantity="path error",
        ),
        _air(campaign, pair, paths),
        BudgetLine("missing pulses", stated, NO_EFFECT),
        _antenna(pair, paths),
    ]
    background = pair.report.get("background", {})
    if background.get("removed", "none") != "none":
        effect = Effect(background["middle_loss_db"], 0.0, 0.0)
        lines.append(BudgetLine("background removal", background["removed"], effect))
    symbols = symbols_of(campaign, pair)
    if "decided" in symbols:
        known = symbols["decided"]
        stated = f"{known['method']}, SNR {known['snr_db']:.1f} dB: error of a subcarrier {known['error_db']:.1f} dB"
        lines.append(BudgetLine("unknown symbols", stated, Effect(known["loss_db"], 0.0, 0.0)))
    if "filter" in symbols:
        sidelobes = "none" if symbols["sidelobes_db"] is None else f"{symbols['sidelobes_db']:.1f} dB"
        stated = f"{symbols['filter']} filter: SNR loss {symbols['loss_db']:.2f} dB, data sidelobes {sidelobes}"
        lines.append(BudgetLine("data symbols", stated, NO_EFFECT))
    if not monostatic:
        total = paths.aperture.path(paths.point_m)
        lines.append(offset_line(paths, "clock", _PPM * total, _scaled(pair.report, "clock", "std_ppm", 1), unit="ppm"))
        if "snr_db" in sidelink:
            noise = noise_loss(10 ** (-sidelink["snr_db"] / 10) / (2 * len(pair.frequency_hz)))
            echo = 10 ** (sidelink["echo_db"] / 20)
            lines += [
                BudgetLine("sidelink noise", f"{sidelink['snr_db']:.1f} dB per subcarrier", noise),
                BudgetLine(
                    "sidelink echo",
                    f"at most {sidelink['echo_db']:.1f} dB",
                    Effect(0.0, 0.0, float(np.arcsin(min(1.0, echo)))),
                ),
            ]
    if isinstance(campaign.settings.waveform, SampledWaveform):
        effect = paths.of_offset(campaign.settings.waveform.middle_s * paths.rate_m_s)
        rate = f"rate of change of the total path at most {np.abs(paths.rate_m_s).max():.2g} m/s"
        lines.append(BudgetLine("stop and go", rate, effect))
    return [*lines, *_between_epochs(paths, pair)]


def symbols_of(campaign: Campaign, pair: OpenPair) -> Mapping[str, Any]:
    """Return the filter of a pair's symbols and its effect, measured or predicted; empty for a constant modulus."""
    waveform, symbols = campaign.settings.waveform, dict(pair.report.get("symbols", {}))
    if not isinstance(waveform, OfdmWaveform) or (pair.report and "filter" not in symbols):
        return symbols
    sent = transmitted(campaign, waveform)
    if not pair.report:
        choose = sent.filter_choice(campaign.settings.processing, np.arange(len(pair.time_s)), pair.weight)
        return choose(None, np.inf).report if choose else {}
    chosen = filter_of(symbols)
    if chosen is not None and sent.power is not None:  # with the window of the image, which may exclude subcarriers
        snr, divided_snr = (
            otherwise if symbols[name] is None else 10 ** (symbols[name] / 10)
            for name, otherwise in (("snr_db", 0.0), ("divided_snr_db", np.inf))
        )
        symbols["loss_db"] = round(decibels(chosen.loss(sent.power, snr, pair.weight, divided_snr)), 2)
    return symbols


def positions_loss_db(campaign: Campaign, pair: OpenPair, scene: OpenScene) -> float:
    """Return the expected peak loss of a pair's image from stated position errors, dB, 0 or less."""
    lines = _positions(campaign, pair, paths_to(pair, scene, scene.middle_m))
    return summed(line.effect for line in lines if line.stated is not None).loss_db


def paths_to(pair: OpenPair, scene: OpenScene, place_m: NDArray[np.float64]) -> PointPaths:
    """Return the paths of a pair to a point of the scene, (3,) float64 metres in the frame of the pixels."""
    return PointPaths.of(
        pair.aperture,
        pair.time_s,
        point_m=place_m,
        axes=scene.axes,
        wavelength_m=pair.wave_speed_m_s / centre_frequency(pair.frequency_hz),
    )


def _positions(campaign: Campaign, pair: OpenPair, paths: PointPaths) -> list[BudgetLine]:
    if pair.left is not None:
        return [BudgetLine("positions", "residual error after track refinement", pair.left)]
    return position_lines(paths, pair.positions, sidelink=_by_sidelink(campaign, pair))


def _by_sidelink(campaign: Campaign, pair: OpenPair) -> bool:
    """Return True if echoes are divided by a sidelink, whose length comes from the logs."""
    return not pair.monostatic and isinstance(campaign.settings.waveform, SampledWaveform)


def _attitude(campaign: Campaign, pair: OpenPair, paths: PointPaths) -> list[BudgetLine]:
    """Return the effect of attitude and lever-arm errors; empty for refined tracks, which are those of the antennas."""
    if pair.left is not None or not pair.axes:
        return []
    sampled = pair.aperture.sample(MOST_PULSES)
    legs = dict(zip(pair.name.split("-"), ("radar_tx", "radar_rx"), strict=True))
    nodes = [_attitude_of(campaign.settings.nodes[name], pair.axes.get(point), sampled) for name, point in legs.items()]
    return attitude_lines(paths, nodes, sidelink=_by_sidelink(campaign, pair))


def _attitude_of(node: Node, axes: NDArray[np.float64] | None, sampled: slice) -> NodeAttitude | None:
    arms = node.lever_arms_m
    if axes is None or not arms.any():
        return None
    return NodeAttitude(
        axes[sampled],
        (arms.radar_tx, arms.radar_rx, arms.sidelink),
        node.attitude,
        node.attitude_error_deg,
        node.attitude_correlation_s,
        node.lever_arm_std_m,
    )


def _between_epochs(paths: PointPaths, pair: OpenPair) -> list[BudgetLine]:
    """Return the interpolation error between epochs of the logs, as noise with the correlation time of one epoch."""
    stated = pair.report.get("positions", {})
    errors = [stated.get(leg, {}).get("interpolation_m") for leg in ("tx", "rx")[: len(pair.positions)]]
    if any(error is None for error in errors):
        return []
    slopes = paths.by_node(same=len(errors) == 1, sidelink=not pair.monostatic)
    parts = [(np.linalg.norm(slope, axis=1) * error, 0.0) for slope, error in zip(slopes, errors, strict=True)]
    words = " and ".join(f"{1e3 * error:.2g} mm" for error in errors)
    return [BudgetLine("between epochs", f"{words} rms", paths.of_noise(*parts))]


def _air(campaign: Campaign, pair: OpenPair, paths: PointPaths) -> BudgetLine:
    """Return the effect of uncertain refractivity: displacement common to all pairs, phase from the path difference.

    The phase of a pair relative to the transmitter's own image has an error proportional to the difference of their
    paths, which includes the sidelink length (docs/theory/atmosphere.md, eq. 6).
    """
    per_n = 1e-6 * float(pair.air["std_n"])
    line = f"{pair.air['source']}: N = {pair.air['refractivity_n']:.1f} ± {pair.air['std_n']:.1f}"
    tx_m, rx_m = (np.linalg.norm(leg - paths.point_m, axis=1) for leg in paths.aperture.legs)
    sidelink_m, difference_m = np.zeros(len(tx_m)), rx_m - tx_m
    if _by_sidelink(campaign, pair):
        sidelink_m = np.linalg.norm(paths.aperture.tx_m - paths.aperture.rx_m, axis=1)
    effect = paths.of_offset(per_n * (tx_m + rx_m - sidelink_m), common=True)
    phase_rad = 2 * np.pi / paths.wavelength_m * per_n * float(np.abs(difference_m - sidelink_m).mean())
    effect = replace(effect, phase_rad=0.0 if pair.monostatic else phase_rad)
    assumed = campaign.settings.scene.atmosphere == "auto"
    return BudgetLine("atmosphere", None if assumed else line, effect, assumed=line if assumed else None)


def symbols_decisions(campaign: Campaign, pair: OpenPair) -> list[Decision]:
    """Return the decisions on unknown symbols and on the filter of symbols of varying modulus, if there are any."""
    symbols, decisions = symbols_of(campaign, pair), list[Decision]()
    if "decided" in symbols:
        decisions.append(Decision("symbols", symbols["decided"]["method"], symbols["decided"]["reason"]))
    if "filter" in symbols:
        reason = f"{symbols['reason']}; SNR loss {symbols['loss_db']:.2f} dB"
        decisions.append(Decision("symbol_filter", symbols["filter"], reason))
    return decisions


def air_decision(pair: OpenPair) -> Decision:
    """Return the refractivity assumed on the paths of a pair, and its effect relative to vacuum."""
    air = pair.air
    cell_m = pair.wave_speed_m_s / float(np.ptp(pair.frequency_hz)) / 2
    displaced_m, residual_m = float(air["vacuum_shift_m"]), float(air["constant_refractivity_error_m"])
    reference = "vacuum"
    if not air["refractivity_n"]:
        displaced_m, reference = 1e-6 * USUAL_N * float(air["range_m"]), f"N = {USUAL_N:.0f}"
    observable = "" if displaced_m > _OBSERVABLE_CELLS * cell_m else ", not observable"
    reason = (
        f"{air['source']}; mean along the paths from {air['antennas_m']:.0f} m height; displacement of the image "
        f"relative to {reference} {100 * displaced_m:.2g} cm in slant range, {displaced_m / cell_m:.2g} cells"
        f"{observable}; a refractivity common to all pulses causes a path error of {100 * residual_m:.1g} cm"
    )
    return Decision("atmosphere", f"N = {air['refractivity_n']:.1f}", reason)


def background_decision(pair: OpenPair) -> Decision:
    """Return the decision on background removal: that of stage `profile`, or the setting before this stage exists."""
    report = pair.report.get("background")
    if report is None:
        return Decision("background", "auto", "decided when range profiles are formed")
    if "removed" in report:
        return Decision("background", report["removed"], report["reason"])
    reason = "configured" if report["requested"] == "none" else "auto: the recording has no echo at constant delay"
    return Decision("background", "none", reason)


def _scaled(report: Mapping[str, Any], section: str, name: str, unit: float) -> float | None:
    value = (report.get(section) or {}).get(name)
    return None if value is None else float(value) / unit


def _stated_tags_ms(campaign: Campaign, pair: OpenPair) -> float | None:
    """Return the standard deviation of the pulses' time tags, milliseconds; None if it is not configured."""
    tx, rx = pair.name.split("-")
    sampled = isinstance(campaign.settings.waveform, SampledWaveform)
    name = tx if sampled else rx  # the node that tags the pulses
    if name not in campaign.settings.nodes:
        return None
    node = campaign.node(pair.flight, name)
    return node.time_tag_std_s / _MS if "time_tag_std_s" in node.model_fields_set else None


def _antenna(pair: OpenPair, paths: PointPaths) -> BudgetLine:
    """Return the budget line of the antennas, whose beams weight the pulses; phases of patterns are not corrected."""
    if pair.beams is None:
        return BudgetLine("antenna", None, NO_EFFECT, "a beam pattern without phase")
    beams, point = pair.beams[pair.aperture.sample(MOST_PULSES)], paths.point_m[None]
    phase = beams.phase(paths.aperture, point)
    if phase is None:
        return BudgetLine("antenna", "pulses weighted by the configured beams", NO_EFFECT)
    return antenna_line(paths, phase[:, 0], beams.weight(paths.aperture, point)[:, 0])


# ---- Plan of each pair, from its echo, or from the flight logs before that is formed ---------------------------------


def plan_pair(campaign: Campaign, pair: OpenPair, scene: OpenScene, *, threads: int = 1) -> Plan:
    """Plan the image of an open pair.

    Parameters
    ----------
    campaign
        Campaign with its settings.
    pair, scene
        Open pair, and the scene with grid and terrain.
    threads
        Number of tiles processed in parallel, for the predicted run time and memory; no choice depends on it.

    Raises
    ------
    CampaignError
        If the job does not fit in memory or on the disk, or its geometry is impossible.
    """
    where = f"flight {pair.flight}, pair {pair.name}"
    flags = check_antennas(scene.grid, scene.terrain, pair.aperture, where=where)
    accuracy = accuracy_of(campaign, pair, scene)
    plan = plan_job(campaign, job_of(campaign, pair, scene, threads=threads), accuracy_db=float(accuracy.value))
    plan = replace(
        plan,
        decisions=(
            *plan.decisions,
            accuracy,
            air_decision(pair),
            background_decision(pair),
            *symbols_decisions(campaign, pair),
        ),
        flags=Flags.merged(flags, scene.flags, plan.flags, recording_flags(campaign, pair, scene)),
    )
    is_written = campaign.is_current(campaign.stage("image", pair.flight, pair.name))
    free_disk = None if is_written else campaign.root.free_bytes()
    check_fits(plan, free_disk=free_disk, where=f"{pair.flight}/{pair.name}")
    return plan


def plan_job(campaign: Campaign, job: Job, *, accuracy_db: float) -> Plan:
    """Plan a job for an accuracy and the overrides of a campaign."""
    overrides = campaign.settings.processing.planned
    return make_plan(job, accuracy_db=accuracy_db, overrides=overrides, where=f"{CONFIG}: processing")


def accuracy_of(campaign: Campaign, pair: OpenPair, scene: OpenScene) -> Decision:
    """Return the requested numerical error, and the reason for it."""
    requested = campaign.settings.processing.accuracy_db
    if requested != "auto":
        return Decision("accuracy_db", requested, "configured")
    return decide_accuracy(budget_of(campaign, pair, scene))


def job_of(campaign: Campaign, pair: OpenPair, scene: OpenScene, *, threads: int = 1) -> Job:
    """Return the planner's job for an open pair, or for a subset of its pulses."""
    ground = GroundModels.of(scene.terrain, scene.level, scene.grid)
    job = imaging_job(
        pair.aperture,
        pair.frequency_hz,
        pair.weight,
        scene.grid,
        ground,
        beams=Beams.within(None, pair.beams, pair.gate),
        integration=campaign.settings.processing.integrated,
        wave_speed_m_s=pair.wave_speed_m_s,
    )
    return replace(
        job,
        illumination=scene_illumination(campaign, pair.name, job.beams and job.beams.on_profiles, scene, pair.aperture),
        tile_px=campaign.settings.processing.tile_px,
        threads=threads,
        memory_bytes=memory_limit(),
    )


def weighing(campaign: Campaign, pair: OpenPair, scene: OpenScene) -> Beams | None:
    """Return the weights of a pair's pulses over the scene: antennas, angular sector, gate; None if all are equal.

    The weights are those of `job_of`, without the echo: they determine the ranges that profiles must cover.
    """
    return Beams.within(integration_of(campaign, pair, scene).sector, pair.beams, pair.gate)


# ---- Scenes beyond the recorded paths

_GATE_POINTS, _GATE_PULSES = 65, 512
"""Points along a side of the scene, and largest number of pulses, from which the recorded share is estimated."""


def gated(campaign: Campaign, pair: OpenPair, scene: OpenScene) -> OpenPair:
    """Return a pair with the gate of its recorded paths; without a gate if all echoes of the scene are recorded.

    The gate is decided with the positions of the logs, so that all stages use the same one.

    Raises
    ------
    CampaignError
        If no point of the scene is recorded by three pulses.

    Notes
    -----
    Source: docs/theory/integration.md, eq. 6.
    """
    pair = replace(pair, gate=None)
    beams, limit_m = weighing(campaign, pair, scene), pair.path_limits_m
    if np.isinf(limit_m).all() or (swath(scene.grid, scene.terrain, pair.aperture, beams=beams)[1] <= limit_m).all():
        return pair
    cell_m, _ = range_step(pair.frequency_hz, oversampling=1.0, wave_speed_m_s=pair.wave_speed_m_s)
    gate = RangeGate(limit_m, EDGE_CELLS * cell_m)
    path_m, illuminated, weight = _recorded(campaign, pair, scene, gate)
    if not illuminated.any():  # an error of the antennas, raised by `job_of`
        return pair
    if (illuminated & (weight > 0)).sum(axis=0).max() >= FEWEST:
        return replace(pair, gate=gate)
    where = f"flight {pair.flight}, pair {pair.name}"
    check_antennas(scene.grid, scene.terrain, pair.aperture, where=where)  # terrain above the antennas is the cause
    key, limit_name, hint = _limit_words(campaign)
    shortest_m = float(path_m[illuminated].min())
    raise CampaignError(
        f"echoes of the scene arrive after {limit_name} at {number_of(len(limit_m), 'pulse')}; shortest total path "
        f"{shortest_m:.1f} m: the scene is at least {shortest_m / 2000:.3g} km from the tracks",
        where=where,
        expected=f"at most {limit_m.max():.1f} m (c·{key} minus the path offsets), at {FEWEST} pulses of a pixel",
        remedy="Correct scene.bounds_m (easting before northing), scene.crs, the positions of the tracks, or the "
        "terrain height (scene.height_m, or unit and datum of scene.dem); or check path_offset_m and "
        f"{key}.{hint}",
    )


def recording_flags(campaign: Campaign, pair: OpenPair, scene: OpenScene) -> Flags:
    """Return the flag of a scene with pixels beyond the recorded range window of some pulses; empty without a gate."""
    if pair.gate is None:
        return Flags()
    path_m, illuminated, weight = _recorded(campaign, pair, scene, pair.gate)
    is_cut = illuminated & (weight < 1)
    pulses = round(is_cut.any(axis=1).mean() * len(pair.aperture))
    unrecorded = illuminated.any(axis=0) & ~(illuminated & (weight > 0)).any(axis=0)
    _, limit_name, hint = _limit_words(campaign)
    line = (
        f"{_percent(is_cut.any(axis=0).mean())} of the scene is not recorded by all of its pulses, "
        f"{_percent(unrecorded.mean())} by none: echoes arrive after {limit_name} at {pulses} of "
        f"{number_of(len(pair.aperture), 'pulse')}; longest total path {path_m[illuminated].max():.1f} m, "
        f"recorded up to {pair.path_limit_m:.1f} m{f'.{hint}' if hint else ''}"
    )
    return Flags({"scene_beyond_recording": line})


def _percent(share: float) -> str:
    """Return a share, sampled at points, in whole percent.

    Examples
    --------
    >>> _percent(0.2349), _percent(0.002), _percent(0.0)
    ('23 %', 'less than 1 %', '0 %')
    """
    return "less than 1 %" if 0 < share < 0.01 else f"{100 * share:.0f} %"


def _recorded(
    campaign: Campaign, pair: OpenPair, scene: OpenScene, gate: RangeGate
) -> tuple[NDArray[np.float64], NDArray[np.bool_], NDArray[np.float64]]:
    """Return total paths, illumination by antennas and sector, and weights of the gate, (pulse, point) of a sample."""
    pulses = slice(None, None, -(-len(pair.aperture) // _GATE_PULSES))
    aperture = pair.aperture[pulses]
    points_m = scene.terrain.positions_at(scene.grid, *scene.grid.sample_pixels(_GATE_POINTS)).reshape(-1, 3)
    beams = weighing(campaign, replace(pair, gate=None), scene)
    path_m = aperture.path(points_m)
    illuminated = np.ones(path_m.shape, bool) if beams is None else beams[pulses].weight(aperture, points_m) != 0
    return path_m, illuminated, gate[pulses].at(path_m)


def _limit_words(campaign: Campaign) -> tuple[str, str, str]:
    """Return key and name of the limit of recorded delays, and the hint at a default height."""
    waveform = campaign.settings.waveform
    hint = f" A likely cause: {HEIGHT_DEFAULT}." if campaign.settings.scene.height_is_default else ""
    if isinstance(waveform, SampledWaveform):
        return waveform.delay_key, waveform.limit_name, hint
    return "path_limit", "the recorded delays", hint


def ranges_of(campaign: Campaign, pair: OpenPair, scene: OpenScene) -> RangeWindow:
    """Return the ranges that the profiles of a pair from `gated` cover.

    Raises
    ------
    CampaignError
        If an antenna is below the terrain, or recorded echoes of the scene are ambiguous in range.
    """
    where = f"flight {pair.flight}, pair {pair.name}"
    check_antennas(scene.grid, scene.terrain, pair.aperture, where=where)
    window = RangeWindow.of(
        pair.aperture,
        scene.grid,
        scene.terrain,
        pair.frequency_hz,
        beams=weighing(campaign, pair, scene),
        wave_speed_m_s=pair.wave_speed_m_s,
    )
    _check_unambiguous(window, subcarriers=len(pair.frequency_hz))
    return window


def _check_unambiguous(window: RangeWindow, *, subcarriers: int) -> None:
    if window.unambiguous <= 2 * GUARD_SAMPLES:
        raise CampaignError(
            f"{subcarriers} subcarriers yield {window.unambiguous} range samples",
            where=f"{CONFIG}: waveform",
            expected=f"more than the {2 * GUARD_SAMPLES} samples that the image needs before and behind the scene",
            remedy="Use more subcarriers; of an FMCW radar, more samples of a sweep (waveform.settle_s, "
            "waveform.sweep_s, waveform.sample_rate_hz).",
        )
    if window.samples > window.unambiguous:
        spans_m, most_m = (
            (count - 2 * GUARD_SAMPLES) * window.step_m for count in (window.samples, window.unambiguous)
        )
        raise CampaignError(
            f"the scene spans {spans_m:.1f} m of total path",
            where=f"{CONFIG}: scene.bounds_m",
            expected=f"less than the unambiguous {most_m:.1f} m",
            remedy="Make the scene smaller.",
        )


def integration_of(campaign: Campaign, pair: OpenPair, scene: OpenScene) -> Integration:
    """Return the integration interval of a pair's pixels: the whole aperture or an angular sector."""
    centre_hz, requested = centre_frequency(pair.frequency_hz), campaign.settings.processing.integrated
    return decide_integration(
        pair.aperture, centre_hz, scene.grid, scene.level, antennas=pair.beams, requested=requested
    )


def check_fits(plan: Plan, *, free_disk: int | None, where: str, memory: int | None = None) -> None:
    """Check that a plan fits the memory and disk of this machine; raise CampaignError if not.

    Parameters
    ----------
    plan
        Plan of a pair.
    free_disk
        Free disk space, bytes; None: not checked.
    where
        Flight and pair, for messages.
    memory
        Available memory, bytes (default: of this machine, or of the control group of the process).
    """
    memory = memory or memory_limit()
    if plan.memory_bytes > memory:
        raise CampaignError(
            f"image formation requires {decimal(plan.memory_bytes)} of memory",
            where=where,
            expected=f"at most {decimal(memory)}, the memory of this machine or of the job",
            remedy="Make scene.bounds_m smaller, use fewer threads, or give the job more memory.",
        )
    if free_disk is not None and plan.disk_bytes > free_disk:
        raise CampaignError(
            f"the results require {decimal(plan.disk_bytes)} on disk",
            where=where,
            expected=f"at most {decimal(free_disk)}, the free disk space",
            remedy="Free disk space, make scene.bounds_m smaller or scene.spacing_m larger.",
        )
