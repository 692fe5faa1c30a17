"""Captures of a pair become transfer functions: by the code alone, or against the sidelink."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.constants import SPEED_OF_LIGHT_M_S
from apertura.echo.baseline import BaselineResidual, baseline_residual, detect_wrong_association
from apertura.echo.captures import saturation_flags
from apertura.echo.clock import decide_clock, estimate_clock
from apertura.echo.code_check import CodeEvidence, own_code
from apertura.echo.demodulate import Numerology, demodulate
from apertura.echo.phase_check import phase_stability
from apertura.echo.resampling import Complexes, Floats, correct_clock
from apertura.echo.second_path import second_path_flags
from apertura.echo.sidelink import METHODS, choose, edges
from apertura.echo.sidelink_state import SidelinkState, measure

Samples = NDArray[np.int16]


@dataclass(frozen=True)
class Transfer:
    """What the captures of a pair measured.

    Attributes
    ----------
    transfer
        (pulse, subcarrier) complex64, the code removed; electrical paths are still in it.
    kept
        (capture,) bool, the captures that `transfer` holds.
    flags
        Edge crossed → what was measured, in one line.
    report
        What was decided on the way and why: clock, sidelink, code.
    sidelink_delay_m
        (pulse,) float64, measured delay of the sidelink times c in the pulses kept, metres; NaN where it did not lock,
        None without a sidelink.
    """

    transfer: Complexes
    kept: NDArray[np.bool_]
    flags: dict[str, str]
    report: dict[str, Any]
    sidelink_delay_m: Floats | None = None


def transfer_by_code(radar: Samples, codes: Complexes, numerology: Numerology, *, time_s: Floats) -> Transfer:
    """Return what a node received of its own pulses, whose clock is the transmitter's.

    `radar` holds (capture, sample, 2) int16 I and Q from the start of the cyclic prefix, `codes` (subcarrier,) what was
    sent, complex64, `time_s` (capture,) float64 when, seconds of any origin.

    Examples
    --------
    >>> numerology = Numerology(1e9, 16e6, np.arange(8), prefix_samples=4, dft_samples=16)
    >>> tone = 1000 * np.exp(2j * np.pi * 3 * np.arange(20) / 16)
    >>> iq = np.stack([tone.real, tone.imag], -1)[None].round().astype(np.int16)
    >>> abs(transfer_by_code(iq, np.full(8, 2, np.complex64), numerology, time_s=np.zeros(1)).transfer).round(0)
    array([[  0.,   0.,   0., 500.,   0.,   0.,   0.,   0.]], dtype=float32)
    """
    transfer = demodulate(_complex(radar), numerology) / codes
    code = own_code(transfer, prefix_cells=numerology.prefix_cells)
    phase = phase_stability(transfer, time_s, prefix_cells=numerology.prefix_cells)
    flags = {**saturation_flags({"radar": radar}), **code.flags, **(phase.flags if phase else {})}
    report = {"code": code.report, **({"own_phase": phase.report} if phase else {})}
    return Transfer(transfer, np.ones(len(radar), bool), flags, report)


def transfer_by_sidelink(
    iq: Mapping[str, Samples],
    codes: Complexes,
    numerology: Numerology,
    *,
    symbol_samples: int,
    sidelink_m: Floats,
    method: str,
    accuracy_db: float,
    where: str,
) -> Transfer:
    """Return what a secondary node received, less all that its two channels share.

    Parameters
    ----------
    iq
        radar, sidelink → (capture, sample, 2) int16 I and Q, from near the start of the cyclic prefix.
    codes, numerology
        (subcarrier,) complex64 as transmitted, and the grid of the symbol.
    symbol_samples
        (T_cp + T)·f_s: nothing beyond is used.
    sidelink_m
        (capture,) float64, distance between the antennas of the sidelink, metres; the path that comes off every echo.
    method
        A key of `METHODS`, or auto.
    accuracy_db
        Level below the peak that errors of the clock may reach, dB.
    where
        What to call the recording in errors.

    Raises
    ------
    CampaignError
        If the sidelink locks in no capture.

    Notes
    -----
    Source: docs/theory/echo_methods.md.
    """
    captures = {name: _complex(samples[:, :symbol_samples]) for name, samples in iq.items()}
    captures, clock, clock_flags = _clock_corrected(captures, numerology, accuracy_db)
    radar, sidelink = (demodulate(captures[name], numerology) / codes for name in ("radar", "sidelink"))
    state = measure(sidelink, where=f"{where}: sidelink")
    chosen, reason = choose(state) if method == "auto" else (method, "asked for")
    locked, cell_m = state.locked, SPEED_OF_LIGHT_M_S / (numerology.numbers.size * numerology.spacing_hz)
    delay_m = state.delay_cells * cell_m
    residual = baseline_residual(delay_m, sidelink_m)
    suspect = detect_wrong_association(residual)
    flags = {
        **saturation_flags(iq),
        **clock_flags,
        **state.flags,
        **edges(chosen, state),
        **second_path_flags(state, cell_m=cell_m),
        **({"association_suspect": suspect} if suspect else {}),
    }
    quality = {"method": chosen, "reason": reason, **_sidelink_report(state, residual)}
    return Transfer(
        METHODS[chosen](radar[locked], sidelink[locked], state.path.select(locked)),
        locked,
        flags,
        {"clock": clock, "sidelink": quality, "code": _sidelink_code(state).report},
        delay_m[locked],
    )


def _complex(iq: Samples) -> Complexes:
    return np.ascontiguousarray(iq, np.float32).view(np.complex64)[..., 0]


def _clock_corrected(
    captures: dict[str, Complexes], numerology: Numerology, accuracy_db: float
) -> tuple[dict[str, Complexes], dict[str, Any], dict[str, str]]:
    """Correct the receiver's clock in the samples where it matters; return also what was decided, and flags."""
    try:
        clock = estimate_clock(captures["sidelink"], numerology)
    except ValueError as error:
        return captures, {"corrected": False, "reason": str(error)}, {"clock_unmeasured": str(error)}
    decision = decide_clock(clock, numerology, accuracy_db=accuracy_db)
    ppm, std_ppm = clock.ppm(numerology)
    report = {
        "corrected": decision.correct,
        "reason": decision.reason,
        "floor_db": round(decision.floor_db, 2),
        "ppm": round(ppm, 4),
        "std_ppm": None if std_ppm is None else round(std_ppm, 4),
    }
    if decision.correct:
        cfo_hz = clock.cfo_of_pulses_hz(len(captures["sidelink"]))
        captures = {
            name: correct_clock(samples, numerology, cfo_hz=cfo_hz, sfo_ppm=clock.sfo_ppm)
            for name, samples in captures.items()
        }
    return captures, report, decision.flags


def _sidelink_report(state: SidelinkState, residual: BaselineResidual | None) -> dict[str, float]:
    report = {
        "lock_rate": round(float(state.locked.mean()), 4),
        "snr_db": round(state.snr_db, 2),
        "echo_db": round(state.echo_db, 2),
        "ripple_db": round(max(state.ripple_db, state.fine_ripple_db), 2),
    }
    if residual is not None:
        report |= {"delay_residual_m": round(residual.residual_m, 4), "delay_noise_m": round(residual.noise_m, 4)}
    return report


def _sidelink_code(state: SidelinkState) -> CodeEvidence:
    if "wrong_code" in state.flags:
        return CodeEvidence(carried=False, evidence=state.flags["wrong_code"])
    return CodeEvidence(True, f"by the code, the sidelink locks in {state.locked.mean():.0%} of the pulses")
