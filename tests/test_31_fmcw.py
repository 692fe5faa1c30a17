"""Files of FMCW beat signals: arrays, MATLAB and sound-card recordings give equal sweeps; faults are named."""

import re
from dataclasses import asdict, replace

import numpy as np
import pytest
from folders import complaint
from scipy.io import savemat, wavfile
from scipy.signal import get_window

from apertura.core.echo.dechirp import FrequencySweep, transfer_of
from apertura.formats.phase_histories.fmcw import trigger_starts
from apertura.formats.reading import read_phase_history
from apertura.simulation.fmcw import beat_signal

pytestmark = pytest.mark.usefixtures("reader")

COFFEE = FrequencySweep(2.26e9, 330e6, 20e-3, 44_100.0)
"""The sweep of MIT's coffee-can radar."""

BEGAN = np.datetime64("2025-05-14T09:30", "ns")
TRIGGER = {"sync_channel": 1, "beat_channel": 2, "edge": "rising", "threshold": 0.3}


def described(**changes):
    defaults = {"kind": "fmcw", "prf_hz": None, "start_utc": "2025-05-14T09:30", "trigger": TRIGGER}
    return {**asdict(COFFEE), **defaults, **changes}


def echo(form, *paths, **changes):
    return read_phase_history(form, paths, pair="a-a", described=described(**changes))


def beats(start_s, sweep=COFFEE):
    """Return beats of a stationary target at 30 m and of an approaching target."""
    paths = [lambda time: np.full_like(time, 60.0), lambda time: 90.0 - 2 * time]
    return beat_signal(sweep, np.asarray(start_s), paths, [1.0, 0.5])


def sound(path, starts, *, count, scale=8000, dtype=np.int16, high_s=20e-3):
    """Write a sound-card recording: a sync channel that is high during sweeps, and the beats."""
    rate = COFFEE.sample_rate_hz
    samples = np.zeros((count, 2))
    for start in starts:
        first, last = int(np.ceil(start)), min(int(np.ceil(start + high_s * rate)), count)
        samples[first:last, 0] = 1.0
        late = replace(COFFEE, start_hz=COFFEE.start_hz)
        exact = beats_from(late, (first - start) / rate, start / rate)
        samples[first:last, 1] = exact[: last - first]
    wavfile.write(path, int(rate), (samples * scale).astype(dtype))
    return path


def beats_from(sweep, late_s, start_s):
    """Return a sweep whose first sample is recorded `late_s` after its start."""
    elapsed = np.arange(sweep.sweep_samples + 2) / sweep.sample_rate_hz + late_s
    total = np.zeros(len(elapsed))
    for path, amplitude in ((np.full_like(elapsed, 60.0), 1.0), (90.0 - 2 * (start_s + elapsed), 0.5)):
        delayed = elapsed - path / 299_792_458.0
        phase = [sweep.start_hz * at + sweep.slope_hz_s * at**2 / 2 for at in (delayed, elapsed)]
        total += np.where(delayed >= 0, amplitude * np.cos(2 * np.pi * (phase[0] - phase[1])), 0)
    return total


STARTS_S = 0.05 + 0.040004 * np.arange(8)


@pytest.mark.quick("*-beat_npy-times-*", "*-beat_mat-none-5")
@pytest.mark.parametrize("count", [5, 900, 3000])
@pytest.mark.parametrize("stated", ["times", "prf", "none"])
@pytest.mark.parametrize("form", ["beat_npy", "beat_mat"])
def test_array_with_a_sweep_per_column_is_rejected(tmp_path, form, stated, count):
    """Sweeps have 882 samples; tested are fewer, a similar number of, and more sweeps than samples."""
    beat = np.random.default_rng(1).normal(size=(count, 882)).astype(np.float32)
    time = BEGAN + np.arange(count) * np.timedelta64(40, "ms")
    changes = {"prf_hz": 25.0} if stated != "times" else {}
    path = tmp_path / f"a.{form[5:]}"

    def save(array):
        if form == "beat_npy":
            np.save(path, array)
            files = [path]
            if stated == "times":
                np.save(tmp_path / "a.time.npy", time)
                files.append(tmp_path / "a.time.npy")
            return files
        savemat(path, {"beat": array, **({"time": time.astype(np.int64) / 1e9} if stated == "times" else {})})
        return [path]

    assert echo(form, *save(beat), **changes).sizes["pulse"] == count
    message = complaint(lambda: echo(form, *save(beat.T), **changes))
    assert f"882 × {count} samples, with a sweep in each column; expected a sweep in each row" in message
    assert "Save the transpose" in message


