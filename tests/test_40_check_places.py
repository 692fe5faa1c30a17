"""Check before a run: logs against recordings, scene against track, terrain, calibration, memory and disk."""

import re
import shutil

import numpy as np
import pytest
import rasterio
from folders import edit_config, edit_track
from rasterio.transform import from_origin

from apertura.campaign.folder import Campaign
from apertura.check import as_line, files, problems
from apertura.check.georeferencing import needles
from apertura.common.confined import ConfinedPath
from apertura.core.geometry.geodesy import projected_from_ecef
from apertura.methods.causes import mistaken_time
from apertura.simulation.presets import DEMO_ORIGIN
from apertura.stages.node_log import read_log

TX, RX = "raw/f01/uav1.track.csv", "raw/f01/uav2.track.pos"


def reported(root, **options):
    return [as_line(problem).replace(f"{root}/", "") for problem in problems(root, **options)]


def only(root):
    """Return the line of the only problem."""
    lines = reported(root)
    assert len(lines) == 1, lines
    return lines[0]


def state(root, section, **keys):
    edit_config(root, lambda document: document.setdefault(section, {}).update(keys))


def shift_times(root, seconds):
    """Shift the times of the CSV log."""

    def shifted(line):
        time, rest = line.split(",", 1)
        return f"{np.datetime64(time.rstrip('Z'), 'ns') + np.timedelta64(round(seconds * 1e9), 'ns')}Z,{rest}"

    edit_track(root, "uav1", lambda lines: [lines[0], *map(shifted, lines[1:])])


def edit_position(root, change, node="uav1"):
    """Change latitude, longitude and height in the log of a node."""
    separator, first = (",", 1) if node == "uav1" else (None, 2)

    def changed(line):
        cells = line.split(separator)
        if not cells[0][:1].isdigit():
            return line
        cells[first : first + 3] = map(str, change(*map(float, cells[first : first + 3])))
        return (separator or " ").join(cells)

    edit_track(root, node, lambda lines: list(map(changed, lines)))


def test_log_late_by_18_seconds_suggests_gpst_taken_for_utc(tiny):
    edit_track(tiny, "uav2", lambda lines: [line.replace("GPST", "UTC ") for line in lines])
    line = only(tiny)
    assert line.startswith(f"{RX}: the log starts 1")
    assert "pulses without a position; the times of log and recording differ by 18." in line
    assert " s (possible cause: GPST interpreted as UTC)" in line


@pytest.mark.parametrize(
    ("shift_s", "cause"),
    [
        (18.9, "GPST interpreted as UTC"),
        (-18.0, "UTC interpreted as GPST"),
        (36.1, "TAI interpreted as UTC"),
        (3600 * 9.5, "local time"),
        (5e5, "another day"),
        (400.0, ""),
    ],
)
def test_cause_of_a_time_shift_is_identified(shift_s, cause):
    assert cause in mistaken_time(shift_s)
    assert bool(mistaken_time(shift_s)) is bool(cause)


def test_log_that_ends_before_the_last_pulse_is_reported(tiny):
    shift_times(tiny, -1.9)
    assert reported(tiny) == []
    shift_times(tiny, -0.2)
    line = only(tiny)
    assert line.startswith(f"{TX}: the log ends 0.")
    assert "of 40 pulses without a position; expected a log that covers the pulses" in line


def test_poor_solutions_at_the_end_of_a_log_are_no_problem(tiny):
    def single(lines):  # the echo step excludes the pulses after the last fixed solution and raises a flag
        cut = [line for line in lines if line.startswith("%") or line.split()[1] < "09:30:19"]
        return [*cut[:-3], *(line.replace("   1  18", "   5  18") for line in cut[-3:])]

    edit_track(tiny, "uav2", single)
    assert reported(tiny) == []
    edit_track(tiny, "uav2", lambda lines: [line.replace("   5  18", "   1  18") for line in lines])
    assert only(tiny).startswith(f"{RX}: the log ends ")


