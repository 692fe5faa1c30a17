"""The campaign folder's config: one model generates the defaults, the JSON schema and the validation.

Only `load`, `steps` and the command line see these objects; wings get plain arrays and numbers. One file per section.
"""

from apertura.pipeline.config.clocks import CLOCK_COLUMNS, CLOCKS, Clock, read_clocks
from apertura.pipeline.config.config import CONFIG, Settings, located, read_settings, validated
from apertura.pipeline.config.flights import FLIGHTS, Flight, read_flights
from apertura.pipeline.config.history_waveforms import FmcwWaveform, PhaseHistoryWaveform
from apertura.pipeline.config.interferometry import Interferometry, check_interferometry
from apertura.pipeline.config.nodes import Antenna, Antennas, LeverArms, Node, PathOffsets
from apertura.pipeline.config.processing import Calibration, Processing
from apertura.pipeline.config.sampled_waveforms import OfdmWaveform, PulseWaveform, SampledWaveform
from apertura.pipeline.config.scene import Scene
from apertura.pipeline.config.section import Name, Section
from apertura.pipeline.config.segments import SEGMENTS, Segment, read_segments
from apertura.pipeline.config.waveform import Waveform

__all__ = [
    "CLOCKS",
    "CLOCK_COLUMNS",
    "CONFIG",
    "FLIGHTS",
    "SEGMENTS",
    "Antenna",
    "Antennas",
    "Calibration",
    "Clock",
    "Flight",
    "FmcwWaveform",
    "Interferometry",
    "LeverArms",
    "Name",
    "Node",
    "OfdmWaveform",
    "PathOffsets",
    "PhaseHistoryWaveform",
    "Processing",
    "PulseWaveform",
    "SampledWaveform",
    "Scene",
    "Section",
    "Segment",
    "Settings",
    "Waveform",
    "check_interferometry",
    "located",
    "read_clocks",
    "read_flights",
    "read_segments",
    "read_settings",
    "validated",
]
