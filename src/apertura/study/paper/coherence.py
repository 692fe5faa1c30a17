"""Coherence factors of a static recording: uncorrected, and corrected at the SNR that gives what is claimed."""

from dataclasses import replace

import numpy as np

from apertura.echo.sidelink import divide
from apertura.simulation.impairments import Impairments, Timing, UniformPhase
from apertura.simulation.recording import straight_pair
from apertura.simulation.scene import Scatterers
from apertura.study.paper.claims import Claim, compare
from apertura.study.paper.formulas import snr_of_coherence_factor
from apertura.study.paper_scene import RX_AHEAD_M, Disturbance, PaperScene, receive_pair, reduced_scene
from apertura.study.point_response import coherence_factors, phase_history

PULSES = 200
CORRECTED = (0.986, 0.9999, 0.9995)
DRAWS = 200


def coherence_claims(*, draws: int = DRAWS, seed: int = 1) -> list[Claim]:
    """Return uncorrected and corrected coherence factors of M = 200 static pulses with free-running clocks.

    The SNR of the corrected ones is the closed form of the paper's value, so they check only that the simulator, the
    division and the closed form are consistent.
    """
    clocks = Impairments(carrier_phase=UniformPhase(), timing=Timing(half_width_s=20e-9))
    uncorrected = [_factors(clocks, np.random.default_rng([seed, draw]))[0] for draw in range(draws)]
    rows = [
        compare(
            "coherence factor, uncorrected (about 1/M)",
            float(np.mean(uncorrected)),
            "1",
            independent_model=1 / PULSES,
            within=3 / np.sqrt(draws),
            style=".2g",
            note=f"mean of {draws} draws, spread {np.std(uncorrected):.4f}; closed form 1/M with M = {PULSES}",
        )
    ]
    for factor in CORRECTED:
        snr_db = 10 * float(np.log10(snr_of_coherence_factor(factor, PULSES)))
        # of a complete pulse after compression: N subcarriers add up
        noisy = replace(clocks, radar_snr_db=snr_db - 10 * float(np.log10(_static().waveform.codes.size)))
        few = max(1, draws // 4)
        corrected = [_factors(noisy, np.random.default_rng([seed, 1, draw]))[1] for draw in range(few)]
        rows.append(
            compare(
                "coherence factor, corrected",
                float(np.mean(corrected)),
                "1",
                paper=factor,
                within=0.1 * (1 - factor),
                relative=False,
                style=".5g",
                agreement="consistency check: recovered",
                note=f"simulated at {snr_db:.1f} dB SNR of a compressed pulse, which the closed form gives for the "
                f"paper's value; spread {np.std(corrected):.1g}",
            )
        )
    return rows


def _static() -> PaperScene:
    """Return a recording that does not move: one reflector 15 m away, receiver 4.7 m beside the transmitter."""
    scene = reduced_scene(pulses=PULSES, subcarriers=128)
    target = Scatterers(np.array([[2.35, 14.0, 0.0]]), np.ones(1, np.complex128))
    return replace(scene, scatterers=target, geometry=straight_pair(np.zeros(PULSES), 4.8, rx_ahead_m=RX_AHEAD_M))


def _factors(impairments: Impairments, generator: np.random.Generator) -> tuple[float, float]:
    """Return the coherence factor at the reflector without and with division by the sidelink."""
    scene = _static()
    radar, sidelink, _ = receive_pair(scene, Disturbance(impairments), generator)
    histories = phase_history(scene, radar), phase_history(scene, divide(radar, sidelink), divided=True)
    before, after = (float(coherence_factors(one, scene.scatterers.position_m)[0]) for one in histories)
    return before, after
