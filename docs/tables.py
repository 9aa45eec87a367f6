"""Fills the marked tables of README.md, RESULTS.md and the pages in `DOCS`; `make results` runs it.

A table lies between `<!-- table: NAME -->` and `<!-- end -->`. In that of `claims`, NAME's rows are written by hand but
for their last two columns; every other one is a key of `TABLES`. plugins/tests/docs/test_claims.py compares tables and
the numbers of sentences with the stored results.
"""

import json
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from datagen.data.paths import TRUTH
from hyaline_paper.claims import CLAIMS, DROP, FAR, NEAR, Interval, bootstrap, decide, over_scenes
from hyaline_paper.comparisons import PUBLISHED

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "docs/results"
DOCS = ("index", "paper", "claims", "photographs")
PAGES = tuple(ROOT / name for name in ("README.md", "RESULTS.md", *(f"docs/{name}.md" for name in DOCS)))
TABLE = re.compile(r"(<!-- table: (\S+) -->\n)(.*?)(<!-- end -->)", re.DOTALL)
ROW = re.compile(r"^\| (?P<claim>.+?) \| (?P<against>.+?) \| `(?P<cell>.+?)` \|.*\|$", re.MULTILINE)
SPLITS = ("interpolating", "extrapolating")
ANGLES = (10, 20, 40)
TRACKS = ("pictures", "masks", "proxies", "shapes", "materials")
"""The benchmark's tracks, ordered by what methods are told."""
DEMO = {
    "light-path": ("`light-path`", "truth", "materials"),
    "paper-best": ("`paper-best`", "truth", ""),
    "paper": ("`paper`", "truth", ""),
    "paper-ellipsoid": ("`paper`", "ellipsoids", ""),
}
"""Runs of the demo: method, geometry and what else they know."""
STANDARD = {"light-path-3500-steps": "light-path", "paper-best-7000-steps": "paper-best", "paper-5000-steps": "paper"}
"""Runs of `standard`, each with twice the usual steps, and their methods."""
MEETS_GLASS = "changed_psnr_db"
"""PSNR of pixels whose light meets glass, by which the benchmark ranks."""
EDITED = "edited_psnr_db"
"""PSNR where edited objects are or were, the mean of a scene's edits."""
PAIRS = (
    ("paper", "dnr"),
    ("paper", "mlp-first"),
    ("dnr-layers", "dnr"),
    ("paper", "dnr-layers"),
    ("mlp-first", "dnr"),
    ("paper-best", "paper"),
    ("light-path", "paper-best"),
)
"""Methods of the benchmark whose difference is printed."""
PHOTOGRAPHS = {
    "light-path-fitted": ("`light-path`", "fitted: full of water"),
    "light-path-fitted-solid": ("`light-path`", "its outside as solid glass of index 1.5"),
    "paper-best-fitted-solid": ("`paper-best`", "the same"),
    "light-path-fitted-none": ("`light-path`", "left out"),
    "nerfacto": ("nerfacto, 1,500 steps", "no shape"),
}
"""Runs on the photographs of a shot glass: method, and the glass that it is given."""
FITS = (
    ("fits",),
    ("fits-unseen",),
    ("fits-unseen-2", "fits-unseen-3", "fits-unseen-4"),
    ("fits-unseen-5",),
    ("fits-unseen-6",),
)
"""Files with fits of random scenes; the code of each differs, and so do the scenes."""

Scores = list[np.ndarray]
"""Scores of the interpolating, then of the extrapolating split, by seed and picture."""


@dataclass(frozen=True, kw_only=True)
class Found:
    """Numbers of the stored results, and how sure they are."""

    numbers: tuple[float, ...]
    unit: str
    intervals: tuple[Interval | None, ...] = ()

    def __add__(self, other: "Found") -> "Found":
        units = dict.fromkeys(filter(None, (self.unit, other.unit)))
        return Found(
            numbers=self.numbers + other.numbers,
            unit="; ".join(units),
            intervals=self.intervals + other.intervals,
        )


# Reading


@cache
def _read(name: str) -> dict[str, Any]:
    (path,) = RESULTS.glob(f"*/{name}.json")
    return json.loads(path.read_text())


