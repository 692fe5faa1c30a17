"""A second path of the sidelink too close to the first to resolve: what it would do to an image if it is one."""

import numpy as np

from apertura.core.echo.sidelink_arrivals import GATE_CELLS
from apertura.core.echo.sidelink_state import ECHO_DB, SidelinkState


def second_path_flags(state: SidelinkState, *, cell_m: float) -> dict[str, str]:
    """Return a flag where what arrives near the direct path is an echo, or may be one and not the transmitter's ripple.

    Parameters
    ----------
    state
        Of the sidelink.
    cell_m
        c/B, metres of path.

    Notes
    -----
    Source: docs/theory/echo_methods.md, "Ripple or echo".
    """
    if state.near_db > ECHO_DB:
        seen = (
            f"an arrival of {state.near_db:.1f} dB within {2 * cell_m:.2f} m of the direct path changes over the flight"
        )
        harm = _harm(10 ** (state.near_db / 20), 1, cell_m)
        return {"sidelink_ripple_or_echo": f"{seen}, as an echo does: {harm}"}
    if state.echo_db > ECHO_DB and 0 < abs(state.echo_cells) <= GATE_CELLS and state.echo_stays:
        line = (
            f"an arrival of {state.echo_db:.1f} dB {state.echo_cells * cell_m:+.2f} m from the direct path stays over "
            "the flight: an echo, or the transmitter's ripple; what corrects one makes ghosts as strong of the other"
        )
        return {"sidelink_ripple_or_echo": line}
    swing = 10 ** (state.ripple_db / 20)
    amplitude = (swing - 1) / (swing + 1)
    if amplitude <= 10 ** (ECHO_DB / 20):
        return {}
    line = (
        f"ripple of {state.ripple_db:.1f} dB in the sidelink is taken for the transmitter's; one channel cannot tell "
        f"it from a second path {state.ripple_cells * cell_m:.2f} m longer that stays so; if it is one, "
    )
    return {"sidelink_ripple_or_echo": line + _harm(amplitude, state.ripple_cells, cell_m)}


def _harm(amplitude: float, cells: int, cell_m: float) -> str:
    """Return what an echo of that amplitude does, in words; unresolved ones move what resolved ones repeat."""
    if cells > 1:
        return f"it makes ghosts of {20 * np.log10(amplitude):.1f} dB"
    path_cm, phase_rad = 100 * amplitude * cells * cell_m / np.sqrt(2), amplitude / np.sqrt(2)
    return f"paths err by about {path_cm:.0f} cm, phases by about {phase_rad:.2f} rad"
