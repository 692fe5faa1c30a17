"""The campaign folder's config: one model generates the defaults, the JSON schema and the validation.

Only `load`, `steps` and the command line see these objects; wings get plain arrays and numbers. One file per section.
"""

from apertura.settings.clocks import CLOCK_COLUMNS, CLOCKS, Clock, read_clocks
from apertura.settings.config import CONFIG, Settings, located, read_settings, validated
from apertura.settings.flights import FLIGHTS, Flight, read_flights
from apertura.settings.history_waveforms import FmcwWaveform, PhaseHistoryWaveform
from apertura.settings.interferometry import Interferometry, check_interferometry
from apertura.settings.nodes import Antenna, Antennas, LeverArms, Node, PathOffsets
from apertura.settings.processing import Calibration, Processing
from apertura.settings.sampled_waveforms import OfdmWaveform, PulseWaveform, SampledWaveform
from apertura.settings.scene import Scene
from apertura.settings.section import Name, Section
from apertura.settings.segments import SEGMENTS, Segment, read_segments
from apertura.settings.waveform import Waveform

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
