"""Detection and false alarms of change detection, on images of simulated revisits, without apertura's simulator.

Images are backprojected here from the echoes of point scatterers, equation by equation, with numpy. Each scene has 20
targets, of which 5 appear, 5 vanish, 5 move by 1 m and 5 turn (amplitude × 0.5, random phase). Tracks are 0, 0.1 and
1 m apart, with slowly varying position errors of 1 cm. A target is detected if a pixel within half a window is reported
as changed; the table also lists the detections by the window about the target alone. The prediction applies the
thresholds to single windows of independent samples that contain the target. Run:
`.venv/bin/python benchmarks/change.py [targets] [unchanged] [--scenes 20] [--draw FILE.png]`.
"""

import argparse
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from apertura.methods.change.detection import NO_DATA, UNCHANGED, change_regions, detect_changes
from apertura.methods.change.statistics import CoherenceDistribution, matched_looks, ratio_probability, window_modes
from apertura.methods.interferometry.coherence import box_sum

C_M_S = 299_792_458.0
FREQUENCY_HZ = 1.405e9 + np.linspace(-205e6, 205e6, 96)
WEIGHTS = np.hanning(98)[1:-1]
PULSES, LENGTH_M, HEIGHT_M, AWAY_M = 64, 6.0, 25.0, 25.0
HALF_M, SPACING_M, DENSITY_M2 = 16.0, 0.25, 12.0
WINDOW = 11
SNR = 100.0
RATE = 1e-4
KINDS = ("appeared", "vanished", "moved", "turned")
LEVELS_DB = (0.0, 5.0, 10.0, 15.0, 20.0)
OFFSETS_M = (0.0, 0.1, 1.0)
ERROR_M = 0.01


@dataclass(frozen=True)
class Points:
    """Point scatterers: (n, 2) metres, (n,) complex amplitudes."""

    place_m: np.ndarray
    amplitude: np.ndarray

    def __add__(self, other):
        return Points(*(np.concatenate(pair) for pair in zip(vars(self).values(), vars(other).values(), strict=True)))


def track(offset_m, generator, error_m):
    """Return the logged and the true positions of a flight; the offset is across the line of sight."""
    along = np.linspace(-LENGTH_M / 2, LENGTH_M / 2, PULSES)
    across_m = offset_m / np.sqrt(2)
    logged = np.stack([along, np.full(PULSES, -AWAY_M - across_m), np.full(PULSES, HEIGHT_M + across_m)], -1)
    phase = np.linspace(0, 1, PULSES)[:, None]
    slow = np.sqrt(2) * np.sin(2 * np.pi * (0.5 * phase + generator.random(3)))
    constant = generator.normal(size=3)
    return logged, logged + error_m * np.sqrt(0.5) * (constant + slow)


def image(points, logged, true, noise=None):
    """Backproject the echoes of points: S(f) = Σ a exp(-j4πfR/c), range profiles, then Σ p(R) exp(j4πf₀R/c).

    With a generator `noise`, the echoes are white noise instead.
    """
    step = FREQUENCY_HZ[1] - FREQUENCY_HZ[0]
    at = np.arange(-HALF_M + SPACING_M / 2, HALF_M, SPACING_M)
    x, y = np.meshgrid(at, at[::-1])
    total, count = np.zeros(x.shape, np.complex128), 4096
    middle = np.hypot(HEIGHT_M, AWAY_M)
    for where, flown in zip(logged, true, strict=True):
        r = np.sqrt(((points.place_m - flown[:2]) ** 2).sum(axis=1) + flown[2] ** 2) - middle
        # successive frequencies differ by a constant factor per scatterer
        factor = np.exp(-4j * np.pi * step * r / C_M_S)
        value = points.amplitude * np.exp(-4j * np.pi * FREQUENCY_HZ[0] * r / C_M_S)
        echo = np.empty(len(FREQUENCY_HZ), np.complex128)
        for number in range(len(FREQUENCY_HZ)):
            echo[number] = value.sum()
            value *= factor
        if noise is not None:
            echo = noise.normal(size=len(echo)) + 1j * noise.normal(size=len(echo))
        padded = np.zeros(count, np.complex128)
        padded[: len(echo)] = WEIGHTS * echo
        profile = np.fft.ifft(padded) * count
        rho = np.sqrt((x - where[0]) ** 2 + (y - where[1]) ** 2 + where[2] ** 2) - middle
        sample = rho * 2 * step / C_M_S * count
        low = np.floor(sample).astype(int)
        share = sample - low
        between = profile[low % count] * (1 - share) + profile[(low + 1) % count] * share
        total += between * np.exp(4j * np.pi * FREQUENCY_HZ[0] * rho / C_M_S)
    return total / PULSES


