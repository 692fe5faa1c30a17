"""Whether the band of a waveform can be had of real samples."""

from apertura.common.errors import CampaignError
from apertura.core.echo.demodulate import Numerology
from apertura.formats.recordings.sample_file import SampleFile


def check_mixing(samples: SampleFile, numerology: Numerology, *, where: object) -> None:
    """Raise CampaignError if real samples are mixed so that a subcarrier and mirror image meet, or prefixes are short.

    Parameters
    ----------
    samples
        Of a recording; complex ones are never wrong.
    numerology
        Of the symbol.
    where
        The recording, for the message.
    """
    mixing = samples.layout.mixing
    if mixing is None:
        return
    low_hz, high_hz = (float(numerology.frequency_hz[end]) - numerology.carrier_hz for end in (0, -1))
    problem = mixing.problem(low_hz, high_hz, numerology.prefix_samples)
    if problem:
        raise CampaignError(
            problem,
            where=where,
            expected="apertura:if_hz and waveform such that the whole band lies inside one Nyquist zone",
            remedy="Correct apertura:if_hz (where baseband zero lies, before aliasing) or the waveform.",
        )
