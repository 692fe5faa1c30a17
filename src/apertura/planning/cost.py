"""What a setting costs in seconds, from how much there is to do and a few constants per engine."""

from collections.abc import Mapping
from dataclasses import dataclass

from apertura.focus.engines.native_prediction import NO_BEAMS, PatchWeights

_WIDE_FORMS = ("shared", "wide", "exact")


@dataclass(frozen=True)
class Costs:
    """Seconds per unit of work on one core.

    Attributes
    ----------
    seconds
        ``native.table`` per pulse, cell and coefficient; ``native.<form>.<degree>`` per pixel and pulse;
        ``native.beam``, ``.edge``, ``.dark`` per pixel and pulse that antennas weigh smoothly (on top of its form),
        pixel by pixel (instead of it) and not at all; ``numba.table`` per pulse and fine sample; ``numba.pixel`` per
        pixel and pulse; ``reference.subcarrier`` per pixel, pulse and subcarrier; ``weight`` per pixel, pulse and
        antenna of both; ``place.<frame>`` per pixel position; ``tile`` per tile; ``thin`` per pulse and range sample
        of a low-pass sum.
    source
        Where they come from, in one line.
    """

    seconds: Mapping[str, float]
    source: str


@dataclass(frozen=True)
class Load:
    """How much there is to do.

    Attributes
    ----------
    pixels, pulses, subcarriers, tiles
        Counts.
    cells
        Cells or fine samples of the table of one pulse.
    frame
        'ecef' or 'local': how pixel positions are found.
    """

    pixels: int
    pulses: int
    subcarriers: int
    tiles: int
    cells: int
    frame: str


def seconds(
    costs: Costs,
    engine: str,
    load: Load,
    *,
    degree: int = 2,
    shares: tuple[float, float, float] = (1.0, 0.0, 0.0),
    weights: PatchWeights = NO_BEAMS,
) -> tuple[float, float]:
    """Return predicted seconds (tables, pixels) of an engine.

    Parameters
    ----------
    costs
        Constants.
    engine
        A key of `ENGINES`.
    load
        How much there is to do.
    degree
        Of native's polynomials.
    shares
        Parts of pixels × pulses that native computes by shared curvature, wide windows and exact paths.
    weights
        Of the antennas' beams.

    Returns
    -------
    tuple of float
        Building the table, and forming all tiles, on one thread.

    Notes
    -----
    Source: docs/theory/planner.md, "Cost".

    Examples
    --------
    >>> from apertura.planning.machine import default_costs
    >>> load = Load(512 * 512, 1024, 4096, 4, 500, "local")
    >>> fast, slow = (sum(seconds(default_costs(), name, load)) for name in ("native", "numba"))
    >>> slow > 15 * fast
    True
    """
    unit, work = costs.seconds, float(load.pixels) * load.pulses
    if engine == "native":
        tables = unit["native.table"] * load.pulses * load.cells * (degree + 1)
        form = sum(share * unit[f"native.{name}.{degree}"] for name, share in zip(_WIDE_FORMS, shares, strict=True))
        if weights.antennas:
            exact = unit[f"native.exact.{degree}"]
            weighed = form + (1 - shares[2]) * unit["native.beam"] + shares[2] * (unit["native.edge"] - exact)
            form = (
                weights.smooth * weighed + weights.pixelwise * unit["native.edge"] + weights.dark * unit["native.dark"]
            )
        pixels = work * form
    elif engine == "numba":
        tables = unit["numba.table"] * load.pulses * load.cells
        pixels = work * (unit["numba.pixel"] + weights.antennas * unit["weight"])
    else:
        spent = load.subcarriers * unit["reference.subcarrier"] + weights.antennas * unit["weight"]
        tables, pixels = 0.0, work * spent
    return tables, pixels + tile_seconds(costs, load)


def tile_seconds(costs: Costs, load: Load) -> float:
    """Return what an engine's tiles cost apart from their sums: placing pixels, and writing."""
    return load.pixels * costs.seconds[f"place.{load.frame}"] + load.tiles * costs.seconds["tile"]
