"""Tests solid plates from 10 mm to 1 um, at the origin and 100 m away, against the closed form of a plate."""

import dataclasses

import numpy as np
import pytest
import trimesh
from support.meshes import box, mesh_of
from support.reference import fresnel_reflectance
from support.scenes import rendered, scene_of

from datagen.data.cameras import Cameras, look_at
from datagen.data.meshes import Mesh
from datagen.machine.mitsuba_variant import use_mitsuba
from datagen.render.mitsuba_scene import load_geometry_mitsuba, to_columns
from datagen.scene.description import RectangleLight, SceneObject, SoftEnvironment
from datagen.scene.materials import Dielectric, Diffuse, RoughDielectric, as_vector
from datagen.scene.media import RAY_OFFSET, largest_coordinate
from datagen.scene.modelling import moved, transformed
from datagen.trace.light_path import LightPathTracer
from datagen.trace.peel import Peeler

use_mitsuba()

AT_ORIGIN, FAR = (0.0, 0.0, 0.0), (100.0, -50.0, 30.0)
DRAWN = [*((thickness, AT_ORIGIN) for thickness in (1e-2, 1e-3, 1e-4, 1e-5, 1e-6))]
DRAWN += [(thickness, FAR) for thickness in (1e-2, 1e-3, 1e-4)]
QUICK = [(1e-2, AT_ORIGIN), (1e-6, AT_ORIGIN), (1e-4, FAR)]
TURN = trimesh.transformations.rotation_matrix(0.4, (1, 2, 0.5))[:3, :3]
IOR, DEPTH, TINT = 1.5, np.array([0.0, 0.25, 0.5]), np.array([1.0, 0.9, 0.6])
"""Optical depth of the plate by channel, straight through, and its tint."""


def plate(thickness: float, place: tuple[float, float, float], turn: np.ndarray = TURN) -> SceneObject:
    absorption = tuple((DEPTH / thickness).tolist())
    mesh = transformed(box((1, 1, thickness)), turn, place)
    return SceneObject(
        name="plate", mesh=mesh, material=Dielectric(ior=IOR, absorption=absorption, tint=as_vector(TINT))
    )


