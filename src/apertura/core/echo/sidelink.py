"""Correction of an echo by the sidelink: removal of clock, phase, timing and transmit ripple common to both channels.

Every method replaces the radar's transfer function R by R·A/S. S is the sidelink or a model of it, and A is its
amplitude in the same pulse: images remain in the units of the radar channel, comparable with monostatic images, and
fading of the sidelink does not amplify a pulse. A new method requires a function, a row in `METHODS`, and limits in
`edges`.
"""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
import scipy
from numpy.typing import NDArray

from apertura.common.arrays import Complexes
from apertura.common.units import decibels
from apertura.core.echo.line_of_sight import LineOfSight, Weights, fit_line_of_sight, phasor
from apertura.core.echo.sidelink_state import ECHO_DB, GATE_CELLS, NULL_DB, SidelinkState, measure

__all__ = ["METHODS", "choose", "divide", "edges", "gated", "measure", "two_parameter", "wiener"]

DIVIDE_SNR_DB = 10.0
"""Minimum SNR per subcarrier for `divide`, dB (docs/theory/echo_methods.md, "Which correction")."""

WIENER_SNR_DB = 6.0
"""Minimum SNR per subcarrier for `wiener`, dB (same source)."""

RIPPLE_DB = 0.5
"""Largest ripple that may remain after a correction, dB peak to peak (same source)."""

FIT_SNR_DB = 13.4
"""N·SNR of the whole pulse, dB, below which errors of the two fitted parameters cause a loss of more than 0.2 dB."""

_PULSES_AT_ONCE = 64
_Inverse = Callable[[Complexes, LineOfSight, Weights | None], Complexes]


def divide(
    radar: Complexes, sidelink: Complexes, path: LineOfSight | None = None, weight: Weights | None = None
) -> Complexes:
    """Return R·A/S, (pulse, subcarrier) complex64 in the units of `radar`.

    Where |S| is more than 20 dB below A, in a spectral null or due to noise, it is set to 20 dB below A: a subcarrier
    in a null is attenuated, and no subcarrier is amplified more than tenfold.

    Parameters
    ----------
    radar, sidelink
        (pulse, subcarrier) complex64 of the same captures.
    path
        The direct path of the sidelink as fitted by `measure`; fitted here by default.
    weight
        (pulse or 1, subcarrier) float32, inverse noise power of the sidelink's subcarriers, mean 1 over each pulse:
        |c|² of symbols of varying modulus; None: equal noise. It affects the fit and `gated`.

    Notes
    -----
    Source: docs/theory/echo_methods.md, "Corrections". This is the only method that is exact for any transmit ripple
    and for a wrong code.

    Examples
    --------
    >>> sidelink = 2 * np.exp(1j * np.arange(8.0)).astype(np.complex64)[None]
    >>> abs(divide(3 * sidelink, sidelink)).round(5)[0, :3]
    array([6., 6., 6.], dtype=float32)
    """

    def inverse(symbols: Complexes, path: LineOfSight, _: Weights | None) -> Complexes:
        return _bounded_inverse(symbols, _amplitude(symbols, path))

    return _correct(radar, sidelink, path, weight, inverse)


def wiener(
    radar: Complexes, sidelink: Complexes, path: LineOfSight | None = None, weight: Weights | None = None
) -> Complexes:
    """Return R·A·S*/(|S|² + σ²), rescaled to preserve the amplitude of the direct path.

    Parameters and result as for `divide`; σ² is the noise per subcarrier, measured outside the direct path.

    Notes
    -----
    Source: docs/theory/echo_methods.md, "Corrections". Without rescaling the peak has a bias of up to SNR/(SNR + 1).
    """

    def inverse(symbols: Complexes, path: LineOfSight, _: Weights | None) -> Complexes:
        amplitude = _amplitude(symbols, path)
        noise = np.where(path.locked, path.noise_power, 0.0)[:, None]  # without lock the noise is unknown
        weakest = _weakest(amplitude)
        regularised = symbols.conj() * amplitude / np.maximum(np.abs(symbols) ** 2 + noise, weakest**2)
        gain = np.abs((regularised * phasor(path, symbols.shape[1])).mean(1, keepdims=True))  # of the direct path
        rescaled = regularised / np.maximum(gain, 1e-30)
        return np.asarray(np.where(path.locked[:, None], rescaled, regularised), np.complex64)

    return _correct(radar, sidelink, path, weight, inverse)


