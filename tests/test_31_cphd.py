"""CPHD of other radars: files written field by field after the standard, without apertura's export."""

import re

import numpy as np
import pytest
import sarkit.cphd as skcphd
from folders import complaint
from lxml import etree

from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.contracts import check
from apertura.common.errors import CampaignError
from apertura.formats.isolated import read_isolated
from apertura.formats.phase_histories import cphd_fields
from apertura.formats.reading import read_phase_history

pytestmark = pytest.mark.usefixtures("reader")

PULSES, SAMPLES = 12, 40
SRP = np.array([4177000.0, 855000.0, 4727000.0])
AWAY = {"TxPos": np.array([800.0, -500.0, 900.0]), "RcvPos": np.array([700.0, 600.0, 800.0])}
ALONG = {"TxPos": np.array([0.0, 7.0, -3.0]), "RcvPos": np.array([1.0, 6.0, 2.0])}
TARGETS = np.array([[3.0, -2.0, 1.0], [-6.0, 4.0, -2.0]])
AMPLITUDES = np.array([1.0, 0.5j])
FIELDS = ["TxTime", "TxPos", "RcvTime", "RcvPos", "SRPPos", "FX1", "FX2", "TOA1", "TOA2", "SC0", "SCSS"]
WHEN = "2024-02-29T23:59:58.250000"
WORDS = {"CF8": ">c8", "CI4": ">i2", "CI2": "i1"}


def collected(sign=-1, srp=SRP):
    """Return PVP of a moving bistatic pair, and its signals: SGN·fx·ΔTOA cycles from each target."""
    pulse = np.arange(PULSES)[:, None]
    pvp = {name: SRP + AWAY[name] + pulse * ALONG[name] for name in AWAY}
    pvp["SRPPos"] = np.broadcast_to(srp, (PULSES, 3))

    def delay(place):
        return sum(np.linalg.norm(pvp[name] - place, axis=-1) for name in AWAY) / SPEED_OF_LIGHT_M_S

    fx = 9e9 + 1e6 * np.arange(SAMPLES)
    delay_s = np.stack([delay(SRP + target) - delay(pvp["SRPPos"]) for target in TARGETS])
    amplitudes = AMPLITUDES if sign < 0 else AMPLITUDES.conj()  # the other sign of time conjugates all phases
    signal = (amplitudes[:, None, None] * np.exp(2j * np.pi * sign * delay_s[:, :, None] * fx)).sum(axis=0)
    sent = 0.5 + 0.001 * np.arange(PULSES)
    pvp |= {"TxTime": sent, "RcvTime": sent + delay(pvp["SRPPos"]), "SC0": 9e9, "SCSS": 1e6}
    return {**pvp, "FX1": 9e9, "FX2": 9e9 + 1e6 * (SAMPLES - 1), "TOA1": -3e-7, "TOA2": 3e-7}, signal


