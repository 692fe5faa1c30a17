"""The paper's three experiments, processed by the regular pipeline, and their coherence."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from apertura.campaign.config import SampledWaveform
from apertura.common.arrays import Complexes, Floats
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.core.backprojection.engines import reference
from apertura.core.backprojection.inputs import PhaseHistory
from apertura.core.echo.demodulate import remove_path
from apertura.core.echo.transfer import Demodulator, transfer_by_code
from apertura.core.imaging.range_profiles import phase_history_of
from apertura.core.quality.measures import coherence_factor
from apertura.simulation import CampaignSpecification, Line, PointTarget, preset
from apertura.simulation.targets import Clutter, Target, Vector
from apertura.stages.acquisition import open_acquisition
from apertura.stages.transmitted import transmitted
from apertura.tools.open_campaign import OpenCampaign, open_campaign
from apertura_research.paper.claims import (
    DISAGREES,
    PAPER,
    UNTESTABLE,
    Claim,
    compare,
    fitted_to,
    half_digit,
    require,
)
from apertura_research.paper.parameters import coherence_of_snr, snr_of_coherence_factor

FLIGHT, MONOSTATIC, BISTATIC = "f01", "uav1-uav1", "uav1-uav2"


@dataclass(frozen=True)
class Experiment:
    """One experiment: its simulation and its processed campaign.

    Attributes
    ----------
    places_m
        (target, 3) float64 ECEF: points, and centres of lines, in the order of the specification.
    rough_m
        (target, 3) float64 ECEF: centres of patches of random points, without the last patch, which is the terrain.
    """

    specification: CampaignSpecification
    opened: OpenCampaign
    places_m: Floats
    rough_m: Floats

    def history(self, pair: str, window: str = "hann") -> PhaseHistory:
        """Return the echo stage of a pair."""
        return phase_history_of(self.opened.stage("echo", FLIGHT, pair), window)

    def uncorrected(self, window: str = "hann") -> PhaseHistory:
        """Demodulate the bistatic captures by the code only, without the sidelink.

        The electrical path of the radar channel is removed, as in the echo stage.
        """
        campaign = self.opened.campaign
        waveform = campaign.settings.waveform
        if not isinstance(waveform, SampledWaveform):
            raise TypeError("the paper's experiments are recordings of samples")
        sent = transmitted(campaign, waveform)
        receiver_name = BISTATIC.split("-")[1]
        receiver = open_acquisition(campaign, FLIGHT, receiver_name, sent)
        every = np.arange(len(receiver.raw.time))
        time_s = receiver.log_seconds(receiver.raw.time.values)
        measured = transfer_by_code(
            receiver.reader(["radar"], every),
            Demodulator(
                lambda pulses: sent.inverses.at(receiver.frames.numbers[pulses]),
                receiver.numerology,
                sent.waveform.capture_samples,
            ),
            time_s=time_s,
        )
        history = self.history(BISTATIC, window)
        offset_m = campaign.settings.nodes[receiver_name].path_offset_m.radar
        offset_s = np.full(len(every), offset_m / SPEED_OF_LIGHT_M_S)
        return replace(history, transfer=remove_path(measured.form(every), history.frequency_hz, delay_s=offset_s))


def open_experiment(folder: Path, name: str) -> Experiment:
    """Open the experiment `lab`, `static` or `uav` in a folder of campaigns."""
    specification = preset(f"paper-{name}")
    ends = [_ends(target) for target in specification.targets]
    middles = [np.add(*both) / 2 for both in ends]
    rough = [isinstance(target, Clutter) for target in specification.targets]
    places, patches = (
        specification.origin.ecef(np.array([one for one, own in zip(middles, rough, strict=True) if own is kind]))
        if kind in rough else np.empty((0, 3))
        for kind in (False, True)
    )  # fmt: skip
    return Experiment(specification, open_campaign(folder / name), places, patches[:-1])


def _ends(target: Target) -> tuple[Vector, Vector]:
    match target:
        case PointTarget():
            return target.position_m, target.position_m
        case Line():
            return target.start_m, target.end_m
        case Clutter(bounds_m=(west, south, east, north)):
            return (west, south, target.up_m), (east, north, target.up_m)
    raise TypeError(f"the experiments contain no target {target!r}")


def profiles_at(history: PhaseHistory, slant_m: Floats) -> Complexes:
    """Range-compress each pulse at given halves of the total path, (pulse, range) complex64.

    Σ_n w_n G_n exp(j2πf_nτ), the inner sum of eq. 6 of docs/theory.md, as one matrix product.
    """
    turns = np.outer(history.frequency_hz, 2 * slant_m / history.wave_speed_m_s)
    waves = np.exp(2j * np.pi * (turns % 1.0)).astype(np.complex64)
    return np.asarray((history.transfer * history.weight).astype(np.complex64) @ waves, np.complex64)


def terms_at(history: PhaseHistory, place_m: Floats) -> NDArray[np.complex128]:
    """Return the contribution of each pulse at a point, (pulse,) complex128."""
    return reference.terms(history, place_m[None])[:, 0]


def noise_power(history: PhaseHistory, slant_m: Floats) -> float:
    """Return the variance of the profile over pulses, averaged over echo-free halves of the total path."""
    silent = profiles_at(history, slant_m)
    return float(np.mean(np.abs(silent - silent.mean(axis=0)) ** 2) * len(silent) / (len(silent) - 1))


def by_pair(experiment: Experiment, window: str = "hann") -> Mapping[str, PhaseHistory]:
    """Return label → echo of both pairs."""
    return {label: experiment.history(pair, window) for label, pair in (("mono", MONOSTATIC), ("bistatic", BISTATIC))}


PRINTED_UNCORRECTED = "0.0034"
PRINTED = {
    "lab": (("cables", "0.986"),),
    "static": (("first cylinder", "0.9999"), ("second cylinder", "0.9995")),
}
"""Experiment → its targets in order, and their printed coherence factors after correction."""

SILENT_M = np.linspace(45.0, 60.0, 60)
"""Half of the total path, at distances beyond all echoes of both experiments, metres."""

ALIKE_RAD, ALIKE_DB = 0.05, 0.2
"""Largest differences between mono- and bistatic recordings of one signal, rad and dB."""

WITHIN = 0.3
"""Tolerance of 1 − Γ relative to its value from noise; for 200 pulses its standard deviation is 10 %."""


def coherence_claims(folder: Path) -> list[Claim]:
    """Return the coherence, and the phase and gain between the pairs, of both experiments in a folder of campaigns."""
    experiments = {name: open_experiment(folder, name) for name in PRINTED}
    return [
        _uncorrected(experiments),
        *(row for name, experiment in experiments.items() for row in _corrected(name, experiment)),
        _spread(experiments["static"]),
        *(row for name, experiment in experiments.items() for row in _alike(name, experiment)),
    ]


def _uncorrected(experiments: Mapping[str, Experiment]) -> Claim:
    terms = {name: terms_at(one.uncorrected("none"), one.places_m[0]) for name, one in experiments.items()}
    factors = {name: coherence_factor(own) for name, own in terms.items()}
    pulses = len(terms["lab"])
    low, high = (-np.log(1 - share) / pulses for share in (0.025, 0.975))  # MΓ is exponential for random phases
    note = (
        f"for the cables; {factors['static']:.2g} for the first cylinder: the paper does not state which is printed; "
        f"random phases: mean 1/M = {1 / pulses:g}, median {np.log(2) / pulses:.4f}; 95 % of recordings give "
        f"{low:.4f} to {high:.4f}, so that any value in this interval agrees"
    )
    is_random = all(low <= value <= high for value in (*factors.values(), float(PRINTED_UNCORRECTED)))
    shown, verdict = f"{factors['lab']:.2g}", UNTESTABLE if is_random else DISAGREES
    name = "coherence factor without correction"
    return Claim(name, PRINTED_UNCORRECTED, f"{1 / pulses:g}", shown, "1", PAPER, verdict, note)


def _corrected(name: str, experiment: Experiment) -> list[Claim]:
    """Compare each target's coherence factor with the printed one, and with the limit by noise of echo-free ranges."""
    rows, histories = [], by_pair(experiment, "none")
    noise = {pair: noise_power(history, SILENT_M) for pair, history in histories.items()}
    for place, (target, printed) in zip(experiment.places_m, PRINTED[name], strict=True):
        terms = {pair: terms_at(history, place) for pair, history in histories.items()}
        factors = {pair: coherence_factor(own) for pair, own in terms.items()}
        snr = {pair: _snr(own, noise[pair]) for pair, own in terms.items()}
        pulses, factor = len(terms["bistatic"]), factors["bistatic"]
        needed_db = _db(snr_of_coherence_factor(float(printed), pulses))
        reason = (
            f"the factor depends only on the SNR, which the paper does not print: {needed_db:.1f} dB per compressed "
            f"pulse were chosen; bistatic, 1σ = {(1 - factor) / np.sqrt(pulses):.2g}; mono {factors['mono']:.5f}"
        )
        title = f"coherence factor after correction, {name}, {target}"
        tolerance = half_digit(printed) + 3 * (1 - factor) / np.sqrt(pulses)
        rows.append(fitted_to(compare(title, factor, "1", paper=printed, within=tolerance, relative=False, style=".5f",
                                      note=reason)))  # fmt: skip
        lack = {pair: (1 - factors[pair]) / (1 - coherence_of_snr(snr[pair], pulses)) for pair in terms}
        title = f"lack of coherence 1 − Γ over its value from noise alone, {name}, {target}"
        note = (
            f"bistatic; mono {lack['mono']:.2f}; the model is the closed form for the noise of echo-free ranges, "
            f"{_db(snr['bistatic']):.1f} dB below the target: the residual is noise only"
        )
        rows.append(compare(title, lack["bistatic"], "1", independent_model=1.0, within=WITHIN, style=".2f", note=note))
    return rows


