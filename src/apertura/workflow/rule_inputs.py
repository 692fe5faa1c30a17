"""Scope of a job, and functions in the rows of rules that return source files and settings.

The functions import modules only when they are called, because the command line also imports the rows.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from apertura.campaign.folder import Campaign


class Scope(Enum):
    """Scope of a rule, and the Snakemake wildcards of the jobs of the rule."""

    NODE = "node", ("flight", "node")
    PAIR = "pair", ("flight", "pair")
    FLIGHT = "flight", ("flight",)
    TWO = "two images", ("two",)
    STACKED = "flight of the stack", ("flight",)
    CAMPAIGN = "campaign", ()
    CHARTED = "charted pair", ()

    def __init__(self, _: str, wildcards: tuple[str, ...]) -> None:
        self.wildcards = wildcards


@dataclass(frozen=True)
class JobScope:
    """Scope of a job and the values of its wildcards.

    Attributes
    ----------
    campaign
        Campaign with settings and flights.
    of
        Kind of scope.
    where
        Values of the wildcards.
    """

    campaign: "Campaign"
    of: Scope
    where: tuple[str, ...]

    @property
    def pairs(self) -> list[tuple[str, str]]:
        """Flight and pair of each image within the scope."""
        campaign = self.campaign
        if self.of is Scope.PAIR:
            return [(self.where[0], self.where[1])]
        if self.of is Scope.FLIGHT:
            return [(self.where[0], pair) for pair in campaign.flight(self.where[0]).pairs]
        if self.of is Scope.TWO:
            return [(flight, pair) for flight, pair in campaign.settings.interferometry.images(self.where[0])]
        if self.of is Scope.STACKED:
            return stacked_pairs(campaign, self.where[0])
        if self.of is Scope.CHARTED:
            return [charted(campaign)]
        return [(flight.name, pair) for flight in campaign.image_flights for pair in flight.pairs]

    def below(self, of: Scope) -> list[tuple[str, ...]]:
        """Return the wildcard values of all jobs with another kind of scope that belong to this job.

        Examples
        --------
        >>> JobScope(None, Scope.PAIR, ("f01", "uav1-uav2")).below(Scope.NODE)
        [('f01', 'uav1'), ('f01', 'uav2')]
        """
        if of is self.of:
            return [self.where]
        if of is Scope.CAMPAIGN:
            return [()]
        if of is Scope.TWO:
            return [(name,) for name in self.campaign.settings.interferometry.pairs]
        if of is Scope.NODE:
            values: Iterable[tuple[str, ...]] = ((name, node) for name, pair in self.pairs for node in pair.split("-"))
        elif of is Scope.FLIGHT:
            values = ((name,) for name, _ in self.pairs)
        elif of is Scope.STACKED:
            stack = self.campaign.settings.stack
            values = ((name,) for name in (stack.all_flights if stack else ()))
        else:
            values = self.pairs
        return list(dict.fromkeys(values))


SourceSpec = str | Callable[[JobScope], Iterable[str]]
SettingSpec = str | Callable[[JobScope], Mapping[str, Any]]
"""Source or setting in the row of a result: a name, or a function that returns names or values for the scope of a job.
"""


def charted(campaign: "Campaign") -> tuple[str, str]:
    """Return flight and pair of `apertura chart`: the last pair of the first image flight.

    Raises
    ------
    CampaignError
        If the campaign has no image flight.
    """
    campaign.check_images()
    return campaign.image_flights[0].name, campaign.image_flights[0].pairs[-1]


def stacked_pairs(campaign: "Campaign", flight: str) -> list[tuple[str, str]]:
    """Return flight and pair of the stack's reference image and of a flight's image; one image for the reference.

    Raises
    ------
    CampaignError
        If the flight is no flight of the stack.
    """
    from apertura.common.errors import CampaignError

    stack = campaign.settings.stack
    if stack is None or flight not in stack.all_flights:
        raise CampaignError(
            f"flight {flight} is not in the stack",
            where="config/config.yaml: stack",
            expected=f"one of {', '.join(stack.all_flights)}" if stack else "a configured stack; none is configured",
            remedy="Add the flight to stack.flights.",
        )
    return [(name, stack.pair) for name in dict.fromkeys((stack.reference, flight))]


def changes(scope: JobScope) -> Iterable[str]:
    """Return the manifest of the changes of a flight, if it is compared with the reference flight of the stack."""
    stack = scope.campaign.settings.stack
    return (
        [scope.campaign.manifest("change", "stack", *scope.where)] if stack and scope.where[0] in stack.flights else []
    )


def has_reference(scope: JobScope) -> bool:
    """Return True for a flight of the stack other than the reference."""
    stack = scope.campaign.settings.stack
    return stack is not None and scope.where[0] != stack.reference


def stack_reference(scope: JobScope) -> Iterable[str]:
    """Return the manifest of the reference image of the stack."""
    stack = scope.campaign.settings.stack
    return [scope.campaign.manifest("stack_image", "stack", stack.reference)] if stack else []


def is_sampled(campaign: "Campaign") -> bool:
    """Return True if samples were recorded; False for phase histories."""
    from apertura.campaign.config import SampledWaveform

    return isinstance(campaign.settings.waveform, SampledWaveform)


def of_samples(scope: JobScope) -> bool:
    """Return True if samples were recorded; False for phase histories."""
    return is_sampled(scope.campaign)


def has_frames(scope: JobScope) -> bool:
    """Return True if the format of the frames that the unknown symbols carry is configured."""
    codes = getattr(scope.campaign.settings.waveform, "codes", None)
    return getattr(codes, "frame", None) is not None


def adds_up(scope: JobScope) -> bool:
    """Return True if a flight has several pairs and therefore sums."""
    from apertura.campaign.config import FUSED

    return FUSED in scope.campaign.flight(scope.where[0]).images


def recording(scope: JobScope) -> Iterable[str]:
    """Return the files of a node's recording."""
    return map(scope.campaign.relative, scope.campaign.promised_files(*scope.where))


