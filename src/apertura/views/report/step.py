"""Rule `page`: what the report says of a flight, as the results section of a paper would: one file that prints."""

import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from apertura.common.atomic import replacement, write_text
from apertura.common.paths import shipped
from apertura.formats.export import exports_in
from apertura.pipeline.campaign import Campaign
from apertura.pipeline.config import FUSED
from apertura.pipeline.lineage import result_of
from apertura.pipeline.opening.scene import OpenScene, settled_scene
from apertura.pipeline.store import check_listed, record_files
from apertura.views.image_report import (
    BUDGET,
    DECISIONS,
    FLAGGED,
    VERDICTS,
    budget_rows,
    decision_rows,
    flag_rows,
    read_report,
    sentences,
    shared_rows,
    verdict_row,
)
from apertura.views.report import PAGE, PICTURES, SUM_PICTURES
from apertura.views.report.page import Block, Heading, Paragraph, Picture, Table, rst_table, rst_text
from apertura.views.report.page import page as page_of

ASKED = ("key", "value")
"""Headings of what was asked."""


def page(campaign: Campaign, flight: str) -> list[Path]:
    """Write results/<flight>/report.html; return its path."""
    lineage = result_of(campaign, "page", flight).begin(campaign.root)
    reports = {name: read_report(campaign, flight, name) for name in campaign.flight(flight).images}
    text = campaign.result(flight, PAGE)
    title = f"{campaign.settings.campaign}, flight {flight}"
    write_text(text, page_of(title, [Heading(1, title), *_blocks(campaign, flight, reports)]))
    record_files(campaign.root / lineage.result.manifest, [text], lineage)
    return [text]


def _blocks(campaign: Campaign, flight: str, reports: Mapping[str, Mapping[str, Any]]) -> Iterator[Block]:
    yield Table(
        "What was asked, and the grid that it gave; all else is auto and decided below.", ASKED, asked_rows(campaign)
    )
    yield Table("What each image says of itself.", VERDICTS, [verdict_row(*one) for one in reports.items()])
    if FUSED in reports:
        yield Heading(2, "Pairs and their sums")
        yield Paragraph(" ".join(sentences("Sum of the pairs", reports[FUSED])))
        yield from _pictures(campaign.result(flight, FUSED), {f"{name}.png": "pictures" for name in SUM_PICTURES})
    for pair in campaign.flight(flight).pairs:
        yield from _pair_blocks(campaign, flight, pair, reports[pair])
    raised = flag_rows(reports)
    yield Heading(2, "Flags")
    if raised:
        yield Table("What crossed a limit of a method, what it means and what to do.", FLAGGED, raised)
    else:
        yield Paragraph("No image of this flight carries a flag: nothing known was crossed.")


def _pair_blocks(campaign: Campaign, flight: str, pair: str, report: Mapping[str, Any]) -> Iterator[Block]:
    folder = campaign.result(flight, pair)
    shown = {row.file: "export" for row in exports_in("pair") if row.pictured}
    shown |= {f"pictures/{name}.png": "pictures" for name in PICTURES}
    yield Heading(2, f"Pair {pair}")
    yield Paragraph(" ".join(sentences(f"Image {pair}", report)))
    yield from _pictures(folder, shown)
    yield Table(
        "Error budget; in brackets what a size assumed would do where nobody stated one.",
        BUDGET,
        budget_rows(report["budget"]),
    )
    yield Table("What the planner decided, and why.", DECISIONS, decision_rows(report))


def _pictures(folder: Path, shown: Mapping[str, str]) -> Iterator[Block]:
    """Yield the pictures of a folder, file → the result that lists it, with what the workflow's report says of them."""
    for name, of in shown.items():
        check_listed(folder / name, folder / f"{of}.manifest.json")
        yield Picture((folder / name).read_bytes(), _caption(Path(name).stem))


def _caption(name: str) -> str:
    """Return what the workflow's report says below a picture."""
    return " ".join((shipped() / "workflow" / "report" / f"{name}.rst").read_text(encoding="utf-8").split())


