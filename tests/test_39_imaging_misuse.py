"""Misuse of the Python functions: refused with one message, or the image has a flag or a verdict."""

import json
from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from scenes import TARGET, TARGET_GRID, point_history

import apertura as ap
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.errors import CampaignError
from apertura.core.antenna.beam import Beam, Beams

HISTORY = point_history()
SQUARE = point_history(200)
APERTURE, ECHO, FREQUENCY = HISTORY.aperture, HISTORY.transfer, HISTORY.frequency_hz
PROFILES = ap.range_compress(HISTORY, TARGET_GRID, ap.FlatGround(0.0))


def of(**fields):
    return lambda: replace(HISTORY, **fields)


def profiles(**fields):
    return lambda: replace(PROFILES, **fields)


def flown(tx_m=APERTURE.tx_m, rx_m=APERTURE.rx_m):
    return lambda: replace(HISTORY, aperture=ap.Aperture(tx_m, rx_m))


def echo_of(path_m, **fields):
    echo = np.exp(-2j * np.pi * FREQUENCY * path_m[:, None] / SPEED_OF_LIGHT_M_S)
    return of(transfer=echo.astype(np.complex64), **fields)


def uniform_beam(pulses):
    """Return a beam of uniform gain for a number of pulses."""
    angle = np.linspace(-3, 3, 9)
    return Beams(transmit=Beam(np.tile(np.eye(3), (pulses, 1, 1)), angle, np.ones(9), angle, np.ones(9)))


PATH_M = APERTURE.path(TARGET)[:, 0]
ALONG = np.linspace(-1, 1, len(HISTORY))[:, None]
WRONG_TRACK = 0.05 * np.random.default_rng(1).standard_normal((len(HISTORY), 3))

