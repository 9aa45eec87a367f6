"""`model fit`: shapes and materials of glass from pictures and masks, in stages.

room      textures of everything known, learned from pixels that surely do not see unknown glass
outside   each object's outside, from masks
grid      solid or vessel, wall and floor, by drawing every cell of a grid through the room's textures
search    one number after the other, in brackets that narrow
refine    the textures once more, from all pixels with the glass that was found, then a search once more

FIT/fit.json         sealed, written first: what was asked; in the end the objects that were found
FIT/STAGE.pt         what a stage found, with the digest of what it was found from
FIT/outside-NAME.pt  the same of the outside of one object
FIT/STAGE.png        a picture of it, for stages that draw
"""

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import cast

import numpy as np
import torch
from jaxtyping import Bool, Int
from scipy import ndimage

from datagen.builder.build import peel_dataset
from datagen.builder.variants import peel_variants
from datagen.data.dataset import Dataset, check_has_meshes, find_num_layers, has_layers
from datagen.data.geometries import list_geometries, read_assignment, read_meshes
from datagen.data.images import png_bytes, to_8bit
from datagen.data.meshes import Mesh, is_there
from datagen.data.paths import FITTED, TRUTH, geometry_root
from datagen.disk.errors import HyalineError
from datagen.disk.ownership import PROXIES, begin, holding, refuse_others, remove_files
from datagen.disk.records import Json, commit_sealed, dump_json, load_sealed, to_json
from datagen.disk.storage import commit, sha256
from datagen.scene.description import Scene
from datagen.scene.folder import open_scene, with_materials
from datagen.scene.materials import Diffuse
from datagen.terminal.command import say, track
from datagen.trace.surface_tables import Limits
from hyaline_photos.commands import DRINK, FitChoices
from hyaline_photos.fit import room
from hyaline_photos.fit.boxes import Box
from hyaline_photos.fit.found import (
    FoundGlass,
    Objects,
    digest,
    from_state,
    in_words,
    pictures,
    summary,
    to_state,
    write_geometry,
)
from hyaline_photos.fit.kinds import choose_outside, choose_shown, find_holders, merged, with_drink
from hyaline_photos.fit.search import find_absorption, guess, guesses, in_even_views, refine
from hyaline_photos.fit.shapes import Revolution
from hyaline_photos.fit.views import Sightings, find_unknown, height_below, known_meshes, read_sightings, with_known
from hyaline_photos.report import FIT, FIT_VERSION
from model.methods.light_path.pixels import LightPathPixels
from model.runtime import leaving_settings
from model.state import State, fingerprint, load_state, save_state

GRID_PIXELS, SEARCH_PIXELS = 2000, 4000
"""Pixels of each object, drawn from all training views."""
ROUNDS, LAST_ROUNDS = 4, 1
MATT = Diffuse(color=(0.5, 0.5, 0.5))
"""Of everything whose material is unknown; light paths do not read its colour."""
UP = np.array([0.0, 0.0, 1.0])
ENLARGED, SHOWN_VIEWS, AMPLIFIED = 3, 4, 4
"""In pictures of stages: width of a pixel, views, and factor on differences."""
STAGES = ("room", "outside", "grid", "search", "textures", "refine")


@dataclass(frozen=True, kw_only=True, eq=False)
class FitFolder:
    """The folder of one fit, held by its writer."""

    root: Path
    asked: dict[str, Json]
    """Everything that determines the result."""

    @property
    def head(self) -> dict[str, Json]:
        """What fit.json begins with."""
        return {"version": FIT_VERSION, **self.asked}

    def begin(self, *, overwrite: bool) -> None:
        """Claims the folder; what another fit left there stays only where this one asks for the same."""
        path = self.root / FIT.head
        if not path.is_file():
            refuse_others(self.root, FIT)
            begin(self.root, FIT, self.head)
        elif overwrite:
            files = [f"{stage}.{ending}" for stage in STAGES for ending in ("pt", "png")]
            remove_files(self.root, [*files, *(path.name for path in self.root.glob("outside-*.pt"))])
            commit_sealed(path, self.head)
        else:
            before = load_sealed(path)
            if different := [key for key, value in self.head.items() if before.get(key) != value]:
                raise HyalineError(
                    f"{self.root}: holds a fit with another {different[0]}; start over with --overwrite, or choose "
                    "another --name"
                )

    def stage(self, name: str, depends_on: str, make: Callable[[], dict[str, State]]) -> dict[str, State]:
        """Runs a stage, or reads its stored result.

        Args:
            depends_on: digest of what it is found from.
        """
        path, key = self.root / f"{name}.pt", sha256(dump_json([self.asked, name, depends_on]))
        try:
            state = load_state(path) if path.is_file() else {}
        except HyalineError as error:
            say(f"{error}; making it again")
            state = {}
        if state.pop("key", None) == key:
            say(f"{name}: found before")
            return state
        say(f"{name} ...")
        state = make()
        save_state(path, {**state, "key": key})
        return state


