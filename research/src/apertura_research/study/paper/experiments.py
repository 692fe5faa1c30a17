"""The paper's experiments as the pipeline left them: campaigns of `apertura simulate` and `apertura run`."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from apertura.common.arrays import Complexes, Floats
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.core.echo.transfer import transfer_by_code
from apertura.core.focus.engines import reference
from apertura.core.focus.inputs import PhaseHistory
from apertura.core.imaging.range_profiles import phase_history_of
from apertura.pipeline.config import SampledWaveform
from apertura.pipeline.opening.acquisition import open_acquisition
from apertura.pipeline.opening.results import OpenCampaign, open_campaign
from apertura.pipeline.opening.transmitted import transmitted
from apertura.simulation import CampaignSpecification, Line, PointTarget, preset

FLIGHT, MONOSTATIC, BISTATIC = "f01", "uav1-uav1", "uav1-uav2"
WINDOW = "hann"


@dataclass(frozen=True)
class Experiment:
    """One experiment: what was simulated, and the campaign as the pipeline left it.

    Attributes
    ----------
    places_m
        (target, 3) float64 ECEF: points, and the middles of lines, in the order of the specification.
    """

    specification: CampaignSpecification
    opened: OpenCampaign
    places_m: Floats

    def history(self, pair: str) -> PhaseHistory:
        """Return the echo stage of a pair, Hann."""
        return phase_history_of(self.opened.stage("echo", FLIGHT, pair), WINDOW)

    def uncorrected(self) -> PhaseHistory:
        """Return the bistatic captures demodulated by the code alone, as if there were no sidelink.

        Electrical paths stay in it: they are the same for every pulse of nodes that stand still.
        """
        campaign = self.opened.campaign
        waveform = campaign.settings.waveform
        if not isinstance(waveform, SampledWaveform):
            raise TypeError("the paper's experiments are recordings of samples")
        sent = transmitted(campaign, waveform)
        receiver = open_acquisition(campaign, FLIGHT, BISTATIC.split("-")[1], sent)
        every = np.arange(len(receiver.raw.time))
        time_s = receiver.log_seconds(receiver.raw.time.values)
        measured = transfer_by_code(receiver.reader(["radar"], every), sent.inverse, receiver.numerology, time_s=time_s)
        return replace(self.history(BISTATIC), transfer=measured.form(every))


def open_experiment(folder: Path, name: str) -> Experiment:
    """Return the experiment `lab`, `static` or `uav` that lies in a folder of campaigns."""
    specification = preset(f"paper-{name}")
    return Experiment(specification, open_campaign(folder / name), _places(specification))


def _places(specification: CampaignSpecification) -> Floats:
    middles = [
        np.add(target.start_m, target.end_m) / 2 if isinstance(target, Line) else target.position_m
        for target in specification.targets
        if isinstance(target, PointTarget | Line)
    ]
    return specification.origin.ecef(np.array(middles, np.float64))


def profiles_at(history: PhaseHistory, slant_m: Floats) -> Complexes:
    """Return (pulse, range) complex64: each pulse compressed at given halves of the total path.

    Σ_n w_n G_n exp(j2πf_nτ), the inner sum of eq. 6 of docs/theory.md, as one matrix product.
    """
    turns = np.outer(history.frequency_hz, 2 * slant_m / SPEED_OF_LIGHT_M_S)
    waves = np.exp(2j * np.pi * (turns % 1.0)).astype(np.complex64)
    return np.asarray((history.transfer * history.weight).astype(np.complex64) @ waves, np.complex64)


def terms_at(history: PhaseHistory, place_m: Floats) -> NDArray[np.complex128]:
    """Return (pulse,) complex128: what each pulse adds at a place."""
    return reference.terms(history, place_m[None])[:, 0]


def noise_power(history: PhaseHistory, slant_m: Floats) -> float:
    """Return the variance over pulses of the profile, averaged over halves of the total path without any echo."""
    silent = profiles_at(history, slant_m)
    return float(np.mean(np.abs(silent - silent.mean(axis=0)) ** 2) * len(silent) / (len(silent) - 1))


def by_pair(experiment: Experiment) -> Mapping[str, PhaseHistory]:
    """Return words → echo of both pairs."""
    return {words: experiment.history(pair) for words, pair in (("mono", MONOSTATIC), ("bistatic", BISTATIC))}
