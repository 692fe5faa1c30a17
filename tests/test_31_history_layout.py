"""Phase history in HDF5 and zarr: arrays are read back unchanged, and deviations from the layout are rejected."""

import json
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest
import zarr
from folders import complaint, require_files

from apertura.campaign.folder import Campaign
from apertura.common.constants import SPEED_OF_LIGHT_M_S
from apertura.common.contracts import check
from apertura.common.errors import CampaignError
from apertura.formats.reading import read_phase_history

pytestmark = pytest.mark.usefixtures("reader")

PULSES, SUBCARRIERS = 9, 16
SUFFIX = {"hdf5": ".h5", "zarr": ".zarr"}
FORMATS = pytest.mark.parametrize("kind", SUFFIX)


def arrays():
    """Return the arrays of a recording."""
    rng = np.random.default_rng(5)
    samples = rng.standard_normal((PULSES, SUBCARRIERS)) + 1j * rng.standard_normal((PULSES, SUBCARRIERS))
    place = np.array([4177000.0, 855000.0, 4728000.0])
    return {
        "transfer": samples.astype(np.complex64),
        "frequency": 1.2e9 + 1e5 * np.arange(SUBCARRIERS),
        "time": np.datetime64("2025-05-14T09:30:00", "ns").astype(np.int64) + 10_000_000 * np.arange(PULSES),
        "tx_position": place + np.arange(PULSES)[:, None],
        "rx_position": place - np.arange(PULSES)[:, None],
        "reference_delay": np.linspace(1e-6, 1.1e-6, PULSES),
        "path_limit": np.full(PULSES, 900.0),
    }


def write(path, fields, *, frame="ecef", units="nanoseconds since 1970-01-01"):
    """Write a file or a folder, depending on the suffix."""
    if path.suffix == ".h5":
        with h5py.File(path, "w") as file:
            file.attrs["frame"] = frame
            for name, values in fields.items():
                file[name] = values
            if "time" in file:
                file["time"].attrs["units"] = units
        return path
    group = zarr.open_group(path, mode="w", zarr_format=3, attributes={"frame": frame})
    for name, values in fields.items():
        group.create_array(name, data=values, attributes={"units": units} if name == "time" else {})
    return path


def files_of(path):
    return [file for file in sorted(path.rglob("*")) if file.is_file()] if path.is_dir() else [path]


def read(kind, *paths):
    files = [file for path in paths for file in files_of(path)]
    return read_phase_history(kind, files, pair="a-b")


@FORMATS
def test_arrays_are_read_back_unchanged(tmp_path, kind):
    fields = arrays()
    echo = check(read(kind, write(tmp_path / f"b{SUFFIX[kind]}", fields)), "echo")
    # default until a campaign configures its atmosphere
    of_vacuum = {
        "reference": "delay",
        "wave_speed_m_s": SPEED_OF_LIGHT_M_S,
    }
    assert echo.attrs == {"frame": "ecef", "pair": "a-b", "flags": {}, **of_vacuum}
    np.testing.assert_array_equal(echo.time.values, fields.pop("time").astype("datetime64[ns]"))
    np.testing.assert_allclose(echo.frequency.values, fields.pop("frequency"), rtol=1e-15)
    for name, values in fields.items():
        np.testing.assert_array_equal(echo[name].values, values, err_msg=name)


@FORMATS
def test_positions_and_path_limit_are_optional(tmp_path, kind):
    fields = {
        name: values for name, values in arrays().items() if name not in {"tx_position", "rx_position", "path_limit"}
    }
    echo = read(kind, write(tmp_path / f"b{SUFFIX[kind]}", fields, frame=""))
    assert "tx_position" not in echo
    assert "frame" not in echo.attrs
    assert np.isinf(echo.path_limit.values).all()


def nan_at(name, *index):
    fields = arrays()
    fields[name] = fields[name].copy()
    fields[name][index] = np.nan
    return fields


def without(name):
    return {key: values for key, values in arrays().items() if key != name}


