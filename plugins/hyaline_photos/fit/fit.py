"""`model fit`: shapes and materials of glass from pictures and masks, in stages.

room      textures of everything known, learned from pixels that surely do not see unknown glass
outside   each object's outside, from masks
grid      solid or vessel, wall and floor, by drawing every cell of a grid through the room's textures
search    one number after the other, in brackets that narrow
again     the textures once more, from all pixels with the glass that was found, then a search once more
"""

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal, cast

import numpy as np
import torch
from jaxtyping import Bool, Int, UInt8
from scipy import ndimage

from datagen.builder.build import peel_dataset
from datagen.builder.variants import peel_variants
from datagen.data.dataset import Dataset, check_has_meshes, find_num_layers, has_layers
from datagen.data.geometries import read_meshes
from datagen.data.images import to_8bit
from datagen.data.meshes import Mesh, is_there
from datagen.data.paths import TRUTH, geometry_root
from datagen.disk.errors import HyalineError, UsageError
from datagen.disk.ownership import PROXIES, holding
from datagen.disk.records import Json
from datagen.scene.description import Scene
from datagen.scene.folder import material_json, open_scene, with_materials
from datagen.scene.materials import Diffuse
from datagen.terminal.command import say, track
from datagen.trace.surface_tables import Limits
from hyaline_photos.fit import drinks, room
from hyaline_photos.fit.boxes import Box
from hyaline_photos.fit.fit_folder import FIT, FitFolder, refuse_losing
from hyaline_photos.fit.found import (
    FoundGlass,
    Objects,
    digest,
    from_state,
    in_words,
    summary,
    to_state,
    write_geometry,
)
from hyaline_photos.fit.kinds import choose_outside, choose_shown
from hyaline_photos.fit.materials import find_absorption
from hyaline_photos.fit.search import alternatives, count_searches, guess, guesses, in_even_views, refine
from hyaline_photos.fit.views import Sightings, find_unknown, height_below, known_meshes, read_sightings, with_known
from model.methods.light_path.pixels import LightPathPixels
from model.settings import SEED
from model.state import State, fingerprint

Skipped = Literal["grid", "search", "again"]
Room = Literal["known", "matt"]

GRID_PIXELS, SEARCH_PIXELS = 2000, 4000
"""Pixels of each object, drawn from all training views."""

ROUNDS, LAST_ROUNDS = 4, 1

MOST_WRONG = 0.15
"""Share of edge pixels that an outside may get wrong without a remark; masks of other views give 0.2 and more."""

MATT = Diffuse(color=(0.5, 0.5, 0.5))
"""Of everything whose material is unknown; light paths do not read its colour."""

UP = np.array([0.0, 0.0, 1.0])

Image8 = UInt8[np.ndarray, "h w 3"]

ENLARGED, SHOWN_VIEWS, MARGIN, GAP = 3, 4, 6, 2
"""In pictures of stages: width of a pixel, views in a row, and pixels around an object and between pictures."""

AMPLIFIED = 4
"""Factor on differences in these pictures."""


@dataclass(frozen=True, kw_only=True)
class FitChoices:
    """Options of `model fit`."""

    unknown: tuple[str, ...] = ()
    """Names of the objects; none: all glass but thin panes."""
    mask_errors: int = 0
    """Rays at each height of an object that may miss it by mistake."""
    steps: int = 800
    """Training steps for textures."""
    skip: tuple[Skipped, ...] = ()
    room: Room = "known"
    """Materials of everything that is not glass: known, or taken as matt."""
    seed: int = 0

    def __post_init__(self) -> None:
        if self.steps < 1 or self.mask_errors < 0:
            raise UsageError("--steps, --mask-errors: expected at least 1 and 0")
        if not SEED[0] <= self.seed <= SEED[1]:
            raise UsageError(f"--seed: is {self.seed}; expected {SEED[0]} to {SEED[1]}")


