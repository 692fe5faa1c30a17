"""`apertura design` and `apertura compare`: report on a flight plan, and comparison of a plan with its flight."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from apertura.campaign.folder import Campaign
from apertura.common.atomic import made_folder, write_text
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.errors import CampaignError
from apertura.core.geometry.geodesy import LOCAL
from apertura.core.quality.budget import expected
from apertura.formats.export.layers import OUTSIDE
from apertura.formats.export.map_layout import number
from apertura.formats.export.radiometry import TAG
from apertura.stages.pair import open_pair
from apertura.stages.refine import open_refined
from apertura.stages.scene import expected_scene
from apertura.tools.design import as_plan
from apertura.tools.design.expected_images import Design, designed
from apertura.tools.design.flight_plan import FlightPlan, MissionTrack, read_flight_plan
from apertura.tools.design.layers import UNITS, PlannedImage, planned_image
from apertura.tools.design.products import PICTURE_TAGS, copy_named, plan_text, write_design
from apertura.tools.design.requirements import (
    AXES,
    SHARE,
    Change,
    Tried,
    Verdict,
    helpful_changes,
    judge,
    refinement_line,
    search,
    tried_report,
)
from apertura.views.plan import first_flight
from apertura.views.quality import read_report
from apertura.views.report.page import Block, Heading, Paragraph, Picture, Table, page
from apertura.views.report.sheet import BLUE, GREY, ORANGE, RED, sheet
from apertura.workflow.stale import outdated_lines, without_outdated

if TYPE_CHECKING:
    from rich.table import Table as PrintedTable

PAGE, PLAN, PANELS, PARETO = "design.html", "plan.yaml", "layers.png", "pareto.png"
_SHOWN = ("resolution", "nesz", "point_snr", "incidence", "loss", "mask")
_TITLES = {
    "resolution": "coarsest resolution",
    "nesz": "NESZ",
    "point_snr": "SNR of a point",
    "loss": "focus loss, tracks as logged",
}
_DOTS = 400  # maximum number of pixels along the longer side of a panel
_MOST_CHANGES, _MOST_PLANS = 5, 12
_JUDGED = ("requirement", "required", "planned", "met", "image", "largest contribution")
_LISTED = {
    "resolution": "resolution, coarsest, m",
    "resolution_fine": "resolution, finest, m",
    "looks": "pulses",
    "incidence": "incidence, °",
    "bistatic_angle": "bistatic, °",
    "nesz": "NESZ, dB",
    "snr": "SNR, dB",
    "point_snr": "point SNR, dB",
    "ambiguity": "ambiguity",
    "loss": "loss, as logged, dB",
    "loss_refined": "loss, refined, dB",
}
"""Layer → column heading; layers that no image has are omitted."""

_LEAST = {"looks", "snr", "point_snr"}
_SMALLEST = 1e-3  # smaller values are printed as 0
_CAPTION = "Predicted images: median over the visible scene, and the value met by 95 % of the visible scene"


def print_design(path: Path, out: Path | None, *, optimise: str | None = None, threads: int = 1) -> bool:
    """Print the predictions for a plan and write them to a folder; return True if all requirements are met.

    Parameters
    ----------
    path
        PLAN.yaml.
    out
        Folder for layers, tracks, map, report and plan; None writes no files.
    optimise
        Keys of `AXES`, separated by commas: components of the track displacement that are optimised first, within the
        plan's bounds.
    threads
        Number of tiles computed in parallel.
    """
    from rich.console import Console

    console = Console(width=max(120, Console().width))
    plan, root = as_plan(path, None)
    tried: list[Tried] = []
    if optimise is not None:
        plan, tried = search(plan, root, [word for word in optimise.split(",") if word], threads=threads)
        moved = ", ".join(f"{key}: {getattr(plan.moved, key):.3g}" for key in AXES.values())
        console.print(f"Best of {len(tried)} valid plans: moved: {{{moved}}}", highlight=False)
    design = designed(plan, root, threads=threads)
    verdicts = judge(design)
    changes = helpful_changes(plan, root, verdicts, threads=threads)
    console.print(headline(verdicts, changes), highlight=False)
    console.print(_table(_CAPTION, *value_table(design)))
    if verdicts:
        console.print(_table("Requirements", _JUDGED, [verdict_row(verdict) for verdict in verdicts]))
    for line in (*interferogram_lines(design), *recording_lines(design), *change_lines(changes)):
        console.print(line, highlight=False)
    for name, image in design.images.items():
        for flag, line in image.flags.items() if image.looks is not None else ():
            console.print(f"[yellow]{flag}[/yellow]: {name}: {line}", highlight=False)
    if out is not None:
        out = made_folder(out)
        write_design(design, out, tried)
        write_text(out / PLAN, plan_text(plan))
        copy_named(plan, path.absolute().parent, out)
        _draw_layers(out / PANELS, design)
        if tried:
            draw_pareto(out / PARETO, tried)
        write_text(out / PAGE, page(f"{plan.campaign}, planned", _blocks(design, verdicts, changes, tried, out)))
        console.print(*(out / name for name in (PAGE, "coverage.png", PLAN)), sep="\n", highlight=False)
    return all(verdict.met for verdict in verdicts)


def _table(title: str, head: Sequence[str], rows: Sequence[Sequence[str]]) -> "PrintedTable":
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    table = Table(title=title, title_justify="left", box=SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
    for column, heading in enumerate(head):
        table.add_column(heading.replace(", ", "\n"), overflow="fold", no_wrap=column == 0)
    for row in rows:
        table.add_row(*row)
    return table


# ---- Text -----------------------------------------------------------------------------------------------------------


def headline(verdicts: Sequence[Verdict], changes: Sequence[Change]) -> str:
    """Return GO or NO-GO, with the missed requirements and the most helpful change.

    Examples
    --------
    >>> headline([Verdict("loss_db", 1.0, 0.3, "f01/a-a", "positions")], [])
    'GO: all requirements met (1 of 1)'
    >>> headline([Verdict("loss_db", 1.0, 4.4, "f01/a-a", "positions")], [])
    'NO-GO: loss_db 4.4 (required 1)'
    """
    if not verdicts:
        return "No verdict: the plan has no requirements (section require)"
    missed = [verdict for verdict in verdicts if not verdict.met]
    if not missed:
        return f"GO: all requirements met ({len(verdicts)} of {len(verdicts)})"
    values = ", ".join(
        f"{verdict.requirement} {_value(verdict.found)} (required {_value(verdict.required)})" for verdict in missed
    )
    change = f"; most helpful change: {changes[0].words}" if changes else ""
    return f"NO-GO: {values}{change}"


def value_table(design: Design) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Return header and rows of a table of all images: median, value met by 95 %, and visible share of the scene."""
    images = design.images.values()
    listed = [name for name in _LISTED if any(np.isfinite(image.layers.get(name, np.nan)).any() for image in images)]
    rows = list[tuple[str, ...]]()
    for image in images:
        visible = image.layers["mask"] == 0
        cells = []
        for name in listed:
            values = image.layers[name][visible] if name in image.layers else np.empty(0)
            values = values[np.isfinite(values)]
            worst = np.percentile(values, 5 if name in _LEAST else 95) if values.size else np.nan
            cells.append("\n".join(map(_digits, (np.median(values), worst))) if values.size else "")
        rows.append((image.name, *cells, f"{100 * visible.mean():.1f}"))
    return ("image", *(_LISTED[name] for name in listed), "visible, %"), rows


