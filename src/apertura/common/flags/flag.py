"""What is told of a flag, wherever it is raised."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Flag:
    """A limit of a method that may be crossed.

    Parameters
    ----------
    measured
        What its line tells: the quantity, with its unit.
    means
        What it means for the image.
    look
        What to look at first, or to do.
    raised
        The file that raises it, relative to src/apertura; several with commas between.

    Examples
    --------
    >>> Flag("share of samples", "the converter is full", "gain", "core/echo/captures.py").look
    'gain'
    """

    measured: str
    means: str
    look: str
    raised: str
