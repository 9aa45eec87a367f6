"""Tests that `examples/radiance_field.py` brings another program's pictures to where `report` scores them."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from support.commands import call
from support.traced_dataset import write_traced_dataset

SCRIPT = Path(__file__).resolve().parents[3] / "examples" / "radiance_field.py"

STAND_IN = """#!{python}
import json, shutil, sys
from pathlib import Path
_, _, _, _, program, *words = sys.argv
get = lambda flag: words[words.index(flag) + 1]
if "nerfstudio.scripts.train" in program:
    run = Path(get("--output-dir"), get("--experiment-name"), words[0], get("--timestamp"))
    run.mkdir(parents=True)
    (run / "config.yml").write_text(json.dumps(dict(data=get("--data"), words=words)))
else:
    data = Path(json.loads(Path(get("--load-config")).read_text())["data"])
    for name in json.loads((data / "transforms.json").read_text())["test_filenames"]:
        place = Path(get("--output-path"), get("--split"), "rgb", Path(name).name)
        place.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(data / name, place)
"""
"""The Python of an environment whose nerfstudio draws every test view as it is."""


@pytest.fixture
def environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An environment with that Python; the current folder is one with the dataset `glasses`."""
    programs = tmp_path / "environment" / "bin"
    programs.mkdir(parents=True)
    for name in ("python", "ns-train"):
        (programs / name).write_text(STAND_IN.format(python=sys.executable))
        (programs / name).chmod(0o755)
    write_traced_dataset(tmp_path / "data" / "glasses", resolution=16)
    monkeypatch.chdir(tmp_path)
    return programs.parent


def run(*words: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, SCRIPT, *map(str, words)], capture_output=True, text=True)


def test_what_it_draws_is_scored_against_the_same_views(environment: Path) -> None:
    answer = run("glasses", "--environment", environment, "--seed-of-ns-train", 3)
    assert answer.returncode == 0, answer.stderr
    assert answer.stdout == "runs/glasses/nerfacto\n"
    again = run("glasses", "--environment", environment)
    assert again.returncode == 1 and "runs/glasses/nerfacto: exists" in again.stderr
    words = json.loads(Path("exports/glasses-nerfacto/nerfacto/run/config.yml").read_text())["words"]
    assert words[-2:] == ["--seed-of-ns-train", "3"] and "1500" in words
    assert call("report").status == 0
    (scene,) = json.loads(Path("runs/report/results.json").read_text())["scenes"]
    (scored,) = scene["runs"]
    assert (scored["method"], scored["geometry"]) == ("nerfacto", "none") and scored["cpu_seconds"] > 0
    for split in ("interpolating", "extrapolating"):
        assert scored["splits"][split]["psnr_db"]["pictures"] == ["inf", "inf"]


def test_views_by_angle_are_drawn_beside_the_others(environment: Path) -> None:
    angles = Path("data/glasses/variants/angles")
    frame = json.loads(Path("data/glasses/transforms_test.json").read_text())["frames"][0]
    (angles / "images" / "extrapolating-10deg").mkdir(parents=True)
    picture = angles / "images" / "extrapolating-10deg" / "0000.png"
    picture.write_bytes(b"as it is")
    (angles / "transforms_extrapolating-10deg.json").write_text(json.dumps({"frames": [frame]}))
    answer = run("glasses", "--environment", environment)
    assert answer.returncode == 0, answer.stderr
    drawn = Path("runs/glasses/nerfacto/variants/angles/predictions/extrapolating-10deg/0000.png")
    assert drawn.read_bytes() == picture.read_bytes()
    told = json.loads(Path("exports/glasses-nerfstudio/transforms.json").read_text())
    assert told["frames"][-1]["transform_matrix"] == frame["transform_matrix"]
    assert not any("depth_file_path" in each for each in told["frames"])