REFUSED = {
    "GHz": (of(frequency_hz=FREQUENCY / 1e9), {}, "values are in GHz"),
    "MHz": (of(frequency_hz=FREQUENCY / 1e6), {}, "values are in MHz"),
    "frequencies negative": (of(frequency_hz=-FREQUENCY), {}, "in Hz"),
    "frequencies NaN": (of(frequency_hz=np.full(200, np.nan)), {}, "in Hz"),
    "frequencies falling": (of(frequency_hz=FREQUENCY[::-1].copy()), {}, "ascending in equal steps"),
    "frequencies from zero": (of(frequency_hz=FREQUENCY - FREQUENCY[0]), {}, "in Hz"),
    "frequencies uneven": (of(frequency_hz=FREQUENCY**2 / FREQUENCY[0]), {}, "ascending in equal steps"),
    "one frequency": (
        lambda: ap.PhaseHistory(ECHO[:, :1], FREQUENCY[:1], np.ones(1), np.zeros(96), APERTURE),
        {},
        "two or more",
    ),
    "carrier alone": (of(frequency_hz=1.2e9), {}, r"frequency_hz \(\)"),
    "weights zero": (of(weight=np.zeros(200)), {}, "at least one positive weight"),
    "weights negative": (of(weight=np.linspace(-1, 1, 200)), {}, "no negative weight"),
    "weights NaN": (of(weight=np.full(200, np.nan)), {}, "not finite"),
    "weights by pulse": (of(weight=np.ones(96)), {}, r"weight \(96,\)"),
    "delay a scalar": (of(reference_delay_s=0.0), {}, r"reference_delay_s \(\)"),
    "delay NaN": (of(reference_delay_s=np.full(96, np.nan)), {}, "not finite"),
    "delay in ns": (of(reference_delay_s=np.full(96, 150.0)), {}, "seconds"),
    "transposed": (of(transfer=ECHO.T), {}, "Transpose"),
    "transfer flat": (of(transfer=ECHO.ravel()), {}, r"transfer \(19200,\)"),
    "transfer a string": (of(transfer="echo.npy"), {}, "complex numbers"),
    "transfer None": (of(transfer=None), {}, "complex numbers"),
    "transfer of objects": (of(transfer=np.array([["a"] * 200] * 96)), {}, "complex numbers"),
    "transfer NaN": (of(transfer=np.full_like(ECHO, np.nan)), {}, "96 of 96 pulses"),
    "transfer zero": (of(transfer=np.zeros_like(ECHO)), {}, "all samples are zero"),
    "real samples": (of(transfer=np.abs(ECHO)), {}, "complex"),
    "fewer pulses": (of(transfer=ECHO[:95]), {}, "aperture of 96 pulses"),
    "no pulses": (lambda: HISTORY[:0], {}, "no pulses"),
    "aperture an array": (of(aperture=APERTURE.tx_m), {}, "Create an aperture with Aperture"),
    "aperture None": (of(aperture=None), {}, "Create an aperture with Aperture"),
    "track of one position": (lambda: ap.Aperture([0.0, 0, 9], [0.0, 0, 9]), {}, "one row of x, y and z per pulse"),
    "track transposed": (lambda: ap.Aperture(APERTURE.tx_m.T, APERTURE.rx_m.T), {}, "one row of x, y and z per pulse"),
    "track in two dimensions": (flown(APERTURE.tx_m[:, :2], APERTURE.rx_m[:, :2]), {}, "x, y and z"),
    "track a string": (lambda: ap.Aperture("track.csv", "track.csv"), {}, "real numbers"),
    "track None": (lambda: ap.Aperture(APERTURE.tx_m, None), {}, "real numbers"),
    "track complex": (flown(APERTURE.tx_m * 1j), {}, "real"),
    "track NaN": (flown(APERTURE.tx_m + np.nan), {}, "phase centres are not finite"),
    "track in mm": (flown(APERTURE.tx_m * 1e3, APERTURE.rx_m * 1e3), {}, "no echo of the scene|below the ground"),
    "track of another frame": (flown(APERTURE.tx_m + 5e6, APERTURE.rx_m + 5e6), {}, "no echo of the scene"),
    "track below the terrain": (flown(-APERTURE.tx_m, -APERTURE.rx_m), {}, "at or below the terrain"),
    "speed of sound": (of(wave_speed_m_s=343.0), {}, "light"),
    "speed in km/s": (of(wave_speed_m_s=299792.458), {}, "light"),
    "speed a string": (of(wave_speed_m_s="air"), {}, "light"),
    "an array for the echo": (lambda: ECHO, {}, "expected PhaseHistory"),
    "a path for the echo": (lambda: "results/f01", {}, "expected PhaseHistory"),
    "another dataset": (lambda: xr.Dataset({"image": ("x", [1.0])}), {}, "a dataset of stage echo"),
    "grid of bounds": (lambda: HISTORY, {"grid": (-4, -4, 4, 4)}, "a SceneGrid"),
    "grid None": (lambda: HISTORY, {"grid": None}, "a SceneGrid"),
    "grid in degrees": (lambda: HISTORY, {"grid": lambda: ap.SceneGrid("EPSG:4326", 5, 5, 0.5, (9, 9))}, "in metres"),
    "grid unknown": (lambda: HISTORY, {"grid": lambda: ap.SceneGrid("UTM32", 5e5, 5e6, 0.5, (9, 9))}, "UTM32"),
    "grid spacing zero": (lambda: HISTORY, {"grid": lambda: ap.SceneGrid("local", 0, 0, 0.0, (9, 9))}, "spacing_m"),
    "grid of one side": (
        lambda: HISTORY,
        {"grid": lambda: ap.SceneGrid("local", 0.0, 0.0, 0.1, 9)},
        "rows and columns",
    ),
    "grid of half pixels": (
        lambda: HISTORY,
        {"grid": lambda: ap.SceneGrid("local", 0.0, 0.0, 0.1, (9.5, 9.5))},
        "rows and columns",
    ),
    "terrain a path": (lambda: HISTORY, {"terrain": "dem.tif"}, "open_dem"),
    "terrain heights alone": (lambda: HISTORY, {"terrain": np.zeros((160, 160))}, "open_dem|a height"),
    "terrain NaN": (lambda: HISTORY, {"terrain": np.nan}, "a finite number of metres"),
    "terrain above the antennas": (lambda: HISTORY, {"terrain": 15.0}, "at or below the terrain"),
    "accuracy positive": (lambda: HISTORY, {"accuracy_db": 60.0}, "accuracy_db"),
    "accuracy a string": (lambda: HISTORY, {"accuracy_db": "high"}, "accuracy_db"),
    "accuracy None": (lambda: HISTORY, {"accuracy_db": None}, "accuracy_db"),
    "engine unknown": (lambda: HISTORY, {"engine": "gpu"}, "unknown engine"),
    "engine None": (lambda: HISTORY, {"engine": None}, "engine"),
    "option unknown": (lambda: HISTORY, {"engine_options": {"native": {"degree": 99}}}, "engine_options.native.degree"),
    "beams a number": (lambda: HISTORY, {"beams": 30.0}, "Beams"),
    "beams of other pulses": (
        lambda: HISTORY,
        {"beams": lambda: uniform_beam(50)},
        "50 pulses",
    ),
    "atmosphere dry": (lambda: HISTORY, {"atmosphere": "dry"}, "atmosphere"),
    "atmosphere an index": (lambda: HISTORY, {"atmosphere": [1.0003]}, "atmosphere"),
    "calibration a string": (lambda: HISTORY, {"calibration": "auto"}, "calibration"),
    "calibration negative": (lambda: HISTORY, {"calibration": -1.0}, "calibration"),
    "track in half precision": (flown(APERTURE.tx_m.astype(np.float16)), {}, "float16, in which adjacent numbers"),
    "track with a mask": (
        lambda: ap.Aperture(np.ma.masked_equal(APERTURE.tx_m, APERTURE.tx_m[5, 0]), APERTURE.rx_m),
        {},
        "1 masked values",
    ),
    "no subcarriers": (
        lambda: ap.PhaseHistory(ECHO[:, :0], FREQUENCY[:0], np.ones(0), np.zeros(96), APERTURE),
        {},
        "no subcarrier",
    ),
    "pixels a boolean": (lambda: HISTORY, {"certified_pixels": True}, "certified_pixels"),
    "pixels too many": (lambda: HISTORY, {"certified_pixels": 10**12}, "0 to 1000000"),
    "pixels negative": (lambda: HISTORY, {"certified_pixels": -1}, "certified_pixels"),
    "pixels a string": (lambda: HISTORY, {"certified_pixels": "all"}, "certified_pixels"),
    "judge a string": (lambda: HISTORY, {"judge": "later"}, "judge"),
    "integration unknown": (lambda: HISTORY, {"integration": {"metres": 3}}, "integration"),
    "tile not a multiple of the patch": (lambda: HISTORY, {"tile_px": 100}, "tile_px"),
    "presum zero": (lambda: HISTORY, {"presum": 0}, "presum"),
    "window unknown": (lambda: HISTORY, {"window": "hamming"}, "window"),
    "carrier of profiles in GHz": (profiles(centre_frequency_hz=1.2), {}, "values are in GHz"),
    "step of profiles zero": (profiles(step_m=0.0), {}, "step_m"),
    "step of profiles a string": (profiles(step_m="5 cm"), {}, "step_m"),
    "profiles undersampled": (profiles(oversampling=0.5), {}, "oversampling"),
    "profiles NaN": (profiles(samples=np.full_like(PROFILES.samples, np.nan)), {}, "pulses are not finite"),
    "starts NaN": (profiles(start_m=np.full(96, np.nan)), {}, "not finite"),
    "starts of other pulses": (profiles(start_m=PROFILES.start_m[:50]), {}, r"start_m \(50,\)"),
    "echo in the time domain": (of(transfer=np.fft.ifft(ECHO, axis=1).astype(np.complex64)), {}, "numpy.fft.fft"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_invalid_arguments_are_refused_in_one_line(name):
    make_input, options, complaint = REFUSED[name]

    def form():
        arguments = {key: value() if callable(value) else value for key, value in options.items()}
        return ap.backproject(make_input(), arguments.pop("grid", TARGET_GRID), **arguments)

    with pytest.raises(CampaignError, match=complaint) as raised:
        form()
    assert "\n" not in str(raised.value)
    assert "self." not in str(raised.value)


FLAGGED = {
    "conjugated": (of(transfer=ECHO.conj()), "echo_outside_scene"),
    "I and Q swapped": (of(transfer=(ECHO.imag + 1j * ECHO.real).astype(np.complex64)), "echo_outside_scene"),
    "paths one way": (echo_of(PATH_M / 2), "echo_outside_scene"),
    "paths twice": (echo_of(2 * PATH_M), "echo_outside_scene"),
    "square array transposed": (lambda: replace(SQUARE, transfer=SQUARE.transfer.T.copy()), "echo_outside_scene"),
    "subcarriers backwards": (of(transfer=ECHO[:, ::-1].copy()), "echo_outside_scene"),
    "delay of the other sign": (echo_of(PATH_M - 30, reference_delay_s=np.full(96, -1e-7)), "echo_outside_scene"),
    "delay removed twice": (echo_of(PATH_M - 30, reference_delay_s=np.full(96, 2e-7)), "echo_outside_scene"),
    "carrier 10 % off": (of(frequency_hz=FREQUENCY + 1.2e8), "defocused"),
    "band twice as wide": (of(frequency_hz=FREQUENCY[0] + 2 * (FREQUENCY - FREQUENCY[0])), "echo_outside_scene"),
    "track 5 cm wrong at random": (flown(APERTURE.tx_m + WRONG_TRACK, APERTURE.rx_m + WRONG_TRACK), "defocused"),
    "track nine pulses late": (flown(np.roll(APERTURE.tx_m, 9, 0), np.roll(APERTURE.rx_m, 9, 0)), None),
    "track half as long": (
        flown(APERTURE.tx_m * [0.5, 1, 1], APERTURE.rx_m * [0.5, 1, 1]),
        "defocused",
    ),
    "conjugated profiles": (profiles(samples=PROFILES.samples.conj()), "defocused"),
    "power for amplitude": (profiles(samples=np.abs(PROFILES.samples).astype(np.complex64) ** 2), None),
    "starts of one-way paths": (profiles(start_m=PROFILES.start_m / 2), None),
    "starts in km": (profiles(start_m=PROFILES.start_m / 1e3), "scene_beyond_samples"),
    "pulses shuffled": (of(transfer=np.random.default_rng(2).permutation(ECHO)), None),
    "step of one-way paths": (profiles(step_m=PROFILES.step_m / 2), None),
}


@pytest.mark.quick("conjugated", "track 5 cm wrong at random", "starts in km")
@pytest.mark.parametrize("name", FLAGGED)
def test_plausible_but_wrong_input_is_flagged(name):
    make_input, flag = FLAGGED[name]
    image = ap.backproject(make_input(), TARGET_GRID)
    flags = json.loads(image.attrs["flags"])
    assert flags, image.attrs["verdict"]
    assert flag is None or flag in flags


@pytest.mark.slow
def test_conjugated_samples_are_identified():
    for name in ("conjugated", "I and Q swapped", "conjugated profiles"):
        (line,) = json.loads(ap.backproject(FLAGGED[name][0](), TARGET_GRID).attrs["flags"]).values()
        assert "I and Q are swapped" in line
        assert "conjugate the samples" in line
    for name in ("paths one way", "square array transposed", "track half as long"):
        assert "I and Q" not in ap.backproject(FLAGGED[name][0](), TARGET_GRID).attrs["flags"]


def test_ambiguous_spectrum_gives_no_verdict():
    """Swapped halves of the spectrum give two peaks in range, which cannot be distinguished from two targets."""
    swapped = replace(HISTORY, transfer=np.fft.fftshift(ECHO, axes=1))
    assert ap.backproject(swapped, TARGET_GRID).attrs["verdict"] == "inconclusive"


def test_correct_image_is_focused_without_a_flag():
    for inputs in (HISTORY, PROFILES):
        attributes = ap.backproject(inputs, TARGET_GRID).attrs
        assert (attributes["verdict"], attributes["flags"]) == ("focused", "{}")


def test_outside_echo_is_not_flagged_if_the_scene_has_points():
    """The sidelobes of a house that is 30 dB brighter and 40 m farther than the target are weaker than the target."""
    window = np.hanning(202)[1:-1]
    house = 30 * np.exp(-2j * np.pi * FREQUENCY * (PATH_M + 40)[:, None] / SPEED_OF_LIGHT_M_S)
    with_target = replace(HISTORY, transfer=(ECHO + house).astype(np.complex64), weight=window / window.sum())
    assert "echo_outside_scene" not in json.loads(ap.backproject(with_target, TARGET_GRID).attrs["flags"])
    alone = replace(HISTORY, transfer=house.astype(np.complex64))
    assert "echo_outside_scene" in json.loads(ap.backproject(alone, TARGET_GRID).attrs["flags"])


def test_lazy_image_is_judged_on_request_and_as_a_whole():
    lazy = ap.backproject(HISTORY, TARGET_GRID, judge=False, tile_px=64)
    assert lazy.attrs["verdict"] == "not judged"
    assert "apertura.judge" in lazy.attrs["verdict_reason"]
    result = ap.judge(abs(lazy)[:9, :9])
    assert (result.verdict, dict(result.flags)) == ("focused", {})
    assert result.focus["points"][0]["x_m"] == pytest.approx(TARGET[0, 0], abs=0.03)
    assert [line["cause"] for line in result.budget] == [
        "positions",
        "heights",
        "calibration",
        "atmosphere",
        "arithmetic",
    ]
    with pytest.raises(CampaignError, match="not yet computed"):
        ap.judge(lazy.compute())
    with pytest.raises(CampaignError, match="several images"):
        ap.judge(lazy + ap.backproject(HISTORY, TARGET_GRID, judge=False))


def test_stated_position_errors_are_expected():
    transmit_error, receive_error = 0.01 * np.random.default_rng(3).standard_normal((2, len(HISTORY), 3))
    image = ap.backproject(flown(APERTURE.tx_m + transmit_error, APERTURE.rx_m + receive_error)(), TARGET_GRID)
    assert "loss_unexpected" in json.loads(image.attrs["flags"])
    result = ap.judge(image, position_std_m=0.01, time_s=10.0 * np.arange(len(HISTORY)))
    assert result.focus["loss_db"] == pytest.approx(result.focus["expected_db"], abs=0.3)
    assert not result.flags
    with pytest.raises(CampaignError, match="in time_s"):
        ap.judge(image, position_std_m=0.01)
    with pytest.raises(CampaignError, match="times of 96 pulses"):
        ap.judge(image, position_std_m=0.01, time_s=np.arange(3.0))


LINK = ap.Link(30.0, 10.0, 10.0, 40.0, 0.0, 8192.0)
SECONDS = np.arange(len(HISTORY)) / 10


def judged(**stated):
    return ap.judge(ap.backproject(HISTORY, TARGET_GRID), **stated)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: ap.range_compress("x", TARGET_GRID, 0.0), "type str; expected PhaseHistory"),
        (lambda: ap.range_compress(PROFILES, TARGET_GRID, 0.0), "range profiles; expected a PhaseHistory"),
        (lambda: ap.range_compress(HISTORY, (1, 2), 0.0), "expected a SceneGrid"),
        (lambda: ap.range_compress(HISTORY, TARGET_GRID, "flat"), "expected a height in metres"),
        (lambda: ap.gradient(PROFILES, (1, 2), np.ones((1, 2))), "expected a SceneGrid"),
        (lambda: ap.gradient(HISTORY, TARGET_GRID, np.ones(TARGET_GRID.shape)), "expected Profiles"),
        (lambda: ap.gradient(PROFILES, TARGET_GRID, "x"), "of the grid's shape"),
        (lambda: ap.open_campaign(3), "expected the path of a campaign folder"),
        (lambda: ap.backproject(HISTORY, TARGET_GRID, atmosphere=1.0003), "expected N units"),
        (lambda: ap.backproject(HISTORY, TARGET_GRID, accuracy_db="-60"), "accuracy_db"),
        (lambda: ap.open_dem("dem.tif", None), "open_dem: scene"),
        (lambda: ap.design(None), "expected a flight plan"),
        (lambda: ap.simulate(None), "simulate: directory"),
        (lambda: ap.simulate("never_made", targets=[]), "simulate: targets"),
        (lambda: ap.simulate("never_made", seed=-1), "simulate: seed"),
        (lambda: ap.simulate([1]), "simulate: directory"),
        (lambda: ap.simulate("a\0b"), "a path with a null byte"),
        (lambda: ap.open_campaign("a\0b"), "a path with a null byte"),
        (lambda: ap.backproject(HISTORY, TARGET_GRID, atmosphere=True), "expected auto, vacuum"),
        (lambda: ap.backproject(HISTORY, TARGET_GRID, terrain=True), "expected a height in metres"),
        (lambda: ap.backproject(HISTORY, TARGET_GRID, terrain=ap.FlatGround("a")), "FlatGround: height_m"),
        (lambda: ap.backproject(HISTORY, TARGET_GRID, judge=1), "True, False or 'auto'"),
        (lambda: ap.backproject(of(weight=np.ones(200))(), TARGET_GRID, calibration=1.0), "weights sum to 200"),
        (lambda: ap.Link(30.0, 10.0, 10.0, 40.0, 0.0, -8192.0), "Link: full_scale_counts"),
        (lambda: ap.Link("30", 10.0, 10.0, 40.0, 0.0, 8192.0), "Link: transmit_power_dbm"),
        (lambda: ap.Link(1000.0, 10.0, 10.0, 40.0, 0.0, 8192.0), "Link: transmit_power_dbm"),
        (lambda: LINK.constant(wavelength_m=-0.22, sent_power=1.0), "wavelength_m"),
        (lambda: ap.Aperture(*2 * [np.full((4, 3), 4e6, np.float32)]), "numbers near 4e+06 m differ by 0.25 m"),
        (lambda: ap.SceneGrid.from_bounds("local", (5.0, 5.0, -5.0, -5.0), spacing_m=0.1), "xmin, ymin, xmax, ymax"),
        (lambda: ap.SceneGrid.from_bounds("local", (1, 2, 3), spacing_m=0.1), "xmin, ymin, xmax, ymax"),
        (lambda: ap.SceneGrid.from_bounds("local", (np.nan, 0, 1, 1), spacing_m=0.1), "xmin, ymin, xmax, ymax"),
        (lambda: ap.SceneGrid.from_bounds("local", (0, 0, 1, 1), spacing_m=0), "SceneGrid.from_bounds: spacing_m"),
        (lambda: TARGET_GRID[5], "slices of rows and of columns"),
        (lambda: judged(position_std_m=np.nan, time_s=SECONDS), "position_std_m of nan"),
        (lambda: judged(position_std_m="1cm", time_s=SECONDS), "position_std_m of '1cm'"),
        (
            lambda: judged(position_std_m=0.01, time_s=SECONDS.astype("datetime64[s]")),
            "times in seconds, from any origin",
        ),
        (lambda: judged(position_std_m=0.01, time_s=SECONDS[::-1]), "times in seconds, from any origin"),
    ],
)
def test_other_functions_refuse_invalid_arguments(call, message):
    with pytest.raises(CampaignError) as refused:
        call()
    assert message in str(refused.value)


