"""Code symbols that change from pulse to pulse: tables, generators, frame numbers, and echoes of campaigns."""

import json
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
import yaml
import zarr
from folders import complaint, edit_config, expected_plan, small_simulation

from apertura.campaign.folder import Campaign
from apertura.common.errors import CampaignError
from apertura.core.echo.constellation import constellation
from apertura.core.echo.demodulate import Numerology
from apertura.core.echo.frame_codes import Inverses, PnCodes, displacement, frame_numbers, pn_sequence
from apertura.core.echo.transfer import Demodulator, transfer_by_code
from apertura.formats.code_tables import CodeTable
from apertura.simulation import Impairments, preset, simulate
from apertura.simulation.continuous import Framing
from apertura.stages import echo, ingest
from apertura.stages.pair import open_pair
from apertura.stages.planning import budget_of
from apertura.stages.scene import expected_scene
from apertura.stages.transfer import PairEcho
from apertura.stages.transmitted import transmitted
from apertura.views.plan import first_flight

FRAMES, SUBCARRIERS = 5, 64


def transfer_of(root, pair):
    """Return stage echo of a pair, formed from the recordings."""
    campaign = Campaign.load(root)
    for node in pair.split("-"):
        ingest.ingest(campaign, "f01", node)
    echo.echo(campaign, "f01", pair)
    return PairEcho.opened(campaign, "f01", pair).stage.load()


def campaign_with(folder, code, frames, *, framing=None, pulses=12, first_frame=0, **impairments):
    secondary = Impairments(**impairments)
    plan = small_simulation(framing=framing, secondary=secondary, pulses=pulses, first_frame=first_frame)
    waveform = replace(plan.waveform, code=code, frames=frames)
    return simulate(folder, replace(plan, waveform=waveform), seed=3)


def edited(root, codes):
    path = root / "config/config.yaml"
    document = yaml.safe_load(path.read_text())
    document["waveform"]["codes"] = codes
    path.write_text(yaml.safe_dump(document))
    return Campaign.load(root)


def difference_db(first, second):
    return 10 * np.log10(np.mean(np.abs(first - second) ** 2) / np.mean(np.abs(first) ** 2))


# ---- Pseudo-noise codes


@pytest.mark.parametrize("exponents", [(3, 2), (7, 6), (15, 14), (4, 3), (8, 6, 5, 4)])
def test_pn_sequence_satisfies_its_recurrence_and_has_the_longest_period(exponents):
    bits = pn_sequence(exponents, seed=5)
    degree = max(exponents)
    assert len(bits) == 2**degree - 1
    doubled = np.concatenate([bits, bits])
    recurrence = np.bitwise_xor.reduce([np.roll(bits, exponent) for exponent in exponents])
    np.testing.assert_array_equal(bits, recurrence)
    words = {tuple(doubled[start : start + degree]) for start in range(len(bits))}
    assert len(words) == len(bits)  # every state but zero occurs once
    assert int("".join(map(str, bits[:degree])), 2) == 5


@pytest.mark.parametrize("exponents", [(4, 2), (3, 1, 2), (6, 2)])
def test_polynomial_that_is_not_primitive_is_refused(exponents):
    with pytest.raises(ValueError, match="not primitive"):
        pn_sequence(exponents, seed=1)


def test_generated_rows_carry_consecutive_bits_and_repeat_with_the_sequence():
    sequence = pn_sequence((7, 6), seed=1)
    table = PnCodes(sequence, "16qam", 6, None)
    assert table.shape == (127, 6)  # gcd(127, 24) = 1
    bits = np.resize(sequence, 127 * 24).reshape(127, 24)
    rows = np.array([0, 5, 126])
    np.testing.assert_array_equal(table[rows], table._constellation.symbols(bits[rows]))
    assert PnCodes(sequence, "qpsk", 6, 4).shape == (4, 6)


# ---- Inverse spectra and frame numbers


def test_inverse_spectra_follow_the_frame_numbers():
    codes = np.exp(2j * np.pi * np.random.default_rng(1).random((3, 8))).astype(np.complex64)
    inverses = Inverses.of_codes(codes)
    np.testing.assert_array_equal(inverses.at(np.array([4, 2, 3])), 1 / codes[[1, 2, 0]])
    assert inverses.at(np.array([1, 4, 7])).shape == (1, 8)
    assert Inverses.of_codes(codes[:1]).at(np.arange(50)).shape == (1, 8)


