"""Tests that the sky is found where it shines between walls that should meet, and nowhere else."""

import dataclasses
import functools

import numpy as np
import pytest
from support.synthetic import synthetic_scene

from datagen.data.cameras import Cameras
from datagen.data.config import DatasetConfig, SplitConfig, square
from datagen.data.meshes import Mesh
from datagen.machine.mitsuba_variant import use_mitsuba
from datagen.scene.builtin import SCENES
from datagen.scene.description import CameraRig, Scene, SceneObject, WalkPoint
from datagen.scene.materials import Dielectric, Diffuse, Material
from datagen.scene.modelling import merged, moved, rounded_box, sheet
from datagen.scene.rig import make_cameras
from datagen.trace.slits import Slit, describe_slit, find_slits

GREY, GLASS = Diffuse(color=(0.5, 0.5, 0.5)), Dielectric()


def all_cameras(scene: Scene, *, seed: int = 0, views: int = 40, size: int = 64) -> tuple[Cameras, ...]:
    split = SplitConfig(views=views, spp=4)
    config = DatasetConfig(
        scene=scene.name,
        preset="tiny",
        resolution=square(size),
        seed=seed,
        train=split,
        interpolating=split,
        extrapolating=split,
    )
    return tuple(make_cameras(scene.cameras, config).values())


def slits_of(scene: Scene, **choices: int) -> tuple[Slit, ...]:
    use_mitsuba(quiet=True)
    return find_slits(scene, all_cameras(scene, **choices))


@functools.cache
def modelled(name: str) -> Scene:
    return SCENES[name]()


@pytest.mark.parametrize(
    ("name", "seed"),
    [
        pytest.param(name, seed, marks=() if (name, seed) == ("glass_table", 0) else pytest.mark.full)
        for name in SCENES
        for seed in (0, 7)
    ],
)
def test_no_camera_of_a_built_in_scene_sees_the_sky_through_a_slit(name: str, seed: int) -> None:
    assert slits_of(modelled(name), seed=seed, size=64 + 448 * (seed > 0)) == ()


def with_meshes(scene: Scene, meshes: dict[str, Mesh]) -> Scene:
    objects = tuple(dataclasses.replace(item, mesh=meshes.get(item.name, item.mesh)) for item in scene.objects)
    return dataclasses.replace(scene, objects=objects)


def test_the_slit_that_the_glass_table_once_had_is_found() -> None:
    """Its left wall ended at y = 2.55, and its back wall began at x = -2.60, y = 2.60."""
    scene = with_meshes(
        modelled("glass_table"),
        {
            "back_wall": moved(rounded_box((6.6, 0.08, 3.4), bevel=0.004), (0.7, 2.64, 1.701)),
            "left_wall": moved(rounded_box((0.08, 6.6, 3.4), bevel=0.004), (-2.66, -0.75, 1.701)),
        },
    )
    (slit,) = slits_of(scene)
    assert slit.between == ("back_wall", "left_wall")
    assert 0.04 < slit.width < 0.14
    assert slit.place[:2] == pytest.approx((-2.61, 2.58), abs=0.06)
    assert slit.num_views > 10
    message = describe_slit(scene, slit)
    assert message.startswith("scene glass_table: the sky shows through a slit of ")
    assert " cm between back_wall and left_wall, near (-2.6" in message
    assert "if they should meet, extend one behind the other" in message


def room(gap: float, *, reach: float = 0.0, **more: tuple[Mesh, Material]) -> Scene:
    """A floor and two walls at a corner; the side wall ends `gap` metres before the back wall.

    Args:
        reach: how far the back wall reaches behind the side wall.
    """
    floor = moved(rounded_box((8, 8, 0.1), bevel=0.004), (0, 0, -0.05))
    back = moved(rounded_box((6 + reach, 0.1, 3), bevel=0.004), (-reach / 2, 2.05, 1.501))
    side = moved(rounded_box((0.1, 6, 3), bevel=0.004), (-3.05, -1 - gap, 1.501))
    objects = {"floor": (floor, GREY), "back": (back, GREY), "side": (side, GREY), **more}
    rig = CameraRig(
        target=(-0.5, 0.2, 0.9),
        radius=1.5,
        elevation_deg=(0, 50),
        azimuth_deg=(-90, 0),
        fov_deg=70,
        walk=(WalkPoint(position=(1, -1, 1.2), target=(-2, 1, 1)), WalkPoint(position=(2, 0, 1), target=(-2, 1.5, 1))),
    )
    return dataclasses.replace(
        synthetic_scene(),
        name="room",
        cameras=rig,
        objects=tuple(SceneObject(name=name, mesh=mesh, material=kind) for name, (mesh, kind) in objects.items()),
    )


