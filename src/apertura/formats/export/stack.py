"""Export of the rasters of a stack: flattened and residual phase, measured and expected coherence."""

from dataclasses import replace
from functools import partial

import numpy as np

from apertura.formats.export.cog import Band, write_cog

_COHERENCE = Band("float32", np.nan, "1", "estimated coherence with the reference flight of the stack", "AVERAGE")
_EXPECTED = "coherence expected from noise, spectral overlap and residual phase"
_FLATTENED = "flattened phase of slc.tif, without the phase of the residual track"
_RESIDUAL = "phase of the residual track, removed from the image"

# Writers of one raster each, (y, x) float32, NaN where invalid; parameters of `apertura.formats.export.cog.write_slc`.
write_stack_coherence = partial(write_cog, band=_COHERENCE)
write_expected_coherence = partial(write_cog, band=replace(_COHERENCE, meaning=_EXPECTED))
write_flattened_phase = partial(write_cog, band=Band("float32", np.nan, "rad", _FLATTENED, "NEAREST"))
write_residual_phase = partial(write_cog, band=Band("float32", np.nan, "rad", _RESIDUAL, "AVERAGE", smooth=True))
