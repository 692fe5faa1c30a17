"""Mistakes in flight logs: time, place, attitude, noise, gaps."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from spoiling.folder import RX, TX, Folder, Mistake, Spoil
from spoiling.logs import Floats, Log

Change = Callable[[Log], Log]
BOTH = (TX, RX)
_FEET_M = 0.3048


def logs(change: Change, *nodes: str) -> Spoil:
    """Return what changes the logs of some nodes."""

    def spoil(folder: Folder) -> None:
        for node in nodes:
            folder.edit_log(node, change)

    return spoil


def late(seconds: float) -> Change:
    """Return what stamps epochs later than they were; the log is lengthened so that it still covers the flight."""
    return lambda log: replace(longer(log, abs(seconds) + 1.0), time_s=longer(log, abs(seconds) + 1.0).time_s + seconds)


def longer(log: Log, seconds: float) -> Log:
    """Return a log that goes on at both ends as a point reflection of itself does."""
    step_s = float(np.median(np.diff(log.time_s)))
    count = int(np.ceil(seconds / step_s))
    steps = np.arange(1, count + 1) * step_s
    quality = log.quality and (log.quality[0],) * count + log.quality + (log.quality[-1],) * count
    attitude = log.attitude_deg
    return replace(
        log,
        time_s=np.concatenate([log.time_s[0] - steps[::-1], log.time_s, log.time_s[-1] + steps]),
        geodetic=np.pad(log.geodetic, ((count, count), (0, 0)), mode="reflect", reflect_type="odd"),
        attitude_deg=None if attitude is None else np.pad(attitude, ((count, count), (0, 0)), mode="reflect"),
        quality=tuple(quality),
    )


def noisy(sigma_m: float, *, seed: int = 0) -> Change:
    """Return what adds white noise after a moving average of one second, `sigma_m` per axis."""

    def change(log: Log) -> Log:
        length = round(1.0 / float(np.median(np.diff(log.time_s))))
        white = np.random.default_rng([seed, len(log.header)]).standard_normal((len(log.time_s) + length - 1, 3))
        kernel = np.full(length, sigma_m / np.sqrt(length))
        return log.moved(np.column_stack([np.convolve(axis, kernel, "valid") for axis in white.T]))

    return change


def wandering(sigma_m: float) -> Change:
    """Return what adds slow noise, correlated over two seconds, as a float solution has."""

    def change(log: Log) -> Log:
        from scipy.ndimage import gaussian_filter1d

        width = 2.0 / float(np.median(np.diff(log.time_s)))
        drawn = np.random.default_rng(5).standard_normal((len(log.time_s) + 8 * round(width), 3))
        smooth = gaussian_filter1d(drawn, width, axis=0)[4 * round(width) :][: len(log.time_s)]
        return log.moved(smooth * sigma_m * np.sqrt(2 * np.sqrt(np.pi) * width))

    return change


def floating(log: Log) -> Log:
    """Return an RTKLIB log whose every epoch says that it is a float solution, 20 cm good."""
    cells = [line.split() for line in log.quality]
    said = [f"2  {row[1]}   0.2000   0.2000   0.4000   {'   '.join(row[5:])}" for row in cells]
    return replace(log, quality=tuple(said))


def turned(column: int, change: Callable[[Floats], Floats]) -> Change:
    """Return what changes roll (0), pitch (1) or yaw (2), degrees."""

    def changed(log: Log) -> Log:
        if log.attitude_deg is None:
            raise ValueError("this log has no attitude")
        attitude = log.attitude_deg.copy()
        attitude[:, column] = change(attitude[:, column])
        return replace(log, attitude_deg=attitude)

    return changed


def geodetic(change: Callable[[Floats], Floats]) -> Change:
    """Return what changes latitude, longitude, height, (epoch, 3)."""
    return lambda log: replace(log, geodetic=np.asarray(change(log.geodetic.copy()), np.float64))


def gap(first_s: float, last_s: float) -> Change:
    """Return what loses the epochs between two times after the log's first."""
    return lambda log: log.picked(np.flatnonzero((log.time_s < first_s) | (log.time_s > last_s)))


def outlier(at_s: float, by_m: tuple[float, float, float]) -> Change:
    """Return what moves a single epoch."""
    return lambda log: log.moved(np.outer(np.arange(len(log.time_s)) == np.abs(log.time_s - at_s).argmin(), by_m))


def step(at_s: float, by_m: tuple[float, float, float]) -> Change:
    """Return what moves all epochs from a time on."""
    return lambda log: log.moved(np.outer(log.time_s >= at_s, by_m))


def every(count: int) -> Change:
    """Return what keeps one epoch in `count`."""
    return lambda log: log.picked(slice(None, None, count))


