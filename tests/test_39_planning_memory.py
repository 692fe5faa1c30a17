"""What a job needs of memory and disk, and what it is given."""

from dataclasses import replace

import pytest
from scenes import monostatic, plan, straight_track

from apertura.common.errors import CampaignError
from apertura.core.planning.plan import memory_limit
from apertura.stages.planning import check_fits


def test_a_job_that_does_not_fit_is_refused_with_the_numbers():
    planned = plan(shape=(20000, 20000))
    check_fits(planned, free_disk=planned.disk_bytes, where="f01/a-b", memory=planned.memory_bytes)
    with pytest.raises(CampaignError, match=r"f01/a-b: image formation requires .* of memory; expected at most 1.0 MB"):
        check_fits(planned, free_disk=None, where="f01/a-b", memory=1_000_000)
    with pytest.raises(CampaignError, match=r"the results require 30.4 GB on disk; expected at most 5.0 GB"):
        check_fits(planned, free_disk=5_000_000_000, where="f01/a-b", memory=planned.memory_bytes)


LONG = {"aperture": monostatic(straight_track(20_000, length_m=600)), "subcarriers": 128}


@pytest.mark.slow
def test_tables_that_outgrow_memory_are_made_in_blocks_of_pulses():
    """The fewest whose tables fit beside all else; with less than all else takes, the job is refused as before."""
    one = plan(**LONG)
    assert one.setting.pulse_blocks == one.choices["pulse_blocks"] == 1
    held = one.setting.table_bytes + 3 * 8 * 20_000 * 120  # tables, and samples while they are read
    beside = one.memory_bytes - held
    sums = 8 * 200 * 200  # the sum of blocks is held besides
    split = plan(**LONG, memory_bytes=beside + sums + held // 3 + 1)
    assert split.setting.pulse_blocks == split.choices["pulse_blocks"] == 3
    assert split.memory_bytes == beside + sums + held // 3
    assert split.predicted_seconds > one.predicted_seconds
    assert "are more than the" in split.reasons["pulse_blocks"]
    assert (
        replace(split.setting, pulse_blocks=1, form_seconds=one.setting.form_seconds) == one.setting
    )  # nothing else changes
    assert len(split.fallbacks) > 1
    assert all(setting.pulse_blocks > 1 for setting in split.fallbacks[:-1])  # finer tables outgrow it as well
    assert split.fallbacks[-1].pulse_blocks == 1
    check_fits(split, free_disk=None, where="f01/a-b", memory=split.memory_bytes)
    short = plan(**LONG, memory_bytes=beside // 2)
    with pytest.raises(CampaignError, match="imaging needs"):
        check_fits(short, free_disk=None, where="f01/a-b", memory=beside // 2)


@pytest.mark.slow
def test_a_long_flight_is_summed_in_blocks_whatever_memory_there_is():
    """Neither its samples nor its tables are ever in memory together, so three times the flight takes no more."""
    flights = [
        {**LONG, "aperture": monostatic(straight_track(count, length_m=count / 33))} for count in (10**5, 3 * 10**5)
    ]
    short, long = (plan(**flight, overrides={"presum": 1}) for flight in flights)
    assert long.setting.pulse_blocks == pytest.approx(3 * short.setting.pulse_blocks, rel=0.3)
    more = 200_000 * 500  # phase centres and axes of every pulse
    assert long.memory_bytes - more == pytest.approx(short.memory_bytes, rel=0.1)
    assert "more than the 536.9 MB" in long.reasons["pulse_blocks"]


@pytest.mark.slow
def test_pulse_blocks_can_be_asked_for_and_hold_64_pulses_or_more():
    assert plan(overrides={"pulse_blocks": 3}).setting.pulse_blocks == 3
    assert "requested" in plan(overrides={"pulse_blocks": 3}).reasons["pulse_blocks"]
    assert plan(overrides={"pulse_blocks": 100}).setting.pulse_blocks == 300 // 64


@pytest.mark.parametrize(
    ("listed", "limits", "limit"),
    [
        ("0::/slurm/job_7/step_0\n", {"slurm/job_7/memory.max": "4000000"}, 4_000_000),  # a parent's counts
        ("0::/slurm/job_7\n", {"memory.max": "max", "slurm/job_7/memory.max": "max"}, None),
        ("0::/elsewhere/outside\n", {"memory.max": "5000000"}, 5_000_000),  # a container sees its own as the root
        ("9:memory:/job\n4:cpu:/job\n0::/\n", {"memory/job/memory.limit_in_bytes": "6000000"}, 6_000_000),
        ("9:memory:/job\n", {"memory/memory.limit_in_bytes": "9223372036854771712"}, None),  # none, in version 1
    ],
)
def test_the_memory_of_a_job_is_that_of_its_control_group(listed, limits, limit, tmp_path):
    for name, text in limits.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text + "\n")
    groups = tmp_path / "groups"
    groups.write_text(listed)
    whole = memory_limit(groups=tmp_path / "none")
    assert memory_limit(groups=groups, root=tmp_path) == (limit or whole)
