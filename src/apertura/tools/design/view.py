"""Commands `apertura design` and `apertura compare`: expected images of a planned flight, against those flown."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from apertura.campaign.folder import Campaign
from apertura.common.atomic import made_folder, write_text
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.errors import CampaignError, number_of
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
_DOTS = 400  # of the longer side of a panel
_MOST_CHANGES, _MOST_PLANS = 5, 12
_JUDGED = ("requirement", "required", "planned", "met", "image", "largest contribution")
_LISTED = {
    "resolution": "coarsest, m",
    "resolution_fine": "finest, m",
    "looks": "pulses",
    "incidence": "incidence, °",
    "bistatic_angle": "bistatic, °",
    "nesz": "NESZ, dB",
    "snr": "SNR, dB",
    "point_snr": "point's SNR, dB",
    "ambiguity": "folded",
    "loss": "loss as logged, dB",
    "loss_refined": "loss refined, dB",
}
"""Layer → head of its column; those that no image has are left out."""

_LEAST = {"looks", "snr", "point_snr"}
_SMALLEST = 1e-3  # of a share, printed as 0 below
_CAPTION = "Planned images: median over the visible scene, and the value that 95 % of it reach"


def print_design(path: Path, out: Path | None, *, optimise: str | None = None, threads: int = 1) -> bool:
    """Print what a plan gives, write it where a folder is named; return whether all that is required is met.

    Parameters
    ----------
    path
        PLAN.yaml.
    out
        Folder for layers, tracks, map, report and the plan as it is; None: nothing is written.
    optimise
        Words of `AXES`, joined by commas: tracks are moved by them within the plan's bounds first.
    threads
        Tiles computed at once.
    """
    from rich.console import Console

    console = Console(width=max(120, Console().width))
    plan, root = as_plan(path, None)
    tried: list[Tried] = []
    if optimise is not None:
        plan, tried = search(plan, root, [word for word in optimise.split(",") if word], threads=threads)
        moved = ", ".join(f"{key}: {getattr(plan.moved, key):.3g}" for key in AXES.values())
        console.print(f"Best of {len(tried)} plans that can be flown: moved: {{{moved}}}", highlight=False)
    design = designed(plan, root, threads=threads)
    verdicts = judge(design)
    changes = helpful_changes(plan, root, verdicts, threads=threads)
    console.print(headline(verdicts, changes), highlight=False)
    console.print(_table(_CAPTION, *value_table(design)))
    if verdicts:
        console.print(_table("Requirements", _JUDGED, [verdict_row(one) for one in verdicts]))
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
    for at, heading in enumerate(head):
        table.add_column(heading.replace(", ", "\n"), overflow="fold", no_wrap=not at)
    for row in rows:
        table.add_row(*row)
    return table


# ---- Words ----------------------------------------------------------------------------------------------------------


def headline(verdicts: Sequence[Verdict], changes: Sequence[Change]) -> str:
    """Return go or no-go, with the requirements missed and the change that helps most.

    Examples
    --------
    >>> headline([Verdict("loss_db", 1.0, 0.3, "f01/a-a", "positions")], [])
    'GO: all of 1 requirement met'
    >>> headline([Verdict("loss_db", 1.0, 4.4, "f01/a-a", "positions")], [])
    'NO-GO: loss_db 4.4 (required 1)'
    """
    if not verdicts:
        return "No verdict: the plan states no requirement (section require)"
    missed = [one for one in verdicts if not one.met]
    if not missed:
        return f"GO: all of {number_of(len(verdicts), 'requirement')} met"
    found = ", ".join(f"{one.requirement} {_value(one.found)} (required {_value(one.required)})" for one in missed)
    helps = f"; most helpful change: {changes[0].words}" if changes else ""
    return f"NO-GO: {found}{helps}"


def value_table(design: Design) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Return head and rows of images, pairs and sums: median of what is seen, what 95 % have, share that is seen."""
    images = design.images.values()
    listed = [name for name in _LISTED if any(np.isfinite(one.layers.get(name, np.nan)).any() for one in images)]
    rows = list[tuple[str, ...]]()
    for image in images:
        seen = image.layers["mask"] == 0
        cells = []
        for name in listed:
            values = image.layers[name][seen] if name in image.layers else np.empty(0)
            values = values[np.isfinite(values)]
            worst = np.percentile(values, 5 if name in _LEAST else 95) if values.size else np.nan
            cells.append("\n".join(map(_digits, (np.median(values), worst))) if values.size else "")
        rows.append((image.name, *cells, f"{100 * seen.mean():.1f}"))
    return ("image", *(_LISTED[name] for name in listed), "visible, %"), rows