def _spread(static: Experiment) -> Claim:
    history = static.history(BISTATIC, "none")
    strong, weak = (terms_at(history, place) for place in static.places_m)
    spreads = [float(np.std(np.angle(terms / terms.mean()))) for terms in (strong, weak)]
    noise = noise_power(history, SILENT_M)
    return compare(
        "phase spread at the second cylinder over that at the first",
        spreads[1] / spreads[0],
        "1",
        independent_model=float(np.sqrt(_snr(strong, noise) / _snr(weak, noise))),
        within=WITHIN,
        style=".3g",
        note=f"a stronger target has the smaller spread: {np.degrees(spreads[0]):.2f}° against "
        f"{np.degrees(spreads[1]):.2f}°; the model is the ratio of amplitudes, spread = 1/√(2·SNR)",
    )


def _alike(name: str, experiment: Experiment) -> list[Claim]:
    mono, bistatic = (terms_at(history, experiment.places_m[0]).mean() for history in by_pair(experiment).values())
    phase, gain_db = float(np.angle(bistatic / mono)), 2 * _db(abs(bistatic / mono))
    words = "mono- and bistatic recordings of one split receive signal agree" if name == "static" else ""
    note = f"{PRINTED[name][0][0]}, at its true position, electrical paths known"
    rows = [
        require(f"phase of bistatic minus monostatic, {name}", phase, "rad", limit=f"within ±{ALIKE_RAD:g} rad",
                met=abs(phase) <= ALIKE_RAD, words=words, style=".4f", note=note),
        require(f"gain of bistatic over monostatic, {name}", gain_db, "dB", limit=f"within ±{ALIKE_DB:g} dB",
                met=abs(gain_db) <= ALIKE_DB, words=words, style=".3f", note=note),
    ]  # fmt: skip
    return [fitted_to(row) for row in rows] if words else rows  # the simulation splits one signal


def _snr(terms: NDArray[np.complex128], noise: float) -> float:
    return float(abs(terms.mean()) ** 2 / noise)


def _db(ratio: float) -> float:
    return 10 * float(np.log10(ratio))
