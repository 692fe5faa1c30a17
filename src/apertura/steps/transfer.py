"""Captures of a pair become transfer functions: by the code alone, or against the sidelink."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.constants import SPEED_OF_LIGHT_M_S
from apertura.echo.association import Association, detect_wrong_association
from apertura.echo.captures import CODE_SIGMA, SATURATED_SHARE, code_contrast_sigma, saturated_share
from apertura.echo.clock import decide_clock, estimate_clock
from apertura.echo.resampling import Waveform, correct_clock
from apertura.echo.sidelink import METHODS, choose, edges, measure
from apertura.echo.sidelink_state import SidelinkState
from apertura.load.recording import Recording
from apertura.settings import OfdmWaveform, Processing


@dataclass(frozen=True)
class Transfer:
    """What the pulses of a pair measured.

    Attributes
    ----------
    transfer
        (pulse, subcarrier) complex64, the code removed; electrical paths are still in it.
    tx_index, rx_index
        (pulse,) int64, the pulses in the recordings of both nodes.
    sidelink_m
        (pulse,) float64, metres: the path that the correction took out of every echo; zero without a sidelink.
    flags
        Edge crossed → what was measured, in one line.
    report
        What was decided on the way and why: clock, sidelink.
    """

    transfer: NDArray[np.complex64]
    tx_index: NDArray[np.int64]
    rx_index: NDArray[np.int64]
    sidelink_m: NDArray[np.float64]
    flags: dict[str, str]
    report: dict[str, Any]


def by_code(rx: Recording, pulses: Association, codes: NDArray[np.complex64], waveform: OfdmWaveform) -> Transfer:
    """Return what a node heard of its own pulses, whose clock is the transmitter's."""
    captured, flags = _captured(rx, ("radar",), pulses.rx_index, waveform)
    transfer = rx.symbols(captured["radar"]) / codes
    flags |= _code_fits(transfer, waveform)
    return Transfer(transfer, pulses.tx_index, pulses.rx_index, np.zeros(len(pulses.rx_index)), flags, {})


def by_sidelink(
    tx: Recording,
    rx: Recording,
    pulses: Association,
    codes: NDArray[np.complex64],
    waveform: OfdmWaveform,
    processing: Processing,
) -> Transfer:
    """Return what a secondary node heard, freed by its sidelink of all that the two channels share."""
    captured, flags = _captured(rx, ("radar", "sidelink"), pulses.rx_index, waveform)
    captured, clock, ticking = _clock_corrected(captured, rx.waveform, processing.accuracy_db)
    radar, direct = (rx.symbols(captured[name]) / codes for name in ("radar", "sidelink"))
    length_m = np.linalg.norm(tx.antenna("sidelink", pulses.tx_index) - rx.antenna("sidelink", pulses.rx_index), axis=1)
    state = measure(direct, where=f"{rx.files}: sidelink")
    report, crossed = _sidelink_report(state, processing.sidelink, length_m, waveform)
    locked = state.locked
    return Transfer(
        METHODS[report["method"]](radar[locked], direct[locked]),
        pulses.tx_index[locked],
        pulses.rx_index[locked],
        length_m[locked],
        {**flags, **ticking, **crossed},
        {"clock": clock, "sidelink": report},
    )


def _captured(
    rx: Recording, channels: tuple[str, ...], pulses: NDArray[np.int64], waveform: OfdmWaveform
) -> tuple[dict[str, NDArray[np.complex64]], dict[str, str]]:
    """Return the samples of one symbol per pulse, by channel, and flags of what the converter did to them."""
    iq = {name: rx.captures(name, pulses) for name in channels}
    symbol = round((waveform.cyclic_prefix_s + waveform.symbol_s) * waveform.sample_rate_hz)
    return {name: _complex(samples[:, :symbol]) for name, samples in iq.items()}, _saturation(iq)


def _complex(iq: NDArray[np.int16]) -> NDArray[np.complex64]:
    return np.ascontiguousarray(iq, np.float32).view(np.complex64)[..., 0]


def _saturation(iq: dict[str, NDArray[np.int16]]) -> dict[str, str]:
    shares = {name: saturated_share(samples) for name, samples in iq.items()}
    return {
        f"saturated_{name}": f"{100 * share:.2f} % of the samples of channel {name} sit at the converter's end stops"
        for name, share in shares.items()
        if share > SATURATED_SHARE
    }


def _code_fits(transfer: NDArray[np.complex64], waveform: OfdmWaveform) -> dict[str, str]:
    bandwidth_hz = waveform.subcarriers * waveform.subcarrier_spacing_hz
    found = code_contrast_sigma(transfer, prefix_cells=round(waveform.cyclic_prefix_s * bandwidth_hz))
    if found >= CODE_SIGMA:
        return {}
    line = f"energy inside the prefix stands {found:.1f} σ out of an even spread, {CODE_SIGMA} σ expected: "
    return {"code_unconfirmed": line + "the codes file is wrong, or no echo rises above the noise"}


def _clock_corrected(
    captured: dict[str, NDArray[np.complex64]], waveform: Waveform, accuracy_db: float
) -> tuple[dict[str, NDArray[np.complex64]], dict[str, Any], dict[str, str]]:
    """Correct the receiver's clock in the samples where it matters; return also what was found, and flags."""
    try:
        clock = estimate_clock(captured["sidelink"], waveform)
    except ValueError as error:
        return captured, {"corrected": False, "reason": str(error)}, {"clock_unmeasured": str(error)}
    decision = decide_clock(clock, waveform, accuracy_db=accuracy_db)
    report = {"corrected": decision.correct, "reason": decision.reason, "floor_db": round(decision.floor_db, 2)}
    if decision.correct:
        cfo_hz = clock.cfo_of_pulses_hz(len(captured["sidelink"]))
        captured = {
            name: correct_clock(samples, waveform, cfo_hz=cfo_hz, sfo_ppm=clock.sfo_ppm)
            for name, samples in captured.items()
        }
    return captured, report, dict(decision.flags)


def _sidelink_report(
    state: SidelinkState, asked: str, length_m: NDArray[np.float64], waveform: OfdmWaveform
) -> tuple[dict[str, Any], dict[str, str]]:
    """Return what was chosen and measured, and the edges that were crossed."""
    method, reason = choose(state) if asked == "auto" else (asked, "asked for in config/config.yaml")
    cell_m = SPEED_OF_LIGHT_M_S / (waveform.subcarriers * waveform.subcarrier_spacing_hz)
    wrong = detect_wrong_association(state.delay_cells * cell_m, length_m)
    lock_rate = float(state.locked.mean())
    flags = {**state.flags, **edges(method, state)}
    if wrong:
        flags["association_suspect"] = wrong
    report = {
        "method": method,
        "reason": reason,
        "lock_rate": round(lock_rate, 4),
        "snr_db": round(state.snr_db, 2),
        "echo_db": round(state.echo_db, 2),
    }
    return report, flags