def _value(value: float | None) -> str:
    return "" if value is None else f"{value:.4g}"


def _digits(value: float) -> str:
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}" if abs(value) >= _SMALLEST else "0"


def interferogram_lines(design: Design) -> Iterator[str]:
    """Yield coherence and height of ambiguity in the middle of each interferogram."""
    for name, layers in design.interferograms.items():
        units = {layer: "" if UNITS[layer][0] == "1" else f" {UNITS[layer][0]}" for layer in layers}
        medians = [f"{layer} {np.nanmedian(values):.3g}{units[layer]}" for layer, values in layers.items()]
        yield f"Interferogram {name}: {', '.join(medians)}"


def verdict_row(verdict: Verdict) -> tuple[str, ...]:
    """Return a verdict as text."""
    met = "yes" if verdict.met else f"no, {verdict.short_db:.2g} dB short"
    return verdict.requirement, f"{verdict.required:g}", f"{verdict.found:.4g}", met, verdict.image, verdict.cause


def recording_lines(design: Design) -> Iterator[str]:
    """Yield band, imaged part of the tracks, and cost of recording and processing."""
    recording, opened = design.recording, design.opened
    low, high = (float(edge(opened.pairs[0].frequency_hz)) for edge in (np.min, np.max))
    wave_cm = 200 * SPEED_OF_LIGHT_M_S / (low + high)
    yield (
        f"Band {low / 1e9:.4f} to {high / 1e9:.4f} GHz, {(high - low) / 1e6:.1f} MHz wide; wavelength {wave_cm:.2f} cm "
        "at its centre"
    )
    for flight, lasting_s in recording.flight_s.items():
        rates = recording.node_bytes_s[flight]
        each = ", ".join(f"{node} {rate / 1e6:.3g} MB/s" for node, rate in rates.items())
        planned = opened.plan.flights[flight]
        flown, track = opened.courses[flight][planned.transmitter], planned.tracks.get(planned.transmitter)
        imaged_s = sum(end - begin for begin, end in flown.imaged_s)
        image = track.image if isinstance(track, MissionTrack) else None
        waypoints = f", waypoints {image[0]} to {image[1]}" if image else ""
        transfer_s = recording.transfer_s[flight]
        parts = (
            f"with {transfer_s:.0f} s of take-off, transit and landing at {planned.climb_m_s:g} m/s"
            if transfer_s
            else "without take-off and landing: the plan states no home"
        )
        yield (
            f"Flight {flight}: imaged along {flown.imaged_m:.1f} m in {imaged_s:.1f} s{waypoints}; {lasting_s:.0f} s "
            f"in the air, {parts}; {recording.pulses[flight]} pulses; {each}"
        )
        refinement = design.refinements[flight]
        yield (
            f"Flight {flight}: focus loss {_loss(design, flight, 'loss')} with the tracks as logged, "
            f"{_loss(design, flight, 'loss_refined')} after refinement; autofocus {refinement.decision.value} "
            f"({refinement.decision.reason}); {refinement_line(design, flight)}"
        )
    dopplers = {one.name: one.doppler_hz for one in design.images.values() if one.looks is not None}
    prf = float(getattr(opened.plan.waveform, "prf_hz", None) or 0.0)
    folds = "; above the pulse rate: echoes fold, ambiguity.tif holds their share" * (max(dopplers.values()) > prf)
    each = ", ".join(f"{name} {hz:.0f}" for name, hz in dopplers.items())
    yield f"Doppler spread over the scene, Hz: {each}; pulse rate {prf:g} Hz{folds}"
    pulses = float(np.median([np.nanmedian(one.layers["looks"]) for one in design.judged]))
    yield (
        f"A pixel of {opened.scene.grid.spacing_m:g} m integrates {pulses:.0f} pulses; a smaller scene.spacing_m "
        "integrates more, where more is flown"
    )
    processing = _duration_text(recording.processing_s)
    yield (
        f"Recorded data {recording.recorded_bytes / 1e9:.3g} GB; processing about {processing}, "
        f"{recording.memory_bytes / 1e9:.2g} GB of memory"
    )


