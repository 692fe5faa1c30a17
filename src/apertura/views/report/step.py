"""Rule `page`: printable HTML report of a flight, organised as the results section of a paper."""

import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from apertura.campaign.config import FUSED
from apertura.campaign.folder import Campaign
from apertura.campaign.store import check_listed, open_listed, record_files
from apertura.common.atomic import replacement, write_text
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.paths import shipped
from apertura.core.geometry.geodesy import LOCAL, geodetic_from_ecef
from apertura.formats.export import exports_in
from apertura.stages.scene import OpenScene, settled_scene
from apertura.views.quality import (
    BUDGET,
    DECISIONS,
    FLAGGED,
    PAYLOAD,
    VERDICTS,
    budget_rows,
    decision_rows,
    flag_rows,
    payload_row,
    read_report,
    sentences,
    shared_rows,
    verdict_row,
)
from apertura.views.report import PAGE, PICTURES, SUM_PICTURES
from apertura.views.report.page import Block, Heading, Paragraph, Picture, Table, rst_table, rst_text
from apertura.views.report.page import page as page_of
from apertura.workflow.lineage import result_of
from apertura.workflow.rule_inputs import JobScope, Scope, has_frames
from apertura.workflow.rules import STACK

SETTING_COLUMNS = ("key", "value")
"""Header of the settings table."""


def page(campaign: Campaign, flight: str) -> list[Path]:
    """Write results/<flight>/report.html; return the path of the file."""
    lineage = result_of(campaign, "page", flight).begin(campaign.root)
    reports = {name: read_report(campaign, flight, name) for name in campaign.flight(flight).images}
    text = campaign.result(flight, PAGE)
    title = f"{campaign.settings.campaign}, flight {flight}"
    write_text(text, page_of(title, [Heading(1, title), *_blocks(campaign, flight, reports)]))
    record_files(campaign.root / lineage.result.manifest, [text], lineage)
    return [text]


def _blocks(campaign: Campaign, flight: str, reports: Mapping[str, Mapping[str, Any]]) -> Iterator[Block]:
    yield Table("Summary of the flight.", ("quantity", "value"), flight_rows(campaign, flight, reports))
    yield Table(
        "Configuration and output grid (settings not listed are chosen automatically, see Processing decisions).",
        SETTING_COLUMNS,
        setting_rows(campaign),
    )
    yield Table("Image quality.", VERDICTS, [verdict_row(name, report) for name, report in reports.items()])
    if FUSED in reports:
        yield Heading(2, "Pairs and sums")
        yield Paragraph(" ".join(sentences("Sum of the pairs", reports[FUSED])))
        yield from _pictures(campaign.result(flight, FUSED), {f"{name}.png": "pictures" for name in SUM_PICTURES})
    for pair in campaign.flight(flight).pairs:
        yield from _pair_blocks(campaign, flight, pair, reports[pair])
    if has_frames(JobScope(campaign, Scope.FLIGHT, (flight,))):
        folder = campaign.result(flight, "payload")
        report = open_listed(folder / "payload.json", folder / "payload.manifest.json")
        yield Heading(2, "Payload")
        yield from _pictures(folder, {"payload.png": "payload"})
        caption = (
            "Frames sent during the recording of each node, recorded ones, and intact ones. SER: symbol error rate "
            "expected from the SNR; FER: frame error rate."
        )
        yield Table(caption, PAYLOAD, [payload_row(summary) for summary in report["nodes"]])
        for summary in report["nodes"]:
            yield from (Paragraph(f"{summary['node']}: {remark}") for remark in summary["remarks"])
    raised = flag_rows(reports)
    if campaign.settings.stack and flight in campaign.settings.stack.flights:
        folder = campaign.result(STACK, flight)
        report = open_listed(folder / "change.json", folder / "change.manifest.json")
        yield Heading(2, f"Changes relative to flight {report['reference']}")
        yield Paragraph(f"{report['says']}.")
        yield from _pictures(folder, {"change.png": "change"})
        raised += flag_rows({"changes": report})
    yield Heading(2, "Flags")
    if raised:
        yield Table("Flags raised, with meaning and advice.", FLAGGED, raised)
    else:
        yield Paragraph("No flags raised.")


