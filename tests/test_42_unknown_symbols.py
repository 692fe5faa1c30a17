"""Campaigns whose symbols are decided from the sidelink: images, unsure pulses, bits of the frames."""

import base64
import json
from dataclasses import replace

import numpy as np
import own_campaign
import pytest
from folders import edit_config

from apertura.campaign.folder import Campaign
from apertura.campaign.store import open_stage, read_manifest
from apertura.check import problems
from apertura.common.errors import CampaignError
from apertura.core.echo.constellation import constellation
from apertura.core.echo.unknown_symbols import SymbolDecider
from apertura.core.quality.point_targets import find_peak
from apertura.run.process import process
from apertura.simulation import preset, simulate
from apertura.simulation.impairments import Clock
from apertura.stages import echo, ingest
from apertura.stages.scene import open_scene
from apertura.stages.transfer import PairEcho
from apertura.tools.payload import payload, payloads, print_payload
from apertura.tools.preview.follow import Preview
from apertura.views.report.pictures import pictures, pictures_fused
from apertura.views.report.step import page
from apertura.workflow.stale import outdated_places

PAIRS = "uav1-uav1", "uav1-uav2"


def formed(root, pair="uav1-uav2"):
    """Ingest both nodes and form the echo of a pair."""
    campaign = Campaign.load(root)
    for node in ("uav1", "uav2"):
        ingest.ingest(campaign, "f01", node)
    echo.echo(campaign, "f01", pair)
    return campaign, PairEcho.opened(campaign, "f01", pair)


@pytest.fixture(scope="module")
def imaged(tmp_path_factory):
    """Image the campaign of 16-QAM frames that was computed apart from the simulator, with a sidelink of 15 dB."""
    root = tmp_path_factory.mktemp("own") / "campaign"
    truth = own_campaign.write(root)
    return process(root, last="cube"), truth


def assert_focused(image, grid, truth):
    """Assert that an image shows five targets within a centimetre."""
    assert len(truth["targets"]) == 5
    for place in truth["targets"]:
        row, column = (float(value) for value in grid.pixel_of(*place))
        peak = find_peak(image, round(row), round(column))
        assert grid.spacing_m * np.hypot(peak.row - row, peak.column - column) < 0.01


@pytest.mark.slow
@pytest.mark.parametrize("pair", PAIRS)
def test_targets_focus_within_a_centimetre_by_unknown_symbols(imaged, pair):
    """Both the monostatic pair, by the symbols of the receiver's sidelink, and the bistatic pair image five targets."""
    campaign, truth = imaged
    assert_focused(
        open_stage(campaign.stage("image", "f01", pair), "image").image.values, open_scene(campaign).grid, truth
    )


@pytest.mark.slow
def test_report_states_the_choice_between_decisions_and_division(imaged):
    """The echo states the node, the method with its reason, and the SNR of 15 dB; no pulse is unsure."""
    decided = open_stage(imaged[0].stage("echo", "f01", "uav1-uav2"), "echo").attrs["symbols"]["decided"]
    assert (decided["node"], decided["method"], decided["unsure"]) == ("uav2", "decisions", 0)
    assert decided["snr_db"] == pytest.approx(15, abs=0.2)
    assert "division an error of -12." in decided["reason"]


@pytest.mark.slow
def test_bits_of_an_independent_campaign_are_read(tmp_path):
    """QPSK at 15 dB: header, counter, data and CRC of all frames agree with those computed by other code."""
    bits = own_campaign.write(tmp_path / "campaign", constellation="qpsk", pulses=40)["bits"]
    (read,) = payloads(Campaign.load(tmp_path / "campaign"), "f01")
    assert read.columns["intact"].all()
    assert np.array_equal(read.columns["counter"], np.arange(40))
    sent = np.packbits(bits[:, 48:-16], axis=1)
    assert np.array_equal(read.data, sent)


