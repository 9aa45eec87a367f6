"""Tests of the presets of `paper`: what they configure, which flags override them, and how runs of them are called."""

import dataclasses
import json
from pathlib import Path

import pytest
import torch
from support.synthetic import write_synthetic_dataset

from datagen.data.dataset import Dataset
from datagen.data.paths import TRUTH
from datagen.disk.errors import HyalineError
from datagen.disk.records import to_json
from eval.papers import comparisons
from model import cli
from model.batches.rays import load_pixels
from model.losses.pixel_losses import LossConfig
from model.methods.paper import PaperConfig, PaperRenderer, build_paper, configure_paper
from model.nets.texture import TexturePyramid
from model.run.run_folder import is_finished, read_run
from model.settings.choices import CommonChoices, PaperChoices, folder_name
from model.settings.paper_presets import DEFAULT_STEPS, PAPER_PRESETS


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return write_synthetic_dataset(tmp_path_factory.mktemp("presets") / "data" / "synthetic")


def test_the_published_preset_is_the_paper_and_the_default(dataset: Dataset) -> None:
    common = CommonChoices(method="paper", dataset=str(dataset.root))
    config, _ = cli.configure(common, PaperChoices())
    assert config.net == PaperConfig(width=dataclasses.asdict(config.net)["width"], texture_size=16)
    assert (config.batch, config.lr, config.texture_lr, config.lr_decay) == (8192, 0.001, None, "linear")
    assert config == cli.configure(common, PaperChoices(preset="published"))[0]


@pytest.mark.parametrize("method", ["paper", "mlp-first"])
def test_the_best_preset_sets_network_textures_rays_and_rates(dataset: Dataset, method: str) -> None:
    common = CommonChoices(method=method, dataset=str(dataset.root))
    config, _ = cli.configure(common, PaperChoices(preset="best"))
    preset, net = PAPER_PRESETS["best"], config.net
    assert isinstance(net, PaperConfig) and (net.width, net.norm) == (int(preset.width), preset.norm)
    assert (net.texture_levels, net.finer_counts) == (preset.texture_levels, preset.finer_counts)
    assert (net.train_samples, net.render_samples) == (preset.rays, preset.render_rays)
    assert (config.batch, config.lr, config.texture_lr, config.lr_decay) == (
        preset.batch, preset.lr, preset.texture_lr, preset.lr_decay,
    )  # fmt: skip
    assert config.loss == LossConfig(softness=preset.softness)
    # As many rays as the published form trains on.
    published = PAPER_PRESETS["published"]
    assert config.steps == preset.steps
    assert preset.steps * preset.batch * preset.rays == published.steps * published.batch * published.rays
    assert net.texture_size == int(32 * preset.texels_per_pixel)


def test_flags_override_the_best_preset(dataset: Dataset) -> None:
    choices = PaperChoices(preset="best", width="64", norm="batch", texture_size=24, texture_levels=2, rays=1)
    common = CommonChoices(
        method="paper", dataset=str(dataset.root), lr=0.5, texture_lr=0.25, batch=64, lr_decay="none",
        steps=DEFAULT_STEPS,
    )  # fmt: skip
    config, _ = cli.configure(common, choices)
    net = config.net
    assert isinstance(net, PaperConfig)
    assert (net.width, net.norm, net.texture_size, net.texture_levels) == (64, "batch", 24, 2)
    assert (net.train_samples, net.render_samples) == (1, PAPER_PRESETS["best"].render_rays)
    assert (config.lr, config.texture_lr, config.batch, config.lr_decay) == (0.5, 0.25, 64, "none")
    assert folder_name(common, choices) == (
        "paper-best-w64-batch-norm-t24-1-rays-2-levels-batch64-lr0.5-texture-lr0.25-no-decay-2500-steps"
    )


def test_tables_look_for_what_the_best_preset_configures(dataset: Dataset) -> None:
    config, _ = cli.configure(CommonChoices(method="paper", dataset=str(dataset.root)), PaperChoices(preset="best"))
    known = dataclasses.asdict(config.net) | dataclasses.asdict(config.loss)
    assert {key: known[key] for key in comparisons.PAPER_BEST} == comparisons.PAPER_BEST


def test_finer_levels_count_less(dataset: Dataset) -> None:
    config = PaperConfig(width=16, texture_size=16, extrinsics="none", texture_levels=3, finer_counts=0.5)
    renderer = build_paper(config, dataset, TRUTH, 4)
    assert isinstance(renderer.textures, TexturePyramid)
    with torch.no_grad():
        for table in renderer.textures.tables():
            table.fill_(1.0)
    rays = load_pixels(dataset, TRUTH, "train", [0]).take(torch.arange(1024), None)
    features = renderer.textures(rays.uv, rays.object_id)
    assert torch.equal(features, 1.75 * (rays.object_id != 0)[..., None].float().expand_as(features))


@pytest.mark.parametrize("share", [0.0, 1.5])
def test_finer_levels_cannot_count_more_than_coarser_ones_or_nothing(share: float) -> None:
    with pytest.raises(HyalineError, match=f"finer_counts: is {share}; expected more than 0, at most 1"):
        PaperConfig(width=16, texture_size=16, finer_counts=share)


def test_a_run_of_the_best_preset_is_called_so_and_records_every_choice(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    flags = "--method paper --preset best --steps 3 --batch 64 --device cpu"
    monkeypatch.setattr("sys.argv", ["model", "train", "--dataset", str(dataset.root), *flags.split()])
    cli.main()
    (out,) = (tmp_path / "runs" / "synthetic").iterdir()
    assert out.name == "paper-best-batch64-3-steps" and is_finished(out)
    record = read_run(out)
    assert record.label == out.name
    assert record.config.net == configure_paper(PaperChoices(preset="best"), dataset, TRUTH, 4)
    assert json.loads((out / "run.json").read_text())["config"] == to_json(record.config)
    renderer = build_paper(record.config.net, dataset, TRUTH, 4)  # pyright: ignore[reportArgumentType]
    assert isinstance(renderer, PaperRenderer)
    assert record.num_parameters == sum(value.numel() for value in renderer.net.parameters())


def test_help_tells_the_values_of_the_best_preset(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["model", "train", "--method", "paper", "--help"])
    with pytest.raises(SystemExit):
        cli.main()
    told = " ".join(capsys.readouterr().out.replace("│", " ").split())
    best = PAPER_PRESETS["best"]
    for words in (
        f"{best.steps} with paper's best preset", f"{best.batch} for paper's best preset",
        f"{best.lr} for paper's best preset", f"{best.texture_lr} for paper's best preset",
        f"{best.width} of the best preset", f"{best.norm} with the best preset", f"{best.rays} with the best preset",
        f"{best.render_rays} with the best preset", f"{best.texture_levels} with the best preset",
    ):  # fmt: skip
        assert words in told, words