@pytest.mark.parametrize(
    ("counted", "expected"),
    [
        ([-1, -1, -1, -1, -1], [0, 1, 4, 5, 6]),
        ([10, 11, 14, 15, 16], [10, 11, 14, 15, 16]),
        ([-1, 11, -1, -1, 16], [10, 11, 14, 15, 16]),
        ([6, 7, 2, 3, 4], [6, 7, 10, 11, 12]),
    ],
)
def test_frames_of_captures_by_counter_or_by_time_tags(counted, expected):
    """Two triggers are missed after the second capture; tags scatter by a fifth of the interval."""
    tags = np.array([0, 1, 4, 5, 6]) * 50_000_000 + np.array([3, -7, 9, -2, 5]) * 1_000_000
    found = frame_numbers(tags, np.array(counted), interval_s=0.05)
    assert found.numbers.tolist() == expected
    if counted[0] == counted[1]:
        assert found.basis == "order of captures; 2 missed triggers counted by time tags"


# ---- Campaigns


@pytest.mark.quick("a-b")
@pytest.mark.parametrize("pair", ["a-a", "a-b"])
def test_echoes_of_changing_codes_equal_those_of_a_fixed_code(tmp_path, pair):
    """Without noise, only the quantisation differs; with other symbols, nothing agrees."""
    fixed = transfer_of(campaign_with(tmp_path / "fixed", "qpsk", 1), pair)
    changing = campaign_with(tmp_path / "changing", "qpsk", FRAMES)
    table = np.load(changing / "raw/codes.npy")
    assert table.shape == (FRAMES, SUBCARRIERS)
    formed = transfer_of(changing, pair)
    np.testing.assert_array_equal(formed.frame, np.arange(12))
    np.testing.assert_array_equal(formed.time, fixed.time)
    assert difference_db(fixed.transfer.values, formed.transfer.values) < -55
    np.save(changing / "raw/codes.npy", np.roll(table, 1, axis=1))  # symbols of other subcarriers
    if pair == "a-a":
        assert difference_db(fixed.transfer.values, transfer_of(changing, pair).transfer.values) > 0


@pytest.mark.slow
@pytest.mark.quick("True")
@pytest.mark.parametrize("counter", [True, False])
def test_missed_triggers_do_not_displace_the_codes(tmp_path, counter):
    """A third of the receiver's captures is missing; frames are those of the transmitter's counter, or of its order."""
    framing = Framing(counter_bits=8) if counter else None
    changing = campaign_with(
        tmp_path / "changing", "64qam", FRAMES, framing=framing, pulses=24, first_frame=250, missed_fraction=0.33
    )
    formed = transfer_of(changing, "a-b")
    first = 250 if counter else 0  # the counter of 8 bits returns to zero after 6 pulses
    frames = formed.frame.values
    assert 10 < len(frames) < 24
    assert frames[-1] - frames[0] > len(frames)
    assert frames.min() >= first
    fixed = transfer_of(
        campaign_with(
            tmp_path / "fixed", "64qam", 1, framing=framing, pulses=24, first_frame=250, missed_fraction=0.33
        ),
        "a-b",
    )
    np.testing.assert_array_equal(fixed.time, formed.time)
    assert difference_db(fixed.transfer.values, formed.transfer.values) < -45


@pytest.mark.slow
def test_table_in_zarr_and_generator_give_the_bits_of_the_npy_table(tmp_path):
    changing = campaign_with(tmp_path / "campaign", "qpsk", FRAMES)
    generated = PnCodes(pn_sequence((15, 14), seed=77), "16qam", SUBCARRIERS, FRAMES)[np.arange(FRAMES)]
    np.save(changing / "raw/codes.npy", generated)
    stored = zarr.create_array(changing / "raw/codes.zarr", data=generated, chunks=(2, 16))
    assert stored.metadata.zarr_format == 3
    pn = {"generator": "pn", "polynomial": [15, 14], "seed": 77, "constellation": "16qam", "frames": FRAMES}
    read = []
    for codes in ("raw/codes.npy", "raw/codes.zarr", pn):
        campaign = edited(changing, codes)
        read.append(transfer_of(changing, "a-a").transfer.values)
        sent = transmitted(campaign, campaign.settings.waveform)
        assert sent.mean_power == pytest.approx((np.abs(generated) ** 2).sum(axis=1).mean())
    np.testing.assert_array_equal(read[0], read[1])
    np.testing.assert_array_equal(read[0], read[2])


# ---- Wrong tables


