"""Memory and disk required by a job, and the available memory."""

from dataclasses import replace

import pytest
from scenes import monostatic, plan, straight_track

from apertura.common.errors import CampaignError
from apertura.core.planning.plan import memory_limit
from apertura.stages.planning import check_fits


def test_job_that_exceeds_memory_or_disk_is_refused():
    planned = plan(shape=(20000, 20000))
    check_fits(planned, free_disk=planned.disk_bytes, where="f01/a-b", memory=planned.memory_bytes)
    with pytest.raises(CampaignError, match=r"f01/a-b: image formation requires .* of memory; expected at most 1.0 MB"):
        check_fits(planned, free_disk=None, where="f01/a-b", memory=1_000_000)
    with pytest.raises(CampaignError, match=r"the results require 30.4 GB on disk; expected at most 5.0 GB"):
        check_fits(planned, free_disk=5_000_000_000, where="f01/a-b", memory=planned.memory_bytes)


LONG = {"aperture": monostatic(straight_track(20_000, length_m=600)), "subcarriers": 128}


@pytest.mark.slow
def test_tables_that_exceed_memory_are_computed_in_pulse_blocks():
    """The fewest blocks whose tables fit are used; if memory is insufficient for the rest, the job is refused."""
    single_block = plan(**LONG)
    assert single_block.setting.pulse_blocks == single_block.choices["pulse_blocks"] == 1
    table_bytes = single_block.setting.table_bytes + 3 * 8 * 20_000 * 120  # tables, and samples during reading
    other_bytes = single_block.memory_bytes - table_bytes
    sum_bytes = 8 * 200 * 200  # additional sum of the blocks
    split = plan(**LONG, memory_bytes=other_bytes + sum_bytes + table_bytes // 3 + 1)
    assert split.setting.pulse_blocks == split.choices["pulse_blocks"] == 3
    assert split.memory_bytes == other_bytes + sum_bytes + table_bytes // 3
    assert split.predicted_seconds > single_block.predicted_seconds
    assert "exceed the memory limit of a block" in split.reasons["pulse_blocks"]
    # Nothing else changes.
    assert (
        replace(split.setting, pulse_blocks=1, form_seconds=single_block.setting.form_seconds) == single_block.setting
    )
    assert len(split.fallbacks) > 1
    assert all(setting.pulse_blocks > 1 for setting in split.fallbacks[:-1])  # finer tables also exceed memory
    assert split.fallbacks[-1].pulse_blocks == 1
    check_fits(split, free_disk=None, where="f01/a-b", memory=split.memory_bytes)
    short = plan(**LONG, memory_bytes=other_bytes // 2)
    with pytest.raises(CampaignError, match="image formation requires"):
        check_fits(short, free_disk=None, where="f01/a-b", memory=other_bytes // 2)


@pytest.mark.slow
def test_long_flight_is_summed_in_blocks_for_any_memory():
    """Samples and tables are never in memory as a whole; a flight of three times the length requires no more memory."""
    flights = [
        {**LONG, "aperture": monostatic(straight_track(count, length_m=count / 33))} for count in (10**5, 3 * 10**5)
    ]
    short, long = (plan(**flight, overrides={"presum": 1}) for flight in flights)
    assert long.setting.pulse_blocks == pytest.approx(3 * short.setting.pulse_blocks, rel=0.3)
    extra_bytes = 200_000 * 500  # phase centres and axes of every pulse
    assert long.memory_bytes - extra_bytes == pytest.approx(short.memory_bytes, rel=0.1)
    assert "exceed the memory limit of a block, 536.9 MB" in long.reasons["pulse_blocks"]


@pytest.mark.slow
def test_pulse_blocks_can_be_requested_and_have_64_pulses_or_more():
    assert plan(overrides={"pulse_blocks": 3}).setting.pulse_blocks == 3
    assert "requested" in plan(overrides={"pulse_blocks": 3}).reasons["pulse_blocks"]
    assert plan(overrides={"pulse_blocks": 100}).setting.pulse_blocks == 300 // 64


@pytest.mark.parametrize(
    ("listed", "limits", "limit"),
    [
        ("0::/slurm/job_7/step_0\n", {"slurm/job_7/memory.max": "4000000"}, 4_000_000),  # the limit of a parent applies
        ("0::/slurm/job_7\n", {"memory.max": "max", "slurm/job_7/memory.max": "max"}, None),
        ("0::/elsewhere/outside\n", {"memory.max": "5000000"}, 5_000_000),  # a container sees its own group as the root
        ("9:memory:/job\n4:cpu:/job\n0::/\n", {"memory/job/memory.limit_in_bytes": "6000000"}, 6_000_000),
        ("9:memory:/job\n", {"memory/memory.limit_in_bytes": "9223372036854771712"}, None),  # no limit, version 1
    ],
)
def test_memory_limit_is_that_of_the_control_group(listed, limits, limit, tmp_path):
    for name, text in limits.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text + "\n")
    groups = tmp_path / "groups"
    groups.write_text(listed)
    whole = memory_limit(groups=tmp_path / "none")
    assert memory_limit(groups=groups, root=tmp_path) == (limit or whole)