def test_single_height_is_accepted_as_flat_terrain():
    assert np.array_equal(ap.range_compress(HISTORY, TARGET_GRID, 0.0).samples, PROFILES.samples)


@pytest.mark.parametrize(
    "convert",
    [
        pytest.param(np.matrix, id="matrix", marks=pytest.mark.filterwarnings("ignore:the matrix subclass")),
        pytest.param(np.ma.masked_array, id="masked nowhere"),
        pytest.param(lambda values: values.astype(values.dtype.newbyteorder(">")), id="other byte order"),
        pytest.param(
            lambda values: values.astype(np.clongdouble if values.dtype.kind == "c" else np.longdouble), id="extended"
        ),
    ],
)
def test_other_numpy_arrays_give_the_same_image(convert):
    converted = replace(HISTORY, transfer=convert(ECHO), aperture=ap.Aperture(*map(convert, APERTURE.legs)))
    images = [ap.backproject(echo, TARGET_GRID, judge=False).values for echo in (converted, HISTORY)]
    np.testing.assert_allclose(images[0], images[1], atol=1e-5)


def test_small_integer_types_are_accepted_as_grid_shape():
    small_integers = replace(TARGET_GRID, shape=tuple(map(np.uint8, TARGET_GRID.shape)))
    images = [ap.backproject(HISTORY, grid, judge=False).values for grid in (small_integers, TARGET_GRID)]
    np.testing.assert_array_equal(*images)


