"""Mistakes in config.yaml and in the code symbols."""

import shutil
from collections.abc import Callable

import numpy as np
from judging.bases import SHARED

from spoiling.folder import RX, TX, Document, Folder, FolderChange, Mistake

_ARMS = ("radar_tx", "radar_rx", "sidelink")


def config(change: Callable[[Document], object]) -> FolderChange:
    """Return a mistake that changes the config."""
    return lambda folder: folder.edit_config(change)


def section(name: str, **changes: Callable[[float], object] | object) -> FolderChange:
    """Return a mistake that replaces keys of a section by values, or by functions of their old values."""

    def change(document: Document) -> None:
        for key, new in changes.items():
            document[name][key] = new(document[name][key]) if callable(new) else new

    return config(change)


def arms(
    *factors: float, plus: tuple[float, float, float] = (0, 0, 0), points: tuple[str, ...] = _ARMS
) -> FolderChange:
    """Return a mistake that multiplies lever arms of the transmitting node axis by axis, and adds metres."""

    def change(document: Document) -> None:
        stated = document["nodes"][TX]["lever_arms_m"]
        for point in points:
            stated[point] = (np.array(stated[point]) * (factors or 1) + plus).tolist()

    return config(change)


def offset(node: str, channel: str, *, plus: float = 0.0, times: float = 1.0) -> FolderChange:
    """Return a mistake that changes a node's path offset."""

    def change(document: Document) -> None:
        stated = document["nodes"][node]["path_offset_m"]
        stated[channel] = stated[channel] * times + plus

    return config(change)


def codes(change: Callable[[np.ndarray], np.ndarray]) -> FolderChange:
    """Return a mistake that changes the code symbols."""
    return lambda folder: folder.edit_codes(change)


def prefix(samples: int) -> FolderChange:
    """Return a mistake that configures too long a cyclic prefix, without changing the length of the DFT window."""

    def change(document: Document) -> None:
        waveform = document["waveform"]
        waveform["cyclic_prefix_s"] += samples / waveform["sample_rate_hz"]
        waveform["symbol_s"] -= max(samples, 0) / waveform["sample_rate_hz"]

    return config(change)


def spacing(extra_bins: int) -> FolderChange:
    """Return a mistake that configures a subcarrier spacing with a longer DFT."""
    return section("waveform", subcarrier_spacing_hz=lambda hz: 1.024e9 / (round(1.024e9 / hz) + extra_bins))


def _other_code(code: np.ndarray) -> np.ndarray:
    return np.exp(1j * np.pi * (np.random.default_rng(99).integers(0, 4, len(code)) / 2 + 0.25))


def _one_symbol(code: np.ndarray) -> np.ndarray:
    code[17] *= -1
    return code


def _carrier_everywhere(folder: Folder) -> None:
    section("waveform", carrier_hz=lambda hz: hz + 5e6)(folder)
    for node in (TX, RX):
        folder.edit_meta(
            node, lambda meta: [c.update({"core:frequency": c["core:frequency"] + 5e6}) for c in meta["captures"]]
        )


def _above_a_geoid(folder: Folder) -> None:
    shutil.copyfile(SHARED / "dem_isce3" / "egm96_15.gtx", folder.root / "raw" / "egm96_15.gtx")
    section("scene", height_datum="egm96", geoid="raw/egm96_15.gtx")(folder)


def _arms_in_enu(folder: Folder) -> None:
    """Configure the lever arms of the transmitter in east, north and up instead of forward, right and down."""
    first, last = folder.log(TX).enu_m[[0, -1]]
    yaw = np.arctan2(*(last - first)[:2])
    # In east, north, up: forward = (sin yaw, cos yaw, 0), right = (cos yaw, −sin yaw, 0), down = (0, 0, −1).
    axes = np.array([[np.sin(yaw), np.cos(yaw), 0], [np.cos(yaw), -np.sin(yaw), 0], [0, 0, -1]])

    def change(document: Document) -> None:
        stated = document["nodes"][TX]["lever_arms_m"]
        for point, arm in list(stated.items()):
            stated[point] = (np.array(arm) @ axes).tolist()

    folder.edit_config(change)


def _no_attitude_no_arms(document: Document) -> None:
    document["nodes"][TX] |= {"attitude": "none", "lever_arms_m": {}}


def _swap_offsets(document: Document) -> None:
    first, second = (document["nodes"][node] for node in (TX, RX))
    first["path_offset_m"], second["path_offset_m"] = second["path_offset_m"], first["path_offset_m"]


def _swap_channels_offsets(document: Document) -> None:
    stated = document["nodes"][RX]["path_offset_m"]
    stated["radar"], stated["sidelink"] = stated["sidelink"], stated["radar"]


def _shift(east_m: float, north_m: float) -> Callable[[list[float]], list[float]]:
    return lambda bounds: [at + by for at, by in zip(bounds, (east_m, north_m) * 2, strict=True)]