def _pair_blocks(campaign: Campaign, flight: str, pair: str, report: Mapping[str, Any]) -> Iterator[Block]:
    folder = campaign.result(flight, pair)
    shown = {row.file: "export" for row in exports_in("pair") if row.pictured}
    shown |= {f"pictures/{name}.png": "pictures" for name in PICTURES}
    yield Heading(2, f"Pair {pair}")
    yield Paragraph(" ".join(sentences(f"Image {pair}", report)))
    yield from _pictures(folder, shown)
    yield Table(
        "Error budget. Values in brackets are not in the sum, because the size of the error is not configured.",
        BUDGET,
        budget_rows(report["budget"]),
    )
    yield Table("Processing decisions, with reasons.", DECISIONS, decision_rows(report))


def _pictures(folder: Path, shown: Mapping[str, str]) -> Iterator[Block]:
    """Yield figures of a folder, given as file → result that lists the file, with captions of the workflow's report."""
    for name, result in shown.items():
        check_listed(folder / name, folder / f"{result}.manifest.json")
        caption = (shipped() / "workflow" / "report" / f"{Path(name).stem}.rst").read_text(encoding="utf-8")
        yield Picture((folder / name).read_bytes(), " ".join(caption.split()))


def flight_rows(campaign: Campaign, flight: str, reports: Mapping[str, Mapping[str, Any]]) -> list[tuple[str, str]]:
    """Return table rows with date, location, band and geometry of a flight; the first pair determines the geometry."""
    pairs = campaign.flight(flight).pairs
    views = [reports[pair]["view"] for pair in pairs if "view" in reports[pair]]
    scene = settled_scene(campaign)
    rows = []
    if scene.grid.crs != LOCAL:
        rows.append(("scene centre", _position_text(geodetic_from_ecef(scene.middle_m))))
    if not views:
        return rows
    first, last = min(view["first_utc"] for view in views), max(view["last_utc"] for view in views)
    view, wave_m = views[0], SPEED_OF_LIGHT_M_S / views[0]["centre_hz"]
    band = f"{frequency_text(view['centre_hz'])} ± {frequency_text(view['band_hz'] / 2)}"
    speed = view.get("speed_m_s")
    return [
        ("recorded, UTC", f"{first[:19].replace('T', ' ')} to {last[:19].replace('T', ' ')}"),
        *rows,
        ("band", f"{band}, wavelength {100 * wave_m:.3g} cm"),
        ("speed", "unknown" if speed is None else f"{speed:.3g} m/s"),
        ("height above the scene", f"{view['height_m']:.3g} m"),
        ("range and incidence angle at the scene centre", f"{view['range_m']:.4g} m, {view['incidence_deg']:.3g}°"),
        ("look side", view["side"] + ("" if view["side_observable"] or view["side"] == "both" else ", assumed")),
    ]


def _position_text(position: Any) -> str:
    latitude, longitude, _ = map(float, position)
    return (
        f"{abs(latitude):.5f}° {'N' if latitude >= 0 else 'S'}, {abs(longitude):.5f}° {'E' if longitude >= 0 else 'W'}"
    )


def setting_rows(campaign: Campaign) -> list[tuple[str, str]]:
    """Return table rows with the settings of a campaign (config key and value), and the output grid with reasons."""
    scene, values = settled_scene(campaign), campaign.values
    west, south, east, north = scene.grid.bounds_m
    rows, columns = scene.grid.shape
    bounds = ", ".join(map(setting_text, scene.grid.bounds_m))
    size = f"{setting_text(east - west)} m × {setting_text(north - south)} m, {columns} × {rows} pixels"
    grid = [
        ("scene: CRS", scene.grid.crs + _why(scene, "crs")),
        ("scene: west, south, east, north, m", bounds + _why(scene, "bounds_m")),
        ("scene: size", size),
        ("scene: pixel spacing", f"{setting_text(scene.grid.spacing_m)} m" + _why(scene, "spacing_m")),
        ("scene: terrain", values["scene"]["dem"] or f"flat, {setting_text(scene.level.height_m)} m"),
    ]
    return [*_set_rows("waveform", values["waveform"]), *grid, *_set_rows("processing", values["processing"])]