@pytest.mark.parametrize("gap", [0.005, pytest.param(0.02, marks=pytest.mark.full), 0.08])
def test_a_slit_is_found_however_narrow_it_is(gap: float) -> None:
    (slit,) = slits_of(room(gap))
    assert slit.between == ("back", "side")
    assert gap <= slit.width < 1.5 * gap + 0.01
    assert slit.place[:2] == pytest.approx((-3.0, 2.0 - gap / 2), abs=0.1)
    assert 0 < slit.num_views <= slit.tried_views == 120


def test_a_slit_between_parts_of_one_object_is_found() -> None:
    scene = room(0.03)
    back, side = (item.mesh for item in scene.objects[1:])
    walls = SceneObject(name="walls", mesh=merged([back, side]), material=GREY)
    (slit,) = slits_of(dataclasses.replace(scene, objects=(scene.objects[0], walls)))
    assert slit.between == ("walls", "walls")


@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize("flips", [(False, False), (False, True), (True, False), (True, True)])
def test_a_slit_between_walls_of_one_face_is_found_however_they_are_wound(side: int, flips: tuple[bool, bool]) -> None:
    scene, length, beyond = synthetic_scene(), 1.65, side * 1.71
    walls = {
        "floor": sheet((-length, -length, 0), (2 * length, 0, 0), (0, 2 * length, 0)),
        "wall": sheet((beyond, -length, 0), (0, 2 * length, 0), (0, 0, 2 * length)),
    }
    meshes = [
        dataclasses.replace(mesh, faces=np.ascontiguousarray(mesh.faces[:, ::-1])) if flip else mesh
        for mesh, flip in zip(walls.values(), flips, strict=True)
    ]
    objects = tuple(SceneObject(name=name, mesh=mesh, material=GREY) for name, mesh in zip(walls, meshes, strict=True))
    (slit,) = slits_of(dataclasses.replace(scene, objects=objects))
    assert 0.06 <= slit.width < 0.09
    assert slit.place[0] == pytest.approx(side * 1.68, abs=0.02)


def test_a_slit_behind_glass_is_found() -> None:
    pane = moved(rounded_box((0.02, 2.5, 2), bevel=0.004), (-2.0, 1.2, 1.1))
    assert len(slits_of(room(0.03, pane=(pane, GLASS)))) == 1


CLOSED: dict[str, Scene] = {
    "a back wall that reaches behind the side wall": room(0.001, reach=0.3),
    "a wide opening": room(0.4),
    "a slit behind a cupboard": room(
        0.03,
        cupboard=(moved(rounded_box((0.4, 0.1, 3.2), bevel=0.004), (-2.8, 1.85, 1.61)), GREY),
        side_board=(moved(rounded_box((0.1, 0.5, 3.2), bevel=0.004), (-2.9, 1.7, 1.61)), GREY),
    ),
    "a glass wall": dataclasses.replace(
        room(0.03),
        objects=(
            *room(0.03).objects[:2],
            dataclasses.replace(room(0.03).objects[2], material=GLASS),
        ),
    ),
}


@pytest.mark.parametrize("case", CLOSED)
def test_what_is_closed_wide_or_hidden_is_no_slit(case: str) -> None:
    assert slits_of(CLOSED[case]) == ()


def test_a_slit_that_no_camera_has_in_its_picture_is_none() -> None:
    scene = room(0.03)
    aside = dataclasses.replace(
        scene.cameras,
        fov_deg=20,
        target=(2.5, 1.5, 0.9),
        azimuth_deg=(-100, -60),
        walk=(
            WalkPoint(position=(1, -1, 1.2), target=(2.5, 1.5, 1)),
            WalkPoint(position=(2, 0, 1), target=(2.5, 1.5, 1)),
        ),
    )
    assert slits_of(dataclasses.replace(scene, cameras=aside)) == ()


def test_a_ray_through_the_place_of_a_slit_meets_no_face_and_rays_beside_it_do() -> None:
    """Against every triangle of the scene, in float64."""
    scene = room(0.03)
    (slit,) = slits_of(scene)
    corners = np.concatenate([item.mesh.vertices[item.mesh.faces] for item in scene.objects]).astype(np.float64)
    origins = np.concatenate([cameras.world_from_camera[:, :3, 3] for cameras in all_cameras(scene)])
    across = np.array([0, 1, 0.0])

    def is_open(target: np.ndarray) -> np.ndarray:
        a, e1, e2 = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        free = []
        for origin in origins:
            d, s = target - origin, origin - a
            p, q = np.cross(d, e2), np.cross(s, e1)
            scale = np.einsum("fc,fc->f", e1, p)
            with np.errstate(divide="ignore", invalid="ignore"):
                u, v = np.einsum("fc,fc->f", s, p) / scale, q @ d / scale
                t = np.einsum("fc,fc->f", q, e2) / scale
            free.append(not ((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)).any())
        return np.array(free)

    assert is_open(np.array(slit.place)).sum() > 0
    assert is_open(np.array(slit.place) - 0.06 * across).sum() == 0
    assert is_open(np.array(slit.place) + np.array([0.1, 0.06, 0])).sum() == 0
