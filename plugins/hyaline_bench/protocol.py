"""The benchmark's protocol: scenes, sizes, splits, edits and tracks, from protocol.toml."""

import functools
import shlex
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from datagen.data.config import ANGLE_SPLITS, TEST_SPLITS, DatasetConfig, Split, SplitConfig, config_difference, square
from datagen.data.dataset import Dataset
from datagen.data.geometries import NO_GEOMETRY
from datagen.data.paths import MIXED, PROXY_KINDS, TRUTH, is_fitted
from datagen.data.variants import ANGLES, EDIT_MASKS_FOLDER, TWINS, variant_root
from datagen.disk.errors import HyalineError
from datagen.disk.records import from_json
from datagen.scene.edits import edits_name, parse_edit
from datagen.terminal.command import choose, say
from eval.score.runs import Run

PROTOCOL = Path(__file__).with_name("protocol.toml")

GLASS, ALL, EDITS = "glass", "all", "edits"
"""Columns besides the splits: the mean over the test splits of pixels whose light meets glass, and of all; and over the
test splits of both edits, of the pixels that change."""
NO_GLASS = TWINS[0]
"""The edit whose masks tell which pixels' light meets glass."""


@dataclass(frozen=True, kw_only=True)
class Size:
    """The size of a preset's datasets."""

    resolution: int
    train: SplitConfig
    test: SplitConfig
    ceiling_db: float | None = None
    """Test views have the samples that their noise ceiling takes to reach this, and at least those of `test`."""
    scenes: tuple[str, ...] = ()
    """The scenes that belong to the preset; empty for all."""


@dataclass(frozen=True, kw_only=True)
class Random:
    """The random scenes that everybody can build."""

    families: tuple[str, ...]
    """Families that public scenes and hidden ones take turns among."""
    first_seed: int
    count: int


@dataclass(frozen=True, kw_only=True)
class Hidden:
    """The scenes that only a verifier can build."""

    count: int
    commitment: str
    """SHA-256 of the verifier's secret; empty while no round is open."""


@dataclass(frozen=True, kw_only=True)
class Bootstrap:
    """How intervals over scenes are found."""

    resamples: int
    seed: int
    confidence: float


@dataclass(frozen=True, kw_only=True)
class Protocol:
    """The content of protocol.toml."""

    version: int
    max_depth: int
    """Longest light path of the truth in segments."""
    presets: dict[str, Size]
    scenes: dict[str, tuple[str, ...]]
    """The built-in scenes, and the edits of each."""
    random: Random
    hidden: Hidden
    digests: dict[str, dict[str, str]]
    """Digests of the public datasets by preset and scene; empty where none are fixed yet."""
    splits: dict[str, str]
    """The splits that every submission predicts, and where their cameras are."""
    tracks: dict[str, str]
    """What a method may be told, from least to most."""
    bootstrap: Bootstrap

    def size(self, preset: str) -> Size:
        return self.presets[choose("preset", preset, self.presets)]

    def public_scenes(self, preset: str) -> list[str]:
        """The scenes of a preset that everybody can build."""
        random = (self.random_name(place, self.random.first_seed + place) for place in range(self.random.count))
        every = [*self.scenes, *random]
        return [name for name in every if name in (self.size(preset).scenes or every)]

    def build_command(self, scene: str, preset: str, out: str) -> str:
        """The command that builds a scene's dataset."""
        ceiling = self.size(preset).ceiling_db
        more = "" if ceiling is None else f" --ceiling {ceiling:g}"
        return f"datagen build {scene} --preset {preset}{more} --out {out}"

    def random_name(self, place: int, seed: int) -> str:
        """The name of the random scene at a place among the public or the hidden ones."""
        return f"random-{self.random.families[place % len(self.random.families)]}-{seed:04d}"

    def hidden_scenes(self, preset: str) -> list[str]:
        """The names under which hidden scenes are published; none in a preset that lists its scenes."""
        return [] if self.size(preset).scenes else [f"hidden-{place}" for place in range(self.hidden.count)]

    def all_scenes(self, preset: str) -> list[str]:
        return [*self.public_scenes(preset), *self.hidden_scenes(preset)]

    def variant_splits(self, scene: str) -> dict[str, Sequence[Split]]:
        """The variants to predict beside the scene itself, and their splits."""
        if scene not in self.scenes:
            return {}  # The cameras of random scenes leave no room 40 degrees outside.
        splits: dict[str, Sequence[Split]] = {ANGLES: [split for split in ANGLE_SPLITS if split in self.splits]}
        return splits | dict.fromkeys((edits_name((parse_edit(edit),)) for edit in self.scenes[scene]), TEST_SPLITS)

    def allowed(self, track: str) -> list[str]:
        """What a track allows, and the tracks before it."""
        return list(self.tracks.values())[: list(self.tracks).index(track) + 1]

    def columns(self) -> dict[str, str]:
        """What is averaged over scenes besides `GLASS` and `ALL`, with a short title."""
        short = {"interpolating": "inter", "extrapolating": "extra"}
        angles = {split: f"{degrees:.0f}°" for split, degrees in ANGLE_SPLITS.items()}
        return {split: (short | angles)[split] for split in self.splits} | {EDITS: EDITS}


