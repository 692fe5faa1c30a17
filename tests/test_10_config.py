"""Model of the config: generated files and rejected values."""

import json
import re
import tomllib
from pathlib import Path

import pytest
import yaml
from typer.main import get_command
from typer.testing import CliRunner

import apertura
from apertura.campaign.config import Processing, Scene, Settings, validated
from apertura.campaign.config.template import WAVEFORMS, config_schema, config_template
from apertura.cli import app
from apertura.common import documents
from apertura.common.errors import CampaignError
from apertura.workflow.lineage import result_of

ROOT = Path(__file__).parents[1]
CONDA_NAMES = {"dask": "dask-core", "matplotlib": "matplotlib-base", "snakemake": "snakemake-minimal"}


def test_template_is_valid_and_comments_every_key():
    lines = config_template().splitlines()
    assert validated(yaml.safe_load(config_template()), where="template").campaign == "my_campaign"
    keys = [number for number, line in enumerate(lines) if re.match(r"\s*[a-z_]+:", line)]
    uncommented = [lines[n] for n in keys if not lines[n - 1].lstrip().startswith("#")]
    assert len(keys) > 30
    assert uncommented == []


def test_template_lists_ranges_and_choices_of_engine_options():
    template = config_template()
    assert re.search(r"tree\.oversampling: .* \(8 to 64\)\n", template)
    assert re.search(r"native\.tolerance_rad: .* \(above 0 to 0\.1\)\n", template)
    assert re.search(r"tree\.chunk: .* \(256 \| 512 \| 1024 \| 2048\)\n", template)


@pytest.mark.parametrize("kind", WAVEFORMS)
def test_init_writes_a_valid_config_of_the_requested_kind(tmp_path, kind):
    run = CliRunner().invoke(app, ["init", str(tmp_path / "new"), "--kind", kind])
    assert run.exit_code == 0, run.output
    text = (tmp_path / "new/config/config.yaml").read_text(encoding="utf-8")
    assert validated(yaml.safe_load(text), where="config.yaml").waveform.kind == kind
    comment, line = re.search(r"^ *# (.*)\n( *kind: .*)$", text, re.M).groups()
    assert line.strip() == f"kind: {kind}"
    named = re.sub(r"\(.*?\)", "", comment)  # a description in brackets may use the name of another kind
    assert [other for other in WAVEFORMS if not re.search(rf"\b{other}\b", named)] == []
    assert set(yaml.safe_load(text)["waveform"]) == set(WAVEFORMS[kind].model_fields)
    option = next(parameter for parameter in get_command(app).commands["init"].params if parameter.name == "kind")
    assert set(re.findall(r"\w+", option.help)) >= set(WAVEFORMS)


def test_unknown_waveform_kind_is_rejected_without_writing(tmp_path):
    error = CliRunner().invoke(app, ["init", str(tmp_path / "new"), "--kind", "chirp"]).exception
    assert isinstance(error, CampaignError)
    assert "'chirp'" in str(error)
    assert "ofdm, samples, phase_history, fmcw" in str(error)
    assert not (tmp_path / "new").exists()


def test_schema_accepts_the_template_and_rejects_a_misspelt_key():
    import jsonschema

    document = yaml.safe_load(config_template())
    jsonschema.validate(document, json.loads(config_schema()))
    document["scene"]["hight_m"] = 1.0
    with pytest.raises(jsonschema.ValidationError, match="hight_m"):
        jsonschema.validate(document, json.loads(config_schema()))


def test_environment_yml_matches_pyproject():

    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    required = dict(re.match(r"([\w.-]+)(.*)", d).groups() for d in project["dependencies"])
    required = {CONDA_NAMES.get(name, name): bound for name, bound in required.items()} | {
        "python": project["requires-python"]
    }
    *conda, pip = yaml.safe_load((ROOT / "environment.yml").read_text())["dependencies"]
    assert dict(re.match(r"([\w.-]+)(.*)", d).groups() for d in conda) == required | {"pip": ""}
    assert pip == {"pip": [f"apertura=={apertura.__version__}"]}


def test_requirements_are_locked_by_hash_without_a_registry():
    for file in ("all.txt", "uv.txt", "wheel.txt"):
        text = (ROOT / "requirements" / file).read_text()
        pins = re.findall(r"^[\w.-]+==", text, re.M)
        assert pins
        assert len(re.findall(r"^[\w.-]+==[^\n]*\\\n\s+--hash=sha256:", text, re.M)) == len(pins)
        assert "://" not in text


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"symbol_s": 1e-6}, "shorter than the DFT window"),
        ({"subcarriers": 20000}, "exceeds the DFT length"),
        ({"subcarrier_spacing_hz": 99e3}, "must be an integer"),
        ({"kind": "chirp"}, "ofdm"),
    ],
)
def test_waveform_that_cannot_be_demodulated_is_rejected(change, expected):
    document = yaml.safe_load(config_template())
    document["waveform"] |= change
    with pytest.raises(CampaignError, match=expected):
        validated(document, where="config.yaml")