def once(item: SceneObject, cosine: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What one face reflects, (..., 1), and one way through the plate transmits, (..., 3), of light at a cosine."""
    assert isinstance(item.material, Dielectric)
    # Far away, float32 makes the plate another thickness.
    height = item.mesh.vertices.astype(np.float64) @ TURN[:, 2]
    middle = np.median(height)
    thickness = height[height > middle].mean() - height[height < middle].mean()
    r = np.vectorize(fresnel_reflectance)(cosine, IOR)[..., None]
    inner = np.sqrt(1 - (1 - cosine**2) / IOR**2)[..., None]
    return r, np.exp(-np.array(item.material.absorption) * thickness / inner)


@pytest.mark.parametrize(
    ("thickness", "place"),
    [pytest.param(*wall, marks=() if wall in QUICK else pytest.mark.full) for wall in DRAWN],
)
def test_the_truth_of_a_plate_is_the_closed_form_and_both_faces_are_peeled(
    thickness: float, place: tuple[float, float, float]
) -> None:
    item = plate(thickness, place)
    pose = look_at(np.array(place) + np.array((0.3, -0.2, 1.1)), np.array(place))
    cameras = Cameras(world_from_camera=pose[None], fov_x=0.09, width=16, height=16)
    r, tau = once(item, np.abs(cameras[0].rays()[1].astype(np.float64) @ TURN[:, 2]))
    through = TINT**2 * (1 - r) ** 2 * tau / (1 - (r * tau) ** 2)  # All reflections between the faces.
    expected = (through + r + r * tau * through).mean(axis=(0, 1))
    assert rendered(scene_of(item), cameras, spp=64).mean(axis=(0, 1)) == pytest.approx(expected, rel=0.01)
    layers, _ = Peeler((item.mesh,)).peel(cameras, 0, 4)
    assert (layers.object_id[:2] == 1).all() and not layers.object_id[2:].any()


@pytest.mark.parametrize(("thickness", "place"), DRAWN)
def test_light_paths_carry_what_the_closed_form_says(thickness: float, place: tuple[float, float, float]) -> None:
    item = plate(thickness, place)
    along = TURN @ [0.5, 0.3, -1.0] / np.linalg.norm([0.5, 0.3, -1.0])
    directions = along + np.random.default_rng(0).normal(size=(512, 3)) * 0.02
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    origins = np.tile(np.array(place) - 1.5 * along, (512, 1))
    tracer = LightPathTracer((item.mesh,), (item.material,))
    paths = tracer.trace(origins.astype(np.float32), directions.astype(np.float32))
    r, tau = once(item, np.abs(directions @ TURN[:, 2]))
    # Straight through; off the first face; off the second. More reflections are too weak to be followed.
    twice = TINT**2 * (1 - r) ** 2
    shares = twice * tau, r * np.ones(3), twice * r * tau**2
    assert paths.has_left[:3].all()
    for found, share in zip(paths.end_throughput, shares):
        # In the thinnest walls a ray's length is rounded by several per cent; that of many is right.
        np.testing.assert_allclose(found, share, rtol=0.12)
        np.testing.assert_allclose(found.mean(axis=0), share.mean(axis=0), rtol=0.015)
    through = np.abs(np.einsum("rk,rk->r", paths.end_direction[0], directions))
    assert (through > 1 - 1e-5).all(), "a plate bends nothing"


def skewer() -> Mesh:
    return mesh_of(trimesh.creation.cylinder(0.02, 1, sections=1000))


@pytest.mark.parametrize("place", [pytest.param(AT_ORIGIN, marks=pytest.mark.full), FAR])
@pytest.mark.parametrize(
    "mesh",
    [
        box((1, 1, 1)),
        box((200, 200, 1)),
        mesh_of(trimesh.creation.icosphere(5, 0.5)),
        mesh_of(trimesh.creation.icosphere(5, 0.02)),
        skewer(),
    ],
    ids=["cube", "ground", "ball", "small ball", "skewer"],
)
def test_no_ray_meets_the_face_that_it_leaves(mesh: Mesh, place: tuple[float, float, float]) -> None:
    """65,536 rays reflected and as many let through; half the offset still suffices."""
    import drjit as dr
    import mitsuba as mi

    from datagen.render.path_integrator import start_off

    mesh = transformed(mesh, TURN, place)
    scene = load_geometry_mitsuba((mesh,))
    rng = np.random.default_rng(0)
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=-1)
    weights = rng.dirichlet((1, 1, 1), 1 << 16)
    targets = np.einsum("pk,pkc->pc", weights, corners[rng.choice(len(corners), 1 << 16, p=area / area.sum())])
    away = rng.normal(size=targets.shape)
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    distance = rng.uniform(0.5, 3, (len(away), 1)) * float(np.ptp(mesh.vertices, axis=0).max())
    d = mi.Vector3f(*to_columns(-away))
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(*to_columns(targets + distance * away)), d))
    offset = RAY_OFFSET / 2 * largest_coordinate(mesh.vertices)
    mirrored = d - 2 * dr.dot(d, si.n) * si.n
    for way in (d, mirrored):
        following = scene.ray_intersect(mi.Ray3f(start_off(si, offset, way), way))
        again = si.is_valid() & following.is_valid() & (following.prim_index == si.prim_index)
        assert not np.array(again).any()


def test_rough_glass_and_lamps_see_thin_walls() -> None:
    """A lamp above a thin rough pane, and a floor in its light: as with a pane of 10 mm, since nothing is absorbed."""

    def picture(thickness: float) -> np.ndarray:
        pane = moved(box((1, 1, thickness)), (0, 0, 0.5))
        objects = (
            SceneObject(name="pane", mesh=pane, material=RoughDielectric(ior=1.5, roughness=0.3)),
            SceneObject(name="floor", mesh=box((2, 2, 0.1)), material=Diffuse(color=(0.5, 0.5, 0.5))),
        )
        lamp = RectangleLight(corner=(-0.2, -0.2, 1.5), edge_u=(0, 0.4, 0), edge_v=(0.4, 0, 0), radiance=(5, 5, 5))
        dark = SoftEnvironment(zenith=(0.01,) * 3, horizon=(0.01,) * 3, ground=(0.01,) * 3)
        scene = dataclasses.replace(scene_of(*objects, environment=dark), lights=(lamp,))
        pose = np.eye(4)
        pose[:3, 3] = (0, 0, 1.4)
        return rendered(scene, Cameras(world_from_camera=pose[None], fov_x=0.3, width=8, height=8), spp=2048)

    assert picture(1e-5).mean() == pytest.approx(picture(1e-2).mean(), rel=0.02)