def smoothed(seconds: float) -> Change:
    """Return what averages positions over some seconds."""

    def change(log: Log) -> Log:
        from scipy.ndimage import uniform_filter1d

        size = round(seconds / float(np.median(np.diff(log.time_s))))
        long = longer(log, seconds)
        path = long.enu_m - long.enu_m[size]
        mean = uniform_filter1d(path, size, axis=0)[size : size + len(log.time_s)]
        return log.moved(mean - path[size : size + len(log.time_s)])

    return change


def retimed(change: Callable[[Floats], Floats]) -> Change:
    """Return what changes the times of epochs, s."""
    return lambda log: replace(log, time_s=change(log.time_s))


def relabelled(said: str, *, meant: str = "GPST") -> Spoil:
    """Return what lengthens both logs by 20 s and has the header of the RTKLIB solution name another time system."""

    def spoil(folder: Folder) -> None:
        folder.edit_log(TX, lambda log: longer(log, 20.0))
        folder.edit_log(RX, lambda log: longer(log, 20.0))
        folder.edit_log(RX, lambda log: replace(log, header=_named(log.header, meant)))
        path = next((folder.root / "raw" / "f01").glob(f"{RX}.track.pos"))
        lines = path.read_text(encoding="utf-8").splitlines()
        count = sum(line.startswith("%") for line in lines)
        path.write_text("\n".join([*_named(lines[:count], said), *lines[count:]]) + "\n", encoding="utf-8")

    return spoil


def _named(header: Sequence[str], system: str) -> tuple[str, ...]:
    """Return the header of an RTKLIB solution whose times are of another system."""
    now = header[-1].split()[1]
    return (*header[:-1], header[-1].replace(now, system, 1))


def swap_tracks(folder: Folder) -> None:
    """Give each node the other's positions; attitudes stay."""
    both = {node: folder.log(node) for node in BOTH}
    for node, other in (BOTH, BOTH[::-1]):
        source = both[other]
        offset_s = (both[node].begun - source.begun).astype(float) / 1e9
        place = _at(source, both[node].time_s + offset_s)
        folder.edit_log(node, geodetic(lambda _, place=place: place))


def _at(log: Log, time_s: Floats) -> Floats:
    return np.column_stack([np.interp(time_s, log.time_s, column) for column in log.geodetic.T])


def _rounded(digits: int) -> Callable[[Floats], Floats]:
    return lambda place: np.column_stack([place[:, :2].round(digits), place[:, 2]])


def _single(place: Floats) -> NDArray[np.float64]:
    return np.column_stack([place[:, :2].astype(np.float32), place[:, 2]]).astype(np.float64)


def _float_and_wander(folder: Folder) -> None:
    folder.edit_log(RX, lambda log: wandering(0.2)(floating(log)))


def _per_axis(*factors: float) -> Callable[[Floats], Floats]:
    return lambda place: place * factors


