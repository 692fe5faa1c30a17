"""SigMF recordings: every datatype and file layout gives the same echo of the same scene."""

import hashlib
import json
from dataclasses import replace

import numpy as np
import pytest
import sigmf
from folders import complaint, copy_writable, edit_meta, small_simulation

from apertura.campaign.folder import Campaign
from apertura.campaign.store import open_stage
from apertura.check.examination import Examination
from apertura.check.files import check_files
from apertura.check.recordings import check_recordings
from apertura.common.contracts import check
from apertura.common.errors import CampaignError
from apertura.core.echo.captures import SATURATED_SHARE, Saturation
from apertura.formats.names import recording_files
from apertura.formats.reading import open_recording
from apertura.formats.recordings.sample_file import EDGE, SETTLING, Mixing, SampleFile, SampleLayout
from apertura.simulation.campaign import write_campaign
from apertura.stages import echo, ingest
from apertura.stages.transfer import PairEcho
from apertura.views.inspect.path import look

RATE_HZ, DFT = 64e6, 256
NODES = {"a": 1, "b": 2}
"""Number of channels of each node."""


@pytest.fixture(scope="module")
def _recorded(tmp_path_factory):
    """Simulated recordings: band of 0 to 16 MHz sampled at 64 MHz, 448 samples per capture, negligible noise."""
    plan = small_simulation(pulses=20)
    nodes = {
        name: replace(node, impairments=replace(node.impairments, radar_snr_db=90.0, sidelink_snr_db=90.0))
        for name, node in plan.nodes.items()
    }
    plan = replace(plan, waveform=replace(plan.waveform, sample_rate_hz=RATE_HZ), nodes=nodes)
    return write_campaign(tmp_path_factory.mktemp("recorded") / "campaign", plan, np.random.default_rng(1))


@pytest.fixture
def campaign(_recorded, tmp_path):
    return copy_writable(_recorded, tmp_path / "campaign")


def metadata_of(root, node):
    return json.loads((root / f"raw/f01/{node}.sigmf-meta").read_text())


def counts_of(root, node):
    """Return the simulated samples, (capture, sample, channel, 2)."""
    counts = np.fromfile(root / f"raw/f01/{node}.sigmf-data", "<i2")
    return counts.reshape(20, -1, NODES[node], 2)


def rewrite(root, node, numbers, datatype, **header):
    """Write other samples of a node."""
    data = np.ascontiguousarray(numbers).tobytes()
    (root / f"raw/f01/{node}.sigmf-data").write_bytes(data)
    properties = {"core:datatype": datatype, "core:sha512": hashlib.sha512(data).hexdigest(), **header}
    edit_meta(root, node, lambda meta: meta["global"].update(properties))


def transfers(root):
    """Return the transfer functions of each pair."""
    opened = Campaign.load(root)
    for node in NODES:
        ingest.ingest(opened, "f01", node)
        check(open_stage(opened.stage("raw", "f01", node), "raw"), "raw")
    for pair in ("a-a", "a-b"):
        echo.echo(opened, "f01", pair)
    return {pair: PairEcho.opened(opened, "f01", pair).stage.transfer.values for pair in ("a-a", "a-b")}


@pytest.fixture(scope="module")
def plain(_recorded, tmp_path_factory):
    """Transfer functions of the recording as simulated, ci16_le."""
    return transfers(copy_writable(_recorded, tmp_path_factory.mktemp("plain") / "campaign"))


def difference_db(ours, theirs):
    return 10 * np.log10(np.mean(np.abs(ours - theirs) ** 2) / np.mean(np.abs(theirs) ** 2) + 1e-20)


