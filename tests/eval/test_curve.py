"""Tests what training saw of test pixels, and the extrapolation curve."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
from support.checked import unchecked
from support.reference import nearest_training_angles
from support.synthetic import pixel_rays

from datagen.data.config import TEST_SPLITS
from datagen.data.dataset import Dataset
from datagen.data.images import png_bytes
from datagen.data.layers import Layers
from eval.analyses.coverage import cover_view, read_coverage, visible_layers
from eval.analyses.curve import ANGLE_EDGES, Bin, curve_of, pool_seeds, slope_db_per_10deg
from eval.page.report import make_report


def test_angles_and_views_equal_a_loop_over_all_training_rays(dataset: Dataset) -> None:
    def centre_ids_uv(split, view):
        layers = dataset.view(split, view).layers()
        return dataset.cameras(split).world_from_camera[view, :3, 3], layers.object_id, layers.uv / 65535

    train = [centre_ids_uv("train", view) for view in range(8)]
    coverage = read_coverage(dataset)
    unseen = 0
    for split in TEST_SPLITS:
        layers = dataset.view(split, 1).layers()
        origin, directions = pixel_rays(dataset.cameras(split), 1)
        points = origin + layers.depth[..., None] * directions
        expected = nearest_training_angles(train, centre_ids_uv(split, 1), points, [False, True, False], coverage.grid)
        found = cover_view(coverage, dataset, split, 1)
        assert list(zip(*np.divmod(found.pixel, 16), strict=True)) == list(expected)
        angles, views = np.array(list(expected.values())).T
        assert found.angle_deg == pytest.approx(np.degrees(angles), abs=1e-3)
        assert np.array_equal(found.views, views)
        assert np.array_equal(np.isinf(angles), views == 0)
        unseen += np.isinf(angles).sum()
    assert 0 < unseen < 100  # Both kinds are there.


def test_a_training_view_has_no_angle_to_training(dataset: Dataset) -> None:
    found = cover_view(read_coverage(dataset), dataset, "train", 3)
    assert len(found.pixel) > 50
    assert found.angle_deg.max() < 1e-3
    assert found.views.min() >= 1


def test_of_many_pixels_a_random_choice_is_looked_at(dataset: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    coverage = read_coverage(dataset)
    whole = cover_view(coverage, dataset, "interpolating", 0)
    monkeypatch.setattr("eval.analyses.coverage.MAX_PIXELS", 20)
    monkeypatch.setattr("eval.analyses.coverage.CHUNK", 7)
    part = cover_view(coverage, dataset, "interpolating", 0)
    assert len(part.pixel) == 20
    place = np.searchsorted(whole.pixel, part.pixel)
    assert np.array_equal(whole.angle_deg[place], part.angle_deg)
    assert np.array_equal(whole.views[place], part.views)


def test_a_pixel_sees_up_to_its_first_opaque_layer() -> None:
    ids = np.array([[1, 2, 1, 0, 1], [1, 1, 2, 0, 0], [2, 2, 1, 0, 0]], np.uint8)[:, None]
    layers = Layers(uv=np.zeros((*ids.shape, 2), np.uint16), object_id=ids, depth=np.zeros(ids.shape, np.float32))
    seen = visible_layers(layers, np.array([False, True, False]))
    assert seen[:, 0].T.tolist() == [
        [True] * 3,
        [True, False, False],
        [True, True, False],
        [False] * 3,
        [True, False, False],
    ]


def test_the_slope_is_the_weighted_least_squares_line_of_numpy() -> None:
    rng = np.random.default_rng(0)
    angle = rng.gamma(2, 6, 20_000)
    error = 255**2 * 10 ** (-(36 - 0.31 * angle) / 10) * rng.exponential(1, 20_000)
    curve = curve_of(angle, np.full(20_000, 3), error)
    bins = [part for part in curve.by_angle if part.pixels >= 100]
    x, y, n = np.array([(part.mean, part.psnr_db, part.pixels) for part in bins]).T
    assert curve.db_per_10deg == pytest.approx(10 * np.polyfit(x, y, 1, w=np.sqrt(n))[0])
    assert curve.db_per_10deg == pytest.approx(-3.1, abs=0.1)
    assert sum(part.pixels for part in curve.by_angle) == 20_000
    inside = (angle >= 4) & (angle < 6)
    (part,) = [part for part in curve.by_angle if part.low == 4]
    assert (part.high, part.pixels) == (6, inside.sum())
    assert (part.mean, part.mse) == pytest.approx((angle[inside].mean(), error[inside].mean()))
    assert [(part.low, part.high) for part in curve.by_views] == [(3, 5)]


def test_pixels_that_training_never_saw_are_kept_apart() -> None:
    angle = np.array([1.0, math.inf, 179.9, math.inf, 180.0])
    curve = curve_of(angle, np.array([4, 0, 4, 0, 4]), np.array([1.0, 2, 3, 4, 5]))
    assert curve.unseen is not None
    assert (curve.unseen.pixels, curve.unseen.mse) == (2, 3.0)
    assert [(part.low, part.pixels, part.mse) for part in curve.by_angle] == [(0, 1, 1.0), (ANGLE_EDGES[-2], 2, 4.0)]
    assert curve.db_per_10deg is None  # Too few pixels for a line.


def test_one_full_bin_has_no_slope() -> None:
    assert slope_db_per_10deg((Bin(low=0, high=2, mean=1, pixels=1000, mse=4),)) is None


def test_seeds_of_the_same_pixels_share_a_curve_of_mean_errors(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    angle, views = np.append(rng.uniform(0, 40, 4000), math.inf), np.full(4001, 5)
    errors = [rng.exponential(scale, 4001) for scale in (4, 9)]
    curves = {f"seed{seed}": curve_of(angle, views, error) for seed, error in enumerate(errors)}
    curves["other"] = curve_of(angle[:3000], views[:3000], errors[0][:3000])
    # Here the runs say themselves which belong together.
    monkeypatch.setattr(
        "eval.analyses.curve.by_group", lambda runs, found: {name: [found[run] for run in runs[name]] for name in runs}
    )
    with unchecked():
        pooled = pool_seeds({"both": ("seed0", "seed1")}, curves)  # pyright: ignore[reportArgumentType]
    expected = curve_of(angle, views, np.mean(errors, axis=0))
    assert list(pooled) == ["both"]
    for found, wanted in zip(pooled["both"].by_angle, expected.by_angle, strict=True):
        assert found.mse == pytest.approx(wanted.mse) and (found.pixels, found.mean) == (wanted.pixels, wanted.mean)
    assert pooled["both"].db_per_10deg == pytest.approx(expected.db_per_10deg)
    assert pooled["both"].unseen is not None and expected.unseen is not None
    assert pooled["both"].unseen.mse == pytest.approx(expected.unseen.mse)
    # Runs that predicted other pixels cannot be averaged bin by bin.
    with unchecked():
        apart = pool_seeds({"all": ("seed0", "other")}, curves)  # pyright: ignore[reportArgumentType]
    assert apart == {"seed0": curves["seed0"], "other": curves["other"]}


def test_the_report_has_a_curve_for_each_run(
    dataset: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Noise that grows with the angle gives the slope that it was made with."""
    coverage = read_coverage(dataset)
    for split in TEST_SPLITS:
        for view in range(2):
            covered = cover_view(coverage, dataset, split, view)
            image = dataset.view(split, view).image.astype(np.float64).reshape(-1, 3)
            angle = np.full(len(image), 0.0)
            angle[covered.pixel] = np.minimum(covered.angle_deg, 60)
            error = 255 * 10 ** (-(30 - 0.4 * angle) / 20)
            image += np.where(image < 128, 1, -1) * error[:, None]
            path = tmp_path / f"runs/synthetic/steep/predictions/{split}/{view:04d}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(png_bytes(np.rint(image).clip(0, 255).astype(np.uint8).reshape(16, 16, 3)))
    make_report(tmp_path / "runs", dataset.root.parent, tmp_path / "out", output_format="markdown", is_full=True)
    curve = json.loads((tmp_path / "out/results.json").read_text())["scenes"][0]["analyses"]["curves"]["steep"]
    assert curve["db_per_10deg"] == pytest.approx(-4, abs=0.8)
    assert curve["unseen"]["pixels"] + sum(part["pixels"] for part in curve["by_angle"]) > 200
    assert f"| steep | {curve['db_per_10deg']:.2f} |" in capsys.readouterr().out
    assert (tmp_path / "out/curve_synthetic.svg").is_file()
