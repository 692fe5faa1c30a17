"""Sizes and error bounds of the GPU's kernel, which its prediction counts with too.

Errors are of one leg's path. D is the largest distance of a pixel from the middle of its patch, s as in
docs/theory/engine.md, (8).
"""

from apertura.core.focus.engines.native_constants import KERNEL

SIDE = KERNEL.patch_side
"""Pixels along a patch, which one block of threads sums; tiles begin at multiples of it."""

TAPS = KERNEL.taps
"""Of a table's filters."""

DEGREE = 2
"""Of the polynomials in a cell: linear ones would spare two look-ups of six, and need tables 1.7 times as fine."""

CHUNK = 64
"""Pulses that a patch looks at together, and whose sum is float32; their sums add up in float64."""

LAST_ORDER, LAST_TERM = 6, 21 / 1024
"""The first order of √(1 + s) that (8) neglects, and its coefficient: at most that over 1 − |s| is neglected."""

FARTHEST = 0.5
"""Largest |s| of which the series is asked at all."""

FLOAT32_ERROR, FLOAT32_RMS = 2.5e-7, 3.2e-8
"""Of D: what float32 makes (8) err by, at worst and in the RMS of 20 000 random pixels at each of five ranges."""

DOUBT = 2.0**20
"""Cells across a patch beyond which float32 could not tell one from the next."""
