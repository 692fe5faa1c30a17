"""Functions that rows of rules quote: scope of a job, and files and settings that are not results.

Nothing is imported here but what a function needs when it is called: the command line reads the rows.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from apertura.campaign.folder import Campaign


class Scope(Enum):
    """Scope of a rule, with the wildcards of its jobs as Snakemake has them."""

    NODE = "node", ("flight", "node")
    PAIR = "pair", ("flight", "pair")
    FLIGHT = "flight", ("flight",)
    TWO = "two images", ("two",)
    CAMPAIGN = "campaign", ()
    CHARTED = "charted pair", ()

    def __init__(self, _: str, wildcards: tuple[str, ...]) -> None:
        self.wildcards = wildcards


@dataclass(frozen=True)
class JobPlace:
    """Scope of one job.

    Attributes
    ----------
    campaign
        Settings and flights.
    of
        Kind of the place.
    where
        Values of the wildcards.
    """

    campaign: "Campaign"
    of: Scope
    where: tuple[str, ...]

    @property
    def pairs(self) -> list[tuple[str, str]]:
        """Flight and pair of every image that the place covers."""
        campaign = self.campaign
        if self.of is Scope.PAIR:
            return [(self.where[0], self.where[1])]
        if self.of is Scope.FLIGHT:
            return [(self.where[0], pair) for pair in campaign.flight(self.where[0]).pairs]
        if self.of is Scope.TWO:
            return [(flight, pair) for flight, pair in campaign.settings.interferometry.images(self.where[0])]
        if self.of is Scope.CHARTED:
            return [charted(campaign)]
        return [(flight.name, pair) for flight in campaign.image_flights for pair in flight.pairs]

    def below(self, of: Scope) -> list[tuple[str, ...]]:
        """Return the places of another kind that belong to this one, each once.

        Examples
        --------
        >>> JobPlace(None, Scope.PAIR, ("f01", "uav1-uav2")).below(Scope.NODE)
        [('f01', 'uav1'), ('f01', 'uav2')]
        """
        if of is self.of:
            return [self.where]
        if of is Scope.CAMPAIGN:
            return [()]
        if of is Scope.NODE:
            found: Iterable[tuple[str, ...]] = ((name, node) for name, pair in self.pairs for node in pair.split("-"))
        elif of is Scope.FLIGHT:
            found = ((name,) for name, _ in self.pairs)
        else:
            found = self.pairs
        return list(dict.fromkeys(found))


SourceSpec = str | Callable[[JobPlace], Iterable[str]]
SettingSpec = str | Callable[[JobPlace], Mapping[str, Any]]
"""Input of a result in its row: a name, or a function of the place that returns names."""


def charted(campaign: "Campaign") -> tuple[str, str]:
    """Return the flight and the pair that are charted: the last pair of the first flight, bistatic where one is.

    Raises
    ------
    CampaignError
        If no flight becomes an image.
    """
    campaign.check_images()
    return campaign.image_flights[0].name, campaign.image_flights[0].pairs[-1]


def is_sampled(campaign: "Campaign") -> bool:
    """Test whether samples were recorded, and not phase histories."""
    from apertura.campaign.config import SampledWaveform

    return isinstance(campaign.settings.waveform, SampledWaveform)


def of_samples(place: JobPlace) -> bool:
    """Test whether samples were recorded, as `is_sampled`."""
    return is_sampled(place.campaign)


def adds_up(place: JobPlace) -> bool:
    """Test whether a flight has pairs to add up."""
    from apertura.campaign.config import FUSED

    return FUSED in place.campaign.flight(place.where[0]).images


def recording(place: JobPlace) -> Iterable[str]:
    """Return the files of what a node recorded."""
    return map(place.campaign.relative, place.campaign.promised_files(*place.where))


def recorded_on_the_bench(place: JobPlace) -> Iterable[str]:
    """Return the recordings of a flight, and what was transmitted."""
    campaign, flight = place.campaign, place.campaign.flight(place.where[0])
    if not is_sampled(campaign):
        return []
    files = (path for node in flight.nodes for path in campaign.promised_files(flight.name, node))
    return map(campaign.relative, (*files, campaign.sent_file))


def stated_paths(place: JobPlace) -> Mapping[str, Any]:
    """Return the configured electrical paths of a flight's nodes."""
    nodes = place.campaign.values["nodes"]
    return {"path_offset_m": {node: nodes[node]["path_offset_m"] for (_, node) in place.below(Scope.NODE)}}


