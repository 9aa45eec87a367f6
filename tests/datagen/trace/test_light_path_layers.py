"""Tests stored light paths: what is read back is what was traced, within the stated errors, and damage is found."""

import dataclasses
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from support.builds import tree
from support.meshes import box
from support.synthetic import synthetic_scene, write_synthetic_dataset

from datagen.build.build import build_dataset, peel_dataset, summary
from datagen.build.verify import verify_dataset
from datagen.data.config import DatasetConfig, SplitConfig
from datagen.data.dataset import Dataset, open_dataset
from datagen.data.geometries import ProxyStatistics, read_meshes, write_proxies
from datagen.data.meshes import Mesh
from datagen.data.number_formats import decode_directions, encode_directions
from datagen.data.paths import TRUTH, layers_root
from datagen.disk.errors import HyalineError
from datagen.machine.mitsuba_variant import use_mitsuba
from datagen.scene.description import Scene, SceneObject
from datagen.scene.folder import load_scene
from datagen.scene.materials import Dielectric
from datagen.trace.light_path import LightPaths, LightPathTracer
from datagen.trace.light_path_layers import NUM_BRANCHES, create_light_paths, read_light_paths, write_light_paths

SIZE, VERTICES = 8, 5
BRANCH_FIELDS = ("has_left", "end_direction", "end_throughput")

needs_tracer = pytest.mark.skipif(
    use_mitsuba(quiet=True).startswith("scalar"), reason="light paths need a vectorised variant of Mitsuba"
)


def glass_scene() -> Scene:
    """A solid, absorbing block of glass instead of the pane."""
    scene = synthetic_scene()
    block = box((0.8, 0.8, 0.4))
    raised = Mesh(
        vertices=block.vertices + np.float32([0, 0, 0.5]), faces=block.faces, normals=block.normals, uv=block.uv
    )
    glass = SceneObject(name="block", mesh=raised, material=Dielectric(ior=1.5, absorption=(1, 2, 3)))
    return dataclasses.replace(scene, objects=(glass, scene.objects[1]))


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A rendered dataset with light paths of 4 rays a pixel, and no straight layers."""
    root = tmp_path_factory.mktemp("paths") / "data"
    few = SplitConfig(views=2, spp=2)
    config = DatasetConfig(scene="s", preset="tiny", resolution=SIZE, train=few, interpolating=few, extrapolating=few)
    build_dataset(glass_scene(), root, config, kinds=("light-path",), num_layers=VERTICES, workers=1, overwrite=False)
    return root


@pytest.fixture
def copy(built: Path, tmp_path: Path) -> Dataset:
    shutil.copytree(built, tmp_path / "data")
    return open_dataset(tmp_path / "data")


def peel(dataset: Dataset, *, rays: int = 4, vertices: int = VERTICES, overwrite: bool = False) -> None:
    peel_dataset(dataset, TRUTH, kinds=("light-path",), num_layers=vertices, rays=rays, overwrite=overwrite)


def assert_close(stored: LightPaths, paths: LightPaths) -> None:
    """Equal within what the format's documentation promises, and exactly 0 where there is nothing."""
    assert np.array_equal(stored.object_id, paths.object_id)
    assert np.array_equal(stored.has_left, paths.has_left)
    for field in dataclasses.fields(LightPaths):
        got, expected = getattr(stored, field.name), getattr(paths, field.name)
        assert (got.dtype, got.shape) == (expected.dtype, expected.shape)
        filled = paths.has_left if field.name in BRANCH_FIELDS else paths.object_id > 0
        assert not got[~filled].any()
        got, expected = got[filled].astype(np.float64), expected[filled].astype(np.float64)
        match field.name:
            case "uv":
                assert np.abs(got - expected).max() < 7.7e-6
            case "direction" | "normal" | "end_direction":
                assert np.linalg.norm(got - expected, axis=-1).max() < 6.5e-5
                assert np.abs(np.linalg.norm(got, axis=-1) - 1).max() < 1e-6
            case "position" | "medium_length":
                assert (np.abs(got - expected) <= 7.7e-6 * np.abs(expected)).all()
            case "throughput" | "end_throughput":
                assert (np.abs(got - expected) <= np.maximum(4.9e-4 * expected, 3e-8)).all()


