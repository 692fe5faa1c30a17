"""Mistakes in recordings: channels, samples, time tags and captures."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from spoiling.folder import RX, TX, Captures, Document, Folder, FolderChange, Mistake

_RADAR = np.s_[:, :, 0]
Complex = NDArray[np.complex128]


def samples(change: Callable[[Complex], Complex], *nodes: str, channels: slice = slice(None)) -> FolderChange:
    """Return a mistake that changes samples, (capture, sample, channel) complex; the first channel is the radar."""

    def changed(captures: Captures) -> NDArray[np.float64]:
        values = captures.astype(np.float64)
        new = change(values[:, :, channels].copy().view(np.complex128)[..., 0])
        values[:, :, channels] = np.ascontiguousarray(new)[..., None].view(np.float64)
        return values

    def apply(folder: Folder) -> None:
        for node in nodes:
            folder.edit_captures(node, changed)

    return apply


RADAR = slice(0, 1)


def tags(change: Callable[[NDArray[np.int64]], NDArray[np.int64]], *nodes: str) -> FolderChange:
    """Return a mistake that adds to the time tags of captures: capture numbers → nanoseconds."""

    def changed(meta: Document) -> None:
        shifts = change(np.arange(len(meta["captures"])))
        for capture, shift in zip(meta["captures"], shifts, strict=True):
            time = np.datetime64(capture["core:datetime"].rstrip("Z"), "ns") + np.timedelta64(int(shift), "ns")
            capture["core:datetime"] = f"{np.datetime_as_string(time, 'us')}Z"

    def apply(folder: Folder) -> None:
        for node in nodes:
            folder.edit_meta(node, changed)

    return apply


def kept(choose: Callable[[int], NDArray[np.int_]], *nodes: str, tagged: bool = True) -> FolderChange:
    """Return a mistake that keeps selected captures (count → numbers), with their own time tags or the first ones."""

    def changed(folder: Folder, node: str) -> None:
        numbers: list[int] = []

        def cut(captures: Captures) -> Captures:
            numbers.extend(choose(len(captures)).tolist())
            return captures[numbers]

        def renumbered(meta: Document) -> None:
            old = meta["captures"]
            length = old[1]["core:sample_start"] - old[0]["core:sample_start"]
            own = [old[number] for number in numbers] if tagged else old[: len(numbers)]
            meta["captures"] = [capture | {"core:sample_start": k * length} for k, capture in enumerate(own)]

        folder.edit_captures(node, cut)
        folder.edit_meta(node, renumbered)

    def apply(folder: Folder) -> None:
        for node in nodes:
            changed(folder, node)

    return apply


def starts(by: int, node: str) -> FolderChange:
    """Return a mistake that delays the starts of captures by a number of samples; the last capture is lost."""

    def changed(meta: Document) -> None:
        for capture in meta["captures"]:
            capture["core:sample_start"] += by
        meta["captures"].pop()

    return lambda folder: folder.edit_meta(node, changed)


def _swap_channels(meta: Document) -> None:
    meta["global"]["apertura:channels"].reverse()


def _random_phase(values: Complex) -> Complex:
    phase = np.random.default_rng(2).uniform(-np.pi, np.pi, len(values))
    return values * np.exp(1j * phase)[:, None, None]


def _walk(values: Complex) -> Complex:
    steps = np.random.default_rng(2).standard_normal(len(values)) * 0.2
    return values * np.exp(1j * np.cumsum(steps))[:, None, None]


def _offset_carrier(hz: float) -> Callable[[Complex], Complex]:
    return lambda values: values * np.exp(2j * np.pi * hz / 1.024e9 * np.arange(values.shape[1]))[:, None]


def _tone(values: Complex) -> Complex:
    tone = np.exp(2j * np.pi * 0.213 * np.arange(values.shape[1]))[:, None]
    phase = np.random.default_rng(4).uniform(0, 2 * np.pi, (len(values), 1, 1))
    return values + 5 * np.abs(values).mean() * tone * np.exp(1j * phase)


def _clipped(values: Complex) -> Complex:
    louder = values * 10
    return np.clip(louder.real, -8191, 8191) + 1j * np.clip(louder.imag, -8191, 8191)


def _limited(values: Complex) -> Complex:
    """Limit each fifth capture to an eighth of the largest I or Q."""
    limit = np.abs(values.view(np.float64)).max() / 8
    values[::5] = np.clip(values[::5].real, -limit, limit) + 1j * np.clip(values[::5].imag, -limit, limit)
    return values


def _repeated(captures: Captures) -> Captures:
    """Replace captures 80 to 119 by the 40 preceding captures."""
    captures[80:120] = captures[40:80]
    return captures


def _drifting(cycles: float) -> Callable[[Complex], Complex]:
    return lambda values: values * np.exp(2j * np.pi * cycles * np.linspace(0, 1, len(values)))[:, None, None]


def _swap_recordings(folder: Folder) -> None:
    raw = folder.root / "raw" / "f01"
    for suffix in (".sigmf-meta", ".sigmf-data"):
        first, second = ((raw / f"{node}{suffix}") for node in (TX, RX))
        first_bytes, second_bytes = first.read_bytes(), second.read_bytes()
        first.write_bytes(second_bytes)
        second.write_bytes(first_bytes)


def _noise_tag(sigma_s: float) -> Callable[[NDArray[np.int64]], NDArray[np.int64]]:
    return lambda n: np.random.default_rng(6).normal(0, sigma_s * 1e9, n.size).astype(np.int64)


def _constant(seconds: float) -> Callable[[NDArray[np.int64]], NDArray[np.int64]]:
    return lambda n: np.full(n.size, round(seconds * 1e9))


def _drift(ppm: float) -> Callable[[NDArray[np.int64]], NDArray[np.int64]]:
    return lambda n: (n * 0.05 * ppm * 1e3).astype(np.int64)


MISTAKES = {
    "channels_swapped": Mistake("radar and sidelink swapped", lambda f: f.edit_meta(RX, _swap_channels), "channels"),
    "tags_rx_late_0s5": Mistake("time tags of the receiver 0.5 s late", tags(_constant(0.5), RX), "time"),
    "tags_tx_late_0s5": Mistake("time tags of the transmitter 0.5 s late", tags(_constant(0.5), TX), "time"),
    "tags_both_late_0s5": Mistake(
        "time tags of both nodes 0.5 s late", tags(_constant(0.5), TX, RX), "time", alike=("sample",)
    ),
    "tags_1h": Mistake("time tags in local time", tags(_constant(3600.0), TX, RX), "time"),
    "tags_rx_1ms": Mistake("time tags of the receiver 1 ms late", tags(_constant(1e-3), RX)),
    "tags_rx_one_pulse": Mistake("time tags of the receiver one pulse late", tags(_constant(0.05), RX), "time"),
    "tags_rx_jitter_5ms": Mistake("time tag jitter of 5 ms at the receiver", tags(_noise_tag(5e-3), RX)),
    "tags_tx_jitter_5ms": Mistake("time tag jitter of 5 ms at the transmitter", tags(_noise_tag(5e-3), TX)),
    "tags_rx_drift_1ppm": Mistake("time tag clock of the receiver 1 ppm fast", tags(_drift(1), RX), control=True),
    "tags_rx_drift_1000ppm": Mistake("time tag clock of the receiver 1000 ppm fast", tags(_drift(1000), RX)),
    "tags_cut_10ms": Mistake("time tags of the receiver truncated to 10 ms", tags(lambda n: -(n % 2) * 2_000_000, RX)),
    "start_1_late_tx": Mistake("captures of the transmitter one sample late", starts(1, TX), "prefix"),
    "start_1_late_rx": Mistake("captures of the receiver one sample late", starts(1, RX), control=True),
    "start_20_late_tx": Mistake("captures of the transmitter 20 samples late", starts(20, TX), "prefix"),
    "rx_phase_quarter": Mistake(
        "phase error of π/2 in the receiver's radar channel", samples(lambda s: 1j * s, RX, channels=RADAR), "offset"
    ),
    "rx_phase_half": Mistake(
        "phase error of π in the receiver's radar channel", samples(lambda s: -s, RX, channels=RADAR), "offset"
    ),
    "rx_channel_skew": Mistake(
        "radar of the receiver one sample late", samples(lambda s: np.roll(s, 1, axis=1), RX, channels=RADAR), "range"
    ),
    "rx_pulse_doubled": Mistake("one capture of the receiver duplicated", kept(lambda n: np.sort(np.r_[:n, 60]), RX)),
    "rx_pulses_dropped": Mistake("a quarter of the receiver's captures lost", kept(lambda n: np.r_[:50, 84:n], RX)),
    "tx_pulses_dropped_unremarked": Mistake(
        "five captures of the transmitter lost, their time tags assigned to the following captures",
        kept(lambda n: np.r_[:60, 65:n], TX, tagged=False),
    ),
    "rx_pulses_dropped_unremarked": Mistake(
        "five captures of the receiver lost, their time tags assigned to the following captures",
        kept(lambda n: np.r_[:60, 65:n], RX, tagged=False),
    ),
    "half_missing": Mistake("second half of the recordings missing", kept(lambda n: np.r_[: n // 2], TX, RX)),
    "rx_half_missing": Mistake("second half of the receiver's recording missing", kept(lambda n: np.r_[: n // 2], RX)),
    "recordings_swapped": Mistake("recordings of both nodes swapped", _swap_recordings),
    "tx_phase_random": Mistake("random carrier phase of the transmitter's own echoes", samples(_random_phase, TX)),
    "tx_phase_walk": Mistake("phase walk of 0.9 rad/√s in the transmitter's own echoes", samples(_walk, TX)),
    "rx_radar_phase_walk": Mistake(
        "phase walk of 0.9 rad/√s in the receiver's radar channel", samples(_walk, RX, channels=RADAR)
    ),
    "rx_carrier_50khz": Mistake(
        "frequency offset of 50 kHz of the receiver's oscillator", samples(_offset_carrier(5e4), RX), control=True
    ),
    "tx_saturated": Mistake("transmitter's radar channel clipped", samples(_clipped, TX)),
    "rx_saturated": Mistake("receiver's radar channel clipped", samples(_clipped, RX, channels=RADAR)),
    "tx_limited": Mistake("a fifth of the transmitter's captures limited to 1/8", samples(_limited, TX)),
    "rx_limited": Mistake("a fifth of the receiver's captures limited to 1/8", samples(_limited, RX, channels=RADAR)),
    "tx_repeated": Mistake("40 transmitter captures repeat the previous 40", lambda f: f.edit_captures(TX, _repeated)),
    "rx_repeated": Mistake("40 receiver captures repeat the previous 40", lambda f: f.edit_captures(RX, _repeated)),
    **{
        f"rx_radar_drift_{cycles}": Mistake(
            f"phase drift of {cycles} cycles between the receiver's radar and sidelink",
            samples(_drifting(cycles), RX, channels=RADAR),
        )
        for cycles in (1, 2, 3)
    },
    "tx_tone": Mistake("strong tone in the transmitter's radar channel", samples(_tone, TX)),
    "tx_iq_swapped": Mistake("I and Q of the transmitter swapped", samples(lambda s: 1j * s.conj(), TX)),
    "iq_swapped": Mistake("I and Q of both nodes swapped", samples(lambda s: 1j * s.conj(), TX, RX)),
    "rx_conjugated": Mistake("Q of the receiver with the wrong sign", samples(np.conj, RX)),
    "rx_both_negated": Mistake("both channels of the receiver inverted", samples(np.negative, RX), control=True),
    "tx_big_endian": Mistake("transmitter's samples big-endian", lambda f: f.edit_captures(TX, lambda c: c.byteswap())),
}  # fmt: skip
