"""Section `waveform`: what was transmitted."""

from typing import Annotated

from pydantic import Field

from apertura.pipeline.config.history_waveforms import FmcwWaveform, PhaseHistoryWaveform
from apertura.pipeline.config.sampled_waveforms import OfdmWaveform, PulseWaveform

Waveform = Annotated[OfdmWaveform | PulseWaveform | PhaseHistoryWaveform | FmcwWaveform, Field(discriminator="kind")]
