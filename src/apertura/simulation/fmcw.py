"""Beat signals of an FMCW radar over point targets, exact in phase and without the stop-and-go approximation."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apertura.common.arrays import Floats
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.core.echo.dechirp import FrequencySweep
from apertura.core.geometry.geodesy import ecef_from_projected, geodetic_from_ecef

Place = tuple[float, float, float]

_LOG_STEP_S = 0.1
_LOG_MARGIN_S = 1.0


@dataclass(frozen=True)
class FmcwFlight:
    """Flight of nodes with a common clock on parallel straight tracks past point targets; the first node transmits.

    Attributes
    ----------
    sweep
        Frequency sweep, mixing and sampling.
    prf_hz, sweeps
        Sweep repetition frequency, and number of sweeps.
    began
        UTC of the first sweep.
    nodes
        Node → east, north, up at the midpoint of the flight, metres from the origin.
    speed_m_s
        Speed, eastward.
    targets
        East, north, up, metres from the origin; amplitude 1 each.
    crs, origin
        Projected CRS, and easting, northing and ellipsoidal height of the origin.
    half_width_m, spacing_m
        Half width and pixel spacing of the scene about `middle`.
    middle
        East and north of the scene centre, metres from the origin.
    """

    sweep: FrequencySweep
    prf_hz: float
    sweeps: int
    nodes: Mapping[str, Place]
    targets: Sequence[Place]
    speed_m_s: float = 5.0
    began: np.datetime64 = field(default_factory=lambda: np.datetime64("2025-05-14T09:30", "ns"))
    crs: str = "EPSG:32632"
    origin: Place = (570_000.0, 5_363_000.0, 500.0)
    middle: tuple[float, float] = (0.0, 0.0)
    half_width_m: float = 4.0
    spacing_m: float = 0.125

    @property
    def start_s(self) -> Floats:
        """Start of each sweep, (sweep,) seconds from `began`."""
        return np.arange(self.sweeps) / self.prf_hz

    def place(self, point: Place) -> Floats:
        """Return the ECEF position of a point, (3,) float64, metres."""
        east, north, up = np.add(self.origin, point)
        position_m: Floats = ecef_from_projected(self.crs, np.array(east), np.array(north), np.array(up))
        return position_m

    def flown(self, node: str, time_s: Floats) -> Floats:
        """Return the ECEF position of a node in uniform straight motion, (…, 3) float64, metres."""
        east, north, up = self.nodes[node]
        middle_m, after_1_s_m = self.place((east, north, up)), self.place((east + self.speed_m_s, north, up))
        position_m: Floats = middle_m + (time_s - self.start_s.mean())[..., None] * (after_1_s_m - middle_m)
        return position_m

    def beats(self, node: str) -> NDArray[np.number]:
        """Return the beat signals that a node records, (sweep, sample)."""
        transmitter = next(iter(self.nodes))

        def path_to(target: Place) -> Callable[[Floats], Floats]:
            target_m = self.place(target)
            return lambda time: sum(
                np.linalg.norm(self.flown(end, time) - target_m, axis=-1) for end in (transmitter, node)
            )

        paths = [path_to(target) for target in self.targets]
        return beat_signal(self.sweep, self.start_s, paths, [1.0] * len(paths))


def write_fmcw_campaign(root: Path, flight: FmcwFlight, *, waveform: Mapping[str, Any]) -> Path:
    """Write a campaign folder with beat signals in .npy files; return the folder.

    Parameters
    ----------
    root
        Folder of the campaign; it must not exist.
    flight
        Flight and sweep.
    waveform
        Keys of the section `waveform` that replace the correct keys.
    """
    import yaml

    (root / "raw/f01").mkdir(parents=True)
    (root / "config").mkdir()
    time = flight.began + np.round(flight.start_s * 1e9).astype("timedelta64[ns]")
    epoch_s = np.arange(-_LOG_MARGIN_S, flight.start_s[-1] + _LOG_MARGIN_S, _LOG_STEP_S)
    for node in flight.nodes:
        _write_log(root / f"raw/f01/{node}.track.csv", flight, node, epoch_s)
        np.save(root / f"raw/f01/{node}.npy", flight.beats(node).astype("f4" if flight.sweep.iq == "real" else "c8"))
        np.save(root / f"raw/f01/{node}.time.npy", time)
    (root / "config" / "config.yaml").write_text(yaml.safe_dump(_config(flight, waveform)), encoding="utf-8")
    names = list(flight.nodes)
    line = f"f01\timage\t{names[0]}\t{','.join(names)}"
    (root / "config/flights.tsv").write_text(f"flight\tkind\ttransmitter\tnodes\n{line}\n", encoding="utf-8")
    return root


def _config(flight: FmcwFlight, waveform: Mapping[str, Any]) -> dict[str, Any]:
    east, north = (origin + offset for origin, offset in zip(flight.origin, flight.middle, strict=False))
    half = flight.half_width_m
    return {
        "campaign": "fmcw",
        "waveform": {"kind": "fmcw", "format": "beat_npy", **asdict(flight.sweep), **waveform},
        "nodes": {node: {"attitude": "none"} for node in flight.nodes},
        "scene": {
            "crs": flight.crs,
            "bounds_m": [east - half, north - half, east + half, north + half],
            "spacing_m": flight.spacing_m,
            "height_m": flight.origin[2],
            "height_datum": "ellipsoid",
            "atmosphere": {"refractivity_n": 0.0},  # `beats` assumes vacuum
        },
    }


def _write_log(path: Path, flight: FmcwFlight, node: str, epoch_s: Floats) -> None:
    rows = [
        f"{flight.began + np.timedelta64(round(second * 1e9), 'ns')}Z,{latitude:.11f},{longitude:.11f},{height:.6f}"
        for second, (latitude, longitude, height) in zip(
            epoch_s, geodetic_from_ecef(flight.flown(node, epoch_s)), strict=True
        )
    ]
    path.write_text("\n".join(["time_utc,latitude_deg,longitude_deg,height_m", *rows]) + "\n", encoding="utf-8")


def beat_signal(
    sweep: FrequencySweep, start_s: Floats, paths: Sequence[Callable[[Floats], Floats]], amplitudes: Sequence[float]
) -> NDArray[np.number]:
    """Compute the beat signal of echoes, sample by sample.

    Parameters
    ----------
    sweep
        Frequency sweep, mixing and sampling.
    start_s
        (pulse,) float64, start of each sweep, seconds.
    paths
        Per target: function of the time of reception (s, any shape) that gives the total path of its echo, metres.
    amplitudes
        Amplitude of each target.

    Returns
    -------
    ndarray
        (pulse, sample), float64 or complex128 according to `sweep.iq`; an echo starts at its delay.

    Notes
    -----
    Source: docs/theory/fmcw.md, eq. 1, evaluated with the exact phases of the transmitted and the received sweep.

    Examples
    --------
    >>> import numpy as np
    >>> sweep = FrequencySweep(2.2e9, 400e6, 20e-6, 25e6)
    >>> beat_signal(sweep, np.zeros(1), [lambda t: np.full_like(t, 60.0)], [1.0]).shape
    (1, 500)
    """
    elapsed = np.arange(sweep.sweep_samples) / sweep.sample_rate_hz
    time_s = np.asarray(start_s)[:, None] + elapsed
    reference = _phase(sweep, elapsed - sweep.reference_delay_s)
    total = np.zeros(time_s.shape, np.complex128)
    for path, amplitude in zip(paths, amplitudes, strict=True):
        emission_s = elapsed - path(time_s) / SPEED_OF_LIGHT_M_S  # after the start of the sweep
        total += np.where(emission_s >= 0, amplitude * np.exp(1j * (_phase(sweep, emission_s) - reference)), 0)
    if sweep.iq == "real":
        return total.real
    return total.conj() if sweep.iq == "conjugate" else total


def _phase(sweep: FrequencySweep, time_s: Floats) -> Floats:
    """Return the phase of the sweep at a time after its start, radians."""
    return 2 * np.pi * (sweep.start_hz * time_s + sweep.slope_hz_s * time_s**2 / 2)