def test_arrays_and_matlab_files_give_the_same_sweeps(tmp_path):
    beat = beats(STARTS_S).astype("f4")
    time = BEGAN + np.round(STARTS_S * 1e9).astype("timedelta64[ns]")
    np.save(tmp_path / "a.npy", beat)
    np.save(tmp_path / "a.time.npy", time)
    savemat(tmp_path / "a.mat", {"beat": beat, "time": time.astype(np.int64) / 1e9})
    array = echo("beat_npy", tmp_path / "a.npy", tmp_path / "a.time.npy")
    matlab = echo("beat_mat", tmp_path / "a.mat")
    np.testing.assert_array_equal(array.transfer, matlab.transfer)
    np.testing.assert_array_equal(array.transfer, transfer_of(beat, COFFEE))
    np.testing.assert_array_equal(array.time, time + np.timedelta64(round(COFFEE.middle_s * 1e9), "ns"))
    assert np.abs(matlab.time.values - array.time.values).max() < np.timedelta64(1, "us")  # float64 seconds since 1970
    assert matlab.frequency.values[0] == 2.26e9
    assert array.attrs["dropped"] == {}


def test_files_of_a_node_are_joined_with_their_times(tmp_path):
    beat = beats(STARTS_S)
    for part, rows in (("p1", slice(0, 5)), ("p2", slice(5, 8))):
        np.save(tmp_path / f"a.{part}.npy", beat[rows])
        np.save(tmp_path / f"a.{part}.time.npy", (BEGAN + (STARTS_S[rows] * 1e9).astype("timedelta64[ns]")))
    both = echo("beat_npy", *sorted(tmp_path.glob("a*.npy")))
    np.testing.assert_array_equal(both.transfer, transfer_of(beat, COFFEE))


def test_repeated_sweeps_are_excluded(tmp_path):
    beat = beats(STARTS_S) + np.random.default_rng(1).normal(0, 1e-3, (len(STARTS_S), COFFEE.sweep_samples))
    beat[4:6] = beat[2:4]
    np.save(tmp_path / "a.npy", beat)
    np.save(tmp_path / "a.time.npy", STARTS_S)
    read = echo("beat_npy", tmp_path / "a.npy", tmp_path / "a.time.npy")
    assert read.attrs["flags"]["captures_repeated"] == "2 of 8 captures of a, first at capture 4"
    assert read.attrs["dropped"] == {"captures_repeated": 2}
    expected = transfer_of(np.delete(beat, [4, 5], axis=0), COFFEE)
    np.testing.assert_allclose(read.transfer.values, expected, atol=1e-6)


def test_complex_sweeps_without_imaginary_parts_are_rejected(tmp_path):
    np.save(tmp_path / "a.npy", beats(STARTS_S).astype(np.complex64))
    message = complaint(lambda: echo("beat_npy", tmp_path / "a.npy", iq="complex", prf_hz=25.0))
    assert "the imaginary parts of all samples are zero, but waveform.iq is complex" in message