def sample_orders(place: JobPlace) -> Mapping[str, Any]:
    """Return the configured order of I and Q of each node, where it is not that of the waveform."""
    nodes = place.campaign.settings.nodes
    orders = {node: nodes[node].iq for (_, node) in place.below(Scope.NODE) if nodes[node].iq is not None}
    return {"iq": orders} if orders else {}


def log(place: JobPlace) -> Iterable[str]:
    """Return a node's flight log."""
    return [place.campaign.relative(place.campaign.track_file(*place.where))]


def transmitted_and_received(place: JobPlace) -> Iterable[str]:
    """Return the files that an echo is read from, and the calibration that it is corrected by."""
    campaign, (flight, pair) = place.campaign, place.where
    nodes = list(dict.fromkeys(pair.split("-")))
    if not is_sampled(campaign):
        logs = [campaign.track_file(flight, node) for node in nodes if campaign.logged(flight, node)]
        return map(campaign.relative, (*campaign.history_files(flight, nodes[-1]), *logs))
    samples = [campaign.promised_files(flight, node)[-1] for node in nodes]
    files = [campaign.relative(path) for path in (campaign.sent_file, *samples)]
    calibration = campaign.settings.calibration
    if calibration is not None and campaign.flight(flight).kind == "image":
        files.append(campaign.manifest("calibration", calibration.flight))
    return files


def received(place: JobPlace) -> Iterable[str]:
    """Return the files that the transfer functions of the pairs are formed from, beside what was measured of these."""
    campaign = place.campaign
    samples = (campaign.promised_files(flight, pair.split("-")[1])[-1] for flight, pair in place.pairs)
    return map(campaign.relative, (campaign.sent_file, *samples))


def echoes_that_bound_the_scene(place: JobPlace) -> Iterable[str]:
    """Return the echoes that decide the grid, where the config leaves it open."""
    campaign, stated = place.campaign, place.campaign.settings.scene
    first = campaign.image_flights[0]
    by_flight = "auto" in {stated.crs, stated.spacing_m, stated.bounds_m}
    return [campaign.manifest("echo", first.name, pair) for pair in first.pairs] if by_flight else []


def unstaged_positions(place: JobPlace) -> Iterable[str]:
    """Return the sources of positions of a phase history, which has no stage `track`: flight logs, else echoes."""
    campaign = place.campaign
    if is_sampled(campaign):
        return []
    nodes = [(flight, node) for flight, node in place.below(Scope.NODE)]
    logs = [campaign.relative(campaign.track_file(*at)) for at in nodes if campaign.logged(*at)]
    return logs or [campaign.manifest("echo", *pair) for pair in place.pairs]


def heights(place: JobPlace) -> Iterable[str]:
    """Return the files of the DEM and of the geoid."""
    return map(place.campaign.relative, place.campaign.height_files().values())


def ground_under_air(place: JobPlace) -> Iterable[str]:
    """Return the files that the height of the ground comes from, where it decides the air."""
    return [] if place.campaign.settings.scene.atmosphere == "vacuum" else heights(place)


def air(place: JobPlace) -> Mapping[str, Any]:
    """Return the settings of the air on the paths: of the ground's height no more than matters."""
    stated = place.campaign.values["scene"]
    if stated["atmosphere"] == "vacuum":
        return {"scene": {"atmosphere": "vacuum"}}
    ground = ("dem_datum", "bounds_m", "crs") if stated["dem"] else ("height_datum",)
    of_ground = {key: stated[key] for key in ground}
    if not stated["dem"]:
        of_ground["height_m"] = round(stated["height_m"], -1)
    return {"scene": {"atmosphere": stated["atmosphere"], **of_ground}}


def patterns(place: JobPlace) -> Iterable[str]:
    """Return the files of the sampled patterns of the pairs' antennas."""
    files = (path for _, pair in place.pairs for path in place.campaign.pattern_files(pair).values())
    return map(place.campaign.relative, files)


