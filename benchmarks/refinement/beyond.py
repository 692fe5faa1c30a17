"""Track refinement with errors other than positions: attitude, lever arm and terrain height.

`python -m benchmarks.refinement.beyond`: forty points, logs with errors of 1 cm, five draws each; prints residual loss
and displacement, acceptance and flags.
"""

import dataclasses

import numpy as np
from apertura_research.autofocus.cases import (
    FLIGHTS,
    GRID,
    NODES,
    PAIRS,
    PROBES_M,
    SCENES,
    AutofocusCase,
    TargetScene,
    drawn_errors,
    record,
)
from apertura_research.autofocus.outcomes import judge

from apertura.core.geometry.lever_arms import TrackCorrection
from apertura.core.scene.terrain import FlatGround
from apertura.methods.autofocus.inputs import TrackErrors
from apertura.methods.autofocus.refine import refine

SIGMA_M = 0.01
OTHERS = {
    "nothing else": (0.0, 0.0, 0.0),
    "attitude 2 deg, arm 25 cm": (0.25 * np.radians(2.0), 0.0, 0.0),
    "lever arm 5 cm": (0.05, 0.0, 0.0),
    "lever arm 5 cm, drift stated": (0.05, 0.0, 0.05),
    "terrain 20 cm higher": (0.0, 0.2, 0.0),
}
"""Additional error → lever arm of the first node, metres to the right of its course; height, metres; stated drift."""


def erroneous_case(flight_name: str, arm_m: float, height_m: float, drift_m: float, seed: int) -> AutofocusCase:
    """Return a case with a lever-arm error to the right of the first node, and terrain above the assumed height."""
    of_tracks, of_scene, of_noise = np.random.default_rng(seed).spawn(3)
    flight, scatterers = FLIGHTS[flight_name](), SCENES["forty"](of_scene)
    errors = TrackErrors((SIGMA_M,) * 3)
    moved = {
        node: drawn_errors(flight.time_s, errors, one) for node, one in zip(NODES, of_tracks.spawn(2), strict=True)
    }
    course = np.gradient(flight.logged_m[NODES[0]], axis=0)[:, :2]
    course /= np.linalg.norm(course, axis=1, keepdims=True)
    arm = np.concatenate([course[:, 1:], -course[:, :1], np.zeros((len(course), 1))], axis=1) * arm_m
    truth = TrackCorrection(flight.time_s, {**moved, NODES[0]: moved[NODES[0]] + arm})
    raised = dataclasses.replace(scatterers, position_m=scatterers.position_m + [0, 0, height_m])
    probes = TargetScene(PROBES_M + [0, 0, height_m], np.ones(len(PROBES_M), complex), np.arange(len(PROBES_M)))
    noises = of_noise.spawn(2)
    return AutofocusCase(
        ("forty", flight_name, "joint", SIGMA_M, 10.0, seed),
        tuple(record(pair, flight, truth, raised, 10.0, one) for pair, one in zip(PAIRS["joint"], noises, strict=True)),
        dict.fromkeys(NODES, TrackErrors((SIGMA_M,) * 3, drift_std_m=drift_m)),
        truth,
        raised.position_m[raised.targets] * [1, 1, 0],
        tuple(record(pair, flight, truth, probes, None, one) for pair, one in zip(PAIRS["joint"], noises, strict=True)),
        flight.reach_m,
    )


def main() -> None:
    for flight_name in ("straight", "wobble", "circle"):
        for name, (arm_m, height_m, drift_m) in OTHERS.items():
            rows = []
            for seed in range(300, 302 if flight_name == "circle" else 305):
                one = erroneous_case(flight_name, arm_m, height_m, drift_m, seed)
                result = refine(one.records, GRID, FlatGround(0.0), one.errors)
                before, after = judge(one), judge(one, result.correction)
                rows.append(
                    (
                        before.probe_loss_db,
                        after.probe_loss_db,
                        before.probe_shift_cm,
                        after.probe_shift_cm,
                        result.accepted,
                        " ".join(result.flags),
                    )
                )
            loss, residual_loss, shift, residual_shift, accepted, flags = zip(*rows, strict=True)
            print(
                f"{flight_name}, {name}: loss {np.mean(loss):.2f} → {np.mean(residual_loss):.2f} dB, "
                f"displacement from the true tracks {np.median(shift):.1f} → {np.median(residual_shift):.1f} cm, "
                f"accepted {sum(accepted)} of {len(rows)}; flags: {sorted(set(' '.join(flags).split())) or 'none'}",
                flush=True,
            )


if __name__ == "__main__":
    main()