@pytest.mark.parametrize("dtype", [np.int16, np.float32, np.complex64])
@pytest.mark.parametrize(("level", "flagged"), [(0.7, True), (0.4, False)])
def test_clipping_converter_is_flagged(tmp_path, dtype, level, flagged):
    """Full scale is 1.5 times the weaker target at level 1; without clipping, the stable tone repeats its crest."""
    iq = "complex" if dtype == np.complex64 else "real"
    sweep = replace(COFFEE, iq=iq)
    beat = beats(STARTS_S, sweep) * 2048 * level
    beat = beat + np.random.default_rng(1).normal(0, 3, beat.shape)
    recorded = np.clip(beat.real.round(), -2048, 2047)
    if iq == "complex":
        recorded = recorded + 1j * np.clip(beat.imag.round(), -2048, 2047)
    np.save(tmp_path / "a.npy", recorded.astype(dtype))
    flags = echo("beat_npy", tmp_path / "a.npy", prf_hz=25.0, iq=iq).attrs["flags"]
    assert ("saturated_radar" in flags) is flagged
    assert set(flags) <= {"saturated_radar"}


def test_stable_tone_without_clipping_is_not_flagged(tmp_path):
    """The direct path is so strong and stable that each sweep reaches the same codes."""
    beat = beat_signal(COFFEE, STARTS_S, [lambda time: np.full_like(time, 60.0)], [1000.0])
    beat += np.random.default_rng(1).normal(0, 0.5, beat.shape)
    np.save(tmp_path / "a.npy", beat.round().astype(np.int16))
    assert echo("beat_npy", tmp_path / "a.npy", prf_hz=25.0).attrs["flags"] == {}


@pytest.mark.parametrize("scale", [1e-20, 1e20])
def test_beat_signals_beyond_the_range_of_computations_are_rejected(tmp_path, scale):
    np.save(tmp_path / "a.npy", beats(STARTS_S) * scale)
    assert "sample" in complaint(lambda: echo("beat_npy", tmp_path / "a.npy", prf_hz=25.0))


LONG = 0.05 + 0.040004 * np.arange(100)


@pytest.mark.parametrize(
    ("noise", "idle", "flagged"),
    [
        (0.1, 0.1, True),
        (0.1, 0.06, True),
        (0.1, 0.03, True),
        (0.1, 0.01, False),
        (0.1, 0.0, False),
        (1.0, 0.1, True),
        (10.0, 0.1, False),
    ],
)
@pytest.mark.parametrize("iq", ["real", "complex"])
def test_idle_time_at_the_end_of_sweeps_is_flagged(tmp_path, iq, noise, idle, flagged):
    """Noise relative to the moving target at amplitude 0.5; idle time relative to the sweep. The direct path is
    constant."""
    sweep = replace(COFFEE, iq=iq)
    beat = beats(LONG, sweep)
    beat[:, round((1 - idle) * beat.shape[1]) :] = 0
    rng = np.random.default_rng(1)
    beat = beat + 0.5 * noise * rng.standard_normal(beat.shape)
    if iq == "complex":
        beat = beat + 0.5j * noise * rng.standard_normal(beat.shape)
    np.save(tmp_path / "a.npy", beat)
    flags = echo("beat_npy", tmp_path / "a.npy", prf_hz=24.0, iq=iq).attrs["flags"]
    assert set(flags) == ({"sweep_idle"} if flagged else set())
    if flagged:
        stated_s = float(re.search(r"after (\S+) s", flags["sweep_idle"])[1])
        assert stated_s == pytest.approx((1 - idle) * COFFEE.sweep_s, abs=0.03 * COFFEE.sweep_s)


@pytest.mark.parametrize("window", ["hann", "hamming", "blackman", ("tukey", 0.1), ("kaiser", 6.0), ("taylor", 4)])
@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_window_of_the_recorder_is_not_taken_for_idle_time(tmp_path, window, noise):
    beat = beats(LONG) + noise * np.random.default_rng(1).standard_normal((len(LONG), COFFEE.sweep_samples))
    np.save(tmp_path / "a.npy", beat * get_window(window, beat.shape[1], fftbins=False))
    assert echo("beat_npy", tmp_path / "a.npy", prf_hz=24.0).attrs["flags"] == {}