def autofocused(place: JobPlace) -> Iterable[str]:
    """Return the settings of images formed by autofocus; empty where it is off."""
    if place.campaign.settings.processing.autofocus == "off":
        return []
    stages = [place.campaign.manifest(stage, *pair) for pair in place.pairs for stage in ("echo", "profile")]
    return [*stages, *patterns(place)]


def transmitter_raw(place: JobPlace) -> Iterable[str]:
    """Return the manifest of what the transmitter recorded."""
    campaign, (flight, pair) = place.campaign, place.where
    return [campaign.manifest("raw", flight, pair.partition("-")[0])] if is_sampled(campaign) else []


def truth(place: JobPlace) -> Iterable[str]:
    """Return the file of true target places of a simulation."""
    return ["truth.json"] if (place.campaign.root / "truth.json").is_file() else []


def everything_recorded(place: JobPlace) -> Iterable[str]:
    """Return every file that was recorded."""
    campaign = place.campaign
    nodes = [(flight.name, node) for flight in campaign.flights for node in flight.nodes]
    return [campaign.relative(path) for at in nodes for path in campaign.raw_files(*at).values()]


def config_files(place: JobPlace) -> Iterable[str]:
    """Return the files of the config that are there."""
    from apertura.campaign.config import CLOCKS, CONFIG, FLIGHTS, SEGMENTS

    files = (CONFIG, FLIGHTS, SEGMENTS, CLOCKS)
    return [path.as_posix() for path in files if (place.campaign.root / path).is_file()]


def everything(place: JobPlace) -> Mapping[str, Any]:
    """Return all settings."""
    return place.campaign.values


def log_settings(place: JobPlace) -> Mapping[str, Any]:
    """Return the settings for reading a node's log."""
    stated = place.campaign.values["nodes"][place.where[1]]["log"]
    return {name: value for name, value in stated.items() if name not in {"longest_gap_s", "smoothing_m"}}


def unstaged_log_settings(place: JobPlace) -> Mapping[str, Any]:
    """Return the settings for reading the logs of a flight, where no stage `track` holds them."""
    if is_sampled(place.campaign):
        return {}
    nodes = {at[1]: at for at in place.below(Scope.NODE) if place.campaign.logged(*at)}
    return {"log": {node: log_settings(JobPlace(place.campaign, Scope.NODE, at)) for node, at in nodes.items()}}


def polarisations(place: JobPlace) -> Mapping[str, Any]:
    """Return the stated polarisations of the pairs."""
    from apertura.campaign.config import polarisation_of

    names = sorted({pair for _, pair in place.pairs})
    labels = {pair: polarisation_of(place.campaign.settings.nodes, pair) for pair in names}
    return {"polarisations": {pair: label for pair, label in labels.items() if label}} if any(labels.values()) else {}


def stated_errors(place: JobPlace) -> Mapping[str, Any]:
    """Return the configured errors of a flight's logs."""
    nodes = place.campaign.values["nodes"]
    return {"position_std_m": {node: nodes[node]["position_std_m"] for (_, node) in place.below(Scope.NODE)}}


def antennas(place: JobPlace) -> Mapping[str, Any]:
    """Return the beams of the pairs' antennas."""
    beams = {point: beam.model_dump(mode="json") for point, (_, beam) in _beams(place).items()}
    return {"antennas": beams} if beams else {}


def _beams(place: JobPlace) -> Mapping[str, tuple[str, Any]]:
    return {point: beam for _, pair in place.pairs for point, beam in place.campaign.antennas(pair).items()}


_RADIO = frozenset({"antennas", "transmit_power_dbm", "receiver", "amplitude_std_db"})
"""Settings of a node that its echoes do not depend on."""


