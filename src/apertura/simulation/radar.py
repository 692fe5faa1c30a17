"""The waveform, and the delays and amplitudes at which it arrives."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from apertura.common.arrays import Floats
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.simulation.scene import Scatterers


@dataclass(frozen=True)
class TransmitWaveform:
    """One OFDM symbol per pulse: s(t) = Σ c_n exp(j2πnΔf(t − T_cp)) for 0 ≤ t < T_cp + T.

    Attributes
    ----------
    codes
        (subcarrier,) complex128, c_n.
    carrier_hz
        RF frequency of subcarrier n = 0, which is baseband zero.
    carrier_is
        n = 0…N−1 (`band_start`) or −N/2…N/2−1 (`band_centre`).
    subcarrier_spacing_hz, symbol_s, cyclic_prefix_s, sample_rate_hz
        Δf, T, T_cp and f_s.

    Examples
    --------
    >>> paper = TransmitWaveform(np.ones(4096), 1.2e9, "band_start", 100e3, 12.5e-6, 3.125e-6, 1.024e9, 100.0)
    >>> paper.dft_samples, paper.prefix_samples, paper.capture_samples
    (10240, 3200, 16000)
    """

    codes: NDArray[np.complex128]
    carrier_hz: float
    carrier_is: Literal["band_start", "band_centre"]
    subcarrier_spacing_hz: float
    symbol_s: float
    cyclic_prefix_s: float
    sample_rate_hz: float
    prf_hz: float

    @property
    def first_subcarrier(self) -> int:
        """The smallest n."""
        return 0 if self.carrier_is == "band_start" else -(len(self.codes) // 2)

    @property
    def baseband_hz(self) -> Floats:
        """(subcarrier,) float64, nΔf."""
        return np.asarray((self.first_subcarrier + np.arange(len(self.codes))) * self.subcarrier_spacing_hz, np.float64)

    @property
    def frequency_hz(self) -> Floats:
        """(subcarrier,) float64, RF frequency."""
        return self.carrier_hz + self.baseband_hz

    @property
    def duration_s(self) -> float:
        """T_cp + T."""
        return self.cyclic_prefix_s + self.symbol_s

    @property
    def dft_samples(self) -> int:
        """Samples of one period 1/Δf."""
        return round(self.sample_rate_hz / self.subcarrier_spacing_hz)

    @property
    def prefix_samples(self) -> int:
        """Samples of the cyclic prefix."""
        return round(self.cyclic_prefix_s * self.sample_rate_hz)

    @property
    def capture_samples(self) -> int:
        """Samples of a triggered capture: prefix and symbol."""
        return round(self.duration_s * self.sample_rate_hz)

    @property
    def mean_power(self) -> float:
        """E|s|² of codes of unit modulus."""
        return float(len(self.codes))

    @property
    def noise_at_unit_snr(self) -> float:
        """E|n|² of samples whose noise in one bin of the DFT equals an echo of amplitude 1."""
        return float(self.dft_samples)

    @property
    def sent(self) -> tuple[str, NDArray[np.complex64]]:
        """Name and content of the file of what was sent."""
        return "codes.npy", self.codes.astype(np.complex64)

    def presence(self, arrival: Floats, rate_hz: float) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Return the samples of a capture between which paths are present, (path,) each.

        Parameters
        ----------
        arrival
            (path,) float64, when the pulse arrives, in samples of the capture, ascending.
        rate_hz
            At which the receiver samples.
        """
        # from its first sample up to, not including, its end; a millionth of a sample is rounding
        first, end = (np.ceil(arrival + extra - 1e-6).astype(int) for extra in (0.0, self.duration_s * rate_hz))
        return first, end


def qpsk_codes(count: int, generator: Generator) -> NDArray[np.complex128]:
    """Return `count` random QPSK code symbols of unit modulus.

    Examples
    --------
    >>> abs(qpsk_codes(3, np.random.default_rng(0))).round(12)
    array([1., 1., 1.])
    """
    return np.asarray(np.exp(1j * np.pi * (generator.integers(0, 4, count) / 2 + 0.25)))


def newman_codes(count: int) -> NDArray[np.complex128]:
    """Return the quadratic-phase code exp(jπn²/N), whose symbol is nearly as flat in time as a chirp.

    Notes
    -----
    Source: S. Boyd, "Multitone signals with low crest factor", IEEE Trans. Circuits Syst. 33 (1986).
    """
    return np.asarray(np.exp(1j * np.pi * np.arange(count) ** 2 / count))


