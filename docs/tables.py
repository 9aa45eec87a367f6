"""Fills the marked tables of README.md and docs/{index,paper}.md from docs/results/*.json; `make results` runs it.

A table lies between `<!-- table: NAME -->` and `<!-- end -->`, where NAME is a key of `TABLES`. Tests compare the
tables, and the numbers in sentences, with the stored results.
"""

import json
import re
import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
PAGES = (ROOT / "README.md", ROOT / "docs/index.md", ROOT / "docs/paper.md")
TABLE = re.compile(r"(<!-- table: (\S+) -->\n).*?(<!-- end -->)", re.DOTALL)
NEAR, FAR = "interpolating", "extrapolating"
ANGLES = (10, 20, 40)
DEMO = {
    "light-path": ("`light-path`", "truth", "materials"),
    "paper-best": ("`paper-best`", "truth", ""),
    "paper": ("`paper`", "truth", ""),
    "paper-ellipsoid": ("`paper`", "ellipsoids", ""),
}
"""Runs of the demo: method, geometry and what else they know."""
HEADLINE = ("light-path", "paper-best", "paper")
STANDARD = {"light-path-3500-steps": "light-path", "paper-best-7000-steps": "paper-best", "paper-5000-steps": "paper"}
"""Runs of `standard`, each with twice the usual steps, and their methods."""


@dataclass(frozen=True, kw_only=True)
class Results:
    """One results.json of `eval report`."""

    name: str

    @property
    def data(self) -> dict[str, Any]:
        return _read(self.name)

    def scene(self, name: str) -> dict[str, Any]:
        """The scores of one scene."""
        return next(scene for scene in self.data["scenes"] if scene["scene"] == name)

    def runs(self, scene: str, run: str) -> list[dict[str, Any]]:
        """A run, and those that differ from it in the seed alone."""
        return [each for each in self.scene(scene)["runs"] if re.sub(r"-seed\d+$", "", each["run"]) == run]

    def values(self, scene: str, run: str, key: str, split: str) -> list[float]:
        """A score of each seed."""
        return [each["splits"][split][key]["mean"] for each in self.runs(scene, run)]

    def mean(self, scene: str, run: str, split: str, key: str = "psnr_db") -> float:
        """A score, averaged over seeds."""
        return statistics.fmean(self.values(scene, run, key, split))

    def at_angle(self, scene: str, run: str, degrees: int, key: str = "psnr_db") -> float:
        """A score at test cameras this many degrees outside the training cameras, averaged over seeds."""
        runs = self.scene(scene)["analyses"]["variants"]["angles"]["runs"]
        split = f"extrapolating-{degrees}deg"
        return statistics.fmean(runs[each["run"]][split][key]["mean"] for each in self.runs(scene, run))


@cache
def _read(name: str) -> dict[str, Any]:
    return json.loads((ROOT / "docs/results" / f"{name}.json").read_text())


def table_of(columns: Sequence[str], rows: Sequence[Sequence[str]], *, texts: int) -> str:
    """A table in Markdown whose first columns are texts and whose others are numbers."""
    rules = ["---"] * texts + ["---:"] * (len(columns) - texts)
    return "".join(f"| {' | '.join(cells)} |\n" for cells in (columns, rules, *rows))


def demo_table() -> str:
    """The glass table of the demo: all runs, mean over seeds."""
    found = Results(name="demo")
    rows = []
    for run, about in DEMO.items():
        near, far, glass_near, glass_far, ssim_near, ssim_far, wrap_near, wrap_far = (
            found.mean("glass_table", run, split, key)
            for key in ("psnr_db", "glass_psnr_db", "ssim", "psnr_uint8_wrap_db")
            for split in (NEAR, FAR)
        )
        size = f"{found.runs('glass_table', run)[0]['num_parameters']:,}"
        bold = "**" if run == "light-path" else ""
        rows.append(
            (
                *about,
                size,
                f"{bold}{near:.2f}{bold}",
                f"{bold}{far:.2f}{bold}",
                _signed(near - far),
                f"{glass_near:.2f}",
                f"{glass_far:.2f}",
                f"{ssim_near:.3f} / {ssim_far:.3f}",
                f"*{wrap_near:.2f} / {wrap_far:.2f}*",
            )
        )
    ceiling = found.scene("glass_table")["noise_ceiling_db"]
    rows.append(("noise ceiling", "", "", "", f"{ceiling[NEAR]:.2f}", f"{ceiling[FAR]:.2f}", *[""] * 5))
    columns = (
        "run",
        "geometry",
        "knows",
        "parameters",
        "PSNR inter.",
        "PSNR extra.",
        "drop",
        "glass inter.",
        "glass extra.",
        "SSIM inter. / extra.",
        "*wrapped* inter. / extra.",
    )
    return table_of(columns, rows, texts=3)