def _by_scene(file: str, run: str, scenes: str = "", key: str = "psnr_db") -> dict[str, Scores]:
    """Scores of a run and of those that differ from it in the seed alone, by scene; `scenes`: how their names begin."""
    if file == "bench":
        (path,) = (path for path in RESULTS.glob("bench/*.json") if re.sub(r"-\d+-steps$", "", path.stem) == run)
        stored = _read(path.stem)["scenes"]
        found = {
            scene: [np.array([[about["splits"][split]["metrics"][key]]]) for split in SPLITS]
            for scene, about in stored.items()
        }
    else:
        found = {}
        for scene in _read(file)["scenes"]:
            runs = [each["splits"] for each in scene["runs"] if re.sub(r"-seed\d+$", "", each["run"]) == run]
            if key == EDITED:
                edits = scene["analyses"]["variants"].values()
                regions = [each["regions_psnr_db"][run]["object"] for each in edits if "regions_psnr_db" in each]
                found[scene["scene"]] = [np.array([[np.mean([each[split] for each in regions])]]) for split in SPLITS]
            elif runs:
                found[scene["scene"]] = [np.array([each[split][key]["pictures"] for each in runs]) for split in SPLITS]
    return {scene: scores for scene, scores in found.items() if scene.startswith(tuple(scenes.split()) or "")}


def _unit(scores: dict[str, Scores]) -> str:
    seeds, near = next(iter(scores.values()))[0].shape
    of_seeds = f"{seeds} seed{'s' * (seeds > 1)}"
    if len(scores) > 1:
        return f"{len(scores)} scenes, {of_seeds}"
    (scene, (_, far)), *_ = scores.items()
    return f"{scene}: {near} + {far.shape[1]} pictures, {of_seeds}" if near > 1 else f"{scene}, {of_seeds}"


def _together(scores: dict[str, Scores]) -> Scores:
    """The scores of the only scene, or the means of each of several."""
    return next(iter(scores.values())) if len(scores) == 1 else list(over_scenes([*scores.values()]))


# What cells of claims.md may call


def score(file: str, run: str, scenes: str = "", key: str = "psnr_db") -> Found:
    """A run's scores on both splits."""
    scores = _by_scene(file, run, scenes, key)
    return Found(numbers=tuple(float(split.mean()) for split in _together(scores)), unit=_unit(scores))


def lead(file: str, run: str, rival: str, scenes: str = "", key: str = "psnr_db") -> Found:
    """How far a run is ahead of another on both splits."""
    return _difference(file, run, rival, scenes, key, (NEAR, FAR))


def drop(file: str, run: str, rival: str, scenes: str = "") -> Found:
    """How much more a run loses than another from the interpolating to the extrapolating split."""
    return _difference(file, run, rival, scenes, "psnr_db", (DROP,))


def _difference(
    file: str, run: str, rival: str, scenes: str, key: str, weights: Sequence[tuple[float, float]]
) -> Found:
    one, other = _shared(file, run, rival, scenes, key)
    gaps = tuple(bootstrap(_together(one), _together(other), weight, of_scenes=len(one) > 1) for weight in weights)
    known = tuple(gap if np.isfinite(gap.low) else None for gap in gaps)
    return Found(numbers=tuple(gap.mean for gap in gaps), unit=_unit(one), intervals=known)


def _shared(file: str, run: str, rival: str, scenes: str, key: str) -> tuple[dict[str, Scores], dict[str, Scores]]:
    one, other = (_by_scene(file, each, scenes, key) for each in (run, rival))
    names = [scene for scene in one if scene in other]
    return {scene: one[scene] for scene in names}, {scene: other[scene] for scene in names}


def _gaps(file: str, run: str, rival: str, scenes: str, key: str) -> tuple[np.ndarray, str]:
    """A run's lead, by split and scene."""
    one, other = _shared(file, run, rival, scenes, key)
    gaps = [[one[scene][split].mean() - other[scene][split].mean() for scene in one] for split in (0, 1)]
    return np.array(gaps), _unit(one)


def median(file: str, run: str, rival: str, scenes: str = "", key: str = "psnr_db") -> Found:
    """The median over scenes of a run's lead, on both splits."""
    gaps, unit = _gaps(file, run, rival, scenes, key)
    return Found(numbers=tuple(np.median(gaps, axis=1).tolist()), unit=unit)


