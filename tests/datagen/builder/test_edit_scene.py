"""Tests edits of scenes: what they change and what they leave, what is refused, and their datasets on disk."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from support.synthetic import quad, synthetic_scene

from datagen.builder.build import build_dataset, peel_dataset
from datagen.builder.variants import build_variant, find_edit_mask, plan_edit, shows_objects
from datagen.data.config import SPLITS, DatasetConfig, square
from datagen.data.dataset import Dataset
from datagen.data.geometries import ProxyStatistics, read_meshes, write_proxies
from datagen.data.meshes import Mesh, is_there
from datagen.data.paths import TRUTH
from datagen.data.variants import ELSEWHERE, LIGHT, OBJECT, TWINS, read_edit_mask
from datagen.disk.errors import HyalineError
from datagen.disk.storage import sha256
from datagen.machine.mitsuba_variant import use_mitsuba
from datagen.scene.description import Scene, SceneObject
from datagen.scene.edits import edit_scene, edits_name, moved_mesh, parse_edit
from datagen.scene.materials import Dielectric, Diffuse, SolidTexture
from datagen.scene.modelling import ball, cylinder, moved
from datagen.scene.soundness import TOLERANCE, touching_share
from datagen.scene.textures import evaluate_texture

use_mitsuba()

STRIPES = SolidTexture(pattern="stripes", colors=((0.8, 0.7, 0.6), (0.1, 0.1, 0.3)), scale=0.15, axis="x")


def edited(scene: Scene, *texts: str) -> Scene:
    return edit_scene(scene, tuple(map(parse_edit, texts))).scene


def with_uv(mesh: Mesh) -> Mesh:
    """Any uv: nothing here reads texels of it."""
    return dataclasses.replace(mesh, uv=np.full((len(mesh.vertices), 2), 0.5, np.float32))


def table(*, gap: float = 0.001) -> Scene:
    """A striped floor, a ball of glass and a striped post, a millimetre above it."""
    sphere, post = moved(ball(0.3, subdivisions=2), (0.5, 0, 0.3 + gap)), moved(cylinder(0.2, 0.5), (-0.5, 0, gap))
    objects = (
        SceneObject(name="floor", mesh=quad(0.0), material=Diffuse(color=STRIPES)),
        SceneObject(name="ball", mesh=with_uv(sphere), material=Dielectric()),
        SceneObject(name="post", mesh=with_uv(post), material=Diffuse(color=STRIPES)),
    )
    return dataclasses.replace(synthetic_scene(), objects=objects)


# The scene


def test_twins_have_no_glass_or_opaque_glass_and_else_the_same_objects() -> None:
    before = table()
    gone, painted = (edit_scene(before, (parse_edit(twin),)) for twin in TWINS)
    for twin in (gone, painted):
        glass = [item.name for item in before.objects if item.material.is_glass]
        assert twin.changed(before) == tuple(glass) == ("ball",)
        assert not any(item.material.is_glass for item in twin.scene.objects if is_there(item.mesh))
    assert [is_there(item.mesh) for item in gone.scene.objects] == [True, False, True]
    assert all(a.mesh is b.mesh for a, b in zip(painted.scene.objects, before.objects, strict=True))
    assert edits_name((parse_edit("no-glass"),)) == "no-glass"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("delete:ball", r"edit 'delete:ball': unknown verb 'delete'; expected remove:OBJECT, move:OBJECT:dx,dy,dz"),
        ("remove:", r"expected remove:OBJECT"),
        ("swap:ball", r"has 1 parts after the verb; expected swap:OBJECT:OBJECT"),
        ("move:ball:1,2,nan", r"moves by '1,2,nan'"),
        ("remove:bal", r"edit 'remove:bal': no object 'bal'; did you mean 'ball'\?"),
        ("glass:floor", r"edit 'glass:floor': .* object floor: 4 open edges; glass must be a closed mesh"),
        ("no-glass:ball", "has 1 parts after the verb; expected no-glass"),
        ("duplicate:ball:0,0,0", r"objects ball and ball_copy1 share 320 faces"),
    ],
)
def test_an_impossible_edit_gets_one_line_that_names_it(text: str, message: str) -> None:
    with pytest.raises(HyalineError, match=message):
        edited(table(), text)


def test_a_moved_object_takes_its_carved_pattern_along() -> None:
    after = edited(table(), "move:post:0.1,0.2,0.3", "move:post:0.03,0,0").objects[2]
    assert isinstance(after.material, Diffuse)
    assert isinstance(after.material.color, SolidTexture)
    before = table().objects[2].mesh.vertices
    np.testing.assert_allclose(after.mesh.vertices, before + np.float32([0.13, 0.2, 0.3]), atol=1e-6)
    colors = evaluate_texture(after.material.color, after.mesh.vertices)
    np.testing.assert_allclose(colors, evaluate_texture(STRIPES, before), atol=1e-4)
    # It would not be so had the pattern stayed in space.
    assert np.abs(evaluate_texture(STRIPES, after.mesh.vertices) - colors).max() > 0.3


# Contact


@pytest.mark.parametrize(
    ("offset", "share"),
    [
        ((0, 0, 0.5 * TOLERANCE), 1),
        ((0, 0, -0.5 * TOLERANCE), 1),
        ((0, 0, 2 * TOLERANCE), 0),
        ((2, 0, 0), 0),  # An edge in common.
        ((1.5, -1.5, 0), 1 / 16),
    ],
)
def test_faces_in_one_plane_touch_where_they_overlap(offset: tuple[float, float, float], share: float) -> None:
    found = touching_share(moved_mesh(quad(0.0), offset), quad(0.0))
    assert found == pytest.approx(share, abs=0.03 * (0 < share < 1))


def test_an_edit_mask_finds_the_light_that_an_edit_moves_and_no_noise() -> None:
    rng = np.random.default_rng(0)
    size = 48
    shown = np.zeros((size, size), bool)
    shown[4:12, 4:12] = True
    light = np.zeros((size, size, 3))
    light[24:36, 20:40] = -0.03
    before = 0.5 + rng.normal(scale=0.02, size=(2, size, size, 3))
    shared = before + light + 0.3 * shown[..., None]
    apart = 0.5 + light + 0.3 * shown[..., None] + rng.normal(scale=0.02, size=before.shape)
    for after in (shared, apart):
        found = find_edit_mask(shown, before, after)
        assert np.array_equal(found == OBJECT, shown)
        # Sure two pixels inside the shadow, and of all that lies more than two pixels outside of it.
        assert (found[26:34, 22:38] == LIGHT).all()
        far = np.ones((size, size), bool)
        far[22:38, 18:42] = False
        assert (found[far & ~shown] == LIGHT).mean() < 0.02
    assert (find_edit_mask(shown, before, shared)[far & ~shown] == ELSEWHERE).all()


# On disk


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    root, config = tmp_path_factory.mktemp("edit") / "table", DatasetConfig.even("table", square(24), 2, spp=32)
    dataset = build_dataset(table(), root, config, num_layers=4, workers=1, overwrite=False)
    numbers = ProxyStatistics(volume_ratio=1.0, mean_distance=0.0, max_distance=0.0)
    proxies = tuple(moved_mesh(mesh, (0, 0, 0.05)) for mesh in read_meshes(dataset, TRUTH))
    write_proxies(dataset, "box", proxies, (numbers,) * len(proxies))
    peel_dataset(dataset, "box", num_layers=4, overwrite=False)
    return dataset


def build(base: Dataset, *texts: str) -> Dataset:
    return build_variant(base, plan_edit(base, tuple(map(parse_edit, texts))), workers=1, overwrite=False)


@pytest.fixture(scope="module")
def after(base: Dataset) -> Dataset:
    kept = hashes(base.root)
    after = build(base, "remove:ball", "duplicate:post:0.1,0.6,0")
    assert kept == {path: found for path, found in hashes(base.root).items() if path in kept}
    return after


def hashes(root: Path) -> dict[str, tuple[str, int]]:
    files = (path for path in root.rglob("*") if path.is_file())
    return {str(path): (sha256(path.read_bytes()), path.stat().st_mtime_ns) for path in files}


def test_an_edited_dataset_has_the_truth_at_the_same_cameras(base: Dataset, after: Dataset) -> None:
    assert after.root == base.root / "variants" / "remove-ball+duplicate-post-0.1,0.6,0"
    assert after.variant is not None and after.edit is not None
    assert (after.variant.of, after.edit.changed) == (base.seal, ("ball", "post_copy1"))
    assert [item.name for item in after.objects] == ["floor", "ball", "post", "post_copy1"]
    assert [is_there(mesh) for mesh in read_meshes(after, TRUTH)] == [True, False, True, True]
    for split in SPLITS[1:]:
        np.testing.assert_array_equal(after.cameras(split).world_from_camera, base.cameras(split).world_from_camera)
        ids = np.concatenate([after.view(split, view).layers().object_id for view in range(2)])
        assert 2 not in ids
        assert {1, 3, 4} <= set(np.unique(ids))
        for view in range(2):
            before, now = (dataset.view(split, view).image.astype(int) for dataset in (base, after))
            mask = read_edit_mask(after, split, view)
            assert np.array_equal(mask == OBJECT, shows_objects(base, after, split, view))
            # The same random numbers: where no light changed, not even the noise did.
            assert np.abs(now - before)[mask == OBJECT].mean() > 5
            assert np.abs(now - before)[mask == ELSEWHERE].mean() < 2
    assert after.splits == SPLITS[1:]


def test_proxies_are_edited_as_their_objects_are(base: Dataset, after: Dataset) -> None:
    floor, gone, post, copy = read_meshes(after, "box")
    before = read_meshes(base, "box")
    assert not is_there(gone)
    np.testing.assert_array_equal(floor.vertices, before[0].vertices)
    np.testing.assert_array_equal(post.vertices, before[2].vertices)
    np.testing.assert_allclose(copy.vertices, before[2].vertices + np.float32([0.1, 0.6, 0]), atol=1e-6)
    assert {0, 1, 3, 4} == set(np.unique(after.view("interpolating", 0).layers("box").object_id))
    with pytest.raises(HyalineError, match="is a variant; name the dataset around it"):
        build(after, "remove:post")