@FORMATS
@pytest.mark.parametrize(
    ("fields", "options", "expected"),
    [
        (arrays(), {"frame": "wgs84"}, "frame is 'wgs84', not 'ecef' or 'local'"),
        (arrays(), {"units": "seconds since 1970-01-01"}, "units of time are 'seconds since 1970-01-01'"),
        (without("reference_delay"), {}, "reference_delay"),
        (without("rx_position"), {}, "tx_position without the position of the other antenna"),
        (nan_at("transfer", 3, 7), {}, "transfer is not a number at index [3, 7]"),
        (nan_at("rx_position", 2, 1), {}, "rx_position is not a number at index [2, 1]"),
        (nan_at("path_limit", 2), {}, "a path_limit that is not positive"),
        (arrays() | {"time": arrays()["time"][::-1].copy()}, {}, "pulse 1 is not later than the previous pulse"),
        (arrays() | {"time": arrays()["time"] * 1e-9}, {}, "time is float64"),
        (arrays() | {"transfer": arrays()["transfer"].real.copy()}, {}, "transfer is float32"),
        (
            arrays() | {"rx_position": arrays()["rx_position"][:, :2].copy()},
            {},
            "rx_position is float64 of shape (9, 2)",
        ),
        (arrays() | {"reference_delay": np.zeros(PULSES - 1)}, {}, "reference_delay has length 8 along pulse"),
        (
            arrays() | {"frequency": np.geomspace(1e9, 2e9, SUBCARRIERS)},
            {},
            "frequencies that do not increase in equal steps",
        ),
        (arrays() | {"tx_position": np.ones((PULSES, 3))}, {}, "tx_position of pulse 0 is 2 m from the Earth's centre"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_deviation_from_the_layout_is_named(tmp_path, kind, fields, options, expected):
    path = write(tmp_path / f"b{SUFFIX[kind]}", fields, **options)
    message = complaint(lambda: read(kind, path))
    assert message.startswith(f"{path}: ")
    assert expected in message


def test_silent_pulses_are_dropped_and_counted(tmp_path):
    fields = arrays()
    fields["transfer"][4] = 0
    echo = read("hdf5", write(tmp_path / "b.h5", fields))
    assert echo.sizes["pulse"] == PULSES - 1
    assert echo.attrs["pulses"] == {"used": PULSES - 1, "dropped": 1, "reasons": {"all samples zero": 1}}


@FORMATS
def test_repeated_pulses_of_all_files_are_excluded(tmp_path, kind):
    first, second = arrays(), arrays()
    second["time"] += 10**12
    second["transfer"] = first["transfer"].copy()
    second["transfer"][0] *= 2
    paths = [write(tmp_path / f"b.{number}{SUFFIX[kind]}", part) for number, part in enumerate((first, second))]
    echo = read(kind, *paths)
    counted = {"used": PULSES + 1, "dropped": PULSES - 1, "reasons": {"captures_repeated": PULSES - 1}}
    assert echo.attrs["pulses"] == counted
    line = f"{PULSES - 1} of {2 * PULSES} captures of b, first at capture {PULSES + 1}"
    assert echo.attrs["flags"]["captures_repeated"] == line
    np.testing.assert_array_equal(echo.transfer[PULSES], second["transfer"][0])


def test_echo_of_the_reference_point_alone_is_kept(tmp_path):
    """Without noise, all its samples are 1: identical pulses without imaginary parts."""
    fields = arrays()
    fields["transfer"] = np.ones_like(fields["transfer"])
    echo = read("hdf5", write(tmp_path / "b.h5", fields))
    assert echo.sizes["pulse"] == PULSES
    assert "not excluded" in echo.attrs["flags"]["captures_repeated"]


@FORMATS
def test_real_transfer_functions_are_rejected(tmp_path, kind):
    fields = arrays()
    fields["transfer"] = (fields["transfer"].real + 0j).astype(np.complex64)
    path = write(tmp_path / f"b{SUFFIX[kind]}", fields)
    assert "the imaginary parts of all samples are zero" in complaint(lambda: read(kind, path))
    fields["transfer"][-1, -1] += 1e-3j
    assert read(kind, write(tmp_path / f"c{SUFFIX[kind]}", fields)).sizes["pulse"] == PULSES


@FORMATS
@pytest.mark.parametrize(("scale", "expected"), [(1e-20, "transfer reaches only"), (1e20, "transfer reaches")])
def test_samples_beyond_the_range_of_computations_are_rejected(tmp_path, kind, scale, expected):
    fields = arrays()
    fields["transfer"] *= np.float32(scale)
    path = write(tmp_path / f"b{SUFFIX[kind]}", fields)
    assert expected in complaint(lambda: read(kind, path))


def test_external_hdf5_array_is_rejected(tmp_path):
    inner, other = tmp_path / "b.h5", tmp_path / "secret"
    np.arange(PULSES, dtype=np.float64).tofile(other)
    write(tmp_path / "whole.h5", arrays())
    for keep in (
        lambda file: file.create_dataset("reference_delay", (PULSES,), "f8", external=[(str(other), 0, 8 * PULSES)]),
        lambda file: file.__setitem__(
            "reference_delay", h5py.ExternalLink(str(tmp_path / "whole.h5"), "reference_delay")
        ),
        lambda file: file.__setitem__("reference_delay", h5py.SoftLink("/path_limit")),
    ):
        write(inner, without("reference_delay"))
        with h5py.File(inner, "a") as file:
            keep(file)
        assert "reference_delay is not an array stored in this file" in complaint(lambda: read("hdf5", inner))


def test_codec_that_may_run_code_is_rejected(tmp_path):
    path = write(tmp_path / "b.zarr", arrays())
    meta = json.loads((path / "time/zarr.json").read_text())
    meta["codecs"].append({"name": "numcodecs.pickle", "configuration": {}})
    (path / "time/zarr.json").write_text(json.dumps(meta))
    assert "time uses codec 'numcodecs.pickle'" in complaint(lambda: read("zarr", path))
    shards = {"name": "sharding_indexed", "configuration": {"codecs": [{"name": "evil"}], "index_codecs": []}}
    (path / "time/zarr.json").write_text(json.dumps(meta | {"codecs": [shards]}))
    assert "time uses codec 'evil'" in complaint(lambda: read("zarr", path))


def test_link_in_a_zarr_folder_is_rejected(tmp_path):
    path = write(tmp_path / "b.zarr", arrays())
    chunk = path / "time/c/0"
    chunk.rename(tmp_path / "elsewhere")
    chunk.symlink_to(tmp_path / "elsewhere")
    assert "b.zarr/time/c/0: a symbolic link" in complaint(lambda: read("zarr", path))


def test_zarr_folder_of_version_2_is_rejected(tmp_path):
    group = zarr.open_group(tmp_path / "b.zarr", mode="w", zarr_format=2, attributes={"frame": "ecef"})
    for name, values in arrays().items():
        group.create_array(name, data=values)
    assert "no zarr.json in b.zarr" in complaint(lambda: read("zarr", tmp_path / "b.zarr"))


def test_truncated_chunk_is_rejected(tmp_path):
    path = write(tmp_path / "b.zarr", arrays())
    chunk = next(file for file in (path / "transfer/c").rglob("*") if file.is_file())
    chunk.write_bytes(chunk.read_bytes()[:20])
    with pytest.raises(CampaignError, match=r"b\.zarr: not readable"):
        read("zarr", path)


@pytest.fixture
def campaign(tmp_path):
    (tmp_path / "config").mkdir()
    (tmp_path / "raw/f01").mkdir(parents=True)
    (tmp_path / "config/config.yaml").write_text(
        "campaign: c\nwaveform: {kind: phase_history, format: zarr}\nnodes: {a: {}, b: {}}\n"
        "scene: {crs: 'EPSG:32632', bounds_m: [0, 0, 10, 10], spacing_m: 1.0}\n"
    )
    (tmp_path / "config/flights.tsv").write_text("flight\tkind\ttransmitter\tnodes\nf01\timage\ta\tb\n")
    write(tmp_path / "raw/f01/b.pass.zarr", arrays())
    return Campaign.load(tmp_path)


def test_every_file_of_a_zarr_folder_belongs_to_the_recording(campaign):
    require_files(campaign)
    files = campaign.raw_files("f01", "b")
    assert {"history.b.pass.zarr/zarr.json", "history.b.pass.zarr/time/c/0"} <= set(files)
    assert read_phase_history("zarr", campaign.history_files("f01", "b"), pair="a-b").sizes["pulse"] == PULSES


def test_zarr_folder_that_leads_out_of_the_campaign_is_rejected(campaign, tmp_path_factory):
    elsewhere, inside = tmp_path_factory.mktemp("elsewhere"), campaign.root / "raw/f01/b.pass.zarr"
    shutil.move(str(inside / "time"), str(elsewhere / "time"))
    Path(inside / "time").symlink_to(elsewhere / "time")
    assert "time: a symbolic link" in complaint(lambda: campaign.history_files("f01", "b"))
    inside.remove()
    Path(inside).symlink_to(elsewhere)
    assert "b.pass.zarr: a symbolic link" in complaint(lambda: campaign.history_files("f01", "b"))