def recorded(scope: JobScope) -> Iterable[str]:
    """Return the recordings of a flight, and the file of the transmitted signal."""
    campaign, flight = scope.campaign, scope.campaign.flight(scope.where[0])
    if not is_sampled(campaign):
        return []
    files = (path for node in flight.recorded for path in campaign.promised_files(flight.name, node))
    return map(campaign.relative, (*files, *campaign.sent_files))


def stated_paths(scope: JobScope) -> Mapping[str, Any]:
    """Return the configured path offsets of a flight's nodes."""
    nodes = scope.campaign.values["nodes"]
    return {"path_offset_m": {node: nodes[node]["path_offset_m"] for (_, node) in scope.below(Scope.NODE)}}


def sample_orders(scope: JobScope) -> Mapping[str, Any]:
    """Return the configured order of I and Q for nodes that override the order in the section `waveform`."""
    nodes = scope.campaign.settings.nodes
    orders = {node: nodes[node].iq for (_, node) in scope.below(Scope.NODE) if nodes[node].iq is not None}
    return {"iq": orders} if orders else {}


def log(scope: JobScope) -> Iterable[str]:
    """Return the flight log of a node."""
    return [scope.campaign.relative(scope.campaign.track_file(*scope.where))]


def transmitted_and_received(scope: JobScope) -> Iterable[str]:
    """Return the files from which stage `echo` is computed, and the calibration applied to the stage."""
    campaign, (flight, pair) = scope.campaign, scope.where
    nodes = list(dict.fromkeys(pair.split("-")))
    if not is_sampled(campaign):
        logs = [campaign.track_file(flight, node) for node in nodes if campaign.logged(flight, node)]
        return map(campaign.relative, (*campaign.history_files(flight, nodes[-1]), *logs))
    source = campaign.symbol_source(flight, pair)
    others = [source] if source is not None and source not in nodes else []
    samples = [campaign.promised_files(flight, node)[-1] for node in (*nodes, *others)]
    files = [campaign.relative(path) for path in (*campaign.sent_files, *samples)]
    files += [campaign.manifest(stage, flight, node) for node in others for stage in ("raw", "track")]
    calibration = campaign.settings.calibration
    if calibration is not None and campaign.flight(flight).kind == "image":
        files.append(campaign.manifest("calibration", calibration.flight))
    return files


