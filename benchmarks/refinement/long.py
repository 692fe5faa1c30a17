"""Refinement of a long flight: CPU seconds and peak memory against its length.

`python -m benchmarks.refinement.long WORK --minutes 1 2 5 10` makes range profiles of three pairs as `--preset flight`
flies them (one transmitter and two receivers at 5 m/s and 500 Hz past twelve points on 410 m of ground), in WORK, half
a gigabyte a minute; logs err by 2 cm. Each length is refined in a process of its own, wrong heights and times tried
beside errors of the logs. Run with OPENBLAS_NUM_THREADS=1: seconds are then those of one core.
"""

import argparse
import resource
import subprocess
import sys
from pathlib import Path
from time import process_time

import numpy as np
from apertura_research.autofocus.cases import NODES
from numpy.typing import NDArray

from apertura.common.arrays import Floats
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.core.antenna.beam import Beams
from apertura.core.backprojection.inputs import Profiles
from apertura.core.geometry.aperture import Aperture
from apertura.core.imaging.job import decide_integration
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.terrain import FlatGround
from apertura.methods.autofocus.inputs import NodePrior, PairRecord, TrackErrors
from apertura.methods.autofocus.refine import refine
from apertura.methods.causes import late_logs, other_height

PULSES_HZ, SPEED_M_S, SIGMA_M, NOISE = 500.0, 5.0, 0.02, 0.02
CENTRE_HZ, BAND_HZ = 1.2512e9, 102.4e6
HALF_M = 204.8
GRID, GROUND = SceneGrid("local", -HALF_M, HALF_M, 0.1, (4096, 4096)), FlatGround(0.0)
BEGIN_M = dict(zip((*NODES, "uav3"), ((0.0, -270.0, 80.0), (12.0, -270.0, 82.0), (-15.0, -270.0, 82.0)), strict=True))
TARGETS_M = np.array([(x, y, 0.0) for x in (-150.0, -50.0, 50.0, 150.0) for y in (-160.0, -40.0, 80.0)])
_AT_ONCE, _GUARD = 4096, 40  # pulses; samples before and behind the scene
_TAPS = np.arange(-24, 25)


def main() -> None:
    """Refine flights of the lengths asked for, each in a process of its own, and print what they took."""
    asked = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    asked.add_argument("work", type=Path)
    asked.add_argument("--minutes", type=float, nargs="+", default=[1, 2, 5, 10])
    given = asked.parse_args()
    given.work.mkdir(parents=True, exist_ok=True)
    if len(given.minutes) == 1:
        print(measured(given.work, given.minutes[0]))
        return
    for minutes in given.minutes:
        one = [sys.executable, "-m", __spec__.name, str(given.work), "--minutes", f"{minutes:g}"]
        subprocess.run(one, check=True)


def measured(work: Path, minutes: float) -> str:
    """Return what the refinement of a flight took, a line."""
    time_s = np.arange(round(60 * minutes * PULSES_HZ)) / PULSES_HZ
    logged = {
        node: begin + SPEED_M_S * (time_s - time_s[-1] / 2)[:, None] * [1, 0, 0] for node, begin in BEGIN_M.items()
    }
    errors = {node: TrackErrors((SIGMA_M,) * 3) for node in logged}
    knots_s, generator = np.arange(0, time_s[-1] + 0.1, 0.1), np.random.default_rng(1)
    flown = {}
    for node, places in logged.items():
        prior = NodePrior.of(errors[node], knots_s, np.eye(3))
        moved = prior.tracks(generator.standard_normal(prior.size))
        flown[node] = places + np.stack([np.interp(time_s, knots_s, axis) for axis in moved.T], axis=-1)
    records = [_record(work / f"{rx}-{minutes:g}.bin", NODES[0], rx, time_s, logged, flown) for rx in logged]
    tracks = {node: (time_s, places) for node, places in logged.items()}
    late = [late_logs([node], tracks) for node in tracks]
    causes = [other_height(list(tracks), time_s, np.array([0.0, 0, 1])), *late, late_logs(list(tracks), tracks)]
    before_mb, begun = _peak_mb(), process_time()
    found = refine(records, GRID, GROUND, errors, causes=causes)
    took = f"{process_time() - begun:6.1f} CPU s, peak {_peak_mb():5.0f} MB ({before_mb:.0f} MB before)"
    return f"{minutes:4g} min: {took}; {'accepted' if found.accepted else 'rejected'}: {found.reason}"