def test_poor_solutions_during_pulses_are_reported_unless_allowed(tiny):
    def single(lines, first):
        late = [not line.startswith("%") and line.split()[1] > first for line in lines]
        return [line.replace("   1  18", "   2  18") if out else line for line, out in zip(lines, late, strict=True)]

    edit_track(tiny, "uav2", lambda lines: single(lines, "09:30:19"))  # pulses from 09:30:18 to 09:30:20 GPST
    assert reported(tiny) == []
    edit_track(tiny, "uav2", lambda lines: single(lines, "09:30:17"))
    assert "epochs during the pulses have a solution poorer than fix" in only(tiny)
    edit_config(tiny, lambda document: document["nodes"]["uav2"].update(worst_fix="float"))
    assert reported(tiny) == []


def test_unreadable_log_is_reported_by_its_reader(tiny):
    edit_track(tiny, "uav1", lambda lines: [*lines[:10], lines[9], *lines[10:]])
    assert "is equal to that of the previous epoch" in only(tiny)


def test_epoch_without_position_is_dropped_from_the_log(tiny):
    edit_track(tiny, "uav1", lambda lines: [*lines[:30], zero(lines[30]), *lines[31:]])
    assert reported(tiny) == []
    track = read_log(Campaign.load(tiny), "f01", "uav1")
    assert track.sizes["epoch"] == 60
    assert track.attrs["dropped"] == {"no fix": 1}


@pytest.mark.parametrize(("epoch", "time"), [(1, "09:29:30"), (-1, "09:30:30")])
def test_epochs_without_position_far_from_the_pulses_are_not_reported(tiny, epoch, time):
    def with_zero_epoch(lines):
        lines[epoch] = zero(f"2025-05-14T{time}.000000Z,{lines[epoch].split(',', 1)[1]}")
        return lines

    edit_track(tiny, "uav1", with_zero_epoch)
    assert reported(tiny) == []


def zero(line):
    time, _, _, rest = line.split(",", 3)
    return f"{time},0.0,0.0,{rest}"


def test_log_without_heights_is_reported(tiny):
    edit_position(tiny, lambda latitude, longitude, _: (latitude, longitude, 0.0))
    lines = reported(tiny)
    assert lines[0].startswith(f"{TX}: height 0 at every epoch")


def test_supersonic_median_speed_is_reported(tiny):
    edit_config(tiny, lambda document: document["scene"].update(bounds_m="auto"))
    for stretched, is_reported in ((500, False), (3, True)):  # the original speed is half a metre per second
        edit_position(tiny, lambda latitude, *rest, by=stretched: (48.4226 + by * (latitude - 48.4226), *rest))
        assert any(line.startswith(f"{TX}: a median speed of") for line in reported(tiny)) is is_reported


def test_missing_attitude_is_reported_if_a_lever_arm_needs_it(tiny):
    edit_track(tiny, "uav1", lambda lines: [",".join(line.split(",")[:4]) for line in lines])
    line = only(tiny)
    assert line.startswith(f"{TX}: no roll, pitch and yaw")
    assert "nodes.uav1.attitude is log" in line
    edit_config(tiny, lambda document: document["nodes"]["uav1"].update(lever_arms_m={}))
    assert reported(tiny) == []


def test_nodes_without_line_of_sight_are_reported(tiny):
    edit_position(tiny, lambda latitude, longitude, up: (longitude, latitude, up), node="uav2")
    lines = reported(tiny)
    assert f"{RX}: the track is 5393 km from the track of uav1: latitude 9.95" in "\n".join(lines)
    assert "expected nodes in line of sight" in "\n".join(lines)