def received(scope: JobScope) -> Iterable[str]:
    """Return the files from which transfer functions of the pairs are computed, in addition to stage `echo`."""
    campaign, samples = scope.campaign, list[Path]()
    for flight, pair in scope.pairs:
        receiver = pair.split("-")[1]
        nodes = dict.fromkeys([receiver, campaign.symbol_source(flight, pair) or receiver])
        samples += [campaign.promised_files(flight, node)[-1] for node in nodes]
    return map(campaign.relative, (*campaign.sent_files, *samples))


def echoes_that_bound_the_scene(scope: JobScope) -> Iterable[str]:
    """Return the echoes from which an automatic grid is derived; empty for a configured grid."""
    campaign, stated = scope.campaign, scope.campaign.settings.scene
    first = campaign.image_flights[0]
    is_automatic = "auto" in {stated.crs, stated.spacing_m, stated.bounds_m}
    return [campaign.manifest("echo", first.name, pair) for pair in first.pairs] if is_automatic else []


def first_flight(scope: JobScope) -> Iterable[str]:
    """Return the images and the assessment of the first flight, to which the other flights are compared."""
    campaign, first = scope.campaign, scope.campaign.image_flights[0]
    if scope.where[0] == first.name:
        return []
    images = [campaign.manifest("image", first.name, pair) for pair in first.pairs]
    return [*images, campaign.manifest("assessment", first.name)]


def unstaged_positions(scope: JobScope) -> Iterable[str]:
    """Return the sources of positions for phase histories, which have no stage `track`: flight logs or echoes."""
    campaign = scope.campaign
    if is_sampled(campaign):
        return []
    nodes = [(flight, node) for flight, node in scope.below(Scope.NODE)]
    logs = [campaign.relative(campaign.track_file(*at)) for at in nodes if campaign.logged(*at)]
    return logs or [campaign.manifest("echo", *pair) for pair in scope.pairs]


def heights(scope: JobScope) -> Iterable[str]:
    """Return the files of the DEM and of the geoid grid."""
    return map(scope.campaign.relative, scope.campaign.height_files().values())


def ground_under_air(scope: JobScope) -> Iterable[str]:
    """Return the files of terrain heights if the refractivity depends on the terrain."""
    return [] if scope.campaign.settings.scene.atmosphere == "vacuum" else heights(scope)


def air(scope: JobScope) -> Mapping[str, Any]:
    """Return the settings of the atmosphere; the terrain height is rounded to the step used for the refractivity."""
    stated = scope.campaign.values["scene"]
    if stated["atmosphere"] == "vacuum":
        return {"scene": {"atmosphere": "vacuum"}}
    ground = ("dem_datum", "bounds_m", "crs") if stated["dem"] else ("height_datum",)
    of_ground = {key: stated[key] for key in ground}
    if not stated["dem"]:
        of_ground["height_m"] = round(stated["height_m"], -1)
    return {"scene": {"atmosphere": stated["atmosphere"], **of_ground}}


def patterns(scope: JobScope) -> Iterable[str]:
    """Return the files of the antenna patterns of the pairs."""
    files = (path for _, pair in scope.pairs for path in scope.campaign.pattern_files(pair).values())
    return map(scope.campaign.relative, files)