def _peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


class Recorded:
    """Samples (pulse, range) complex64 of a file, read when they are asked for as an array."""

    ndim, dtype = 2, np.dtype(np.complex64)

    def __init__(self, path: Path, shape: tuple[int, int], first: int = 0) -> None:
        self.path, self.shape, self.first = path, shape, first

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, pulses: slice) -> "Recorded":
        begin, end, _ = pulses.indices(len(self))
        return Recorded(self.path, (end - begin, self.shape[1]), self.first + begin)

    def __array__(self, dtype: object = None, copy: bool | None = None) -> NDArray[np.complex64]:
        offset = self.first * self.shape[1] * self.dtype.itemsize
        read = np.fromfile(self.path, self.dtype, self.shape[0] * self.shape[1], offset=offset)
        return np.asarray(read.reshape(self.shape), np.complex64)


def _record(
    path: Path, tx: str, rx: str, time_s: Floats, logged: dict[str, Floats], flown: dict[str, Floats]
) -> PairRecord:
    """Return a pair along its logs, with the echoes of the tracks that were flown, in a file."""
    aperture, step_m = Aperture(logged[tx], logged[rx]), SPEED_OF_LIGHT_M_S / BAND_HZ / 2
    edge = np.array([(x, y, 0.0) for x in (-HALF_M, HALF_M) for y in (-HALF_M, HALF_M)])
    beside = np.clip((logged[tx] + logged[rx])[:, 0] / 2, -HALF_M, HALF_M)
    nearest = np.stack([beside, np.full(len(time_s), -HALF_M), np.zeros(len(time_s))], axis=-1)
    start_m = sum(np.linalg.norm(nearest - leg, axis=1) for leg in aperture.legs) - _GUARD * step_m
    farthest_m = np.max([aperture.path(place[None])[:, 0] for place in edge], axis=0)
    samples = int(np.ceil((farthest_m - start_m).max() / step_m)) + _GUARD
    if not path.exists():
        longer_m = np.linalg.norm(flown[tx] - flown[rx], axis=1) - np.linalg.norm(logged[tx] - logged[rx], axis=1)
        with path.open("wb") as file:
            for first in range(0, len(time_s), _AT_ONCE):
                some = slice(first, first + _AT_ONCE)
                at = Aperture(flown[tx][some], flown[rx][some])
                _echo(at, longer_m[some], start_m[some], step_m, samples, first).tofile(file)
    profiles = Profiles(
        np.broadcast_to(np.zeros(1, np.complex64), (len(time_s), samples)), start_m, step_m, CENTRE_HZ, 2.0, aperture
    )
    object.__setattr__(profiles, "samples", Recorded(path, (len(time_s), samples)))  # as a stage is: read on access
    sector = decide_integration(aperture, CENTRE_HZ, GRID, GROUND).sector
    between_m = None if tx == rx else aperture.tx_m - aperture.rx_m
    return PairRecord(f"{tx}-{rx}", profiles, time_s, between_m, Beams.within(sector, None))


def _echo(
    aperture: Aperture, longer_m: Floats, start_m: Floats, step_m: float, samples: int, seed: int
) -> NDArray[np.complex64]:
    """Return (pulse, range): the targets by spreading, their sidelink's length given back, and noise."""
    generator, pulse = np.random.default_rng(seed), np.arange(len(longer_m))[:, None]
    noise = generator.standard_normal((2, len(longer_m), samples))
    echo: NDArray[np.complex64] = np.asarray(NOISE * (noise[0] + 1j * noise[1]), np.complex64)
    for place in TARGETS_M:
        path = aperture.path(place[None])[:, 0] - longer_m
        at = (path - start_m) / step_m
        near = np.rint(at).astype(np.int64)[:, None] + _TAPS
        level = (600 / path) ** 2 * np.exp(-2j * np.pi * CENTRE_HZ / SPEED_OF_LIGHT_M_S * path)
        part = np.sinc((near - at[:, None]) / 2) * np.hanning(len(_TAPS) + 2)[1:-1] * level[:, None]
        inside = (near >= 0) & (near < samples)
        echo[np.broadcast_to(pulse, near.shape)[inside], near[inside]] += part[inside]
    return echo


if __name__ == "__main__":
    main()
