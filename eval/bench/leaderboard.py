"""The leaderboard: a static page of scored submissions, a table a track, with the views that each predicts worst."""

import base64
from collections.abc import Sequence
from functools import partial
from statistics import fmean

import numpy as np
from jaxtyping import UInt8

from datagen.data.config import TEST_SPLITS
from datagen.data.images import decode_png
from datagen.disk.errors import HyalineError
from datagen.disk.records import shown
from datagen.pages.html import Markup, Part, anchor, document, prose, section, tag
from datagen.pages.pictures import Gallery
from eval.bench.protocol import ALL, Protocol
from eval.bench.score import COSTS, Failure, Scored, Summary, summarise
from eval.page.page import MOST_BYTES
from eval.page.run_page import compared_figure
from eval.score.png import check_png
from eval.tables.grids import MISSING, Column, Grid, format_number
from eval.tables.looks import html_table

NOTES = (
    "PSNR: the mean over a split's pictures, then over a scene's splits, then over scenes. Interval: 95 %, from a "
    "percentile bootstrap over scenes. Below ceiling: distance to the PSNR that the noise of the truth allows. Median "
    "and worst: of the scenes. 10°, 20°, 40° and edits: of all built-in scenes. Hidden: of all hidden scenes; everyone "
    "can build the truth of the others. Edits: whole pictures are compared, although an edit changes few pixels.",
    "CPU min, GB, frames/s: of training and prediction, means over scenes (memory: the largest), where the run's "
    "costs.json has them; on the participant's machine, so compare them within a factor of two. Rows with other scenes "
    "than the first come after those with the same: their averages cannot be compared.",
)


def leaderboard_page(found: Sequence[Scored], protocol: Protocol) -> bytes:
    """The page of scored submissions, all of one preset."""
    check_comparable(found, protocol)
    gallery = Gallery(MOST_BYTES)
    details = [_submission_page(scored, protocol, gallery) for scored in _ranked(found, protocol)]
    title = f"hyaline-bench {protocol.version}, {found[0].preset}"
    return document(
        title,
        gallery.store(),
        tag("div", tag("h1", title), *_tracks(found, protocol), class_="page", id="tracks-page"),
        *details,
        navigation=_navigation(found, protocol),
    )


def check_comparable(found: Sequence[Scored], protocol: Protocol) -> None:
    """Raises a HyalineError unless all were scored by this protocol on the same datasets of one preset."""
    preset = found[0].preset
    for scored in found:
        if (scored.version, scored.preset) != (protocol.version, preset):
            raise HyalineError(
                f"{scored.name}: was scored with protocol {scored.version} at {shown(scored.preset)}; expected "
                f"{protocol.version} at {preset}, as the others"
            )
    digests: dict[str, str] = {}
    for scored in found:
        for scene, result in scored.scenes.items():
            if digests.setdefault(scene, result.dataset) != result.dataset:
                raise HyalineError(
                    f"{scored.name}: was scored on another dataset of {scene} ({result.dataset[:12]}, others on "
                    f"{digests[scene][:12]}); predict and score it again on the one that the protocol names"
                )


def track_grid(title: str, found: Sequence[Scored], protocol: Protocol) -> Grid:
    """One row a submission: the most scenes first, those with the same scenes together, then the highest PSNR."""
    ranked = _ranked(found, protocol)
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


def _ranked(found: Sequence[Scored], protocol: Protocol) -> list[Scored]:
    def rank(scored: Scored) -> tuple[int, list[str], float, str]:
        summary = summarise(scored, ALL, protocol.bootstrap)
        return -len(scored.scenes), sorted(scored.scenes), 0.0 if summary is None else -summary.mean, scored.name

    return sorted(found, key=rank)


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
        scored.packed_by,
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
    return Grid(
        title=f"{scored.name}: each scene",
        columns=(
            *(Column(group=text, is_number=False) for text in ("scene", "dataset")),
            *(Column(group=text) for text in ("seed", "CPU s ↓", "below ceiling dB ↓")),
            *(Column(group=f"{short} ↑") for short in columns.values()),
        ),
        rows=tuple(rows),
        notes=(
            f"Submission {scored.submission[:12]}, packed by hyaline {scored.packed_by}, scored by {scored.scored_by}.",
        ),
    )


def _tracks(found: Sequence[Scored], protocol: Protocol) -> list[Part]:
    parts: list[Part] = [tag("p", protocol.about, class_="note")]
    links = {scored.name: f"{_place(scored)}-page" for scored in found}
    for track, told in protocol.tracks.items():
        inside = [scored for scored in found if scored.track == track]
        content = (
            html_table(track_grid(f"{track}: {len(inside)} submitted", inside, protocol), links)
            if inside
            else tag("p", "No submission yet.")
        )
        parts.append(section(f"Track: {track}", tag("p", prose(told)), content, id_=anchor("track", track)))
    return [*parts, *(tag("p", note, class_="note") for note in NOTES)]


def _place(scored: Scored) -> str:
    return anchor("submission", scored.name, scored.submission)


def _submission_page(scored: Scored, protocol: Protocol, gallery: Gallery) -> Markup:
    figures = [_failure(scored, failure, gallery) for failure in scored.failures]
    shown = section(
        scored.name,
        tag("p", f"Track {scored.track}: told {scored.knowledge or 'what the track allows'}.", class_="note"),
        html_table(scene_grid(scored, protocol)),
        tag("h3", "The views that it predicts worst"),
        tag("p", "At most one of each scene; hidden scenes are left out.", class_="note"),
        tag("div", *figures, class_="views"),
        id_=_place(scored),
    )
    return tag("div", shown, class_="page", id=f"{_place(scored)}-page")


def _failure(scored: Scored, failure: Failure, gallery: Gallery) -> Markup | None:
    what = f"{failure.scene}, {failure.split} view {failure.view}"
    names = []
    for kind, text in (("truth", failure.truth), ("prediction", failure.prediction)):
        names.append(name := anchor(kind, text))
        if not gallery.add(name, partial(_decode, text, f"{scored.name}: {what}: {kind}")):
            return None
    truth, prediction = names
    return compared_figure(gallery, truth, prediction, what, f"{what}: PSNR {failure.psnr_db:.2f} dB")


def _decode(text: str, where: str) -> UInt8[np.ndarray, "h w 3"]:
    data = base64.b64decode(text)
    check_png(data, where=where)
    return np.asarray(decode_png(data, where=where).convert("RGB"))


def _navigation(found: Sequence[Scored], protocol: Protocol) -> Markup:
    items = [tag("li", tag("a", "Tracks", href="#tracks-page"))]
    for track in protocol.tracks:
        inside = [scored for scored in _ranked(found, protocol) if scored.track == track]
        links = [tag("li", tag("a", scored.name, href=f"#{_place(scored)}-page")) for scored in inside]
        items += [tag("li", tag("a", track, href=f"#{anchor('track', track)}"), tag("ul", *links))] if inside else []
    return tag("nav", tag("ul", *items), aria_label="Parts of the leaderboard")
