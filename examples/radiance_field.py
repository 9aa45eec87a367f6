"""Trains somebody else's radiance field on a dataset's pictures, so that `report` sets it beside ours.

    python examples/radiance_field.py glass_table                        # nerfacto, on a CPU
    python examples/radiance_field.py glass_table --method splatfacto    # Gaussian splats, on an NVIDIA GPU

Both methods are nerfstudio's. It needs older libraries than hyaline, so it is installed into an environment of its own
(8 GB). It gets training pictures and cameras, as `datagen export --format nerfstudio` writes them, and draws the test
views, those by angle included, into runs/SCENE/METHOD, where `report` and `hyaline-bench` find them.

We have trained nerfacto only. splatfacto needs CUDA, which we do not have: its command was never run.
"""

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
import venv
from pathlib import Path
from typing import NamedTuple

NERFSTUDIO = "nerfstudio==1.1.5"
CONSTRAINTS = ("numpy<2", "torch<2.15", "torchvision<0.30")
"""nerfstudio names no upper versions of these; numpy 2 breaks it, and the others are those that we tried."""


class Method(NamedTuple):
    """How a method of nerfstudio is trained here."""

    device: str
    steps: int
    flags: tuple[str, ...]


METHODS = {
    "nerfacto": Method(
        device="cpu",
        steps=1500,
        flags=(
            # Its own sizes are for a GPU: a step of 1,024 rays takes 8 CPU seconds with them, and 0.4 with these.
            *("--pipeline.model.implementation", "torch"),
            *("--pipeline.datamanager.train-num-rays-per-batch", "1024"),
            *("--pipeline.model.log2-hashmap-size", "15"),
            *("--pipeline.model.num-levels", "8"),
            *("--pipeline.model.features-per-level", "4"),
            *("--pipeline.model.num-proposal-samples-per-ray", "64", "32"),
            *("--pipeline.model.num-nerf-samples-per-ray", "24"),
            *("--pipeline.model.proposal-net-args-list.0.log2-hashmap-size", "13"),
            *("--pipeline.model.proposal-net-args-list.0.num-levels", "4"),
            *("--pipeline.model.proposal-net-args-list.0.max-res", "64"),
            *("--pipeline.model.proposal-net-args-list.1.log2-hashmap-size", "14"),
            *("--pipeline.model.proposal-net-args-list.1.num-levels", "4"),
            *("--pipeline.model.proposal-net-args-list.1.max-res", "128"),
            # Cameras are exact, and all pictures are equally exposed.
            *("--pipeline.model.camera-optimizer.mode", "off"),
            *("--pipeline.model.use-appearance-embedding", "False"),
        ),
    ),
    "splatfacto": Method(
        device="cuda",
        steps=30000,
        # The exported points lie on the true surfaces, which pictures alone do not show.
        flags=("--pipeline.model.random-init", "True"),
    ),
}


def main() -> None:
    choices = parse()
    dataset = choices.dataset if choices.dataset.is_dir() else Path("data") / choices.dataset
    name = dataset.resolve().name
    folder = choices.out or Path("runs") / name / choices.method
    if folder.exists():
        raise SystemExit(f"{folder}: exists; remove it, or set another --out")
    python = install(choices.environment)
    pictures = Path("exports") / f"{name}-nerfstudio"
    words = ("export", dataset, "--format", "nerfstudio", "--out", pictures)
    subprocess.run([sys.executable, "-m", "datagen", *words], check=True, stdout=sys.stderr)
    add_angles(dataset, pictures)
    work = Path("exports") / f"{name}-{choices.method}"
    seconds = train(python, pictures, work, choices)
    draw(python, work, choices.method)
    keep(work, folder, dataset, choices, seconds)
    print(folder)


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description="Train a radiance field of nerfstudio on a dataset, and draw its test views.",
        epilog="Other flags are passed on to ns-train.",
    )
    parser.add_argument("dataset", type=Path, help="a dataset's folder, or its name under data/")
    parser.add_argument("--method", choices=[*METHODS], default="nerfacto", help="default: nerfacto")
    parser.add_argument("--steps", type=int, help="default: 1500 for nerfacto, 30000 for splatfacto")
    parser.add_argument("--out", type=Path, help="folder of the run; default: runs/DATASET/METHOD")
    parser.add_argument(
        "--environment",
        type=Path,
        default=Path("build/nerfstudio"),
        help="virtual environment of nerfstudio, made if it is missing; default: build/nerfstudio",
    )
    choices, flags = parser.parse_known_args()
    choices.steps = choices.steps or METHODS[choices.method].steps
    return argparse.Namespace(**vars(choices), flags=flags)


