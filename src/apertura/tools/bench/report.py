"""Rule `bench` and `apertura bench`: measure a stationary radar; write bench.json, bench.html and bench.png."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from apertura.campaign.config import CONFIG, FLIGHTS, validated
from apertura.campaign.folder import Campaign
from apertura.campaign.store import open_listed, record_files
from apertura.common.atomic import write_json, write_text
from apertura.common.errors import CampaignError, number_of
from apertura.common.flag_table import FLAGS
from apertura.common.provenance import Provenance
from apertura.methods.bench.channels import SIGMAS
from apertura.stages.tags import tags_of
from apertura.tools.bench.measurement import Bench, measure_bench, series
from apertura.views.report.page import Block, Heading, Paragraph, Picture, Table, page
from apertura.views.report.sheet import BLUE, GREEN, ORANGE, RED, SKY, sheet, thinned
from apertura.workflow.lineage import result_of
from apertura.workflow.stale import outdated_places

REPORT, PAGE, PICTURE = "bench.json", "bench.html", "bench.png"
_COLOURS = (BLUE, ORANGE, GREEN, RED, SKY)
_HEAD = ("node or pair", "quantity", "measured", "limit", "verdict")


def bench(campaign: Campaign, flight: str) -> Sequence[Path]:
    """Measure a flight of kind bench; write its report, page and plot, and return their paths."""
    lineage = result_of(campaign, "bench", flight).begin(campaign.root)
    measured = measure_bench(campaign, flight)
    report, text, picture = written = [campaign.result(flight, name) for name in (REPORT, PAGE, PICTURE)]
    title = f"{campaign.settings.campaign}, bench {flight}"
    write_json(report, measured.report)
    origin = Provenance.of(lineage.modules, {}, settings=lineage.result.settings)
    draw_bench(picture, measured, title=title, tags=tags_of(origin, lineage))
    write_text(text, page(title, _blocks(title, measured.report, picture.read_bytes())))
    record_files(campaign.root / lineage.result.manifest, written, lineage)
    return written


def print_bench(campaign: Campaign, *, write: bool = False) -> int:
    """Measure flights of kind bench without an up-to-date result, print all verdicts, and count the lines with flags.

    Parameters
    ----------
    campaign
        The campaign.
    write
        Write the measured paths into config/config.yaml.

    Raises
    ------
    CampaignError
        If there is no flight of kind bench.
    """
    flights = [flight.name for flight in campaign.flights if flight.kind == "bench"]
    if not flights:
        raise CampaignError(
            f"{number_of(len(campaign.flights), 'flight')}, none of kind bench",
            where=campaign.root / FLIGHTS,
            expected="a line with the columns flight, bench, transmitter, nodes for a recording of a stationary radar",
            remedy="Add the line; no flight log is required.",
        )
    for where in outdated_places(campaign, "bench"):
        bench(campaign, *where)
    flagged = 0
    for flight in flights:
        report = open_listed(campaign.result(flight, REPORT), campaign.root / campaign.manifest("bench", flight))
        _print(flight, report)
        for name in (PAGE, PICTURE):
            print(f"  {campaign.relative(campaign.result(flight, name))}")
        flagged += sum(bool(line["flags"]) for line in report["lines"])
        _offer(campaign, flight, report["path_offset_m"], write=write)
    return flagged


def _print(flight: str, report: Mapping[str, Any]) -> None:
    from rich import box
    from rich.console import Console
    from rich.table import Table as Printed

    console = Console(highlight=False, width=150)
    table = Printed(title=f"bench {flight}", title_justify="left", box=box.SIMPLE_HEAD, padding=0)
    for heading in _HEAD:
        table.add_column(heading, overflow="fold")
    for row in _rows(report):
        table.add_row(*row)
    console.print(table)
    for name, line in report["flags"].items():
        console.print(f"{name}: {FLAGS[name].meaning}\n    {line}\n    advice: {FLAGS[name].advice}", markup=False)


def _rows(report: Mapping[str, Any]) -> list[tuple[str, str, str, str, str]]:
    return [
        (line["of"], line["what"], line["measured"], line["limit"], ", ".join(line["flags"]) or "ok")
        for line in report["lines"]
    ]


def _blocks(title: str, report: Mapping[str, Any], picture: bytes) -> Iterator[Block]:
    yield Heading(1, title)
    flags = report["flags"]
    yield Paragraph(
        "The set-up is stationary: changes from pulse to pulse are caused by the radar. "
        + (
            f"{number_of(len(flags), 'flag')} raised, see below."
            if flags
            else "All measurements are within their limits."
        )
    )
    if flags:
        rows = [(name, line, FLAGS[name].meaning, FLAGS[name].advice) for name, line in flags.items()]
        yield Table("Flags raised.", ("flag", "measurement", "meaning", "advice"), rows)
    yield Picture(
        picture,
        "From top to bottom: phase, delay and amplitude of the strongest path of each pair against time, relative to "
        "their mean; mean range profile; Allan deviation of the delay, computed from the phase (dashed: white noise at "
        "the measured SNR).",
    )
    yield Table("Measurements.", _HEAD, _rows(report))


def draw_bench(path: Path, measured: Bench, *, title: str, tags: Mapping[str, str]) -> None:
    """Plot the links of a bench: phase, delay and amplitude over time, mean profile, Allan deviation of the delay."""
    links = [node.link for node in measured.nodes if node.link is not None]
    with sheet(path, 8.4, title=title, tags=tags) as figure:
        *over_time, profile, allan = figure.subplots(5, 1)
        for link, colour in zip(links, _COLOURS * len(links), strict=False):
            time_s, *values = series(link)
            drawn = thinned(len(time_s))
            for axes, value in zip(over_time, values, strict=True):
                axes.plot(time_s[drawn], value[drawn], ".", ms=2, color=colour, label=link.name)
            path_m, level_db = link.profile
            profile.plot(path_m, level_db, lw=0.8, color=colour)
            deviation = np.array(link.deviation(measured.interval_s))
            if deviation.size:
                allan.loglog(*deviation.T, "o-", ms=3, color=colour)
                white = np.sqrt(3) * link.noise_rad / (2 * np.pi * link.frequency_hz) / deviation[:, 0]
                allan.loglog(deviation[:, 0], white, "--", lw=0.8, color=colour)
        labels = "phase, rad", "delay, ps", "amplitude, dB"
        for axes, label in zip(over_time, labels, strict=True):
            axes.set(ylabel=label)
            axes.tick_params(labelbottom=axes is over_time[-1])
        over_time[-1].set(xlabel="time, s")
        profile.set(xlabel="total path, m (receivers: relative to the sidelink)", ylabel="mean profile, dB")
        if links:
            paths_m, margin_m = [0.0, *(link.path_m for link in links)], 40 * links[0].cell_m
            profile.set(xlim=(min(paths_m) - margin_m, max(paths_m) + margin_m), ylim=(-80, 3))
        allan.set(ylabel="Allan deviation", xlabel="averaging time, s")
        for axis in (allan.xaxis, allan.yaxis):
            axis.set_major_formatter(lambda value, _: f"{value:g}")
        over_time[0].set_title(title)
        if links:
            over_time[0].legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), markerscale=4)


# ---- Measured path offsets in the config ----------------------------------------------------------------------------


def _offer(campaign: Campaign, flight: str, offsets: Mapping[str, Any], *, write: bool) -> None:
    """Print the measured path offsets as config keys, or write them; links with a flag in `_DOUBTS` are skipped."""
    if not offsets:
        print(f"{CONFIG}: bench.radar_m and bench.sidelink_m are not configured: path offsets cannot be computed")
        return
    for node, offset in offsets.items():
        if offset["doubts"]:
            print(f"nodes.{node}.path_offset_m: not determined; flags of the link: {', '.join(offset['doubts'])}")
    differing = {
        node: offset
        for node, offset in offsets.items()
        if not offset["doubts"] and abs(offset["offset_m"] - offset["stated_m"]) > SIGMAS * offset["std_m"]
    }
    if write:
        write_offsets(campaign, flight, differing)
    elif differing:
        print(f"measured path offsets for {CONFIG} (to write them: `apertura bench --write`):")
        transmitter = campaign.flight(flight).transmitter
        for node, offset in differing.items():
            radar_m = _radar_m(campaign, node, offset["offset_m"], is_transmitter=node == transmitter)
            print(f"  nodes.{node}.path_offset_m.radar: {radar_m}  # ± {offset['std_m']:.4f}")


def _radar_m(campaign: Campaign, node: str, offset_m: float, *, is_transmitter: bool) -> float:
    """Return the path offset of a radar channel, metres; for a receiver, `offset_m` is relative to its sidelink."""
    return round(offset_m if is_transmitter else offset_m + campaign.settings.nodes[node].path_offset_m.sidelink, 4)


def write_offsets(campaign: Campaign, flight: str, offsets: Mapping[str, Any]) -> None:
    """Write measured path offsets into config/config.yaml; the rest of the file is unchanged."""
    path, transmitter = campaign.root / CONFIG, campaign.flight(flight).transmitter
    text = path.read_text(encoding="utf-8")
    values = {
        node: _radar_m(campaign, node, offset["offset_m"], is_transmitter=node == transmitter)
        for node, offset in offsets.items()
    }
    for node, value in values.items():
        text = with_value(text, ("nodes", node, "path_offset_m", "radar"), value)
        print(f"{CONFIG}: nodes.{node}.path_offset_m.radar: {value}")
    if values:
        validated(yaml.safe_load(text), where=path)
        write_text(path, text)
    else:
        print(f"{CONFIG}: unchanged, because there is no measured path offset to write")


def with_value(text: str, keys: tuple[str, ...], value: float) -> str:
    r"""Set the value of a nested key in a YAML document; comments and all other text are unchanged.

    Examples
    --------
    >>> with_value("a:  # one\n  b: 1  # two\n", ("a", "b"), 2.5)
    'a:  # one\n  b: 2.5  # two\n'
    >>> with_value("a:\n  c: 1\n", ("a", "b", "d"), 2.5)
    'a:\n  b: {d: 2.5}\n  c: 1\n'
    >>> with_value("a: {}\n", ("a", "b"), 2.5)
    'a: {b: 2.5}\n'
    """
    node: Any = yaml.compose(text)
    rest = list(keys)
    while rest and isinstance(node, yaml.MappingNode):
        child = next((entry for name, entry in node.value if name.value == rest[0]), None)
        if child is None:
            break
        node, rest = child, rest[1:]
    if not rest:
        return text[: node.start_mark.index] + repr(value) + text[node.end_mark.index :]
    inserted = repr(value)
    for key in reversed(rest[1:]):
        inserted = f"{{{key}: {inserted}}}"
    at = node.start_mark.index
    if node.flow_style:
        return f"{text[: at + 1]}{rest[0]}: {inserted}{', ' if node.value else ''}{text[at + 1 :]}"
    return f"{text[:at]}{rest[0]}: {inserted}\n{' ' * node.start_mark.column}{text[at:]}"