@pytest.mark.quick("ci16_be")
@pytest.mark.parametrize("datatype", ["ci16_be", "ci32_le", "ci32_be", "cf32_le", "cf32_be", "cf64_le", "cu16_le"])
def test_lossless_datatype_gives_bitwise_equal_echoes(campaign, plain, datatype):
    stored = SampleLayout(datatype).stored
    for node, channels in NODES.items():
        counts = counts_of(campaign, node)
        rewrite(campaign, node, (counts.astype(int) + (32768 if "u" in datatype else 0)).astype(stored), datatype)
        theirs = sigmf.fromfile(str(campaign / f"raw/f01/{node}"), autoscale=False).read_samples().reshape(-1, channels)
        ours = SampleFile(campaign / f"raw/f01/{node}.sigmf-data", channels, SampleLayout(datatype)).read(0, 400)
        if "u" not in datatype:
            np.testing.assert_array_equal(ours[..., 0] + 1j * ours[..., 1], theirs[:400])
    for pair, transfer in transfers(campaign).items():
        np.testing.assert_array_equal(transfer, plain[pair])


@pytest.mark.slow
@pytest.mark.parametrize("unit", [2.0**-40, 2.0**15])
def test_unit_of_floats_only_scales_the_echo(campaign, plain, unit):
    """Volts or counts: scaling by powers of two gives bitwise equal echoes of the monostatic pairs."""
    for node in NODES:
        rewrite(campaign, node, (counts_of(campaign, node) * unit).astype("<f4"), "cf32_le")
    scaled = transfers(campaign)
    np.testing.assert_array_equal(scaled["a-a"], plain["a-a"] * np.float32(unit))
    assert difference_db(scaled["a-b"], plain["a-b"] * unit) < -120


@pytest.mark.slow
@pytest.mark.parametrize("datatype", ["ci8", "cu8"])
def test_eight_bit_samples_add_only_quantisation_noise(campaign, plain, datatype):
    """A step Δ adds Δ²/12 to the variances of I and Q; a DFT of N samples spreads these over N subcarriers: Δ²/6N."""
    counts = counts_of(campaign, "a")
    step = np.abs(counts).max() / 127
    rounded = np.rint(counts / step) + (128 if datatype == "cu8" else 0)
    rewrite(campaign, "a", rounded.astype(SampleLayout(datatype).stored), datatype)
    transfer = transfers(campaign)["a-a"]
    noise = np.mean(np.abs(transfer * step - plain["a-a"]) ** 2)
    assert noise == pytest.approx(step**2 / 6 / DFT, rel=0.1)


def as_real(counts, if_hz):
    """Return I and Q as real samples at an intermediate frequency, with phase zero at the start of each capture."""
    cycles = if_hz / RATE_HZ * np.arange(counts.shape[1])
    carrier = np.exp(2j * np.pi * cycles)[None, :, None]
    return np.real((counts[..., 0] + 1j * counts[..., 1]) * carrier)


@pytest.mark.slow
@pytest.mark.parametrize("if_hz", [8e6, 8e6 + 5 * RATE_HZ, -24e6])
def test_real_samples_at_an_intermediate_frequency_give_the_same_echo(campaign, plain, if_hz):
    """The echoes agree within the -80 dB of the filter, in any Nyquist zone, upright or mirrored."""
    for node in NODES:
        real = as_real(counts_of(campaign, node), if_hz)
        rewrite(campaign, node, real.astype("<f4"), "rf32_le", **{"apertura:if_hz": if_hz})
    assert [str(problem) for problem in check_recordings(Examination(Campaign.load(campaign)))] == []
    for pair, transfer in transfers(campaign).items():
        assert difference_db(transfer, plain[pair]) < -70, pair


@pytest.mark.slow
@pytest.mark.parametrize("datatype", ["ri16_le", "ri16_be", "rf16_le"])
def test_real_samples_add_only_quantisation_noise(campaign, plain, datatype):
    """Rounding adds a variance of Δ²/12 to the real sample; the Hilbert filter adds the same to Q within the band."""
    real = np.rint(as_real(counts_of(campaign, "a"), 8e6) / 16)  # 11 bits, exact in float16
    rewrite(campaign, "a", real.astype(SampleLayout(datatype).stored), datatype, **{"apertura:if_hz": 8e6})
    transfer = transfers(campaign)["a-a"]
    noise = np.mean(np.abs(16 * transfer - plain["a-a"]) ** 2)
    assert noise == pytest.approx(16**2 / 12 * 4 / DFT, rel=0.1)


