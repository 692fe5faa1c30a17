"""Captures of a pair become transfer functions: by the code alone, or against the sidelink."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.constants import SPEED_OF_LIGHT_M_S
from apertura.echo.association import detect_wrong_association
from apertura.echo.captures import code_flags, saturation_flags
from apertura.echo.clock import decide_clock, estimate_clock
from apertura.echo.demodulate import Numerology, demodulate
from apertura.echo.resampling import Complexes, Floats, correct_clock
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
        What was decided on the way and why: clock, sidelink.
    """

    transfer: Complexes
    kept: NDArray[np.bool_]
    flags: dict[str, str]
    report: dict[str, Any]


def transfer_by_code(radar: Samples, codes: Complexes, numerology: Numerology) -> Transfer:
    """Return what a node received of its own pulses, whose clock is the transmitter's.

    `radar` holds (capture, sample, 2) int16 I and Q from the start of the cyclic prefix, `codes` (subcarrier,) what was
    sent, complex64.

    Examples
    --------
    >>> numerology = Numerology(1e9, 16e6, np.arange(8), prefix_samples=4, dft_samples=16)
    >>> tone = 1000 * np.exp(2j * np.pi * 3 * np.arange(20) / 16)
    >>> iq = np.stack([tone.real, tone.imag], -1)[None].round().astype(np.int16)
    >>> abs(transfer_by_code(iq, np.full(8, 2, np.complex64), numerology).transfer).round(0)
    array([[  0.,   0.,   0., 500.,   0.,   0.,   0.,   0.]], dtype=float32)
    """
    transfer = demodulate(_complex(radar), numerology) / codes
    flags = {**saturation_flags({"radar": radar}), **code_flags(transfer, numerology)}
    return Transfer(transfer, np.ones(len(radar), bool), flags, {})


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
    chosen, reason = choose(state) if method == "auto" else (method, "asked for in the config")
    locked = state.locked
    return Transfer(
        METHODS[chosen](radar[locked], sidelink[locked], state.path.select(locked)),
        locked,
        {**saturation_flags(iq), **clock_flags, **_sidelink_flags(chosen, state, sidelink_m, numerology)},
        {"clock": clock, "sidelink": {"method": chosen, "reason": reason, **_sidelink_report(state)}},
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
    report = {"corrected": decision.correct, "reason": decision.reason, "floor_db": round(decision.floor_db, 2)}
    if decision.correct:
        cfo_hz = clock.cfo_of_pulses_hz(len(captures["sidelink"]))
        captures = {
            name: correct_clock(samples, numerology, cfo_hz=cfo_hz, sfo_ppm=clock.sfo_ppm)
            for name, samples in captures.items()
        }
    return captures, report, decision.flags


def _sidelink_report(state: SidelinkState) -> dict[str, float]:
    lock_rate = round(float(state.locked.mean()), 4)
    return {"lock_rate": lock_rate, "snr_db": round(state.snr_db, 2), "echo_db": round(state.echo_db, 2)}


def _sidelink_flags(method: str, state: SidelinkState, sidelink_m: Floats, numerology: Numerology) -> dict[str, str]:
    cell_m = SPEED_OF_LIGHT_M_S / (numerology.numbers.size * numerology.spacing_hz)
    suspect = detect_wrong_association(state.delay_cells * cell_m, sidelink_m)
    return {**state.flags, **edges(method, state), **({"association_suspect": suspect} if suspect else {})}