@pytest.mark.slow
def test_noisy_sidelink_is_divided_and_flagged(tmp_path):
    """At 8 dB, 16-QAM is unsure: all pulses remain, divided by the sidelink; at 15 dB there is no flag."""
    own_campaign.write(tmp_path / "noisy", pulses=64, sidelink_db=8.0)
    stage = formed(tmp_path / "noisy")[1].stage
    assert stage.attrs["symbols"]["decided"]["method"] == "division"
    assert stage.attrs["sidelink"]["method"] == "divide"
    assert "below 11.4 dB" in stage.attrs["flags"]["symbols_unsure"]
    assert stage.sizes["pulse"] > 60
    own_campaign.write(tmp_path / "clear", pulses=64)
    attrs = formed(tmp_path / "clear")[1].stage.attrs
    assert "symbols_unsure" not in attrs["flags"]


@pytest.mark.slow
def test_monostatic_echo_uses_sure_symbols_only(tmp_path):
    """Around the least SNR of 16-QAM, 11.4 dB: some pulses are excluded; at 8 dB, all are, and the error names the SNR.

    Before, all pulses were used, and the report stated the loss of division: 0.00 instead of 1.1 dB at 8 dB.
    """
    stages = []
    for name, sidelink_db in (("limit", 11.4), ("clear", 25.0)):
        own_campaign.write(tmp_path / name, pulses=64, sidelink_db=sidelink_db)
        stages.append(formed(tmp_path / name, "uav1-uav1")[1].stage)
    limit, clear = stages
    decided = limit.attrs["symbols"]["decided"]
    assert decided["method"] == "decisions"
    assert 0 < decided["unsure"] < 64
    assert f"symbols of {decided['unsure']} of 64 pulses are unsure" in limit.attrs["flags"]["symbols_unsure"]
    both = np.isin(clear.time.values, limit.time.values)
    measured, truth = limit.transfer.values, clear.transfer.values[both]
    gain = np.vdot(truth, measured).real / np.vdot(truth, truth).real
    assert 20 * np.log10(gain) == pytest.approx(decided["loss_db"], abs=0.15)
    assert "symbols_unsure" not in clear.attrs["flags"]
    own_campaign.write(tmp_path / "noisy", pulses=64, sidelink_db=8.0)
    with pytest.raises(CampaignError, match=r"all 64 pulses are unsure; .*at least 11.4 dB for 16qam"):
        formed(tmp_path / "noisy", "uav1-uav1")


@pytest.mark.slow
def test_monostatic_image_without_header_and_pilots_is_refused(tmp_path):
    """The phase of blind symbols is ambiguous; a bistatic pair does not need it."""
    root = tmp_path / "campaign"
    own_campaign.write(root, pulses=32)
    edit_config(root, lambda config: config["waveform"]["codes"].pop("frame"))
    assert formed(root)[1].shape[0] == 32
    with pytest.raises(CampaignError, match="ambiguous by quarter turns"):
        formed(root, "uav1-uav1")
    with pytest.raises(CampaignError, match="no frame format"):
        print_payload(Campaign.load(root))


@pytest.mark.slow
def test_payload_of_the_preset_is_that_of_its_truth(tmp_path):
    """Decided symbols of the simulated frames are those in symbols.npy; files and summary are written."""
    root = simulate(tmp_path / "campaign", preset("payload", pulses=40))
    campaign = Campaign.load(root)
    files = payload(campaign, "f01")
    assert [path.name for path in files] == ["payload.json", "payload.png", "uav2.csv", "uav2.npy"]
    (summary,) = json.loads(files[0].read_text())["nodes"]
    assert summary["intact"] == summary["frames"]
    assert summary["received_bit_s"] == pytest.approx((4096 - 64) * 20)
    (read,) = payloads(campaign, "f01")
    true = np.load(root / "symbols.npy")[read.columns["counter"]]
    qam = constellation("16qam")
    sent = np.packbits(qam.bits(qam.decide(true))[:, 48:-16], axis=1)
    assert np.array_equal(np.load(root / "results/f01/payload/uav2.npy"), sent)


@pytest.mark.slow
def test_expected_frame_errors_are_the_mean_over_frames(tmp_path):
    """Of frames at 20 dB and at 6 dB, all weak ones are lost and no others, as their SNR predicts."""
    own_campaign.write(tmp_path / "campaign", pulses=96, sidelink_db=20.0, weak=slice(10, 34))
    campaign = Campaign.load(tmp_path / "campaign")
    (summary,) = (one.summary for one in payloads(campaign, "f01"))
    assert summary["frame_error_rate"] == 24 / 96
    assert summary["frame_error_rate_expected"] == pytest.approx(24 / 96, abs=0.005)