def fit(dataset: Dataset, geometry: str, choices: FitChoices, out: Path, *, overwrite: bool) -> None:
    """Finds glass, and writes it as a geometry; stages that were finished before are kept.

    Args:
        out: folder of what the stages find.
        overwrite: start over.

    Raises:
        HyalineError: an object has an unknown name or is not glass, or masks are missing.
    """
    check_has_meshes(dataset)
    scene = open_scene(dataset)
    assumed = {item.name: MATT for item in scene.objects if choices.room == "matt" and not item.material.is_glass}
    unknown = find_unknown(dataset, scene, choices.unknown)
    meshes = read_meshes(dataset, TRUTH)
    is_exact = choices.mask_errors == 0
    sightings = read_sightings(dataset, meshes, unknown, is_exact=is_exact)
    shown = choose_shown(dataset, sightings, mask_errors=choices.mask_errors, must_be_all=bool(choices.unknown))
    if shown != unknown:
        sightings = read_sightings(dataset, meshes, shown, is_exact=is_exact)
    known = known_meshes(meshes, sightings.unknown)
    if not any(map(is_there, known)):
        raise HyalineError(
            f"{dataset.root}: only unknown glass has a mesh; add meshes of what is seen through it, such as the floor"
        )
    root = geometry_root(dataset.root, geometry)
    if not overwrite:
        refuse_losing(dataset, geometry, sightings.unknown)
    with holding(out, FIT), room.one_thread():
        folder = FitFolder(root=out, asked=_asked(dataset, geometry, choices, sightings))
        folder.begin(overwrite=overwrite)
        work = _Work(
            dataset=dataset,
            choices=choices,
            scene=with_materials(scene, assumed),
            meshes=meshes,
            sightings=sightings,
            folder=folder,
        )
        found = work.run()
        with holding(root, PROXIES, within=dataset.root):
            write_geometry(
                dataset, geometry, meshes, {name: material_json(each) for name, each in assumed.items()}, found
            )
        folder.finish(summary(dataset, found))
    if has_layers(dataset):
        num_layers = dataset.layer_store().head.num_layers
        is_other = find_num_layers(dataset, geometry) not in (None, num_layers)
        peel_dataset(dataset, geometry, num_layers=num_layers, overwrite=overwrite or is_other)
        peel_variants(dataset, workers=1)


def _asked(dataset: Dataset, geometry: str, choices: FitChoices, sightings: Sightings) -> dict[str, Json]:
    """Everything that determines the result."""
    return {
        "dataset": dataset.seal,
        "geometry": geometry,
        "unknown": [dataset.objects[object_id - 1].name for object_id in sightings.unknown],
        "masks": fingerprint(torch.from_numpy(sightings.first)),
        "mask_errors": choices.mask_errors,
        "room": choices.room,
        "steps": choices.steps,
        "seed": choices.seed,
    }


