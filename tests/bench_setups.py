"""A stationary tandem with cables, correct and with typical faults of a bench set-up, and the flags of each fault."""

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from folders import edit_config
from numpy.typing import NDArray

from apertura.simulation import (
    CampaignSpecification,
    ImageGrid,
    Impairments,
    Origin,
    PointTarget,
    SimulatedFlight,
    SimulatedNode,
    Straight,
    WaveformSpecification,
)
from apertura.simulation.campaign import write_campaign
from apertura.simulation.impairments import Clock, Reflection, TimeTag, Timing, UniformPhase

FLIGHT, TRANSMITTER, RECEIVER = "b01", "uav1", "uav2"
PULSES = 120
RADAR_M, SIDELINK_M = 10.0, 5.0
"""Path to the target and back, m, target 5 m away; electrical length of the sidelink cable, m."""

_CARRIER_HZ, _RATE_HZ = 1.2e9, 1.024e9
_WAVEFORM = WaveformSpecification(512, _CARRIER_HZ, 800e3, 1.5625e-6, 0.390625e-6, _RATE_HZ, 20.0)

Samples = NDArray[np.complex128]  # (capture, sample) of one channel


def _clock(ppm: float) -> Clock:
    return Clock.of_ppm(ppm, carrier_hz=_CARRIER_HZ, sample_rate_hz=_RATE_HZ)


RECEIVED = Impairments(
    clock=_clock(0.01),
    carrier_phase=UniformPhase(),
    timing=Timing(offset_s=12e-9, half_width_s=40e-9),
    time_tag=TimeTag(offset_s=3.7e-3, jitter_s=0.2e-3),
    radar_snr_db=10.0,
    sidelink_snr_db=30.0,
)
"""Impairments of the receiver's channels; SNR per subcarrier, which corresponds to 37 dB for a compressed pulse."""


def cabled(
    own: Impairments = Impairments(radar_snr_db=10.0),  # noqa: B008, it is frozen
    received: Impairments = RECEIVED,
    *,
    pulses: int = PULSES,
    radar_m: float = 0.911,
) -> CampaignSpecification:
    """Return a tandem on a bench: echo path `RADAR_M`, cable of `radar_m`, sidelink of `SIDELINK_M`."""
    nodes = {
        TRANSMITTER: SimulatedNode(impairments=own),
        RECEIVER: SimulatedNode(
            path_offset_m={"radar": radar_m, "sidelink": 0.0},
            impairments=received,
            lever_arms_m={"radar_tx": (0, 0, 0)},
        ),
    }
    east_m = {TRANSMITTER: -SIDELINK_M / 2, RECEIVER: SIDELINK_M / 2}
    south_m = float(np.sqrt((RADAR_M / 2) ** 2 - (SIDELINK_M / 2) ** 2))
    tracks = {name: Straight((x, -south_m, 0.75), (0.0, 0.0, 0.0)) for name, x in east_m.items()}
    flight = SimulatedFlight(FLIGHT, TRANSMITTER, tracks, pulses, kind="bench")
    grid = ImageGrid("EPSG:32632", half_width_m=3.0, spacing_m=0.1)
    target = (PointTarget((0.0, 0.0, 0.75)),)
    return CampaignSpecification(
        "bench", Origin(48.4, 9.95, 620.0), _WAVEFORM, target, nodes, (flight,), grid, "vacuum"
    )


_CABLED = cabled()


@dataclass(frozen=True)
class Setup:
    """A set-up: its simulation, and the changes to its files afterwards.

    Attributes
    ----------
    flags
        Flags of which at least one must be raised; if the set is empty, no flag may be raised.
    """

    flags: frozenset[str]
    specification: CampaignSpecification = _CABLED
    spoil: Callable[[Path], None] = lambda _: None

    def write(self, folder: Path, seed: int) -> Path:
        """Write a simulation of the set-up to a new folder, without flight logs."""
        root = write_campaign(folder, self.specification, np.random.default_rng(seed))
        for log in (root / "raw" / FLIGHT).glob("*.track.*"):
            log.unlink()
        edit_config(root, lambda config: config.update(bench={"radar_m": RADAR_M, "sidelink_m": SIDELINK_M}))
        self.spoil(root)
        return root


def samples_of(root: Path, node: str) -> tuple[Path, Path, dict, NDArray[np.int16]]:
    """Return the paths of both files, the metadata and the samples (capture, sample, channel, 2) int16 of a node."""
    meta, data = (root / "raw" / FLIGHT / f"{node}.sigmf-{kind}" for kind in ("meta", "data"))
    described = json.loads(meta.read_text(encoding="utf-8"))
    channels = described["global"].get("core:num_channels", 1)
    captures = len(described["captures"])
    return meta, data, described, np.fromfile(data, np.int16).reshape(captures, -1, channels, 2)


def write_samples(meta: Path, data: Path, described: dict, iq: NDArray[np.int16]) -> None:
    """Write samples and metadata with updated sample indices of the captures and without a hash."""
    for number, capture in enumerate(described["captures"]):
        capture["core:sample_start"] = number * iq.shape[1]
    described["global"].pop("core:sha512", None)
    iq.tofile(data)
    meta.write_text(json.dumps(described), encoding="utf-8")