@pytest.mark.slow
def test_wrong_sign_of_the_intermediate_frequency_changes_the_echo(campaign, plain):
    real = as_real(counts_of(campaign, "a"), 8e6)
    rewrite(campaign, "a", real.astype("<f4"), "rf32_le", **{"apertura:if_hz": -24e6})
    assert difference_db(transfers(campaign)["a-a"], plain["a-a"]) > -6


@pytest.mark.parametrize(
    ("datatype", "if_hz", "expected"),
    [
        ("rf32_le", 20e6, r"the band of 20 to 35\.75 MHz, sampled at 64 MHz, is within 1\.6 MHz of the edge"),
        ("rf32_le", None, "core:datatype rf32_le without apertura:if_hz; .*Add apertura:if_hz"),
        ("cf32_le", 8e6, "core:datatype cf32_le with apertura:if_hz"),
        ("cf24_le", None, "core:datatype 'cf24_le'; expected ci16_le: c or r"),
        ("ci16", None, "core:datatype 'ci16'"),
    ],
)
def test_invalid_datatype_or_mixing_is_named(campaign, datatype, if_hz, expected):
    real = as_real(counts_of(campaign, "a"), 8e6).astype("<f4")
    rewrite(campaign, "a", real, datatype, **({} if if_hz is None else {"apertura:if_hz": if_hz}))
    with pytest.raises(CampaignError, match=expected):
        transfers(campaign)
    problems = check_recordings(Examination(Campaign.load(campaign)))
    assert any(expected[:20].replace("\\", "") in str(problem) for problem in problems)


def test_mirror_image_is_80_db_down_across_the_band():
    """A tone at any frequency inside the band and of any phase is converted to exp(j2πft)."""
    n = np.arange(600)
    inner = slice(SETTLING, -SETTLING)
    for cycles in np.linspace(EDGE, 0.5 - EDGE, 23):
        mixed = Mixing(0.25, 1.0, restarts=True).baseband(np.cos(2 * np.pi * cycles * n + 1)[None, :, None])
        tone = np.exp(1j * (2 * np.pi * (cycles - 0.25) * n + 1))
        residual = mixed[0, inner, 0].astype(float) @ [1, 1j] - tone[inner]
        assert np.abs(residual).max() < 2e-4  # I is exact; the error of Q is twice the image


def test_mixing_of_a_continuous_recording_does_not_depend_on_reads(tmp_path):
    rng = np.random.default_rng(1)
    rng.normal(0, 1000, (5000, 2)).astype(">i2").tofile(tmp_path / "a")
    file = SampleFile(tmp_path / "a", 2, SampleLayout("ri16_be", mixing=Mixing(11.3, 64.0, restarts=False)))
    whole = file.read(0, 5000)
    parts = np.concatenate([file.read(first, min(first + 700, 5000)) for first in range(0, 5000, 700)])
    np.testing.assert_allclose(parts, whole, atol=1e-3)
    np.testing.assert_allclose(file.captures(np.array([100, 3000]), 300)[1], whole[3000:3300], atol=1e-3)
    np.testing.assert_array_equal(file.channel(1)[40:50], file.read(40, 50)[:, 1])


@pytest.mark.parametrize("taken_for", ["i16_le", "i16_be", "u16_le", "i32_le", "i8"])
@pytest.mark.parametrize(("kind", "right"), [("<f4", "f32_le"), (">f4", "f32_be"), ("<f8", "f64_le")])
@pytest.mark.parametrize("unit", [1.0, 1e-6])
def test_floats_declared_as_integers_are_rejected(campaign, taken_for, kind, right, unit):
    """The sample indices of the captures are adapted to the declared datatype."""
    numbers = (counts_of(campaign, "a") * unit).astype(kind)
    per_sample = np.dtype(kind).itemsize * 8 // int("".join(filter(str.isdigit, taken_for)))

    def count(meta):
        for capture in meta["captures"]:
            capture["core:sample_start"] *= per_sample

    rewrite(campaign, "a", numbers, f"c{taken_for}")
    edit_meta(campaign, "a", count)
    message = complaint(lambda: open_recording(recording_files(campaign / "raw/f01", "a")))
    expected = f"core:datatype c{taken_for}, but a.sigmf-data contains floating-point numbers; expected c{right}"
    assert expected in message
    assert f"Set core:datatype to c{right}" in message