def aligned(second, first):
    """Remove the phase between the images that varies as a quadratic polynomial, fitted to the phases of windows."""
    phase = np.zeros(first.shape)
    row, column = np.indices(first.shape) / first.shape[0] * 2 - 1
    terms = np.stack([row**0, row, column, row * column, row**2, column**2], -1)
    for _ in range(4):
        crossed = box_sum(second * np.exp(-1j * phase) * first.conj(), WINDOW)
        centre = np.angle(crossed.sum())
        angle = np.angle(crossed * np.exp(-1j * centre)) + centre
        weight = np.abs(crossed) * (np.abs(angle - centre) < 1.5)
        design = (terms * weight[..., None]).reshape(-1, terms.shape[-1])
        phase = phase + terms @ np.linalg.lstsq(design, (angle * weight).ravel(), rcond=None)[0]
    return second * np.exp(-1j * phase)


def overlap(offset_m):
    """Return the coherence that a baseline across the line of sight leaves: Hann window shifted by f₀B/(R tan θ)."""
    shift = FREQUENCY_HZ.mean() * offset_m / np.hypot(HEIGHT_M, AWAY_M) / (FREQUENCY_HZ[1] - FREQUENCY_HZ[0])
    index = np.arange(len(WEIGHTS))
    moved = np.interp(index + shift, index, WEIGHTS, left=0, right=0)
    return float((WEIGHTS * moved).sum() / np.sqrt((WEIGHTS**2).sum() * (moved**2).sum()))


def clutter(generator):
    count = int(DENSITY_M2 * (2 * HALF_M + 3) ** 2)
    amplitude = generator.normal(size=count) + 1j * generator.normal(size=count)
    return Points(generator.uniform(-HALF_M - 1.5, HALF_M + 1.5, (count, 2)), amplitude)


@cache
def response():
    """Return the image of a point of amplitude 1, and the mean power of clutter."""
    generator = np.random.default_rng(0)
    logged, _ = track(0.0, generator, 0.0)
    point = image(Points(np.zeros((1, 2)), np.ones(1, complex)), logged, logged)
    power = (np.abs(image(clutter(generator), logged, logged)) ** 2).mean()
    return point, power


def scene(seed, offset_m, level_db=None, error_m=ERROR_M):
    """Return reference, revisit, expected coherence, and (kind, places) of the targets of a scene."""
    generator = np.random.default_rng(seed)
    ground = clutter(generator)
    before, after, targets = [], [], []
    if level_db is not None:
        point, power = response()
        size = np.sqrt(power) / np.abs(point).max() * 10 ** (level_db / 20)
        places = [(x, y) for x in np.linspace(-12, 12, 5) for y in np.linspace(-10.5, 10.5, 4)]
        for number, place in enumerate(places):
            kind = KINDS[number % len(KINDS)]
            own = Points(
                np.array([place]) + generator.uniform(-0.3, 0.3, 2), size * np.exp(2j * np.pi * generator.random(1))
            )
            other = own
            if kind == "moved":
                angle = 2 * np.pi * generator.random()
                other = replace(own, place_m=own.place_m + [np.cos(angle), np.sin(angle)])
            if kind == "turned":
                other = replace(own, amplitude=0.5 * own.amplitude * np.exp(2j * np.pi * generator.random()))
            before += [own] if kind != "appeared" else []
            after += [other] if kind != "vanished" else []
            targets.append((kind, np.concatenate([own.place_m, other.place_m])))
    flights, error_rad = [], 0.0
    for points, offset in ((before, 0.0), (after, offset_m)):
        logged, true = track(offset, generator, error_m)
        sight = logged / np.linalg.norm(logged, axis=1, keepdims=True)
        error_rad = 4 * np.pi * FREQUENCY_HZ.mean() / C_M_S * ((true - logged) * sight).sum(axis=1) - error_rad
        formed = image(sum(points, ground), logged, true)
        noise = image(Points(np.zeros((0, 2)), np.zeros(0, complex)), logged, logged, generator)
        ratio = (np.abs(noise) ** 2).mean() / np.median(np.abs(formed) ** 2) * np.log(2)
        flights.append(formed + noise / np.sqrt(SNR * ratio))
    flights[1] = aligned(flights[1], flights[0])
    # coherence that remains with the variation of the position errors over the aperture, at the scene centre
    motion = np.abs(np.exp(1j * error_rad).mean())
    expected = np.full(flights[0].shape, overlap(offset_m) * motion * SNR / (1 + SNR))
    return *(one.astype(np.complex64) for one in flights), expected, targets


