"""Rule `bench`: a radar that stands still, measured: bench.json, bench.html and bench.png; and `apertura bench`."""

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
from apertura.workflow.stale import stale_results

REPORT, PAGE, PICTURE = "bench.json", "bench.html", "bench.png"
_COLOURS = (BLUE, ORANGE, GREEN, RED, SKY)
_HEAD = ("of", "quantity", "measured", "limit", "verdict")


def bench(campaign: Campaign, flight: str) -> Sequence[Path]:
    """Measure a flight of kind bench; write its report, page and picture, and return their paths."""
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
    """Measure the flights of kind bench that are not measured yet, print their verdicts; return how many lines flag.

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
            expected="a line of a recording that stood still: flight, bench, transmitter, nodes",
            remedy="Add it; no flight log is needed.",
        )
    stale, flagged = set(stale_results(campaign)), 0
    for flight in flights:
        manifest = campaign.manifest("bench", flight)
        if manifest in stale or not (campaign.root / manifest).is_file():
            bench(campaign, flight)
        report = open_listed(campaign.result(flight, REPORT), campaign.root / manifest)
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
        "Nothing moved: whatever changes from pulse to pulse is the radar's own. "
        + (f"{number_of(len(flags), 'flag')} raised, listed below." if flags else "Every line is within its limit.")
    )
    if flags:
        rows = [(name, line, FLAGS[name].meaning, FLAGS[name].advice) for name, line in flags.items()]
        yield Table("Flags", ("flag", "measured", "meaning", "advice"), rows)
    yield Picture(
        picture,
        "Phase, delay and amplitude of the strongest path of each pair from pulse to pulse, against their mean; mean "
        "range profile; Allan deviation of the delay by its phase, dashed what white noise of that SNR alone gives.",
    )
    yield Table("What was measured.", _HEAD, _rows(report))


def draw_bench(path: Path, measured: Bench, *, title: str, tags: Mapping[str, str]) -> None:
    """Draw the links of a bench: phase, delay and amplitude over time, mean profile, Allan deviation of the delay."""
    links = [node.link for node in measured.nodes if node.link is not None]
    with sheet(path, 8.4, title=title, tags=tags) as figure:
        *over_time, profile, allan = figure.subplots(5, 1)
        for link, colour in zip(links, _COLOURS * len(links), strict=False):
            time_s, *values = series(link)
            some = thinned(len(time_s))
            for axes, value in zip(over_time, values, strict=True):
                axes.plot(time_s[some], value[some], ".", ms=2, color=colour, label=link.name)
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
        profile.set(xlabel="total path, m; of a receiver beyond its sidelink", ylabel="mean profile, dB")
        if links:
            paths_m, margin_m = [0.0, *(link.path_m for link in links)], 40 * links[0].cell_m
            profile.set(xlim=(min(paths_m) - margin_m, max(paths_m) + margin_m), ylim=(-80, 3))
        allan.set(ylabel="Allan deviation", xlabel="averaging time, s")
        for axis in (allan.xaxis, allan.yaxis):
            axis.set_major_formatter(lambda value, _: f"{value:g}")
        over_time[0].set_title(title)
        if links:
            over_time[0].legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), markerscale=4)


# ---- Measured paths into the config ---------------------------------------------------------------------------------


def _offer(campaign: Campaign, flight: str, offsets: Mapping[str, Any], *, write: bool) -> None:
    """Print what the config would say of the measured paths, or write it; nothing of links that carry a flag."""
    if not offsets:
        print(f"{CONFIG}: bench.radar_m and bench.sidelink_m are not stated: no path beyond the set-up")
        return
    for node, one in offsets.items():
        if one["doubts"]:
            print(f"nodes.{node}.path_offset_m: not of a link with {', '.join(one['doubts'])}")
    differing = {
        node: one
        for node, one in offsets.items()
        if not one["doubts"] and abs(one["offset_m"] - one["stated_m"]) > SIGMAS * one["std_m"]
    }
    if write:
        write_offsets(campaign, flight, differing)
    elif differing:
        print(f"paths for {CONFIG}, or `apertura bench --write`:")
        transmitter = campaign.flight(flight).transmitter
        for node, one in differing.items():
            radar_m = _radar_m(campaign, node, one["offset_m"], own=node == transmitter)
            print(f"  nodes.{node}.path_offset_m.radar: {radar_m}  # ± {one['std_m']:.4f}")


def _radar_m(campaign: Campaign, node: str, offset_m: float, *, own: bool) -> float:
    """Return the offset of a radar channel: of a receiver only its difference to the sidelink's is measured."""
    return round(offset_m if own else offset_m + campaign.settings.nodes[node].path_offset_m.sidelink, 4)


def write_offsets(campaign: Campaign, flight: str, offsets: Mapping[str, Any]) -> None:
    """Write measured paths into config/config.yaml; all else stays letter by letter."""
    path, transmitter = campaign.root / CONFIG, campaign.flight(flight).transmitter
    text = path.read_text(encoding="utf-8")
    found = {node: _radar_m(campaign, node, one["offset_m"], own=node == transmitter) for node, one in offsets.items()}
    for node, value in found.items():
        text = with_value(text, ("nodes", node, "path_offset_m", "radar"), value)
        print(f"{CONFIG}: nodes.{node}.path_offset_m.radar: {value}")
    if found:
        validated(yaml.safe_load(text), where=path)
        write_text(path, text)
    else:
        print(f"{CONFIG}: nothing to write: it says what was measured")


def with_value(text: str, keys: tuple[str, ...], value: float) -> str:
    r"""Return a YAML document with the value of a key below others put in, comments and all else as they were.

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
        below = next((own for name, own in node.value if name.value == rest[0]), None)
        if below is None:
            break
        node, rest = below, rest[1:]
    if not rest:
        return text[: node.start_mark.index] + repr(value) + text[node.end_mark.index :]
    put = repr(value)
    for key in reversed(rest[1:]):
        put = f"{{{key}: {put}}}"
    at = node.start_mark.index
    if node.flow_style:
        return f"{text[: at + 1]}{rest[0]}: {put}{', ' if node.value else ''}{text[at + 1 :]}"
    return f"{text[:at]}{rest[0]}: {put}\n{' ' * node.start_mark.column}{text[at:]}"