def test_sweeps_without_times_follow_the_configured_rate_and_start(tmp_path):
    np.save(tmp_path / "a.npy", beats(STARTS_S))
    stage = echo("beat_npy", tmp_path / "a.npy", prf_hz=25.0)
    middle = np.timedelta64(round(COFFEE.middle_s * 1e9), "ns")
    np.testing.assert_array_equal(stage.time, BEGAN + middle + np.arange(8) * np.timedelta64(40, "ms"))
    unknown = echo("beat_npy", tmp_path / "a.npy", prf_hz=25.0, start_utc=None)
    assert unknown.time.values[0] == np.datetime64("1970-01-01", "ns") + middle


def test_sweep_starts_between_sound_samples_are_found(tmp_path):
    starts = (STARTS_S + 0.00001) * COFFEE.sample_rate_hz
    assert np.ptp(starts % 1) > 0.1
    path = sound(tmp_path / "a.wav", starts, count=int(starts[-1]) + 1200)
    stage = echo("beat_wav", path)
    assert stage.sizes["pulse"] == len(starts)
    assert stage.attrs["dropped"] == {}
    starts_utc = BEGAN + np.round((STARTS_S + 0.00001) * 1e9).astype("timedelta64[ns]")
    middle = np.timedelta64(round(COFFEE.middle_s * 1e9), "ns")
    # the resolution of a sync edge without intermediate samples is one sample
    within = np.timedelta64(round(0.51e9 / COFFEE.sample_rate_hz), "ns")
    assert np.abs(stage.time.values - middle - starts_utc).max() <= within


def test_sampled_sync_edge_gives_the_fraction_of_a_sample(tmp_path):
    starts = (STARTS_S + 0.00001) * COFFEE.sample_rate_hz
    path = sound(tmp_path / "a.wav", starts, count=int(starts[-1]) + 1200)
    rate, samples = wavfile.read(path)
    number = np.arange(len(samples))
    edges = [(number - edge) / 2 + 0.5 for start in starts for edge in (start, start + 882)]  # two samples wide
    ramps = sum(sign * np.clip(edge, 0, 1) for edge, sign in zip(edges, [1, -1] * len(starts), strict=True))
    wavfile.write(path, rate, np.stack([8000 * ramps, samples[:, 1]], 1).astype(np.int16))
    stage = echo("beat_wav", path)
    truth = transfer_of(beats(starts / COFFEE.sample_rate_hz), COFFEE) * 8000
    inside = slice(40, -40)
    error = np.abs(stage.transfer.values - truth)[:, inside].max() / 8000
    assert error < 0.03
    rounded = transfer_of(
        np.stack([samples[int(np.ceil(start)) :, 1][: COFFEE.sweep_samples] for start in starts]), COFFEE
    )
    assert np.abs(rounded - truth)[:, inside].max() / 8000 > 0.3


def test_truncated_sweeps_are_dropped_and_counted(tmp_path):
    starts = STARTS_S * COFFEE.sample_rate_hz
    early = np.insert(starts, 4, starts[3] + 500)  # a trigger within a sweep
    stage = echo("beat_wav", sound(tmp_path / "a.wav", early, count=int(starts[-1]) + 400, high_s=5e-3))
    assert stage.attrs["dropped"] == {"incomplete": 2}
    assert stage.sizes["pulse"] == 7