def random_paths(rng: np.random.Generator, branches: int, vertices: int, rays: int) -> LightPaths:
    """Paths of any length, with values as wide apart as they may be."""

    def directions(*shape: int) -> np.ndarray:
        d = rng.normal(size=(*shape, 3))
        return (d / np.linalg.norm(d, axis=-1, keepdims=True)).astype(np.float32)

    shape = (branches, vertices, rays)
    filled = np.arange(vertices)[:, None] < rng.integers(0, vertices + 1, size=(branches, 1, rays))
    left = rng.random((branches, rays)) < 0.5
    at_vertex, at_end = filled[..., None], left[..., None]
    return LightPaths(
        object_id=np.where(filled, rng.integers(1, 3, size=shape), 0).astype(np.uint8),
        uv=np.where(at_vertex, rng.random((*shape, 2)), 0).astype(np.float32),
        direction=directions(*shape) * at_vertex,
        position=np.where(at_vertex, rng.normal(size=(*shape, 3)) * 100, 0).astype(np.float32),
        normal=directions(*shape) * at_vertex,
        throughput=np.where(at_vertex, np.exp(rng.uniform(-30, 0, size=(*shape, 3))), 0).astype(np.float32),
        medium_length=np.where(filled, np.exp(rng.uniform(-9, 2, size=shape)), 0).astype(np.float32),
        has_left=left,
        end_direction=directions(branches, rays) * at_end,
        end_throughput=np.where(at_end, np.exp(rng.uniform(-30, 0, size=(branches, rays, 3))), 0).astype(np.float32),
    )


def part(paths: LightPaths, rays: slice | np.ndarray) -> LightPaths:
    """Some of the rays."""

    def cut(name: str) -> np.ndarray:
        return getattr(paths, name)[np.s_[:, rays] if name in BRANCH_FIELDS else np.s_[:, :, rays]]

    return LightPaths(**{field.name: cut(field.name) for field in dataclasses.fields(LightPaths)})


@pytest.mark.parametrize(("branches", "samples"), [(1, 1), (2, 4), (5, 9)])
def test_any_paths_come_back_within_the_stated_errors(branches: int, samples: int, tmp_path: Path) -> None:
    dataset = write_synthetic_dataset(tmp_path, resolution=SIZE, train_views=2)
    create_light_paths(
        dataset, TRUTH, num_branches=branches, max_vertices=3, samples=samples, geometry_hash="synthetic"
    )
    rng = np.random.default_rng(0)
    views = [random_paths(rng, branches, 3, SIZE**2 * samples) for _ in range(2)]
    middle = 3 * SIZE * samples
    for view, paths in enumerate(views):
        blocks = [part(paths, slice(0, middle)), part(paths, slice(middle, None))]
        write_light_paths(dataset, TRUTH, "train", view, blocks)
    for view, paths in enumerate(views):
        assert_close(read_light_paths(dataset, TRUTH, "train", view), paths)


def test_directions_keep_their_angle_at_every_fold_of_the_octahedron() -> None:
    corners = np.array(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3)).reshape(3, -1).T
    corners = corners[np.abs(corners).sum(axis=1) > 0]
    nearby = corners[:, None] + np.random.default_rng(0).normal(size=(1, 2000, 3)) * [[[1e-3]]]
    d = np.concatenate([corners, nearby.reshape(-1, 3)])
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    decoded = decode_directions(encode_directions(d.astype(np.float32))).astype(np.float64)
    assert np.linalg.norm(decoded - d, axis=1).max() < 6.5e-5
    assert np.abs(decoded[:26] - d[:26]).max() < 6.5e-5


