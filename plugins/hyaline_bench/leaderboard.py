"""The leaderboard: the tables of each track as a page of Markdown."""

from collections.abc import Sequence
from statistics import fmean

from datagen.data.config import TEST_SPLITS
from datagen.disk.errors import HyalineError
from eval.tables.grids import MISSING, TABLE_WIDTH, Column, Grid, format_number, grid_text, markdown_escaped
from hyaline_bench.protocol import ALL, Protocol
from hyaline_bench.score import COSTS, Scored, Summary, summarise

NOTES = (
    "The sweep trains built-in methods on public scenes. Hidden scenes and other people's methods are run by hand, as "
    "docs/bench.md says.",
    "PSNR: the mean over a split's pictures, then over a scene's splits, then over scenes. Interval: 95 %, from a "
    "percentile bootstrap over scenes. Below ceiling: distance to the PSNR that the noise of the truth allows. Median "
    "and worst: of the scenes. 10°, 20°, 40° and edits: of all built-in scenes. Hidden: of all hidden scenes; everyone "
    "can build the truth of the others. Edits: whole pictures are compared, although an edit changes few pixels.",
    "CPU min, GB, frames/s: of training and prediction, means over scenes (memory: the largest), where the run's "
    "costs.json has them; on the participant's machine, so compare them within a factor of two. Rows with other scenes "
    "than the first come after those with the same: their averages cannot be compared.",
)


def results_page(found: Sequence[Scored], protocol: Protocol) -> str:
    """The page of scored submissions, all of one preset: the tables of each track that has some."""
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
            grids = (track_grid("all scenes", inside, protocol), *(scene_grid(scored, protocol) for scored in inside))
            parts += [grid_text(grid, "markdown", width=TABLE_WIDTH) for grid in grids]
    return "\n".join(parts)


def check_comparable(found: Sequence[Scored]) -> None:
    """Raises a HyalineError unless all were scored on the same datasets.

    Digests change with the format of datasets, so those of different versions are not compared.
    """
    digests: dict[tuple[str, str], str] = {}
    for scored in found:
        for scene, result in scored.scenes.items():
            place = scene, scored.scored_by.partition(" ")[0]
            if digests.setdefault(place, result.dataset) != result.dataset:
                raise HyalineError(
                    f"{scored.name}: was scored on another dataset of {scene} ({result.dataset[:12]}, others on "
                    f"{digests[place][:12]}); predict and score it again on the one that the protocol names"
                )


def track_grid(title: str, found: Sequence[Scored], protocol: Protocol) -> Grid:
    """One row a submission: the most scenes first, those with the same scenes together, then the highest PSNR."""

    def rank(scored: Scored) -> tuple[int, list[str], float, str]:
        summary = summarise(scored, ALL, protocol.bootstrap)
        return -len(scored.scenes), sorted(scored.scenes), 0.0 if summary is None else -summary.mean, scored.name

    ranked = sorted(found, key=rank)
    equal = [scored for scored in ranked if set(scored.scenes) == set(ranked[0].scenes)]
    others = {key: short for key, short in protocol.columns().items() if key != ALL}
    numbers = ("PSNR dB ↑", "below ceiling dB ↓", "median dB ↑", "worst dB ↑")
    return Grid(
        title=title,
        columns=(
            Column(group="method", is_number=False),
            Column(group="scenes"),
            Column(group=numbers[0]),
            Column(group="95 % interval", is_number=False),
            *(Column(group=name) for name in numbers[1:]),
            Column(group="worst scene", is_number=False),
            *(Column(group=f"{short} ↑") for short in (*others.values(), "hidden")),
            Column(group="CPU min ↓"),
            Column(group="GB ↓"),
            Column(group="frames/s ↑"),
            Column(group="seed"),
            Column(group="code", is_number=False),
        ),
        rows=tuple(_row(scored, list(others), protocol) for scored in ranked),
        best=frozenset({(0, 2)}) if len(equal) > 1 else frozenset(),
    )


def _row(scored: Scored, others: Sequence[str], protocol: Protocol) -> tuple[str, ...]:
    total = len(protocol.all_scenes(scored.preset))
    public, hidden = (names(scored.preset) for names in (protocol.public_scenes, protocol.hidden_scenes))
    built_in = [scene for scene in public if scene in protocol.scenes]
    columns = [
        summarise(scored, column, protocol.bootstrap, among=None if column in TEST_SPLITS else built_in)
        for column in others
    ]
    columns.append(summarise(scored, ALL, protocol.bootstrap, among=hidden) if hidden else None)
    seeds = sorted({scene.seed for scene in scored.scenes.values() if scene.seed is not None})
    return (
        scored.name,
        f"{len(scored.scenes)}/{total}",
        *_summary_cells(summarise(scored, ALL, protocol.bootstrap)),
        *(format_number(None if column is None else column.mean, 2) for column in columns),
        *_cost_cells(scored),
        ", ".join(map(str, seeds)) or MISSING,
        scored.packed_by or scored.scored_by,
    )


def _summary_cells(summary: Summary | None) -> tuple[str, ...]:
    if summary is None:
        return (MISSING,) * 6
    interval = MISSING if summary.low is None else f"{summary.low:.2f} to {summary.high:.2f}"
    gap, worst = format_number(summary.gap, 2), f"{summary.worst:.2f}"
    return f"{summary.mean:.2f}", interval, gap, f"{summary.median:.2f}", worst, summary.worst_scene


def _cost_cells(scored: Scored) -> tuple[str, ...]:
    """Processor minutes, gigabytes and frames a second; a scene that lacks one leaves it out of the mean."""
    scenes = scored.scenes.values()
    cpu, memory, frames = ([scene.costs[key] for scene in scenes if key in scene.costs] for key in COSTS)
    return (
        format_number(fmean(cpu) / 60 if cpu else None, 2),
        format_number(max(memory) / 1e9 if memory else None, 2),
        format_number(fmean(frames) if frames else None, 2),
    )


def scene_grid(scored: Scored, protocol: Protocol) -> Grid:
    """The scores of each scene, with the digest of its dataset, the seed and the processor time."""
    columns = protocol.columns()
    rows = [
        (
            name,
            scene.dataset[:12],
            MISSING if scene.seed is None else str(scene.seed),
            format_number(scene.costs.get("cpu_seconds"), 0),
            format_number(scene.gap_db(ALL), 2),
            *(format_number(scene.psnr_db(column) if scene.values(column) else None, 2) for column in columns),
        )
        for name, scene in scored.scenes.items()
    ]
    packed = f"packed by hyaline {scored.packed_by}, " if scored.packed_by else ""
    return Grid(
        title=f"{scored.name}: each scene",
        columns=(
            *(Column(group=text, is_number=False) for text in ("scene", "dataset")),
            *(Column(group=text) for text in ("seed", "CPU s ↓", "below ceiling dB ↓")),
            *(Column(group=f"{short} ↑") for short in columns.values()),
        ),
        rows=tuple(rows),
        notes=(f"Submission {scored.submission[:12]}, {packed}scored by {scored.scored_by}.",),
    )
