"""The runs that the paper's tables compare, found by what their records say, not by their names."""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from datagen.data.geometries import NO_GEOMETRY
from datagen.data.paths import TRUTH
from datagen.disk.records import Json
from datagen.disk.storage import dump_json
from eval.papers.published import DNR, NO_EXTRINSICS, SPHERICAL_HARMONICS, VIEW_VECTOR, PublishedRow
from eval.score.runs import Run
from eval.score.seeds import SeedGroup

PROXIES = "proxies"
"""Stands for every geometry but the truth; no kind of proxy has this name."""


@dataclass(frozen=True, kw_only=True)
class Line:
    """One line of a comparison: what a run must be to stand there."""

    title: str
    method: str
    choices: Mapping[str, Json] = field(default_factory=dict)
    """Keys of the configuration with their values."""
    geometry: str | None = TRUTH
    """None takes any, `PROXIES` any that is neither the truth nor none."""
    published: PublishedRow | None = None
    """What the paper printed for it."""

    def fits(self, run: Run) -> bool:
        """True when the run stands in this line."""
        config = flat_config(run)
        return (
            run.method == self.method
            and self.geometry in (None, run.geometry, run.geometry if run.geometry in (TRUTH, NO_GEOMETRY) else PROXIES)
            and all(key in config and config[key] == value for key, value in self.choices.items())
        )


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """One of the paper's tables, or one that it should have had."""

    title: str
    lines: tuple[Line, ...]
    varied: tuple[str, ...] | None = None
    """Keys of the configuration in which runs of one comparison may differ; None: in all, as methods do."""
    notes: tuple[str, ...] = ()


PAPER: dict[str, Json] = {
    "zero_layer": False,
    "blocks": 3,
    "norm": "batch",
    "textures": "object",
    "texture_features": 16,
    "texture_levels": 1,
    "finer_counts": 1.0,
    "train_samples": 1,
    "render_samples": 1,
    "layers": "all",
    "precision": "fp32",
    "softness": 0.0,
    "vgg_weights": "none",
    "adversarial": 0.0,
}
"""The paper's renderer with the defaults of `model train`, but for the extrinsics."""

VIEW: dict[str, Json] = {**PAPER, "extrinsics": "view"}

PAPER_BEST: dict[str, Json] = {
    **VIEW,
    "width": 128,
    "norm": "none",
    "texture_levels": 5,
    "finer_counts": 0.5,
    "train_samples": 4,
    "render_samples": 16,
    "softness": 0.03,
}
"""`model train paper --preset best`."""

LIGHT_PATH: dict[str, Json] = {
    "branches": 12,
    "compositing": "physics",
    "environment_size": 32,
    "sky_lobes": 12,
    "hidden": 128,
    "directions": "off",
    "debias": 1.0,
    "fill_in": "on",
    "position_octaves": 0,
    "straight_layers": 0,
    "shells": 1,
    "relief": "off",
    "stack_hidden": 32,
    "texture_levels": 5,
    "train_samples": 4,
    "render_samples": 16,
    "refined_samples": 64,
}
"""`light-path` on the true geometry with all of its parts."""

LIGHT_PATH_ON_PROXIES: dict[str, Json] = {
    **{key: value for key, value in LIGHT_PATH.items() if key != "shells"},
    "directions": "on",
    "debias": 0.0,
    "fill_in": "off",
    "stack_hidden": 96,
    "straight_layers": 24,
    "relief": "on",
}
"""The same on proxies; how many shells there are, the number of objects decides."""

PROXY_KEYS = (
    "geometry",
    "texture_sizes",
    "directions",
    "debias",
    "fill_in",
    "stack_hidden",
    "straight_layers",
    "shells",
    "relief",
)
"""What `light-path` chooses by the geometry."""

OURS = Line(title="paper", method="paper", choices=VIEW, published=VIEW_VECTOR)
BEST = Line(title="paper-best", method="paper", choices=PAPER_BEST)
BEST_NOTE = (
    "paper-best: `--preset best`, everything within the paper's idea that was found to help, tuned as light-path is."
)

