"""Section `nodes`: equipment of each UAV, lever arms, antennas, accuracies, and settings for reading flight logs."""

import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, field_validator, model_validator

from apertura.campaign.config.section import Metres3, Section
from apertura.common.errors import CampaignError
from apertura.formats.names import TRACKS
from apertura.formats.tracks.log_options import LogOptions

# ---- Section `nodes.<n>.log`: values that a flight log does not contain ---------------------------------------------

Latitude = Annotated[float, Field(ge=-90, le=90)]
Longitude = Annotated[float, Field(ge=-180, le=360)]
Cell = Annotated[str, Field(min_length=1, max_length=200)]


class Log(Section):
    """Information for reading a flight log that the log does not contain."""

    format: str | None = Field(
        None, description=f"one of {', '.join(TRACKS)}; null: identified by suffix and header of the file"
    )
    time_system: Literal["utc", "gpst"] | None = Field(
        None,
        description="time system of a log that does not state one: utc or gpst (ahead of UTC by the leap seconds)",
    )
    start_utc: str | None = Field(
        None,
        description="time zero of a log with relative times, or date of a log that contains only times of day, "
        "ISO 8601 in UTC",
    )
    columns: dict[Cell, Cell] = Field(
        default_factory=dict, description="column read by apertura → name of the column in the CSV log"
    )
    scales: dict[Cell, Annotated[float, Field(gt=0, le=1e12)]] = Field(
        default_factory=dict,
        description="column read by apertura → factor for the numbers in the CSV log, such as 1e-7 or 0.001",
    )
    quality: Literal["rtklib", "gga"] | None = Field(
        None,
        description="numbering of solution types in a CSV log: rtklib (1 fix, 2 float, 5 single) or gga (4 fix, 5 "
        "float, 1 single); null: the log contains names",
    )
    base: tuple[Latitude, Longitude, float] | None = Field(
        None,
        description="base station of a log of baselines: latitude, longitude (deg), ellipsoidal height (m), WGS 84",
    )
    body: str | None = Field(None, description="name of the rigid body or device, for logs of several bodies")
    height_offset_m: float | None = Field(
        None, description="offset added to logged heights to obtain ellipsoidal heights, m"
    )
    longest_gap_s: float | None = Field(
        None,
        gt=0,
        description="longest gap between epochs that is interpolated, s; pulses in longer gaps are excluded; null: "
        "limited by the interpolation error",
    )
    smoothing_m: float | None = Field(
        None,
        gt=0,
        description="noise of logged positions to be removed by a smoothing spline, m; null: no smoothing",
    )

    @field_validator("format")
    @classmethod
    def _format_is_known(cls, name: str | None) -> str | None:
        if name is not None and name not in TRACKS:
            raise ValueError(f"unknown format; choose {', '.join(TRACKS)}")
        return name

    @property
    def options(self) -> LogOptions:
        """Options of the log readers."""
        return LogOptions(**self.model_dump(exclude={"longest_gap_s", "smoothing_m"}))


# ---- Section `nodes`: equipment, lever arms, antennas ---------------------------------------------------------------

_OHMS = 50.0  # reference impedance of configured voltages
StandardDeviation = Annotated[float, Field(gt=0)]
Beamwidth = Annotated[float, Field(gt=0, le=180)]


class Antenna(Section):
    """Boresight and beam widths of an antenna; its horizontal axis lies in the forward-right plane of the body."""

    boresight_deg: tuple[Annotated[float, Field(ge=-180, le=360)], Annotated[float, Field(ge=-90, le=90)]] = Field(
        description="azimuth clockwise from forward, elevation above the forward-right plane (down is negative), deg"
    )
    beamwidth_deg: tuple[Beamwidth, Beamwidth] | None = Field(
        None, description="full width at -3 dB (one way) in azimuth and elevation of a Gaussian beam, deg"
    )
    pattern: str | None = Field(
        None,
        description="CSV file with both cuts of the pattern, used instead of beamwidth_deg: columns cut (azimuth, "
        "elevation), angle_deg, gain_db and, optionally, phase_deg",
    )
    cutoff_db: float = Field(
        -20.0, ge=-80, le=-3, description="gain relative to the peak below which pulses are excluded, dB"
    )

    @model_validator(mode="after")
    def _one_pattern(self) -> Self:
        if (self.beamwidth_deg is None) == (self.pattern is None):
            raise ValueError("state either beamwidth_deg, [azimuth, elevation], or pattern, a CSV file")
        return self