@pytest.mark.parametrize("kind", ["noise", "full scale", "sine", "constant", "zeros", "clipped"])
@pytest.mark.parametrize("bits", [8, 16, 32])
def test_integers_are_not_mistaken_for_floats(tmp_path, kind, bits):
    generator, top, phase_rad = np.random.default_rng(3), 2 ** (bits - 1) - 1, np.arange(40_000) * 0.01
    values = {
        "noise": generator.normal(0, top / 100, phase_rad.size),
        "full scale": generator.uniform(-top, top, phase_rad.size),
        "sine": top * 0.9 * np.sin(phase_rad),
        "constant": np.full(phase_rad.size, top * 0.49),
        "zeros": np.zeros(phase_rad.size),
        "clipped": np.clip(generator.normal(0, top, phase_rad.size), -top, top),
    }[kind]
    path = tmp_path / "iq"
    path.write_bytes(values.astype(f"<i{bits // 8}").tobytes())
    layout = SampleLayout(f"ci{bits}_le" if bits > 8 else "ci8")
    assert SampleFile(path, 1, layout).floats_among_counts(0) is None


@pytest.mark.parametrize("wrong", [np.nan, np.inf, 1e30])
def test_invalid_float_sample_is_named(campaign, wrong):
    numbers = counts_of(campaign, "a").astype("<f4")
    numbers[3, 5, 0, 1] = wrong
    rewrite(campaign, "a", numbers, "cf32_le")
    at = 3 * numbers.shape[1] + 5
    with pytest.raises(CampaignError, match=rf"a.sigmf-data: sample {at} is not finite or exceeds 1e15"):
        transfers(campaign)


def test_clipped_float_samples_are_flagged():
    rng = np.random.default_rng(1)
    waves = rng.normal(0, 0.1, (4, 5000, 2)).astype(np.float32)
    for recorded, clipped in ((waves, False), (waves.clip(-0.25, 0.25), True)):
        saturation = Saturation()
        for block in recorded:
            saturation.count({"radar": block[None]})
        assert (saturation.shares["radar"] > SATURATED_SHARE) is clipped
        assert bool(saturation.flags) is clipped


def nonconforming(root, node, *, header=24, trailing=10):
    """Add a header to every capture and a footer to the file, under another file name."""
    folder = root / "raw/f01"
    counts = counts_of(root, node)
    captures = [b"\xff" * header + samples.tobytes() for samples in counts]
    (folder / f"{node}.sigmf-data").unlink()
    (folder / f"{node} rx0.dat").write_bytes(b"".join(captures) + b"\xee" * trailing)
    digest = hashlib.sha512((folder / f"{node} rx0.dat").read_bytes()).hexdigest()

    def describe(meta):
        properties = {"core:dataset": f"{node} rx0.dat", "core:trailing_bytes": trailing, "core:sha512": digest}
        meta["global"].update(properties)
        for capture in meta["captures"]:
            capture["core:header_bytes"] = header

    edit_meta(root, node, describe)


@pytest.mark.slow
def test_header_and_trailing_bytes_are_skipped(campaign, plain):
    recorded = {node: counts_of(campaign, node) for node in NODES}
    for node in NODES:
        nonconforming(campaign, node)
        files = recording_files(campaign / "raw/f01", node)
        opened = open_recording(files)
        np.testing.assert_array_equal(opened.samples.captures(opened.captures.start[3:7], 448), recorded[node][3:7])
        # the reader of the package sigmf counts a header twice
        begin, end = sigmf.fromfile(str(files[0])).get_capture_byte_boundaries(5)
        assert files[1].read_bytes()[begin:end] == recorded[node][5].tobytes()
        across = opened.samples.read(440, 460)  # the end of a capture and the start of the next
        np.testing.assert_array_equal(across, recorded[node].reshape(-1, NODES[node], 2)[440:460])
    for pair, transfer in transfers(campaign).items():
        np.testing.assert_array_equal(transfer, plain[pair])