@needs_tracer
def test_stored_paths_are_a_fresh_trace_of_a_finer_pictures_pixel_centres(built: Path) -> None:
    dataset = open_dataset(built)
    materials = tuple(item.material for item in load_scene(built / "scene").objects)
    tracer = LightPathTracer(read_meshes(dataset, TRUTH), materials)
    for split, view in (("train", 0), ("train", 1), ("extrapolating", 1)):
        cameras = dataclasses.replace(dataset.cameras(split), width=2 * SIZE, height=2 * SIZE)
        origin, directions = cameras[view].rays()
        by_pixel = directions.reshape(SIZE, 2, SIZE, 2, 3).swapaxes(1, 2).reshape(-1, 3)
        paths = tracer.trace(np.broadcast_to(origin, by_pixel.shape), by_pixel, max_vertices=VERTICES)
        stored = read_light_paths(dataset, TRUTH, split, view)
        # The two ways to compute a ray differ in the last bit, which a path through glass makes larger.
        same = (stored.object_id == paths.object_id).all(axis=(0, 1))
        assert same.mean() > 0.98
        through_glass = (stored.object_id[0, :3] == [[1], [1], [2]]).all(axis=0)
        assert through_glass.any() or split != "train"
        for field in dataclasses.fields(LightPaths):
            got, expected = (getattr(part(paths, same), field.name) for paths in (stored, paths))
            assert np.abs(got.astype(np.float64) - expected).max() < 1e-3
    assert "rays with a branch given up after 24 surfaces train: 0.00 %" in summary(dataset, TRUTH, ("light-path",))


