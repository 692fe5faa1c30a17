"""A campaign folder brings data. Whatever else lies in it is not run: each test would leave a marker if it were."""

import os
import pickle
import subprocess
import sys
from pathlib import Path

import pytest
from folders import copy_writable

ROOT = Path(__file__).parents[1]
BIN = Path(sys.executable).parent
CODE = "import os; os.close(os.open({marker!r}, os.O_CREAT))"

LOOKS = ("plan", "check", "summary", "step scene")
"""What a person types in a campaign folder."""

ROADS = {
    "snakemake from the sources": ([BIN / "snakemake", "--directory", "{campaign}"], ROOT),
    "snakemake from elsewhere": (
        [BIN / "snakemake", "--snakefile", ROOT / "Snakefile", "--directory", "{campaign}"],
        None,
    ),
    "apertura from elsewhere": ([BIN / "apertura", "run", "{campaign}"], None),
    "apertura in the campaign": ([BIN / "apertura", "run", "."], "{campaign}"),
    "apertura check in the campaign": ([BIN / "apertura", "check", "."], "{campaign}"),
}


class _Code:
    def __init__(self, code):
        self.code = code

    def __reduce__(self):
        return exec, (self.code,)


def plant(root, marker):
    """Lay code wherever a tool that trusts the folder would look for some."""
    code = CODE.format(marker=str(marker))
    yte = f"__use_yte__: true\n__definitions__:\n  - {code!r}\ncores: 1\n"
    files = dict.fromkeys(("profiles/default/config.yaml", "default/config.yaml", "config.yaml"), yte)
    files |= {f"profiles/default/config.v{version}+.yaml": yte for version in (8, 9)}
    files |= dict.fromkeys(("Snakefile", "workflow/Snakefile", "workflow/profiles/default/Snakefile"), f"{code}\n")
    modules = ("snakemake", "yaml", "numpy", "json", "encodings", "apertura", "sitecustomize", "usercustomize", "zarr")
    files |= {f"{name}.py": f"{code}\n" for name in modules}
    files |= {"apertura/__init__.py": f"{code}\n", "pyproject.toml": "[tool.x]\n", "python.pth": f"import os; {code}\n"}
    files |= dict.fromkeys(("apertura.sh", "bash", "python", ".envrc", ".bashrc"), f"#!/bin/sh\ntouch {marker}\n")
    # Settings that libraries read from the working folder when they are imported; these would be an error at least.
    files |= {".numba_config.yaml": "[", "matplotlibrc": "backend: nosuch\n\x00"}
    for name, text in files.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
        path.chmod(0o755)
    for name in ("iocache/latest.pkl", "metadata/cmVzdWx0cw==", "auxiliary/code.pkl"):
        path = root / ".snakemake" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(pickle.dumps(_Code(code)))


def run(road, campaign, elsewhere, *options):
    command, folder = ROADS[road]
    command = [str(part).format(campaign=campaign) for part in command]
    options = () if "check" in command else ("--cores", "1", *options)
    return subprocess.run(
        [*command, *options],
        cwd=elsewhere if folder is None else str(folder).format(campaign=campaign),
        env={**os.environ, "PATH": f"{BIN}{os.pathsep}/usr/bin:/bin"},
        text=True,
        capture_output=True,
        check=False,
    )


@pytest.mark.slow
@pytest.mark.parametrize("road", ROADS)
def test_no_file_beside_the_data_is_run(tiny, tmp_path, road):
    marker = tmp_path / "marker"
    plant(tiny, marker)
    done = run(road, tiny, tmp_path, "-n")
    assert done.returncode == 0, done.stdout + done.stderr
    assert not marker.exists()


@pytest.mark.parametrize("words", LOOKS)
def test_nor_by_commands_typed_in_the_folder(finished_tiny, tmp_path, words):
    """Such as numba's cache of compiled code, unpickled from where `.numba_config.yaml` says."""
    campaign, marker = copy_writable(finished_tiny.root, tmp_path / "campaign"), tmp_path / "marker"
    plant(campaign, marker)
    words = [*words.split(), *([] if "step" in words or "summary" in words else ["."])]
    done = subprocess.run([BIN / "apertura", *words], cwd=campaign, text=True, capture_output=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert not marker.exists()


@pytest.mark.slow
def test_nor_while_steps_run(tiny, tmp_path):
    marker = tmp_path / "marker"
    plant(tiny, marker)
    done = run("apertura in the campaign", tiny, tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    assert (tiny / "results/f01/fused/coherent_db.tif").is_file()
    assert not marker.exists()


@pytest.mark.slow
@pytest.mark.parametrize("road", ["snakemake from the sources", "apertura in the campaign"])
@pytest.mark.parametrize(
    "line",
    [
        "__use_yte__: true\n__definitions__:\n  - {code!r}\n",
        "x: !!python/object/apply:os.system ['touch {marker}']\n",
        "?__import__('os').system('touch {marker}'): 1\n",
    ],
    ids=["yte", "python tag", "yte key"],
)
def test_code_in_the_config_is_refused_as_a_key_or_a_tag(tiny, tmp_path, road, line):
    marker = tmp_path / "marker"
    path = tiny / "config" / "config.yaml"
    path.write_text(line.format(code=CODE.format(marker=str(marker)), marker=marker) + path.read_text())
    done = run(road, tiny, tmp_path, "-n")
    assert done.returncode != 0
    assert "config/config.yaml" in done.stderr + done.stdout
    assert "Traceback" not in done.stderr + done.stdout
    assert not marker.exists()
