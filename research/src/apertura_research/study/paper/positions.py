"""How well positions must be known: λ/10, mono- against bistatic, and errors along the sidelink."""

from collections.abc import Callable

import numpy as np

from apertura.common.arrays import Floats
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.core.geometry.aperture import Aperture
from apertura.simulation.impairments import Impairments, Localization
from apertura.simulation.observation import observe
from apertura.simulation.presets import paper_waveform
from apertura.simulation.synthesis import transfer_functions
from apertura_research.study.paper.claims import Claim, compare, require
from apertura_research.study.paper.losses import ERRORS, peak_losses_db
from apertura_research.study.paper_scene import RX_AHEAD_M, reduced_scene
from apertura_research.study.point_response import amplitude_db, find_peaks, phase_history, range_tables

PRINTED_CM = 2.0
DRAWS = 20
SIGMA_CM = 1.0
LARGEST_LOSS_DB = 1.0


def position_claims(*, draws: int = DRAWS, seed: int = 3) -> list[Claim]:
    """Return what λ/10 is and costs, what a bistatic pair needs against a monostatic one, and what cancels."""
    tenth_cm = 10 * SPEED_OF_LIGHT_M_S / float(paper_waveform().frequency_hz.mean())
    mono_db, bistatic_db = (_mean_db(loss, SIGMA_CM, draws, seed) for loss in (_monostatic_db, _bistatic_db))
    tenth_db = _mean_db(_monostatic_db, tenth_cm, draws, seed)
    largest_db = _mean_db(_monostatic_db, tenth_cm / 3, draws, seed)
    return [
        compare("positions must be known to λ/10", tenth_cm, "cm", paper=PRINTED_CM, within=0.5, relative=False,
                style=".3g", note="at the middle of the band; the requirement rows use δR = 2 cm one way"),
        require(f"loss at position errors of λ/10, {draws} draws", tenth_db, "dB",
                limit=f"at most {LARGEST_LOSS_DB:g} dB", met=tenth_db >= -LARGEST_LOSS_DB, style=".2f",
                note="λ/10 as standard deviation per axis, moving average of 1 s, monostatic: too much"),
        require(f"loss at position errors of λ/30 = (λ/10)/3, {draws} draws", largest_db, "dB",
                limit=f"at most {LARGEST_LOSS_DB:g} dB", met=largest_db >= -LARGEST_LOSS_DB, style=".2f",
                note="λ/10 taken as three standard deviations: as the largest error, it is enough"),
        compare(f"bistatic over monostatic loss at {SIGMA_CM:g} cm: the need is about equal", bistatic_db / mono_db,
                "1", independent_model=1.0, within=0.35, style=".2f",
                note=f"mono {mono_db:.2f} dB, bistatic {bistatic_db:.2f} dB, {draws} draws; the model is equality"),
        *_along_the_sidelink(),
    ]  # fmt: skip


def _mean_db(loss_db: Callable[[float, np.random.Generator], float], size_cm: float, draws: int, seed: int) -> float:
    return float(np.mean([loss_db(size_cm, np.random.default_rng([seed, draw])) for draw in range(draws)]))


def _bistatic_db(size_cm: float, generator: np.random.Generator) -> float:
    return float(peak_losses_db(ERRORS["localization"], size_cm, generator).mean())


def _monostatic_db(size_cm: float, generator: np.random.Generator) -> float:
    scene = reduced_scene(pulses=600, subcarriers=128)
    targets = scene.scatterers.position_m
    levels = []
    for sigma_m in (0.0, size_cm / 100):
        wrong = Impairments(localization=Localization(sigma_m))
        # one antenna position for both ways: no transmitter of its own
        seen = observe(scene.waveform, scene.scatterers, scene.geometry, generator, receiver=wrong, sidelink=False)
        transfer = transfer_functions(seen.channels["radar"], None).astype(np.complex64)
        levels.append(find_peaks(range_tables(phase_history(scene, transfer), targets), targets)[1])
    return float(amplitude_db(levels[1] / levels[0]).mean())


def _along_the_sidelink() -> list[Claim]:
    """Return what an error of 1 cm along the sidelink leaves in the corrected path of a target abreast of the pair."""
    half_m, error_m = RX_AHEAD_M / 2, 0.01
    target = np.array([[0.0, 15.0, 0.0]])
    ends = np.array([[-half_m, 0.0, 10.0]]), np.array([[half_m, 0.0, 10.0]])

    def wrong_cm(tx_m: float, rx_m: float) -> float:
        moved = ends[0] + [tx_m, 0, 0], ends[1] + [rx_m, 0, 0]
        return 100 * float(_corrected_m(*moved, target) - _corrected_m(*ends, target))

    growth_cm = 100 * _echo_growth(ends, error_m, target)
    both, one = abs(wrong_cm(error_m, error_m)), abs(wrong_cm(0.0, error_m))
    why = "R_tx + R_rx − R_sl, target abreast of the middle, 15 m away and 10 m below"
    return [
        require("errors along the sidelink cancel: 1 cm common to both nodes", both, "cm",
                limit="less than 0.1 cm of path", met=both < 0.1, style=".3f",
                note=f"{why}; it shifts the image along the track"),
        require("errors along the sidelink cancel: 1 cm of the receiver alone", one, "cm",
                limit="less than 0.1 cm of path", met=one < 0.1, style=".3f",
                note=f"{why}; the sidelink grows by 1 cm, the echo's path by {growth_cm:.2f} cm: they cancel only "
                "where the target lies in line with the sidelink"),
    ]  # fmt: skip


def _corrected_m(tx_m: Floats, rx_m: Floats, target_m: Floats) -> float:
    return float(Aperture(tx_m, rx_m).path(target_m)[0, 0] - np.linalg.norm(tx_m - rx_m))


def _echo_growth(ends: tuple[Floats, Floats], error_m: float, target_m: Floats) -> float:
    paths = [Aperture(ends[0], ends[1] + [along, 0, 0]).path(target_m)[0, 0] for along in (0.0, error_m)]
    return float(paths[1] - paths[0])