@dataclass(frozen=True, kw_only=True, eq=False)
class _Work:
    """The stages, in run order."""

    dataset: Dataset
    choices: FitChoices
    scene: Scene
    meshes: tuple[Mesh, ...]
    """True ones, of all objects; those of unknown objects are not looked at where masks show their shape."""
    sightings: Sightings
    folder: FitFolder

    def run(self) -> Objects:
        skip = self.choices.skip
        textures = self.folder.stage("room", "room: learns textures beside the glass", "", self._learn_room)
        found = self._stage("outside", "outside: finds outsides from masks", {}, self._find_outsides)
        if "grid" not in skip:
            what = "grid: tells solid glass from vessels"
            found = self._stage("grid", what, found, lambda: self._scan(self._room(textures, found), found))
        if "search" not in skip:
            what = "search: one number after the other"
            found = self._stage("search", what, found, lambda: self._search("search", textures, found, range(ROUNDS)))
        if "again" not in skip:
            what = "again: learns textures with the glass that was found"
            textures = self.folder.stage("textures", what, digest(found), lambda: self._learn_again(found))
            what = "again: searches once more"
            last = range(ROUNDS, ROUNDS + LAST_ROUNDS)
            found = self._stage("again", what, found, lambda: self._search("again", textures, found, last))
        return found

    def _stage(self, name: str, title: str, before: Objects, make: Callable[[], Objects]) -> Objects:
        state = self.folder.stage(name, title, digest(before), lambda: cast(dict, to_state(make())))
        return {int(key): found for key, found in from_state(state).items()}

    def _learn_room(self) -> dict[str, State]:
        pixels, beside = self._pixels({}, room.FINE), np.flatnonzero(self._beside_glass())
        state = self._learn(pixels, beside)
        self._show_room(room.load_room(state, pixels, beside))
        return state

    def _learn_again(self, found: Objects) -> dict[str, State]:
        pixels = self._pixels(found, room.FINE)
        return self._learn(pixels, np.arange(len(pixels.rgb)))

    def _learn(self, pixels: LightPathPixels, rows: Int[np.ndarray, " pixel"]) -> dict[str, State]:
        is_sky = np.isinf(self.sightings.depth) & self._beside_glass()
        sky = room.SeenSky(rows=np.flatnonzero(is_sky), directions=self.sightings.rays()[1][is_sky])
        return room.room_state(room.learn(pixels, rows, sky, self.choices.steps, seed=self.choices.seed))

    def _beside_glass(self) -> Bool[np.ndarray, "view h w"]:
        """Pixels that neither show unknown glass nor touch one that does."""
        seen = ndimage.binary_dilation(self.sightings.touched, np.ones((1, 3, 3), bool))
        return np.logical_not(seen)

    def _find_outsides(self) -> Objects:
        found: Objects = {}
        sightings, holders = self.sightings, drinks.find_holders(self.sightings)
        apart = [each for each in sightings.unknown if each not in {*holders, *holders.values()}]
        # What others may stand on, such as a table top, comes first.
        for object_id in sorted(apart, key=lambda each: -int(self.sightings.sees(each).sum())):
            found |= self._found_if_shown(object_id, sightings)
            if object_id in found and isinstance(found[object_id].glass, Box):
                sightings = with_known(sightings, object_id, found[object_id].glass.mesh())
        done = set[int]()
        for inside, vessel in holders.items():
            if vessel in done:
                continue
            outside = self._found_if_shown(vessel, drinks.merged(sightings, {inside: vessel})).get(vessel)
            if outside is None:
                done.add(vessel)
            elif (glass := drinks.with_drink(outside.glass, sightings, inside, vessel)) is not None:
                found[vessel] = dataclasses.replace(outside, glass=glass, drink_id=inside)
                done |= {vessel, inside}
                say(f"  {self._name(inside)}: drink in {self._name(vessel)}")
        for object_id in dict.fromkeys((*holders.values(), *holders)):
            if object_id not in done:
                found |= self._found_if_shown(object_id, sightings)
        if not found:
            raise HyalineError(f"{self.dataset.root}: masks show the shape of none of the unknown objects")
        return dict(sorted(found.items()))

    def _found_if_shown(self, object_id: int, sightings: Sightings) -> Objects:
        """The outside of an object, by its id; empty where masks do not show it and nobody asked for it by name."""
        try:
            return {object_id: self._find_outside(object_id, sightings)}
        except HyalineError as error:
            if self.choices.unknown:
                raise
            say(f"  taken as known: {error}")
            return {}

    def _find_outside(self, object_id: int, sightings: Sightings) -> FoundGlass:
        below = (*known_meshes(self.meshes, self.sightings.unknown), *sightings.found)
        try:
            outside = choose_outside(
                sightings,
                object_id,
                UP,
                mask_errors=self.choices.mask_errors,
                stands_on=partial(height_below, below, UP),
            )
        except HyalineError as error:
            raise HyalineError(f"{self._name(object_id)}: {error}") from None
        wrong = f"{100 * outside.unexplained:.2g} % of the pixels at its mask's edge are wrong"
        say(f"  {self._name(object_id)}: {outside.glass.kind}; {wrong}")
        if outside.unexplained > MOST_WRONG:
            say(f"  {self._name(object_id)}: its masks contradict the cameras; check the order of the masks")
        return FoundGlass(glass=outside.glass, unexplained=outside.unexplained)

    def _scan(self, drawn: room.Room, found: Objects) -> Objects:
        found = dict(found)
        for object_id, item in found.items():
            ids = item.ids(object_id)
            rows = self._rows(ids, GRID_PIXELS)
            start = item.glass
            misses = drawn.misses(ids, rows, guesses(start))
            if item.drink_id is not None:
                start, _ = find_absorption(start, "drink_absorption", misses, self._is_even(rows))
            cells, glass = guess(start, misses, self._is_even(rows), label=self._name(object_id))
            best, second = alternatives(cells)
            drawn.put(ids, glass)
            words = f"  {self._name(object_id)}: {in_words(glass)}"
            if second is not best:
                words += f"; with {second.loss / best.loss:.2f} times the loss: {in_words(second.glass)}"
            say(words)
            found[object_id] = dataclasses.replace(item, glass=glass)
        self._show_drawn("grid", drawn, found)
        return found

    def _search(self, stage: str, textures: dict[str, State], found: Objects, numbers: range) -> Objects:
        found = dict(found)
        for number in numbers:
            total = sum(count_searches(item.glass, number) for item in found.values())
            label = f"{stage}, round {number + 1}"
            list(track(self._round(textures, found, number), label=label, total=total))
        for object_id, item in found.items():
            say(f"  {self._name(object_id)}: {in_words(item.glass)}")
        self._show_drawn(stage, self._room(textures, found), found)
        return found

    def _round(self, textures: dict[str, State], found: Objects, number: int) -> Iterator[None]:
        """Searches all numbers of all objects once, and replaces the objects in `found`."""
        drawn = self._room(textures, found, room.FINE if number >= room.COARSE_ROUNDS else room.COARSE)
        for object_id in found:
            item = found[object_id]
            rows = self._rows(item.ids(object_id), SEARCH_PIXELS if number >= 2 else GRID_PIXELS)
            misses, is_even = drawn.misses(item.ids(object_id), rows, (item.glass,)), self._is_even(rows)
            for glass, name, value in refine(item.glass, misses, is_even, number=number):
                if (earlier := item.numbers.get(name)) is not None:
                    value = dataclasses.replace(value, before=earlier.value)
                item = dataclasses.replace(item, glass=glass, numbers={**item.numbers, name: value})
                yield
            drawn.put(item.ids(object_id), item.glass)
            found[object_id] = item

    # What the stages share

    def _known(self, found: Objects) -> list[Mesh]:
        """Meshes of the known objects, and once others are found, of the unknown ones whose shape masks do not show."""
        hidden = set(self.sightings.unknown)
        if found:
            hidden = {each for object_id, item in found.items() for each in item.ids(object_id)}
        return list(known_meshes(self.meshes, tuple(hidden)))

    def _name(self, object_id: int) -> str:
        return self.dataset.objects[object_id - 1].name

    def _rows(self, object_ids: Sequence[int], count: int) -> Int[np.ndarray, " pixel"]:
        """Some of the pixels that see one of some objects first."""
        rows = np.flatnonzero(np.isin(self.sightings.first, object_ids))
        return np.sort(np.random.default_rng(self.choices.seed).permutation(rows)[:count])

    def _is_even(self, rows: Int[np.ndarray, " pixel"]) -> Bool[np.ndarray, " pixel"]:
        return in_even_views(rows // self.dataset.config.resolution.pixels)

    def _pixels(self, found: Objects, limits: Limits = room.COARSE) -> LightPathPixels:
        meshes, materials = self._known(found), [item.material for item in self.scene.objects]
        for object_id, item in found.items():
            for each, body in zip(item.ids(object_id), item.glass.bodies(), strict=True):
                meshes[each - 1], materials[each - 1] = body
        return room.load_pixels(self.dataset, self.scene, tuple(meshes), tuple(materials), limits)

    def _room(self, textures: dict[str, State], found: Objects, limits: Limits = room.COARSE) -> room.Room:
        return room.load_room(textures, self._pixels(found, limits), np.flatnonzero(self._beside_glass()))

    # Pictures

    def _show_room(self, drawn: room.Room) -> None:
        whole = tuple(slice(0, side) for side in self.dataset.config.resolution.shape)
        views = np.linspace(0, len(self.sightings.first) - 1, SHOWN_VIEWS).astype(int).tolist()
        self.folder.write_picture("room", sheet([self._compared(drawn, view, whole) for view in views]))

    def _show_drawn(self, stage: str, drawn: room.Room, found: Objects) -> None:
        """A row for each object: some views that see it best."""
        rows = []
        for object_id, item in found.items():
            drawn.put(item.ids(object_id), item.glass)
        for object_id, item in found.items():
            seen = np.isin(self.sightings.first, item.ids(object_id))
            counts = seen.sum(axis=(1, 2))
            large = np.flatnonzero(counts >= np.quantile(counts[counts > 0], 0.5))
            some = large[np.linspace(0, len(large) - 1, min(SHOWN_VIEWS, len(large))).astype(int)].tolist()
            near = [np.asarray(ndimage.binary_dilation(seen[view], iterations=MARGIN), np.uint8) for view in some]
            boxes = [ndimage.find_objects(each)[0] for each in near]
            rows.append([part for view, box in zip(some, boxes) for part in self._compared(drawn, view, box)])
        self.folder.write_picture(stage, sheet(rows))

    def _compared(self, drawn: room.Room, view: int, box: tuple[slice, ...]) -> list[Image8]:
        """A part of a view's picture, what was drawn of it, and their difference, amplified."""
        shape = self.sightings.first.shape
        pixels = np.arange(np.prod(shape)).reshape(shape)[view][box]
        truth = self.dataset.view("train", view).image[box]
        colors = drawn.draw(pixels.ravel()).reshape(*pixels.shape, 3)
        difference = np.abs(colors - truth / np.float32(255)) * AMPLIFIED
        return [truth, to_8bit(colors), to_8bit(np.clip(difference, 0, 1))]


def sheet(rows: list[list[Image8]]) -> Image8:
    """Pictures side by side, row by row, enlarged."""
    height, width = (max(image.shape[axis] for row in rows for image in row) + GAP for axis in (0, 1))
    canvas = np.full((len(rows) * height, max(map(len, rows)) * width, 3), 255, np.uint8)
    for down, row in enumerate(rows):
        for across, image in enumerate(row):
            canvas[down * height :, across * width :][: image.shape[0], : image.shape[1]] = image
    return canvas.repeat(ENLARGED, axis=0).repeat(ENLARGED, axis=1)