def test_wrong_tables_are_refused(tmp_path):
    codes = np.ones((FRAMES, SUBCARRIERS), np.complex64)
    for name, table in {"shape": codes[:, :-1], "zero": codes * 0, "nan": codes * np.nan, "real": codes.real}.items():
        np.save(tmp_path / f"{name}.npy", table)
        assert f"{name}.npy" in complaint(lambda name=name: CodeTable(tmp_path / f"{name}.npy", SUBCARRIERS))
    late = np.ones((1 << 15, SUBCARRIERS), np.complex64)  # a large table is tested when its rows are read
    late[51, 3] = 0
    np.save(tmp_path / "late.npy", late)
    table = CodeTable(tmp_path / "late.npy", SUBCARRIERS)
    assert "1 are zero" in complaint(lambda: table[np.array([50, 51])])
    zarr.create_array(tmp_path / "large.zarr", shape=(1 << 20, SUBCARRIERS), dtype=np.complex64, chunks=(1 << 20, 64))
    assert "chunks of" in complaint(lambda: CodeTable(tmp_path / "large.zarr", SUBCARRIERS))
    (tmp_path / "empty.zarr").mkdir()
    assert "zarr.json" in complaint(lambda: CodeTable(tmp_path / "empty.zarr", SUBCARRIERS))


def test_polynomial_of_the_config_is_checked(tmp_path):
    pn = {"generator": "pn", "polynomial": [4, 2], "seed": 3}
    campaign = edited(campaign_with(tmp_path / "campaign", "qpsk", FRAMES, pulses=2), pn)
    line = complaint(lambda: transmitted(campaign, campaign.settings.waveform))
    assert "waveform.codes" in line
    assert "not primitive" in line


def test_memory_of_a_table_is_that_of_its_block(tmp_path):
    """A table of 1 GB occupies no memory; a block of 64 frames is read in 3 arrays of its size."""
    path = tmp_path / "long.npy"
    table = np.lib.format.open_memmap(path, mode="w+", dtype=np.complex64, shape=(1 << 17, 1024))
    numbers = np.unique(np.linspace(0, (1 << 17) - 1, 16).astype(int))
    table[numbers] = 1
    table[1000:1064] = 1j
    del table
    tracemalloc.start()
    inverses = Inverses.of_codes(CodeTable(path, 1024))
    assert (inverses.at(np.arange(1000, 1064)) == -1j).all()
    assert tracemalloc.get_traced_memory()[1] < 8 * 64 * 1024 * 8
    tracemalloc.stop()


# ---- Displaced frames


@pytest.mark.parametrize("shift", [-16, -3, 0, 1, 16])
@pytest.mark.parametrize("same_delay", [True, False])
def test_displacement_of_frames_is_found_by_the_code(shift, same_delay):
    """Echo 10 dB below the noise per subcarrier with one delay; 10 dB above it if the delay changes."""
    rng = np.random.default_rng(shift + 20)
    codes = constellation("64qam").points[rng.integers(0, 64, (200, 256))]
    frames = np.arange(30, 94)
    delay = np.full(64, 11.3) if same_delay else rng.uniform(0, 256, 64)
    level = 10 ** (-0.5 if same_delay else 0.5)
    echo = level * codes[frames + shift] * np.exp(-2j * np.pi * np.arange(256) * delay[:, None] / 256)
    received = echo + (rng.normal(size=(64, 256, 2)) @ [1, 1j]) / np.sqrt(2)
    inverses = Inverses.of_codes(codes)
    assert displacement(received.astype(np.complex64), inverses, frames, same_delay=same_delay) == shift
    noise = (received - echo).astype(np.complex64)
    assert displacement(noise, inverses, frames, same_delay=same_delay) == 0


@pytest.mark.slow
@pytest.mark.parametrize("pair", ["a-a", "a-b"])
def test_codes_of_later_frames_are_found_and_corrected(tmp_path, pair):
    changing = campaign_with(tmp_path / "changing", "qpsk", FRAMES * 8, pulses=40)
    expected = transfer_of(changing, pair)
    assert "frames_displaced" not in expected.attrs["flags"]
    np.save(changing / "raw/codes.npy", np.roll(np.load(changing / "raw/codes.npy"), 3, axis=0))
    formed = transfer_of(changing, pair)
    assert "after" in formed.attrs["flags"]["frames_displaced"]
    np.testing.assert_array_equal(formed.transfer, expected.transfer)


# ---- Plan and budget