def channel(node: str, number: int, change: Callable[[Samples], Samples]) -> Callable[[Path], None]:
    """Return a function that changes the complex samples (capture, sample) of one channel of a node."""

    def spoil(root: Path) -> None:
        meta, data, described, iq = samples_of(root, node)
        signal = iq[:, :, number, 0] + 1j * iq[:, :, number, 1].astype(np.float64)
        changed = change(signal)
        iq[:, :, number] = np.stack([changed.real, changed.imag], -1).round().clip(-32768, 32767)
        write_samples(meta, data, described, iq)

    return spoil


def _captures(
    node: str, change: Callable[[list, NDArray[np.int16]], tuple[list, NDArray[np.int16]]]
) -> Callable[[Path], None]:
    def spoil(root: Path) -> None:
        meta, data, described, iq = samples_of(root, node)
        described["captures"], iq = change(described["captures"], iq)
        write_samples(meta, data, described, np.ascontiguousarray(iq))

    return spoil


def _lost(captures: list, iq: NDArray[np.int16]) -> tuple[list, NDArray[np.int16]]:
    kept = np.flatnonzero(np.random.default_rng(5).random(len(captures)) > 0.1)
    return [captures[index] for index in kept], iq[kept]


def _stopped(captures: list, iq: NDArray[np.int16]) -> tuple[list, NDArray[np.int16]]:
    return captures[:90], iq[:90]


def _tone(x: Samples) -> Samples:
    """Add a tone at a fifth of the band, 10 dB below the signal, with a random phase in each capture."""
    phase_rad = 2 * np.pi * (80e6 * np.arange(x.shape[1]) / _RATE_HZ + np.random.default_rng(2).random((len(x), 1)))
    return x + 0.3 * np.sqrt((np.abs(x) ** 2).mean()) * np.exp(1j * phase_rad)


def _stuck(x: Samples) -> Samples:
    """Return samples whose bit 3 is always 1."""
    return (x.real.astype(np.int64) | 8) + 1j * (x.imag.astype(np.int64) | 8)


def _false(captures: list, iq: NDArray[np.int16]) -> tuple[list, NDArray[np.int16]]:
    """Insert a capture of noise between two pulses, five times."""
    rng, listed, rows = np.random.default_rng(6), [], []
    for number, capture in enumerate(captures):
        listed.append(capture)
        rows.append(iq[number])
        if number % 20 == 7:
            time = np.datetime64(capture["core:datetime"].removesuffix("Z")) + np.timedelta64(21, "ms")
            listed.append({**capture, "core:datetime": f"{time}Z"})
            rows.append(rng.normal(0, 5, iq[number].shape).round().astype(np.int16))
    return listed, np.array(rows)


def _swapped(root: Path) -> None:
    meta, data, described, iq = samples_of(root, RECEIVER)
    write_samples(meta, data, described, np.ascontiguousarray(iq[:, :, ::-1]))


def _leaks(root: Path) -> None:
    """Add the sidelink samples to the radar channel, 10 dB below."""
    meta, data, described, iq = samples_of(root, RECEIVER)
    iq[:, :, 0] = (iq[:, :, 0] + 0.3 * iq[:, :, 1]).round()
    write_samples(meta, data, described, iq)


def _other_code(root: Path) -> None:
    path = root / "raw" / "codes.npy"
    codes = np.load(path)
    np.save(path, codes[np.random.default_rng(7).permutation(len(codes))])


def _stated(**paths: float) -> Callable[[Path], None]:
    return lambda root: edit_config(root, lambda config: config["nodes"][RECEIVER]["path_offset_m"].update(paths))


def _split(root: Path) -> None:
    """Configure one signal for both radar channels, and attenuate one by 3 dB."""
    edit_config(root, lambda config: config["bench"].update(split=True))
    channel(RECEIVER, 0, lambda x: 0.7 * x)(root)


def _turning(rad: Callable[[Samples], Samples]) -> Callable[[Samples], Samples]:
    return lambda x: x * np.exp(1j * rad(x))


def _along(x: Samples) -> NDArray[np.float64]:
    return np.linspace(0, 1, len(x))[:, None]