def write(
    path, pvp, signals, *, kind="CF8", sign=-1, version="1.1.0", domain="FX", collect="BISTATIC", channels=("A",)
):
    """Write the parts of the standard that a reader needs; a parameter may be a single number for all pulses."""
    names = [name for name in (*FIELDS, "AmpSF", "SIGNAL") if name in pvp]
    table = np.zeros(
        PULSES, [(name, "i8" if name == "SIGNAL" else "f8", (3,) if name.endswith("Pos") else ()) for name in names]
    )
    for name in names:
        table[name] = pvp[name]
    layout = "".join(
        f"<{name}><Offset>{place // 8}</Offset><Size>{dtype.itemsize // 8}</Size><Format>"
        f"{'I8' if name == 'SIGNAL' else 'X=F8;Y=F8;Z=F8;' if dtype.shape else 'F8'}</Format></{name}>"
        for name, (dtype, place, *_) in table.dtype.fields.items()
    )
    size = PULSES * SAMPLES * skcphd.binary_format_string_to_dtype(kind).itemsize
    listed = "".join(
        f"<Channel><Identifier>{name}</Identifier><NumVectors>{PULSES}</NumVectors><NumSamples>{SAMPLES}</NumSamples>"
        f"<SignalArrayByteOffset>{number * size}</SignalArrayByteOffset>"
        f"<PVPArrayByteOffset>{number * table.nbytes}</PVPArrayByteOffset></Channel>"
        for number, name in enumerate(channels)
    )
    xml = (
        f'<CPHD xmlns="http://api.nsgreg.nga.mil/schema/cphd/{version}"><CollectionID><CollectType>{collect}'
        f"</CollectType><Classification>U</Classification><ReleaseInfo>U</ReleaseInfo></CollectionID><Global>"
        f"<DomainType>{domain}</DomainType><SGN>{sign:+d}</SGN><Timeline><CollectionStart>{WHEN}Z</CollectionStart>"
        f"</Timeline></Global><Data><SignalArrayFormat>{kind}</SignalArrayFormat><NumBytesPVP>{table.itemsize}"
        f"</NumBytesPVP>{listed}</Data><PVP>{layout}</PVP></CPHD>"
    )
    with path.open("wb") as stream:
        writer = skcphd.Writer(stream, skcphd.Metadata(xmltree=etree.fromstring(xml).getroottree()))
        for name, signal in zip(channels, np.broadcast_to(signals, (len(channels), PULSES, SAMPLES)), strict=True):
            writer.write_pvp(name, table)
            if kind == "CF8":
                writer.write_signal(name, signal.astype(np.complex64))
            else:
                pairs = np.round(np.stack([signal.real, signal.imag], -1)).astype(WORDS[kind].replace(">", "<"))
                dtype = skcphd.binary_format_string_to_dtype(kind)
                writer.write_signal(name, pairs.view(dtype)[..., 0])
    return path


def read(*paths, pair="tx-rx", **described):
    return check(read_phase_history("cphd", paths, pair=pair, described=described), "echo")


def expected_transfer(echo):
    """Return Σ a·exp(-j2πf(τ - τ_ref)) over the targets, as defined by the contract of the echo stage."""
    tx, rx = echo.tx_position.values, echo.rx_position.values
    delay = [
        sum(np.linalg.norm(leg - SRP - target, axis=1) for leg in (tx, rx)) / SPEED_OF_LIGHT_M_S for target in TARGETS
    ]
    excess_s = np.stack(delay) - echo.reference_delay.values
    return (AMPLITUDES[:, None, None] * np.exp(-2j * np.pi * excess_s[:, :, None] * echo.frequency.values)).sum(axis=0)


@pytest.mark.parametrize("version", ["1.0.1", "1.1.0"])
@pytest.mark.parametrize("sign", [-1, 1])
def test_samples_of_either_sign_refer_to_the_reference_point(tmp_path, sign, version):
    pvp, signal = collected(sign)
    echo = read(write(tmp_path / "rx.cphd", pvp, signal, sign=sign, version=version))
    np.testing.assert_allclose(echo.transfer.values, expected_transfer(echo), atol=1e-5)
    np.testing.assert_array_equal(echo.tx_position.values, pvp["TxPos"])
    np.testing.assert_array_equal(echo.rx_position.values, pvp["RcvPos"])
    assert echo.time.values[0] == np.datetime64(WHEN, "ns") + np.timedelta64(500, "ms")
    assert echo.attrs["frame"] == "ecef"
    assert np.isinf(echo.path_limit.values).all()


def test_moving_reference_point_is_followed(tmp_path):
    wandering = SRP + np.arange(PULSES)[:, None] * np.array([0.4, 0.1, -0.3])
    echo = read(write(tmp_path / "rx.cphd", *collected(srp=wandering)))
    np.testing.assert_allclose(echo.transfer.values, expected_transfer(echo), atol=1e-5)


@pytest.mark.parametrize(("kind", "full"), [("CI2", 100), ("CI4", 20000)])
def test_integer_samples_are_scaled_per_pulse(tmp_path, kind, full):
    pvp, signal = collected()
    scale = (1 + np.arange(PULSES)) / full
    pvp["AmpSF"] = scale
    echo = read(
        write(tmp_path / "rx.cphd", pvp, signal / scale[:, None] * np.linspace(0.1, 0.6, PULSES)[:, None], kind=kind)
    )
    wanted = expected_transfer(echo) * np.linspace(0.1, 0.6, PULSES)[:, None]
    assert (np.abs(echo.transfer.values - wanted) <= 0.75 * scale[:, None]).all()