def predicted(level_db, coherence, modes, generator, trials=4000):
    """Return the probability of detecting each kind of change in the window about the target."""
    looks, matched = round(1 / (modes**2).sum()), matched_looks(modes, RATE / 2)
    point, _ = response()
    energy = 10 ** (level_db / 10) * (np.abs(point) ** 2).sum() / np.abs(point).max() ** 2 / WINDOW**2 * looks
    distribution = CoherenceDistribution(round(matched, 2))
    found = {}
    for kind in KINDS:
        first = (generator.normal(size=(trials, looks)) + 1j * generator.normal(size=(trials, looks))) / np.sqrt(2)
        own = (generator.normal(size=(trials, looks)) + 1j * generator.normal(size=(trials, looks))) / np.sqrt(2)
        second = coherence * first + np.sqrt(1 - coherence**2) * own
        turn = np.exp(2j * np.pi * generator.random((trials, 1)))
        if kind != "appeared":
            first = first + np.sqrt(energy) * np.eye(looks)[0]
        if kind == "appeared":
            second = second + np.sqrt(energy) * np.eye(looks)[0]
        if kind == "moved":
            second = second + np.sqrt(energy) * np.eye(looks)[1]
        if kind == "turned":
            second = second + 0.5 * turn * np.sqrt(energy) * np.eye(looks)[0]
        powers = [(np.abs(one) ** 2).sum(axis=1) for one in (first, second)]
        estimate = np.abs((first * second.conj()).sum(axis=1)) / np.sqrt(powers[0] * powers[1])
        flat = np.full(trials, coherence)
        changed = ratio_probability(np.log(powers[1] / powers[0]), flat, matched) < RATE / 2
        changed |= distribution.probability(estimate, flat) < RATE / 2
        found[kind] = float(changed.mean())
    return found


def targets_table(scenes, draw):
    """Print detection against prediction for each kind of change, level and distance of the tracks."""
    print(f"false-alarm rate {RATE:g} per pixel, window {WINDOW} px, {scenes} scenes of 20 targets, errors {ERROR_M} m")
    print("apart m | level dB | " + " | ".join(f"{kind}: found, by its window, predicted" for kind in KINDS)
          + " | false pixels: found, expected | false regions | coherence")  # fmt: skip
    curves = {}
    for offset_m in OFFSETS_M:
        for level_db in LEVELS_DB:
            hits, central, counts = (dict.fromkeys(KINDS, 0) for _ in range(3))
            wrong, pixels, regions, coherences = 0, 0, 0, []
            for seed in range(scenes):
                first, second, expected, targets = scene(seed, offset_m, level_db)
                changes = detect_changes(first, second, expected, window=WINDOW, rate=RATE)
                coherences.append(changes.expected)
                changed = ~np.isin(changes.classes, (UNCHANGED, NO_DATA))
                away = changes.classes != NO_DATA
                row, column = np.indices(first.shape)
                for kind, places in targets:
                    near, at = np.zeros(first.shape, bool), None
                    for x, y in places:
                        distance = np.maximum(np.abs((HALF_M - y) / SPACING_M - 0.5 - row),
                                              np.abs((x + HALF_M) / SPACING_M - 0.5 - column))  # fmt: skip
                        near |= distance <= WINDOW / 2
                        at = np.unravel_index(distance.argmin(), distance.shape) if at is None else at
                        away &= distance > WINDOW / 2 + 4
                    counts[kind] += 1
                    hits[kind] += bool((changed & near).any())
                    central[kind] += bool(changed[at])
                wrong, pixels = wrong + int((changed & away).sum()), pixels + int(away.sum())
                found, labels = change_regions(changes, window=WINDOW)
                regions += sum(not (labels == one.number)[~away].any() for one in found)
            level = float(np.mean(coherences))
            expectation = predicted(level_db, level, window_modes(first, WINDOW), np.random.default_rng(1))
            rates = {kind: [one[kind] / counts[kind] for one in (hits, central)] for kind in KINDS}
            cells = [f"{rates[kind][0]:.2f}, {rates[kind][1]:.2f}, {expectation[kind]:.2f}" for kind in KINDS]
            curves[offset_m, level_db] = [(*rates[kind], expectation[kind]) for kind in KINDS]
            print(f"{offset_m} | {level_db:.0f} | {' | '.join(cells)} | {wrong}, {RATE * pixels:.1f} | {regions} | "
                  f"{level:.3f}", flush=True)  # fmt: skip
    if draw:
        drawn(curves, draw)


