"""Tests the method `light-path`: its rays, its physics, its training."""

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from support.synthetic import write_synthetic_dataset
from support.training import assert_resumes, load

from datagen.data.cameras import subpixel_offsets
from datagen.data.dataset import Dataset
from datagen.data.geometries import ProxyStatistics, read_meshes, write_proxies
from datagen.data.images import srgb_from_linear
from datagen.data.paths import TRUTH
from datagen.disk.errors import HyalineError, NumericsError
from datagen.machine.mitsuba_variant import short_lived_workers, use_mitsuba
from model.batches.rays import linear_curve, made_ahead, srgb_curve
from model.methods.light_path.config import LightPathConfig
from model.methods.light_path.net import RELIEF_DEPTH, LightPathRenderer, is_doubtful
from model.methods.light_path.pixels import STACKED_VERTICES, LightPathPixels, nest_shells, trace_light_paths
from model.methods.light_path.sizes import COUNTED_PIXELS, measure_sizes, texels_across
from model.methods.paper.config import PaperConfig
from model.methods.paper.renderer import PaperRenderer
from model.methods.renderer import difference
from model.nets.learned_sky import LearnedSky
from model.run.predict import load_renderer, predict_colors
from model.run.run_folder import TrainConfig, read_run
from model.run.train import train

use_mitsuba()

CPU = torch.device("cpu")
NET = LightPathConfig(
    texture_sizes=(24, 24), hidden=32, stack_hidden=16, environment_size=8, sky_lobes=5, branches=4, render_samples=4
)
SMALL = TrainConfig(
    method="light-path",
    geometry="truth",
    net=NET,
    steps=12,
    batch=128,
    lr=0.005,
    texture_lr=0.02,
    lr_decay="cosine",
    updates=2,
    evaluate_every=6,
    checkpoint_every=5,
)


def pixels_of(dataset: Dataset, **config: float) -> LightPathPixels:
    return load(LightPathConfig(texture_sizes=(8, 8), **config), dataset, [2, 5])


def test_no_worker_of_drjit_spins_beside_torch_after_a_batch_is_traced(dataset: Dataset) -> None:
    import drjit as dr

    pixels = pixels_of(dataset, straight_layers=2)
    for rng in (None, np.random.default_rng(0)):
        pixels.take(torch.arange(64), rng)
        assert dr.thread_count() == 1
    with pytest.raises(KeyError, match="stopped"), short_lived_workers():
        assert dr.thread_count() > 1
        raise KeyError("stopped")
    assert dr.thread_count() == 1


def white(renderer: LightPathRenderer) -> LightPathRenderer:
    """Everything shines with radiance 1: each texel and the environment."""
    last = renderer.decoder[-1]
    assert isinstance(last, torch.nn.Linear)
    with torch.no_grad():
        last.weight.zero_()
        last.bias.fill_(math.log(math.expm1(1)))
        renderer.environment.maps[-1].fill_(math.log(math.expm1(1)))
        if renderer.environment.lobes is not None:
            renderer.environment.lobes.brightness.fill_(-100)
    return renderer


def test_one_ray_a_pixel_goes_through_its_centre_and_meets_the_straight_layers(dataset: Dataset) -> None:
    pixels = pixels_of(dataset, render_samples=1)
    paths = pixels.take(torch.arange(len(pixels.rgb)), None)
    for place, view in enumerate((2, 5)):
        layers = dataset.view("train", view).layers()
        here = slice(place * 1024, (place + 1) * 1024)
        assert np.array_equal(paths.stack.surface[here, :4].numpy().T.reshape(4, 32, 32), layers.object_id)
        uv = paths.stack.uv[here, :4].numpy().transpose(1, 0, 2).reshape(4, 32, 32, 2)
        assert np.abs(uv - layers.uv / 65535).max() < 1e-4


