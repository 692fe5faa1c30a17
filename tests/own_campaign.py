"""A campaign with data symbols computed from the equations with numpy alone, without the simulator of the product.

Two nodes fly past five point targets. The symbols of each pulse are new and carry a frame: header 1acffc1d, a counter,
random data and a CRC-16. The receiver has a random phase and trigger delay in each capture.
"""

import hashlib
import json
from pathlib import Path

import numpy as np
import yaml
from pyproj import Transformer

SPEED_M_S = 299_792_458.0
N, SPACING_HZ, RATE_HZ, CARRIER_HZ, PRF_HZ = 1024, 400e3, 512e6, 1.2e9, 20.0
DFT, PREFIX, SYMBOL = 1280, 400, 1600
HEADER = 0x1ACFFC1D
X, Y, HEIGHT = 570_661.0, 5_363_707.0, 620.0
TARGETS = ((0.0, 0.0, 1.0), (-1.9, -0.7, 0.8), (2.1, 0.9, 0.9), (-1.0, 1.7, 0.6), (1.3, -3.2, 0.7))
BITS = {"qpsk": 2, "16qam": 4, "64qam": 6}
_ECEF = Transformer.from_crs("EPSG:32632", "EPSG:4978", always_xy=True)
_GEODETIC = Transformer.from_crs("EPSG:32632", "EPSG:4979", always_xy=True)


def crc16(bits: list[int]) -> list[int]:
    """Return the CRC-16 with polynomial 0x1021 and start value 0xFFFF of bits, most significant bit first."""
    register = 0xFFFF
    for bit in bits:
        out = register >> 15 & 1
        register = register << 1 & 0xFFFF
        if out ^ bit:
            register ^= 0x1021
    return [register >> shift & 1 for shift in range(15, -1, -1)]


def frame(counter: int, data: np.ndarray) -> np.ndarray:
    """Return the bits of a frame: header, counter of 16 bits, data, CRC."""
    counted = [counter >> shift & 1 for shift in range(15, -1, -1)]
    header = [HEADER >> shift & 1 for shift in range(31, -1, -1)]
    checked = counted + data.tolist()
    return np.array(header + checked + crc16(checked), np.uint8)


