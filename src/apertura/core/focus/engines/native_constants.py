"""Sizes and error bounds of the compiled kernel, each once in Python as in native/bounds.hpp once in C++.

The engine may not be compiled where a plan is made, so they are not read from the library; a test compares the two.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class KernelConstants:
    """What the kernel is built on.

    D is the largest distance of a block from its patch's origin, δ of a pixel from its block's centre, R the range;
    errors are of one leg's path, in the unit of D, δ and R.

    Attributes
    ----------
    patch_side, block_side
        Pixels along a patch, whose paths are series about its origin, and along a block, of one polynomial.
    batch
        Pulses whose paths are computed together: phase centres are padded to a multiple of it.
    taps
        Of a table's filters.
    window
        Table cells that one look-up can reach; tables have as many empty cells at both ends.
    echo_taps, echo_degree
        Samples that make an echo at a single place, and the degree of the polynomials that weigh them
        (docs/theory/autofocus.md, "What pulses add").
    window_margin
        Cells: a path lies up to ½ beyond the cell it is rounded to, the rest is what float32 may err.
    fifth_order
        Of D⁵/R⁴. Order n of |w + d| is at most max |P_{n-2} − P_n| / (2n − 1) · dⁿ/Rⁿ⁻¹, 0.083 for n = 5, with room for
        higher orders.
    third_order
        Of δ³/R²: 1/(3√3).
    shared_curvature_error
        Of Dδ²/R², where all blocks of a patch share one curvature: three terms of 1/(3√3).
    own_curvature_error
        Of D²δ²/R³, where each has its own: six terms of 1/8, of which all but a tenth is in the block's curvature.
    curvature_span
        Second-order terms move a pixel of a block by at most 1.5² their coefficients; twice that bounds all blocks.
    weight_change, weight_curvature
        Of the beam's peak: how much antenna weights may differ between the nodes of a patch, first and second
        difference, to be taken as a polynomial.
    sector_bend
        Of the width of a sector's edge: how much a pixel's place in it may bend inside a block to be taken as linear.

    Notes
    -----
    Source: docs/theory/engine.md, "Paths", "Look-ups" and "Antennas".
    """

    patch_side: int = 16
    block_side: int = 4
    batch: int = 8
    taps: int = 16
    window: int = 16
    echo_taps: int = 8
    echo_degree: int = 4
    window_margin: float = 0.51
    fifth_order: float = 0.14
    third_order: float = 0.19
    shared_curvature_error: float = 0.58
    own_curvature_error: float = 0.075
    curvature_span: float = 4.5
    weight_change: float = 0.12
    weight_curvature: float = 0.025
    sector_bend: float = 0.002


KERNEL = KernelConstants()
