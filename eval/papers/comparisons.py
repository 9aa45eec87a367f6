"""The runs that the paper's tables compare, found by what their records say, not by their names."""

import dataclasses
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import cast

from datagen.data.geometries import NO_GEOMETRY
from datagen.data.paths import TRUTH
from datagen.disk.records import Json
from datagen.disk.storage import dump_json
from eval.papers.published import DNR, NO_EXTRINSICS, SPHERICAL_HARMONICS, VIEW_VECTOR, PublishedRow
from eval.score.runs import Run
from eval.score.seeds import SeedGroup

FREE_FLAGS = ("geometry", "seed", "steps", "batch", "updates", "lr", "texture-lr", "lr-decay", "hidden", "texture-size")
"""Runs of one line may differ in these: what they learn from, for how long, and how large they are."""


@dataclass(frozen=True, kw_only=True)
class Line:
    """One line of a comparison: what a run must be to stand there."""

    title: str
    method: str
    flags: Mapping[str, str] | None = None
    """The flags of `model train METHOD` that it was trained with, without dashes, beside `FREE_FLAGS`; None: any."""
    geometry: str | None = TRUTH
    """None takes any."""
    published: PublishedRow | None = None
    """What the paper printed for it."""

    def fits(self, run: Run) -> bool:
        """True when the run stands in this line."""
        return (
            run.method == self.method
            and self.geometry in (None, run.geometry)
            and (self.flags is None or (run.flags is not None and _flags(run, FREE_FLAGS) == self.flags))
        )


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """One of the paper's tables, or one that it should have had."""

    title: str
    lines: tuple[Line, ...]
    varied: str | None = None
    """The flag in which alone runs of one comparison may differ; None: in all, as methods do."""
    notes: tuple[str, ...] = ()


OURS = Line(title="paper", method="paper", flags={}, published=VIEW_VECTOR)
BEST = Line(title="paper-best", method="paper-best", flags={})
BEST_NOTE = "paper-best: everything within the paper's idea that was found to help, tuned as light-path is."

COMPARISONS: dict[str, Comparison] = {
    "table1": Comparison(
        title="Table 1, what each layer is told of the camera",
        lines=(
            Line(title="no extrinsics", method="paper", flags={"extrinsics": "none"}, published=NO_EXTRINSICS),
            dataclasses.replace(OURS, title="view vector"),
            Line(
                title="spherical harmonics",
                method="paper",
                flags={"extrinsics": "sh"},
                published=SPHERICAL_HARMONICS,
            ),
        ),
        varied="extrinsics",
    ),
    "table2": Comparison(
        title="Table 2, Deferred Neural Rendering against the paper",
        lines=(
            Line(title="DNR", method="dnr", published=DNR),
            OURS,
            BEST,
            Line(title="what the authors ran", method="authors-code"),
            Line(title="DeepVoxels, small", method="deepvoxels", geometry=NO_GEOMETRY),
            Line(title="DeepVoxels", method="deepvoxels-paper", geometry=NO_GEOMETRY),
        ),
        notes=("The paper names no number for DeepVoxels; which of its runs fed Table 2 is not known.", BEST_NOTE),
    ),
    "square": Comparison(
        title="What earns the gain, layers or the per-pixel network",
        lines=(
            Line(title="U-Net, first layer (DNR)", method="dnr", published=DNR),
            Line(title="U-Net, all layers", method="dnr-layers"),
            Line(title="per pixel, first layer", method="mlp-first"),
            dataclasses.replace(OURS, title="per pixel, all layers (paper)"),
            dataclasses.replace(BEST, title="per pixel, all layers (paper-best)"),
        ),
        notes=(BEST_NOTE,),
    ),
    "zero-layer": Comparison(
        title="A random layer of zeros while training (section 4.4)",
        lines=(
            Line(title="without", method="paper", flags={}),
            Line(title="with", method="paper", flags={"zero-layer": ""}),
        ),
        varied="zero-layer",
        notes=("What it is for, edited scenes, the table of claims has.",),
    ),
    "headline": Comparison(
        title="light-path against the paper",
        lines=(Line(title="light-path", method="light-path", flags={}), BEST, OURS),
        notes=(BEST_NOTE,),
    ),
}

LADDER = Comparison(
    title="Quality against the proxy's error",
    lines=(
        Line(title="light-path", method="light-path", flags={}, geometry=None),
        dataclasses.replace(BEST, geometry=None),
        Line(title="paper", method="paper", flags={}, geometry=None),
    ),
    varied="geometry",
)

ABLATIONS: dict[str, Line] = {
    "ablation": Line(title="light-path", method="light-path", geometry=None),
    "variants": Line(title="paper", method="paper", geometry=None),
}
"""Tables of what each choice of a method is worth, and the runs that they set beside each other."""

UNCOMPARED = ("seed", "type", "texels_per_pixel", "vgg_sha256")
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
    """Runs that may be compared: alike but for the flag that the comparison varies; each part in the lines' order.

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


def _same(run: Run, varied: str | None) -> bytes:
    """What two runs must share to be compared."""
    if varied is None:
        # Who knows cameras alone is compared with those who know the truth.
        return dump_json(TRUTH if run.geometry == NO_GEOMETRY else run.geometry)
    return dump_json([run.method, cast(Json, _flags(run, ("seed", varied)))])


def _flags(run: Run, besides: Collection[str]) -> dict[str, str]:
    """The flags that a run was trained with, and their values, besides some."""
    flags: dict[str, str] = {}
    for word in run.flags or ():
        if word.startswith("--"):
            flags[word.removeprefix("--")] = ""
        elif flags:
            flags[list(flags)[-1]] = word
    return {flag: value for flag, value in flags.items() if flag not in besides}


def _variety(part: Sequence[Entry]) -> int:
    """How many different things a part compares."""
    return len({(entry.line.title, entry.group.first.geometry) for entry in part})