def test_pulses_without_a_normal_signal_are_dropped_and_counted(tmp_path):
    pvp, signal = collected()
    pvp["SIGNAL"] = np.where(np.arange(PULSES) == 3, 0, np.where(np.arange(PULSES) == 7, 2, 1))
    pvp["TxPos"][3] = np.nan  # this pulse contains only noise, without a transmission
    signal[5] = 0
    echo = read(write(tmp_path / "rx.cphd", pvp, signal))
    assert echo.attrs["pulses"] == {
        "used": 9,
        "dropped": 3,
        "reasons": {"SIGNAL other than 1": 2, "all samples zero": 1},
    }
    np.testing.assert_allclose(echo.transfer.values, expected_transfer(echo), atol=1e-5)


def test_samples_outside_the_band_of_a_pulse_are_zero(tmp_path):
    pvp, signal = collected()
    pvp["FX1"], pvp["FX2"] = 9e9 + 3e6, np.where(np.arange(PULSES) == 2, 9e9 + 30e6, 9e9 + 35e6)
    echo = read(write(tmp_path / "rx.cphd", pvp, signal))
    wanted = expected_transfer(echo)
    wanted[2, 28:] = 0
    assert echo.frequency.values[[0, -1]].tolist() == [9e9 + 3e6, 9e9 + 35e6]
    np.testing.assert_allclose(echo.transfer.values, wanted, atol=1e-5)


def test_configured_channel_is_read(tmp_path):
    pvp, signal = collected()
    path = write(tmp_path / "rx.cphd", pvp, np.stack([signal, 2 * signal]), channels=("HH", "VV"))
    assert "2 channels, 'HH', 'VV'; expected a channel selected by waveform.channel" in complaint(lambda: read(path))
    assert "expected channel 'HV'" in complaint(lambda: read(path, channel="HV"))
    np.testing.assert_allclose(read(path, channel="VV").transfer.values, 2 * signal, atol=1e-5)


def test_files_are_joined_in_order_of_their_names(tmp_path):
    pvp, signal = collected()
    second = write(tmp_path / "rx.b.cphd", {**pvp, "TxTime": pvp["TxTime"] + 1}, 2 * signal)
    first = write(tmp_path / "rx.a.cphd", pvp, signal)
    np.testing.assert_allclose(read(second, first).transfer.values, np.concatenate([signal, 2 * signal]), atol=1e-5)
    write(first, {**pvp, "TxTime": pvp["TxTime"] + 2}, signal)
    assert complaint(lambda: read(first, second)).startswith(
        f"{second}: pulses that are not later than those of the previous file"
    )


def changed(**changes):
    """Return PVP and signals with some parameters replaced, or changed at one pulse: (pulse, value)."""
    pvp, signal = collected()
    for name, change in changes.items():
        if isinstance(change, tuple):
            pvp[name] = np.array(np.broadcast_to(pvp[name], (PULSES, *np.shape(pvp[name])[1:])))
            pvp[name][change[0]] = change[1]
        else:
            pvp[name] = change
    return pvp, signal


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"TxPos": (4, np.nan)}, "TxPos is not a number at index [4, 0]"),
        ({"RcvPos": (4, 10.0)}, "rx_position of pulse 4 is 17 m from the Earth's centre (1 such pulses)"),
        ({"TxTime": (4, 0.0)}, "pulse 4 is not later than the previous pulse"),
        ({"SCSS": (6, 1.0001e6)}, "frequencies (SC0, SCSS) of pulse 6 differ by 3900 Hz from the first pulse"),
        ({"SC0": (6, 9.001e9)}, "frequencies (SC0, SCSS) of pulse 6 differ by 1e+06 Hz from the first pulse"),
        ({"SCSS": -1e6}, "fewer than two samples between FX1 and FX2"),
        ({"FX1": 1e10, "FX2": 1.1e10}, "fewer than two samples between FX1 and FX2"),
        ({"SIGNAL": np.zeros(PULSES)}, "no pulse with SIGNAL 1"),
        ({"SRPPos": (0, 1e300)}, "SRPPos reaches 1e+300"),
        ({"AmpSF": np.full(PULSES, np.inf)}, "AmpSF is not a number"),
    ],
)
def test_invalid_parameter_is_named(tmp_path, changes, expected):
    message = complaint(lambda: read(write(tmp_path / "rx.cphd", *changed(**changes))))
    assert message.startswith(f"{tmp_path / 'rx.cphd'}: {expected}")