def _value(value: float | None) -> str:
    return "" if value is None else f"{value:.4g}"


def _digits(value: float) -> str:
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}" if abs(value) >= _SMALLEST else "0"


def interferogram_lines(design: Design) -> Iterator[str]:
    """Yield a line with the median coherence and height of ambiguity of each interferogram."""
    for name, layers in design.interferograms.items():
        units = {layer: "" if UNITS[layer][0] == "1" else f" {UNITS[layer][0]}" for layer in layers}
        medians = [f"{layer} {np.nanmedian(values):.3g}{units[layer]}" for layer, values in layers.items()]
        yield f"Interferogram {name}: {', '.join(medians)}"


def verdict_row(verdict: Verdict) -> tuple[str, ...]:
    """Return the table row of a verdict."""
    met = "yes" if verdict.met else f"no, {verdict.short_db:.2g} dB short"
    return verdict.requirement, f"{verdict.required:g}", f"{verdict.found:.4g}", met, verdict.image, verdict.cause


def recording_lines(design: Design) -> Iterator[str]:
    """Yield lines on the band, the imaged tracks, and the cost of recording and processing."""
    recording, opened = design.recording, design.opened
    low, high = (float(edge(opened.pairs[0].frequency_hz)) for edge in (np.min, np.max))
    wave_cm = 200 * SPEED_OF_LIGHT_M_S / (low + high)
    yield (
        f"Band {low / 1e9:.4f} to {high / 1e9:.4f} GHz, bandwidth {(high - low) / 1e6:.1f} MHz; centre wavelength "
        f"{wave_cm:.2f} cm"
    )
    for flight, duration_s in recording.flight_s.items():
        rates = recording.node_bytes_s[flight]
        each = ", ".join(f"{node} {rate / 1e6:.3g} MB/s" for node, rate in rates.items())
        planned = opened.plan.flights[flight]
        flown, track = opened.courses[flight][planned.transmitter], planned.tracks.get(planned.transmitter)
        imaged_s = sum(end - begin for begin, end in flown.imaged_s)
        image = track.image if isinstance(track, MissionTrack) else None
        waypoints = f", waypoints {image[0]} to {image[1]}" if image else ""
        transfer_s = recording.transfer_s[flight]
        parts = (
            f"including {transfer_s:.0f} s of take-off, transit and landing (climb_m_s: {planned.climb_m_s:g} m/s)"
            if transfer_s
            else "without take-off and landing, because the plan has no home"
        )
        yield (
            f"Flight {flight}: imaged part {flown.imaged_m:.1f} m in {imaged_s:.1f} s{waypoints}; flight time "
            f"{duration_s:.0f} s, {parts}; {recording.pulses[flight]} pulses; {each}"
        )
        refinement = design.refinements[flight]
        yield (
            f"Flight {flight}: focus loss {_loss(design, flight, 'loss')} with the tracks as logged, "
            f"{_loss(design, flight, 'loss_refined')} after refinement; autofocus {refinement.decision.value} "
            f"({refinement.decision.reason}); {refinement_line(design, flight)}"
        )
    dopplers = {image.name: image.doppler_hz for image in design.images.values() if image.looks is not None}
    prf = float(getattr(opened.plan.waveform, "prf_hz", None) or 0.0)
    ambiguous = ", exceeded by the Doppler spread; relative power of ambiguous echoes: ambiguity.tif" * (
        max(dopplers.values()) > prf
    )
    each = ", ".join(f"{name} {hz:.0f}" for name, hz in dopplers.items())
    yield f"Doppler spread over the scene, Hz: {each}; pulse rate {prf:g} Hz{ambiguous}"
    pulses = float(np.median([np.nanmedian(image.layers["looks"]) for image in design.judged]))
    yield (
        f"{pulses:.0f} pulses are integrated for a pixel of {opened.scene.grid.spacing_m:g} m; with a smaller "
        "scene.spacing_m, more pulses are integrated if the track is long enough"
    )
    processing = _duration_text(recording.processing_s)
    yield (
        f"Recorded data: {recording.recorded_bytes / 1e9:.3g} GB; processing: about {processing} with "
        f"{recording.memory_bytes / 1e9:.2g} GB of memory"
    )