def refuse_losing(dataset: Dataset, geometry: str, unknown: tuple[int, ...]) -> None:
    """Refuses a fit whose geometry would lose glass that another fit has found."""
    own = (read_assignment(dataset, geometry) or ()) if geometry in list_geometries(dataset) else ()
    # What `datagen capture` keeps free for a drink belongs to its vessel.
    mine = {dataset.objects[place - 1].name + part for place in unknown for part in ("", DRINK)}
    if lost := [item.name for item, by in zip(dataset.objects, own) if by == FITTED and item.name not in mine]:
        raise HyalineError(
            f"{geometry_root(dataset.root, geometry)}: holds a fit of {', '.join(lost)}, too; replace it with "
            "--overwrite, or choose another --name"
        )


def fit(dataset: Dataset, geometry: str, choices: FitChoices, out: Path, *, overwrite: bool) -> None:
    """Finds glass, and writes it as a geometry; stages that were finished before are kept.

    Args:
        out: folder of what the stages find.
        overwrite: start over.

    Raises:
        HyalineError: an object has an unknown name or is not glass, or masks are missing.
    """
    check_has_meshes(dataset)
    scene, meshes = open_scene(dataset), read_meshes(dataset, TRUTH)
    assumed = {item.name: MATT for item in scene.objects if choices.room == "matt" and not item.material.is_glass}
    mask_errors = choices.mask_errors if choices.mask_errors is not None else 5 * (dataset.imported is not None)
    unknown = find_unknown(dataset, scene, choices.unknown)
    sightings = read_sightings(dataset, meshes, unknown, is_exact=mask_errors == 0)
    shown = choose_shown(dataset, sightings, must_be_all=bool(choices.unknown))
    if shown != unknown:
        sightings = read_sightings(dataset, meshes, shown, is_exact=mask_errors == 0)
    if not any(map(is_there, known_meshes(meshes, sightings.unknown))):
        raise HyalineError(
            f"{dataset.root}: only unknown glass has a mesh; add meshes of what is seen through it, such as the floor"
        )
    root = geometry_root(dataset.root, geometry)
    if not overwrite:
        refuse_losing(dataset, geometry, sightings.unknown)
    # Everything that determines the result.
    asked: dict[str, Json] = {
        "dataset": dataset.seal,
        "geometry": geometry,
        "unknown": [dataset.objects[object_id - 1].name for object_id in sightings.unknown],
        "masks": fingerprint(torch.from_numpy(sightings.first)),
        "mask_errors": mask_errors,
        "room": choices.room,
        "steps": choices.steps,
        "seed": choices.seed,
    }
    with holding(out, FIT), leaving_settings():
        torch.set_num_threads(1)  # On so few pixels a second one costs more than it saves.
        folder = FitFolder(root=out, asked=asked)
        folder.begin(overwrite=overwrite)
        work = _Work(
            dataset=dataset,
            choices=choices,
            mask_errors=mask_errors,
            scene=with_materials(scene, assumed),
            meshes=meshes,
            sightings=sightings,
            folder=folder,
        )
        found = work.run()
        with holding(root, PROXIES, within=dataset.root):
            materials = {name: to_json(each) for name, each in assumed.items()}
            write_geometry(dataset, geometry, meshes, materials, found)
        commit_sealed(out / FIT.head, {**folder.head, **summary(dataset, found)})
    if has_layers(dataset):
        num_layers = dataset.layer_store().head.num_layers
        is_other = find_num_layers(dataset, geometry) not in (None, num_layers)
        peel_dataset(dataset, geometry, num_layers=num_layers, overwrite=overwrite or is_other)
        peel_variants(dataset, workers=1)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Work:
    """The stages, in run order."""

    dataset: Dataset
    choices: FitChoices
    mask_errors: int
    scene: Scene
    meshes: tuple[Mesh, ...]
    """True ones, of all objects; those of unknown objects are not looked at where masks show their shape."""
    sightings: Sightings
    folder: FitFolder

    def run(self) -> Objects:
        skip = self.choices.skip
        textures = self.folder.stage("room", "", self._learn_room)
        found = self._stage("outside", {}, self._find_outsides)
        if "grid" not in skip:
            found = self._stage("grid", found, lambda: self._scan(textures, found))
        if "search" not in skip:
            found = self._stage("search", found, lambda: self._search("search", textures, found, range(ROUNDS)))
        if "refine" not in skip:
            textures = self.folder.stage("textures", digest(found), lambda: self._learn_again(found))
            last = range(ROUNDS, ROUNDS + LAST_ROUNDS)
            found = self._stage("refine", found, lambda: self._search("refine", textures, found, last))
        return found

    def _stage(self, name: str, before: Objects, make: Callable[[], Objects]) -> Objects:
        state = self.folder.stage(name, digest(before), lambda: cast(dict, to_state(make())))
        return {int(key): found for key, found in from_state(state).items()}

    def _learn_room(self) -> dict[str, State]:
        pixels, beside = self._pixels({}, room.FINE), np.flatnonzero(self._beside_glass())
        state = self._learn(pixels, beside)
        drawn = room.load_room(state, pixels, beside)
        decibels = drawn.decibels(self._beside_glass())
        say(f"  {room.in_words(decibels)}")
        self._show("room", drawn, {})
        return {**state, "decibels": decibels.tolist()}

    def _learn_again(self, found: Objects) -> dict[str, State]:
        pixels = self._pixels(found, room.FINE)
        return self._learn(pixels, np.arange(len(pixels.rgb)))

    def _learn(self, pixels: LightPathPixels, rows: Int[np.ndarray, " pixel"]) -> dict[str, State]:
        is_sky = np.isinf(self.sightings.depth) & self._beside_glass()
        directions, choices = self.sightings.rays()[1][is_sky], self.choices
        sky = np.flatnonzero(is_sky)
        return room.room_state(room.learn(pixels, rows, sky, directions, choices.steps, seed=choices.seed))

    def _beside_glass(self) -> Bool[np.ndarray, "view h w"]:
        """Pixels that neither show unknown glass nor touch one that does."""
        return ~np.asarray(ndimage.binary_dilation(self.sightings.touched, np.ones((1, 3, 3), bool)), bool)

    def _find_outsides(self) -> Objects:
        found: Objects = {}
        sightings, holders = self.sightings, find_holders(self.sightings)
        apart = [each for each in sightings.unknown if each not in {*holders, *holders.values()}]
        # What others may stand on, such as a table top, comes first.
        for object_id in sorted(apart, key=lambda each: -int(self.sightings.sees(each).sum())):
            found |= self._outside(object_id, found, partial(self._found_if_shown, object_id, sightings))
            if object_id in found and isinstance(found[object_id].glass, Box):
                sightings = with_known(sightings, object_id, found[object_id].glass.mesh())
        for inside, vessel in holders.items():
            found |= self._outside(vessel, found, partial(self._found_with_drink, vessel, inside, sightings))
        if not found:
            raise HyalineError(f"{self.dataset.root}: masks show the shape of none of the unknown objects")
        return dict(sorted(found.items()))

    def _outside(self, object_id: int, before: Objects, make: Callable[[], Objects]) -> Objects:
        """What is found of one object, kept if the next one is interrupted."""
        return self._stage(f"outside-{self._name(object_id)}", before, make)

    def _found_with_drink(self, vessel: int, inside: int, sightings: Sightings) -> Objects:
        """The outside of a vessel with its drink; of both if the inner object is none."""
        outside = self._found_if_shown(vessel, merged(sightings, {inside: vessel})).get(vessel)
        glass = outside and with_drink(outside.glass, sightings, inside, vessel)
        if outside and glass:
            say(f"  {self._name(inside)}: drink in {self._name(vessel)}")
            return {vessel: dataclasses.replace(outside, glass=glass, drink_id=inside)}
        return self._found_if_shown(vessel, sightings) | self._found_if_shown(inside, sightings)

    def _found_if_shown(self, object_id: int, sightings: Sightings) -> Objects:
        """The outside of an object, by its id; empty where masks do not show it and nobody asked for it by name."""
        name = self._name(object_id)
        below = (*known_meshes(self.meshes, self.sightings.unknown), *sightings.found)
        stands_on = partial(height_below, below, UP)
        try:
            found = choose_outside(sightings, object_id, UP, mask_errors=self.mask_errors, stands_on=stands_on)
        except HyalineError as error:
            if self.choices.unknown:
                raise HyalineError(f"{name}: {error}") from None
            say(f"  taken as known: {name}: {error}")
            return {}
        say(f"  {name}: {found.glass.kind}; {found.unexplained:.2%} of the pixels at its mask's edge are wrong")
        if found.overruled:
            say(f"  {name}: left out, lacking parts that others show: {', '.join(pictures(self.dataset, found))}")
        return {object_id: found}

    def _scan(self, textures: dict[str, State], found: Objects) -> Objects:
        found = {object_id: self._with_unmasked_drink(object_id, item) for object_id, item in found.items()}
        drawn = self._room(textures, found)
        for object_id, item in found.items():
            ids, start = item.ids(object_id), item.glass
            rows, is_even = self._rows(ids, GRID_PIXELS)
            misses = drawn.misses(ids, rows, guesses(start))
            if "level" in start.numbers:
                start, _ = find_absorption(start, "drink_absorption", misses, is_even)
            glass = guess(start, misses, is_even, label=self._name(object_id), may_be_filled=len(ids) > 1)
            drawn.put(ids, glass)
            found[object_id] = dataclasses.replace(item, glass=glass)
        found = self._shown("grid", drawn, found)
        dry = {each: item for each, item in found.items() if "level" not in item.glass.numbers}
        return found | {each: dataclasses.replace(item, drink_id=None) for each, item in dry.items()}

    def _with_unmasked_drink(self, object_id: int, item: FoundGlass) -> FoundGlass:
        """The same with the object that `datagen capture` keeps free for its drink, if it may hold one."""
        free = f"{self._name(object_id)}{DRINK}"
        ids = [place for place, each in enumerate(self.dataset.objects, start=1) if each.name == free]
        if not ids or item.drink_id is not None or not isinstance(item.glass, Revolution) or item.glass.is_closed:
            return item
        return item if is_there(self.meshes[ids[0] - 1]) else dataclasses.replace(item, drink_id=ids[0])

    def _search(self, stage: str, textures: dict[str, State], found: Objects, rounds: range) -> Objects:
        """Searches all numbers of all objects once in each round."""
        found = dict(found)
        for number in rounds:
            drawn = self._room(textures, found, room.FINE if number >= room.COARSE_ROUNDS else room.COARSE)
            for object_id in track(list(found), label=f"{stage}, round {number + 1}", total=len(found)):
                item, ids = found[object_id], found[object_id].ids(object_id)
                rows, is_even = self._rows(ids, SEARCH_PIXELS if number >= 2 else GRID_PIXELS)
                misses = drawn.misses(ids, rows, (item.glass,))
                for glass, name, value in refine(item.glass, misses, is_even, number=number):
                    if (earlier := item.numbers.get(name)) is not None:
                        value = dataclasses.replace(value, before=earlier.value)
                    item = dataclasses.replace(item, glass=glass, numbers={**item.numbers, name: value})
                drawn.put(ids, item.glass)
                found[object_id] = item
        return self._shown(stage, self._room(textures, found), found)

    # What the stages share

    def _name(self, object_id: int) -> str:
        return self.dataset.objects[object_id - 1].name

    def _rows(
        self, object_ids: Sequence[int], count: int
    ) -> tuple[Int[np.ndarray, " pixel"], Bool[np.ndarray, " pixel"]]:
        """Some of the pixels that see one of some objects first, and which of them are of even views."""
        rows = np.flatnonzero(np.isin(self.sightings.first, object_ids))
        rows = np.sort(np.random.default_rng(self.choices.seed).permutation(rows)[:count])
        return rows, in_even_views(rows // self.dataset.config.resolution.pixels)

    def _pixels(self, found: Objects, limits: Limits = room.COARSE) -> LightPathPixels:
        # Once others are found, unknown ones whose shape masks do not show have their true meshes.
        hidden = {each for object_id, item in found.items() for each in item.ids(object_id)}
        meshes = list(known_meshes(self.meshes, tuple(hidden or self.sightings.unknown)))
        materials = [item.material for item in self.scene.objects]
        for object_id, item in found.items():
            for each, body in item.glass.bodies(item.ids(object_id)).items():
                meshes[each - 1], materials[each - 1] = body
        return room.load_pixels(self.dataset, self.scene, tuple(meshes), tuple(materials), limits)

    def _room(self, textures: dict[str, State], found: Objects, limits: Limits = room.COARSE) -> room.Room:
        return room.load_room(textures, self._pixels(found, limits), np.flatnonzero(self._beside_glass()))

    def _shown(self, stage: str, drawn: room.Room, found: Objects) -> Objects:
        """What a stage found, after saying and drawing it."""
        for object_id, item in found.items():
            say(f"  {self._name(object_id)}: {in_words(item.glass)}")
        self._show(stage, drawn, found)
        return found

    def _show(self, stage: str, drawn: room.Room, found: Objects) -> None:
        """Writes a picture of some views, beside them what is drawn of them, and the difference, amplified."""
        for object_id, item in found.items():
            drawn.put(item.ids(object_id), item.glass)
        rows = []
        for view in np.linspace(0, len(self.sightings.first) - 1, SHOWN_VIEWS).astype(int).tolist():
            truth = self.dataset.view("train", view).image
            pixels = np.arange(truth[..., 0].size)
            colors = drawn.draw(view * len(pixels) + pixels).reshape(truth.shape)
            difference = np.abs(colors - truth / np.float32(255)) * AMPLIFIED
            rows.append(np.hstack([truth, to_8bit(colors), to_8bit(np.clip(difference, 0, 1))]))
        picture = np.vstack(rows).repeat(ENLARGED, axis=0).repeat(ENLARGED, axis=1)
        commit(self.folder.root / f"{stage}.png", png_bytes(picture))