def test_times_that_contradict_positions_are_flagged(tmp_path):
    right, signal = collected()
    receiver_from_srp = right["RcvPos"][4] - SRP
    pvp, _ = changed(RcvPos=(4, SRP + receiver_from_srp * (1 + 50.0 / np.linalg.norm(receiver_from_srp))))
    flag = read(write(tmp_path / "rx.cphd", pvp, signal)).attrs["flags"]["reference_point"]
    assert flag == (
        "RcvTime - TxTime of pulse 4 differs by 1.67e-07 s from the delay of its reference point, 50 m of path "
        "(1 of 12 pulses)"
    )
    tropo = {"RcvTime": pvp["RcvTime"] + 8e-8}  # 24 m: the tropospheric delay of a path through the whole atmosphere
    assert read(write(tmp_path / "b.cphd", {**right, **tropo}, signal)).attrs["flags"] == {}


def test_nan_sample_is_named(tmp_path):
    pvp, signal = collected()
    signal[7, 11] = np.nan
    assert "the signal is not a number at index [7, 11]" in complaint(
        lambda: read(write(tmp_path / "a.cphd", pvp, signal))
    )


@pytest.mark.parametrize(
    ("options", "pair", "expected"),
    [
        ({"domain": "TOA"}, "tx-rx", "samples in domain TOA, not in the frequency domain"),
        ({"collect": "MONOSTATIC"}, "tx-rx", "CollectType MONOSTATIC for pair tx-rx"),
        ({}, "rx-rx", "CollectType BISTATIC for pair rx-rx"),
    ],
)
def test_unsupported_file_is_rejected(tmp_path, options, pair, expected):
    assert expected in complaint(lambda: read(write(tmp_path / "rx.cphd", *collected(), **options), pair=pair))


def test_nearly_equal_frequencies_are_one_set(tmp_path):
    echo = read(write(tmp_path / "rx.cphd", *changed(SC0=(6, 9e9 + 10.0))))  # 3e-6 cycles at the edge of the swath
    assert echo.sizes["pulse"] == PULSES


def test_truncated_file_is_rejected(tmp_path):
    path = write(tmp_path / "rx.cphd", *collected())
    data = path.read_bytes()
    for length in (*range(0, 2000, 200), *np.linspace(2000, len(data) - 1, 12).astype(int)):
        path.write_bytes(data[:length])
        with pytest.raises(CampaignError, match=re.escape(str(path))):
            read(path)


def test_external_xml_entity_is_not_read(tmp_path):
    """An XML entity may name any file; the contents of that file must not be disclosed."""
    secret = tmp_path / "secret"
    secret.write_text("BISTATIC")
    path = write(tmp_path / "rx.cphd", *collected())
    xml = f'<!DOCTYPE CPHD [<!ENTITY x SYSTEM "file://{secret}">]><CPHD xmlns="'
    modified = path.read_bytes().replace(b'<CPHD xmlns="', xml.encode()).replace(b"BISTATIC<", b"&x;<")
    size = int(re.search(rb"XML_BLOCK_SIZE := (\d+)", modified).group(1))
    new_size = size + len(xml) - len('<CPHD xmlns="') - len("BISTATIC") + len("&x;")
    path.write_bytes(modified.replace(b"XML_BLOCK_SIZE := %d" % size, b"XML_BLOCK_SIZE := %d" % new_size))
    try:
        fields = read_isolated(cphd_fields.read_fields, [path])[0]
    except ValueError:
        return
    assert str(fields["collect_type"]) != "BISTATIC"