def wins(file: str, run: str, rival: str, scenes: str = "", key: str = "psnr_db") -> Found:
    """In how many scenes a run leads on either split, and the number of scenes."""
    gaps, unit = _gaps(file, run, rival, scenes, key)
    return Found(numbers=(*(gaps > 0).sum(axis=1).tolist(), gaps.shape[1]), unit=unit)


def count(file: str, scenes: str = "", run: str = "paper") -> Found:
    """The number of scenes."""
    scores = _by_scene(file, run, scenes)
    return Found(numbers=(float(len(scores)),), unit="")


def size(file: str) -> Found:
    """Width and height of the pictures of a file's first scene."""
    resolution = _read(file)["scenes"][0]["resolution"]
    return Found(numbers=(float(resolution["width"]), float(resolution["height"])), unit="")


def at(file: str, run: str, rival: str | None = None) -> Found:
    """Scores at cameras 10, 20 and 40 degrees outside the training cameras; of two runs, the first one's lead."""
    (scene,) = _read(file)["scenes"]
    stored = scene["analyses"]["variants"]["angles"]["runs"]

    def means(run: str) -> np.ndarray:
        runs = [splits for name, splits in stored.items() if re.sub(r"-seed\d+$", "", name) == run]
        of_angle = [[each[f"extrapolating-{angle}deg"]["psnr_db"]["mean"] for each in runs] for angle in ANGLES]
        return np.mean(of_angle, axis=1)

    found = means(run) - (0 if rival is None else means(rival))
    return Found(numbers=tuple(found.tolist()), unit=_unit(_by_scene(file, run)))


def ceiling(file: str) -> Found:
    """The stored noise ceiling of both splits."""
    (scene,) = _read(file)["scenes"]
    return Found(numbers=tuple(scene["noise_ceiling_db"][split] for split in SPLITS), unit=scene["scene"])


def larger(run: str, pictures: str = "at that size") -> Found:
    """Scores of pictures four times as wide as those trained on."""
    (grid,) = _read("larger")["tables"]["larger"]
    (row,) = (row for row in grid["rows"] if row[:3] == ["512 x 512", run, pictures])
    return Found(numbers=tuple(map(float, row[3:5])), unit="glass_table: 2 + 2 pictures, 1 seed")


def published(split: str) -> Found:
    """The lowest and the highest score in the paper's tables."""
    found = [scores[SPLITS.index(split)] for scores in PUBLISHED]
    return Found(numbers=(min(found), max(found)), unit="the paper's tables")


def stated(*numbers: float, by: str) -> Found:
    """Settings, and numbers that others state."""
    return Found(numbers=tuple(map(float, numbers)), unit=by)


CALLS = (score, lead, drop, median, wins, count, size, at, ceiling, larger, published, stated)


def evaluated(cell: str) -> Found:
    """What a cell of claims.md finds in the stored results."""
    return eval(cell, {call.__name__: call for call in CALLS})  # Our own page.


# Tables


def table_of(columns: Sequence[str], rows: Sequence[Sequence[str]], *, texts: int) -> str:
    """A table in Markdown whose first columns are texts and whose others are numbers."""
    rules = ["---"] * texts + ["---:"] * (len(columns) - texts)
    return "".join(f"| {' | '.join(cells)} |\n" for cells in (columns, rules, *rows))


def _signed(value: float, decimals: int = 2) -> str:
    return f"{round(value, decimals) + 0.0:.{decimals}f}".replace("-", "\N{MINUS SIGN}")


def _both(found: Found, decimals: int = 2) -> str:
    return " / ".join(_signed(number, decimals) for number in found.numbers)


def demo_table() -> str:
    """The glass table of the demo: all runs, mean over seeds."""
    sizes = {run["run"]: f"{run['num_parameters']:,}" for run in _read("demo")["scenes"][0]["runs"]}
    rows = []
    for run, about in DEMO.items():
        near, far = score("demo", run).numbers
        glass, ssim, wrapped = (score("demo", run, key=key) for key in ("glass_psnr_db", "ssim", "psnr_uint8_wrap_db"))
        psnr = [f"**{value:.2f}**" if run == "light-path" else f"{value:.2f}" for value in (near, far)]
        cells = (_signed(near - far), *_both(glass).split(" / "), _both(ssim, 3), f"*{_both(wrapped)}*")
        rows.append((*about, sizes[run], *psnr, *cells))
    stored = _both(ceiling("demo")).split(" / ")
    rows.append(("noise ceiling", "", "", "", *stored, *[""] * 5))
    columns = ("run", "geometry", "knows", "parameters of networks", "PSNR inter.", "PSNR extra.", "drop")
    columns += ("glass inter.", "glass extra.", "SSIM inter. / extra.", "*wrapped* inter. / extra.")
    return table_of(columns, rows, texts=3)