MISTAKES = {
    "logs_47m_high": Mistake(
        "heights of both logs above a geoid", logs(lambda log: log.moved((0, 0, 47.0)), *BOTH), "height"
    ),
    "logs_0m3_high": Mistake("height of the base wrong", logs(lambda log: log.moved((0, 0, 0.3)), *BOTH), "height"),
    "rx_log_0m3_high": Mistake("height of one base wrong", logs(lambda log: log.moved((0, 0, 0.3)), RX), "offset"),
    "logs_shifted_0m7": Mistake(
        "ETRS89 taken for WGS 84 in both logs",
        logs(lambda log: log.moved((0.5, 0.5, 0)), *BOTH),
        alike=("sample", "curved"),
    ),
    "rx_log_shifted_0m7": Mistake("one log in another datum", logs(lambda log: log.moved((0.5, 0.5, 0)), RX), "offset"),
    "rx_log_shifted_0m1": Mistake("base of one log 10 cm off", logs(lambda log: log.moved((0.1, 0, 0)), RX), "offset"),
    "tracks_swapped": Mistake("each node has the other's log", swap_tracks, "tracks"),
    "tracks_late_0s5": Mistake("both logs 0.5 s late", logs(late(0.5), *BOTH), "time", alike=("sample",)),
    "tx_track_late_0s5": Mistake("log of the transmitter 0.5 s late", logs(late(0.5), TX), "time"),
    "rx_track_late_0s5": Mistake("log of the receiver 0.5 s late", logs(late(0.5), RX), "time"),
    "tracks_late_0s1": Mistake("both logs 0.1 s late", logs(late(0.1), *BOTH), "time", alike=("sample",)),
    "gpst_for_utc_both": Mistake("GPST taken for UTC in both logs", logs(late(18.0), *BOTH), "time"),
    "gpst_for_utc_rx": Mistake("GPST taken for UTC in the solution", relabelled("UTC"), "time"),
    "utc_for_gpst_rx": Mistake("UTC taken for GPST in the solution", relabelled("GPST", meant="UTC"), "time"),
    "utc_for_gpst_tx": Mistake("UTC taken for GPST in one log", logs(late(-18.0), TX), "time"),
    "noise_4cm": Mistake("4 cm of track noise in both logs", logs(noisy(0.04), *BOTH)),
    "noise_2cm": Mistake("2 cm of track noise in both logs", logs(noisy(0.02), *BOTH)),
    "noise_1cm": Mistake("1 cm of track noise in both logs", logs(noisy(0.01), *BOTH)),
    "tx_noise_4cm": Mistake("4 cm of track noise at the transmitter", logs(noisy(0.04), TX)),
    "rx_noise_4cm": Mistake("4 cm of track noise at the receiver", logs(noisy(0.04), RX)),
    "rtk_float": Mistake("float solution that wanders 20 cm and says so", _float_and_wander),
    "rtk_wander_unsaid": Mistake("solution wanders 20 cm, Q says fixed", logs(wandering(0.2), RX)),
    "rtk_step_0m1": Mistake("solution steps by 10 cm in the middle", logs(step(5.0, (0.1, 0, 0.05)), RX)),
    "tx_gap_3s": Mistake("3 s missing in the transmitter's log", logs(gap(4.0, 7.0), TX)),
    "rx_gap_3s": Mistake("3 s missing in the receiver's log", logs(gap(4.0, 7.0), RX)),
    "tx_outlier_0m5": Mistake("one epoch 0.5 m off", logs(outlier(5.0, (0.3, 0.3, 0.26)), TX)),
    "rx_outlier_0m5": Mistake("one epoch 0.5 m off", logs(outlier(5.0, (0.3, 0.3, 0.26)), RX)),
    "logs_1hz": Mistake("logs at 1 Hz", logs(every(10), *BOTH)),
    "logs_5hz": Mistake("logs at 5 Hz", logs(every(2), *BOTH), control=True),
    "logs_longer": Mistake("logs go on for 20 s", logs(lambda log: longer(log, 20.0), *BOTH), control=True),
    "tx_smoothed_5s": Mistake("log smoothed over 5 s", logs(smoothed(5.0), TX)),
    "logs_1hz_cut_times": Mistake(
        "one epoch a second, its time cut to whole seconds",
        logs(lambda log: retimed(np.floor)(every(10)(log.picked(slice(5, None)))), TX),
        "time",  # each by the same half second
    ),
    "tx_times_rounded_1s": Mistake("times of a 10 Hz log rounded to 1 s", logs(retimed(np.round), TX)),
    "tx_times_jitter": Mistake(
        "times of a log scatter by 25 ms",
        logs(retimed(lambda s: s + np.random.default_rng(3).normal(0, 0.025, s.size).clip(-0.045, 0.045)), TX),
    ),
    "latitude_longitude_swapped": Mistake(
        "latitude and longitude swapped in both logs", logs(geodetic(lambda p: p[:, [1, 0, 2]]), *BOTH)
    ),
    "tx_latitude_longitude_swapped": Mistake(
        "latitude and longitude swapped in one log", logs(geodetic(lambda p: p[:, [1, 0, 2]]), TX)
    ),
    "heights_in_feet": Mistake("heights in feet in both logs", logs(geodetic(_per_axis(1, 1, 1 / _FEET_M)), *BOTH)),
    "longitude_west": Mistake("longitude with the wrong sign", logs(geodetic(_per_axis(1, -1, 1)), *BOTH)),
    "logs_6_digits": Mistake("degrees with 6 digits, 11 cm", logs(geodetic(_rounded(6)), *BOTH)),
    "logs_7_digits": Mistake("degrees with 7 digits, 1.1 cm", logs(geodetic(_rounded(7)), *BOTH)),
    "logs_single_precision": Mistake("degrees went through float32", logs(geodetic(_single), *BOTH)),
    "yaw_sign": Mistake("yaw counter-clockwise", logs(turned(2, np.negative), TX), "attitude"),
    "yaw_90": Mistake("yaw from east", logs(turned(2, lambda yaw: yaw + 90), TX), "attitude"),
    "yaw_magnetic": Mistake("yaw from magnetic north, 4° off", logs(turned(2, lambda yaw: yaw + 4), TX)),
    "yaw_magnetic_15": Mistake("yaw 15° off", logs(turned(2, lambda yaw: yaw + 15), TX), "attitude"),
    "yaw_180": Mistake("yaw backwards", logs(turned(2, lambda yaw: yaw + 180), TX), "attitude"),
    "roll_sign": Mistake("roll with the wrong sign", logs(turned(0, np.negative), TX)),
    "pitch_sign": Mistake("pitch with the wrong sign", logs(turned(1, np.negative), TX)),
    "attitude_in_radians": Mistake(
        "attitude in radians", logs(lambda log: replace(log, attitude_deg=np.radians(log.attitude_deg)), TX), "attitude"
    ),
}  # fmt: skip