def short_demo_table() -> str:
    """PSNR of the demo's runs, mean over seeds."""
    found = Results(name="demo")
    rows = [
        (
            name if geometry == "truth" else f"{name} on {geometry}",
            *(f"{found.mean('glass_table', run, split):.2f} dB" for split in (NEAR, FAR)),
        )
        for run, (name, geometry, _) in DEMO.items()
    ]
    ceiling = found.scene("glass_table")["noise_ceiling_db"]
    rows.append(("noise ceiling", *(f"{ceiling[split]:.2f} dB" for split in (NEAR, FAR))))
    return table_of(("run", "PSNR interpolating", "PSNR extrapolating"), rows, texts=1)


def _signed(value: float) -> str:
    return f"{value:.2f}".replace("-", "\N{MINUS SIGN}")


def angles_table() -> str:
    """PSNR of the demo's runs at test cameras outside the training cameras."""
    found = Results(name="demo")
    rows = [
        (DEMO[run][0], *(f"{found.at_angle('glass_table', run, degrees):.1f}" for degrees in ANGLES))
        for run in HEADLINE
    ]
    return table_of(("run", *(f"{degrees}°" for degrees in ANGLES)), rows, texts=1)


def standard_mean(run: str, split: str) -> float:
    """PSNR averaged over the scenes of `standard`."""
    found = Results(name="standard")
    return statistics.fmean(found.mean(scene["scene"], run, split) for scene in found.data["scenes"])


def standard_table() -> str:
    """PSNR on four scenes at 256 x 256."""
    found = Results(name="standard")
    scenes = [scene["scene"] for scene in found.data["scenes"]]
    rows = [
        (scene, *(f"{found.mean(scene, run, NEAR):.2f} / {found.mean(scene, run, FAR):.2f}" for run in STANDARD))
        for scene in scenes
    ]
    rows.append(("mean", *(f"{standard_mean(run, NEAR):.2f} / {standard_mean(run, FAR):.2f}" for run in STANDARD)))
    return table_of(("scene", *(f"`{method}`" for method in STANDARD.values())), rows, texts=1)


def lead_over(rival: str, run: str = "light-path", *, results: str = "demo", scene: str = "glass_table") -> str:
    """How far a run leads another: `near / far` in dB."""
    found = Results(name=results)
    return " / ".join(f"{found.mean(scene, run, split) - found.mean(scene, rival, split):.1f}" for split in (NEAR, FAR))


def at_angles(run: str) -> str:
    """PSNR of a run of the demo at 10, 20 and 40 degrees."""
    return " / ".join(f"{Results(name='demo').at_angle('glass_table', run, degrees):.1f}" for degrees in ANGLES)


def readme_claims() -> tuple[str, ...]:
    """Sentences of README with numbers of stored results."""
    means = {
        method: f"{standard_mean(run, NEAR):.1f} / {standard_mean(run, FAR):.1f}" for run, method in STANDARD.items()
    }
    run, rival, _ = STANDARD
    shelf = lead_over(rival, run, results="standard", scene="plant_shelf")
    unet, per_pixel = layer_gains()
    return (
        f"`light-path` leads it by {lead_over('paper-best')} dB, and `paper` as published by {lead_over('paper')}",
        f"outside the training views, `light-path` scores {at_angles('light-path')} dB and `paper-best` "
        f"{at_angles('paper-best')}",
        f"`light-path` averages {means['light-path']} dB over four scenes, and `paper-best` {means['paper-best']}",
        f"`plant_shelf`, which shows the least glass ({shelf} dB)",
        f"in the training pictures, and `light-path` scores {fitted_scores('light-path-fitted')} dB on the demo",
        f"From pictures and masks alone, it scores {captured_scores()} dB",
        f"{unet} dB (interpolating / extrapolating) with a U-Net, and {per_pixel} dB with the per-pixel network",
        f"pixels that score {larger_scores('light-path')} dB; those of `paper` score {larger_scores('paper')}",
        f"ground truth, upsampled, {larger_scores('truth', 'enlarged')}",
    )