def short_demo_table() -> str:
    """PSNR of the demo's runs, mean over seeds."""
    rows = [
        (name if geometry == "truth" else f"{name} on {geometry}", *_both(score("demo", run)).split(" / "))
        for run, (name, geometry, _) in DEMO.items()
    ]
    rows.append(("noise ceiling", *_both(ceiling("demo")).split(" / ")))
    return table_of(("run", "PSNR interpolating, dB", "PSNR extrapolating, dB"), rows, texts=1)


def angles_table() -> str:
    """PSNR of the demo's runs at test cameras outside the training cameras."""
    rows = [(DEMO[run][0], *_both(at("demo", run), 1).split(" / ")) for run in ("light-path", "paper-best", "paper")]
    return table_of(("run", *(f"{degrees}°" for degrees in ANGLES)), rows, texts=1)


def standard_table() -> str:
    """PSNR on four scenes at 256 x 256."""
    scenes = [scene["scene"] for scene in _read("standard")["scenes"]]
    rows = [(scene, *(_both(score("standard", run, scene)) for run in STANDARD)) for scene in scenes]
    rows.append(("mean", *(_both(score("standard", run)) for run in STANDARD)))
    return table_of(("scene", *(f"`{method}`" for method in STANDARD.values())), rows, texts=1)


def pairs_table() -> str:
    """Differences of methods over the benchmark's scenes, with their intervals."""
    rows = []
    for pair in PAIRS:
        gaps = [_interval(gap) for gap in lead("bench", *pair).intervals]
        glass = [_interval(gap) for gap in lead("bench", *pair, key=MEETS_GLASS).intervals]
        near, far, _ = wins("bench", *pair, key=MEETS_GLASS).numbers
        rows.append((f"`{pair[0]}` over `{pair[1]}`", *glass, f"{near:.0f} / {far:.0f}", *gaps))
    columns = ("gain in dB", "glass, inter.", "extra.", "scenes with a gain", "all pixels, inter.", "extra.")
    return table_of(columns, rows, texts=1)


def verdicts_table() -> str:
    """The paper's claims over the benchmark's scenes, which have the usual runs of each method on true shapes alone."""
    rows = []
    methods = {name for pair in PAIRS for name in pair}
    for claim in CLAIMS:
        for pair in claim.pairs:
            first, second = (line.method for line in pair.lines)
            if {first, second} <= methods and not any(line.flags or line.geometry != TRUTH for line in pair.lines):
                one, other = _shared("bench", first, second, "", "psnr_db")
                found = decide(claim, "", {scene: (one[scene], other[scene]) for scene in one})
                numbers = found.numbers.replace("-", "\N{MINUS SIGN}").replace("+", "")
                rows.append((claim.text, f"`{first}` against `{second}`", numbers, found.verdict))
    return table_of(("claim", "first against second", "first minus second in dB", "verdict"), rows, texts=4)


def tracks_table() -> str:
    """PSNR of the benchmark's methods over its scenes, by what they are told."""
    stored = {path.stem: _read(path.stem) for path in RESULTS.glob("bench/*.json")}
    methods: list[tuple[int, float, tuple[str, ...]]] = []
    for name, about in stored.items():
        run = re.sub(r"-\d+-steps$", "", name)
        found = score("bench", run, key=MEETS_GLASS) + score("bench", run)
        cells = (about["track"], f"`{run}`", str(len(about["scenes"])), *_both(found).split(" / "))
        methods.append((TRACKS.index(about["track"]), -sum(found.numbers[:2]), cells))
    columns = ("track", "method", "scenes", "glass, inter.", "extra.", "all pixels, inter.", "extra.")
    return table_of(columns, [cells for *_, cells in sorted(methods)], texts=2)