@pytest.mark.quick("*swapped in the logs.", "*check the heights*")
@pytest.mark.parametrize(
    ("change", "remedy"),
    [
        (lambda lat, lon, up: (lon, lat, up), "Check if latitude and longitude are swapped in the logs."),
        (lambda lat, lon, up: (lat, -lon, up), "Check the sign of longitude in the logs"),
        (lambda lat, lon, up: (-lat, lon, up), "Check the sign of latitude in the logs"),
        (lambda lat, lon, up: (np.radians(lat), np.radians(lon), up), "Check if the logs are in radians."),
        (
            lambda lat, lon, up: (lat, lon, up / 0.3048),
            "m above the terrain: check the heights in the logs (metres, not feet",
        ),
    ],
)
def test_logs_far_from_the_scene_are_reported_with_the_likely_cause(tiny, change, remedy):
    for node in ("uav1", "uav2"):
        edit_position(tiny, change, node=node)
    line = only(tiny)
    assert "from the track of f01 uav1-uav1, uav1-uav2: the shortest total path is" in line
    assert remedy in line


def bounds_of(root):
    bounds_m = []
    edit_config(root, lambda document: bounds_m.extend(document["scene"]["bounds_m"]))
    return bounds_m


def test_scene_in_the_neighbouring_zone_is_reported_with_distance(tiny):
    state(tiny, "scene", crs="EPSG:32633")
    line = only(tiny)
    assert "the scene is 444 km from the track" in line
    assert "Check if scene.crs should be EPSG:32632, the UTM zone of the track, instead of EPSG:32633." in line


def test_bounds_in_degrees_are_recognised(tiny):
    state(tiny, "scene", bounds_m=[9.9545, 48.4225, 9.9555, 48.4235], spacing_m=0.0001)
    assert "The bounds appear to be in degrees: set scene.bounds_m in metres in EPSG:32632." in only(tiny)
    state(tiny, "scene", crs="EPSG:25832")
    line = only(tiny)
    found = "bounds_m [9.9545, 48.4225, 9.9555, 48.4235] lie outside the area of use of"
    assert line.startswith(f"config/config.yaml: scene.bounds_m: {found}")
    assert "The bounds appear to be in degrees" in line


def test_bounds_with_northing_first_are_recognised(tiny):
    xmin, ymin, xmax, ymax = bounds_of(tiny)
    state(tiny, "scene", bounds_m=[ymin, xmin, ymax, xmax])
    assert "easting before northing" in only(tiny)


def test_scene_is_too_far_if_all_echoes_arrive_after_the_prefix(tiny):
    xmin, ymin, xmax, ymax = bounds_of(tiny)
    for north_m, far in ((90.0, False), (130.0, True)):  # 234 m of total path
        state(tiny, "scene", bounds_m=[xmin, ymin + north_m, xmax, ymax + north_m])
        assert bool(reported(tiny)) is far
    state(tiny, "waveform", cyclic_prefix_s=1.4e-6)
    assert reported(tiny) == []


@pytest.mark.parametrize(
    ("crs", "found"),
    [
        ("EPSG:4326", "EPSG:4326 (WGS 84) is in degrees"),
        ("EPSG:2225", "is in US survey foot"),
        ("EPSG:4978", "EPSG:4978 (WGS 84) is not projected"),
        ("EPSG:99999", "'EPSG:99999' is unknown to PROJ"),
        ("local", "CRS local with positions on Earth, in latitude and longitude"),
    ],
)
def test_crs_must_be_projected_in_metres(tiny, crs, found):
    state(tiny, "scene", crs=crs)
    line = only(tiny)
    assert line.startswith("config/config.yaml: scene.crs: ")
    assert found in line
    if crs in {"EPSG:4326", "EPSG:2225", "EPSG:4978"}:
        assert "Set scene.crs to EPSG:32632 and scene.bounds_m to metres in this CRS" in line


def test_track_outside_area_of_use_is_reported_with_automatic_bounds(tiny):
    state(tiny, "scene", crs="EPSG:32633", bounds_m="auto")  # 2° outside the zone is tolerated
    assert reported(tiny) == []
    state(tiny, "scene", crs="EPSG:32635")
    assert "the track lies outside the area of use of EPSG:32635 (WGS 84 / UTM zone 35N)" in only(tiny)


