"""Tests what is refused because it would render wrong in silence, and that nothing good is refused with it."""

import dataclasses

import numpy as np
import pytest
from support.meshes import inside_out
from support.reference import winding_numbers
from support.synthetic import synthetic_scene

from datagen.data.config import DatasetConfig, square
from datagen.data.meshes import Mesh
from datagen.data.queries import windings
from datagen.disk.errors import HyalineError
from datagen.scene.description import Scene, SceneObject, WalkPoint
from datagen.scene.materials import Dielectric, Diffuse, Material, ThinDielectric
from datagen.scene.modelling import ball, lathe, merged, moved, rounded_box, sheet, transformed, tube, walled
from datagen.scene.rig import cameras_within, make_cameras
from datagen.scene.soundness import check_glass_is_seen, check_scene

GLASS, GREY, PANE = Dielectric(), Diffuse(color=(0.5, 0.5, 0.5)), ThinDielectric()
BALL = ball(0.2, subdivisions=3)
WALK = (WalkPoint(position=(1.5, 0, 1), target=(0, 0, 0)), WalkPoint(position=(0, 0.8, 0.5), target=(0, 0, 0)))
RIG = dataclasses.replace(synthetic_scene().cameras, target=(0, 0, 0.3), radius=2.0, elevation_deg=(10, 70), walk=WALK)


def scene_of(mesh: Mesh, material: Material = GLASS, **others: tuple[Mesh, Material]) -> Scene:
    """A scene with an object `thing`, and others."""
    objects = [SceneObject(name="thing", mesh=mesh, material=material)]
    objects += [SceneObject(name=name, mesh=other, material=kind) for name, (other, kind) in others.items()]
    return dataclasses.replace(synthetic_scene(), name="room", objects=tuple(objects), cameras=RIG)


def with_normals(mesh: Mesh, factor: float, share: float = 1.0) -> Mesh:
    """The mesh with a share of its normals multiplied."""
    factors = np.where(np.arange(len(mesh.normals)) < share * len(mesh.normals), factor, 1)[:, None]
    return dataclasses.replace(mesh, normals=(mesh.normals * factors).astype(np.float32))


def scaled(mesh: Mesh, factor: float) -> Mesh:
    return transformed(mesh, factor * np.eye(3), (0, 0, 0))


def eight() -> Mesh:
    """A tube along a flat figure of eight, which goes through itself in the middle."""
    angle = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    path = np.stack([0.3 * np.sin(angle), 0.3 * np.sin(angle) * np.cos(angle), np.full(64, 0.4)], axis=-1)
    return tube(path, 0.05, is_loop=True)


def glasses(*glass: tuple[Mesh, Material]) -> Scene:
    """A scene of objects `g0`, `g1` and so on."""
    objects = tuple(SceneObject(name=f"g{i}", mesh=mesh, material=material) for i, (mesh, material) in enumerate(glass))
    return dataclasses.replace(scene_of(BALL), objects=objects)


def quad(z: float, size: float = 1.0) -> Mesh:
    return sheet((-size / 2, -size / 2, z), (size, 0, 0), (0, size, 0))


FLOOR = rounded_box((3, 3, 0.1), bevel=0.01)
CUBE = rounded_box((0.2, 0.2, 0.2), bevel=0.01)
ON_FLOOR = moved(CUBE, (0, 0, 0.15))

BALLS = [moved(ball(0.1, subdivisions=1), (i / 4, 0, 3)) for i in range(33)]
DROPS = [(moved(ball(0.02, subdivisions=1), (i / 20 - 0.8, 0, 0)), Dielectric(ior=1.33)) for i in range(32)]
BUBBLE = ball(0.2, subdivisions=2)
SHELL = merged([ball(0.3, subdivisions=2), inside_out(BUBBLE)])

