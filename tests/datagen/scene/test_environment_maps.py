"""Tests maps of the environment: their files, which way they lie, and what light paths and the truth see of them."""

import dataclasses
import io
import math
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
import trimesh
from support.meshes import mesh_of
from support.scenes import camera_at
from support.synthetic import synthetic_scene

from benchmarks.sky import radiance_of_map, radiance_of_sky
from datagen.disk.errors import HyalineError
from datagen.machine.mitsuba_variant import use_mitsuba
from datagen.scene.description import MAX_SHARPNESS, EnvironmentMap, Lobe, Scene, SceneObject, SoftEnvironment
from datagen.scene.folder import load_scene, save_scene, scene_files
from datagen.scene.images import read_map
from datagen.scene.materials import Dielectric
from datagen.trace.surface_tables import Limits

use_mitsuba()

from datagen.render.mitsuba_scene import load_scene_mitsuba, painted  # noqa: E402
from datagen.render.truth import Renderer  # noqa: E402

HEIGHT, WIDTH = 16, 32


def exr_bytes(radiance: np.ndarray, *, kind: type = np.float32, compression: int = OpenEXR.ZIP_COMPRESSION) -> bytes:
    channels = {name: np.ascontiguousarray(radiance[..., c], kind) for c, name in enumerate("RGB")}
    buffer = io.BytesIO()
    OpenEXR.File({"compression": compression, "type": OpenEXR.scanlineimage}, channels).write(buffer)
    return buffer.getvalue()


def hdr_bytes(radiance: np.ndarray, *, is_compressed: bool) -> bytes:
    """By the definition: a shared exponent so that the largest of three mantissas is 128 to 255."""
    _, exponent = np.frexp(radiance.max(axis=-1))
    mantissas = radiance / np.exp2(exponent - 8.0)[..., None]
    pixels = np.concatenate([mantissas, (exponent + 128)[..., None]], axis=-1).astype(np.uint8)
    height, width = radiance.shape[:2]
    head = f"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y {height} +X {width}\n".encode()
    if not is_compressed:
        return head + pixels.tobytes()
    lines = []
    for row in pixels:
        lines.append(bytes([2, 2, width >> 8, width & 255]))
        for channel in row.T:
            # The first half as a literal, the second as runs of one.
            half = width // 2
            lines.append(bytes([half]) + channel[:half].tobytes())
            lines += [bytes([129, value]) for value in channel[half:].tolist()]
    return head + b"".join(lines)


def spotted(row: int, column: int) -> np.ndarray:
    """Dim, but for one bright texel."""
    radiance = np.full((HEIGHT, WIDTH, 3), 0.01, np.float32)
    radiance[row, column] = (4, 2, 1)
    return radiance


def scene_under(folder: Path, radiance: np.ndarray, **settings: float) -> Scene:
    """Two glass balls under a map."""
    folder.mkdir(exist_ok=True)
    (folder / "sky.exr").write_bytes(exr_bytes(radiance))
    places = ((0, 0, 0), (-0.5, 0.1, 0))
    balls = [mesh_of(trimesh.creation.icosphere(3, 0.2).apply_translation(place)) for place in places]
    return dataclasses.replace(
        synthetic_scene(),
        objects=tuple(SceneObject(name=f"ball{i}", mesh=ball, material=Dielectric()) for i, ball in enumerate(balls)),
        environment=EnvironmentMap(path="sky.exr", **settings),
        folder=folder,
    )


@pytest.mark.parametrize(
    ("row", "column", "rotation_deg", "expected"),
    [
        (8, 16, 0.0, (1, 0, 0)),
        (8, 24, 0.0, (0, -1, 0)),
        (8, 8, 0.0, (0, 1, 0)),
        (8, 0, 0.0, (-1, 0, 0)),
        (1, 16, 0.0, (0.2, 0, 1)),
        (14, 16, 0.0, (0.2, 0, -1)),
        (8, 16, 90.0, (0, 1, 0)),
        (8, 16, -45.0, (1, -1, 0)),
    ],
)
def test_a_bright_texel_shines_from_where_the_convention_says_in_mitsuba_and_by_formula(
    tmp_path: Path, row: int, column: int, rotation_deg: float, expected: tuple[float, float, float]
) -> None:
    import mitsuba as mi

    scene = scene_under(tmp_path, spotted(row, column), rotation_deg=rotation_deg)
    grid = np.random.default_rng(0).normal(size=(40000, 3))
    directions = grid / np.linalg.norm(grid, axis=1, keepdims=True)
    by_formula = radiance_of_sky(scene, directions)
    si = mi.SurfaceInteraction3f()
    environment = load_scene_mitsuba(scene).environment()
    si.wi = mi.Vector3f(*(-directions.T).astype(np.float32))
    found = np.array(environment.eval(si)).T
    for radiance in (found, by_formula):
        lit = directions[radiance[:, 0] > 2]
        middle = lit.mean(axis=0) / np.linalg.norm(lit.mean(axis=0))
        # Half a texel, 6 degrees, and at the poles as much again: Mitsuba's rows reach from pole to pole.
        assert math.degrees(math.acos(middle @ expected / np.linalg.norm(expected))) < 13


@pytest.mark.parametrize("compression", [OpenEXR.NO_COMPRESSION, OpenEXR.ZIP_COMPRESSION, OpenEXR.PIZ_COMPRESSION])
def test_an_exr_of_halves_or_floats_is_read_as_it_was_written(compression: int) -> None:
    radiance = np.random.default_rng(0).random((HEIGHT, WIDTH, 3)).astype(np.float16).astype(np.float32)
    for kind in (np.float16, np.float32):
        data = exr_bytes(radiance, kind=kind, compression=compression)
        assert np.array_equal(read_map(data, where="sky.exr"), radiance)