def test_iq_order_of_a_node_overrides_that_of_sampled_waveforms():
    document = yaml.safe_load(config_template()) | {"nodes": {"uav1": {}, "uav2": {"iq": "conjugate"}}}
    document["waveform"]["iq"] = "swapped"
    settings = validated(document, where="config.yaml")
    assert [settings.iq_of(node) for node in ("uav1", "uav2")] == ["swapped", "conjugate"]
    document = yaml.safe_load(config_template("fmcw")) | {"nodes": {"uav1": {"iq": "conjugate"}}}
    with pytest.raises(CampaignError, match=r"nodes\.uav1\.iq applies to recorded samples only"):
        validated(document, where="config.yaml")


def test_stage_depends_only_on_its_own_settings(finished_tiny):
    """A step that depends on the complete config would be rerun unnecessarily."""
    everything = {*Settings.model_json_schema()["properties"], *Processing.model_json_schema()["properties"]}
    of = {"scene": ()}
    stages = {
        stage: result_of(finished_tiny, stage, *of.get(stage, ("f01", "uav1-uav1"))).settings
        for stage in ("echo", "profile", "image", "scene")
    }
    assert all(set(settings) < everything for settings in stages.values())
    assert not {"window", "sidelink"} & stages["image"].keys()
    assert set(stages["echo"]["nodes"]) == {"uav1"}
    assert "window" not in stages["echo"]


def test_layers_without_settings_do_not_name_the_config_file():
    layers = [ROOT / "src/apertura" / layer for layer in ("core", "methods", "formats/export", "formats/catalog")]
    files = [file for layer in layers for file in layer.rglob("*.py")]
    assert len(files) > 80
    assert [file for file in files if "config/config.yaml" in file.read_text(encoding="utf-8")] == []


def read_scene(scene):
    return documents.validated(Scene, scene, where="config", expected="a scene")


@pytest.mark.parametrize(
    ("configured", "horizontal_crs"),
    [
        ({"crs": "EPSG:32632"}, "EPSG:32632"),
        ({"crs": "IGNF:LAMB93"}, "IGNF:LAMB93"),
        ({"crs": "EPSG:32632+5773", "height_datum": "egm96"}, "EPSG:32632"),
        ({"crs": "EPSG:32632+EPSG:3855", "dem": "d.tif", "dem_datum": "egm2008"}, "EPSG:32632"),
    ],
)
def test_pixels_use_the_horizontal_part_of_a_compound_crs(configured, horizontal_crs):
    assert read_scene(configured).crs == horizontal_crs


@pytest.mark.parametrize(
    ("configured", "message"),
    [
        ({"crs": "EPSG:32632+5773"}, "has the vertical datum egm96, but height_datum is 'ellipsoid'"),
        (
            {"crs": "EPSG:32632+7837", "height_datum": "egm96"},
            "has the vertical datum EPSG:7837, but height_datum is 'egm96'",
        ),
        (
            {"crs": "EPSG:32632+3855", "dem": "d.tif", "dem_datum": "egm96"},
            "has the vertical datum egm2008, but dem_datum is",
        ),
        ({"crs": "+proj=utm +zone=32"}, "must be authority and code such as EPSG:32632"),
        ({"crs": "+init=/elsewhere/file:9"}, "must be authority and code such as EPSG:32632"),
        ({"crs": "urn:ogc:def:crs:EPSG::32632"}, "must be authority and code such as EPSG:32632"),
        ({"crs": "EPSG:32632+geoidgrids=x"}, "must be authority and code such as EPSG:32632"),
        ({"crs": "EPSG:32632\n"}, "must be authority and code such as EPSG:32632"),
    ],
)
def test_conflicting_vertical_datum_and_proj_strings_are_rejected(configured, message):
    with pytest.raises(CampaignError, match=re.escape(message)):
        read_scene(configured)


def test_bounds_off_the_spacing_report_the_nearest_grid():
    document = {"campaign": "c", "waveform": {"kind": "phase_history", "format": "cphd"}, "nodes": {"a": {}}}
    document["scene"] = {"crs": "EPSG:32632", "bounds_m": [0.0, 0.0, 10.1, 10.0], "spacing_m": 0.25}
    with pytest.raises(CampaignError) as refused:
        validated(document, where="config.yaml")
    assert "10.1, 10.0] is 40.4 × 40 pixels of 0.25 m; the nearest whole grid is [0.0, 0.0, 10.0, 10.0]" in str(
        refused.value
    )
    assert refused.value.expected == "consistent values"


@pytest.mark.parametrize(
    ("orcid", "problem"),
    [
        ("0000-0002-1825-0097", None),
        ("https://orcid.org/0000-0002-1694-233X", None),
        ("0000-0002-1825-0079", "the check character must be 0"),
        ("0000-0002-1825-009X", "the check character must be 7"),
        ("0000-0002-1852-0097", "the check character must be"),
        ("0000 0002 1825 0097", "must be an ORCID iD such as 0000-0002-1825-0097"),
    ],
)
def test_orcid_with_a_wrong_digit_is_rejected(orcid, problem):
    """ISO 7064 MOD 11-2 detects every single wrong digit and every transposition; the valid iDs are published ones."""
    document = {"campaign": "c", "waveform": {"kind": "phase_history", "format": "cphd"}, "nodes": {"a": {}}}
    document["metadata"] = {"creators": [{"name": "A. Nother", "orcid": orcid}]}
    if problem is None:
        assert validated(document, where="x").metadata.creators[0].orcid == orcid.removeprefix("https://orcid.org/")
    else:
        with pytest.raises(CampaignError, match=problem):
            validated(document, where="x")