def test_single_pixel_image_is_judged():
    grid = ap.SceneGrid("local", -0.05, 0.05, 0.1, (1, 1))
    assert ap.backproject(HISTORY, grid, judge=True).attrs["verdict"] == "inconclusive"


@pytest.mark.slow
def test_xarray_and_dask_arrays_are_accepted():
    labelled = replace(HISTORY, transfer=xr.DataArray(ECHO), aperture=ap.Aperture(*map(xr.DataArray, APERTURE.legs)))
    lazy = replace(HISTORY, transfer=xr.DataArray(ECHO).chunk().data)
    expected = ap.backproject(HISTORY, TARGET_GRID).values
    assert all(np.array_equal(ap.backproject(echo, TARGET_GRID).values, expected) for echo in (labelled, lazy))


def test_image_without_samples_is_not_called_focused():
    """The profile starts are in km, so that no pixel lies within the samples."""
    image = ap.backproject(replace(PROFILES, start_m=PROFILES.start_m / 1e3), TARGET_GRID, judge=True)
    assert image.attrs["verdict"] == "inconclusive"


def test_lazy_image_does_not_follow_later_changes_of_the_track_array():
    """A lazy image is computed later, when the caller may have changed the array."""
    track = APERTURE.tx_m.copy()
    first, second = (
        ap.backproject(replace(HISTORY, aperture=ap.Aperture(track, track)), TARGET_GRID, judge=False) for _ in range(2)
    )
    expected = first.values
    track += 1.0
    np.testing.assert_array_equal(second.values, expected)