@pytest.mark.parametrize("is_compressed", [True, False])
def test_a_radiance_picture_is_read_to_its_8_bits_as_mitsuba_reads_it(tmp_path: Path, is_compressed: bool) -> None:
    import mitsuba as mi

    radiance = np.exp(np.random.default_rng(0).normal(size=(HEIGHT, WIDTH, 3)) * 3).astype(np.float32)
    path = tmp_path / "sky.hdr"
    path.write_bytes(hdr_bytes(radiance, is_compressed=is_compressed))
    found = read_map(path.read_bytes(), where="sky.hdr")
    assert np.array_equal(found, np.array(mi.Bitmap(str(path)), np.float32))
    assert (np.abs(found - radiance).max(axis=-1) <= radiance.max(axis=-1) / 127).all()


def test_a_broken_map_is_refused_in_one_line() -> None:
    data = exr_bytes(spotted(3, 3))
    for broken in (data[: len(data) // 2], b"PK" + data, data[:8]):
        with pytest.raises(HyalineError, match=r"damaged|cannot be read"):
            read_map(broken, where="sky.exr")
    for broken in (hdr_bytes(spotted(3, 3), is_compressed=True)[:-3], b"#?RADIANCE\n\n-Y 16 +X 99999999\n", b"#?\n"):
        with pytest.raises(HyalineError, match=r"sky\.hdr: .*(damaged|expected|not a Radiance)"):
            read_map(broken, where="sky.hdr")
    negative = spotted(3, 3)
    negative[2, 5, 1] = -1
    with pytest.raises(HyalineError, match=r"sky\.exr: pixel \(column 5, row 2\) is .*; expected finite radiance"):
        read_map(exr_bytes(negative), where="sky.exr")


def test_a_scene_under_a_map_is_written_with_it_and_read_again(tmp_path: Path) -> None:
    settled = scene_under(tmp_path / "a", spotted(5, 6), scale=2.0, rotation_deg=30.0)
    scene = dataclasses.replace(settled, objects=synthetic_scene().objects)
    save_scene(scene, tmp_path / "b")
    again = load_scene(tmp_path / "b")
    assert again.environment == scene.environment
    assert scene_files(again) == scene_files(scene)
    (tmp_path / "b" / "sky.exr").unlink()
    with pytest.raises(HyalineError, match=r"sky\.exr: the file is missing"):
        load_scene(tmp_path / "b")
    with pytest.raises(HyalineError, match=r"environment path: is 'sky\.png'; expected an \.exr or \.hdr file"):
        EnvironmentMap(path="sky.png")


def test_truth_and_light_paths_see_one_map_through_glass(tmp_path: Path) -> None:
    from datagen.trace.light_path import LightPathTracer

    rng = np.random.default_rng(1)
    # Smooth enough that half a texel at the poles matters little.
    coarse = rng.random((4, 8, 3)).astype(np.float32)
    ways = np.stack(np.meshgrid(*[np.linspace(-1, 1, 64)] * 2), axis=-1)
    polar, azimuth = (ways[..., 1] + 1) * math.pi / 2, -ways[..., 0] * math.pi
    directions = np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], axis=-1)
    radiance = radiance_of_map(coarse, directions, 0.0).astype(np.float32)
    scene = scene_under(tmp_path, radiance, scale=1.5, rotation_deg=70.0)
    cameras = camera_at((1.0, 0.5, 0.3), fov_x=0.5, size=16)
    truth = Renderer(scene, max_depth=16).radiance(cameras, 0, spp=1024, seed=0)
    tracer = LightPathTracer(tuple(item.mesh for item in scene.objects), tuple(item.material for item in scene.objects))
    origin, directions = dataclasses.replace(cameras, width=96, height=96)[0].rays()
    rays = directions.reshape(-1, 3)
    paths = tracer.trace(np.tile(origin, (len(rays), 1)), rays, Limits(8, max_vertices=1))
    light = paths.end_throughput * radiance_of_sky(scene, paths.end_direction.astype(np.float64))
    seen = light.sum(axis=0).reshape(16, 6, 16, 6, 3).mean(axis=(1, 3))
    assert np.abs(seen - truth).mean() < 0.02 * truth.mean()


@pytest.mark.parametrize("sharpness", [8.0, 300.0, 3000.0, pytest.param(MAX_SHARPNESS, marks=pytest.mark.full)])
def test_a_lobe_as_small_as_the_sun_shines_as_much_as_its_formula_says(sharpness: float) -> None:
    lobe = Lobe(direction=(1, -1, 0.7), radiance=(3, 2, 1), sharpness=sharpness)
    radiance = painted(SoftEnvironment(zenith=(0, 0, 0), horizon=(0, 0, 0), ground=(0, 0, 0), lobes=(lobe,)))
    height, width = radiance.shape[:2]
    rows = np.cos(np.linspace(0, np.pi, height + 1))
    areas = (rows[:-1] - rows[1:]) * 2 * np.pi / width
    found = (radiance[..., 0].astype(np.float64) * areas[:, None]).sum()
    assert found == pytest.approx(3 * 2 * np.pi / sharpness * (1 - np.exp(-2 * sharpness)), rel=0.02)
    assert (height, width) == ((256, 512) if sharpness < 2000 else (512, 1024) if sharpness < 9000 else (2048, 4096))
