"""Track refinement of long flights: CPU seconds and peak memory against the length of the flight.

`python -m benchmarks.refinement.long WORK --minutes 1 2 5 10` simulates range profiles of the three pairs of `--preset
flight` (one transmitter and two receivers at 5 m/s and 500 Hz past twelve points on 410 m of terrain) into WORK, half a
gigabyte per minute; the logs have errors of 2 cm. Each length is refined in a separate process, with height and time
errors as possible causes. Run with OPENBLAS_NUM_THREADS=1 to measure times of one core.
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
_AT_ONCE, _GUARD = 4096, 40  # pulses per block; samples before and behind the scene
_TAPS = np.arange(-24, 25)


def main() -> None:
    """Refine flights of the requested lengths, each in a separate process, and print times and memory."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path)
    parser.add_argument("--minutes", type=float, nargs="+", default=[1, 2, 5, 10])
    options = parser.parse_args()
    options.work.mkdir(parents=True, exist_ok=True)
    if len(options.minutes) == 1:
        print(measured(options.work, options.minutes[0]))
        return
    for minutes in options.minutes:
        command = [sys.executable, "-m", __spec__.name, str(options.work), "--minutes", f"{minutes:g}"]
        subprocess.run(command, check=True)


def measured(work: Path, minutes: float) -> str:
    """Refine a flight; return a line with its time, memory and result."""
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
    before_mb, start_s = _peak_mb(), process_time()
    result = refine(records, GRID, GROUND, errors, causes=causes)
    cost = f"{process_time() - start_s:6.1f} CPU s, peak {_peak_mb():5.0f} MB ({before_mb:.0f} MB before)"
    return f"{minutes:4g} min: {cost}; {'accepted' if result.accepted else 'rejected'}: {result.reason}"


def _peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


class Recorded:
    """Samples in a file, (pulse, range) complex64, read on conversion to an array."""

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
    """Return a pair with its logged tracks, and write the echoes of its true tracks to a file."""
    aperture, step_m = Aperture(logged[tx], logged[rx]), SPEED_OF_LIGHT_M_S / BAND_HZ / 2
    edge = np.array([(x, y, 0.0) for x in (-HALF_M, HALF_M) for y in (-HALF_M, HALF_M)])
    abreast_m = np.clip((logged[tx] + logged[rx])[:, 0] / 2, -HALF_M, HALF_M)
    nearest = np.stack([abreast_m, np.full(len(time_s), -HALF_M), np.zeros(len(time_s))], axis=-1)
    start_m = sum(np.linalg.norm(nearest - leg, axis=1) for leg in aperture.legs) - _GUARD * step_m
    farthest_m = np.max([aperture.path(place[None])[:, 0] for place in edge], axis=0)
    samples = int(np.ceil((farthest_m - start_m).max() / step_m)) + _GUARD
    if not path.exists():
        longer_m = np.linalg.norm(flown[tx] - flown[rx], axis=1) - np.linalg.norm(logged[tx] - logged[rx], axis=1)
        with path.open("wb") as file:
            for first in range(0, len(time_s), _AT_ONCE):
                block = slice(first, first + _AT_ONCE)
                at = Aperture(flown[tx][block], flown[rx][block])
                _echo(at, longer_m[block], start_m[block], step_m, samples, first).tofile(file)
    profiles = Profiles(
        np.broadcast_to(np.zeros(1, np.complex64), (len(time_s), samples)), start_m, step_m, CENTRE_HZ, 2.0, aperture
    )
    object.__setattr__(profiles, "samples", Recorded(path, (len(time_s), samples)))  # read on access, like a stage
    sector = decide_integration(aperture, CENTRE_HZ, GRID, GROUND).sector
    between_m = None if tx == rx else aperture.tx_m - aperture.rx_m
    return PairRecord(f"{tx}-{rx}", profiles, time_s, between_m, Beams.within(sector, None))


def _echo(
    aperture: Aperture, longer_m: Floats, start_m: Floats, step_m: float, samples: int, seed: int
) -> NDArray[np.complex64]:
    """Simulate profiles, (pulse, range): targets with spreading loss and the restored sidelink length, and noise."""
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