@pytest.mark.slow
def test_report_shows_the_payload_without_decoding_it_again(imaged, monkeypatch):
    """The page of a flight with frames depends on the payload, shows its plot, and the error rates of both limits."""
    campaign = imaged[0]
    process(campaign, first="layers", last="export_fused")
    for pair in PAIRS:
        pictures(campaign, "f01", pair)
    pictures_fused(campaign, "f01")
    payload(campaign, "f01")
    monkeypatch.setattr("apertura.tools.payload.payloads", None)
    page(campaign, "f01")
    assert outdated_places(campaign, "payload") == []
    print_payload(campaign)
    html = campaign.result("f01", "report.html").read_text()
    section = html[html.index("<h2>Payload</h2>") :]
    encoded = base64.b64encode(campaign.result("f01", "payload", "payload.png").read_bytes()).decode()
    assert encoded in section
    assert "<td>uav2</td>" in section
    sources = read_manifest(campaign.result("f01", "page.manifest.json"))["sources"]
    assert "results/f01/payload/payload.manifest.json" in sources


@pytest.mark.slow
def test_transmitter_is_imaged_by_its_own_recording_of_what_it_sent(tmp_path):
    """The symbols of its loop-back compress the echoes of the transmitter to the same profiles as the true symbols."""
    root = tmp_path / "campaign"
    bits = own_campaign.write(root, pulses=64, loopback=True)["bits"]
    edit_config(root, lambda config: config.update(processing={"symbol_filter": "reciprocal"}))
    stage = formed(root, "uav1-uav1")[1].stage
    decided = stage.transfer.values
    assert stage.attrs["symbols"]["decided"]["node"] == "uav1"
    assert stage.attrs["flags"] == {}
    edit_config(root, lambda config: config["waveform"].update(codes="raw/codes.npy"))
    codes = np.array([own_campaign.modulated(row, 4) for row in bits])
    np.save(root / "raw" / "codes.npy", codes.astype(np.complex64))
    campaign = Campaign.load(root)
    echo.echo(campaign, "f01", "uav1-uav1")
    known = PairEcho.opened(campaign, "f01", "uav1-uav1").stage.transfer.values
    assert np.allclose(decided, known, atol=1e-5 * np.abs(known).max())


@pytest.mark.slow
def test_pulses_with_a_weak_sidelink_are_excluded(tmp_path):
    """A sidelink 14 dB weaker in a part of the flight leaves its pulses unsure: they are counted and flagged."""
    root = tmp_path / "campaign"
    own_campaign.write(root, pulses=96, sidelink_db=20.0, weak=slice(10, 24))
    stage = formed(root)[1].stage
    assert stage.attrs["symbols"]["decided"]["unsure"] == 14
    assert stage.attrs["pulses"]["reasons"]["symbols_unsure"] == 14
    assert stage.attrs["flags"]["symbols_unsure"].startswith("symbols of 14 of 96 pulses are unsure")
    assert not np.isin(np.arange(10, 24), stage.capture.values).any()


def advanced(preview, *, ended=False):
    """Read the files of a preview, and add all pulses that are ready; return the pairs."""
    preview._read()
    for pair in preview.pairs:
        while pair.add_next(ended=ended) or pair.refine_next():
            pass
    return preview.pairs


@pytest.mark.slow
def test_preview_follows_the_sidelink_that_gives_the_symbols(tmp_path):
    """Monostatic pulses are added as the receiver records them, and then show five targets within a centimetre."""
    root = tmp_path / "campaign"
    truth = own_campaign.write(root)
    data = root / "raw" / "f01" / "uav2.sigmf-data"
    whole = data.read_bytes()
    data.write_bytes(b"")
    preview = Preview(Campaign.load(root), follow=True)
    pair = advanced(preview)[0]
    assert (pair.name, pair.counts["added"]) == ("uav1-uav1", 0)
    assert pair.waits == "symbols are decided from the sidelink of uav2, which has recorded 0 captures"
    for share in (0.4, 0.7):
        data.write_bytes(whole[: int(share * len(whole))])
        assert 200 * share - 3 <= advanced(preview)[0].counts["added"] < 200 * share
    data.write_bytes(whole)
    pair = advanced(preview, ended=True)[0]
    assert (pair.counts["added"], pair.waits, pair.flags) == (200, "", {})
    assert_focused(pair.images[1].image, pair.images[1].grid, truth)