@dataclass(frozen=True)
class Paths:
    """Ways from the transmitter to one receiving channel, each array (pulse, path).

    Attributes
    ----------
    delay_s, delay_rate
        float64, seconds at the pulse's start, and their growth in seconds per second; zero: stop and go.
    amplitude
        complex128.
    """

    delay_s: Floats
    amplitude: NDArray[np.complex128]
    delay_rate: Floats

    def and_also(self, other: "Paths") -> "Paths":
        """Return both sets together."""
        both = zip(vars(self).values(), vars(other).values(), strict=True)
        return Paths(*(np.concatenate(pair, axis=1) for pair in both))

    def at(self, pulses: slice | NDArray[np.intp]) -> "Paths":
        """Return those of some pulses."""
        return Paths(self.delay_s[pulses], self.amplitude[pulses], self.delay_rate[pulses])


def echo_paths(
    tx_position_m: Floats,
    rx_position_m: Floats,
    scatterers: Scatterers,
    *,
    path_offset_m: float = 0.0,
    tx_velocity_m_s: Floats | float = 0.0,
    rx_velocity_m_s: Floats | float = 0.0,
) -> Paths:
    """Return the echoes of scatterers: delay (R_tx + R_rx + offset)/c, amplitude a/(R_tx·R_rx).

    Parameters
    ----------
    tx_position_m, rx_position_m
        (pulse, 3) float64, phase centres in the Cartesian frame of the scatterers, metres.
    path_offset_m
        Electrical path of the receiving channel beyond geometry, metres.
    tx_velocity_m_s, rx_velocity_m_s
        (pulse, 3) float64, for Doppler within the pulse; zero without.

    Notes
    -----
    Source: docs/theory/simulate.md, eq. 1.

    Examples
    --------
    >>> point = Scatterers(np.array([[0.0, 3.0, 0.0]]), np.array([1.0 + 0j]))
    >>> paths = echo_paths(np.zeros((1, 3)), np.array([[4.0, 0.0, 0.0]]), point)
    >>> paths.delay_s * 299792458, paths.amplitude.real.round(4)
    (array([[8.]]), array([[0.0667]]))
    """
    tx_range, tx_rate = _range_and_rate(tx_position_m, tx_velocity_m_s, scatterers.position_m)
    rx_range, rx_rate = _range_and_rate(rx_position_m, rx_velocity_m_s, scatterers.position_m)
    return Paths(
        (tx_range + rx_range + path_offset_m) / SPEED_OF_LIGHT_M_S,
        scatterers.amplitude / (tx_range * rx_range),
        (tx_rate + rx_rate) / SPEED_OF_LIGHT_M_S,
    )


def direct_path(
    tx_position_m: Floats,
    rx_position_m: Floats,
    *,
    path_offset_m: float = 0.0,
    relative_velocity_m_s: Floats | float = 0.0,
) -> Paths:
    """Return the one path from antenna to antenna: delay (R + offset)/c, amplitude 1/R, level inside 1 m.

    Parameters
    ----------
    tx_position_m, rx_position_m, path_offset_m
        As for `echo_paths`.
    relative_velocity_m_s
        (pulse, 3) float64, transmitter's less receiver's velocity.

    Examples
    --------
    >>> direct_path(np.zeros((1, 3)), np.array([[4.0, 0.0, 0.0]])).amplitude
    array([[0.25+0.j]])
    """
    distance, rate = _range_and_rate(tx_position_m - rx_position_m, relative_velocity_m_s, np.zeros((1, 3)))
    delay = (distance + path_offset_m) / SPEED_OF_LIGHT_M_S
    return Paths(delay, 1 / np.maximum(distance, 1.0).astype(np.complex128), rate / SPEED_OF_LIGHT_M_S)


def _range_and_rate(antenna_m: Floats, velocity_m_s: Floats | float, points_m: Floats) -> tuple[Floats, Floats]:
    sight = antenna_m[:, None, :] - points_m[None, :, :]
    distance = np.sqrt(np.einsum("pki,pki->pk", sight, sight))
    velocity = np.broadcast_to(np.asarray(velocity_m_s, np.float64), antenna_m.shape)
    return distance, np.einsum("pki,pi->pk", sight, velocity) / np.maximum(distance, 1e-9)