@pytest.mark.slow
@pytest.mark.parametrize("code", ["qpsk", "64qam"])
def test_plan_and_budget_state_the_loss_of_symbols_before_and_after_the_echo(tmp_path, code):
    root = simulate(tmp_path / "campaign", changed_demo(code), seed=2)
    campaign = Campaign.load(root)
    before = expected_plan(campaign, "f01", "uav1-uav1")
    ingest.ingest(campaign, "f01", "uav1")
    echo.echo(campaign, "f01", "uav1-uav1")
    campaign = Campaign.load(root)
    after = expected_plan(campaign, "f01", "uav1-uav1")
    decisions = [{item.name: item for item in plan.decisions}.get("symbol_filter") for plan in (before, after)]
    ground = expected_scene(campaign, lambda: first_flight(campaign))
    budget = budget_of(campaign, open_pair(campaign, "f01", "uav1-uav1"), ground)
    stated = [line.stated for line in budget if line.cause == "data symbols"]
    if code == "qpsk":
        assert decisions == [None, None]
        assert stated == []
        return
    assert decisions[0].value == "reciprocal"
    power, window = np.abs(np.load(root / "raw" / "codes.npy")) ** 2, np.hanning(1024)
    gain = power.mean() * (window**2 / power).mean() / np.mean(window**2)
    reason, stated_db = decisions[0].reason.removesuffix(" dB").split("; SNR loss ")
    assert reason.endswith("when they are formed")
    assert float(stated_db) == pytest.approx(10 * np.log10(gain), abs=0.1)
    assert decisions[1].value == "wiener"
    measured_db = decisions[1].reason.split("SNR loss ")[1]
    assert float(measured_db.removesuffix(" dB")) < 1
    # of the same echo with equal weights
    edit_config(root, lambda document: document.update(processing={"window": "none"}))
    unweighted = {item.name: item for item in expected_plan(Campaign.load(root), "f01", "uav1-uav1").decisions}
    assert unweighted["symbol_filter"].reason.split("SNR loss ")[1] != measured_db
    assert stated[0].startswith("wiener filter: SNR loss 0.")


def changed_demo(code, *, snr_db=-5.0, frames=100):
    plan = preset("demo", pulses=100)
    own = Impairments(radar_snr_db=snr_db)
    nodes = {"uav1": replace(plan.nodes["uav1"], impairments=own), "uav2": plan.nodes["uav2"]}
    return replace(plan, nodes=nodes, waveform=replace(plan.waveform, code=code, frames=frames))


@pytest.fixture(scope="module")
def fixed_qpsk(tmp_path_factory):
    """Transfer functions of the demo flight with a fixed QPSK code: without noise, and with an SNR of -5 dB."""
    folder = tmp_path_factory.mktemp("fixed")
    return [
        scaled_transfer(simulate(folder / f"{snr_db}", changed_demo("qpsk", snr_db=snr_db, frames=1), seed=2))[0]
        for snr_db in (None, -5.0)
    ]


def scaled_transfer(root):
    """Return transfer functions in units of the simulation instead of counts, and the report on the symbols."""
    stage = transfer_of(root, "uav1-uav1")
    truth = json.loads((root / "truth.json").read_text())["flights"]["f01"]["nodes"]["uav1"]
    return stage.transfer.values * truth["channels"]["radar"]["full_scale"], stage.attrs.get("symbols", {})


@pytest.mark.slow
@pytest.mark.parametrize("symbol_filter", ["reciprocal", "matched", "auto"])
@pytest.mark.parametrize("code", ["16qam", "64qam"])
def test_noise_of_echoes_with_changing_symbols_equals_the_closed_form(fixed_qpsk, tmp_path, code, symbol_filter):
    """Difference from the echoes of a fixed code without noise, relative to that of the fixed code with noise."""
    root = simulate(tmp_path / "campaign", changed_demo(code), seed=2)
    edit_config(root, lambda document: document.update(processing={"symbol_filter": symbol_filter}))
    measured, symbols = scaled_transfer(root)
    clean, noisy = fixed_qpsk
    noise, reference = (np.mean(np.abs(some - clean) ** 2) for some in (measured, noisy))
    assert 10 * np.log10(noise / reference) == pytest.approx(symbols["loss_db"], abs=0.1)
    assert symbols["filter"] == ("wiener" if symbol_filter == "auto" else symbol_filter)
    mean = np.vdot(clean, measured) / np.vdot(clean, clean)
    assert abs(mean - 1) < 0.01


