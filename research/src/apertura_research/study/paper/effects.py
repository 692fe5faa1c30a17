"""What one error does to one range profile: a shift, a phase, or nothing that its magnitude shows."""

from dataclasses import dataclass, replace

import numpy as np

from apertura.common.arrays import Complexes
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.simulation.impairments import Impairments, Timing, UniformPhase
from apertura.simulation.recording import straight_pair
from apertura.simulation.scene import Scatterers
from apertura_research.study.paper.claims import Claim, compare, require
from apertura_research.study.paper.experiments import profiles_at
from apertura_research.study.paper_scene import UNDISTURBED, Disturbance, PaperScene, receive_pair, reduced_scene
from apertura_research.study.point_response import phase_history

TIMING_S, SMALL_TIMING_S = 1e-9, 0.5e-9
TARGET_M = 15.0
_SLANT_M = np.linspace(17.5, 18.7, 4801)


@dataclass(frozen=True)
class Profile:
    """One target's range profile on a fine axis, referenced to the band's start as the paper writes it."""

    values: Complexes
    carrier_hz: float

    @property
    def peak(self) -> int:
        """Where it is largest."""
        return int(np.abs(self.values).argmax())

    @property
    def phase(self) -> float:
        """At its peak, rad: that of exp(−j2πf_cτ), the carrier's turn over the true delay."""
        turned = self.carrier_hz * 2 * _SLANT_M[self.peak] / SPEED_OF_LIGHT_M_S
        return float(np.angle(self.values[self.peak] * np.exp(-2j * np.pi * (turned % 1.0))))


def effect_claims() -> list[Claim]:
    """Return what timing and carrier phase do to the profile of one target."""
    scene = _one_target()
    still, moved, little, turned = (
        _profile(scene, disturbance)
        for disturbance in (
            UNDISTURBED,
            Disturbance(Impairments(timing=Timing(offset_s=TIMING_S))),
            Disturbance(Impairments(timing=Timing(offset_s=SMALL_TIMING_S))),
            Disturbance(Impairments(carrier_phase=UniformPhase(np.pi))),
        )
    )
    magnitude_db = _change_db(still, turned)
    return [
        *_timing(scene, still, moved, TIMING_S),
        require(
            "a timing offset of 0.5 ns leaves the range profile",
            _shift_cells(scene, still, little),
            "cells",
            limit="less than half a cell c/2B",
            met=_shift_cells(scene, still, little) < 0.5,
            style=".3f",
            note=f"its peak is {20 * np.log10(_level(little) / _level(still)):+.3f} dB; the phase turns by "
            f"{360 * scene.waveform.carrier_hz * SMALL_TIMING_S:.0f}°, which is what defocuses",
        ),
        require(
            "a carrier phase leaves the magnitude of the range profile",
            magnitude_db,
            "dB",
            limit="below −90 dB of the peak",
            met=magnitude_db < -90,
            style=".0f",
            note=f"largest change anywhere; the phase turned by {np.degrees(turned.phase - still.phase) % 360:.0f}°",
        ),
    ]


def _timing(scene: PaperScene, still: Profile, moved: Profile, late_s: float) -> list[Claim]:
    """Return shift and phase of a capture that starts late: every echo seems earlier by as much."""
    bandwidth_hz = len(scene.waveform.codes) * scene.waveform.subcarrier_spacing_hz
    turn = (moved.phase - still.phase) / (2 * np.pi) % 1.0
    return [
        compare(
            f"shift of the profile by a timing offset of {1e9 * late_s:g} ns, B·T",
            _shift_cells(scene, still, moved),
            "cells",
            independent_model=bandwidth_hz * late_s,
            within=0.01,
            note="closed form B·T with B = 409.6 MHz",
        ),
        compare(
            f"phase of the peak by a timing offset of {1e9 * late_s:g} ns, 2πf_cT",
            turn,
            "turns",
            independent_model=scene.waveform.carrier_hz * late_s % 1.0,
            within=0.005,
            relative=False,
            note="closed form f_cT modulo one turn, profile referenced to the start of the band; about the band's "
            "middle, as this project's profiles are, it is f_mid·T",
        ),
    ]


def _one_target() -> PaperScene:
    target = Scatterers(np.array([[0.0, TARGET_M, 0.0]]), np.ones(1, np.complex128))
    scene = reduced_scene(pulses=150, subcarriers=4096)
    return replace(scene, scatterers=target, geometry=straight_pair(np.zeros(1), 10.0))


def _profile(scene: PaperScene, disturbance: Disturbance) -> Profile:
    radar, _, _ = receive_pair(scene, disturbance, np.random.default_rng(2))
    values = profiles_at(phase_history(scene, radar), _SLANT_M)[0]
    return Profile(values, scene.waveform.carrier_hz)


def _shift_cells(scene: PaperScene, still: Profile, moved: Profile) -> float:
    cell_m = SPEED_OF_LIGHT_M_S / (2 * len(scene.waveform.codes) * scene.waveform.subcarrier_spacing_hz)
    return float(abs(_SLANT_M[moved.peak] - _SLANT_M[still.peak]) / cell_m)


def _change_db(still: Profile, turned: Profile) -> float:
    """Return the largest change of magnitude anywhere, against the peak."""
    before, after = np.abs(still.values), np.abs(turned.values)
    return 20 * float(np.log10(np.abs(after - before).max() / before.max()))


def _level(profile: Profile) -> float:
    return float(np.abs(profile.values[profile.peak]))
