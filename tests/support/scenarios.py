"""Commands that go on after an interruption, each with the folder it starts from: what the tests kill and starve."""

from dataclasses import dataclass

import pytest

BUILD = (
    "datagen build --scene scene --out data/one --preset tiny --resolution 8 --views 1 --test-views 1"
    " --spp 2 --test-spp 2 --num-layers 2"
)
TRAIN = "model train paper data/one --steps 5 --batch 32 --texture-size 8 --hidden 8 --device cpu"
GRID = f"{TRAIN.replace('--steps 5', '--steps 2')} --{{no-,}}zero-layer"

PREPARED: dict[str, tuple[str, ...]] = {
    "scene": ("",),
    "dataset": ("scene", BUILD),
    "proxies": ("dataset", "proxies make data/one --kind box"),
    "run": ("dataset", f"{TRAIN} --out runs/one/paper"),
    "variants": ("dataset", "datagen add data/one --angles"),
    "drawn": ("variants", f"{TRAIN} --out runs/one/paper"),
}
"""By name: the state to start from (none: a scene's folder alone), and the commands that follow."""


@dataclass(frozen=True, kw_only=True)
class Scenario:
    """A command that writes."""

    name: str
    start: str
    """The prepared state that it starts from."""
    line: str


SCENARIOS = (
    Scenario(name="build", start="scene", line=BUILD),
    Scenario(name="build anew", start="dataset", line=f"{BUILD} --seed 1 --overwrite"),
    Scenario(name="peel anew", start="proxies", line="datagen peel data/one --num-layers 3 --overwrite"),
    Scenario(name="proxies", start="dataset", line="proxies make data/one --kind box"),
    Scenario(name="proxies anew", start="proxies", line="proxies make data/one --kind box --overwrite"),
    Scenario(name="angle splits", start="dataset", line="datagen add data/one --angles"),
    Scenario(name="larger", start="dataset", line="datagen add data/one --larger 2"),
    Scenario(name="edit", start="proxies", line="datagen add data/one --edit remove:pane"),
    Scenario(name="train", start="dataset", line=f"{TRAIN} --out runs/one/paper"),
    Scenario(name="train anew", start="run", line=f"{TRAIN} --out runs/one/paper --seed 1 --overwrite"),
    Scenario(name="render", start="run", line="model predict runs/one/paper --device cpu --overwrite"),
    Scenario(name="sweep", start="dataset", line="model sweep grid.txt"),
    Scenario(name="report", start="run", line="report"),
)

QUICK = ("build", "build anew", "proxies anew", "train", "train anew", "render")
"""What `make test` tries: between them these commit each kind of file, for the first time and over another one."""

EACH_SCENARIO = pytest.mark.parametrize(
    "scenario",
    [pytest.param(item, id=item.name, marks=() if item.name in QUICK else pytest.mark.full) for item in SCENARIOS],
)