COMPARISONS: dict[str, Comparison] = {
    "table1": Comparison(
        title="Table 1, what each layer is told of the camera",
        lines=(
            Line(
                title="no extrinsics", method="paper", choices={**PAPER, "extrinsics": "none"}, published=NO_EXTRINSICS
            ),
            Line(title="view vector", method="paper", choices=VIEW, published=VIEW_VECTOR),
            Line(
                title="spherical harmonics",
                method="paper",
                choices={**PAPER, "extrinsics": "sh"},
                published=SPHERICAL_HARMONICS,
            ),
        ),
        # The width follows from the number of inputs, so that all have about 34,000 parameters.
        varied=("extrinsics", "width"),
    ),
    "table2": Comparison(
        title="Table 2, Deferred Neural Rendering against the paper",
        lines=(
            Line(title="DNR", method="dnr", published=DNR),
            OURS,
            BEST,
            Line(title="what the authors ran", method="authors-code"),
            Line(title="DeepVoxels", method="deepvoxels", geometry=NO_GEOMETRY),
        ),
        notes=("The paper names no number for DeepVoxels; which of its runs fed Table 2 is not known.", BEST_NOTE),
    ),
    "square": Comparison(
        title="What earns the gain, layers or the per-pixel network",
        lines=(
            Line(title="U-Net, first layer (DNR)", method="dnr", published=DNR),
            Line(title="U-Net, all layers", method="dnr-layers"),
            Line(title="per pixel, first layer", method="mlp-first"),
            Line(title="per pixel, all layers (paper)", method="paper", choices=VIEW, published=VIEW_VECTOR),
            dataclasses.replace(BEST, title="per pixel, all layers (paper-best)"),
        ),
        notes=(BEST_NOTE,),
    ),
    "zero-layer": Comparison(
        title="A random layer of zeros while training (section 4.4)",
        lines=(
            Line(title="without", method="paper", choices=VIEW),
            Line(title="with", method="paper", choices={**VIEW, "zero_layer": True}),
        ),
        varied=("zero_layer", "width"),
        notes=("What it is for, edited scenes, the table of claims has.",),
    ),
    "headline": Comparison(
        title="light-path against the paper",
        lines=(Line(title="light-path", method="light-path", choices=LIGHT_PATH), BEST, OURS),
        notes=(BEST_NOTE,),
    ),
}

LADDER = Comparison(
    title="Quality against the proxy's error",
    lines=(
        Line(title="light-path", method="light-path", choices=LIGHT_PATH),
        Line(title="light-path", method="light-path", choices=LIGHT_PATH_ON_PROXIES, geometry=PROXIES),
        dataclasses.replace(BEST, geometry=None),
        Line(title="paper", method="paper", choices=VIEW, geometry=None),
    ),
    varied=PROXY_KEYS,
)

ABLATIONS: dict[str, Line] = {
    "ablation": Line(title="light-path", method="light-path", geometry=None),
    "variants": Line(title="paper", method="paper", geometry=None),
}
"""Tables of what each choice of a method is worth, and the runs that they set beside each other."""

UNCOMPARED = ("seed", "type", "preset", "texels_per_pixel", "vgg_sha256")
"""Keys that say how others were found."""

FOLLOWING = ("width", "batch", "texture_sizes", "sky_lobes", "refined_samples")
"""Keys that follow from others: a difference in them alone counts, one beside another does not."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Entry:
    """A group of runs in its line."""

    line: Line
    group: SeedGroup


def flat_config(run: Run) -> dict[str, Json]:
    """A run's choices, those of its network among them, without its seed; empty where it does not tell."""
    flat: dict[str, Json] = {}
    for key, value in (run.config or {}).items():
        flat |= value if isinstance(value, dict) else {key: value}
    return {key: value for key, value in flat.items() if key not in UNCOMPARED}


def find_entries(comparison: Comparison, groups: Sequence[SeedGroup]) -> list[list[Entry]]:
    """Runs that may be compared: alike but for the keys that the comparison varies; each part in the lines' order.

    Parts with a single line are left out where others have more: there is nothing to compare them with.
    """
    parts: dict[bytes, list[Entry]] = {}
    for line in comparison.lines:
        for group in groups:
            if line.fits(group.first):
                parts.setdefault(_same(group.first, comparison.varied), []).append(Entry(line=line, group=group))
    most = max((_variety(part) for part in parts.values()), default=0)
    kept = [part for part in parts.values() if _variety(part) > 1 or most == 1]
    return sorted(kept, key=lambda part: -_variety(part))


def differences(one: Run, other: Run) -> dict[str, tuple[Json, Json]]:
    """The keys in which two configurations differ with both values, without those that follow from others."""
    before, after = flat_config(one), flat_config(other)
    keys = [key for key in dict.fromkeys([*before, *after]) if before.get(key) != after.get(key)]
    leading = [key for key in keys if key not in FOLLOWING] or keys
    return {key: (before.get(key), after.get(key)) for key in leading}


def _same(run: Run, varied: tuple[str, ...] | None) -> bytes:
    """What two runs must share to be compared."""
    if varied is None:
        # Who knows cameras alone is compared with those who know the truth.
        return dump_json(TRUTH if run.geometry == NO_GEOMETRY else run.geometry)
    config = {key: value for key, value in flat_config(run).items() if key not in varied}
    return dump_json([run.method, config])


def _variety(part: Sequence[Entry]) -> int:
    """How many different things a part compares."""
    return len({(entry.line.title, entry.group.first.geometry) for entry in part})