@pytest.mark.slow
@pytest.mark.parametrize("method", ["two_parameter", "gated"])
def test_noise_of_a_sidelink_with_64_qam_is_that_of_a_constant_modulus(tmp_path, method):
    """The subcarriers of a sidelink of 2 dB are weighted by |c|²; with equal weights, its noise is 4.3 dB higher."""
    noise, clean = {}, None
    for code, snr_db in (("qpsk", None), ("qpsk", 2.0), ("64qam", 2.0)):
        plan = changed_demo(code, snr_db=None)
        quiet = Impairments(sidelink_snr_db=snr_db)
        plan = replace(plan, nodes={**plan.nodes, "uav2": replace(plan.nodes["uav2"], impairments=quiet)})
        root = simulate(tmp_path / f"{code}{snr_db}", plan, seed=5)
        settings = {"sidelink": method, "symbol_filter": "reciprocal"}
        edit_config(root, lambda document, settings=settings: document.update(processing=settings))
        ingest.ingest(Campaign.load(root), "f01", "uav1")
        stage = transfer_of(root, "uav1-uav2")
        scale = json.loads((root / "truth.json").read_text())["flights"]["f01"]["nodes"]["uav2"]["channels"]["radar"]
        formed = stage.transfer.values * scale["full_scale"]
        clean = formed if snr_db is None else clean
        noise[code] = np.mean(np.abs(formed - clean) ** 2)
        assert snr_db is None or stage.attrs["sidelink"]["snr_db"] == pytest.approx(snr_db, abs=0.5)
    assert 10 * np.log10(noise["64qam"] / noise["qpsk"]) == pytest.approx(0, abs=1.0)  # 200 errors of phase and delay


@pytest.mark.parametrize(
    ("wrong", "noise", "carried"),
    [(slice(0), 0.1, True), (slice(None), 0.1, False), (slice(192, None), 0.1, False), (slice(None), 30.0, None)],
    ids=["right", "wrong", "last quarter wrong", "wrong in noise"],
)
def test_changing_code_that_compresses_no_echo_is_unconfirmed(wrong, noise, carried):
    """Before, a wrong seed and a table with too few rows gave an image without a flag; in noise, nothing is decided."""
    draw, pulses = np.random.default_rng(5), 256
    numerology = Numerology(1e9, 64e6, np.arange(64), prefix_samples=64, dft_samples=256)
    sent, configured = (np.exp(0.5j * np.pi * draw.integers(0, 4, (pulses, 64))) for _ in range(2))
    right = np.ones(pulses, bool)
    right[wrong] = False
    configured[right] = sent[right]
    echo = np.exp(-2j * np.pi * np.arange(64) * 5 / 64)
    samples = (sent * echo) @ np.exp(2j * np.pi * np.outer(np.arange(64), np.arange(320) - 64) / 256)
    samples += noise * np.sqrt(32) * draw.normal(size=(pulses, 320, 2)).view(complex)[..., 0]
    iq = (200 * np.stack([samples.real, samples.imag], -1)).round().astype(np.int16)
    inverse = (1 / configured).astype(np.complex64)
    demodulator = Demodulator(lambda captures: inverse[captures], numerology, 320)
    measured = transfer_by_code(lambda captures: {"radar": iq[captures]}, demodulator, time_s=np.arange(pulses) / 10)
    assert measured.report["code"]["carried"] is carried
    assert ("code_unconfirmed" in measured.flags) is (carried is False)
    if wrong.start:
        assert "in 4 of 16 parts of the flight" in measured.flags["code_unconfirmed"]


def test_echo_of_fewer_than_three_pulses_is_refused(tmp_path):
    """Before, a code that locks in a single pulse by chance ended in an internal error of a later step."""
    campaign = Campaign.load(campaign_with(tmp_path / "campaign", "qpsk", FRAMES, pulses=2))
    for node in "ab":
        ingest.ingest(campaign, "f01", node)
    with pytest.raises(CampaignError, match=r"b\.sigmf.*: 2 of 2 common pulses remain; expected at least 3 pulses"):
        echo.echo(campaign, "f01", "a-b")


def test_any_row_of_a_table_that_is_not_finite_is_found_when_it_is_opened(tmp_path):
    """Before, 16 rows were tested: `check` reported no problem, and the run ended with an error."""
    codes = np.ones((200, SUBCARRIERS), np.complex64)
    codes[101, 7] = np.nan
    np.save(tmp_path / "codes.npy", codes)
    message = complaint(lambda: CodeTable(tmp_path / "codes.npy", SUBCARRIERS))
    assert "of shape (200, 64), of which 0 are zero and 1 not finite" in message