def gated(
    radar: Complexes, sidelink: Complexes, path: LineOfSight | None = None, weight: Weights | None = None
) -> Complexes:
    """Return R·A/S with S gated to 16 cells on each side of the direct path.

    Parameters and result as for `divide`.

    Notes
    -----
    Source: docs/theory/echo_methods.md, "Corrections" (the gate retains the noise of 33 of N cells), and
    docs/theory/changing_codes.md, "Sidelink with symbols of varying modulus", for subcarriers of unequal noise.
    """

    def gate(symbols: Complexes) -> Complexes:
        profile = scipy.fft.ifft(symbols, axis=1)
        # with fewer than 33 subcarriers, all cells are inside the gate
        profile[:, GATE_CELLS + 1 : symbols.shape[1] - GATE_CELLS] = 0
        return np.asarray(scipy.fft.fft(profile, axis=1), np.complex64)

    def inverse(symbols: Complexes, path: LineOfSight, weight: Weights | None) -> Complexes:
        direct = phasor(path, symbols.shape[1])
        aligned = symbols * direct.conj()
        clean = gate(aligned)
        if weight is not None:  # one step from equal weights to the weighted least squares
            clean = clean + gate(weight * (aligned - clean))
        return _bounded_inverse(clean * direct, path.amplitude[:, None].astype(np.float32))

    return _correct(radar, sidelink, path, weight, inverse)


def two_parameter(
    radar: Complexes, sidelink: Complexes, path: LineOfSight | None = None, weight: Weights | None = None
) -> Complexes:
    """Return R compensated for one delay and one phase of the direct path per pulse.

    Parameters and result as for `divide`.

    Notes
    -----
    Source: docs/theory/echo_methods.md, "Two parameters of a pulse".
    """

    def inverse(symbols: Complexes, path: LineOfSight, _: Weights | None) -> Complexes:
        return phasor(path, symbols.shape[1]).conj()

    return _correct(radar, sidelink, path, weight, inverse)


METHODS: Mapping[str, Callable[..., Complexes]] = {
    "divide": divide,
    "wiener": wiener,
    "two_parameter": two_parameter,
    "gated": gated,
}
"""Name → correction method, in ascending order of computational cost."""


DIVIDING = "divide", "wiener"
"""Methods that remove any transmitted spectrum; the other methods assume a flat spectrum and a single path."""


def edges(method: str, state: SidelinkState) -> dict[str, str]:
    """Return the limits that a method exceeds on a sidelink: flag → measured values, one line; {} if it is adequate.

    Notes
    -----
    Source: the thresholds are derived and simulated in docs/theory/echo_methods.md, "Which correction".
    """
    snr_db = {
        "divide": (state.snr_db, DIVIDE_SNR_DB, "per subcarrier"),
        "wiener": (state.snr_db, WIENER_SNR_DB, "per subcarrier"),
        "gated": (_gain_db(state, 2 * GATE_CELLS + 1), DIVIDE_SNR_DB, "inside the gate"),
        "two_parameter": (_gain_db(state, 1), FIT_SNR_DB, "of the whole pulse"),
    }
    exceeded = {}
    measured, needed, reference = snr_db[method]
    if measured < needed:
        exceeded["sidelink_noisy"] = (
            f"SNR of the sidelink {measured:.1f} dB {reference}: {method} requires {needed:.1f} dB"
        )
    reach = {"divide": state.subcarriers, "wiener": state.subcarriers, "gated": GATE_CELLS, "two_parameter": 0}[method]
    if state.echo_db > ECHO_DB and 0 < abs(state.echo_cells) <= reach:
        exceeded["sidelink_echo"] = (
            f"an echo of {state.echo_db:.1f} dB in the sidelink causes ghosts of the same level after {method}"
        )
    ripple_db = {"gated": state.fine_ripple_db, "two_parameter": max(state.ripple_db, state.fine_ripple_db)}
    if ripple_db.get(method, 0.0) > RIPPLE_DB:
        exceeded["sidelink_ripple"] = f"residual ripple of {ripple_db[method]:.1f} dB over the band after {method}"
    if method in ("gated", "two_parameter") and "wrong_code" in state.flags:
        exceeded["sidelink_code"] = f"{method} requires the code, which the sidelink does not contain"
    return exceeded