@pytest.mark.slow
def test_preview_of_ambiguous_symbols_is_bistatic(tmp_path):
    """Without pilots and header, the monostatic pair states the reason."""
    own_campaign.write(tmp_path / "campaign", pulses=64)
    edit_config(tmp_path / "campaign", lambda config: config["waveform"]["codes"].pop("frame"))
    alone, other = advanced(Preview(Campaign.load(tmp_path / "campaign"), follow=False), ended=True)
    assert "ambiguous by quarter turns" in alone.waits
    assert (alone.counts["added"], other.counts["added"], other.waits) == (0, 64, "")


@pytest.mark.slow
@pytest.mark.parametrize("pair", PAIRS)
def test_finished_echo_decides_the_symbols_of_its_stage_without_measuring_the_sidelink_again(
    tmp_path, monkeypatch, pair
):
    """With a clock offset, transfer functions read from a finished stage are those of the run, bit by bit."""
    plan = preset("payload", pulses=96)
    receiver = plan.nodes["uav2"]
    impairments = replace(receiver.impairments, clock=Clock(cfo_hz=100e3))
    nodes = {**plan.nodes, "uav2": replace(receiver, impairments=impairments)}
    root, live, within = simulate(tmp_path / "campaign", replace(plan, nodes=nodes)), list[PairEcho](), PairEcho.within
    monkeypatch.setattr(PairEcho, "within", lambda self, *names: live.append(self) or within(self, *names))
    opened = formed(root, pair)[1]
    monkeypatch.setattr(SymbolDecider, "measured", lambda *_: pytest.fail("the sidelink is measured again"))
    assert opened.dataset.symbol_clock.values == pytest.approx(100e3, rel=0.01)
    assert np.array_equal(opened.stage.transfer.values, live[0].stage.transfer.values)


def test_framed_symbols_of_a_simulation_require_a_constellation():
    """Newman's code carries no data."""
    with pytest.raises(ValueError, match="requires a constellation"):
        replace(preset("payload").waveform, code="newman")


@pytest.mark.slow
def test_check_refuses_monostatic_pairs_without_a_known_part(tmp_path):
    """The error is found before the run; with a frame there is no problem."""
    own_campaign.write(tmp_path / "campaign", pulses=8)
    assert problems(tmp_path / "campaign") == []
    edit_config(tmp_path / "campaign", lambda config: config["waveform"]["codes"].pop("frame"))
    (problem,) = problems(tmp_path / "campaign")
    assert "ambiguous by quarter turns" in problem.found


@pytest.mark.slow
@pytest.mark.parametrize(
    ("codes", "found"),
    [
        ({"frame": {"header": "1a", "counter_bits": 48}, "constellation": "64qam"}, "header of 8 bits"),
        ({"pilots": "raw/none.npy"}, "no such file"),
        ({"node": "uav9"}, "node 'uav9' is not part of flight f01"),
        ({"node": "uav1"}, "node uav1 recorded no channel named 'sidelink'"),
    ],
)
def test_wrong_settings_of_unknown_symbols_are_refused(tmp_path, codes, found):
    """The error states the setting; a node without sidelink is found when the echo is formed."""
    own_campaign.write(tmp_path / "campaign", pulses=8)
    edit_config(tmp_path / "campaign", lambda config: config["waveform"]["codes"].update(codes))
    with pytest.raises(CampaignError) as caught:
        formed(tmp_path / "campaign", "uav1-uav1")
    assert found in caught.value.found


def printed(campaign, capsys):
    """Return the summary of the only node in payload.json, and the printed text in one line."""
    print_payload(campaign)
    (summary,) = json.loads(campaign.result("f01", "payload", "payload.json").read_text())["nodes"]
    return summary, " ".join(capsys.readouterr().out.split())


