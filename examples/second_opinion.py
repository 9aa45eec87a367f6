"""Scores the pictures of all runs on a dataset by the code of nerfbaselines, too, and sets both scores side by side.

    report                                          # writes runs/report/results.json
    python examples/second_opinion.py glass_table

nerfbaselines is installed into an environment of its own (0.6 GB). It is given the PNG files alone, so reading and
averaging are compared, too. Exit status: 1 if scores differ by more than single precision explains.
"""

import argparse
import json
import subprocess
import sys
import venv
from pathlib import Path

NERFBASELINES = "nerfbaselines==1.2.12"
SPLITS = ("interpolating", "extrapolating")
TITLES = {"psnr_db": ("PSNR dB", 4), "ssim": ("SSIM", 5)}
TOLERANCE = {"psnr_db": 1e-4, "ssim": 1e-5}
"""nerfbaselines computes in single precision."""

PROGRAM = """
import json, sys
import numpy as np
from nerfbaselines import metrics
from nerfbaselines.utils import convert_image_dtype
from PIL import Image

def read(path):
    with Image.open(path) as image:
        return convert_image_dtype(np.asarray(image.convert("RGB")), np.float32)

answers = []
for pairs in json.load(sys.stdin):
    scores = [(metrics.psnr(*both), metrics.ssim(*both)) for both in ([read(path) for path in pair] for pair in pairs)]
    answers.append([float(np.mean(values)) for values in zip(*scores)])
json.dump(answers, sys.stdout)
"""
"""Lists of pairs (truth, prediction) of paths in; the means of PSNR and SSIM of each list out."""


def main() -> None:
    choices = parse()
    report = json.loads(choices.results.read_text())
    found = [scene for scene in report["scenes"] if scene["scene"] == choices.dataset.name]
    if not found:
        raise SystemExit(f"{choices.results}: has no scores of {choices.dataset.name}; run `report` first")
    rows = [(run, split) for run in found[0]["runs"] for split in SPLITS if run["splits"].get(split)]
    pairs = [pictures(choices, run["run"], split) for run, split in rows]
    answer = subprocess.run(
        [install(choices.environment), "-W", "ignore", "-c", PROGRAM],
        input=json.dumps(pairs),
        capture_output=True,
        text=True,
        check=False,
    )
    if answer.returncode:
        raise SystemExit(answer.stderr)
    sys.exit(compare(rows, json.loads(answer.stdout)))


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Score the pictures of all runs on a dataset by nerfbaselines, too.")
    parser.add_argument("dataset", type=Path, help="a dataset's folder, or its name under data/")
    parser.add_argument("--results", type=Path, default=Path("runs/report/results.json"), help="scores of `report`")
    parser.add_argument("--runs", type=Path, help="folder of the runs; default: runs/SCENE")
    parser.add_argument(
        "--environment",
        type=Path,
        default=Path("build/nerfbaselines"),
        help="virtual environment of nerfbaselines, made if it is missing; default: build/nerfbaselines",
    )
    choices = parser.parse_args()
    choices.dataset = choices.dataset if choices.dataset.is_dir() else Path("data") / choices.dataset
    choices.runs = choices.runs or Path("runs") / choices.dataset.name
    return choices


def pictures(choices: argparse.Namespace, run: str, split: str) -> list[tuple[str, str]]:
    """Paths of the true and the predicted pictures of a split."""
    truths = sorted((choices.dataset / "images" / split).glob("*.png"))
    return [(str(truth), str(choices.runs / run / "predictions" / split / truth.name)) for truth in truths]


def install(environment: Path) -> Path:
    """The Python of an environment that has nerfbaselines, which is made once."""
    python = environment.absolute() / "bin" / "python"
    if not (python.parent / "nerfbaselines").is_file():
        print(f"installs {NERFBASELINES} into {environment}", file=sys.stderr)
        venv.create(environment, with_pip=True)
        subprocess.run([python, "-m", "pip", "install", "--quiet", NERFBASELINES], check=True)
    return python


def compare(rows: list[tuple[dict, str]], answers: list[list[float]]) -> int:
    """Prints both scores of every run, and returns the exit status."""
    names = [f"{title}{who}" for title, _ in TITLES.values() for who in ("", ", nerfbaselines")]
    print(f"| run | split | {' | '.join(names)} |\n|---|---|{'---:|' * len(names)}")
    differing = 0
    for (run, split), answer in zip(rows, answers, strict=True):
        cells = []
        for (key, (_, decimals)), other in zip(TITLES.items(), answer, strict=True):
            ours = float(run["splits"][split][key]["mean"])  # "inf" where pictures are equal.
            differing += ours != other and not abs(ours - other) <= TOLERANCE[key]
            cells += [f"{ours:.{decimals}f}", f"{other:.{decimals}f}"]
        print(f"| {run['run']} | {split} | {' | '.join(cells)} |")
    if differing:
        print(f"{differing} scores differ", file=sys.stderr)
    return int(differing > 0)


if __name__ == "__main__":
    main()