@needs_tracer
def test_the_share_of_paths_that_are_given_up_is_known(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    dataset = write_synthetic_dataset(tmp_path, resolution=SIZE, train_views=2)
    monkeypatch.setattr("datagen.trace.light_path_layers.MAX_DEPTH", 1)
    peel(dataset, rays=1)
    # One surface suffices for the floor and for what the pane mirrors, not for what is behind the pane.
    sees_pane = read_light_paths(dataset, TRUTH, "train", 0).object_id[0, 0] == 1
    assert 0 < sees_pane.mean() < 1
    assert dataset.layer_store(TRUTH, "light-path").record("train", 0).overflow_share == sees_pane.mean()


@needs_tracer
def test_blocks_do_not_change_a_byte(built: Path, copy: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("datagen.trace.light_path_layers.BLOCK_RAYS", 3 * SIZE * 4)
    peel(copy, overwrite=True)
    assert tree(copy.root) == tree(built)


@needs_tracer
def test_stopped_tracing_goes_on_to_the_same_bytes(built: Path, copy: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []

    def stop(*arguments: object) -> None:
        calls.append(arguments)
        if len(calls) == 3:
            raise KeyboardInterrupt
        write_light_paths(*arguments)  # type: ignore[arg-type]

    with monkeypatch.context() as patch:
        patch.setattr("datagen.build.jobs.write_light_paths", stop)
        with pytest.raises(KeyboardInterrupt):
            peel(copy, overwrite=True)
    views = [(split, view) for split in ("train", "interpolating", "extrapolating") for view in range(2)]
    assert sum(copy.layer_store(TRUTH, "light-path").is_peeled(split, view) for split, view in views) == 2  # type: ignore[arg-type]
    peel(copy)
    assert tree(copy.root) == tree(built)
    # A lost shard is made again, what is intact is left alone.
    shards = layers_root(copy.root, TRUTH, "light-path") / "peels.zarr" / "train" / "uv" / "c" / "1"
    next(path for path in shards.rglob("0") if path.is_file()).unlink()
    untouched = layers_root(copy.root, TRUTH, "light-path") / "records" / "train" / "0000.json"
    before = untouched.stat().st_mtime_ns
    peel(copy)
    assert untouched.stat().st_mtime_ns == before
    assert tree(copy.root) == tree(built)


@needs_tracer
def test_the_command_with_two_workers_writes_the_same_bytes(built: Path, copy: Dataset) -> None:
    shutil.rmtree(layers_root(copy.root, TRUTH, "light-path"))
    flags = ("--layers", "straight", "light-path", "--num-layers", str(VERTICES), "--workers", "2")
    command = [sys.executable, "-m", "datagen", "peel", "--dataset", str(copy.root), *flags]
    answer = subprocess.run(command, check=True, capture_output=True, text=True)
    assert "rays with more than 5 hits train" in answer.stderr
    assert "rays with a branch given up after 24 surfaces train" in answer.stderr
    assert verify_dataset(copy.root)[1] == []
    shutil.rmtree(layers_root(copy.root, TRUTH, "straight"))
    shutil.rmtree(copy.root / "heads" / "layers" / "straight")
    assert tree(copy.root) == tree(built)


@needs_tracer
def test_verify_and_the_reader_find_a_flipped_bit(copy: Dataset) -> None:
    assert verify_dataset(copy.root)[1] == []
    root = layers_root(copy.root, TRUTH, "light-path")
    store = root / "peels.zarr" / "train"
    shards = [next(path for path in folder.rglob("c/1/**/0") if path.is_file()) for folder in sorted(store.glob("*/"))]
    assert len(shards) == len(dataclasses.fields(LightPaths))
    rng = np.random.default_rng(0)
    for path in [*shards, store / "uv" / "zarr.json", root / "layers.json", root / "records" / "train" / "0001.json"]:
        good = path.read_bytes()
        bad = bytearray(good)
        bad[rng.integers(len(good))] ^= 1 << rng.integers(8)
        path.write_bytes(bad)
        assert any(str(path) in problem for problem in verify_dataset(copy.root)[1])
        with pytest.raises(HyalineError, match=path.name):
            read_light_paths(copy, TRUTH, "train", 1)
        path.write_bytes(good)
    (store / "notes.txt").write_text("mine")
    assert any("notes.txt" in remark for remark in verify_dataset(copy.root).remarks)


@needs_tracer
def test_other_settings_are_refused_with_the_way_out(
    built: Path, copy: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(HyalineError, match=r"traced with 4 rays a pixel, not 9; pass --overwrite, or --rays 4$"):
        peel(copy, rays=9)
    with pytest.raises(HyalineError, match=r"traced to 5 vertices, not 8; pass --overwrite, or --num-layers 5$"):
        peel(copy, vertices=8)
    with pytest.raises(HyalineError, match="rays: is 5; expected a square number of rays per pixel"):
        peel(copy, rays=5, overwrite=True)
    with (
        monkeypatch.context() as patch,
        pytest.raises(HyalineError, match="branches, which are now 7; pass --overwrite"),
    ):
        patch.setattr("datagen.build.build.NUM_BRANCHES", 7)
        peel(copy)
    with monkeypatch.context() as patch, pytest.raises(HyalineError, match="light paths: Mitsuba runs as scalar_rgb"):
        patch.setattr("datagen.machine.mitsuba_variant.use_mitsuba", lambda **_: "scalar_rgb")
        peel(copy, overwrite=True)
    assert tree(copy.root) == tree(built)
    peel(copy, rays=1, overwrite=True)
    assert read_light_paths(copy, TRUTH, "train", 0).object_id.shape == (NUM_BRANCHES, VERTICES, SIZE**2)


@needs_tracer
def test_a_proxys_paths_have_the_materials_of_the_objects(copy: Dataset) -> None:
    nothing = ProxyStatistics(volume_ratio=1, mean_distance=0, max_distance=0)
    write_proxies(copy, "box", read_meshes(copy, TRUTH), (nothing, nothing))
    peel_dataset(copy, "box", kinds=("light-path",), num_layers=VERTICES, overwrite=False)
    one, other = (read_light_paths(copy, geometry, "train", 0) for geometry in (TRUTH, "box"))
    for field in dataclasses.fields(LightPaths):
        assert np.array_equal(getattr(one, field.name), getattr(other, field.name))
    assert verify_dataset(copy.root)[1] == []


def test_paths_that_were_not_traced_name_the_command(tmp_path: Path) -> None:
    dataset = write_synthetic_dataset(tmp_path, resolution=SIZE, train_views=1)
    command = rf"make them with `datagen peel --dataset {tmp_path} --geometry truth --layers light-path`"
    with pytest.raises(HyalineError, match=command):
        read_light_paths(dataset, TRUTH, "train", 0)
    create_light_paths(dataset, TRUTH, num_branches=2, max_vertices=3, samples=1, geometry_hash="synthetic")
    with pytest.raises(HyalineError, match=r"not peeled yet; finish with .* light-path --num-layers 3 --rays 1`"):
        read_light_paths(dataset, TRUTH, "train", 0)