def radio(place: JobPlace) -> Mapping[str, Any]:
    """Return the radios of the pairs and what is made of them; nothing where images are relative."""
    from apertura.campaign.config import Receiver, polarisation_of, radio_of

    campaign = place.campaign
    if not campaign.calibrated:
        return {}
    nodes = campaign.settings.nodes
    stated: dict[str, Any] = {
        key: value.model_dump(mode="json") if isinstance(value, Receiver) else value
        for _, pair in place.pairs
        for key, value in radio_of(nodes, pair).items()
    }
    stated |= {pair: label for _, pair in place.pairs if (label := polarisation_of(nodes, pair))}
    stated |= {f"nodes.{node}.amplitude_std_db": nodes[node].amplitude_std_db for (_, node) in place.below(Scope.NODE)}
    processing = campaign.settings.processing
    measured = {"radiometric_calibration": named} if (named := processing.radiometric_calibration) else {}
    return {"radio": stated, "radiometry": list(processing.radiometry), **measured}


def coefficients(place: JobPlace) -> Mapping[str, Any]:
    """Return the backscattering coefficients and mean powers to write; empty where none is."""
    written = place.campaign.coefficients
    return {"radiometry": list(written)} if written else {}


def multilook(place: JobPlace) -> Mapping[str, Any]:
    """Return the settings of power averaging; empty where it is off."""
    stated = place.campaign.values["processing"]["multilook"]
    return {"multilook": stated} if stated else {}


def noise_of_sums(place: JobPlace) -> Iterable[str]:
    """Return the manifests of what states the noise of a flight's images, where it is taken off their sums."""
    multilooking = place.campaign.settings.processing.multilook
    subtracted = multilooking is not None and multilooking.subtract_noise
    return [place.campaign.manifest("layers", *pair) for pair in place.pairs] if subtracted else []


def measured_image(place: JobPlace) -> Iterable[str]:
    """Return the image that is calibrated, with what was sent and the file of constants, or averaged; else nothing."""
    campaign, files = place.campaign, list[Path]()
    if campaign.calibrated:
        files += [campaign.sent_file] if is_sampled(campaign) else []
        files += [path for path in [campaign.calibration_file] if path is not None]
    is_needed = campaign.calibrated or multilook(place)
    return [*map(campaign.relative, files), *(campaign.manifest("image", *pair) for pair in place.pairs if is_needed)]


def calibration_of_images(place: JobPlace) -> Iterable[str]:
    """Return the manifests of what states the radiometry of images; nothing where they are relative."""
    campaign = place.campaign
    return [campaign.manifest("layers", *pair) for pair in place.pairs] if campaign.calibrated else []


def pair_settings(place: JobPlace) -> Mapping[str, Any]:
    """Return the settings of a pair's echo: its nodes and the presence of beams, not their shapes."""
    campaign, (flight, pair) = place.campaign, place.where
    nodes = {
        node: {key: value for key, value in campaign.values["nodes"][node].items() if key not in _RADIO}
        for node in pair.split("-")
    }
    stated = {
        "beams": sorted(_beams(place)),
        "segments": [list(segment) for segment in campaign.segments_of(flight, pair)],
        "clocks": [asdict(one) for one in campaign.clocks if one.flight == flight and one.node in nodes],
    }
    return {"nodes": nodes, **{name: value for name, value in stated.items() if value}}


_POINTS = frozenset({"reference_points", "reflectors"})
"""Settings of the scene that its grid does not depend on."""


def grid(place: JobPlace) -> Mapping[str, Any]:
    """Return the settings of the grid."""
    stated = place.campaign.values["scene"]
    return {"scene": {key: value for key, value in stated.items() if key not in _POINTS}}


_BEFORE_THE_IMAGE = frozenset(
    {"window", "sidelink", "background", "interference", "false_alarms_per_s", "autofocus", "autofocus_method", "keep"}
)
_AFTER_THE_IMAGE = frozenset({"fusion", "radiometry", "radiometric_calibration", "multilook"})


def imaging(place: JobPlace) -> Mapping[str, Any]:
    """Return all settings of the processing but those of other rules: a new one counts for the image."""
    processing = place.campaign.values["processing"]
    return {name: value for name, value in processing.items() if name not in _BEFORE_THE_IMAGE | _AFTER_THE_IMAGE}


def two_images(place: JobPlace) -> Mapping[str, Any]:
    """Return the images compared, as flight/pair."""
    return {"images": ["/".join(pair) for pair in place.pairs]}


def charted_pair(place: JobPlace) -> Mapping[str, Any]:
    """Return the pair that is charted."""
    return {"pair": list(charted(place.campaign))}