Decibels = Annotated[float, Field(ge=-300, le=300)]
Gain = Annotated[float, Field(ge=-60, le=80)]
Polarisation = Literal["H", "V", "L", "R"]

_BEAM = "null (isotropic), or boresight_deg with beamwidth_deg or pattern, and cutoff_db"


class Antennas(Section):
    """Beams, gains and polarisations of a node's antennas."""

    radar_tx: Antenna | None = Field(None, description=f"transmitting radar antenna: {_BEAM}")
    radar_rx: Antenna | None = Field(None, description=f"receiving radar antenna: {_BEAM}")
    radar_tx_gain_dbi: Gain | None = Field(
        None, description="peak gain of the transmitting radar antenna, to which its pattern is normalised, dBi"
    )
    radar_rx_gain_dbi: Gain | None = Field(
        None, description="peak gain of the receiving radar antenna, to which its pattern is normalised, dBi"
    )
    radar_tx_polarisation: Polarisation | None = Field(
        None, description="polarisation of the transmitting radar antenna: H, V, L or R; null: not configured"
    )
    radar_rx_polarisation: Polarisation | None = Field(
        None, description="polarisation of the receiving radar antenna: H, V, L or R; null: not configured"
    )

    def any(self) -> bool:
        """Return True if an antenna has a beam."""
        return self.radar_tx is not None or self.radar_rx is not None


class LeverArms(Section):
    """Lever arms from the logged point to each phase centre, in body axes forward-right-down."""

    radar_tx: Metres3 = Field((0.0, 0.0, 0.0), description="transmitting radar antenna, m")
    radar_rx: Metres3 = Field((0.0, 0.0, 0.0), description="receiving radar antenna, m")
    sidelink: Metres3 = Field((0.0, 0.0, 0.0), description="sidelink antenna, m")

    def any(self) -> bool:
        """Return True if a lever arm is not zero."""
        return any(any(arm) for arm in (self.radar_tx, self.radar_rx, self.sidelink))


class PathOffsets(Section):
    """Path offsets of the receiving node: electrical path in addition to the geometric path, metres of total path."""

    radar: float = Field(0.0, description="radar channel, m")
    sidelink: float = Field(0.0, description="sidelink channel, m")


class Receiver(Section):
    """Receiver chain from the port of the receiving radar antenna to the recorded samples."""

    full_scale_counts: float = Field(
        gt=0,
        le=2**32,
        description="magnitude |I + jQ| of a complex sine at full scale in recorded counts, such as 8192 for 14 bits",
    )
    full_scale_dbm: Decibels | None = Field(
        None, description="power of a sine at full scale at the input of the converter, dBm"
    )
    full_scale_v: Annotated[float, Field(gt=0, le=1e6)] | None = Field(
        None,
        description="instead of full_scale_dbm: amplitude (half the peak-to-peak value) of a sine at full scale in "
        "50 ohms, V",
    )
    gain_db: Decibels = Field(
        description="gain from the antenna port to the input of the converter, including cables, dB"
    )
    noise_figure_db: Annotated[float, Field(ge=0, le=100)] | None = Field(
        None, description="noise figure at the antenna port, dB, for comparison with the measured noise; null: unknown"
    )

    @model_validator(mode="after")
    def _one_full_scale(self) -> Self:
        if (self.full_scale_dbm is None) == (self.full_scale_v is None):
            raise ValueError("state either full_scale_dbm or full_scale_v, the full scale of the converter")
        return self

    @property
    def at_full_scale_dbm(self) -> float:
        """Power of a sine at full scale, dBm.

        Examples
        --------
        >>> round(Receiver(full_scale_counts=8192, full_scale_v=0.5, gain_db=30).at_full_scale_dbm, 2)
        3.98
        """
        if self.full_scale_v is None:
            return float(self.full_scale_dbm or 0.0)
        return 10 * math.log10(self.full_scale_v**2 / (2 * _OHMS) * 1e3)


