"""Mistakes in flight logs: time, position, attitude, noise and gaps."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from spoiling.folder import RX, TX, Folder, FolderChange, Mistake
from spoiling.logs import Floats, Log

Change = Callable[[Log], Log]
BOTH = (TX, RX)
_FEET_M = 0.3048


def logs(change: Change, *nodes: str) -> FolderChange:
    """Return a mistake that changes the logs of the given nodes."""

    def apply(folder: Folder) -> None:
        for node in nodes:
            folder.edit_log(node, change)

    return apply


def late(seconds: float) -> Change:
    """Return a change that delays the time tags of epochs; the log is extended so that it still covers the flight."""
    return lambda log: replace(longer(log, abs(seconds) + 1.0), time_s=longer(log, abs(seconds) + 1.0).time_s + seconds)


def longer(log: Log, seconds: float) -> Log:
    """Extend a log at both ends by its point reflection."""
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
    """Return a change that adds white noise after a moving average of one second, `sigma_m` per axis."""

    def change(log: Log) -> Log:
        length = round(1.0 / float(np.median(np.diff(log.time_s))))
        white = np.random.default_rng([seed, len(log.header)]).standard_normal((len(log.time_s) + length - 1, 3))
        kernel = np.full(length, sigma_m / np.sqrt(length))
        return log.moved(np.column_stack([np.convolve(axis, kernel, "valid") for axis in white.T]))

    return change


def wandering(sigma_m: float) -> Change:
    """Return a change that adds slow noise, correlated over two seconds, typical of a float solution."""

    def change(log: Log) -> Log:
        from scipy.ndimage import gaussian_filter1d

        width = 2.0 / float(np.median(np.diff(log.time_s)))
        drawn = np.random.default_rng(5).standard_normal((len(log.time_s) + 8 * round(width), 3))
        smooth = gaussian_filter1d(drawn, width, axis=0)[4 * round(width) :][: len(log.time_s)]
        return log.moved(smooth * sigma_m * np.sqrt(2 * np.sqrt(np.pi) * width))

    return change


def floating(log: Log) -> Log:
    """Return an RTKLIB log that reports a float solution with a standard deviation of 20 cm in every epoch."""
    cells = [line.split() for line in log.quality]
    quality = [f"2  {row[1]}   0.2000   0.2000   0.4000   {'   '.join(row[5:])}" for row in cells]
    return replace(log, quality=tuple(quality))


def turned(column: int, change: Callable[[Floats], Floats]) -> Change:
    """Return a change of roll (0), pitch (1) or yaw (2), degrees."""

    def changed(log: Log) -> Log:
        if log.attitude_deg is None:
            raise ValueError("the log contains no attitude")
        attitude = log.attitude_deg.copy()
        attitude[:, column] = change(attitude[:, column])
        return replace(log, attitude_deg=attitude)

    return changed


def geodetic(change: Callable[[Floats], Floats]) -> Change:
    """Return a change of latitude, longitude and height, (epoch, 3)."""
    return lambda log: replace(log, geodetic=np.asarray(change(log.geodetic.copy()), np.float64))


def gap(first_s: float, last_s: float) -> Change:
    """Return a change that removes the epochs between two times, counted from the first epoch."""
    return lambda log: log.picked(np.flatnonzero((log.time_s < first_s) | (log.time_s > last_s)))


def outlier(at_s: float, by_m: tuple[float, float, float]) -> Change:
    """Return a change that displaces a single epoch."""
    return lambda log: log.moved(np.outer(np.arange(len(log.time_s)) == np.abs(log.time_s - at_s).argmin(), by_m))


def step(at_s: float, by_m: tuple[float, float, float]) -> Change:
    """Return a change that displaces all epochs from a time on."""
    return lambda log: log.moved(np.outer(log.time_s >= at_s, by_m))


def every(count: int) -> Change:
    """Return a change that keeps one epoch in `count`."""
    return lambda log: log.picked(slice(None, None, count))


def smoothed(seconds: float) -> Change:
    """Return a change that averages positions over a time in seconds."""

    def change(log: Log) -> Log:
        from scipy.ndimage import uniform_filter1d

        size = round(seconds / float(np.median(np.diff(log.time_s))))
        long = longer(log, seconds)
        path = long.enu_m - long.enu_m[size]
        mean = uniform_filter1d(path, size, axis=0)[size : size + len(log.time_s)]
        return log.moved(mean - path[size : size + len(log.time_s)])

    return change


def retimed(change: Callable[[Floats], Floats]) -> Change:
    """Return a change of the time tags of epochs, s."""
    return lambda log: replace(log, time_s=change(log.time_s))


def relabelled(declared: str, *, actual: str = "GPST") -> FolderChange:
    """Return a mistake that extends both logs by 20 s and declares a wrong time system in the RTKLIB header."""

    def apply(folder: Folder) -> None:
        folder.edit_log(TX, lambda log: longer(log, 20.0))
        folder.edit_log(RX, lambda log: longer(log, 20.0))
        folder.edit_log(RX, lambda log: replace(log, header=_named(log.header, actual)))
        path = next((folder.root / "raw" / "f01").glob(f"{RX}.track.pos"))
        lines = path.read_text(encoding="utf-8").splitlines()
        count = sum(line.startswith("%") for line in lines)
        path.write_text("\n".join([*_named(lines[:count], declared), *lines[count:]]) + "\n", encoding="utf-8")

    return apply


def _named(header: Sequence[str], system: str) -> tuple[str, ...]:
    """Return the header of an RTKLIB solution with another time system."""
    current = header[-1].split()[1]
    return (*header[:-1], header[-1].replace(current, system, 1))


def swap_tracks(folder: Folder) -> None:
    """Swap the positions of both nodes; attitudes are unchanged."""
    by_node = {node: folder.log(node) for node in BOTH}
    for node, other in (BOTH, BOTH[::-1]):
        source = by_node[other]
        offset_s = (by_node[node].begun - source.begun).astype(float) / 1e9
        position = _at(source, by_node[node].time_s + offset_s)
        folder.edit_log(node, geodetic(lambda _, position=position: position))


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
        "heights of both logs refer to a geoid", logs(lambda log: log.moved((0, 0, 47.0)), *BOTH), "height"
    ),
    "logs_0m3_high": Mistake("wrong height of the base", logs(lambda log: log.moved((0, 0, 0.3)), *BOTH), "height"),
    "rx_log_0m3_high": Mistake("wrong height of one base", logs(lambda log: log.moved((0, 0, 0.3)), RX), "offset"),
    "logs_shifted_0m7": Mistake(
        "ETRS89 used as WGS 84 in both logs",
        logs(lambda log: log.moved((0.5, 0.5, 0)), *BOTH),
        alike=("sample", "curved"),
    ),
    "rx_log_shifted_0m7": Mistake("one log in another datum", logs(lambda log: log.moved((0.5, 0.5, 0)), RX), "offset"),
    "rx_log_shifted_0m1": Mistake(
        "base of one log displaced by 10 cm", logs(lambda log: log.moved((0.1, 0, 0)), RX), "offset"
    ),
    "tracks_swapped": Mistake("logs of both nodes swapped", swap_tracks, "tracks"),
    "tracks_late_0s5": Mistake("both logs 0.5 s late", logs(late(0.5), *BOTH), "time", alike=("sample",)),
    "tx_track_late_0s5": Mistake("log of the transmitter 0.5 s late", logs(late(0.5), TX), "time"),
    "rx_track_late_0s5": Mistake("log of the receiver 0.5 s late", logs(late(0.5), RX), "time"),
    "tracks_late_0s1": Mistake("both logs 0.1 s late", logs(late(0.1), *BOTH), "time", alike=("sample",)),
    "gpst_for_utc_both": Mistake("GPST used as UTC in both logs", logs(late(18.0), *BOTH), "time"),
    "gpst_for_utc_rx": Mistake("GPST declared as UTC in the solution", relabelled("UTC"), "time"),
    "utc_for_gpst_rx": Mistake("UTC declared as GPST in the solution", relabelled("GPST", actual="UTC"), "time"),
    "utc_for_gpst_tx": Mistake("UTC used as GPST in one log", logs(late(-18.0), TX), "time"),
    "noise_4cm": Mistake("4 cm of track noise in both logs", logs(noisy(0.04), *BOTH)),
    "noise_2cm": Mistake("2 cm of track noise in both logs", logs(noisy(0.02), *BOTH)),
    "noise_1cm": Mistake("1 cm of track noise in both logs", logs(noisy(0.01), *BOTH)),
    "tx_noise_4cm": Mistake("4 cm of track noise at the transmitter", logs(noisy(0.04), TX)),
    "rx_noise_4cm": Mistake("4 cm of track noise at the receiver", logs(noisy(0.04), RX)),
    "rtk_float": Mistake("declared float solution with errors of 20 cm", _float_and_wander),
    "rtk_wander_unsaid": Mistake("errors of 20 cm in a solution declared as fixed", logs(wandering(0.2), RX)),
    "rtk_step_0m1": Mistake("step of 10 cm in the middle of the solution", logs(step(5.0, (0.1, 0, 0.05)), RX)),
    "tx_gap_3s": Mistake("3 s missing in the transmitter's log", logs(gap(4.0, 7.0), TX)),
    "rx_gap_3s": Mistake("3 s missing in the receiver's log", logs(gap(4.0, 7.0), RX)),
    "tx_outlier_0m5": Mistake("one epoch displaced by 0.5 m", logs(outlier(5.0, (0.3, 0.3, 0.26)), TX)),
    "rx_outlier_0m5": Mistake("one epoch displaced by 0.5 m", logs(outlier(5.0, (0.3, 0.3, 0.26)), RX)),
    "logs_1hz": Mistake("logs at 1 Hz", logs(every(10), *BOTH)),
    "logs_5hz": Mistake("logs at 5 Hz", logs(every(2), *BOTH), control=True),
    "logs_longer": Mistake("logs extended by 20 s", logs(lambda log: longer(log, 20.0), *BOTH), control=True),
    "tx_smoothed_5s": Mistake("log smoothed over 5 s", logs(smoothed(5.0), TX)),
    "logs_1hz_cut_times": Mistake(
        "one epoch per second, with times truncated to whole seconds",
        logs(lambda log: retimed(np.floor)(every(10)(log.picked(slice(5, None)))), TX),
        "time",  # all epochs are displaced by the same half second
    ),
    "tx_times_rounded_1s": Mistake("times of a 10 Hz log rounded to 1 s", logs(retimed(np.round), TX)),
    "tx_times_jitter": Mistake(
        "time jitter of 25 ms in a log",
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
    "logs_6_digits": Mistake("degrees with 6 decimals, 11 cm", logs(geodetic(_rounded(6)), *BOTH)),
    "logs_7_digits": Mistake("degrees with 7 decimals, 1.1 cm", logs(geodetic(_rounded(7)), *BOTH)),
    "logs_single_precision": Mistake("degrees rounded to float32", logs(geodetic(_single), *BOTH)),
    "yaw_sign": Mistake("yaw counter-clockwise", logs(turned(2, np.negative), TX), "attitude"),
    "yaw_90": Mistake("yaw from east", logs(turned(2, lambda yaw: yaw + 90), TX), "attitude"),
    "yaw_magnetic": Mistake("yaw from magnetic north, error 4°", logs(turned(2, lambda yaw: yaw + 4), TX)),
    "yaw_magnetic_15": Mistake("yaw error of 15°", logs(turned(2, lambda yaw: yaw + 15), TX), "attitude"),
    "yaw_180": Mistake("yaw error of 180°", logs(turned(2, lambda yaw: yaw + 180), TX), "attitude"),
    "roll_sign": Mistake("roll with the wrong sign", logs(turned(0, np.negative), TX)),
    "pitch_sign": Mistake("pitch with the wrong sign", logs(turned(1, np.negative), TX)),
    "attitude_in_radians": Mistake(
        "attitude in radians", logs(lambda log: replace(log, attitude_deg=np.radians(log.attitude_deg)), TX), "attitude"
    ),
}  # fmt: skip