def test_wrong_header_size_is_a_wrong_file_size(campaign):
    nonconforming(campaign, "a")
    edit_meta(campaign, "a", lambda meta: meta["captures"][4].update({"core:header_bytes": 25}))
    message = complaint(lambda: ingest.ingest(Campaign.load(campaign), "f01", "a"))
    assert "less 491 of core:header_bytes and core:trailing_bytes, not a multiple of 1-channel samples" in message


@pytest.mark.parametrize("name", ["../a.dat", "/etc/passwd", "..", ".hidden", "a\\b"])
def test_dataset_must_be_next_to_its_metadata(campaign, name):
    nonconforming(campaign, "a")
    edit_meta(campaign, "a", lambda meta: meta["global"].update({"core:dataset": name}))
    assert "global.core:dataset" in complaint(lambda: ingest.ingest(Campaign.load(campaign), "f01", "a"))


def collection(root, **nodes):
    """Rename the recordings, and write a collection that refers to them."""
    folder = root / "raw/f01"
    streams = []
    for node, name in nodes.items():
        for kind in ("meta", "data"):
            (folder / f"{node}.sigmf-{kind}").rename(folder / f"{name}.sigmf-{kind}")
        digest = hashlib.sha512((folder / f"{name}.sigmf-meta").read_bytes()).hexdigest()
        streams.append({"name": name, "hash": digest})
    body = {"core:version": "1.2.0", "core:streams": streams, "apertura:nodes": nodes}
    (folder / "flight.sigmf-collection").write_text(json.dumps({"collection": body}))
    return body


@pytest.mark.slow
def test_collection_assigns_recordings_to_nodes(campaign, plain):
    collection(campaign, a="rx_0", b="rx_1")
    for pair, transfer in transfers(campaign).items():
        np.testing.assert_array_equal(transfer, plain[pair])


def test_archive_is_rejected_with_the_command_to_unpack(campaign):
    folder = campaign / "raw/f01"
    for suffix in ("meta", "data"):
        (folder / f"a.sigmf-{suffix}").unlink()
    (folder / "a.sigmf").write_bytes(b"a tar archive")
    message = complaint(lambda: recording_files(folder, "a"))
    assert "a.sigmf: a SigMF archive; expected .sigmf-meta and .sigmf-data. Unpack it: tar -xf a.sigmf" in message
    assert "Unpack it: tar -xf a.sigmf" in look(folder / "a.sigmf").problem.remedy
    problems = [str(problem) for problem in check_files(Examination(Campaign.load(campaign)))]
    assert any("Unpack it" in problem for problem in problems)


def test_metadata_with_another_hash_in_the_collection_are_rejected(campaign):
    collection(campaign, a="rx_0", b="b")
    edit_meta(campaign, "rx_0", lambda meta: meta["captures"][0].update({"core:frequency": 1e9}))
    message = complaint(lambda: ingest.ingest(Campaign.load(campaign), "f01", "a"))
    assert "rx_0.sigmf-meta: sha512" in message
    assert "core:streams of flight.sigmf-collection" in message


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (
            {"apertura:nodes": {"a": "rx_7"}},
            "apertura:nodes assigns stream 'rx_7' to 'a'; expected one of core:streams",
        ),
        ({"core:streams": [{"name": "rx_0", "hash": "12"}]}, "collection.core:streams.0.hash"),
        ({"core:streams": [{"name": "../rx_0", "hash": "0" * 128}]}, "collection.core:streams.0.name"),
    ],
)
def test_invalid_collection_is_named(campaign, change, expected):
    body = collection(campaign, a="rx_0", b="rx_1") | change
    (campaign / "raw/f01/flight.sigmf-collection").write_text(json.dumps({"collection": body}))
    assert expected in complaint(lambda: ingest.ingest(Campaign.load(campaign), "f01", "a"))


@pytest.mark.parametrize("node", NODES)
def test_written_recordings_pass_the_sigmf_validator(campaign, node):
    sigmf.fromfile(str(campaign / f"raw/f01/{node}")).validate()