def _loss(design: Design, flight: str, layer: str) -> str:
    """Return a loss of the image of a flight that requirements are of, as 95 % of the visible scene has it."""
    image = next(one for one in design.judged if one.name.startswith(f"{flight}/"))
    values = image.layers[layer][image.layers["mask"] == 0]
    return f"{np.percentile(values, SHARE):.2f} dB" if values.size and np.isfinite(values).all() else "not known"


def _duration_text(seconds: float) -> str:
    for unit, size in (("h", 3600), ("min", 60)):
        if seconds >= size:
            return f"{seconds / size:.2g} {unit}"
    return f"{seconds:.0f} s"


def _values_text(change: Change) -> str:
    return ", ".join(f"{name} {value:.4g}" for name, value in change.found.items())


def change_lines(changes: Sequence[Change]) -> Iterator[str]:
    """Yield the single changes that help most."""
    for place, change in enumerate(changes[:_MOST_CHANGES], 1):
        then = ", all requirements met" if change.meets else ""
        then += f", but no longer met: {', '.join(change.breaks)}" if change.breaks else ""
        yield f"{place}. {change.words}: {change.gain_db:.2g} dB closer{then} ({_values_text(change)})"


def _blocks(
    design: Design, verdicts: Sequence[Verdict], changes: Sequence[Change], tried: Sequence[Tried], out: Path
) -> Iterator[Block]:
    plan = design.opened.plan
    yield Heading(1, f"{plan.campaign}: flight plan")
    yield Paragraph(f"{headline(verdicts, changes)}.")
    if verdicts:
        caption = "Requirements; each must hold for 95 % of the visible scene."
        yield Table(caption, _JUDGED, [verdict_row(one) for one in verdicts])
    if changes:
        yield Table(
            "Single changes, most helpful first.",
            ("change", "closer by", "all met", "result"),
            [
                (
                    change.words,
                    f"{change.gain_db:.2g} dB",
                    "yes" if change.meets else ", nor ".join(("no", *change.breaks)),
                    _values_text(change),
                )
                for change in changes[:_MOST_CHANGES]
            ],
        )
    yield Picture((out / "coverage.png").read_bytes(), "Tracks and visible areas.")
    yield Picture((out / PANELS).read_bytes(), f"Layers of {design.judged[0].name}; white: not visible.")
    if tried:
        yield Picture((out / PARETO).read_bytes(), "Plans tried by the search, and the Pareto-optimal ones.")
        plans = tried_report(tried)[:_MOST_PLANS]
        head = (*(f"moved.{key}" for key in plans[0]["moved"]), *plans[0]["found"])
        rows = [[_value(value) for value in (*one["moved"].values(), *one["found"].values())] for one in plans]
        yield Table("Pareto-optimal plans, the chosen one first; design.json holds all.", head, rows)
    yield Table(f"{_CAPTION}.", *value_table(design))
    yield Paragraph(" ".join(f"{line}." for line in (*interferogram_lines(design), *recording_lines(design))))
    for image in design.images.values():
        if image.budget:
            counted = [one for one in image.budget if one.counts]
            sizes = [one.stated or one.assumed or "" for one in counted]
            effects = [(f"{one.effect.loss_db:.2f}", _digits(100 * one.effect.shift_m)) for one in counted]
            lines = [(one.cause, size, *effect) for one, size, effect in zip(counted, sizes, effects, strict=True)]
            caption = (
                f"Error budget of {image.name}, in the middle of the scene: {expected(image.budget).loss_db:.2f} dB."
            )
            yield Table(caption, ("cause", "size", "loss, dB", "shift, cm"), lines)
            break
    raised = [
        (flag, name, line) for name, one in design.images.items() if one.looks for flag, line in one.flags.items()
    ]
    if raised:
        yield Table("Flags raised.", ("flag", "image", "measured"), raised)


# ---- Pictures -------------------------------------------------------------------------------------------------------


