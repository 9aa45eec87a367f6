"""The leaderboard: averages over scenes in a table of methods for each track and one of scenes, as Markdown."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from statistics import fmean

import numpy as np
from jaxtyping import Float
from scipy import stats

from datagen.data.config import TEST_SPLITS
from datagen.disk.errors import HyalineError
from eval.tables.grids import MISSING, TABLE_WIDTH, Column, Grid, format_number, grid_text, markdown_escaped
from hyaline_bench.protocol import ALL, GLASS, Bootstrap, Protocol
from hyaline_bench.score import Scored, mean_of_all

NOTES = (
    "The sweep trains built-in methods on public scenes. Hidden scenes and other people's methods are run by hand, as "
    "docs/bench.md says.",
    "PSNR in dB: the mean over a split's pictures, then over the interpolating and the extrapolating split, then over "
    "scenes. Glass, which ranks methods: pixels whose light meets glass, that is, which change when all glass is "
    "removed. All: all pixels. Interval: 95 %, from a percentile bootstrap over scenes. Below ceiling: distance to the "
    "PSNR that the noise of the truth and 8 bits leave a perfect method. Worst: by glass. Inter, extra: glass. 10°, "
    "20°, 40°: all pixels of all built-in scenes. Edits: the pixels that change, in all built-in scenes. Hidden: glass "
    "in all hidden scenes; everyone can build the truth of the others.",
    "CPU min: of training, mean over scenes, on the participant's machine, so compare it within a "
    "factor of two. Rows with other scenes than the first come after those with the same: their averages cannot be "
    "compared. Costs and all metrics of every split are in the files of scores. Of scenes: the share of glass pixels, "
    "PSNR of the training pictures by their own noise, ceilings, and glass dB of each method.",
)


# Averages


@dataclass(frozen=True, kw_only=True)
class Summary:
    """A column's PSNR over scenes in dB."""

    mean: float
    interval: tuple[float, float] | None
    """Confidence interval of the mean; None for a single scene."""
    worst: float
    worst_scene: str
    ceiling: float | None
    """Mean of the ceilings; None if one is unknown."""


def summarise(
    scored: Scored, column: str, bootstrap: Bootstrap, *, among: Collection[str] | None = None
) -> Summary | None:
    """A column over the scenes that have it; None if there are none, or a score is undefined.

    Args:
        among: only these scenes, each of which must have the column.
    """
    scenes = {name: scene for name, scene in scored.scenes.items() if scene.values(column)}
    if among is not None:
        scenes = {name: scenes[name] for name in among if name in scenes}
    known = {name: value for name, scene in scenes.items() if (value := scene.psnr_db(column)) is not None}
    if not known or len(known) < max(len(scenes), len(among or ())):
        return None
    worst = min(known, key=lambda name: known[name])
    return Summary(
        mean=fmean(known.values()),
        interval=mean_interval(np.array(list(known.values())), bootstrap),
        worst=known[worst],
        worst_scene=worst,
        ceiling=mean_of_all([scene.ceiling_db(column) for scene in scenes.values()]),
    )


def mean_interval(values: Float[np.ndarray, "scene"], bootstrap: Bootstrap) -> tuple[float, float] | None:
    """The percentile bootstrap's interval of the mean; None for a single value."""
    if len(values) < 2:
        return None
    size = {"n_resamples": bootstrap.resamples, "confidence_level": bootstrap.confidence}
    found = stats.bootstrap((values,), np.mean, method="percentile", rng=bootstrap.seed, **size).confidence_interval
    return float(found.low), float(found.high)


# Tables


def results_page(found: Sequence[Scored], protocol: Protocol) -> str:
    """The page of scored submissions, all of one preset: the tables of each track that has some, and one of scenes."""
    check_comparable(found)
    preset = found[0].preset
    parts = [
        f"# hyaline-bench {protocol.version}, {preset}\n",
        f"```\nhyaline-bench commands --preset {preset} | model sweep -",
        f"hyaline-bench commands --preset {preset} --fitted | model sweep -",
        f"hyaline-bench leaderboard --preset {preset}\n```\n",
        *(f"{markdown_escaped(note)}\n" for note in NOTES),
    ]
    for track in protocol.tracks:
        if inside := [scored for scored in found if scored.track == track]:
            parts += [f"## Track: {track}\n", "Allowed inputs:\n"]
            parts += [*(f"- {markdown_escaped(told)}" for told in protocol.allowed(track)), ""]
            parts.append(grid_text(track_grid(inside, protocol), "markdown", width=TABLE_WIDTH))
    parts += ["## Scenes\n", grid_text(scene_grid(found), "markdown", width=TABLE_WIDTH)]
    return "\n".join(parts)