def modulated(bits: np.ndarray, per_symbol: int) -> np.ndarray:
    """Return square QAM symbols of unit mean power, each axis with a Gray code, I before Q."""
    side = 2 ** (per_symbol // 2)
    levels = {index ^ index >> 1: 2 * index - side + 1 for index in range(side)}
    grouped = bits.reshape(-1, 2, per_symbol // 2) @ (1 << np.arange(per_symbol // 2 - 1, -1, -1))
    axes = np.vectorize(levels.__getitem__)(grouped)
    return (axes[:, 0] + 1j * axes[:, 1]) * np.sqrt(1.5 / (side**2 - 1))


def write(  # noqa: PLR0915 - one pass through the equations
    root: Path,
    *,
    constellation: str = "16qam",
    pulses: int = 200,
    sidelink_db: float = 15.0,
    radar_db: float = 10.0,
    weak: slice | None = None,
    loopback: bool = False,
) -> dict[str, np.ndarray]:
    """Write the campaign; return bits, (pulse, bit), and easting and northing of the targets, (target, 2).

    The SNRs are per subcarrier. `weak`: pulses whose direct path is 14 dB weaker. `loopback`: the transmitter
    records what it sends as its own sidelink, and gives the symbols of monostatic images.
    """
    random, per_symbol = np.random.default_rng(11), BITS[constellation]
    time_s = np.arange(pulses) / PRF_HZ

    def track(along_m: float, at_s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        x = X + along_m + 1.0 * (at_s - time_s[-1] / 2)
        return x, np.full_like(x, Y - 11.5), np.full_like(x, HEIGHT + 4.8)

    def ecef(x: np.ndarray, y: np.ndarray, height: np.ndarray) -> np.ndarray:
        return np.stack(_ECEF.transform(x, y, height), -1)

    nodes = {"uav1": -1.9, "uav2": 2.8}
    position = {name: ecef(*track(along, time_s)) for name, along in nodes.items()}
    places = np.array(TARGETS)
    scene = ecef(X + places[:, 0], Y + places[:, 1], np.full(len(places), HEIGHT))
    frequency = CARRIER_HZ + np.arange(N) * SPACING_HZ
    total = N * per_symbol
    bits = np.array([frame(m, random.integers(0, 2, total - 64)) for m in range(pulses)])
    codes = np.array([modulated(row, per_symbol) for row in bits])

    def leg(one: np.ndarray, other: np.ndarray) -> np.ndarray:
        return np.linalg.norm(one - other, axis=-1) / SPEED_M_S

    def samples(transfer: np.ndarray, phase: np.ndarray, snr_db: float) -> np.ndarray:
        """Return captures whose subcarriers have the given SNR: s(t) = Σ c_n H_n exp(j2πnΔf(t - T_cp))."""
        bins = np.zeros((pulses, DFT), complex)
        bins[:, :N] = codes * transfer * np.exp(1j * phase)[:, None]
        level = np.sqrt(np.mean(np.abs(transfer) ** 2) / 10 ** (snr_db / 10) / 2)
        period = np.fft.ifft(bins, axis=1) * DFT
        index = (np.arange(PREFIX + SYMBOL) - PREFIX) % DFT
        captured = period[:, index]
        # noise of the variance σ² per sample becomes σ²/K in a subcarrier of a DFT of K samples
        return captured + level * np.sqrt(DFT) * random.normal(size=(*captured.shape, 2)) @ [1, 1j]

    def write_node(name: str, channels: dict[str, np.ndarray], tag_s: float) -> None:
        folder = root / "raw" / "f01"
        folder.mkdir(parents=True, exist_ok=True)
        stacked = np.stack(list(channels.values()), -1)
        scale = [8000 / np.abs(values).max() for values in channels.values()]
        stacked = stacked * scale
        iq = np.stack([stacked.real, stacked.imag], -1).round().astype("<i2")
        data = iq.tobytes()
        (folder / f"{name}.sigmf-data").write_bytes(data)
        start = np.datetime64("2026-05-14T09:30:00", "ns")

        def utc(at_s: float) -> str:
            return f"{start + np.timedelta64(round((at_s + tag_s) * 1e9), 'ns')}Z"

        described = {
            "global": {
                "core:datatype": "ci16_le",
                "core:sample_rate": RATE_HZ,
                "core:version": "1.2.5",
                "core:num_channels": len(channels),
                "core:sha512": hashlib.sha512(data).hexdigest(),
                "core:extensions": [{"name": "apertura", "version": "0.1.0", "optional": True}],
                "apertura:channels": list(channels),
                "apertura:node": name,
            },
            "captures": [
                {
                    "core:sample_start": m * stacked.shape[1],
                    "core:frequency": CARRIER_HZ,
                    "core:datetime": utc(time_s[m]),
                }
                for m in range(pulses)
            ],
            "annotations": [],
        }
        (folder / f"{name}.sigmf-meta").write_text(json.dumps(described))
        logged = np.arange(-2.0, time_s[-1] + 2.0, 0.1)
        longitude, latitude, height = _GEODETIC.transform(*track(nodes[name], logged))
        rows = [
            f"{start + np.timedelta64(round(s * 1e9), 'ns')}Z,{lat:.11f},{lon:.11f},{h:.6f},0,0,90"
            for s, lat, lon, h in zip(logged, latitude, longitude, height, strict=True)
        ]
        header = "time_utc,latitude_deg,longitude_deg,height_m,roll_deg,pitch_deg,yaw_deg"
        (folder / f"{name}.track.csv").write_text("\n".join([header, *rows]) + "\n")

    def echoes(receiver: str) -> np.ndarray:
        delay = leg(position["uav1"][:, None], scene) + leg(position[receiver][:, None], scene)
        return (places[:, 2, None] * np.exp(-2j * np.pi * frequency * delay[..., None])).sum(1)

    none = np.zeros(pulses)
    own = {"radar": samples(echoes("uav1"), none, radar_db)}
    if loopback:
        own["sidelink"] = samples(np.exp(-2j * np.pi * frequency * 3e-9)[None], none, 30.0)
    write_node("uav1", own, 0.0)
    late_s, phase = random.uniform(-40e-9, 40e-9, pulses), random.uniform(-np.pi, np.pi, pulses)
    trigger = np.exp(-2j * np.pi * np.outer(late_s, np.arange(N) * SPACING_HZ))
    direct = np.exp(-2j * np.pi * np.outer(leg(position["uav1"], position["uav2"]), frequency))
    direct[weak or slice(0)] *= 0.2
    received = {
        "radar": samples(echoes("uav2") * trigger, phase, radar_db),
        "sidelink": samples(direct * trigger, phase, sidelink_db),
    }
    write_node("uav2", received, 3.7e-3)
    config = {
        "campaign": "own",
        "waveform": {
            "kind": "ofdm",
            "codes": {
                "source": "sidelink",
                "constellation": constellation,
                "frame": {"header": f"{HEADER:x}"},
                **({"node": "uav1"} if loopback else {}),
            },
            "carrier_hz": CARRIER_HZ,
            "subcarriers": N,
            "subcarrier_spacing_hz": SPACING_HZ,
            "symbol_s": SYMBOL / RATE_HZ,
            "cyclic_prefix_s": PREFIX / RATE_HZ,
            "sample_rate_hz": RATE_HZ,
            "prf_hz": PRF_HZ,
        },
        "nodes": {name: {"attitude": "none", "position_std_m": 0.001} for name in nodes},
        "scene": {
            "crs": "EPSG:32632",
            "bounds_m": [X - 6, Y - 6, X + 6, Y + 6],
            "spacing_m": 0.05,
            "height_m": HEIGHT,
            "height_datum": "ellipsoid",
            "atmosphere": {"refractivity_n": 0.0},
        },
    }
    (root / "config").mkdir(parents=True)
    (root / "config" / "config.yaml").write_text(yaml.safe_dump(config, sort_keys=False))
    (root / "config" / "flights.tsv").write_text("flight\tkind\ttransmitter\tnodes\nf01\timage\tuav1\tuav1,uav2\n")
    return {"bits": bits, "targets": places[:, :2] + [X, Y]}