@pytest.mark.slow
def test_header_that_is_not_sent_is_flagged_and_stated(tmp_path, capsys):
    """Two of 32 bits differ: before, the payload was 0 intact frames without a remark, and the echo had no flag."""
    root = tmp_path / "campaign"
    own_campaign.write(root, pulses=64, sidelink_db=25.0)
    assert formed(root)[1].stage.attrs["flags"] == {}
    edit_config(root, lambda config: config["waveform"]["codes"].update(frame={"header": "1acffc1e"}))
    campaign, pair = formed(root)
    line = "6.2 % of the bits of the header are wrong, 0.00 % expected from the SNR"
    assert pair.stage.attrs["flags"] == {"header_differs": f"sidelink of uav2: {line}"}
    summary, text = printed(campaign, capsys)
    assert (summary["intact"], summary["lost"]) == (0, 64)
    assert summary["remarks"][0].startswith(line)
    assert f"f01, uav2: {line}" in text


@pytest.mark.slow
@pytest.mark.parametrize("pair", PAIRS)
def test_header_in_the_conjugated_samples_names_the_order_of_i_and_q(tmp_path, capsys, pair):
    """The conjugate of a band around the carrier is a band of QAM symbols too: only the header tells them apart."""
    plan = preset("payload", pulses=96)
    plan = replace(plan, waveform=replace(plan.waveform, carrier_is="band_centre"))
    root = simulate(tmp_path / "campaign", plan)
    edit_config(root, lambda config: config["nodes"]["uav2"].update(iq="conjugate"))
    campaign, echoes = formed(root, pair)
    flags = echoes.stage.attrs["flags"]
    assert {"header_differs", "spectrum_inverted"} <= flags.keys()
    assert "sidelink of uav2: the complex conjugates of the samples contain the header" in flags["spectrum_inverted"]
    assert "change nodes.uav2.iq, or waveform.iq" in printed(campaign, capsys)[1]
    edit_config(root, lambda config: config["nodes"]["uav2"].update(iq="complex"))
    assert not formed(root, pair)[1].stage.attrs["flags"].keys() & {"header_differs", "spectrum_inverted"}


@pytest.mark.slow
def test_frames_without_capture_are_lost(tmp_path, capsys):
    """Of 100 sent frames, 90 are recorded between the first and the last: before, the frame error rate was 0."""
    root = tmp_path / "campaign"
    own_campaign.write(root, constellation="qpsk", pulses=100, sidelink_db=25.0)
    path = root / "raw" / "f01" / "uav2.sigmf-meta"
    described = json.loads(path.read_text())
    described["captures"] = [one for m, one in enumerate(described["captures"]) if not (20 <= m < 28 or m in (50, 70))]
    path.write_text(json.dumps(described))
    summary, _ = printed(Campaign.load(root), capsys)
    assert (summary["frames"], summary["intact"], summary["sent"], summary["lost"]) == (90, 90, 100, 10)
    assert summary["frame_error_rate"] == pytest.approx(0.1)
    assert summary["received_bit_s"] == pytest.approx(0.9 * summary["sent_bit_s"])
    assert summary["remarks"] == []


@pytest.mark.slow
@pytest.mark.parametrize(
    ("frame", "intact", "remark"),
    [
        ({"counter_bits": 24}, 64, "agrees with time tags and prf_hz in 0 of 63 steps"),
        ({"counter_bits": 8}, 64, "the counter is 0 in all intact frames"),
        ({"header": "1acffc1d00"}, 0, "no frame is intact, of 64.0 expected from the SNR"),
    ],
)
def test_wrong_fields_of_a_frame_are_stated(tmp_path, capsys, frame, intact, remark):
    """Before, frames with a wrong length of the counter were intact without a remark, as the check sum covers both."""
    root = tmp_path / "campaign"
    own_campaign.write(root, constellation="qpsk", pulses=64, sidelink_db=25.0)
    edit_config(root, lambda config: config["waveform"]["codes"].update(frame={"header": "1acffc1d", **frame}))
    summary, text = printed(Campaign.load(root), capsys)
    assert (summary["intact"], summary["sent"]) == (intact, 64)
    assert remark in text