def _draw_layers(path: Path, design: Design) -> None:
    """Draw the layers of the first image that requirements are of, north-up."""
    from matplotlib.colors import BoundaryNorm, ListedColormap

    image, grid = design.judged[0], design.opened.scene.grid
    pair = next(one for one in design.images.values() if one.looks is not None)
    layers = {name: image.layers.get(name, pair.layers.get(name)) for name in _SHOWN}
    found: dict[str, NDArray[Any]] = {name: values for name, values in layers.items() if values is not None}
    found = {name: values for name, values in found.items() if np.isfinite(values.astype(np.float64)).any()}
    west, south, east, north = grid.bounds_m
    size = east - west, north - south
    rows = -(-len(found) // 2)
    high = 2.1 * min(1.6, max(0.45, size[1] / size[0]))
    step = max(1, max(grid.shape) // _DOTS)
    across, up = ("x", "y") if grid.crs == LOCAL else ("east", "north")
    with sheet(path, 0.5 + rows * (high + 0.55), title=f"layers of {image.name}", tags=PICTURE_TAGS) as figure:
        drawn = figure.subplots(rows, 2, squeeze=False)
        for axes, (name, values) in zip(drawn.flat, found.items(), strict=False):
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
                seen = np.ma.masked_where(image.layers["mask"][::step, ::step] != 0, shown)
                ends = dict(zip(("vmin", "vmax"), _ends(seen), strict=True))
                picture = axes.imshow(seen, extent=extent, cmap="viridis", interpolation="nearest", **ends)
                figure.colorbar(picture, ax=axes, shrink=0.8).set_label(UNITS[name][0])
            axes.set_title(_TITLES.get(name, name))
        for axes in list(drawn.flat)[len(found) :]:
            axes.set_axis_off()
        for axes in drawn[-1]:
            axes.set_xlabel(f"{across}, m")
        for axes in drawn[:, 0]:
            axes.set_ylabel(f"{up}, m")
        figure.suptitle(f"{image.name}, {across} and {up} from {number(round(west))} m, {number(round(south))} m")


def _ends(values: NDArray[np.float64]) -> tuple[float, float]:
    """Return the colour limits of a layer: at least a hundredth of its size apart, so that labels stay short.

    Examples
    --------
    >>> _ends(np.array([1.0, 3.0])), _ends(np.array([2.0, 2.0]))
    ((1.0, 3.0), (1.99, 2.01))
    """
    known = np.ma.compressed(values)
    low, high = (float(known.min()), float(known.max())) if known.size else (0.0, 1.0)
    more = max(0.0, 0.01 * max(abs(low), abs(high)) - (high - low)) / 2
    return low - more, high + more


def draw_pareto(path: Path, tried: Sequence[Tried]) -> None:
    """Draw the plans that a search tried over two requirements, those that no other beats, and the one taken."""
    required = [one.requirement for one in tried[0].verdicts if one.required is not None]
    names = [*required, *(one.requirement for one in tried[0].verdicts if one.requirement not in required)]
    spread = {name: np.ptp([_found(one, name) for one in tried]) for name in names}
    names = [name for name in names if np.isfinite(spread[name]) and spread[name] > 0] or names
    across, up = (*names, *names)[:2]
    limits = {one.requirement: one.required for one in tried[0].verdicts}
    with sheet(path, 4.2, title="plans tried", tags=PICTURE_TAGS) as figure:
        axes = figure.add_subplot()
        for front, colour, label in ((False, GREY, "tried"), (True, BLUE, "none is better in all that is required")):
            some = [one for one in tried if one.on_front == front]
            axes.plot(
                *_at(some, across, up), "o", color=colour, markersize=5 if front else 3, linestyle="none", label=label
            )
        best = min(tried, key=lambda one: one.objective)
        axes.plot(*_at([best], across, up), "*", color=RED, markersize=14, linestyle="none", label="taken")
        if limits[across] is not None:
            axes.axvline(float(limits[across] or 0), color=ORANGE, linestyle="--", label="required")
        if limits[up] is not None:
            axes.axhline(float(limits[up] or 0), color=ORANGE, linestyle="--")
        axes.set_xlabel(across)
        axes.set_ylabel(up)
        axes.legend()


def _found(one: Tried, name: str) -> float:
    return next((verdict.found for verdict in one.verdicts if verdict.requirement == name), float("nan"))


def _at(tried: Sequence[Tried], across: str, up: str) -> tuple[list[float], list[float]]:
    return [_found(one, across) for one in tried], [_found(one, up) for one in tried]


# ---- Planned and flown ----------------------------------------------------------------------------------------------


def print_comparison(path: Path, folder: Path, *, threads: int = 1) -> None:
    """Print planned and flown side by side: by the logs of the campaign, and by its images where there are any."""
    from rich.console import Console

    plan, campaign = read_flight_plan(path), without_outdated(Campaign.load(folder))
    campaign.check_images()
    rows = comparison_rows(plan, path.absolute().parent, campaign, threads=threads)
    head = ("image", "quantity", "planned", "flown (from the logs)", "measured in the image")
    console = Console(width=max(120, Console().width))
    console.print(_table("Planned and flown; measured resolution: widths of the brightest point", head, rows))
    for line in outdated_lines(campaign):
        console.print(line, highlight=False)
    planned, flown = (one.model_dump() for one in (plan.waveform, campaign.settings.waveform))
    for key, value in planned.items():
        if isinstance(value, int | float) and flown.get(key) != value:
            line = f"waveform.{key}: {_value(value)} planned, {_value(flown.get(key)) or 'none'} in the campaign"
            console.print(f"[yellow]another radar[/yellow]: {line}", highlight=False)


def comparison_rows(plan: FlightPlan, root: Path, campaign: Campaign, *, threads: int = 1) -> list[tuple[str, ...]]:
    """Return image, quantity, planned, flown and measured of every pair that both have, as text.

    Parameters
    ----------
    plan, root
        The plan, and its folder.
    campaign
        With logs and recordings.
    threads
        Tiles computed at once.

    Raises
    ------
    CampaignError
        If they have no flight and pair in common.
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
            planned_pair = next(one for one in design.opened.pairs if (one.flight, one.name) == (flight.name, pair))
            numbers = [_numbers(planned), _numbers(flown)]
            pulses = [float(len(one.time_s)) for one in (planned_pair, opened)]
            speeds = [
                float(np.median(np.linalg.norm(np.diff(one.aperture.middle_m, axis=0), axis=1) / np.diff(one.time_s)))
                for one in (planned_pair, opened)
            ]
            numbers[0] |= {"pulses": pulses[0], "speed, m/s": speeds[0]}
            numbers[1] |= {"pulses": pulses[1], "speed, m/s": speeds[1]}
            for name, value in numbers[0].items():
                measured_value = measured.get(name)
                texts = ["" if np.isnan(one) else f"{one:.4g}" for one in (value, numbers[1].get(name, np.nan))]
                rows.append(
                    (f"{flight.name}/{pair}", name, *texts, "" if measured_value is None else f"{measured_value:.4g}")
                )
    if not rows:
        raise CampaignError(
            f"images {', '.join(design.images)}",
            "the plan",
            f"some of those of {campaign.root.name}",
            "Name flights and nodes as in the campaign.",
        )
    return rows


def _numbers(image: PlannedImage) -> dict[str, float]:
    """Return the values of an image that are compared: medians over the visible scene."""
    seen = image.layers["mask"] == 0
    numbers = {"coverage, %": 100 * float(seen.mean())}
    for name in ("resolution", "resolution_fine", "looks", "incidence", "bistatic_angle", "nesz", "point_snr"):
        values = image.layers[name][seen] if name in image.layers else np.empty(0)
        values = values[np.isfinite(values)]
        if values.size:
            numbers[f"{name}, {UNITS[name][0]}"] = float(np.median(values))
    return numbers | {"loss, dB": -expected(image.budget).loss_db}


def _measured(campaign: Campaign, flight: str, pair: str) -> Mapping[str, float]:
    """Return the same values of a finished image; empty before."""
    from apertura.common.raster import opened_raster

    if not campaign.is_current(campaign.result(flight, pair, "export")):
        return {}
    report = read_report(campaign, flight, pair)
    found: dict[str, float] = {}
    brightest = report.get("brightest") or {}
    axes = ("ground_range_width_m", "cross_range_width_m")
    widths = [float(brightest[axis]) for axis in axes if brightest.get(axis) is not None]
    if report["focus"].get("verdict") == "focused" and len(widths) == len(axes):
        found |= {"resolution, m": max(widths), "resolution_fine, m": min(widths)}
    if report["focus"].get("loss_db") is not None:
        found["loss, dB"] = -float(report["focus"]["loss_db"])
    for name in ("looks", "incidence", "bistatic_angle", "nesz"):
        with opened_raster(
            campaign.result(flight, pair, f"{name}.tif"), expected="a layer", remedy="Run again."
        ) as raster:
            if name == "nesz" and TAG not in raster.tags():
                continue  # uncalibrated: dB of the image's own power, no sigma0
            values = raster.read(1, masked=True).compressed()
        values = values[np.isfinite(values)]
        if values.size:
            found[f"{name}, {UNITS[name][0]}"] = float(np.median(values))
    with opened_raster(campaign.result(flight, pair, "mask.tif"), expected="a layer", remedy="Run again.") as raster:
        found["coverage, %"] = 100 * float((raster.read(1) == 0).mean())
    return found