@pytest.mark.quick("{'crs': 'auto', 'bounds_m': 'auto', 'spacing_m': 'auto'}", "{'crs': 'EPSG:25832'}")
@pytest.mark.parametrize(
    "keys",
    [
        {"crs": "auto"},
        {"crs": "auto", "bounds_m": "auto", "spacing_m": "auto"},
        {"bounds_m": "auto"},
        {"spacing_m": "auto"},
        {"crs": "EPSG:25832"},
    ],
    ids=str,
)
def test_automatic_settings_and_equivalent_crs_are_accepted(tiny, keys):
    state(tiny, "scene", **keys)
    assert reported(tiny) == []


@pytest.mark.slow
def test_gotcha_is_accepted_only_in_its_local_frame(shared, tmp_path):
    (tmp_path / "config").mkdir()
    (tmp_path / "raw/f01").mkdir(parents=True)
    for number, file in enumerate(sorted((shared / "gotcha_afrl").glob("*.mat"))):
        shutil.copyfile(file, tmp_path / f"raw/f01/radar.{number}.mat")
    config = (
        "campaign: gotcha\nwaveform: {kind: phase_history, format: afrl_mat}\nnodes: {radar: {}}\n"
        "scene: {crs: local, bounds_m: [-50, -50, 50, 50], spacing_m: 0.2}\n"
    )
    (tmp_path / "config/config.yaml").write_text(config)
    (tmp_path / "config/flights.tsv").write_text("flight\tkind\ttransmitter\tnodes\nf01\timage\tradar\tradar\n")
    assert reported(tmp_path) == []
    state(tmp_path, "scene", crs="EPSG:32616")
    assert "CRS EPSG:32616 with positions in metres of a local frame; expected local" in only(tmp_path)


def test_track_must_be_above_the_terrain(tiny):
    state(tiny, "scene", height_m=624.0)
    assert reported(tiny) == []
    state(tiny, "scene", height_m=626.0)
    line = only(tiny)
    assert line.startswith(
        "config/config.yaml: scene.height_m: flight f01, uav1, uav2: median height above the terrain -1."
    )
    assert "which may refer to the geoid" in line


def test_track_more_than_30_km_above_the_terrain_is_reported(tiny):
    for height_m, high in ((-29_000.0, False), (-30_000.0, True)):
        state(tiny, "scene", height_m=height_m)
        lines = reported(tiny)
        assert any("m above the terrain: check the heights in the logs" in line for line in lines)  # no echo comes back
        assert any("expected a node at most 30 km above the terrain" in line for line in lines) is high


def write_dem(root, heights, *, post_m=1.0, east_m=0.0):
    """Write a DEM with heights (row, column), centred on the scene, and configure it."""
    east, north, _ = projected_from_ecef("EPSG:32632", DEMO_ORIGIN.ecef(np.zeros(3)))
    rows, columns = heights.shape
    transform = from_origin(east + east_m - columns * post_m / 2, north + rows * post_m / 2, post_m, post_m)
    profile = {"width": columns, "height": rows, "count": 1, "dtype": "float64", "crs": "EPSG:32632"}
    with rasterio.open(root / "dem.tif", "w", "GTiff", transform=transform, **profile) as raster:
        raster.write(heights, 1)
    state(root, "scene", dem="dem.tif", dem_datum="ellipsoid")


FLAT = np.full((60, 60), 600.0)


def with_post(height_m, row=30, column=30):
    return np.where((np.arange(60)[:, None] == row) & (np.arange(60) == column), height_m, FLAT)


@pytest.mark.quick("flat", "cliff", "spike")
@pytest.mark.parametrize(
    ("heights", "spike"),
    [
        (FLAT, False),
        (FLAT + 500.0 * (np.arange(60) > 30) - 490, False),  # a cliff through the scene
        (with_post(1050.0), False),
        (with_post(3600.0), True),
        (with_post(-400.0), True),
        (with_post(3600.0, row=5), False),
        (with_post(3600.0, row=25), False),  # two metres outside the scene
    ],
    ids=["flat", "cliff", "mast", "spike", "pit", "far outside", "just outside"],
)
def test_dem_spike_of_kilometres_is_reported_and_a_cliff_is_not(tiny, heights, spike):
    write_dem(tiny, heights)
    lines = [line for line in reported(tiny) if "are such spikes" in line]
    assert bool(lines) is spike
    assert all(
        line.startswith("dem.tif: ") and "where the median height of the surroundings is 600 m" in line
        for line in lines
    )