def check_comparable(found: Sequence[Scored]) -> None:
    """Raises a HyalineError unless all were scored on the same datasets, at one preset."""
    digests: dict[str, str] = {}
    for scored in found:
        if scored.preset != found[0].preset:
            raise HyalineError(f"{scored.name}: was scored at {scored.preset}, others at {found[0].preset}")
        for scene, result in scored.scenes.items():
            if digests.setdefault(scene, result.dataset) != result.dataset:
                raise HyalineError(
                    f"{scored.name}: was scored on another dataset of {scene} ({result.dataset[:12]}, others on "
                    f"{digests[scene][:12]}); predict and score it again on the one that the protocol names"
                )


def track_grid(found: Sequence[Scored], protocol: Protocol) -> Grid:
    """One row a submission: the most scenes first, those with the same scenes together, then the highest in glass."""

    def rank(scored: Scored) -> tuple[int, list[str], float, str]:
        summary = summarise(scored, GLASS, protocol.bootstrap)
        return -len(scored.scenes), sorted(scored.scenes), 0.0 if summary is None else -summary.mean, scored.name

    ranked = sorted(found, key=rank)
    equal = [scored for scored in ranked if set(scored.scenes) == set(ranked[0].scenes)]
    return Grid(
        title="methods",
        columns=(
            Column(group="method", is_number=False),
            Column(group="scenes"),
            *(Column(group=f"{name} {unit}") for name in (GLASS, ALL) for unit in ("dB ↑", "95 %", "below ceiling ↓")),
            *(Column(group=f"{short} ↑") for short in (*protocol.columns().values(), "hidden")),
            Column(group="worst", is_number=False),
            Column(group="CPU min ↓"),
        ),
        rows=tuple(_row(scored, protocol) for scored in ranked),
        best=frozenset({(0, 2)}) if len(equal) > 1 else frozenset(),
    )


def _row(scored: Scored, protocol: Protocol) -> tuple[str, ...]:
    total = len(protocol.all_scenes(scored.preset))
    public, hidden = (names(scored.preset) for names in (protocol.public_scenes, protocol.hidden_scenes))
    built_in = [scene for scene in public if scene in protocol.scenes]
    glass, every = (summarise(scored, column, protocol.bootstrap) for column in (GLASS, ALL))
    others = [
        summarise(scored, column, protocol.bootstrap, among=None if column in TEST_SPLITS else built_in)
        for column in protocol.columns()
    ]
    others.append(summarise(scored, GLASS, protocol.bootstrap, among=hidden) if hidden else None)
    cpu = [scene.costs["cpu_seconds"] for scene in scored.scenes.values() if "cpu_seconds" in scene.costs]
    return (
        scored.name,
        f"{len(scored.scenes)}/{total}",
        *_summary_cells(glass),
        *_summary_cells(every),
        *(format_number(None if summary is None else summary.mean, 2) for summary in others),
        MISSING if glass is None else f"{glass.worst_scene} {glass.worst:.2f}",
        format_number(fmean(cpu) / 60 if cpu else None, 2),
    )


def _summary_cells(summary: Summary | None) -> tuple[str, ...]:
    if summary is None:
        return (MISSING,) * 3
    interval = "{:.1f} to {:.1f}".format(*summary.interval) if summary.interval else MISSING
    gap = None if summary.ceiling is None else summary.ceiling - summary.mean
    return f"{summary.mean:.2f}", interval, format_number(gap, 2)


def scene_grid(found: Sequence[Scored]) -> Grid:
    """The scenes with what their pictures allow, and each method's PSNR of pixels whose light meets glass."""
    scenes = {name: scene for scored in found for name, scene in scored.scenes.items()}
    rows = []
    for name, scene in scenes.items():
        shares = [split.changed for split in scene.values(GLASS) if split.changed is not None]
        numbers = (scene.train_noise_db, *map(scene.ceiling_db, (ALL, GLASS)))
        scores = (scored.scenes[name].psnr_db(GLASS) if name in scored.scenes else None for scored in found)
        cells = (*(format_number(number, 1) for number in numbers), *(format_number(score, 2) for score in scores))
        rows.append((name, scene.dataset[:12], f"{100 * fmean(shares):.0f}", *cells))
    truth = "scene", "dataset", "glass %", "training dB", "ceiling dB", "glass ceiling dB"
    titles = (*truth, *(scored.name for scored in found))
    columns = tuple(Column(group=title, is_number=place > 1) for place, title in enumerate(titles))
    return Grid(title="glass dB of each scene", columns=columns, rows=tuple(rows))