def training_places(dataset: Dataset, **config: object) -> np.ndarray:
    """Where (down, right) in their pixel the four training rays of one pixel lie, 500 times."""
    pixels = pixels_of(dataset, train_samples=4, **config)  # pyright: ignore[reportArgumentType]
    index = torch.full((500,), 1024 + 17 * 32 + 5)
    paths = pixels.take(index, np.random.default_rng(0))
    again = pixels.take(index, np.random.default_rng(0))
    assert torch.equal(paths.ends.uv, again.ends.uv)
    camera = dataset.cameras("train")
    d = paths.stack.direction.numpy().astype(np.float64) @ camera.world_from_camera[5][:3, :3]
    focal = 16 / math.tan(camera.fov_x / 2)
    column, row = 16 - d[:, 0] / d[:, 2] * focal, 16 + d[:, 1] / d[:, 2] * focal
    place = np.stack([row - 17, column - 5], axis=-1)
    assert place.min() > -1e-3
    assert place.max() < 1 + 1e-3
    return place.reshape(500, 4, 2)


def test_training_rays_fill_their_pixels_one_in_each_cell(dataset: Dataset) -> None:
    cells = np.floor(np.clip(training_places(dataset, debias=0.0), 0, 0.999) * 2).astype(int)
    assert (np.sort(cells[..., 0] * 2 + cells[..., 1], axis=1) == np.arange(4)).mean() > 0.99


def test_paired_training_rays_lie_opposite_each_other_and_pairs_are_independent(dataset: Dataset) -> None:
    place = training_places(dataset, debias=0.5).reshape(500, 2, 2, 2)
    np.testing.assert_allclose(place.sum(axis=2), 1, atol=1e-3)
    first, second = place[:, :, 0].transpose(1, 2, 0)
    assert np.abs(np.corrcoef(np.concatenate([first, second]))[:2, 2:]).max() < 0.15
    assert np.abs(np.histogram(first, bins=5, range=(0, 1))[0] / 1000 - 0.2).max() < 0.05