WRONG: dict[str, tuple[Scene, str]] = {
    "glass with flipped normals": (
        scene_of(with_normals(BALL, -1)),
        r"100\.0 % of the vertex normals point to the back of their faces; expected at most 1 %, compute its normals",
    ),
    "normals that are 0": (scene_of(with_normals(BALL, 0, 0.004)), r"3 vertex normals are 0; expected unit vectors"),
    "two balls that overlap": (
        scene_of(merged([BALL, moved(BALL, (0.13, 0.02, 0.01))])),
        r"\d\d\.\d % of the surface, around \(.*\), lies inside of the rest: its parts overlap; unite it",
    ),
    "a bubble that is wound outward": (
        scene_of(merged([BALL, moved(ball(0.04, subdivisions=2), (0.05, 0, 0))])),
        r"part \d of 2 lies inside another part and is wound outward; delete it, reverse its faces if it is a bubble",
    ),
    "a surface that crosses itself": (scene_of(eight()), r"lies inside of the rest: the surface crosses itself"),
    "glass a hundredth of a millimetre above an opaque floor": (
        scene_of(moved(ON_FLOOR, (0, 0, 1e-5)), GLASS, floor=(FLOOR, GREY)),
        r"1\d\.\d % of its surface lies in faces of floor, and one of them is glass; leave a gap of a millimetre",
    ),
    "a pane on a floor": (scene_of(quad(0.05, 0.4), PANE, floor=(FLOOR, GREY)), r"100\.0 % of its surface lies in"),
    "millimetres taken for metres": (
        scene_of(scaled(ON_FLOOR, 1000), GREY),
        r"is 200 m large, and the cameras are 2 m from their target; .* scale it \(by 0\.001",
    ),
    "metres taken for kilometres": (
        scene_of(scaled(ON_FLOOR, 0.001), GREY),
        r"is 0\.0002 m large and at least 0\.\d+ m from every camera, too small to be seen; lengths are metres",
    ),
    "a scene a thousand times too small": (
        dataclasses.replace(scene_of(scaled(BALL, 0.001), GREY), cameras=dataclasses.replace(RIG, radius=0.002)),
        r"its cameras are 0\.002 m from .* lengths are metres",
    ),
    "a scene a thousand times too large": (
        dataclasses.replace(scene_of(scaled(BALL, 1000), GREY), cameras=dataclasses.replace(RIG, radius=2000)),
        r"its cameras are 2000 m from .* lengths are metres",
    ),
    "more priorities than a ray can tell apart": (
        glasses(*((mesh, Dielectric(priority=i // 20)) for i, mesh in enumerate(BALLS))),
        r"33 dielectrics of different priority; expected at most 32",
    ),
    "too many dielectrics, some overlapping": (
        glasses((ball(0.85, subdivisions=2), Dielectric()), *DROPS),
        r"overlap, and there are 33 dielectrics; where any overlap, expected at most",
    ),
    "a drink that ends exactly on its glass": (
        glasses((SHELL, Dielectric()), (BUBBLE, Dielectric(ior=1.33))),
        r"objects g0 and g1 share 320 faces; extend one into the other",
    ),
    "a camera in glass": (
        scene_of(ball(1.2, subdivisions=3)),
        r"a camera is inside this glass, at \(.*\), but rays must start in air",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_what_renders_wrong_is_refused_in_a_line_that_names_the_place_and_the_way_out(case: str) -> None:
    scene, message = WRONG[case]
    with pytest.raises(HyalineError, match=message) as refused:
        check_scene(scene)
    assert str(refused.value).startswith("scene room: ")
    assert "; " in str(refused.value)
    assert "\n" not in str(refused.value)


TUMBLER = lathe(walled([(0, 0), (0.03, 0), (0.035, 0.1)], wall=0.0002, floor=0.001))

GOOD: dict[str, Scene] = {
    "a ball": scene_of(BALL),
    "a bubble in a ball": scene_of(merged([BALL, inside_out(moved(ball(0.05, subdivisions=2), (0.1, 0, 0)))])),
    "a wall of a fifth of a millimetre": scene_of(TUMBLER),
    "a few flipped normals": scene_of(with_normals(BALL, -1, 0.004)),
    "opaque parts that overlap": scene_of(merged([BALL, moved(BALL, (0.1, 0, 0))]), GREY),
    "an opaque cube flush on a floor": scene_of(ON_FLOOR, GREY, floor=(FLOOR, GREY)),
    "glass a millimetre above a floor": scene_of(moved(ON_FLOOR, (0, 0, 0.001)), GLASS, floor=(FLOOR, GREY)),
    "glass that reaches into a floor": scene_of(moved(ON_FLOOR, (0, 0, -0.001)), GLASS, floor=(FLOOR, GREY)),
    "as many dielectrics as wanted, of one priority and apart": glasses(*((mesh, Dielectric()) for mesh in BALLS)),
    "32 dielectrics of two priorities": glasses(*((m, Dielectric(priority=i // 20)) for i, m in enumerate(BALLS[:32]))),
    "32 dielectrics that overlap": glasses((ball(0.85, subdivisions=2), Dielectric()), *DROPS[:31]),
    "a drink that does not touch its glass": glasses((SHELL, GLASS), (ball(0.19, subdivisions=2), GLASS)),
    "a drink in its glass": scene_of(
        BALL, GLASS, drink=(moved(ball(0.1, subdivisions=3), (0.15, 0, 0)), Dielectric(ior=1.33, priority=-1))
    ),
    "glass around what the cameras look at": scene_of(moved(ball(0.7, subdivisions=3), (-0.3, -0.3, 0))),
}


@pytest.mark.parametrize("case", GOOD)
def test_what_renders_right_is_not_refused(case: str) -> None:
    check_scene(GOOD[case])


def test_real_cameras_in_glass_are_refused_that_a_sample_of_the_rig_misses() -> None:
    cameras = make_cameras(RIG, DatasetConfig.even("room", square(16), 8))
    cameras_within(scene_of(BALL), cameras)
    place = cameras["train"].world_from_camera[3, :3, 3]
    scene = scene_of(moved(ball(0.03, subdivisions=2), place.tolist()))
    check_scene(scene)
    with pytest.raises(HyalineError, match="object thing: a camera is inside this glass"):
        cameras_within(scene, cameras)


def test_a_rig_none_of_whose_cameras_sees_glass_is_refused() -> None:
    cameras = make_cameras(RIG, DatasetConfig.even("room", square(16), 8)).values()
    check_glass_is_seen(scene_of(BALL), cameras)
    with pytest.raises(HyalineError, match=r"no camera sees thing; .* or a rig with a target near it"):
        check_glass_is_seen(scene_of(moved(BALL, (0, 0, 50))), cameras)


def test_windings_are_those_of_the_solid_angle() -> None:
    mesh = merged([BALL, moved(BALL, (0.13, 0.02, 0.01)), inside_out(moved(BALL, (-0.2, 0, 0.1))), CUBE])
    points = np.random.default_rng(5).uniform(-0.4, 0.4, size=(400, 3))
    expected = winding_numbers(mesh, points)
    found = windings(mesh.vertices[mesh.faces], points)
    np.testing.assert_allclose(found, expected, atol=1e-6)
    assert set(found) >= {-1, 0, 1, 2}