def drawn(curves, path):
    """Draw detection against the level: by the target's window (dots), by any window (crosses), predicted (lines)."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, len(KINDS), figsize=(11, 3), sharey=True, layout="constrained")
    for number, (axis, kind) in enumerate(zip(axes, KINDS, strict=True)):
        for colour, offset_m in zip(("C0", "C1", "C3"), OFFSETS_M, strict=True):
            found, central, expected = np.array([curves[offset_m, level][number] for level in LEVELS_DB]).T
            axis.plot(LEVELS_DB, expected, color=colour, linewidth=1)
            axis.plot(LEVELS_DB, central, "o", color=colour, label=f"{offset_m:g} m")
            axis.plot(LEVELS_DB, found, "+", color=colour)
        axis.set(title=kind, xlabel="peak over clutter, dB", ylim=(-0.03, 1.03))
        axis.grid(alpha=0.3)
    axes[0].set_ylabel(f"detected, rate {RATE:g}")
    axes[0].legend(title="tracks apart", fontsize=8, title_fontsize=8)
    figure.savefig(path, dpi=110)


def unchanged_table(scenes):
    """Print false alarms in scenes without a change against the requested rate."""
    print(f"{scenes} scenes without a change; pixels per test: false, expected; regions")
    print(
        "apart m | errors m | rate | amplitude | coherence | regions: found, at most expected | scenes with one | looks"
    )
    for offset_m, error_m in ((0.0, 0.0), *((offset_m, ERROR_M) for offset_m in OFFSETS_M)):
        pairs = [scene(1000 + seed, offset_m, error_m=error_m)[:3] for seed in range(scenes)]
        for rate in (1e-2, 1e-3, 1e-4):
            amplitude = coherent = regions = with_region = 0
            expected, limit, looks = 0.0, 0.0, []
            for first, second, level in pairs:
                changes = detect_changes(first, second, level, window=WINDOW, rate=rate)
                amplitude += int(np.isin(changes.classes, (1, 2)).sum())
                coherent += int((changes.classes == 3).sum())
                found = len(change_regions(changes, window=WINDOW)[0])
                regions, with_region = regions + found, with_region + bool(found)
                expected += rate / 2 * changes.valid
                limit += rate * changes.tests(WINDOW)
                looks.append(changes.looks)
            print(f"{offset_m} | {error_m} | {rate:g} | {amplitude}, {expected:.0f} | {coherent}, {expected:.0f} | "
                  f"{regions}, {limit:.1f} | {with_region} | {np.mean(looks):.1f}", flush=True)  # fmt: skip


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("tables", nargs="*", default=["targets", "unchanged"])
    parser.add_argument("--scenes", type=int, default=20)
    parser.add_argument("--draw")
    options = parser.parse_args()
    if "unchanged" in options.tables:
        unchanged_table(options.scenes)
    if "targets" in options.tables:
        targets_table(options.scenes, options.draw)


if __name__ == "__main__":
    main()