LEAST_NOISE = "two_parameter", "gated", "wiener", "divide"
"""Methods in ascending order of the noise of the sidelink that they pass on."""


def choose(state: SidelinkState, order: Sequence[str] = tuple(METHODS)) -> tuple[str, str]:
    """Choose the first adequate method of `order`, by default that of lowest cost; return it and the reason, one line.

    Examples
    --------
    >>> noise = np.random.default_rng(1).normal(size=(2, 40, 256))
    >>> choose(measure((10 + noise[0] + 1j * noise[1]).astype(np.complex64)))
    ('divide', 'SNR 17.0 dB per subcarrier, echoes below -41.7 dB, ripple 0.0 dB: adequate method of lowest cost')
    """
    exceeded = {method: edges(method, state) for method in METHODS}
    adequate = [method for method in order if not exceeded[method]]
    advantage = "noise" if order is LEAST_NOISE else "cost"
    summary = (
        f"SNR {state.snr_db:.1f} dB per subcarrier, echoes {'of' if state.echo_cells else 'below'} "
        f"{state.echo_db:.1f} dB, ripple {max(state.ripple_db, state.fine_ripple_db):.1f} dB"
    )
    if adequate:
        return adequate[0], f"{summary}: adequate method of lowest {advantage}"
    # two_parameter makes every locked pulse coherent: an image can be formed, possibly with ghosts
    fallback = "wiener" if "wrong_code" in state.flags else "two_parameter"
    return fallback, f"{summary}: no method is adequate, smallest error ({'; '.join(exceeded[fallback].values())})"


def _gain_db(state: SidelinkState, cells: int) -> float:
    """Return the SNR after removal of all but `cells` delay cells with weights of the subcarriers, dB."""
    return state.snr_db + decibels(state.noise_gain * state.subcarriers / min(cells, state.subcarriers))


def _amplitude(symbols: Complexes, path: LineOfSight) -> NDArray[np.float32]:
    """Return the amplitude of the direct path, or of the whole sidelink in pulses without lock, (pulse, 1)."""
    rms = np.sqrt(np.mean(np.abs(symbols) ** 2, axis=1))
    return np.asarray(np.where(path.locked, path.amplitude, rms)[:, None], np.float32)


def _bounded_inverse(symbols: Complexes, amplitude: NDArray[np.float32]) -> Complexes:
    """Return A/S, with |S| limited from below to `_weakest`."""
    power = np.square(symbols.real) + np.square(symbols.imag)
    scale = amplitude / np.maximum(power, np.square(_weakest(amplitude)))
    return np.asarray(symbols.conj() * scale, np.complex64)


def _weakest(amplitude: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the |S| below which a subcarrier is attenuated instead of divided; neither it nor its square is zero."""
    return np.asarray(np.maximum(amplitude * 10 ** (NULL_DB / 20), 1e-15), np.float32)


def _correct(
    radar: Complexes, sidelink: Complexes, path: LineOfSight | None, weight: Weights | None, inverse: _Inverse
) -> Complexes:
    path = path or fit_line_of_sight(sidelink, weight)
    if weight is not None:
        weight = np.broadcast_to(weight, sidelink.shape)
    corrected = np.empty(radar.shape, np.complex64)
    for first in range(0, len(radar), _PULSES_AT_ONCE):
        pulses = slice(first, first + _PULSES_AT_ONCE)
        factors = inverse(sidelink[pulses], path.select(pulses), weight if weight is None else weight[pulses])
        # `out`: for large blocks numpy would reuse the inverse and swap the factors, which changes the rounding
        np.multiply(radar[pulses], factors, out=corrected[pulses])
    return corrected
