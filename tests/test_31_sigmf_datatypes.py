"""Whatever numbers a recorder writes, and however they lie in its files, the echo is that of the same scene."""

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
"""Node → channels."""


@pytest.fixture(scope="module")
def _recorded(tmp_path_factory):
    """Band of 0 to 16 MHz in 64 MHz, 448 samples per capture, hardly any noise."""
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


def stated(root, node):
    return json.loads((root / f"raw/f01/{node}.sigmf-meta").read_text())


def counts_of(root, node):
    """Return (capture, sample, channel, 2) as simulated."""
    counts = np.fromfile(root / f"raw/f01/{node}.sigmf-data", "<i2")
    return counts.reshape(20, -1, NODES[node], 2)


def rewrite(root, node, numbers, datatype, **header):
    """Write other numbers as the samples of a node."""
    data = np.ascontiguousarray(numbers).tobytes()
    (root / f"raw/f01/{node}.sigmf-data").write_bytes(data)
    known = {"core:datatype": datatype, "core:sha512": hashlib.sha512(data).hexdigest(), **header}
    edit_meta(root, node, lambda meta: meta["global"].update(known))


def transfers(root):
    """Return pair → transfer functions."""
    opened = Campaign.load(root)
    for node in NODES:
        ingest.ingest(opened, "f01", node)
        check(open_stage(opened.stage("raw", "f01", node), "raw"), "raw")
    for pair in ("a-a", "a-b"):
        echo.echo(opened, "f01", pair)
    return {pair: PairEcho.opened(opened, "f01", pair).stage.transfer.values for pair in ("a-a", "a-b")}


@pytest.fixture(scope="module")
def plain(_recorded, tmp_path_factory):
    """Transfer functions of the recording as it was simulated, ci16_le."""
    return transfers(copy_writable(_recorded, tmp_path_factory.mktemp("plain") / "campaign"))


def apart_db(ours, theirs):
    return 10 * np.log10(np.mean(np.abs(ours - theirs) ** 2) / np.mean(np.abs(theirs) ** 2) + 1e-20)


@pytest.mark.quick("ci16_be")
@pytest.mark.parametrize("datatype", ["ci16_be", "ci32_le", "ci32_be", "cf32_le", "cf32_be", "cf64_le", "cu16_le"])
def test_a_datatype_that_holds_every_count_gives_the_same_bits(campaign, plain, datatype):
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
def test_the_unit_of_floats_is_that_of_the_echo_and_changes_nothing_else(campaign, plain, unit):
    """Volts or counts: by powers of two, to the last bit of what a node hears of itself."""
    for node in NODES:
        rewrite(campaign, node, (counts_of(campaign, node) * unit).astype("<f4"), "cf32_le")
    scaled = transfers(campaign)
    np.testing.assert_array_equal(scaled["a-a"], plain["a-a"] * np.float32(unit))
    assert apart_db(scaled["a-b"], plain["a-b"] * unit) < -120


@pytest.mark.slow
@pytest.mark.parametrize("datatype", ["ci8", "cu8"])
def test_eight_bits_add_the_noise_of_their_steps_and_nothing_else(campaign, plain, datatype):
    """A step of Δ has Δ²/12 in I and in Q, which a DFT of N samples spreads over N subcarriers: Δ²/6N on each."""
    counts = counts_of(campaign, "a")
    step = np.abs(counts).max() / 127
    rounded = np.rint(counts / step) + (128 if datatype == "cu8" else 0)
    rewrite(campaign, "a", rounded.astype(SampleLayout(datatype).stored), datatype)
    transfer = transfers(campaign)["a-a"]
    noise = np.mean(np.abs(transfer * step - plain["a-a"]) ** 2)
    assert noise == pytest.approx(step**2 / 6 / DFT, rel=0.1)


def as_real(counts, if_hz):
    """Return counts of I and Q as real samples at an intermediate frequency, each capture from phase zero."""
    turns = if_hz / RATE_HZ * np.arange(counts.shape[1])
    carrier = np.exp(2j * np.pi * turns)[None, :, None]
    return np.real((counts[..., 0] + 1j * counts[..., 1]) * carrier)


@pytest.mark.quick("-24000000.0")
@pytest.mark.parametrize("if_hz", [8e6, 8e6 + 5 * RATE_HZ, -24e6])
def test_real_samples_at_an_intermediate_frequency_give_the_same_echo(campaign, plain, if_hz):
    """In whichever Nyquist zone the band lies, upright or mirrored: to the filter's -80 dB."""
    for node in NODES:
        real = as_real(counts_of(campaign, node), if_hz)
        rewrite(campaign, node, real.astype("<f4"), "rf32_le", **{"apertura:if_hz": if_hz})
    assert [str(one) for one in check_recordings(Examination(Campaign.load(campaign)))] == []
    for pair, transfer in transfers(campaign).items():
        assert apart_db(transfer, plain[pair]) < -70, pair