def _set_rows(section: str, values: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return the settings of a section that are not chosen automatically and apply to the configured format."""
    unset: tuple[object, ...] = ("auto", None, "", (), [], {})
    without = {"trigger"} if str(values.get("format")).startswith("beat_") and values["format"] != "beat_wav" else set()
    return [
        (f"{section}: {name.removesuffix('_hz')}", frequency_text(value))
        if name.endswith("_hz") and isinstance(value, int | float)
        else (f"{section}: {name}", setting_text(value))
        for name, value in values.items()
        if value not in unset and name not in without
    ]


def frequency_text(hz: float) -> str:
    """Format a frequency in GHz, MHz, kHz or Hz.

    Examples
    --------
    >>> frequency_text(1_204_800_000), frequency_text(4e5), frequency_text(20)
    ('1.2048 GHz', '400 kHz', '20 Hz')
    """
    units = ((1e9, "GHz"), (1e6, "MHz"), (1e3, "kHz"))
    scale, unit = next((entry for entry in units if abs(hz) >= entry[0]), (1.0, "Hz"))
    return f"{hz / scale:.9g} {unit}"


def setting_text(value: object) -> str:
    """Format a configured value as text.

    Examples
    --------
    >>> [setting_text(value) for value in (12.5, 3.125e-06, {"align_phase": False}, "hann", ["sigma0"])]
    ['12.5', '3.125e-06', 'align_phase: no', 'hann', 'sigma0']
    """
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, list | tuple):
        return ", ".join(map(setting_text, value))
    if isinstance(value, float):
        return f"{value:.12g}"
    if isinstance(value, Mapping):
        return ", ".join(f"{name}: {setting_text(entry)}" for name, entry in value.items())
    return str(value)


def _why(scene: OpenScene, name: str) -> str:
    return f" ({scene.chosen[name]})" if name in scene.chosen else ""


def landing(campaign: Campaign) -> dict[str, Any]:
    """Return parts of the first page of the workflow's report as reStructuredText with no markup other than tables."""
    flights = {flight.name: flight.pairs for flight in campaign.image_flights}
    reports = {
        f"{flight} {name}": read_report(campaign, flight, name)
        for flight, names in campaign.images.items()
        for name in names
    }
    first, pairs = next(iter(flights.items()))
    decided, raised = {pair: reports[f"{first} {pair}"] for pair in pairs}, flag_rows(reports)
    return {
        "title": rst_text(campaign.settings.campaign),
        "flights": rst_text(", ".join(f"{flight} ({', '.join(names)})" for flight, names in flights.items())),
        "configuration": rst_table(SETTING_COLUMNS, setting_rows(campaign)),
        "verdicts": rst_table(VERDICTS, [verdict_row(name, report) for name, report in reports.items()]),
        "sentences": [
            rst_text(" ".join(sentences(f"Sum of the pairs of {flight}", reports[f"{flight} {FUSED}"])))
            for flight in flights
            if f"{flight} {FUSED}" in reports
        ],
        "first": rst_text(first),
        "decisions": rst_table(("pairs", *DECISIONS), shared_rows(decided)),
        "flags": rst_table(FLAGGED, raised) if raised else "",
    }


@contextmanager
def open_report(campaign: Campaign) -> Iterator[tuple[Path, Path]]:
    """Yield the paths of Snakemake's report and its style sheet; record the report when the context exits.

    The sources are hashed on exit, because Snakemake updates the times of files before writing the report.
    """
    path = campaign.result(PAGE)
    with TemporaryDirectory() as folder, replacement(path) as temporary:
        page = Path(folder) / path.name  # written by the Snakemake process
        yield page, shipped() / "workflow" / "report" / "report.css"
        shutil.copyfile(page, temporary)
        lineage = result_of(campaign, "report").begin(campaign.root)
    record_files(campaign.root / lineage.result.manifest, [path], lineage)