def autofocused(scope: JobScope) -> Iterable[str]:
    """Return the sources of autofocus; empty if autofocus is off."""
    if scope.campaign.settings.processing.autofocus == "off":
        return []
    stages = [scope.campaign.manifest(stage, *pair) for pair in scope.pairs for stage in ("echo", "profile")]
    return [*stages, *patterns(scope)]


def transmitter_raw(scope: JobScope) -> Iterable[str]:
    """Return the manifest of the transmitter's recording."""
    campaign, (flight, pair) = scope.campaign, scope.where
    return [campaign.manifest("raw", flight, pair.partition("-")[0])] if is_sampled(campaign) else []


def truth(scope: JobScope) -> Iterable[str]:
    """Return the file of true target positions of a simulation."""
    return ["truth.json"] if (scope.campaign.root / "truth.json").is_file() else []


def everything_recorded(scope: JobScope) -> Iterable[str]:
    """Return all recorded files."""
    campaign = scope.campaign
    nodes = [(flight.name, node) for flight in campaign.flights for node in flight.nodes]
    return [campaign.relative(path) for at in nodes for path in campaign.raw_files(*at).values()]


def config_files(scope: JobScope) -> Iterable[str]:
    """Return the existing config files."""
    from apertura.campaign.config import CLOCKS, CONFIG, FLIGHTS, SEGMENTS

    files = (CONFIG, FLIGHTS, SEGMENTS, CLOCKS)
    return [path.as_posix() for path in files if (scope.campaign.root / path).is_file()]


def everything(scope: JobScope) -> Mapping[str, Any]:
    """Return all settings."""
    return scope.campaign.values


def log_settings(scope: JobScope) -> Mapping[str, Any]:
    """Return the settings for reading a node's log."""
    stated = scope.campaign.values["nodes"][scope.where[1]]["log"]
    return {name: value for name, value in stated.items() if name not in {"longest_gap_s", "smoothing_m"}}


def unstaged_log_settings(scope: JobScope) -> Mapping[str, Any]:
    """Return the settings for reading the logs of a flight; empty if there are stages `track`."""
    if is_sampled(scope.campaign):
        return {}
    nodes = {at[1]: at for at in scope.below(Scope.NODE) if scope.campaign.logged(*at)}
    return {"log": {node: log_settings(JobScope(scope.campaign, Scope.NODE, at)) for node, at in nodes.items()}}


def polarisations(scope: JobScope) -> Mapping[str, Any]:
    """Return the configured polarisations of the pairs."""
    from apertura.campaign.config import polarisation_of

    names = sorted({pair for _, pair in scope.pairs})
    labels = {pair: polarisation_of(scope.campaign.settings.nodes, pair) for pair in names}
    return {"polarisations": {pair: label for pair, label in labels.items() if label}} if any(labels.values()) else {}


def stated_errors(scope: JobScope) -> Mapping[str, Any]:
    """Return the configured position accuracy of a flight's logs."""
    nodes = scope.campaign.values["nodes"]
    return {"position_std_m": {node: nodes[node]["position_std_m"] for (_, node) in scope.below(Scope.NODE)}}


def antennas(scope: JobScope) -> Mapping[str, Any]:
    """Return the antenna beams of the pairs."""
    beams = {point: beam.model_dump(mode="json") for point, (_, beam) in _beams(scope).items()}
    return {"antennas": beams} if beams else {}


def _beams(scope: JobScope) -> Mapping[str, tuple[str, Any]]:
    return {point: beam for _, pair in scope.pairs for point, beam in scope.campaign.antennas(pair).items()}


_RADIO = frozenset({"antennas", "transmit_power_dbm", "receiver", "amplitude_std_db"})
"""Settings of a node that do not affect its echoes."""