@pytest.mark.slow
@pytest.mark.parametrize("datatype", ["ri16_le", "ri16_be", "rf16_le"])
def test_real_counts_add_the_noise_of_their_steps(campaign, plain, datatype):
    """Rounded to whole counts, Δ²/12 at the real sample: H gives as much to the quadrature, within the band."""
    real = np.rint(as_real(counts_of(campaign, "a"), 8e6) / 16)  # 11 bits, which float16 holds
    rewrite(campaign, "a", real.astype(SampleLayout(datatype).stored), datatype, **{"apertura:if_hz": 8e6})
    transfer = transfers(campaign)["a-a"]
    noise = np.mean(np.abs(16 * transfer - plain["a-a"]) ** 2)
    assert noise == pytest.approx(16**2 / 12 * 4 / DFT, rel=0.1)


@pytest.mark.slow
def test_the_wrong_sign_of_the_intermediate_frequency_is_another_echo(campaign, plain):
    real = as_real(counts_of(campaign, "a"), 8e6)
    rewrite(campaign, "a", real.astype("<f4"), "rf32_le", **{"apertura:if_hz": -24e6})
    assert apart_db(transfers(campaign)["a-a"], plain["a-a"]) > -6


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
def test_a_datatype_or_mixing_that_cannot_be_is_named(campaign, datatype, if_hz, expected):
    real = as_real(counts_of(campaign, "a"), 8e6).astype("<f4")
    rewrite(campaign, "a", real, datatype, **({} if if_hz is None else {"apertura:if_hz": if_hz}))
    with pytest.raises(CampaignError, match=expected):
        transfers(campaign)
    problems = check_recordings(Examination(Campaign.load(campaign)))
    assert any(expected[:20].replace("\\", "") in str(one) for one in problems)


def test_the_mirror_image_stays_80_db_below_from_edge_to_edge():
    """A tone anywhere inside the band comes out as exp(j2πft) and nothing else, whatever its phase."""
    n = np.arange(600)
    inner = slice(SETTLING, -SETTLING)
    for turns in np.linspace(EDGE, 0.5 - EDGE, 23):
        mixed = Mixing(0.25, 1.0, restarts=True).baseband(np.cos(2 * np.pi * turns * n + 1)[None, :, None])
        tone = np.exp(1j * (2 * np.pi * (turns - 0.25) * n + 1))
        left = mixed[0, inner, 0].astype(float) @ [1, 1j] - tone[inner]
        assert np.abs(left).max() < 2e-4  # I is exact, Q errs by twice the image


def test_a_recording_that_ran_through_is_mixed_the_same_however_it_is_read(tmp_path):
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
def test_floats_that_are_taken_for_counts_are_refused(campaign, taken_for, kind, right, unit):
    """Captures are as many samples as the file holds by the datatype that is stated."""
    numbers = (counts_of(campaign, "a") * unit).astype(kind)
    per_sample = np.dtype(kind).itemsize * 8 // int("".join(filter(str.isdigit, taken_for)))

    def count(meta):
        for capture in meta["captures"]:
            capture["core:sample_start"] *= per_sample

    rewrite(campaign, "a", numbers, f"c{taken_for}")
    edit_meta(campaign, "a", count)
    message = complaint(lambda: open_recording(recording_files(campaign / "raw/f01", "a")))
    found = f"core:datatype c{taken_for}, but a.sigmf-data contains floating-point numbers; expected c{right}"
    assert found in message
    assert f"Set core:datatype to c{right}" in message


@pytest.mark.parametrize("kind", ["noise", "full scale", "sine", "constant", "zeros", "clipped"])
@pytest.mark.parametrize("bits", [8, 16, 32])
def test_counts_are_no_floats(tmp_path, kind, bits):
    generator, top, turns = np.random.default_rng(3), 2 ** (bits - 1) - 1, np.arange(40_000) * 0.01
    values = {
        "noise": generator.normal(0, top / 100, turns.size),
        "full scale": generator.uniform(-top, top, turns.size),
        "sine": top * 0.9 * np.sin(turns),
        "constant": np.full(turns.size, top * 0.49),
        "zeros": np.zeros(turns.size),
        "clipped": np.clip(generator.normal(0, top, turns.size), -top, top),
    }[kind]
    path = tmp_path / "iq"
    path.write_bytes(values.astype(f"<i{bits // 8}").tobytes())
    layout = SampleLayout(f"ci{bits}_le" if bits > 8 else "ci8")
    assert SampleFile(path, 1, layout).floats_among_counts(0) is None


@pytest.mark.parametrize("wrong", [np.nan, np.inf, 1e30])
def test_a_float_that_is_no_sample_is_named(campaign, wrong):
    numbers = counts_of(campaign, "a").astype("<f4")
    numbers[3, 5, 0, 1] = wrong
    rewrite(campaign, "a", numbers, "cf32_le")
    at = 3 * numbers.shape[1] + 5
    with pytest.raises(CampaignError, match=rf"a.sigmf-data: sample {at} is not finite or exceeds 1e15"):
        transfers(campaign)


