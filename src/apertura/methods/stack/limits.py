"""Limits of a flight of a stack: its flags, and the reasons to leave it out, docs/theory/stack.md, section 5."""

from dataclasses import dataclass

from apertura.common.flags import Flags

MOST_RESIDUAL_RAD = 0.3
"""Largest standard deviation of the residual phase of stable windows without a flag: 1.8 mm at 1.2 GHz one way and 3 %
of the coherence.
"""

EXCLUDED_RESIDUAL_RAD = 1.0
"""Standard deviation of the residual phase above which a flight is left out: phases are hardly related (1.81 rad for
unrelated phases).
"""

MOST_SPREAD_RAD = 0.3
"""Largest rms phase over the aperture without a flag: a phase screen does not correct this phase, whose effect is a
displacement by up to 0.16 resolution cells, and a loss of 4 % of the coherence.
"""

MOST_LOSS = 0.2
"""Largest amount by which the median coherence is below the expected coherence, without a flag."""

LEAST_COHERENT = 0.2
"""Smallest fraction of the common pixels with significant coherence; a flight with less is left out."""

LEAST_STABLE = 0.5
"""Smallest fraction of the coherent windows that follow one residual track; a flight with less is left out: the track
would be fitted to terrain that moves.
"""


@dataclass(frozen=True)
class FlightFit:
    """Measures of a flight's fit into the stack.

    Attributes
    ----------
    residual_rad
        Standard deviation of the residual phase over stable windows; infinite without an estimate.
    spread_rad
        Rms phase of the residual track over the aperture.
    coherence, expected
        Median coherence with the reference and its expected value; NaN without common pixels.
    coherent
        Fraction of the common pixels with significant coherence.
    stable
        Fraction of the coherent windows that follow the residual track.
    windows
        Number of coherent windows.
    failure
        Reason for which no residual track was estimated; empty otherwise.
    """

    residual_rad: float
    spread_rad: float
    coherence: float
    expected: float
    coherent: float
    stable: float
    windows: int
    failure: str = ""

    @property
    def reason(self) -> str | None:
        """Reason for which the flight is left out; None if it is used.

        Examples
        --------
        >>> FlightFit(0.1, 0.1, 0.9, 0.95, 0.97, 0.95, 200).reason is None
        True
        >>> FlightFit(1.2, 0.1, 0.9, 0.95, 0.97, 0.95, 200).reason
        'residual phase 1.20 rad, more than 1 rad'
        """
        if self.failure:
            return self.failure
        if self.coherent < LEAST_COHERENT:
            return f"significant coherence at {self.coherent:.0%} of the common pixels, less than {LEAST_COHERENT:.0%}"
        if self.stable < LEAST_STABLE:
            return f"{self.stable:.0%} of the coherent windows follow one residual track, less than {LEAST_STABLE:.0%}"
        if self.residual_rad > EXCLUDED_RESIDUAL_RAD:
            return f"residual phase {self.residual_rad:.2f} rad, more than {EXCLUDED_RESIDUAL_RAD:g} rad"
        return None

    @property
    def flags(self) -> Flags:
        """Flags of the flight."""
        flags = Flags()
        if self.reason:
            flags["stack_flight_excluded"] = self.reason
            return flags
        if self.residual_rad > MOST_RESIDUAL_RAD:
            flags["stack_residual_phase"] = f"{self.residual_rad:.2f} rad over {self.windows} coherent windows"
        if self.spread_rad > MOST_SPREAD_RAD:
            flags["stack_motion_defocuses"] = f"{self.spread_rad:.2f} rad rms over the aperture"
        if self.expected - self.coherence > MOST_LOSS:
            flags["stack_decorrelated"] = f"{self.coherence:.2f} against {self.expected:.2f} expected"
        return flags
