"""Vessels are joined with what their hulls have beside them."""

import numpy as np
import pytest
from support.silhouettes import block, cylinder, either, sightings_of

from datagen.data.meshes import Mesh, check_closed, check_mesh, check_solid, signed_volume
from datagen.machine.mitsuba_variant import use_mitsuba
from datagen.scene.modelling import moved, rounded_box
from datagen.scene.shading_normals import MAX_OPPOSING, opposing_share
from hyaline_photos.fit.handles import Handled, with_handles, without_handles
from hyaline_photos.fit.hull import HullShape
from hyaline_photos.fit.lathe import Axis, evenly
from hyaline_photos.fit.shapes import OUTSIDE, Revolution
from hyaline_photos.fit.views import rays_near

use_mitsuba()
AXIS = Axis(point=np.zeros(3), direction=np.array([0.0, 0.0, 1.0]))
LINE = np.array([(0, 0), (0.03, 0), (0.03, 0.09)])
VESSEL = Revolution(axis=AXIS, outside=evenly(LINE, OUTSIDE)).hollowed(0.1, 0.1, 0.3)


def hull_of(*beside: Mesh) -> HullShape:
    """The solid vessel, a little fatter, as hulls are, with other parts that go into it."""
    import manifold3d

    from hyaline_photos.fit.handles import _mesh, _solid
    from hyaline_photos.fit.lathe import revolved

    fat = np.array([(0, -0.0005), (0.0305, -0.0005), (0.0305, 0.092), (0, 0.096)])
    parts = [revolved(AXIS, fat), *beside]
    joined = manifold3d.Manifold.batch_boolean([_solid(part) for part in parts], manifold3d.OpType.Add)
    return HullShape(surface=_mesh(joined))


def handled() -> Handled:
    # From 5 mm inside of the wall to 17 mm outside of it.
    bar = moved(rounded_box((0.022, 0.012, 0.012), bevel=0.001), (0.036, 0, 0.05))
    found = with_handles(VESSEL, hull_of(bar))
    assert found is not None
    return found


def test_the_union_is_closed_and_solid_and_has_the_handle_s_volume_more() -> None:
    mesh = handled().mesh()
    for check in (check_mesh, check_closed, check_solid):
        check(mesh, where="mug")
    assert mesh.vertices[:, 0].max() == pytest.approx(0.047, abs=1e-5)
    more = signed_volume(mesh) - signed_volume(VESSEL.mesh())
    assert more == pytest.approx(0.017 * 0.012**2, rel=0.05)


def test_other_numbers_move_the_vessel_and_leave_the_faces_and_the_handle() -> None:
    mug = handled()
    thin = mug.having(wall=0.001, ior=1.6)
    mesh, other = mug.mesh(), thin.mesh()
    check_closed(other, where="mug")
    check_solid(other, where="mug")
    assert np.array_equal(mesh.faces, other.faces)
    assert signed_volume(other) < 0.7 * signed_volume(mesh)
    is_handle = mesh.vertices[:, 0] > 0.032
    assert np.array_equal(mesh.vertices[is_handle], other.vertices[is_handle])


def test_shading_normals_are_outward_units_and_uv_are_in_the_atlas() -> None:
    mesh = handled().mesh()
    assert np.linalg.norm(mesh.normals, axis=1) == pytest.approx(np.ones(len(mesh.normals)), abs=1e-4)
    assert opposing_share(mesh) < MAX_OPPOSING
    assert mesh.uv.min() >= 0
    assert mesh.uv.max() <= 1


def test_a_hull_that_is_only_fatter_has_no_handle() -> None:
    assert with_handles(VESSEL, hull_of()) is None


def test_rays_through_the_handle_are_left_out() -> None:
    bar = block((0.036, 0, 0.05), (0.011, 0.006, 0.006), np.eye(3))
    rays = rays_near(sightings_of(either(cylinder(0.03, 0, 0.09), bar), views=6), 1)
    hull = hull_of(moved(rounded_box((0.022, 0.012, 0.012), bevel=0.001), (0.036, 0, 0.05)))
    kept = without_handles(rays, VESSEL, hull)
    body = cylinder(0.03, 0, 0.09)(kept.origins, kept.directions)
    assert len(kept.hits) < len(rays.hits)
    assert (body == kept.hits).mean() > 0.99
    assert (cylinder(0.03, 0, 0.09)(rays.origins, rays.directions) == rays.hits).mean() < 0.99