def _bad_contact(x: Samples) -> Samples:
    """Attenuate about a tenth of the captures to near zero, in bursts."""
    bad = np.repeat(np.random.default_rng(8).random(-(-len(x) // 4)) < 0.1, 4)[: len(x)]
    return np.where(bad[:, None], 0.02 * x, x)


def _moving_clock(x: Samples) -> Samples:
    """Rotate samples within each capture at an increasing rate: 2 ppm of the carrier from first to last."""
    time_s = np.arange(x.shape[1]) / _RATE_HZ
    return x * np.exp(-2j * np.pi * 2e-6 * _CARRIER_HZ * (_along(x) - 0.5) * time_s)


def _both(change: Callable[[Samples], Samples]) -> Callable[[Path], None]:
    def spoil(root: Path) -> None:
        for number in (0, 1):
            channel(RECEIVER, number, change)(root)

    return spoil


def carrying(setup: Setup) -> Setup:
    """Return a set-up whose pulses carry frames of unknown 16-QAM symbols."""
    waveform = replace(setup.specification.waveform, code="16qam", frames=PULSES, framed=True)
    return replace(setup, specification=replace(setup.specification, waveform=waveform))


RIGHT = Setup(frozenset())
SPOILT = {
    "reference unlocked": Setup(frozenset({"clock_unlocked"}), cabled(received=replace(RECEIVED, clock=_clock(2.0)))),
    "clock drifts": Setup(frozenset({"clock_drifts"}), spoil=_both(_moving_clock)),
    "radar contact loose": Setup(frozenset({"contact_intermittent"}), spoil=channel(RECEIVER, 0, _bad_contact)),
    "sidelink contact loose": Setup(
        frozenset({"contact_intermittent", "sidelink_lost"}), spoil=channel(RECEIVER, 1, _bad_contact)
    ),
    "own contact scatters": Setup(
        frozenset({"contact_intermittent"}),
        spoil=channel(TRANSMITTER, 0, lambda x: x * np.random.default_rng(3).normal(1, 0.12, len(x))[:, None]),
    ),
    "channels swapped": Setup(frozenset({"channels_swapped"}), spoil=_swapped),
    "radar saturated": Setup(
        frozenset({"saturated_radar"}),
        spoil=channel(RECEIVER, 0, lambda x: (4 * x.real).clip(-8191, 8191) + 1j * (4 * x.imag).clip(-8191, 8191)),
    ),
    "sidelink saturated": Setup(
        frozenset({"saturated_sidelink"}),
        spoil=channel(RECEIVER, 1, lambda x: (4 * x.real).clip(-8191, 8191) + 1j * (4 * x.imag).clip(-8191, 8191)),
    ),
    "sidelink leaks": Setup(frozenset({"channel_crosstalk"}), spoil=_leaks),
    "code of another radar": Setup(frozenset({"wrong_code", "code_unconfirmed"}), spoil=_other_code),
    "triggers missed": Setup(frozenset({"triggers_missed"}), spoil=_captures(RECEIVER, _lost)),
    "triggers false": Setup(frozenset({"triggers_false"}), spoil=_captures(TRANSMITTER, _false)),
    "DC": Setup(frozenset({"channel_dc"}), spoil=channel(TRANSMITTER, 0, lambda x: x + 900)),
    "bit stuck": Setup(frozenset({"channel_bits_stuck"}), spoil=channel(RECEIVER, 0, _stuck)),
    "I and Q unequal": Setup(
        frozenset({"channel_image"}), spoil=channel(RECEIVER, 0, lambda x: x.real + 0.8j * x.imag)
    ),
    "I and Q swapped": Setup(frozenset({"spectrum_inverted"}), spoil=_both(lambda x: x.imag + 1j * x.real)),
    "reflection in the sidelink": Setup(
        frozenset({"sidelink_echo", "second_arrival", "sidelink_ripple_or_echo"}),
        cabled(received=replace(RECEIVED, sidelink_multipath=(Reflection(4.0, 0.3),))),
    ),
    "attenuated too much": Setup(
        frozenset({"link_weak", "channel_weak"}), cabled(received=replace(RECEIVED, radar_snr_db=-22.0))
    ),
    "converter without gain": Setup(frozenset({"channel_weak"}), spoil=channel(RECEIVER, 0, lambda x: 1e-3 * x)),
    "path of the config wrong": Setup(frozenset({"path_offset_disagrees"}), spoil=_stated(radar=-0.911)),
    "clocks of the two channels apart": Setup(
        frozenset({"link_incoherent"}),
        spoil=channel(RECEIVER, 0, _turning(lambda x: 0.3 * np.random.default_rng(4).normal(size=(len(x), 1)))),
    ),
    "cable warms up": Setup(
        frozenset({"link_drifts"}), spoil=channel(RECEIVER, 0, _turning(lambda x: 0.4 * _along(x)))
    ),
    "transmitter's phase wanders": Setup(
        frozenset({"link_drifts", "link_incoherent"}),
        spoil=channel(
            TRANSMITTER, 0, _turning(lambda x: 0.06 * np.random.default_rng(9).normal(size=(len(x), 1)).cumsum(0))
        ),
    ),
    "captures of the transmitter late": Setup(
        frozenset({"delay_jumps"}),
        spoil=channel(TRANSMITTER, 0, lambda x: np.where(_along(x) > 0.6, np.roll(x, -20, axis=1), x)),
    ),
    "amplifier steps by 1 dB": Setup(
        frozenset({"contact_intermittent"}),
        spoil=channel(RECEIVER, 0, lambda x: np.where(_along(x) > 0.5, 0.89, 1.0) * x),
    ),
    "receiver stops early": Setup(frozenset({"triggers_missed"}), spoil=_captures(RECEIVER, _stopped)),
    "another transmitter": Setup(frozenset({"interference"}), spoil=channel(RECEIVER, 0, _tone)),
    "split unequal": Setup(frozenset({"splitter_channels_differ"}), spoil=_split),
}
"""Fault → a set-up with this fault, and the flags that report the fault."""