def radio(scope: JobScope) -> Mapping[str, Any]:
    """Return the radios of the pairs and the settings of radiometry; empty if images are relative."""
    from apertura.campaign.config import Receiver, polarisation_of, radio_of

    campaign = scope.campaign
    if not campaign.calibrated:
        return {}
    nodes = campaign.settings.nodes
    stated: dict[str, Any] = {
        key: value.model_dump(mode="json") if isinstance(value, Receiver) else value
        for _, pair in scope.pairs
        for key, value in radio_of(nodes, pair).items()
    }
    stated |= {pair: label for _, pair in scope.pairs if (label := polarisation_of(nodes, pair))}
    stated |= {f"nodes.{node}.amplitude_std_db": nodes[node].amplitude_std_db for (_, node) in scope.below(Scope.NODE)}
    processing = campaign.settings.processing
    measured = {"radiometric_calibration": named} if (named := processing.radiometric_calibration) else {}
    return {"radio": stated, "radiometry": list(processing.radiometry), **measured}


def coefficients(scope: JobScope) -> Mapping[str, Any]:
    """Return the names of the backscattering coefficients and mean powers to be written; empty if there are none."""
    written = scope.campaign.coefficients
    return {"radiometry": list(written)} if written else {}


def multilook(scope: JobScope) -> Mapping[str, Any]:
    """Return the settings of multilooking; empty if multilooking is off."""
    stated = scope.campaign.values["processing"]["multilook"]
    return {"multilook": stated} if stated else {}


def measured_image(scope: JobScope) -> Iterable[str]:
    """Return the image, transmitted signal and file of constants, as far as calibration or multilooking need these."""
    campaign, files = scope.campaign, list[Path]()
    if campaign.calibrated:
        files += campaign.sent_files if is_sampled(campaign) else []
        files += [path for path in [campaign.calibration_file] if path is not None]
    is_needed = campaign.calibrated or multilook(scope)
    return [*map(campaign.relative, files), *(campaign.manifest("image", *pair) for pair in scope.pairs if is_needed)]


def pair_settings(scope: JobScope) -> Mapping[str, Any]:
    """Return the settings that affect the echo of a pair: those of its nodes, and the presence (not shape) of beams."""
    campaign, (flight, pair) = scope.campaign, scope.where
    nodes = {
        node: {key: value for key, value in campaign.values["nodes"][node].items() if key not in _RADIO}
        for node in pair.split("-")
    }
    stated = {
        "beams": sorted(_beams(scope)),
        "segments": [list(segment) for segment in campaign.segments_of(flight, pair)],
        "clocks": [asdict(clock) for clock in campaign.clocks if clock.flight == flight and clock.node in nodes],
    }
    return {"nodes": nodes, **{name: value for name, value in stated.items() if value}}


_POINTS = frozenset({"reference_points", "reflectors"})
"""Settings of the scene that do not affect its grid."""


def grid(scope: JobScope) -> Mapping[str, Any]:
    """Return the settings of the grid."""
    stated = scope.campaign.values["scene"]
    return {"scene": {key: value for key, value in stated.items() if key not in _POINTS}}


_BEFORE_THE_IMAGE = frozenset(
    {
        "window",
        "sidelink",
        "symbol_filter",
        "background",
        "interference",
        "false_alarms_per_s",
        "autofocus",
        "autofocus_method",
        "keep",
    }
)
_AFTER_THE_IMAGE = frozenset({"fusion", "radiometry", "radiometric_calibration", "multilook"})


def imaging(scope: JobScope) -> Mapping[str, Any]:
    """Return the settings of section `processing` except those of other rules; new keys count as image settings."""
    processing = scope.campaign.values["processing"]
    return {name: value for name, value in processing.items() if name not in _BEFORE_THE_IMAGE | _AFTER_THE_IMAGE}


def two_images(scope: JobScope) -> Mapping[str, Any]:
    """Return the compared images, as flight/pair."""
    return {"images": ["/".join(pair) for pair in scope.pairs]}


def charted_pair(scope: JobScope) -> Mapping[str, Any]:
    """Return the pair of `apertura chart`."""
    return {"pair": list(charted(scope.campaign))}
