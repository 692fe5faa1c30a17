"""Fusion of the UAV experiment's images: phase, clutter, sidelobes and widths, measured in the pipeline's products."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from apertura.common.arrays import Floats
from apertura.core.quality.point_targets import Cut, cut_through, find_peak
from apertura.simulation.presets import GAP_M, SEGMENT_M
from apertura_research.paper.claims import Claim, compare, require
from apertura_research.paper.experiments import (
    BISTATIC,
    MONOSTATIC,
    Experiment,
    by_pair,
    open_experiment,
    terms_at,
)

EAST, NORTH = (1.0, 0.0), (0.0, 1.0)
REACH_M = 1.5
"""Half length of cuts, and radius about each target that is excluded from clutter measurements."""

WITHIN = 0.05
LARGEST_PHASE_RAD = 0.3


@dataclass(frozen=True)
class Images:
    """Four images of the flight on one grid, each (y, x), normalised to 1 at its brightest target.

    Attributes
    ----------
    amplitude
        `mono`, `bistatic`, `coherent` (complex64) and `noncoherent`, the sum of magnitudes as in the paper.
    pixel
        (target, 2) float64, row and column of each target, patches of random points last.
    """

    amplitude: dict[str, NDArray[np.complex64]]
    pixel: Floats
    spacing_m: float

    def cut(self, name: str, direction: tuple[float, float]) -> Cut:
        """Measure the width and sidelobes of an image through its brightest target."""
        image = self.amplitude[name]
        peak = find_peak(image, *self.brightest(name))
        return cut_through(image, peak, direction=direction, spacing_m=self.spacing_m, reach_m=REACH_M)

    def brightest(self, name: str) -> tuple[int, int]:
        """Return row and column of the brightest pixel."""
        magnitude: Floats = np.abs(self.amplitude[name])
        row, column = divmod(int(magnitude.argmax()), magnitude.shape[1])
        return row, column

    def clutter(self) -> NDArray[np.bool_]:
        """Return the mask of pixels farther than `REACH_M` from every target, (y, x) bool."""
        rows, columns = self.amplitude["mono"].shape
        places = np.stack(np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij"), -1)
        away = np.linalg.norm(places[:, :, None] - self.pixel, axis=-1)
        return np.asarray((away * self.spacing_m > REACH_M).all(axis=-1))


def open_images(experiment: Experiment) -> Images:
    """Read the images of the pairs and their sums from the cube."""
    cube, grid = experiment.opened.stage("cube"), experiment.opened.scene.grid
    pairs = dict(zip(cube.attrs["pairs"], cube.image.values[0], strict=True))
    amplitude = {"mono": pairs[MONOSTATIC], "bistatic": pairs[BISTATIC], "coherent": cube.coherent.values[0]}
    amplitude["noncoherent"] = cube.magnitude.values[0].astype(np.complex64)
    pixel = grid.pixel_below(np.concatenate([experiment.places_m, experiment.rough_m]))[:, :2]
    images = Images(amplitude, pixel, grid.spacing_m)
    peaks = {name: abs(find_peak(image, *images.brightest(name)).value) for name, image in amplitude.items()}
    return replace(images, amplitude={name: image / np.float32(peaks[name]) for name, image in amplitude.items()})


def fusion_claims(folder: Path) -> list[Claim]:
    """Return the gain and cost of fusion in the UAV experiment of a folder of campaigns."""
    experiment = open_experiment(folder, "uav")
    images = open_images(experiment)
    return [_phase(experiment), *_widths(images), *_clutter(images), *_sidelobes(images)]


def _phase(experiment: Experiment) -> Claim:
    mono, bistatic = (
        [terms_at(history, place).sum() for place in experiment.places_m] for history in by_pair(experiment).values()
    )
    worst = float(np.abs(np.angle(np.divide(bistatic, mono))).max())
    return require(
        "absolute coherence: phase of bistatic minus monostatic image, UAV flight",
        worst,
        "rad",
        limit=f"within ±{LARGEST_PHASE_RAD:g} rad",
        met=worst <= LARGEST_PHASE_RAD,
        style=".3f",
        note=f"worst of {len(mono)} targets, by the double sum at the true position of each, clutter included",
    )


def _widths(images: Images) -> list[Claim]:
    reason = (
        f"two track segments of {SEGMENT_M:g} m with a gap of {GAP_M:g} m, at midpoints, not fitted: the paper does "
        "not state which segments it used"
    )
    rows = []
    for axis, direction, printed in (("cross-range", EAST, "11"), ("ground-range", NORTH, "49")):
        width_cm = 100 * images.cut("coherent", direction).width_m
        name = f"UAV experiment: {axis} width, coherent sum"
        rows.append(compare(name, width_cm, "cm", paper=printed, within=WITHIN, style=".3g", reason=reason))
    single_m, noncoherent_m = (
        [images.cut(name, direction).width_m for direction in (EAST, NORTH)] for name in ("mono", "noncoherent")
    )
    finer = min(noncoherent / single for noncoherent, single in zip(noncoherent_m, single_m, strict=True))
    rows.append(
        require("UAV experiment: width of the noncoherent sum over that of the monostatic image", finer, "1",
                limit="at least 0.9", met=finer >= 0.9, words="noncoherent fusion gains no resolution", style=".2f",
                note="the smaller ratio of cross- and ground-range widths, cm: "
                + " against ".join(f"{100 * one[0]:.0f} × {100 * one[1]:.0f}" for one in (noncoherent_m, single_m)))
    )  # fmt: skip
    return rows


MAGNITUDES_DB, MAGNITUDES_CONTRAST = 0.49, 0.72
"""Clutter suppression and contrast of the sum of magnitudes of two independent Rayleigh clutters of equal power:
(|a| + |b|)²/4 has the mean (1 + π/4)/2 and the contrast √((10 + 3π)/(2 + π/2)² − 1); docs/theory/study.md."""


def _clutter(images: Images) -> list[Claim]:
    outside = images.clutter()
    power = {name: np.abs(image[outside]).astype(np.float64) ** 2 for name, image in images.amplitude.items()}
    level_db = {name: 10 * np.log10(values.mean()) for name, values in power.items()}
    contrast = {name: float(values.std() / values.mean()) for name, values in power.items()}
    single_db = 10 * np.log10((power["mono"].mean() + power["bistatic"].mean()) / 2)
    gained_db = {kind: single_db - level_db[kind] for kind in ("coherent", "noncoherent")}
    rows = [
        compare(
            f"clutter suppression by the {kind} sum: mean clutter relative to targets",
            gained_db[kind],
            "dB",
            independent_model=expected,
            within=1.0,
            relative=False,
            style=".2f",
            note=f"clutter {level_db['mono']:.1f} dB in mono, {level_db['bistatic']:.1f} dB in bistatic, "
            f"{level_db[kind]:.1f} dB in the sum; {reason}",
        )
        for kind, expected, reason in (
            ("coherent", 3.0, "targets add in amplitude, clutter of two look angles adds in power: 3 dB"),
            ("noncoherent", MAGNITUDES_DB, "magnitudes add: the clutter only becomes smoother"),
        )
    ]
    difference_db = gained_db["coherent"] - gained_db["noncoherent"]
    return [
        *rows,
        require("clutter suppression by the coherent sum over that by the noncoherent one", difference_db, "dB",
                limit="within ±1 dB", met=abs(difference_db) <= 1.0,
                words='that of the noncoherent sum is "comparable"', style=".2f",
                note=f"{gained_db['coherent']:.1f} dB against {gained_db['noncoherent']:.1f} dB; only the contrast "
                "of the clutter is comparable, see the next row"),
        compare("contrast of clutter in the noncoherent sum over that of one image",
                2 * contrast["noncoherent"] / (contrast["mono"] + contrast["bistatic"]), "1",
                independent_model=MAGNITUDES_CONTRAST, within=0.15, style=".2f",
                note="standard deviation of power over its mean, of two independent looks"),
    ]  # fmt: skip


def _sidelobes(images: Images) -> list[Claim]:
    cuts = {name: images.cut(name, EAST) for name in ("mono", "coherent")}
    expected_db = two_segment_sidelobe_db(SEGMENT_M, GAP_M)
    note = (
        f"mono {cuts['mono'].pslr_db:.1f} dB; the model is sin(πLu)/(πLu)·cos(πDu), D = L + gap, without clutter, for "
        "equal segments at broadside"
    )
    name = "highest cross-range sidelobe of the coherent sum, from the gap between segments"
    return [
        compare(name, cuts["coherent"].pslr_db, "dB", independent_model=expected_db, within=1.5, relative=False,
                style=".1f", note=note)
    ]  # fmt: skip


def two_segment_sidelobe_db(length_m: float, gap_m: float) -> float:
    """Return the highest sidelobe of two equal apertures with a gap between them, dB.

    Examples
    --------
    >>> round(two_segment_sidelobe_db(1.0, 0.0), 1), two_segment_sidelobe_db(1.0, 1.0) > -6
    (-13.3, True)
    """
    u = np.linspace(0.0, 3.0, 30001)
    response = np.abs(np.sinc(u) * np.cos(np.pi * (1 + gap_m / length_m) * u))
    beyond = int(np.argmax(np.diff(response) > 0))
    return float(20 * np.log10(response[beyond:].max()))