@functools.cache
def load_protocol() -> Protocol:
    """The protocol of this version."""
    return from_json(Protocol, tomllib.loads(PROTOCOL.read_text()), where=str(PROTOCOL))


@contextmanager
def left_out() -> Iterator[None]:
    """Says what is wrong with a dataset, a run or a method, and goes on with the next one."""
    try:
        yield
    except HyalineError as error:
        say(f"left out: {error}")


def is_of_preset(dataset: Dataset, preset: str, protocol: Protocol) -> bool:
    """True for a dataset of one of the preset's scenes.

    Raises:
        HyalineError: it has the preset's name, but another size, seed or depth of paths.
    """
    config = dataset.config
    if config.preset != preset or config.scene not in protocol.all_scenes(preset) or dataset.parent is not None:
        return False
    size = protocol.size(preset)
    asked = DatasetConfig(
        scene=config.scene,
        preset=preset,
        resolution=square(size.resolution),
        train=size.train,
        interpolating=size.test,
        extrapolating=size.test,
        ceiling_db=size.ceiling_db,
        max_depth=protocol.max_depth,
    )
    if difference := config_difference(asked, config):
        raise HyalineError(
            f"{dataset.root}: differs from the protocol's {preset} ({difference}); `hyaline-bench commands` prints the "
            "commands that build public scenes, `hyaline-bench secret` those for hidden ones"
        )
    return True


def glass_masks(dataset: Dataset) -> Path:
    """The folder of masks that tell which pixels' light meets glass."""
    masks = variant_root(dataset.root, NO_GLASS) / EDIT_MASKS_FOLDER
    if not masks.is_dir():
        words = ["datagen", "add", str(dataset.root), "--edit", NO_GLASS]
        raise HyalineError(f"{masks}: missing; make them with `{shlex.join(words)}`")
    return masks


def least_track(run: Run, tracks: Mapping[str, str]) -> str | None:
    """The first track that allows what a run was told, by its record; None if the record does not say."""
    pictures, masks, proxies, shapes, materials = tracks
    geometry, told, uses_materials = run.record.geometry, run.record.told, run.record.uses_materials
    if uses_materials is None:
        uses_materials = run.record.method == "light-path"
    if geometry is None:
        return materials if uses_materials else None
    if is_fitted(geometry):
        if uses_materials and (told is None or told):
            return materials  # Of other objects at least, such as varnish on a floor.
        return shapes if told or geometry == "fitted-materials" else masks
    if uses_materials:
        return materials
    if geometry == NO_GEOMETRY:
        return pictures
    kind = geometry.partition("-")[0]
    if geometry == TRUTH or kind == MIXED:  # A mixture may hold true meshes.
        return shapes
    return proxies if kind in PROXY_KINDS else None


def choose_track(run: Run, asked: str | None, tracks: Mapping[str, str]) -> str:
    """The track of a run: the one that was asked for, if it may be told that much there, or the first that fits.

    The record of a foreign method is a promise, so its track must be asked for, unless it was told pictures alone.
    """
    least = least_track(run, tracks)
    if asked is None:
        is_own = run.seal is not None
        if least is None or not (is_own or run.record.geometry == NO_GEOMETRY):
            raise HyalineError(
                f"{run.folder}: run.json does not show all inputs of the method; name the track with --track, "
                f"one of {', '.join(tracks)}"
            )
        return least
    choose("track", asked, tracks)
    order = list(tracks)
    if least is not None and order.index(asked) < order.index(least):
        raise HyalineError(
            f"{run.folder}: uses inputs ({run.record.knowledge or run.record.geometry}) that the track {asked} does "
            f"not allow; submit it to {least}"
        )
    return asked