def errors_table() -> str:
    """Squared errors of the benchmark's methods by what pixels show."""
    (grid,) = _read("errors")["tables"]["errors"]
    rows = [
        (f"`{re.sub(r'-[0-9]+-steps.*', '', row[0])}`", *(cell.replace("-", "\N{MINUS SIGN}") for cell in row[2:]))
        for row in grid["rows"]
    ]
    columns = ("method", "glass", "mirrored", "lit", "opaque", "sky", "all", "shares", "highlights, dB", "their error")
    return table_of(columns, rows, texts=1)


def curves_table() -> str:
    """PSNR of training, held-out and test views by passes over the training pictures."""
    (grid,) = _read("curves")["tables"]["curves"]
    ends = {
        tuple(run): f"{float(passes):g}" for *run, passes, _, _, _, _ in grid["rows"]
    }  # Of a run, the last row stays.
    rows = [
        (scene.removesuffix("_64"), f"`{re.sub('-[0-9]+-steps$', '', run)}`", ends[scene, run], *cells)
        for scene, run, *cells in grid["rows"]
    ]
    columns = ("scene", "method", "all passes", "after pass", "training", "held out", "test, inter.", "test, extra.")
    return table_of(columns, rows, texts=2)


def fits_table() -> str:
    """What fitted glass costs on random scenes."""
    rows = []
    for files in FITS:
        costs, inside = [], []
        for file in files:
            gaps, _ = _gaps(file, "light-path-600-steps", "light-path-fitted-600-steps", "", "psnr_db")
            costs.append(gaps)
            inside += [inside for scene in _read(file)["scenes"] for inside in _indices(scene)]
        cost = np.concatenate(costs, axis=1)
        texts = [" / ".join(_signed(value, 1) for value in of(cost, axis=1)) for of in (np.median, np.min, np.max)]
        rows.append((", ".join(files), str(cost.shape[1]), *texts, f"{sum(inside)} of {len(inside)}"))
    return table_of(("fits", "scenes", "median", "least", "greatest", "indices in their interval"), rows, texts=1)


def photographs_table() -> str:
    """PSNR on the held-out photographs of a shot glass, and in its glass."""
    rows = []
    for run, about in PHOTOGRAPHS.items():
        whole, glass = (score("photographs", run, key=key) for key in ("psnr_db", "glass_psnr_db"))
        rows.append((*about, *_both(glass).split(" / "), *_both(whole).split(" / ")))
    columns = ("method", "glass", "in glass, inter.", "extra.", "whole picture, inter.", "extra.")
    return table_of(columns, rows, texts=2)


def _indices(scene: dict[str, Any]) -> list[bool]:
    """Of each fitted object's index of refraction: whether its interval contains the true one."""
    objects = [item for fit in scene["analyses"]["fits"].values() for item in fit.values() if item.get("measured")]
    return [
        item["numbers"]["ior"]["low"] <= item["measured"]["true"]["ior"] <= item["numbers"]["ior"]["high"]
        for item in objects
    ]


def _interval(gap: Interval | None) -> str:
    if gap is None:
        return "too few"
    return f"{_signed(gap.mean)} ({_signed(gap.low)} to {_signed(gap.high)})"


def _claim_row(row: re.Match[str]) -> str:
    found = evaluated(row["cell"])
    intervals = "; ".join(_interval(gap) for gap in found.intervals) or "–"  # noqa: RUF001
    return f"| {row['claim']} | {row['against']} | `{row['cell']}` | {found.unit or '–'} | {intervals} |"  # noqa: RUF001


TABLES: dict[str, Callable[[], str]] = {
    "demo": demo_table,
    "short-demo": short_demo_table,
    "angles": angles_table,
    "standard": standard_table,
    "pairs": pairs_table,
    "verdicts": verdicts_table,
    "tracks": tracks_table,
    "errors": errors_table,
    "curves": curves_table,
    "fits": fits_table,
    "photographs": photographs_table,
}


def filled(text: str) -> str:
    """A page whose tables are those of the stored results."""

    def table(found: re.Match[str]) -> str:
        rows = ROW.sub(_claim_row, found[3]) if found[2] == "claims" else TABLES[found[2]]()
        return f"{found[1]}{rows}{found[4]}"

    return TABLE.sub(table, text)


if __name__ == "__main__":
    for page in PAGES:
        page.write_text(filled(page.read_text()))