def _loss(design: Design, flight: str, layer: str) -> str:
    """Return the loss that 95 % of the visible scene do not exceed, in the image to which requirements apply."""
    image = next(image for image in design.judged if image.name.startswith(f"{flight}/"))
    values = image.layers[layer][image.layers["mask"] == 0]
    return f"{np.percentile(values, SHARE):.2f} dB" if values.size and np.isfinite(values).all() else "not predicted"


def _duration_text(seconds: float) -> str:
    for unit, size in (("h", 3600), ("min", 60)):
        if seconds >= size:
            return f"{seconds / size:.2g} {unit}"
    return f"{seconds:.0f} s"


def _values_text(change: Change) -> str:
    return ", ".join(f"{name} {value:.4g}" for name, value in change.found.items())


def change_lines(changes: Sequence[Change]) -> Iterator[str]:
    """Yield a line for each of the most helpful single changes."""
    for rank, change in enumerate(changes[:_MOST_CHANGES], 1):
        effect = ", all requirements met" if change.meets else ""
        effect += f", but no longer met: {', '.join(change.breaks)}" if change.breaks else ""
        yield (
            f"{rank}. {change.words}: reduces the shortfall by {change.gain_db:.2g} dB{effect} ({_values_text(change)})"
        )


def _blocks(
    design: Design, verdicts: Sequence[Verdict], changes: Sequence[Change], tried: Sequence[Tried], out: Path
) -> Iterator[Block]:
    plan = design.opened.plan
    yield Heading(1, f"{plan.campaign}: flight plan")
    yield Paragraph(f"{headline(verdicts, changes)}.")
    if verdicts:
        caption = "Requirements, to be met by 95 % of the visible scene."
        yield Table(caption, _JUDGED, [verdict_row(verdict) for verdict in verdicts])
    if changes:
        yield Table(
            "Single changes, most helpful first.",
            ("change", "shortfall reduced by", "all met", "predicted values"),
            [
                (
                    change.words,
                    f"{change.gain_db:.2g} dB",
                    "yes" if change.meets else f"no{_newly_missed(change)}",
                    _values_text(change),
                )
                for change in changes[:_MOST_CHANGES]
            ],
        )
    yield Picture((out / "coverage.png").read_bytes(), "Tracks and visible areas.")
    yield Picture((out / PANELS).read_bytes(), f"Layers of {design.judged[0].name}; white: not visible.")
    if tried:
        yield Picture((out / PARETO).read_bytes(), "Plans tried by the search; Pareto-optimal plans are marked.")
        plans = tried_report(tried)[:_MOST_PLANS]
        head = (*(f"moved.{key}" for key in plans[0]["moved"]), *plans[0]["found"])
        rows = [[_value(value) for value in (*trial["moved"].values(), *trial["found"].values())] for trial in plans]
        yield Table("Pareto-optimal plans, the selected plan first; complete list: design.json.", head, rows)
    yield Table(f"{_CAPTION}.", *value_table(design))
    yield Paragraph(" ".join(f"{line}." for line in (*interferogram_lines(design), *recording_lines(design))))
    for image in design.images.values():
        if image.budget:
            counted = [line for line in image.budget if line.counts]
            budget_lines = [
                (
                    line.cause,
                    line.stated or line.assumed or "",
                    f"{line.effect.loss_db:.2f}",
                    _digits(100 * line.effect.shift_m),
                )
                for line in counted
            ]
            total_db = expected(image.budget).loss_db
            caption = f"Error budget of {image.name} at the scene centre; total loss {total_db:.2f} dB."
            yield Table(caption, ("cause", "error", "loss, dB", "displacement, cm"), budget_lines)
            break
    raised = [
        (flag, name, line) for name, image in design.images.items() if image.looks for flag, line in image.flags.items()
    ]
    if raised:
        yield Table("Flags raised.", ("flag", "image", "measurement"), raised)