MISTAKES = {
    "height_47m": Mistake("terrain 47 m too high", section("scene", height_m=lambda m: m + 47), "height"),
    "height_2m": Mistake("terrain 2 m too high", section("scene", height_m=lambda m: m + 2), "height"),
    "height_3m": Mistake("terrain 3 m too high", section("scene", height_m=lambda m: m + 3), "height"),
    "height_0m5": Mistake("terrain 0.5 m too high", section("scene", height_m=lambda m: m + 0.5), "height"),
    "height_below_0m5": Mistake("terrain 0.5 m too low", section("scene", height_m=lambda m: m - 0.5), "height"),
    "height_below_1m": Mistake("terrain 1 m too low", section("scene", height_m=lambda m: m - 1.0), "height"),
    "height_egm96": Mistake("ellipsoidal height configured as a height above EGM96", _above_a_geoid, "height"),
    "arm_z_1m2": Mistake("lever arms 1.2 m too low", arms(plus=(0, 0, 1.2)), "arm"),
    "arm_y_sign": Mistake("y of the lever arms with the wrong sign", arms(1, -1, 1), "arm"),
    "arm_x_sign": Mistake("x of the lever arms with the wrong sign", arms(-1, 1, 1), "arm"),
    "arm_z_sign": Mistake("z of the lever arms with the wrong sign", arms(1, 1, -1), "arm"),
    "arms_xy_swapped": Mistake("lever arms in right-forward-down", config(lambda d: [
        d["nodes"][TX]["lever_arms_m"].update({p: [a[1], a[0], a[2]]})
        for p, a in list(d["nodes"][TX]["lever_arms_m"].items())
    ]), "arm"),
    "arms_in_enu": Mistake("lever arms in east-north-up for the mean course", _arms_in_enu, "arm"),
    "arms_in_cm": Mistake("lever arms in centimetres", arms(100, 100, 100), "arm"),
    "arms_forgotten": Mistake("no lever arms", config(lambda d: d["nodes"][TX].update(lever_arms_m={})), "arm"),
    "sidelink_arm_forgotten": Mistake("no lever arm of the sidelink", arms(0, 0, 0, points=("sidelink",)), "arm"),
    "attitude_none": Mistake("attitude none with lever arms", config(lambda d: d["nodes"][TX].update(attitude="none"))),
    "attitude_none_no_arms": Mistake("no attitude, hence no lever arms", config(_no_attitude_no_arms), "arm"),
    "attitude_course": Mistake("attitude from the course", config(lambda d: d["nodes"][TX].update(attitude="course"))),
    "tx_offset_0m3": Mistake("0.3 m error of the monostatic path offset", offset(TX, "radar", plus=0.3), "range"),
    "tx_offset_5cm": Mistake("5 cm error of the monostatic path offset", offset(TX, "radar", plus=0.05), "range"),
    "tx_offset_sign": Mistake("monostatic path offset with the wrong sign", offset(TX, "radar", times=-1), "range"),
    "rx_offset_0m3": Mistake("0.3 m error of the bistatic path offset", offset(RX, "radar", plus=0.3), "range"),
    "rx_offset_5cm": Mistake("5 cm error of the bistatic path offset", offset(RX, "radar", plus=0.05), "range"),
    "rx_offset_sign": Mistake("bistatic path offset with the wrong sign", offset(RX, "radar", times=-1), "range"),
    "sidelink_offset_0m3": Mistake(
        "0.3 m error of the sidelink path offset", offset(RX, "sidelink", plus=0.3), "range"
    ),
    "sidelink_offset_sign": Mistake(
        "sidelink path offset with the wrong sign", offset(RX, "sidelink", times=-1), "range"
    ),
    "offsets_of_nodes_swapped": Mistake("path offsets of the nodes swapped", config(_swap_offsets), "range"),
    "offsets_of_channels_swapped": Mistake(
        "path offsets of radar and sidelink swapped", config(_swap_channels_offsets), "range"
    ),
    "prefix_1_long": Mistake("cyclic prefix one sample too long", prefix(1), "prefix"),
    "prefix_20_short": Mistake("cyclic prefix 20 samples too short", prefix(-20), "prefix"),
    "prefix_5_long": Mistake("cyclic prefix 5 samples too long", prefix(5), "prefix"),
    "code_of_another_seed": Mistake("code with another seed", codes(_other_code)),
    "code_conjugated": Mistake("code conjugated", codes(np.conj)),
    "code_shifted": Mistake("code shifted by one subcarrier", codes(lambda code: np.roll(code, 1))),
    "code_reversed": Mistake("code in descending order of subcarriers", codes(lambda code: code[::-1])),
    "code_one_symbol": Mistake("one symbol of the code wrong", codes(_one_symbol), control=True),
    "carrier_is_centre": Mistake(
        "band start configured as band centre", section("waveform", carrier_is="band_centre"), "carrier_is"
    ),
    "carrier_5mhz_config": Mistake(
        "carrier error of 5 MHz in the config", section("waveform", carrier_hz=lambda hz: hz + 5e6)
    ),
    "carrier_5mhz": Mistake("carrier error of 5 MHz in config and metadata", _carrier_everywhere),
    "spacing_1_bin": Mistake("subcarrier spacing 0.04 % too narrow", spacing(1)),
    "prf_doubled": Mistake("configured PRF twice the true one", section("waveform", prf_hz=lambda hz: 2 * hz)),
    "zone_33": Mistake("scene in the neighbouring UTM zone", section("scene", crs="EPSG:32633")),
    "zone_south": Mistake("scene in the southern UTM zone", section("scene", crs="EPSG:32732")),
    "scene_moved_1m": Mistake(
        "scene bounds 1 m farther east", section("scene", bounds_m=_shift(1.0, 0.0)), control=True
    ),
    "scene_moved_100m": Mistake(
        "scene bounds 100 m farther north", section("scene", bounds_m=_shift(0.0, 100.0)), alike=("sample", "curved")
    ),
}  # fmt: skip