def larger_scores(run: str, pictures: str = "at that size") -> str:
    """Scores of pictures four times as wide as those trained on, in dB."""
    (grid,) = Results(name="larger").data["tables"]["larger"]
    (row,) = (row for row in grid["rows"] if row[:3] == ["512 x 512", run, pictures])
    return " / ".join(f"{float(cell):.1f}" for cell in row[3:5])


def fitted_scores(run: str, *, results: str = "fits-demo", scene: str = "glass_table") -> str:
    """Scores of a run beside those on fitted glass, in dB."""
    found = Results(name=results)
    return " / ".join(f"{found.mean(scene, run, split):.1f}" for split in (NEAR, FAR))


def captured_scores() -> str:
    """Scores of `light-path` on a dataset captured from pictures and masks alone, in dB."""
    return fitted_scores("light-path-fitted-1000-steps", results="known-fitted", scene="shots")


def layer_gains() -> tuple[str, ...]:
    """What all layers gain over the first one, with a U-Net and with the per-pixel network: `near / far` in dB."""
    pairs = (("dnr", "dnr-layers"), ("mlp-first", "paper"))
    return tuple(lead_over(first, run, results="paper") for first, run in pairs)


def fitted_cost() -> str:
    """What fitted glass costs `light-path` on random scenes: the median of `near / far` in dB."""
    found = Results(name="fits")
    scenes = [scene["scene"] for scene in found.data["scenes"]]
    runs = ("light-path-600-steps", "light-path-fitted-600-steps")
    costs = {
        split: statistics.median(
            found.mean(scene, runs[0], split) - found.mean(scene, runs[1], split) for scene in scenes
        )
        for split in (NEAR, FAR)
    }
    return f"{len(scenes)} random scenes {costs[NEAR]:.1f} / {costs[FAR]:.1f} dB in the median"


def paper_claims() -> tuple[str, ...]:
    """Sentences of the paper page with numbers of stored results."""
    found = Results(name="demo")
    wrapped, true = (
        " / ".join(f"{found.mean('glass_table', 'paper', split, key):.1f}" for split in (NEAR, FAR))
        for key in ("psnr_uint8_wrap_db", "psnr_db")
    )
    fitted, told = map(fitted_scores, ("light-path-fitted", "light-path"))
    hulls = fitted_scores("light-path-fitted-hull", results="known-fitted")
    unet, per_pixel = layer_gains()
    return (
        f"Layers gain {unet} dB over a single layer with a U-Net, {per_pixel} with the per-pixel network",
        f"gain {unet} dB for the U-Net and {per_pixel} for the per-pixel network",
        f"outperform the best version of the paper's method by {lead_over('paper-best')} dB",
        f"which gains {lead_over('paper', 'paper-best')} dB over the published form",
        f"on {fitted_cost()}",
        f"scores {fitted} dB on fitted glass, {told} on the true one, and {hulls} on hulls",
        f"it reaches {captured_scores()}",
        f"`light-path` 7.7 / 7.5 dB: it has {larger_scores('light-path')} dB, the upsampled ground truth "
        f"{larger_scores('truth', 'enlarged')}",
        f"the wrapped metric gives `paper` {wrapped} dB here, in the published range; its PSNR is {true} dB",
    )


TABLES: dict[str, Callable[[], str]] = {
    "demo": demo_table,
    "short-demo": short_demo_table,
    "angles": angles_table,
    "standard": standard_table,
}


CLAIMS: dict[str, Callable[[], tuple[str, ...]]] = {
    "README.md": readme_claims,
    "index.md": tuple,  # Its numbers are all in the table.
    "paper.md": paper_claims,
}


def filled(text: str) -> str:
    """A page whose tables are those of the stored results."""
    return TABLE.sub(lambda found: f"{found[1]}{TABLES[found[2]]()}{found[3]}", text)


if __name__ == "__main__":
    for page in PAGES:
        page.write_text(filled(page.read_text()))