def test_batches_made_ahead_are_those_of_their_step_and_errors_of_the_other_thread_arrive(
    dataset: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    pixels = pixels_of(dataset)

    def draw(step: int) -> list[np.random.Generator]:
        return [np.random.default_rng([step, update]) for update in range(2)]

    steps = range(3, 6)
    for step, traced in zip(steps, made_ahead(pixels, draw, steps, size=40), strict=True):
        expected_rngs = draw(step)
        indices = [torch.from_numpy(rng.integers(len(pixels.rgb), size=40)) for rng in expected_rngs]
        expected = pixels.take_all(list(zip(indices, expected_rngs)))
        for index, expected_rng, batch, rng in zip(indices, expected_rngs, expected, draw(step)):
            assert np.array_equal(rng.integers(len(pixels.rgb), size=40), index)
            found = traced.take(index, rng)
            assert rng.random() == expected_rng.random()
            for part in ("ends", "sky", "stack"):
                for name, values in vars(getattr(batch, part)).items():
                    assert values is None or torch.equal(getattr(getattr(found, part), name), values), name

    def fail(*_: object, **__: object) -> None:
        raise NumericsError("no paths today")

    monkeypatch.setattr(pixels.tracer, "trace_ends", fail)
    with pytest.raises(NumericsError, match="no paths today"):
        next(made_ahead(pixels, draw, range(9), size=40))


@pytest.mark.parametrize("paired", [True, False])
def test_rays_of_a_pixel_meet_facets_in_pairs_or_spread_evenly(dataset: Dataset, *, paired: bool) -> None:
    pixels = pixels_of(dataset, debias=float(paired))
    points = pixels._facets(500, 4, np.random.default_rng(2)).reshape(500, 4, 2)
    if paired:
        first, second = points.reshape(500, 2, 2, 2)[:, :, 0].transpose(1, 2, 0)
        assert np.abs(np.corrcoef(np.concatenate([first, second]))[:2, 2:]).max() < 0.15
    else:  # Spread evenly: no two of a pixel lie near each other.
        apart = np.abs(points[:, :, None] - points[:, None]) % 1
        apart = np.linalg.norm(np.minimum(apart, 1 - apart), axis=-1)[:, ~np.eye(4, dtype=bool)]
        assert apart.min() > 0.25


def test_where_everything_shines_alike_glass_disappears(dataset: Dataset) -> None:
    pixels = pixels_of(dataset)
    renderer = white(LightPathRenderer(LightPathConfig(texture_sizes=(8, 8), stack_hidden=0)))
    with torch.no_grad():
        colors = renderer(pixels.take(torch.arange(len(pixels.rgb)), None))
    assert (colors - 1).abs().max() < 1e-3


@pytest.mark.parametrize("sees_directions", [True, False])
def test_texels_shine_alike_in_all_directions_unless_the_decoder_sees_them(
    dataset: Dataset, *, sees_directions: bool
) -> None:
    paths = pixels_of(dataset, directions=True).take(torch.arange(256), None)
    assert paths.ends.reflected is not None
    turned = dataclasses.replace(paths, ends=dataclasses.replace(paths.ends, reflected=paths.ends.reflected.roll(1, 1)))
    renderer = LightPathRenderer(LightPathConfig(texture_sizes=(8, 8), directions=sees_directions))
    with torch.no_grad():
        assert torch.equal(renderer(paths), renderer(turned)) != sees_directions


def test_the_learned_sky_is_continuous_all_around() -> None:
    renderer = LightPathRenderer(LightPathConfig(texture_sizes=(8,), sky_lobes=0))
    height = renderer.environment.maps[0].shape[1]
    polar = (torch.arange(height) + 0.5) / height * math.pi
    azimuth = ((torch.arange(2 * height) + 0.5) / height - 1) * math.pi
    sin, cos = torch.sin(polar)[:, None], torch.cos(polar)[:, None]
    directions = torch.stack([sin * torch.cos(azimuth), sin * torch.sin(azimuth), cos.expand(-1, 2 * height)])
    with torch.no_grad():
        finest_counts = 0.5 ** (len(renderer.environment.maps) - 1)
        renderer.environment.maps[0].copy_(torch.log(torch.expm1(1 + 0.5 * directions)) / finest_counts)
        asked = torch.nn.functional.normalize(torch.randn(4000, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
        error = (renderer.environment(asked) - (1 + 0.5 * asked)).abs()
    assert error[asked[..., 2].abs() < 0.95].max() < 3e-3
    assert error.max() < 0.03  # Half a texel around the poles is flat.


def test_skies_of_runs_from_before_there_were_lobes_load_and_shine_as_they_did() -> None:
    names = [str(level) for level in range(5)]
    sky = LearnedSky(8, 0, 0.5)
    assert list(sky.state_dict()) == names
    sky.load_state_dict({name: torch.full_like(sky.get_parameter(name), 0.5) for name in names})
    total = 0.5 * sum(0.5**level for level in range(5))
    shine = sky(torch.eye(3))
    torch.testing.assert_close(shine, torch.full((3, 3), math.log1p(math.exp(total))))


@pytest.mark.parametrize(("lobes", "most"), [(0, 0.2), (12, 0.6)])
def test_the_sky_where_no_ray_has_been_is_filled_in_from_around(lobes: int, most: float) -> None:
    renderer = LightPathRenderer(LightPathConfig(texture_sizes=(8,), sky_lobes=lobes))
    directions = torch.nn.functional.normalize(torch.randn(2000, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    seen = directions[:, 0] > 0.2
    color = torch.tensor([2.0, 0.3, 0.05])
    optimizer = torch.optim.Adam(renderer.environment.parameters(), lr=0.02)
    for _ in range(300):
        optimizer.zero_grad()
        (renderer.environment(directions[seen]) - color).abs().mean().backward()
        optimizer.step()
    with torch.no_grad():
        behind = renderer.environment(directions[directions[:, 0] < -0.5])
    assert (renderer.environment(directions[seen]) / color - 1).abs().max() < 0.05
    assert (behind - color).abs().max() < most  # One map alone would say 0.69 there: 1.3 off.


def test_the_finest_map_of_the_sky_learns_although_its_gradients_are_small() -> None:
    renderer = LightPathRenderer(LightPathConfig(texture_sizes=(8,), sky_lobes=0, environment_size=64))
    directions = torch.nn.functional.normalize(
        torch.randn(20_000, 3, generator=torch.Generator().manual_seed(0)), dim=-1
    )
    stripes = (1 + 0.5 * torch.sign(torch.sin(20 * directions[:, 2:]))).expand(-1, 3)
    sky = {id(value) for value in renderer.environment.parameters()}
    groups = [group for group in renderer.groups(LightPathConfig().optimisation()) if id(group.parameters[0]) in sky]
    optimizer = torch.optim.Adam([{"params": part.parameters, "lr": part.lr, "eps": part.eps} for part in groups])
    for _ in range(200):
        optimizer.zero_grad()
        (renderer.environment(directions) - stripes).square().mean().backward()
        optimizer.step()
    with torch.no_grad():
        error = (renderer.environment(directions) - stripes).square().mean()
    assert error < 0.12  # The variance of the stripes is 0.25; with one epsilon for all maps 0.19 stays.


def test_textures_and_sky_are_as_fine_as_the_pixels_that_see_them(tmp_path: Path) -> None:
    dataset = write_synthetic_dataset(tmp_path / "data" / "synthetic", resolution=16)
    pixels = trace_light_paths(LightPathConfig().usual(TRUTH).sized((2, 2)), dataset, TRUTH, dataset.cameras("train"))
    tele = dataclasses.replace(pixels.cameras, fov_x=pixels.cameras.fov_x / 2)
    floors = []
    for cameras in (pixels.cameras, tele):
        (_, floor), rows = measure_sizes(dataclasses.replace(pixels, cameras=cameras), 8)
        floors.append(floor)
        # The sky is seen directly. Pixels are an angle of 1 / focal wide in the middle, and less in a corner.
        corner = math.cos(math.atan(8 * math.sqrt(2) / cameras.focal)) ** 1.5
        least = math.pi * cameras.focal
        assert min(128, least) <= rows <= min(128, 2 * least / corner)
    assert floors[1] / floors[0] == pytest.approx(tele.focal / pixels.cameras.focal, rel=0.25)


def test_the_branch_with_most_light_decides_what_a_pixel_sees_of_an_object() -> None:
    # Every pixel's corners end on object 1 twice: a strong branch on a square of 0.1, and a faint one on one of 0.01.
    rays = COUNTED_PIXELS * 3
    corners = torch.tensor([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.1, 0.0]]).repeat(COUNTED_PIXELS, 1)
    place = torch.cat([0.1 * corners, corners])
    throughput = torch.cat([torch.full((rays, 3), 0.04), torch.full((rays, 3), 0.9)])
    ray = torch.arange(rays).repeat(2)
    across = texels_across(ray, torch.ones_like(ray), place, throughput, 3)
    assert across.tolist() == pytest.approx([0, 10, 0], rel=1e-5)


@pytest.mark.parametrize("lobes", [0, 12])
def test_a_sky_starts_from_what_was_seen_and_fills_in_the_rest(lobes: int) -> None:
    generator = torch.Generator().manual_seed(0)
    asked = torch.nn.functional.normalize(torch.randn(200_000, 3, generator=generator), dim=-1)
    seen = asked[asked[:, 0] > -0.5]

    def pattern(direction: torch.Tensor) -> torch.Tensor:
        stripes = torch.sin(12 * torch.atan2(direction[:, 1], direction[:, 0]))
        return torch.stack([0.5 + 0.3 * stripes, 0.5 - 0.3 * stripes, 0.2 + 0.1 * direction[:, 2]], dim=-1)

    sky = LearnedSky(64, lobes, 0.7)
    sky.start_from(seen, pattern(seen))
    with torch.no_grad():
        # Noise of about 25 rays in each texel, and texels of 2.8 degrees across stripes of 15.
        assert (sky(seen) - pattern(seen)).abs().mean() < 0.02
        behind = sky(asked[asked[:, 0] < -0.8])
    assert (behind.mean(dim=0) - torch.tensor([0.5, 0.5, 0.2])).abs().max() < 0.1


def test_the_sky_learns_a_lamp_brighter_than_white_from_its_reflections_alone() -> None:
    # Pixel 0 looks at the lamp, and is clipped; pixel 1 sees it mirrored by glass of which 4 % reflect.
    lamp, share = 4.0, 0.04
    shares = torch.tensor([1.0, share])
    truth = (srgb_curve(lamp * shares).clamp_max(1) * 255).round()[:, None].expand(2, 3) / 255
    sky = LearnedSky(8, 4, 0.7)
    towards = torch.tensor([[0.6, 0.0, 0.8]] * 2)
    optimizer = torch.optim.Adam(sky.parameters(), lr=LightPathConfig().sky_lr)
    for _ in range(300):
        optimizer.zero_grad()
        difference(srgb_curve(sky(towards) * shares[:, None]), truth).abs().mean().backward()
        optimizer.step()
    with torch.no_grad():
        assert (sky(towards) / lamp - 1).abs().max() < 0.05


@pytest.mark.parametrize(("rate", "updates"), [(0.3, 1), (1e-3, 4)])
def test_the_sky_learns_at_a_rate_of_its_own_with_each_update(
    dataset: Dataset, tmp_path: Path, rate: float, updates: int
) -> None:
    config = dataclasses.replace(
        SMALL, steps=3, updates=updates, lr_decay="none", net=dataclasses.replace(NET, sky_lr=rate)
    )
    train(config, dataset, tmp_path / "run", label="a", device=CPU)
    learned = load_renderer(tmp_path / "run", config, dataset).environment.maps
    # Adam's first steps are as long as its rate.
    assert max(texels.abs().max().item() for texels in learned) == pytest.approx(3 * updates * rate, rel=0.1)


def test_pixels_whose_rays_differ_are_drawn_with_more_rays_and_the_others_are_not(dataset: Dataset) -> None:
    torch.manual_seed(0)
    renderer = LightPathRenderer(LightPathConfig(texture_sizes=(24, 24))).eval()
    with torch.no_grad():
        renderer.environment.maps[0].normal_(std=400.0)  # A sky of much detail.
    once, refined = (pixels_of(dataset, render_samples=4, refined_samples=samples) for samples in (4, 64))
    few, many = (predict_colors(renderer, pixels) for pixels in (once, refined))
    with torch.inference_mode():
        every = torch.arange(len(few))
        rays, finer, finest = (renderer.radiance(once.with_rays(samples).take(every, None)) for samples in (4, 64, 256))
        doubtful, still = is_doubtful(rays), is_doubtful(finer)
        mean = (4 * rays.mean(dim=1) + 64 * finer.mean(dim=1)) / 68
        mean[still] = torch.lerp(mean, finest.mean(dim=1), 256 / 324)[still]
        mean = srgb_curve(mean)
    assert 0.02 < doubtful.float().mean() < 0.98
    assert 0.02 < still[doubtful].float().mean() < 0.98
    assert torch.equal(many[~doubtful], few[~doubtful])
    # Which facet of rough metal a ray meets depends on its place in the bundle, so only most colours are the same.
    assert (many - mean)[doubtful].abs().mean() < 0.25 * (few - mean)[doubtful].abs().mean()
    assert torch.equal(predict_colors(renderer, refined), many)


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [(0.5, 0.5, False), (0.5, 0.52, False), (0.2, 0.8, True), (0.9, 9.0, False), (0.2, 1.6, True), (0.5, 1.6, True)],
)
def test_a_pixel_is_doubtful_where_its_rays_differ_but_not_beyond_white(
    low: float, high: float, expected: bool
) -> None:
    radiance = torch.tensor([low, high] * 8)[None, :, None].expand(1, 16, 3)
    assert bool(is_doubtful(radiance)) is expected


def test_a_pixel_whose_radiance_changes_linearly_is_not_doubtful() -> None:
    down, right = torch.from_numpy(subpixel_offsets(16)).float().unbind(dim=1)
    plane = (0.2 + 0.3 * down + 0.4 * right)[None, :, None].expand(1, 16, 3)
    assert not bool(is_doubtful(plane))
    edge = (0.2 + 0.4 * (down + right > 1))[None, :, None].expand(1, 16, 3)
    assert bool(is_doubtful(edge))


def test_the_curve_is_the_datasets_own_and_rises_on_above_one() -> None:
    linear = torch.linspace(0, 1, 1001)
    assert np.abs(srgb_curve(linear).numpy() - srgb_from_linear(linear.numpy())).max() < 1e-5
    above = torch.tensor([1.5, 3.0], requires_grad=True)
    srgb_curve(above).sum().backward()
    assert above.grad is not None
    assert (above.grad > 0).all()


def test_training_learns_the_synthetic_scene_and_resumes_to_the_bit(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = dataclasses.replace(SMALL, net=dataclasses.replace(NET, texture_sizes=(80, 80)))  # Moved lazily.
    assert_resumes(monkeypatch, config, dataset, tmp_path, stop=8)
    assert read_run(tmp_path / "whole").knowledge == "true geometry, materials (all but diffuse colours)"


def test_straight_layers_stand_beside_the_paths_on_proxies(dataset: Dataset) -> None:
    config = dataclasses.replace(LightPathConfig().usual("box").sized((32, 32)), shells=1, straight_layers=8)
    pixels = load(dataclasses.replace(config, render_samples=1), dataset, [2])
    stack = pixels.take(torch.arange(1024), None).stack
    layers = dataset.view("train", 2).layers()
    assert np.array_equal(stack.surface[:, -8:-4].numpy().T.reshape(4, 32, 32), layers.object_id)
    assert (stack.throughput[:, -8:][stack.surface[:, -8:] > 0] == 1).all()
    renderer = LightPathRenderer(config)
    assert renderer(pixels.take(torch.arange(64), None)).shape == (64, 3)


def sizes_on(dataset: Dataset, geometry: str) -> tuple[tuple[int, ...], int]:
    config = LightPathConfig().usual(geometry).sized((2, 2))
    return measure_sizes(trace_light_paths(config, dataset, geometry, dataset.cameras("train")), 24)


def test_texels_are_shared_among_objects_whatever_their_shells(tmp_path: Path) -> None:
    dataset = write_synthetic_dataset(tmp_path / "data" / "synthetic", resolution=16)
    statistics = (ProxyStatistics(volume_ratio=1, mean_distance=0, max_distance=0),) * 2
    write_proxies(dataset, "box", read_meshes(dataset, TRUTH), statistics)
    (pane, floor), _ = sizes_on(dataset, "box")
    # As these proxies are the truth, about as much is met of them; but no path ends on a pane of glass.
    assert sizes_on(dataset, TRUTH)[0][0] == 3
    assert 8 <= pane < floor
    config = LightPathConfig().usual("box").sized((pane, floor))
    pixels = load(config, dataset, [2], "box")
    colors = LightPathRenderer(config)(pixels.take(torch.arange(256), None))
    assert colors.shape == (256, 3)
    assert torch.isfinite(colors).all()


def test_surfaces_are_loaded_once_as_long_as_meshes_and_shells_stay(tmp_path: Path) -> None:
    dataset = write_synthetic_dataset(tmp_path / "data" / "synthetic", resolution=16)
    truth = read_meshes(dataset, TRUTH)
    statistics = (ProxyStatistics(volume_ratio=1, mean_distance=0, max_distance=0),) * 2

    def tracer(geometry: str, shells: int) -> object:
        config = LightPathConfig(texture_sizes=(8, 8), render_samples=1, shells=shells, straight_layers=2)
        return load(config, dataset, [1], geometry).tracer

    first = tracer(TRUTH, 1)
    assert tracer(TRUTH, 1) is first and tracer(TRUTH, 2) is not first
    write_proxies(dataset, "box", truth, statistics)
    of_boxes = tracer("box", 2)
    assert tracer("box", 2) is of_boxes
    higher = dataclasses.replace(truth[1], vertices=truth[1].vertices + np.float32(0.01))
    write_proxies(dataset, "box", (truth[0], higher), statistics)
    assert tracer("box", 2) is not of_boxes


def test_shells_lie_one_inside_the_other_with_textures_of_their_own(dataset: Dataset) -> None:
    config = LightPathConfig(texture_sizes=(8, 8), render_samples=1, shells=3, straight_layers=6)
    truth = read_meshes(dataset, TRUTH)
    nested = nest_shells(truth, 3)
    for copy, mesh in enumerate(nested):
        outer = truth[copy // 3].vertices.astype(np.float64)
        center = (outer.min(axis=0) + outer.max(axis=0)) / 2
        assert np.allclose(mesh.vertices, center + (1 - copy % 3 / 3) * (outer - center), atol=1e-6)
    batch = load(config, dataset, [2]).take(torch.arange(1024), None)
    assert batch.stack is not None
    met = batch.stack.surface[:, sum(STACKED_VERTICES) :]
    assert set(met.flatten().tolist()) == {0, 1, 2, 3, 4, 5, 6}
    renderer = LightPathRenderer(config)
    # The second copy of the second object is surface 5: its texels alone change under it.
    before = renderer.textures(batch.stack.uv, batch.stack.surface)
    with torch.no_grad():
        renderer.textures[0].table[4 * 64 : 5 * 64] += 1
    changed = (renderer.textures(batch.stack.uv, batch.stack.surface) != before).any(dim=-1)
    assert torch.equal(changed, batch.stack.surface == 5)
    with pytest.raises(HyalineError, match="shells: is 128 for 2 objects"):
        LightPathConfig(texture_sizes=(8, 8), shells=128)


def test_a_relief_shifts_look_ups_by_its_depth_and_learns(dataset: Dataset) -> None:
    config = dataclasses.replace(LightPathConfig().usual("box").sized((32, 32)), shells=1, straight_layers=8)
    assert config.relief
    batch = load(config, dataset, [2]).take(torch.arange(64), None)
    assert batch.stack is not None and batch.stack.uv_slope is not None
    torch.manual_seed(0)
    renderer = LightPathRenderer(config)
    assert renderer.relief is not None
    with torch.no_grad():
        renderer.textures[0].table.normal_()
        flat = renderer(batch)
        renderer.relief.table.fill_(2.0)
        deep = renderer(batch)
        # The same as textures looked up at shifted uv, without a relief.
        shift = 2.0 * RELIEF_DEPTH
        straight = sum(STACKED_VERTICES)
        uv = batch.stack.uv.clone()
        uv[:, straight:] = (uv[:, straight:] + shift * batch.stack.uv_slope).clamp(0, 1)
        ends = dataclasses.replace(batch.ends, uv=(batch.ends.uv + shift * batch.ends.uv_slope).clamp(0, 1))
        moved = dataclasses.replace(batch, ends=ends, stack=dataclasses.replace(batch.stack, uv=uv))
        renderer.relief.table.zero_()
        expected = renderer(moved)
    assert not torch.allclose(deep, flat, atol=1e-3)
    torch.testing.assert_close(deep, expected, atol=1e-4, rtol=1e-3)
    renderer(batch).sum().backward()
    assert renderer.relief.table.grad is not None and renderer.relief.table.grad.any()


def test_training_ends_with_filling_in_what_hardly_any_ray_met(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    filled: list[torch.Tensor] = []
    monkeypatch.setattr("model.methods.light_path.net.fill_in", lambda _, met: filled.append(met))
    for name, net in (("plain", dataclasses.replace(NET, fill_in=False)), ("filled", NET)):
        train(dataclasses.replace(SMALL, net=net, steps=8), dataset, tmp_path / name, label=name, device=CPU)
    (met,) = filled
    # 8 steps of 128 pixels, of which glass, which absorbs and reflects, and the sky take their parts.
    assert 0.3 * 8 * 128 < float(met.sum()) < 2 * 8 * 128
    assert bool((met == 0).any())


def test_the_papers_renderer_takes_several_rays_a_pixel(dataset: Dataset) -> None:
    one = PaperConfig(width=16, texture_size=16, extrinsics="none", norm="none")
    many = dataclasses.replace(one, train_samples=4, render_samples=9)
    stored = load(one, dataset, [2])
    traced = load(many, dataset, [2])
    assert torch.equal(stored.rgb, traced.rgb)
    index = torch.arange(1024)
    batch = traced.take(index, None)
    assert batch.samples == 9
    center = stored.take(index, None)
    # The middle one of nine goes through the pixel's centre.
    assert torch.equal(batch.object_id.view(1024, 9, -1)[:, 4], center.object_id)
    assert (batch.uv.view(1024, 9, -1, 2)[:, 4] - center.uv).abs().max() < 1e-4
    assert torch.equal(batch.p_camera[::9], center.p_camera)
    torch.manual_seed(0)
    renderer = PaperRenderer(many, num_layers=4, num_objects=2, positions=None)
    whole, middle = renderer(batch), renderer(dataclasses.replace(batch, samples=1))
    assert torch.allclose(whole, srgb_curve(linear_curve(middle).view(1024, 9, 3).mean(dim=1)))
