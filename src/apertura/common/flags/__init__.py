"""Every flag an image may carry: what was measured, what it means, what to look at; docs/flags.md comes of it."""

from apertura.common.flags.flag import Flag
from apertura.common.flags.images import OF_IMAGES
from apertura.common.flags.raised import Flags
from apertura.common.flags.recordings import OF_RECORDINGS

__all__ = ["FLAGS", "Flag"]

FLAGS = OF_RECORDINGS | OF_IMAGES
"""Name → what it says, in the order in which a recording becomes an image."""

Flags.rows = FLAGS.keys()  # from here: what raises a flag stays apart from what flags mean