def _newly_missed(change: Change) -> str:
    return f"; no longer met: {', '.join(change.breaks)}" if change.breaks else ""


# ---- Plots ----------------------------------------------------------------------------------------------------------


def _draw_layers(path: Path, design: Design) -> None:
    """Plot layers of the first image to which requirements apply, north-up."""
    from matplotlib.colors import BoundaryNorm, ListedColormap

    image, grid = design.judged[0], design.opened.scene.grid
    pair = next(image for image in design.images.values() if image.looks is not None)
    layers = {name: image.layers.get(name, pair.layers.get(name)) for name in _SHOWN}
    shown_layers: dict[str, NDArray[Any]] = {name: values for name, values in layers.items() if values is not None}
    shown_layers = {
        name: values for name, values in shown_layers.items() if np.isfinite(values.astype(np.float64)).any()
    }
    west, south, east, north = grid.bounds_m
    size = east - west, north - south
    rows = -(-len(shown_layers) // 2)
    high = 2.1 * min(1.6, max(0.45, size[1] / size[0]))
    step = max(1, max(grid.shape) // _DOTS)
    across, up = ("x", "y") if grid.crs == LOCAL else ("east", "north")
    with sheet(path, 0.5 + rows * (high + 0.55), title=f"layers of {image.name}", tags=PICTURE_TAGS) as figure:
        drawn = figure.subplots(rows, 2, squeeze=False)
        for axes, (name, values) in zip(drawn.flat, shown_layers.items(), strict=False):
            axes.grid(visible=False)
            extent = (0, size[0], 0, size[1])
            shown = np.ma.masked_invalid(values[::step, ::step].astype(np.float64))
            if name == "mask":
                colours = ListedColormap(["#dddddd", "#2d3773", "#e17814", "#96143c", "#ffffff"])
                shown = np.ma.masked_invalid(np.where(shown == OUTSIDE, 4, shown))
                norm = BoundaryNorm(np.arange(-0.5, 5), 5)
                picture = axes.imshow(shown, extent=extent, cmap=colours, norm=norm, interpolation="nearest")
                bar = figure.colorbar(picture, ax=axes, ticks=range(5), shrink=0.8)
                bar.ax.set_yticklabels(["visible", "shadow", "layover", "both", "outside"])
            else:
                visible = np.ma.masked_where(image.layers["mask"][::step, ::step] != 0, shown)
                limits = dict(zip(("vmin", "vmax"), _colour_limits(visible), strict=True))
                picture = axes.imshow(visible, extent=extent, cmap="viridis", interpolation="nearest", **limits)
                figure.colorbar(picture, ax=axes, shrink=0.8).set_label(UNITS[name][0])
            axes.set_title(_TITLES.get(name, name))
        for axes in list(drawn.flat)[len(shown_layers) :]:
            axes.set_axis_off()
        for axes in drawn[-1]:
            axes.set_xlabel(f"{across}, m")
        for axes in drawn[:, 0]:
            axes.set_ylabel(f"{up}, m")
        origin = f"{number(round(west))} m, {number(round(south))} m"
        figure.suptitle(f"{image.name}; {across} and {up} relative to {origin}")


def _colour_limits(values: NDArray[np.float64]) -> tuple[float, float]:
    """Return the colour limits of a layer, which span at least 1 % of its magnitude so that labels stay short.

    Examples
    --------
    >>> _colour_limits(np.array([1.0, 3.0])), _colour_limits(np.array([2.0, 2.0]))
    ((1.0, 3.0), (1.99, 2.01))
    """
    finite = np.ma.compressed(values)
    low, high = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 1.0)
    margin = max(0.0, 0.01 * max(abs(low), abs(high)) - (high - low)) / 2
    return low - margin, high + margin


def draw_pareto(path: Path, tried: Sequence[Tried]) -> None:
    """Plot the plans tried by a search over two requirements, with the Pareto-optimal and the selected plans."""
    required = [verdict.requirement for verdict in tried[0].verdicts if verdict.required is not None]
    others = [verdict.requirement for verdict in tried[0].verdicts if verdict.requirement not in required]
    names = [*required, *others]
    spread = {name: np.ptp([_predicted(trial, name) for trial in tried]) for name in names}
    names = [name for name in names if np.isfinite(spread[name]) and spread[name] > 0] or names
    across, up = (*names, *names)[:2]
    limits = {verdict.requirement: verdict.required for verdict in tried[0].verdicts}
    with sheet(path, 4.2, title="plans tried", tags=PICTURE_TAGS) as figure:
        axes = figure.add_subplot()
        for front, colour, label in ((False, GREY, "tried"), (True, BLUE, "Pareto-optimal")):
            trials = [trial for trial in tried if trial.on_front == front]
            axes.plot(
                *_at(trials, across, up), "o", color=colour, markersize=5 if front else 3, linestyle="none", label=label
            )
        best = min(tried, key=lambda trial: trial.objective)
        axes.plot(*_at([best], across, up), "*", color=RED, markersize=14, linestyle="none", label="selected")
        if limits[across] is not None:
            axes.axvline(float(limits[across] or 0), color=ORANGE, linestyle="--", label="required")
        if limits[up] is not None:
            axes.axhline(float(limits[up] or 0), color=ORANGE, linestyle="--")
        axes.set_xlabel(across)
        axes.set_ylabel(up)
        axes.legend()


def _predicted(trial: Tried, name: str) -> float:
    return next((verdict.found for verdict in trial.verdicts if verdict.requirement == name), float("nan"))


def _at(tried: Sequence[Tried], across: str, up: str) -> tuple[list[float], list[float]]:
    return [_predicted(trial, across) for trial in tried], [_predicted(trial, up) for trial in tried]


# ---- Planned and flown ----------------------------------------------------------------------------------------------


def print_comparison(path: Path, folder: Path, *, threads: int = 1) -> None:
    """Print planned values next to values from the logs of the campaign and, if available, measured in its images."""
    from rich.console import Console

    plan, campaign = read_flight_plan(path), without_outdated(Campaign.load(folder))
    campaign.check_images()
    rows = comparison_rows(plan, path.absolute().parent, campaign, threads=threads)
    head = ("image", "quantity", "planned", "flown (from the logs)", "measured in the image")
    console = Console(width=max(120, Console().width))
    title = "Planned and flown values; the measured resolution is the width of the brightest point"
    console.print(_table(title, head, rows))
    for line in outdated_lines(campaign):
        console.print(line, highlight=False)
    planned, flown = (waveform.model_dump() for waveform in (plan.waveform, campaign.settings.waveform))
    for key, value in planned.items():
        if isinstance(value, int | float) and flown.get(key) != value:
            line = f"waveform.{key}: {_value(value)} planned, {_value(flown.get(key)) or 'not set'} in the campaign"
            console.print(f"[yellow]different radar[/yellow]: {line}", highlight=False)


def comparison_rows(plan: FlightPlan, root: Path, campaign: Campaign, *, threads: int = 1) -> list[tuple[str, ...]]:
    """Return table rows (image, quantity, planned, flown, measured) for every pair of both the plan and the campaign.

    Parameters
    ----------
    plan, root
        The plan, and its folder.
    campaign
        A campaign with logs and recordings.
    threads
        Number of tiles computed in parallel.

    Raises
    ------
    CampaignError
        If the plan and the campaign have no flight and pair in common.
    """
    design = designed(plan, root, threads=threads)
    scene = expected_scene(campaign, lambda: first_flight(campaign))
    rows = list[tuple[str, ...]]()
    for flight in campaign.image_flights:
        for pair in flight.pairs:
            planned = design.images.get(f"{flight.name}/{pair}")
            if planned is None:
                continue
            opened = open_pair(campaign, flight.name, pair)
            if campaign.is_current(campaign.stage("refined_track", flight.name)):
                opened = open_refined(campaign, flight.name).pair(opened)
            flown = planned_image(
                campaign,
                opened,
                scene,
                sigma0_db=plan.expect.sigma0_db,
                rcs_dbsm=plan.expect.rcs_dbsm,
                threads=threads,
            )
            measured = _measured(campaign, flight.name, pair)
            planned_pair = next(
                candidate
                for candidate in design.opened.pairs
                if (candidate.flight, candidate.name) == (flight.name, pair)
            )
            numbers = [_numbers(planned), _numbers(flown)]
            pulses = [float(len(track.time_s)) for track in (planned_pair, opened)]
            speeds = [
                float(
                    np.median(np.linalg.norm(np.diff(track.aperture.middle_m, axis=0), axis=1) / np.diff(track.time_s))
                )
                for track in (planned_pair, opened)
            ]
            numbers[0] |= {"pulses": pulses[0], "speed, m/s": speeds[0]}
            numbers[1] |= {"pulses": pulses[1], "speed, m/s": speeds[1]}
            for name, value in numbers[0].items():
                measured_value = measured.get(name)
                values = value, numbers[1].get(name, np.nan)
                texts = ["" if np.isnan(entry) else f"{entry:.4g}" for entry in values]
                rows.append(
                    (f"{flight.name}/{pair}", name, *texts, "" if measured_value is None else f"{measured_value:.4g}")
                )
    if not rows:
        raise CampaignError(
            f"images {', '.join(design.images)}, none of which is in the campaign",
            "the plan",
            f"at least one image of campaign {campaign.root.name}",
            "Name flights and nodes as in the campaign.",
        )
    return rows


def _numbers(image: PlannedImage) -> dict[str, float]:
    """Return the predicted values of an image for the comparison: medians over the visible scene."""
    visible = image.layers["mask"] == 0
    numbers = {"coverage, %": 100 * float(visible.mean())}
    for name in ("resolution", "resolution_fine", "looks", "incidence", "bistatic_angle", "nesz", "point_snr"):
        values = image.layers[name][visible] if name in image.layers else np.empty(0)
        values = values[np.isfinite(values)]
        if values.size:
            numbers[f"{name}, {UNITS[name][0]}"] = float(np.median(values))
    return numbers | {"loss, dB": -expected(image.budget).loss_db}


def _measured(campaign: Campaign, flight: str, pair: str) -> Mapping[str, float]:
    """Return the values of `_numbers` measured in a finished image; empty if the image is not up to date."""
    from apertura.common.raster import opened_raster

    if not campaign.is_current(campaign.result(flight, pair, "export")):
        return {}
    report = read_report(campaign, flight, pair)
    measured: dict[str, float] = {}
    brightest = report.get("brightest") or {}
    axes = ("ground_range_width_m", "cross_range_width_m")
    widths = [float(brightest[axis]) for axis in axes if brightest.get(axis) is not None]
    if report["focus"].get("verdict") == "focused" and len(widths) == len(axes):
        measured |= {"resolution, m": max(widths), "resolution_fine, m": min(widths)}
    if report["focus"].get("loss_db") is not None:
        measured["loss, dB"] = -float(report["focus"]["loss_db"])
    for name in ("looks", "incidence", "bistatic_angle", "nesz"):
        with opened_raster(
            campaign.result(flight, pair, f"{name}.tif"), expected="a layer", remedy="Run the workflow again."
        ) as raster:
            if name == "nesz" and TAG not in raster.tags():
                continue  # uncalibrated: dB of image power instead of sigma0
            values = raster.read(1, masked=True).compressed()
        values = values[np.isfinite(values)]
        if values.size:
            measured[f"{name}, {UNITS[name][0]}"] = float(np.median(values))
    mask = campaign.result(flight, pair, "mask.tif")
    with opened_raster(mask, expected="a layer", remedy="Run the workflow again.") as raster:
        measured["coverage, %"] = 100 * float((raster.read(1) == 0).mean())
    return measured