def test_floats_that_a_converter_has_clipped_are_flagged_too():
    rng = np.random.default_rng(1)
    waves = rng.normal(0, 0.1, (4, 5000, 2)).astype(np.float32)
    for recorded, clipped in ((waves, False), (waves.clip(-0.25, 0.25), True)):
        saturation = Saturation()
        for block in recorded:
            saturation.count({"radar": block[None]})
        assert (saturation.shares["radar"] > SATURATED_SHARE) is clipped
        assert bool(saturation.flags) is clipped


def nonconforming(root, node, *, header=24, trailing=10):
    """Put a header before every capture and a footer behind all, in a file of another name."""
    folder = root / "raw/f01"
    counts = counts_of(root, node)
    captures = [b"\xff" * header + one.tobytes() for one in counts]
    (folder / f"{node}.sigmf-data").unlink()
    (folder / f"{node} rx0.dat").write_bytes(b"".join(captures) + b"\xee" * trailing)
    digest = hashlib.sha512((folder / f"{node} rx0.dat").read_bytes()).hexdigest()

    def describe(meta):
        known = {"core:dataset": f"{node} rx0.dat", "core:trailing_bytes": trailing, "core:sha512": digest}
        meta["global"].update(known)
        for capture in meta["captures"]:
            capture["core:header_bytes"] = header

    edit_meta(root, node, describe)


def test_bytes_that_are_no_samples_are_passed_over(campaign, plain):
    recorded = {node: counts_of(campaign, node) for node in NODES}
    for node in NODES:
        nonconforming(campaign, node)
        files = recording_files(campaign / "raw/f01", node)
        opened = open_recording(files)
        np.testing.assert_array_equal(opened.samples.captures(opened.captures.start[3:7], 448), recorded[node][3:7])
        begin, end = sigmf.fromfile(str(files[0])).get_capture_byte_boundaries(5)  # its own reading adds a header twice
        assert files[1].read_bytes()[begin:end] == recorded[node][5].tobytes()
        across = opened.samples.read(440, 460)  # the end of a capture, and the beginning of the next
        np.testing.assert_array_equal(across, recorded[node].reshape(-1, NODES[node], 2)[440:460])
    for pair, transfer in transfers(campaign).items():
        np.testing.assert_array_equal(transfer, plain[pair])


def test_a_header_that_is_not_where_the_metadata_say_is_a_wrong_size(campaign):
    nonconforming(campaign, "a")
    edit_meta(campaign, "a", lambda meta: meta["captures"][4].update({"core:header_bytes": 25}))
    message = complaint(lambda: ingest.ingest(Campaign.load(campaign), "f01", "a"))
    assert "less 491 of core:header_bytes and core:trailing_bytes, not a multiple of 1-channel samples" in message


@pytest.mark.parametrize("name", ["../a.dat", "/etc/passwd", "..", ".hidden", "a\\b"])
def test_a_dataset_lies_beside_its_metadata(campaign, name):
    nonconforming(campaign, "a")
    edit_meta(campaign, "a", lambda meta: meta["global"].update({"core:dataset": name}))
    assert "global.core:dataset" in complaint(lambda: ingest.ingest(Campaign.load(campaign), "f01", "a"))


def collection(root, **nodes):
    """Give the recordings other names, and a collection that knows them."""
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


def test_a_collection_says_which_recording_is_a_nodes(campaign, plain):
    collection(campaign, a="rx_0", b="rx_1")
    for pair, transfer in transfers(campaign).items():
        np.testing.assert_array_equal(transfer, plain[pair])


def test_an_archive_is_to_be_unpacked(campaign):
    folder = campaign / "raw/f01"
    for suffix in ("meta", "data"):
        (folder / f"a.sigmf-{suffix}").unlink()
    (folder / "a.sigmf").write_bytes(b"a tar archive")
    message = complaint(lambda: recording_files(folder, "a"))
    assert "a.sigmf: a SigMF archive; expected .sigmf-meta and .sigmf-data. Unpack it: tar -xf a.sigmf" in message
    assert "Unpack it: tar -xf a.sigmf" in look(folder / "a.sigmf").problem.remedy
    problems = [str(problem) for problem in check_files(Examination(Campaign.load(campaign)))]
    assert any("Unpack it" in problem for problem in problems)


def test_metadata_that_a_collection_hashed_otherwise_are_refused(campaign):
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
def test_a_collection_that_cannot_be_is_named(campaign, change, expected):
    body = collection(campaign, a="rx_0", b="rx_1") | change
    (campaign / "raw/f01/flight.sigmf-collection").write_text(json.dumps({"collection": body}))
    assert expected in complaint(lambda: ingest.ingest(Campaign.load(campaign), "f01", "a"))


@pytest.mark.parametrize("node", NODES)
def test_what_we_write_passes_the_validator_of_sigmf(campaign, node):
    sigmf.fromfile(str(campaign / f"raw/f01/{node}")).validate()
