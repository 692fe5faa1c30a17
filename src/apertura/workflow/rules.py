"""Rules of the workflow, one row per rule: result, sources, settings, function, resources and cost.

Lineage, resources, the remaining time and `apertura step` are derived from the rows. A test compares the rows with the
rules in `workflow/`. Rows refer to functions by `Lazy`, because the command line also imports the rows.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

from apertura.common.lazy import Lazy, module_of
from apertura.formats.catalog import DOCUMENTS
from apertura.workflow import rule_inputs as inputs
from apertura.workflow.rule_inputs import Scope

INTERFEROMETRY = "interferometry"
"""Results folder of interferograms."""

STACK = "stack"
"""Results folder of the stack."""

STUDY = "study"
"""Results folder of benchmark measurements, which are only made on demand."""

EVERY = "*"
"""Source of a result that describes all results except those written on demand."""


@dataclass(frozen=True)
class Demand:
    """Cluster resources of a job: a constant and terms proportional to the work, derived from measured runs.

    Attributes
    ----------
    base_mb
        Resident memory independent of the work: 1.5 times the memory measured for a small amount of work.
    pulse_bytes, pixel_bytes, tile_bytes, image_bytes
        Memory per pulse, per pixel held in memory at a time, per tile to be formed, and per described image.
    profile_share
        Memory per byte of range profiles held in memory at a time.
    threads
        Largest useful number of threads.
    recorded_s
        Seconds per recorded GB.
    pixel_s
        Seconds per million pixels and image.
    sum_s
        Seconds of a single thread per 1e9 contributions (pixels × pulses).
    """

    base_mb: float
    pulse_bytes: float = 0.0
    pixel_bytes: float = 0.0
    tile_bytes: float = 0.0
    image_bytes: float = 0.0
    profile_share: float = 0.0
    threads: int = 1
    recorded_s: float = 0.0
    pixel_s: float = 0.0
    sum_s: float = 0.0


@dataclass(frozen=True)
class Cost:
    """Expected run time of a job, started by a fork, on two CPU cores of 2025.

    During a run, the expected run times are scaled by the measured run times.

    Attributes
    ----------
    begin_s
        Seconds independent of the work.
    mb_s, mpx_s, mb_mpx_s
        Seconds per recorded MB, per million pixels, and per product of both numbers.
    all_cores
        True if a job uses all cores.
    last
        True if no other rule, or hardly any other rule, depends on the rule.
    """

    begin_s: float = 0.4
    mb_s: float = 0.0
    mpx_s: float = 0.0
    mb_mpx_s: float = 0.0
    all_cores: bool = False
    last: bool = False

    @property
    def of_imaging(self) -> bool:
        """True if a job sums pulses at all pixels, so that its run time varies with the plan by orders of magnitude."""
        return bool(self.mb_mpx_s)

    @property
    def of_rasters(self) -> bool:
        """True if a job mainly reads and writes rasters; predicted run times of such jobs have similar errors."""
        return bool(self.mpx_s) and not self.mb_s and not self.mb_mpx_s


@dataclass(frozen=True)
class Rule:
    """Rule of the workflow.

    Attributes
    ----------
    name
        Name in the workflow.
    of
        Scope of the jobs of the rule.
    help
        One-sentence description, printed by `apertura step`.
    step
        Function that writes the result and returns the written paths; its arguments are a campaign and the values of
        the wildcards.
    sources
        Names of results within the scope of the job, and functions of the scope that return further manifests and
        files, relative to the campaign folder.
    settings
        Settings that affect the result: dotted keys, and functions of the scope that return further values by name.
    demand
        Cluster resources of a job; None if Snakemake itself computes the result.
    cost
        Expected run time of a job.
    result
        Name of the result; empty for the name of the rule.
    products
        Files next to the manifest that are intended for users.
    documents
        Files next to the manifest that are intended for other rules.
    exports
        Kind of the rows of `apertura.formats.export` that the rule writes.
    styles
        True if the rule writes the styles of all rows.
    manifest
        Path relative to the results, without ``.manifest.json``; empty to derive the path from the scope and the name
        of the result.
    kinds
        Kinds of flights to which the rule applies.
    needed
        Function that returns True if the result exists in a scope.
    on_demand
        True if the result is only written on request, not by every run.
    shares
        True if the rule computes part of `result`, which another rule completes.
    forms
        True if the step reads transfer functions of its pairs, which are computed from the recordings of receivers.
    reads
        Readers (of recordings, of logs) whose code affects the result, if the step reads recorded files.
    command
        Name of the `apertura step` command; empty for the name of the rule.
    arguments, options
        Arguments and options of that command; empty arguments for the wildcards.
    last_words
        Arguments after the wildcards, for a command that is used by several rules.
    """

    name: str
    of: Scope
    help: str
    step: Callable[..., Any]
    sources: tuple[inputs.SourceSpec, ...]
    settings: tuple[inputs.SettingSpec, ...] = ()
    demand: Demand | None = None
    cost: Cost = Cost()
    result: str = ""
    products: tuple[str, ...] = ()
    documents: tuple[str, ...] = ()
    exports: str = ""
    styles: bool = False
    manifest: str = ""
    kinds: tuple[str, ...] = ("image",)
    needed: Callable[[inputs.JobScope], bool] = lambda _: True
    on_demand: bool = False
    shares: bool = False
    forms: bool = False
    reads: tuple[str, ...] = ("recordings", "logs")
    command: str = ""
    arguments: tuple[str, ...] = ()
    options: tuple[str, ...] = ()
    last_words: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Set the default values that follow from the name and the scope."""
        folder = "/".join(f"{{{word}}}" for word in self.of.wildcards)
        defaults = {
            "result": self.name,
            "manifest": f"{folder}/{self.result or self.name}".removeprefix("/"),
            "command": self.name.replace("_", "-"),
            "arguments": self.of.wildcards,
        }
        for field, value in defaults.items():
            if not getattr(self, field):
                object.__setattr__(self, field, value)

    @property
    def module(self) -> str:
        """Dotted name of the module that contains the step function."""
        return module_of(self.step)

    @property
    def folder(self) -> str:
        """Folder of the result relative to the results folder, with wildcards in braces."""
        return self.manifest.rpartition("/")[0]

    @property
    def log(self) -> str:
        """Path of the rule's log and benchmark files relative to their folders, without file extension.

        Examples
        --------
        >>> RULES["echo"].log, RULES["calibrate"].log, RULES["cube"].log
        ('{flight}/{pair}.echo', '{flight}/calibrate', 'cube')
        """
        above, _, last = self.folder.rpartition("/")
        if not self.of.wildcards:
            return self.name
        return f"{above}/{last}.{self.name}" if above else f"{last}/{self.name}"

    def command_line(self, where: Iterable[str]) -> str:
        """Return the shell command of a job.

        Parameters
        ----------
        where
            Values of the wildcards.

        Examples
        --------
        >>> RULES["ingest"].command_line(("f01", "uav1")), RULES["export_fused"].command_line(["f01"])
        ('apertura step ingest f01 uav1', 'apertura step export f01 fused')
        """
        return " ".join(["apertura step", self.command, *where, *self.last_words])