def test_needles_are_narrow_and_taller_than_the_threshold():
    x, y = np.meshgrid(np.arange(80.0), np.arange(80.0))
    rough = 1000 * np.abs(x - 40) / 40 + 400 * np.sin(x / 9) * np.cos(y / 7) + 3000.0 * (y > x)  # hills and a cliff
    assert not needles(rough, taller_than_m=500.0).any()
    for width, is_needle in ((1, True), (5, True), (8, False)):
        spiked = rough * 0
        spiked[40 : 40 + width, 40 : 40 + width] = 600.0
        assert needles(spiked, taller_than_m=500.0).any() == is_needle
        assert not needles(spiked, taller_than_m=601.0).any()
    spiked[:] = np.where(x < 2, 3000.0, 0.0)  # a cliff at the edge of the DEM
    assert not needles(spiked, taller_than_m=500.0).any()


def test_dem_that_covers_part_of_the_scene_is_reported(tiny):
    write_dem(tiny, FLAT, east_m=28.0)
    assert "% of the scene lies outside the DEM, to the west" in only(tiny)


def test_impossible_heights_are_reported_only_within_the_scene(tiny):
    write_dem(tiny, with_post(-32767.0, row=25))  # 5 m north of the centre of a scene of 6 m
    assert reported(tiny) == []
    write_dem(tiny, with_post(-32767.0))
    assert "have impossible heights" in only(tiny)


def test_track_below_the_dem_is_reported(tiny):
    write_dem(tiny, FLAT + 27)
    edit_position(tiny, lambda *place: (DEMO_ORIGIN.latitude_deg, DEMO_ORIGIN.longitude_deg, place[2]))
    still, below = reported(tiny)  # constant position: no aperture either
    assert "no aperture" in still
    assert below.startswith("config/config.yaml: scene.dem: flight f01, uav1: median height above the terrain -2.")


def test_unreadable_dem_is_reported(tiny):
    write_dem(tiny, FLAT)
    (tiny / "dem.tif").write_bytes(b"no raster")
    assert "dem.tif: not readable" in only(tiny)


CALIBRATION = {"flight": "c01", "reflector_m": [570660.0, 5363700.0, 620.0]}


def add_calibration_flight(root, kind="calibration", nodes="uav1,uav2"):
    shutil.copytree(root / "raw/f01", root / "raw/c01")
    lines = f"f01\timage\tuav1\tuav1,uav2\nc01\t{kind}\tuav1\t{nodes}\n"
    (root / "config/flights.tsv").write_text(f"flight\tkind\ttransmitter\tnodes\n{lines}")


def test_calibration_flight_must_cover_every_pair(tiny):
    add_calibration_flight(tiny)
    assert "no section calibration" in only(tiny)
    edit_config(tiny, lambda document: document.update(calibration=CALIBRATION))
    assert reported(tiny) == []
    flights_template = (tiny / "config/flights.tsv").read_text().replace("c01\tcalibration\tuav1\tuav1,uav2", "{}")
    (tiny / "config/flights.tsv").write_text(flights_template.format("c01\tcalibration\tuav1\tuav1"))
    assert "flight f01 has pairs uav1-uav2, which are not calibrated by c01" in only(tiny)
    (tiny / "config/flights.tsv").write_text(flights_template.format("c01\timage\tuav1\tuav1,uav2"))
    assert "calibration.flight: flight c01 is of kind image" in only(tiny)
    (tiny / "config/flights.tsv").write_text(flights_template.replace("{}\n", ""))
    assert "calibration.flight: flight c01 is not in the table" in only(tiny)