def test_error_budget_contains_the_atmosphere_if_vacuum_is_assumed():
    """N = 300 lengthens every path by 300 ppm, which displaces a point at range R by 300e-6 R."""
    budget = json.loads(ap.backproject(HISTORY, TARGET_GRID, judge=False).attrs["budget"])
    line = next(entry for entry in budget if entry["cause"] == "atmosphere")
    slant_m = np.linalg.norm(APERTURE.tx_m.mean(axis=0) - TARGET)
    ground_m = np.linalg.norm((APERTURE.tx_m.mean(axis=0) - TARGET)[0, :2])
    assert "a refractivity of 300 N units, with vacuum assumed" in line["stated"]
    assert line["shift_m"] == pytest.approx(300e-6 * slant_m * slant_m / ground_m, rel=0.1)
    stated = ap.backproject(HISTORY, TARGET_GRID, judge=False, atmosphere=285.0).attrs["budget"]
    assert "20 N units" in stated


@pytest.mark.parametrize(("accuracy_db", "replaced"), [(-60.0, False), (-100.0, True)])
def test_requested_engine_that_misses_the_accuracy_is_replaced_and_flagged(accuracy_db, replaced):
    image = ap.backproject(HISTORY, TARGET_GRID, engine="native", accuracy_db=accuracy_db, judge=False)
    flags = json.loads(image.attrs["flags"])
    assert ("engine_replaced" in flags) == replaced
    if replaced:
        assert flags["engine_replaced"] == "the image formed by reference: the requested native does not meet -100 dB"
    automatic = ap.backproject(HISTORY, TARGET_GRID, accuracy_db=accuracy_db, judge=False)
    assert "engine_replaced" not in json.loads(automatic.attrs["flags"])