def _workflow(_: inputs.JobScope) -> Mapping[str, Any]:
    from apertura.common.paths import shipped
    from apertura.common.provenance import canonical_json, sha256_text, sha256_tree

    commands = {rule.name: rule.command_line(rule.of.wildcards) for rule in RULES.values()}
    return {"workflow": sha256_text(canonical_json([sha256_tree(shipped() / "workflow"), commands]))}


_STAGES, _VIEWS, _TOOLS = Lazy("apertura.stages"), Lazy("apertura.views"), Lazy("apertura.tools")
_GROUND = ("scene", "terrain")
_FORMED = ("echo", "profile", *_GROUND, inputs.patterns)
_IMAGE_SETTINGS = (inputs.imaging, inputs.antennas)

_INGEST = Rule(
    "ingest",
    Scope.NODE,
    "Read a node's recording and flight log into raw.zarr and track.zarr.",
    _STAGES.ingest.ingest,
    result="raw",
    sources=(inputs.recording,),
    settings=("waveform", "processing.false_alarms_per_s", inputs.sample_orders),
    reads=("recordings",),
    kinds=("calibration", "image"),
    needed=inputs.of_samples,
    demand=Demand(250, pulse_bytes=100, recorded_s=60),
    cost=Cost(0.3, mb_s=0.003),
)

