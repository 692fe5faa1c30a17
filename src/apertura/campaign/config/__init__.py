"""Config of a campaign folder: a single model provides the defaults, the JSON schema and the validation.

`campaign` and higher layers use these objects; lower layers receive arrays and numbers.
"""

from apertura.campaign.config.config import CONFIG, Settings, located, read_settings, validated
from apertura.campaign.config.flights import (
    CLOCK_COLUMNS,
    CLOCKS,
    FLIGHTS,
    FUSED,
    KINDS,
    SEGMENTS,
    ClockRow,
    Flight,
    Segment,
    is_monostatic,
    read_clocks,
    read_flights,
    read_segments,
)
from apertura.campaign.config.nodes import (
    Antenna,
    Antennas,
    LeverArms,
    Node,
    PathOffsets,
    Receiver,
    check_radio,
    polarisation_of,
    radio_of,
)
from apertura.campaign.config.processing import (
    CalibrationSettings,
    Interferometry,
    KnownReflector,
    Processing,
    Scene,
    check_interferometry,
)
from apertura.campaign.config.section import Name, Section
from apertura.campaign.config.waveform import (
    FmcwWaveform,
    OfdmWaveform,
    PhaseHistoryWaveform,
    PulseWaveform,
    SampledWaveform,
    Waveform,
)

__all__ = [
    "CLOCKS",
    "CLOCK_COLUMNS",
    "CONFIG",
    "FLIGHTS",
    "FUSED",
    "KINDS",
    "SEGMENTS",
    "Antenna",
    "Antennas",
    "CalibrationSettings",
    "ClockRow",
    "Flight",
    "FmcwWaveform",
    "Interferometry",
    "KnownReflector",
    "LeverArms",
    "Name",
    "Node",
    "OfdmWaveform",
    "PathOffsets",
    "PhaseHistoryWaveform",
    "Processing",
    "PulseWaveform",
    "Receiver",
    "SampledWaveform",
    "Scene",
    "Section",
    "Segment",
    "Settings",
    "Waveform",
    "check_interferometry",
    "check_radio",
    "is_monostatic",
    "located",
    "polarisation_of",
    "radio_of",
    "read_clocks",
    "read_flights",
    "read_segments",
    "read_settings",
    "validated",
]