def install(environment: Path) -> Path:
    """The Python of an environment that has nerfstudio, which is made once."""
    python = environment.absolute() / "bin" / "python"
    if not (python.parent / "ns-train").is_file():
        print(f"installs {NERFSTUDIO} into {environment}", file=sys.stderr)
        venv.create(environment, with_pip=True)
        subprocess.run([python, "-m", "pip", "install", NERFSTUDIO, *CONSTRAINTS], check=True)
    return python


def add_angles(dataset: Path, pictures: Path) -> None:
    """Adds the views by angle of `datagen add DATASET --angles` to the exported test views, if the dataset has them."""
    path = pictures / "transforms.json"
    transforms = json.loads(path.read_text())
    for cameras in sorted((dataset / "variants" / "angles").glob("transforms_*.json")):
        split = cameras.stem.removeprefix("transforms_")
        for number, frame in enumerate(json.loads(cameras.read_text())["frames"]):
            name = f"images/{split}_{number:04d}.png"
            shutil.copyfile(cameras.parent / "images" / split / f"{number:04d}.png", pictures / name)
            transforms["frames"].append({"file_path": name, "transform_matrix": frame["transform_matrix"]})
            transforms["test_filenames"].append(name)
    for frame in transforms["frames"]:
        frame.pop("depth_file_path", None)  # nerfstudio expects it of all frames or of none.
    path.write_text(json.dumps(transforms))


def train(python: Path, pictures: Path, work: Path, choices: argparse.Namespace) -> float:
    """Trains in WORK/METHOD/run, and returns the processor seconds that it took."""
    method = METHODS[choices.method]
    shutil.rmtree(work, ignore_errors=True)
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    call(
        *(python, "train", choices.method, "--data", pictures),
        *("--output-dir", work.parent, "--experiment-name", work.name, "--timestamp", "run"),
        *("--max-num-iterations", choices.steps, "--vis", "tensorboard", "--machine.device-type", method.device),
        *(*method.flags, *choices.flags),
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def draw(python: Path, work: Path, method: str) -> None:
    """Draws both test splits into WORK/test/rgb, under the names of the exported pictures."""
    config = work / method / "run" / "config.yml"
    names = ("--split", "test", "--rendered-output-names", "rgb", "--image-format", "png")
    rays = ("--eval-num-rays-per-chunk", "4096")
    call(python, "render", "dataset", "--load-config", config, "--output-path", work, *rays, *names)


PROGRAM = """
import sys, torchvision
alexnet = torchvision.models.alexnet
torchvision.models.alexnet = lambda weights=None, **others: alexnet(**others)
from nerfstudio.scripts.{name} import entrypoint
sys.argv[0] = "ns-{name}"
entrypoint()
"""
"""ns-train or ns-render, which would download weights for a score (LPIPS) of their own. `report` has its own scores."""


def call(python: Path, name: str, *words: object) -> None:
    # nerfstudio 1.1.5 expects torch.load to read its checkpoints, which hold more than tensors.
    environment = {**os.environ, "TORCH_FORCE_NO_WEIGHTS_ONLY_LOAD": "1"}
    command = [python, "-W", "ignore", "-c", PROGRAM.format(name=name), *words]
    subprocess.run(list(map(str, command)), check=True, env=environment, stdout=sys.stderr)


def keep(work: Path, folder: Path, dataset: Path, choices: argparse.Namespace, seconds: float) -> None:
    """Copies the pictures to where `report` expects them, with what its tables print beside the scores."""
    for picture in sorted((work / "test" / "rgb").glob("*.png")):
        split, number = picture.stem.split("_")
        home = folder / "variants" / "angles" if split.endswith("deg") else folder
        place = home / "predictions" / split / f"{number}.png"
        place.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(picture, place)
    run = {
        "method": choices.method,
        "geometry": "none",
        "knowledge": "cameras only",
        "dataset": str(dataset),
        "config": {"package": NERFSTUDIO, "steps": choices.steps, "flags": choices.flags},
    }
    (folder / "run.json").write_text(json.dumps(run, indent=2) + "\n")
    (folder / "costs.json").write_text(json.dumps({"cpu_seconds": round(seconds, 2)}) + "\n")


if __name__ == "__main__":
    try:
        main()
    except subprocess.CalledProcessError as error:
        sys.exit(error.returncode)  # The program has said why.