_IMAGE = Rule(
    "image",
    Scope.PAIR,
    "Form the image of a pair, image.zarr.",
    _STAGES.image.image,
    sources=(*_FORMED, "refined_track"),
    settings=_IMAGE_SETTINGS,
    forms=True,
    demand=Demand(
        900,
        pulse_bytes=1000,
        pixel_bytes=30,
        tile_bytes=15_000,
        profile_share=3.0,
        threads=4,
        recorded_s=30,
        pixel_s=5,
        sum_s=3,
    ),
    cost=Cost(0.6, mpx_s=1.2, mb_mpx_s=0.00001, all_cores=True),
    options=("threads",),
)

_ROWS = (
    _INGEST,
    replace(
        _INGEST, result="track", manifest="", sources=(inputs.log,), settings=(inputs.log_settings,), reads=("logs",)
    ),
    Rule(
        "bench",
        Scope.FLIGHT,
        "Measure channels, clocks and links of a stationary radar; write bench.json, bench.html and bench.png.",
        _TOOLS.bench.report.bench,
        sources=(inputs.recorded,),
        settings=("campaign", "waveform", "bench", "processing.sidelink", inputs.stated_paths, inputs.sample_orders),
        products=("bench.json", "bench.html", "bench.png"),
        reads=("recordings",),
        kinds=("bench",),
        demand=Demand(500, pulse_bytes=1000, recorded_s=240),
        cost=Cost(0.5, mb_s=0.05, last=True),
    ),
    Rule(
        "echo",
        Scope.PAIR,
        "Determine pulses, phase centres, clock and sidelink of a pair, echo.zarr.",
        _STAGES.echo.echo,
        sources=("raw", "track", inputs.transmitted_and_received, inputs.ground_under_air),
        settings=(
            "waveform",
            "processing.sidelink",
            "processing.symbol_filter",
            "processing.interference",
            "processing.accuracy_db",
            inputs.pair_settings,
            inputs.air,
        ),
        kinds=("calibration", "image"),
        demand=Demand(400, pulse_bytes=400, recorded_s=120),
        cost=Cost(0.3, mb_s=0.0011),
    ),
    Rule(
        "transfer",
        Scope.PAIR,
        "Store the transfer functions of a pair, transfer.zarr, for use without the recording.",
        _STAGES.transfer.transfer,
        sources=("echo", inputs.received),
        reads=("recordings",),
        kinds=("calibration", "image"),
        needed=inputs.of_samples,
        on_demand=True,
        demand=Demand(400, pulse_bytes=400, recorded_s=120),
        cost=Cost(0.3, mb_s=0.001, last=True),
    ),
    Rule(
        "calibrate",
        Scope.FLIGHT,
        "Estimate the path offsets of a calibration flight's pairs, calibration.json.",
        _STAGES.calibration.calibrate,
        result="calibration",
        sources=("echo",),
        settings=("calibration", "scene.crs"),
        documents=("calibration.json",),
        forms=True,
        kinds=("calibration",),
        demand=Demand(500, pulse_bytes=1000, recorded_s=60),
    ),
    Rule(
        "scene",
        Scope.CAMPAIGN,
        "Choose the output grid of the campaign, scene.json.",
        _STAGES.scene.scene,
        sources=(inputs.echoes_that_bound_the_scene, inputs.heights),
        settings=("campaign", inputs.grid),
        documents=("scene.json",),
        demand=Demand(400, pulse_bytes=500),
        cost=Cost(last=True),
    ),
    Rule(
        "terrain",
        Scope.CAMPAIGN,
        "Resample the DEM to the output grid, terrain.zarr.",
        _STAGES.scene.terrain,
        sources=("scene", inputs.heights),
        settings=("scene.dem", "scene.dem_datum", "scene.geoid"),
        needed=lambda scope: bool(scope.campaign.settings.scene.dem),
        demand=Demand(500, pixel_bytes=50, pixel_s=10),
    ),
    Rule(
        "profile",
        Scope.PAIR,
        "Compute the range profiles of a pair over the scene, profile.zarr.",
        _STAGES.profile.profile,
        sources=("echo", *_GROUND, inputs.patterns),
        settings=(
            "processing.window",
            "processing.background",
            "processing.interference",
            "processing.integration",
            inputs.antennas,
        ),
        forms=True,
        demand=Demand(500, pulse_bytes=500, recorded_s=120),
        cost=Cost(0.3, mb_s=0.001),
    ),
    Rule(
        "refine",
        Scope.FLIGHT,
        "Estimate track errors of a flight from its images if autofocus is enabled, refined_track.zarr.",
        _STAGES.refine.refine,
        result="refined_track",
        sources=(inputs.autofocused, *_GROUND),
        settings=("processing.autofocus", "processing.autofocus_method", "scene.reference_points"),
        demand=Demand(600, pulse_bytes=40_000, pixel_bytes=30, pixel_s=10, recorded_s=120),
        cost=Cost(0.3, mb_s=0.02, mpx_s=0.5),
    ),
    Rule(
        "tracks",
        Scope.FLIGHT,
        "Write the refined tracks of a flight (tracks/<node>.pos, .csv), and plot the corrections (tracks.png).",
        _STAGES.tracks.tracks,
        sources=("refined_track", "track", inputs.unstaged_positions),
        settings=("campaign", inputs.stated_errors, inputs.unstaged_log_settings),
        products=("tracks.png",),
        manifest="{flight}/tracks/tracks",
        reads=("logs",),
        demand=Demand(500, recorded_s=5),
        cost=Cost(0.5, last=True),
    ),
    replace(
        _IMAGE,
        name="tiles",
        help="Form a share of an image's tiles in one job, such as '2-of-8'; step image completes the image.",
        step=_STAGES.image.tiles,
        result="image",
        command="tiles",
        shares=True,
        arguments=("flight", "pair", "share"),
        cost=Cost(0.6, mpx_s=0.8, mb_mpx_s=0.00001, all_cores=True),
    ),
    _IMAGE,
    Rule(
        "assess",
        Scope.FLIGHT,
        "Compare the images of a flight and choose the pairs of the coherent sum, assessment.json.",
        _STAGES.assess.assess,
        result="assessment",
        sources=("echo", "image", "refined_track", *_GROUND, inputs.first_flight),
        settings=("processing.fusion",),
        documents=("assessment.json",),
        demand=Demand(500, pulse_bytes=500, pixel_bytes=30, pixel_s=5),
        cost=Cost(0.3, mpx_s=0.09),
    ),
    Rule(
        "cube",
        Scope.CAMPAIGN,
        "Stack all images and compute sums and interferometric phases, cube.zarr.",
        _STAGES.cube.cube,
        sources=("image", "assessment", "scene"),
        settings=("campaign", "metadata", "processing.tile_px"),
        demand=Demand(500, pixel_bytes=50, pixel_s=10, threads=2),
        cost=Cost(0.3, mpx_s=0.65),
        options=("threads",),
    ),
    Rule(
        "layers",
        Scope.PAIR,
        "Write incidence, bistatic angle, mask, looks, noise and, if calibrated, sigma0 of a pair as GeoTIFFs.",
        _STAGES.layers.layers,
        sources=(*_FORMED, inputs.measured_image),
        settings=(
            "campaign",
            "metadata",
            inputs.polarisations,
            "processing.integration",
            inputs.antennas,
            inputs.radio,
            inputs.multilook,
        ),
        exports="layers",
        forms=True,
        demand=Demand(600, pulse_bytes=500, pixel_bytes=30, pixel_s=5, recorded_s=20, threads=2),
        cost=Cost(0.4, mpx_s=0.12, last=True),
        options=("threads",),
    ),
    Rule(
        "export",
        Scope.PAIR,
        "Write GeoTIFFs and the quicklook of a pair, or of the sums ('fused').",
        _STAGES.export.export,
        sources=("image", "assessment", "scene", "layers"),
        settings=("campaign", "metadata", inputs.polarisations),
        documents=DOCUMENTS,
        exports="pair",
        demand=Demand(500, pixel_bytes=50, pixel_s=30),
        cost=Cost(0.4, mpx_s=0.3, last=True),
        options=("threads",),
    ),
    Rule(
        "cphd",
        Scope.PAIR,
        "Write the calibrated transfer functions of a pair as CPHD, phase_history.cphd.",
        _STAGES.cphd.cphd,
        sources=("echo", "profile", "scene"),
        settings=("campaign",),
        products=("phase_history.cphd",),
        forms=True,
        reads=("recordings",),
        on_demand=True,
        demand=Demand(500, pulse_bytes=500, recorded_s=120),
        cost=Cost(0.5, mb_s=0.02, last=True),
    ),
    Rule(
        "coverage",
        Scope.CAMPAIGN,
        "Draw the coverage of all flights and pairs, coverage.png and coverage.geojson.",
        _STAGES.coverage.coverage,
        sources=("echo", "layers", "scene"),
        settings=("campaign",),
        products=("coverage.png", "coverage.geojson"),
        demand=Demand(600, pulse_bytes=500, pixel_s=1),
    ),
    Rule(
        "export_fused",
        Scope.FLIGHT,
        "Write GeoTIFFs and the quicklook of the sums of the pairs of a flight.",
        _STAGES.export.export,
        result="fused",
        sources=("image", "assessment", "scene", "layers"),
        settings=("campaign", "metadata", inputs.polarisations, "processing.tile_px", inputs.multilook),
        documents=DOCUMENTS,
        exports="fused",
        manifest="{flight}/fused/export",
        needed=inputs.adds_up,
        command="export",
        last_words=("fused",),
        demand=Demand(500, pixel_bytes=50, pixel_s=30, threads=2),
        cost=Cost(0.6, mpx_s=0.5),
        options=("threads",),
    ),
    Rule(
        "interferogram",
        Scope.TWO,
        "Compute coherence, unwrapped phase and heights from two images, a pair named in interferometry.pairs.",
        _STAGES.interferogram.interferogram,
        sources=(*_FORMED, "image", "layers"),
        settings=(
            "campaign",
            "metadata",
            inputs.polarisations,
            inputs.two_images,
            "interferometry.window_px",
            "scene.reference_points",
            "processing.integration",
        ),
        documents=("interferogram.json",),
        exports="interferogram",
        manifest=f"{INTERFEROMETRY}/{{two}}/interferogram",
        arguments=("name",),
        demand=Demand(600, pulse_bytes=1000, pixel_bytes=200, pixel_s=60),
        cost=Cost(1.0, mpx_s=20.0, last=True),
    ),
    Rule(
        "stack_image",
        Scope.STACKED,
        "Refer the phase of a flight's image to the stack's reference, without the residual motion of the track.",
        _STAGES.stack.stack_image,
        sources=(*_FORMED, "refined_track", "image", "layers"),
        settings=(
            "campaign",
            "metadata",
            "stack.reference",
            "stack.pair",
            "stack.window_px",
            inputs.polarisations,
            "processing.integration",
        ),
        documents=("stack.json",),
        exports="stack",
        manifest=f"{STACK}/{{flight}}/stack_image",
        demand=Demand(600, pulse_bytes=1000, pixel_bytes=500, pixel_s=60),
        cost=Cost(1.0, mpx_s=10.0),
    ),
    Rule(
        "stack",
        Scope.CAMPAIGN,
        "List baselines, coherence and residual phases of the stack's flights, stack/baselines.csv and stack.json.",
        _STAGES.stack.stack,
        sources=("stack_image",),
        settings=("campaign", "stack.reference", "stack.flights", "stack.pair"),
        products=("baselines.csv",),
        documents=("stack.json",),
        manifest=f"{STACK}/stack",
        needed=lambda scope: scope.campaign.settings.stack is not None,
        demand=Demand(350),
        cost=Cost(0.3, last=True),
    ),
    Rule(
        "change",
        Scope.STACKED,
        "Detect changes of a flight of the stack relative to the reference: rasters, polygons and change.json.",
        _STAGES.change.change,
        sources=("stack_image", inputs.stack_reference, "image", "scene"),
        settings=(
            "campaign",
            "metadata",
            inputs.polarisations,
            "stack.reference",
            "stack.pair",
            "stack.window_px",
            "stack.change",
        ),
        documents=("change.json",),
        exports="change",
        manifest=f"{STACK}/{{flight}}/change",
        needed=inputs.has_reference,
        demand=Demand(400, pixel_bytes=500, pixel_s=20),
        cost=Cost(1.0, mpx_s=10.0, last=True),
    ),
    Rule(
        "mosaic",
        Scope.CAMPAIGN,
        "Write a mosaic of each product from all flights, mosaic/<pair>/<product>.vrt.",
        _STAGES.mosaic.mosaic,
        sources=("layers", "export", "fused"),
        settings=("campaign", inputs.coefficients),
        styles=True,
        manifest="mosaic/mosaic",
        demand=Demand(500),
        cost=Cost(mpx_s=0.11),
    ),
    Rule(
        "stac",
        Scope.CAMPAIGN,
        "Describe all images in a static STAC catalogue, stac/catalog.json.",
        _STAGES.stac.stac,
        sources=("echo", "layers", "export", "fused", "scene", "interferogram"),
        settings=("campaign", "metadata", inputs.polarisations),
        products=("stac/catalog.json",),
        demand=Demand(400, image_bytes=200_000),
    ),
    Rule(
        "pictures",
        Scope.PAIR,
        "Draw the figures of a pair for the report: geometry, pulses, phase, cuts, range profiles, budget.",
        _VIEWS.report.pictures.pictures,
        sources=("echo", "profile", "image", "layers", inputs.transmitter_raw, "refined_track", *_GROUND),
        settings=("campaign",),
        on_demand=True,
        demand=Demand(600, pulse_bytes=2000, pixel_s=5, recorded_s=60),
        cost=Cost(1.0, mb_s=0.01, last=True),
    ),
    Rule(
        "pictures_fused",
        Scope.FLIGHT,
        "Draw the figures of a flight's sums for the report: comparison with the pairs, and cuts through a target.",
        _VIEWS.report.pictures.pictures_fused,
        sources=("export", "image", "assessment", "fused", "scene"),
        settings=("campaign",),
        products=("panels.png", "sum_cuts.png"),
        manifest="{flight}/fused/pictures",
        needed=inputs.adds_up,
        on_demand=True,
        demand=Demand(500, pixel_s=5),
        cost=Cost(0.6, mpx_s=0.5, last=True),
    ),
    Rule(
        "payload",
        Scope.FLIGHT,
        "Read the data in the frames of a flight, with errors and data rate of each node, into payload/.",
        _TOOLS.payload.payload,
        sources=(inputs.recorded,),
        settings=("campaign", "waveform", "processing.accuracy_db", inputs.sample_orders),
        products=("payload.png",),
        documents=("payload.json",),
        manifest="{flight}/payload/payload",
        reads=("recordings",),
        kinds=("bench", "calibration", "image"),
        needed=inputs.has_frames,
        on_demand=True,
        demand=Demand(400, pulse_bytes=2000, recorded_s=120),
        cost=Cost(0.6, mb_s=0.02, last=True),
    ),
    Rule(
        "page",
        Scope.FLIGHT,
        "Write the report page of a flight, report.html.",
        _VIEWS.report.step.page,
        sources=("pictures", "pictures_fused", "export", "fused", "scene", inputs.changes, "payload"),
        settings=(inputs.everything,),
        on_demand=True,
        demand=Demand(500, pixel_s=5),
        cost=Cost(0.6, mpx_s=0.5),
    ),
    Rule(
        "report",
        Scope.CAMPAIGN,
        "Write the first page of Snakemake's report, for `apertura report`.",
        _VIEWS.report.step.landing,
        sources=("page", "coverage"),
        settings=(inputs.everything,),
        on_demand=True,
    ),
    Rule(
        "map",
        Scope.CAMPAIGN,
        "Write the data of `apertura map`, map/map.json.",
        _VIEWS.webmap.document.webmap,
        sources=("layers", "export", "fused", "coverage", "scene", "change", "interferogram", inputs.truth),
        settings=("campaign", "calibration", "scene.reference_points"),
        products=("map.json",),
        manifest="map/map",
        demand=Demand(500, pixel_s=1),
        cost=Cost(mpx_s=0.12, last=True),
    ),
    Rule(
        "speed_accuracy",
        Scope.CHARTED,
        "Measure run time and accuracy of all engines and settings for a pair, within a time limit in seconds.",
        _TOOLS.chart.speed_accuracy.speed_accuracy,
        sources=(*_FORMED, "refined_track"),
        settings=(inputs.charted_pair, *_IMAGE_SETTINGS),
        products=("speed_accuracy.csv", "speed_accuracy.png", "speed_accuracy.html"),
        forms=True,
        manifest=f"{STUDY}/speed_accuracy",
        on_demand=True,
        command="chart",
        arguments=("flight", "pair"),
        options=("seconds",),
        demand=Demand(2000, profile_share=3.0, recorded_s=600),
    ),
    Rule(
        "whole_chart",
        Scope.CAMPAIGN,
        "Measure run time and accuracy from raw samples to GeoTIFFs for several settings, whole.csv and whole.png.",
        _TOOLS.chart.whole.whole_chart,
        result="whole",
        sources=(inputs.everything_recorded, inputs.heights),
        settings=(inputs.everything,),
        products=("whole.csv", "whole.png"),
        manifest=f"{STUDY}/whole",
        on_demand=True,
        options=("repeats",),
        demand=Demand(2000, profile_share=3.0, recorded_s=1200),
    ),
    Rule(
        "ro_crate",
        Scope.CAMPAIGN,
        "Describe the whole run with all files and commands as an RO-Crate, ro-crate-metadata.json.",
        _STAGES.ro_crate.ro_crate,
        sources=(inputs.config_files, EVERY),
        settings=("campaign", "metadata", _workflow),
        products=("ro-crate-metadata.json",),
        demand=Demand(350, image_bytes=1_000_000),
    ),
)

RULES: Mapping[str, Rule] = dict(reversed({row.name: row for row in reversed(_ROWS) if row.demand}.items()))
"""Name of a rule → row; for a rule with several results, the row of the first result."""

RESULTS: Mapping[str, Rule] = {row.result: row for row in _ROWS if not row.shares}
"""Name of a result → row of its rule; each result follows the results on which it depends."""