def test_reflector_out_of_range_is_reported(tiny):
    add_calibration_flight(tiny)
    swapped = CALIBRATION | {"reflector_m": [5363700.0, 570660.0, 620.0]}
    edit_config(tiny, lambda document: document.update(calibration=swapped))
    line = only(tiny)
    assert line.startswith("config/config.yaml: calibration.reflector_m: reflector [5363700.0, 570660.0, 620.0] is ")
    state(tiny, "scene", crs="EPSG:99999")
    assert "unknown to PROJ" in only(tiny)


def test_invalid_beam_pattern_is_reported(tiny):
    (tiny / "config/horn.csv").write_text("cut,angle_deg,gain_db\nazimuth,0,0\n")
    antenna = {"boresight_deg": [90, -20], "pattern": "config/horn.csv"}
    edit_config(tiny, lambda document: document["nodes"]["uav1"].update(antennas={"radar_rx": antenna}))
    assert only(tiny).startswith("config/horn.csv: ")


def enlarge(root, size):
    """Enlarge a recording as a sparse file, whose last capture becomes longer."""
    with (root / "raw/f01/uav1.sigmf-data").open("r+b") as stream:
        stream.truncate(size)


def test_memory_check_counts_metadata_of_captures_and_no_samples(tiny, monkeypatch):
    enlarge(tiny, 4_000_000_000)
    monkeypatch.setattr(files, "free_memory", lambda: 400_000_000)
    assert reported(tiny, without=["disk"]) == []
    monkeypatch.setattr(files, "_CAPTURE_BYTES", 400_000_000)
    line = reported(tiny, without=["disk"])
    assert re.search(r"\d+ captures of uav\d in f01 need at least .* GB of memory; expected at most 0.4 GB", line[0])
    assert reported(tiny, without=["disk", "memory"]) == []


def test_free_memory_is_read_from_meminfo_with_swap(tmp_path):
    (tmp_path / "meminfo").write_text("MemTotal: 9 kB\nMemAvailable:    1000 kB\nSwapFree:  24 kB\n")
    assert files.free_memory(tmp_path / "meminfo") == 1024 * 1024


def test_disk_must_hold_the_results_still_to_be_written(tiny, monkeypatch):
    enlarge(tiny, 400_000_000)  # samples are not copied into the results
    free = {"bytes": 400_000_000}
    monkeypatch.setattr(ConfinedPath, "free_bytes", lambda _: free["bytes"])
    assert reported(tiny) == []
    free["bytes"] = 1_000
    line = only(tiny)
    assert re.search(r"results need at least \d+ MB \(.*echo \d+ MB", line)
    assert "expected at most 0 MB, the free disk space" in line


@pytest.mark.parametrize(("unit", "refused"), [("degrees", False), ("radians", True)])
def test_attitude_in_radians_is_refused_if_a_lever_arm_needs_it(tiny, unit, refused):
    """On a circle of 10 m, yaw follows the course over 360° only if the angles are in radians."""

    def circle(lines):
        header, *rows = lines
        rows_of_circle = []
        for number, row in enumerate(rows):
            time, latitude, longitude, height, *_ = row.split(",")
            angle = 360 * number / len(rows)
            north, east = 10 * np.sin(np.radians(angle)), -10 * np.cos(np.radians(angle))
            position = float(latitude) + north / 111_200, float(longitude) + east / 73_900
            angles = np.array([1.0, -4.0, angle])
            angles = np.radians(angles) if unit == "radians" else angles
            rows_of_circle.append(
                ",".join([time, *(f"{x:.9f}" for x in position), height, *(f"{x:.4f}" for x in angles)])
            )
        return [header, *rows_of_circle]

    edit_track(tiny, "uav1", circle)
    lines = reported(tiny)
    assert (
        any(
            line.startswith(f"{TX}: attitude angles appear to be in radians: with this convention, yaw")
            for line in lines
        )
        is refused
    )
    edit_config(tiny, lambda document: document["nodes"]["uav1"].update(lever_arms_m={}))
    assert not any("attitude" in line for line in reported(tiny))