class Node(Section):
    """UAV and its equipment."""

    lever_arms_m: LeverArms = Field(
        default_factory=LeverArms, description="lever arms from the logged point to the phase centres, in body axes"
    )
    antennas: Antennas = Field(default_factory=Antennas, description="antenna beams, in body axes")
    path_offset_m: PathOffsets = Field(
        default_factory=PathOffsets,
        description="electrical path of the node as receiver, in addition to the geometric path",
    )
    transmit_power_dbm: Decibels | None = Field(
        None, description="mean power at the port of the transmitting antenna during a pulse, dBm; null: unknown"
    )
    iq: Literal["complex", "swapped", "conjugate"] | None = Field(
        None, description="order of I and Q in the recordings of this node; null: waveform.iq"
    )
    receiver: Receiver | None = Field(
        None,
        description="radar receiver: full_scale_counts, full_scale_dbm or full_scale_v, gain_db, noise_figure_db; "
        "with transmit_power_dbm and both antenna gains, images are calibrated to sigma0; null: "
        "relative images",
    )
    amplitude_std_db: Annotated[float, Field(ge=0, le=100)] | None = Field(
        None,
        description="combined standard deviation of the configured power, antenna gains and receiver, dB; null: "
        "unknown",
    )
    attitude: Literal["log", "course", "none"] = Field(
        "none", description="source of the attitude: log, course (course over ground), or none"
    )
    log: Log = Field(
        default_factory=Log, description="information for reading the flight log that the log does not contain"
    )
    worst_fix: Literal["auto", "fix", "float", "any"] = Field(
        "auto",
        description="minimum solution type, for logs with solution types: fix, float or any; auto: fix if the log "
        "contains RTK solutions, otherwise any; pulses with poorer solutions are excluded",
    )
    position_std_m: StandardDeviation | tuple[StandardDeviation, StandardDeviation, StandardDeviation] | None = Field(
        None,
        description="standard deviation of logged positions, m: one number, or [north, east, up]; null: values of "
        "the log, if available",
    )
    position_correlation_s: float = Field(
        1.0,
        gt=0,
        description="correlation time of position errors, s: errors are modelled as a moving average of this length "
        "over white noise; the autocorrelation falls linearly to zero at this time, and to 1/e at 0.63 times this "
        "time",
    )
    position_drift_m: float = Field(
        0.0,
        ge=0,
        description="standard deviation per axis of slow position errors over a flight (offset, slope and "
        "curvature), m, which track refinement may correct in addition to position_std_m",
    )
    attitude_std_deg: StandardDeviation | tuple[StandardDeviation, StandardDeviation] | None = Field(
        None,
        description="standard deviation of the attitude, deg: one number, or [roll and pitch, heading]; null: "
        "unknown, the error budget assumes the value of a small inertial unit, or of the course",
    )
    attitude_correlation_s: float = Field(
        100.0, gt=0, description="correlation time of attitude errors, defined as position_correlation_s, s"
    )
    lever_arm_std_m: StandardDeviation | None = Field(
        None,
        description="standard deviation of lever_arms_m per axis, m; null: unknown, the error budget assumes 1 cm",
    )
    time_tag_std_s: float = Field(
        3e-3, ge=0, description="standard deviation of the time offset common to all time tags of a flight, s"
    )

    @property
    def attitude_error_deg(self) -> tuple[float, float] | None:
        """Values of `attitude_std_deg`: one for roll and pitch, one for heading."""
        stated = self.attitude_std_deg
        return stated if stated is None or isinstance(stated, tuple) else (stated, stated)

    @property
    def poorest_fix(self) -> str:
        """Value of `worst_fix` for a log with RTK solutions."""
        return "fix" if self.worst_fix == "auto" else self.worst_fix

    @model_validator(mode="after")
    def _lever_arm_needs_attitude(self) -> Self:
        if self.attitude == "none" and self.lever_arms_m.any():
            raise ValueError(
                "lever_arms_m is not zero, but attitude is none: body axes cannot be rotated to north-east-down; "
                "set attitude to log or course, or set the lever arms to zero"
            )
        if self.attitude == "none" and self.antennas.any():
            raise ValueError(
                "antennas has a beam, but attitude is none: body axes cannot be rotated to north-east-down; "
                "set attitude to log or course, or set the beam to null"
            )
        return self