@pytest.mark.parametrize("dtype", [np.int16, np.int32, np.float32, np.uint8])
def test_triggers_of_a_bipolar_channel_of_any_type_are_found(tmp_path, dtype):
    starts = STARTS_S * COFFEE.sample_rate_hz
    path = sound(tmp_path / "a.wav", starts, count=int(starts[-1]) + 1200)
    rate, samples = wavfile.read(path)
    swings = np.where(samples[:, 0] > 0, -0.6, 0.4) * 100 + np.random.default_rng(1).normal(0, 3, len(samples))
    recorded = np.stack([samples[:, 1] / 80, swings], 1) + (128 if dtype == np.uint8 else 0)
    wavfile.write(path, rate, recorded.astype(dtype))
    trigger = {"sync_channel": 2, "beat_channel": 1, "edge": "falling", "threshold": 0.3}
    stage = echo("beat_wav", path, trigger=trigger)
    assert stage.sizes["pulse"] == len(starts)
    profile = np.abs(np.fft.ifft(stage.transfer.values * np.hanning(stage.sizes["subcarrier"]), axis=1))
    assert set(profile[:, 1:].argmax(axis=1) + 1) == {round(60 / 299_792_458 * 330e6)}


def test_click_between_sync_pulses_is_no_trigger():
    sync = np.tile(np.r_[np.zeros(500), np.ones(500)], 5)
    sync[1200] = 0.6  # above the midpoint, within the threshold
    np.testing.assert_allclose(trigger_starts(sync, threshold=0.3), [499.5, 1499.5, 2499.5, 3499.5, 4499.5])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"beat": np.ones((8, 700))}, r"float64 of shape \(8, 700\); a sweep has 882 samples"),
        ({"beat": np.ones((8, 882), "c8")}, "complex64 samples, but waveform.iq is real"),
        (
            {"beat": np.where(np.arange(8)[:, None] == 3, np.nan, np.ones((8, 882)))},
            "sweep 3 contains a sample that is not a number",
        ),
        ({"beat": np.zeros((8, 882))}, "no sweep with a non-zero sample"),
        ({"time": np.arange(7.0)}, "7 times for 8 sweeps"),
        ({"time": np.r_[0.0, 2, 1, 3:8]}, "sweep 2 starts -1 s after the previous sweep, whose duration is 0.02 s"),
        ({"time": 1.7e9 + np.arange(8) / 128}, "sweep 1 starts 0.0078125 s after"),
        ({"time": np.r_[0.0:7, np.nan]}, "time 7 is not between 1970 and 2199"),
        ({"time": np.arange(8) * 10**18}, "time 1 is not between"),
        ({"time": np.arange(8.0) * 1j}, "array of times is complex128"),
        ({"time": None}, "no sweep times"),
        ({"beat": None}, "no variable beat"),
    ],
)
def test_invalid_sweeps_are_rejected(tmp_path, change, message):
    fields = {"beat": beats(STARTS_S), "time": 1.7e9 + STARTS_S, **change}
    savemat(tmp_path / "a.mat", {name: values for name, values in fields.items() if values is not None})
    error = complaint(lambda: echo("beat_mat", tmp_path / "a.mat"))
    assert re.search(message, error)
    assert "a.mat" in error


def test_times_without_beat_signals_are_rejected(tmp_path):
    np.save(tmp_path / "a.time.npy", np.arange(8.0))
    assert "times without beat signals" in complaint(lambda: echo("beat_npy", tmp_path / "a.time.npy"))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"sample_rate_hz": 48_000.0}, "44100 samples/s"),
        ({"trigger": TRIGGER | {"beat_channel": 3}}, "2 channels"),
        ({"sweep_s": 0.1}, "8 triggers, none followed by a complete sweep"),
        ({"start_utc": "soon"}, "waveform.start_utc"),
    ],
)
def test_sound_file_that_does_not_fit_its_waveform_is_rejected(tmp_path, changes, message):
    starts = STARTS_S * COFFEE.sample_rate_hz
    path = sound(tmp_path / "a.wav", starts, count=int(starts[-1]) + 1200)
    assert message in complaint(lambda: echo("beat_wav", path, **changes))


def test_truncated_sound_file_is_rejected(tmp_path):
    starts = STARTS_S * COFFEE.sample_rate_hz
    path = sound(tmp_path / "a.wav", starts, count=int(starts[-1]) + 1200)
    path.write_bytes(path.read_bytes()[:-5000])
    assert "not readable" in complaint(lambda: echo("beat_wav", path))
