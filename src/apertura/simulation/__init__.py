"""Simulation of campaign folders from a scene, tracks and impairments, with the true values in truth.json."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from numbers import Integral
from pathlib import Path

from numpy.random import Generator, default_rng

from apertura.common.documents import validated
from apertura.common.errors import CampaignError, quoted
from apertura.simulation.campaign import write_campaign
from apertura.simulation.continuous import Framing
from apertura.simulation.impairments import Impairments, Radio
from apertura.simulation.presets import PRESETS
from apertura.simulation.specification import (
    CampaignSpecification,
    ImageGrid,
    SimulatedFlight,
    SimulatedNode,
    read_specification,
    specification_text,
)
from apertura.simulation.targets import (
    Clutter,
    GaussianBeam,
    Line,
    Origin,
    Plate,
    PointTarget,
    Straight,
    Target,
    TargetChange,
    Track,
    Waypoints,
    Wobble,
)
from apertura.simulation.waveform import PulseSpecification, WaveformSpecification

__all__ = [
    "CampaignSpecification",
    "Clutter",
    "Framing",
    "GaussianBeam",
    "ImageGrid",
    "Impairments",
    "Line",
    "Origin",
    "Plate",
    "PointTarget",
    "PulseSpecification",
    "Radio",
    "SimulatedFlight",
    "SimulatedNode",
    "Straight",
    "TargetChange",
    "WaveformSpecification",
    "Waypoints",
    "Wobble",
    "preset",
    "read_specification",
    "simulate",
    "specification_text",
]


def simulate(
    directory: str | Path,
    specification: CampaignSpecification | str | Path = "demo",
    *,
    targets: Sequence[Target] | None = None,
    tracks: Mapping[str, Track] | None = None,
    waveform: WaveformSpecification | PulseSpecification | None = None,
    impairments: Mapping[str, Impairments] | None = None,
    seed: int | Generator = 1,
) -> Path:
    """Write a simulated campaign: SigMF recordings, flight logs, codes, config and truth.json; return its folder.

    Parameters
    ----------
    directory
        Folder of the campaign; it must be new or empty.
    specification
        A specification, the path of a YAML specification, or a preset (a key of `PRESETS`): `demo`, `paper`,
        `paper-uav`, …
    targets
        Targets that replace those of the specification, in metres east, north and up of its origin.
    tracks
        Node → track that replaces that of the specification in every flight; additional nodes have no impairments.
    waveform
        Transmitted waveform that replaces that of the specification.
    impairments
        Node → impairments that replace those of the specification.
    seed
        Seed of all random draws, or the generator itself; the same seed gives identical files.

    Raises
    ------
    CampaignError
        If the folder is not empty, or the specification is invalid.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> track = Straight(start_m=(-1.0, -11.0, 5.0), velocity_m_s=(1.0, 0.0, 0.0))
    >>> with TemporaryDirectory() as folder:
    ...     made = simulate(f"{folder}/campaign", preset("demo", pulses=2), targets=[PointTarget((0.0, 0.0, 0.0))],
    ...                     tracks={"uav1": track}, impairments={"uav1": Impairments(radar_snr_db=20.0)})
    ...     sorted(path.name for path in made.rglob("*") if path.is_file())
    ['codes.npy', 'config.yaml', 'flights.tsv', 'truth.json', 'uav1.sigmf-data', 'uav1.sigmf-meta', 'uav1.track.csv']
    """
    if not isinstance(directory, str | Path):
        raise CampaignError(
            quoted(directory), "simulate: directory", "the path of a folder", "Pass a string or a pathlib.Path."
        )
    if targets is not None and not len(targets):
        raise CampaignError(
            "no targets", "simulate: targets", "at least one target", "Omit targets to use those of the specification."
        )
    if not isinstance(seed, Generator) and (isinstance(seed, bool) or not isinstance(seed, Integral) or seed < 0):
        raise CampaignError(
            quoted(seed), "simulate: seed", "an integer of at least 0, or a numpy Generator", "Pass such a seed."
        )
    base = specification
    if not isinstance(base, CampaignSpecification):
        base = preset(base) if isinstance(base, str) and base in PRESETS else read_specification(Path(base))
    parts = vars(base) | {"nodes": dict(base.nodes)}
    if targets is not None:
        parts["targets"] = tuple(targets)
    if waveform is not None:
        parts["waveform"] = waveform
    if tracks is not None:
        parts["nodes"] = {name: base.nodes.get(name, SimulatedNode()) for name in tracks}
        parts["flights"] = tuple(vars(flight) | {"tracks": tracks} for flight in base.flights)
    for name, of_node in (impairments or {}).items():
        parts["nodes"][name] = replace(parts["nodes"].get(name, SimulatedNode()), impairments=of_node)
    checked = validated(CampaignSpecification, parts, where="simulate", expected="a consistent specification")
    return write_campaign(Path(directory), checked, default_rng(seed))


def preset(name: str, *, pulses: int | None = None) -> CampaignSpecification:
    """Return the specification of a preset, optionally with another number of pulses.

    Raises
    ------
    CampaignError
        If there is no preset of this name.

    Examples
    --------
    >>> preset("swarm").flights[0].tracks.keys()
    dict_keys(['uav1', 'uav2', 'uav3', 'uav4'])
    """
    if name not in PRESETS:
        raise CampaignError(
            f"unknown preset {name!r}", "simulate", f"one of {', '.join(PRESETS)}", "Use one of these presets."
        )
    return PRESETS[name]() if pulses is None else PRESETS[name](pulses=pulses)