# ---- Radio of a pair, for calibrated images --------------------------------------------------------------------------


def radio_of(nodes: Mapping[str, Node], pair: str) -> dict[str, object]:
    """Return config key → value for the radio of a pair; None for values that are not configured.

    Examples
    --------
    >>> list(radio_of({"a": Node(transmit_power_dbm=10.0), "b": Node()}, "a-b"))[:2]
    ['nodes.a.transmit_power_dbm', 'nodes.a.antennas.radar_tx_gain_dbi']
    """
    tx, rx = pair.split("-")
    return {
        f"nodes.{tx}.transmit_power_dbm": nodes[tx].transmit_power_dbm,
        f"nodes.{tx}.antennas.radar_tx_gain_dbi": nodes[tx].antennas.radar_tx_gain_dbi,
        f"nodes.{rx}.antennas.radar_rx_gain_dbi": nodes[rx].antennas.radar_rx_gain_dbi,
        f"nodes.{rx}.receiver": nodes[rx].receiver,
    }


def polarisation_of(nodes: Mapping[str, Node], pair: str) -> str | None:
    """Return the transmit and receive polarisations of a pair, such as HV; None unless both are configured.

    Examples
    --------
    >>> own = Node(antennas=Antennas(radar_tx_polarisation="H", radar_rx_polarisation="V"))
    >>> polarisation_of({"a": own, "b": Node()}, "a-a"), polarisation_of({"a": own, "b": Node()}, "a-b")
    ('HV', None)
    """
    tx, rx = pair.split("-")
    sent, received = nodes[tx].antennas.radar_tx_polarisation, nodes[rx].antennas.radar_rx_polarisation
    return f"{sent}{received}" if sent and received else None


def check_radio(nodes: Mapping[str, Node], pairs: Iterable[str], *, sampled: bool, where: Path) -> None:
    """Check that the radio is configured completely for all pairs, or for none.

    Parameters
    ----------
    nodes, pairs
        Nodes and pairs of the campaign.
    sampled
        True if samples were recorded, False for phase histories, the scale of which is unknown.
    where
        Path of the config.

    Raises
    ------
    CampaignError
        If the radio of a pair is configured incompletely, or is configured for recorded phase histories.
    """
    stated = {key: value for pair in pairs for key, value in radio_of(nodes, pair).items()}
    missing = [key for key, value in stated.items() if value is None]
    if len(missing) < len(stated) and (missing or not sampled):
        raise CampaignError(
            f"{', '.join(missing)} {'is' if len(missing) == 1 else 'are'} not configured, although "
            f"{next(key for key, value in stated.items() if value is not None)} is configured"
            if missing
            else "a radio is configured, but the scale of a recorded phase history is unknown",
            where=where,
            expected="power, both antenna gains and receiver of every pair, or none of these values",
            remedy="State the missing values; for relative images, set the other values to null.",
        )