def asked_rows(campaign: Campaign) -> list[tuple[str, str]]:
    """Return what was asked of a campaign, key of the config → value; grid as settled, and why."""
    scene, values = settled_scene(campaign), campaign.values
    west, south, east, north = scene.grid.bounds_m
    rows, columns = scene.grid.shape
    bounds = ", ".join(map(setting_text, scene.grid.bounds_m))
    size = f"{setting_text(east - west)} m × {setting_text(north - south)} m, {columns} × {rows} pixels"
    grid = [
        ("scene: CRS", scene.grid.crs + _why(scene, "crs")),
        ("scene: west, south, east, north, m", bounds + _why(scene, "bounds_m")),
        ("scene: size", size),
        ("scene: pixels", f"{setting_text(scene.grid.spacing_m)} m" + _why(scene, "spacing_m")),
        ("scene: ground", values["scene"]["dem"] or f"level, {setting_text(scene.level.height_m)} m"),
    ]
    return [*_set_rows("waveform", values["waveform"]), *grid, *_set_rows("processing", values["processing"])]


def _set_rows(section: str, values: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return the settings of a section that are not left to apertura."""
    unset: tuple[object, ...] = ("auto", None, "", (), [], {})
    return [(f"{section}: {name}", setting_text(value)) for name, value in values.items() if value not in unset]


def setting_text(value: object) -> str:
    """Return a setting as people write it.

    Examples
    --------
    >>> [setting_text(value) for value in (1_204_800_000.0, 3.125e-06, {"align_phase": False}, "hann")]
    ['1204800000', '3.125e-06', 'align_phase: False', 'hann']
    """
    if isinstance(value, float):
        return f"{value:.12g}"
    if isinstance(value, Mapping):
        return ", ".join(f"{name}: {setting_text(one)}" for name, one in value.items())
    return str(value)


def _why(scene: OpenScene, name: str) -> str:
    return f" ({scene.chosen[name]})" if name in scene.chosen else ""


def landing(campaign: Campaign) -> dict[str, Any]:
    """Return what the workflow's report opens with, as reStructuredText in which nothing is markup but the tables."""
    flights = {one.name: one.pairs for one in campaign.image_flights}
    reports = {
        f"{one} {name}": read_report(campaign, one, name) for one, names in campaign.images.items() for name in names
    }
    first, pairs = next(iter(flights.items()))
    decided, raised = {pair: reports[f"{first} {pair}"] for pair in pairs}, flag_rows(reports)
    return {
        "title": rst_text(campaign.settings.campaign),
        "flights": rst_text(", ".join(f"{one} ({', '.join(names)})" for one, names in flights.items())),
        "asked": rst_table(ASKED, asked_rows(campaign)),
        "verdicts": rst_table(VERDICTS, [verdict_row(*one) for one in reports.items()]),
        "sentences": [
            rst_text(" ".join(sentences(f"Sum of the pairs of {one}", reports[f"{one} {FUSED}"])))
            for one in flights
            if f"{one} {FUSED}" in reports
        ],
        "first": rst_text(first),
        "decisions": rst_table(("pairs", *DECISIONS), shared_rows(decided)),
        "flags": rst_table(FLAGGED, raised) if raised else "",
    }


@contextmanager
def open_report(campaign: Campaign) -> Iterator[tuple[Path, Path]]:
    """Yield where snakemake's report is to be written, and its style; it is recorded when the body ends.

    Its sources are hashed when it is written: snakemake settles the times of files before.
    """
    path = campaign.result(PAGE)
    with TemporaryDirectory() as folder, replacement(path) as temporary:
        page = Path(folder) / path.name  # of another process
        yield page, shipped() / "workflow" / "report" / "report.css"
        shutil.copyfile(page, temporary)
        lineage = result_of(campaign, "report").begin(campaign.root)
    record_files(campaign.root / lineage.result.manifest, [path], lineage)
