"""The campaign folder's config: one model generates the defaults, the JSON schema and the validation.

Only `steps` and the command line see these objects; wings get plain arrays and numbers. One file per section.
"""

from apertura.settings.antennas import Antenna, Antennas
from apertura.settings.calibration import Calibration
from apertura.settings.config import Settings
from apertura.settings.names import Name
from apertura.settings.node import LeverArms, Node, PathOffsets
from apertura.settings.processing import Processing
from apertura.settings.reading import read_settings, validated
from apertura.settings.scene import Scene
from apertura.settings.section import Section
from apertura.settings.waveform import OfdmWaveform, PhaseHistoryWaveform, Waveform

__all__ = [
    "Antenna",
    "Antennas",
    "Calibration",
    "LeverArms",
    "Name",
    "Node",
    "OfdmWaveform",
    "PathOffsets",
    "PhaseHistoryWaveform",
    "Processing",
    "Scene",
    "Section",
    "Settings",
    "Waveform",
    "read_settings",
    "validated",
]
