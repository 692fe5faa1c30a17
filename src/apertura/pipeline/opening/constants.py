"""The file of constants that were measured at reflectors: what it holds, and whether it is of a campaign's radar."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from apertura.common.documents import read_json, validated
from apertura.common.errors import CampaignError
from apertura.common.provenance import sha256_file
from apertura.core.echo.compression import centre_frequency
from apertura.pipeline.campaign import Campaign
from apertura.pipeline.config import SampledWaveform, polarisation_of
from apertura.pipeline.opening.pair import OpenPair
from apertura.pipeline.opening.transmitted import transmitted

FILE = "calibration.json"
"""Name of the file, in the campaign folder."""

_SAME = 1e-3  # relative: of frequencies and powers that are stated alike, which moves a constant by 0.01 dB at most

_REMEDY = "Measure with `apertura reflectors`, or set processing.radiometric_calibration to null."

Decibels = Annotated[float, Field(ge=-1000, le=1000)]
Line = Annotated[str, Field(max_length=400)]
Deviation = Annotated[float, Field(ge=0, le=1000)]


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class AntennaShape(_Part):
    """Pattern of an antenna, to whose peak a constant is referred."""

    beamwidth_deg: tuple[float, float] | None
    pattern_sha256: str | None


class Radar(_Part):
    """What a constant depends on beside the radio: the constant of another is another.

    `sent_power` is the mean power of the signal in the units that echoes are divided by; None of phase histories.
    """

    centre_hz: Annotated[float, Field(gt=0)]
    bandwidth_hz: Annotated[float, Field(gt=0)]
    subcarriers: int
    sent_power: float | None
    antennas: Mapping[str, AntennaShape]
    polarisation: Annotated[str, Field(pattern="^[HVLR]{2}$")] | None = None

    @classmethod
    def of(cls, campaign: Campaign, opened: OpenPair) -> "Radar":
        """Return what the constant of an open pair depends on."""
        waveform, frequency = campaign.settings.waveform, opened.frequency_hz
        sent = transmitted(campaign, waveform).mean_power if isinstance(waveform, SampledWaveform) else None
        files = campaign.pattern_files(opened.name)
        shapes = {}
        for point, (node, antenna) in campaign.antennas(opened.name).items():
            path = files.get(f"nodes.{node}.antennas.{point}.pattern")
            shapes[point] = AntennaShape(
                beamwidth_deg=antenna.beamwidth_deg, pattern_sha256=None if path is None else sha256_file(path)
            )
        return cls(
            centre_hz=centre_frequency(frequency),
            bandwidth_hz=float(frequency[-1] - frequency[0]),
            subcarriers=len(frequency),
            sent_power=sent,
            antennas=shapes,
            polarisation=polarisation_of(campaign.settings.nodes, opened.name),
        )

    def differs(self, other: "Radar") -> str | None:
        """Return in what another radar is another, in words; None where they are the same.

        Examples
        --------
        >>> one = Radar(centre_hz=1.3e9, bandwidth_hz=2e8, subcarriers=256, sent_power=1.0, antennas={})
        >>> one.differs(one), one.differs(one.model_copy(update={"centre_hz": 1.4e9}))
        (None, 'centre_hz is 1.4e+09 and was 1.3e+09')
        """
        for name in type(self).model_fields:
            was, now = getattr(self, name), getattr(other, name)
            if name == "polarisation" and None in (was, now):
                continue  # nobody said that it is another
            numbers = isinstance(was, float) and isinstance(now, float)
            if not (abs(was - now) <= _SAME * abs(was) if numbers else was == now):
                words = [f"{one:g}" if isinstance(one, float) else str(one) for one in (now, was)]
                return f"{name} is {words[0]} and was {words[1]}"
        return None


class PairConstant(_Part):
    """Constant of a pair, and its phase against `reference` of the file, rad; None where they share no image.

    `profile_noise` is the noise of a pulse per Σw² of the window: of another gain of the receiver it is another.
    """

    radar: Radar
    constant_db: Decibels
    std_db: Deviation
    chance: Annotated[float, Field(ge=0, le=1)]
    reflectors: Annotated[int, Field(ge=1)]
    flights: Annotated[int, Field(ge=1)]
    phase_rad: float | None
    phase_std_rad: Deviation | None
    profile_noise: Annotated[float, Field(gt=0)] | None = None
    flags: Mapping[Annotated[str, Field(pattern="^(constant_drifts|reflectors_disagree)$")], Line]

    @property
    def constant(self) -> float:
        """K, m⁴ per m²."""
        return float(10 ** (self.constant_db / 10))


class Constants(_Part):
    """calibration.json."""

    schema_version: Literal[1] = 1
    software: str
    campaign: str
    flights: Mapping[str, str]
    reference: str
    pairs: Annotated[Mapping[str, PairConstant], Field(min_length=1)]
    measurements: tuple[Mapping[str, Any], ...]
    images: Mapping[str, str]

    @property
    def measured(self) -> str:
        """When and where from, in words."""
        days = sorted({began[:10] for began in self.flights.values()})
        return f"reflectors of campaign {self.campaign}, {', '.join(days)}"


def read_constants(path: Path) -> Constants:
    """Return a file of constants.

    Raises
    ------
    CampaignError
        If it is not there, or is no such file.
    """
    expected, remedy = "what `apertura reflectors` writes", "Copy it from the campaign that measured it."
    return validated(Constants, read_json(path, expected=expected, remedy=remedy), where=path, expected=expected)


def constant_of(campaign: Campaign, opened: OpenPair) -> tuple[PairConstant, str] | None:
    """Return the measured constant of an open pair and where it comes from.

    None where the config names no file, or where that holds constants of other pairs of the campaign alone: a
    reflector that serves monostatic pairs calibrates no bistatic one.

    Raises
    ------
    CampaignError
        If the file holds no pair of the campaign, or was measured with another radar.
    """
    path = campaign.calibration_file
    if path is None:
        return None
    constants = read_constants(path)
    check_pairs(constants, campaign, path)
    if opened.name not in constants.pairs:
        return None
    found = constants.pairs[opened.name]
    other = found.radar.differs(Radar.of(campaign, opened))
    if other is not None:
        raise CampaignError(
            f"measured with another radar than {opened.name} now: {other}",
            where=path,
            expected="constants of the same band, signal and antennas",
            remedy=_REMEDY,
        )
    return found, constants.measured


def check_pairs(constants: Constants, campaign: Campaign, path: Path) -> None:
    """Raise CampaignError where a file of constants holds none of a campaign's pairs."""
    pairs = list(dict.fromkeys(pair for flight in campaign.image_flights for pair in flight.pairs))
    if constants.pairs.keys().isdisjoint(pairs):
        found = f"no constant of {', '.join(pairs)}, but of {', '.join(constants.pairs)}"
        raise CampaignError(found, path, "a constant of one of the pairs that are imaged", _REMEDY)
