"""Tests of the perceptual and the adversarial loss."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.signal import correlate2d
from support.synthetic import write_synthetic_dataset
from support.training import assert_resumes, build, load

from datagen.data.config import square
from datagen.data.dataset import Dataset
from datagen.data.paths import TRUTH
from datagen.disk.errors import HyalineError
from datagen.disk.storage import sha256
from model.batches.layers import load_pixels
from model.batches.rays import RayBatch
from model.methods.paper.config import DnrConfig, PaperConfig
from model.methods.patch_losses import (
    IMAGENET_MEAN,
    IMAGENET_STD,
    Adversary,
    PatchDiscriminator,
    PerceptualLoss,
    find_vgg,
    vgg_layers,
)
from model.methods.renderer import PatchTerms, Renderer, difference, pixel_loss
from model.run.run_folder import TrainConfig, check_trained_on, read_run
from model.run.train import check_losses
from model.settings import LossConfig

pytestmark = pytest.mark.usefixtures("one_thread")


CPU = torch.device("cpu")
NET = PaperConfig(width=16, texture_size=100, position_size=32)
SMALL = TrainConfig(method="paper", geometry=TRUTH, net=NET, steps=5, batch=128, evaluate_every=5, checkpoint_every=2)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return write_synthetic_dataset(tmp_path_factory.mktemp("losses") / "data" / "synthetic", train_views=5)


# The perceptual loss.


def test_it_compares_what_scipy_computes_after_the_last_activation_of_three_stages() -> None:
    loss = PerceptualLoss("random")
    assert [place for place, layer in enumerate(loss.features) if isinstance(layer, torch.nn.Conv2d)] == [
        0, 2, 5, 7, 10, 12, 14,
    ]  # As torchvision counts.  # fmt: skip
    picture = torch.rand(1, 3, 8, 8, generator=torch.Generator().manual_seed(1))
    x = (picture[0].double().numpy() - np.array(IMAGENET_MEAN)[:, None, None]) / np.array(IMAGENET_STD)[:, None, None]
    for place in (0, 2):
        layer = loss.features[place]  # pyright: ignore[reportIndexIssue]
        weight, bias = layer.weight.double().numpy(), layer.bias.double().numpy()
        x = np.stack(
            [sum(correlate2d(channel, kernel, "same") for channel, kernel in zip(x, kernels)) for kernels in weight]
        )
        x = np.maximum(x + bias[:, None, None], 0)
    found = loss.compare_layers(picture)
    np.testing.assert_allclose(found[0][0].numpy(), x, atol=1e-4)
    assert [layer.shape[1:] for layer in found] == [(64, 8, 8), (128, 4, 4), (256, 2, 2)]
    truth, noise = torch.rand(2, 2, 32, 32, 3, generator=torch.Generator().manual_seed(0))
    assert float(loss(truth, truth)) == 0 < float(loss(truth + 0.05 * noise, truth)) < float(loss(noise, truth))


def test_weights_come_from_a_file_and_only_the_features_are_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    place = tmp_path / "hub/checkpoints/vgg16-397923af.pth"
    with pytest.raises(HyalineError, match=r"hub/checkpoints/vgg16-397923af.pth: no VGG16 weights; fetch them with"):
        find_vgg(LossConfig(vgg_weights="imagenet"))
    trained = vgg_layers()
    state = {f"features.{name}": value for name, value in trained.state_dict().items()}
    place.parent.mkdir(parents=True)
    torch.save({**state, "classifier.0.weight": "whatever"}, place)
    with pytest.raises(HyalineError, match="damaged, its SHA-256 is"):
        find_vgg(LossConfig(vgg_weights="imagenet"))  # Not the file that the name promises.
    source = find_vgg(LossConfig(vgg_weights=str(place)))
    assert source.vgg_sha256 == sha256(place.read_bytes()) and source.describe() == "pre-trained VGG16"
    loss = PerceptualLoss(str(place))
    assert all(torch.equal(value, trained.state_dict()[name]) for name, value in loss.features.state_dict().items())
    torch.save({"features.0.weight": torch.zeros(3)}, tmp_path / "other")
    (tmp_path / "none").write_bytes(b"no weights")
    for name in ("other", "none"):
        with pytest.raises(HyalineError, match=f"{name}: not the weights of these layers"):
            PerceptualLoss(str(tmp_path / name))


def test_a_colour_beyond_white_costs_nothing_where_the_picture_clips() -> None:
    truth = torch.tensor([[1.0, 1.0, 1.0], [254 / 255, 0.5, 0.0]])
    colors = torch.tensor([[1.7, 1.0, 0.8], [1.7, 0.2, 0.3]], requires_grad=True)
    missed = difference(colors, truth)
    missed.abs().sum().backward()
    torch.testing.assert_close(missed, torch.tensor([[0.0, 0.0, 0.8 - 1.0], [1.7 - 254 / 255, 0.2 - 0.5, 0.3]]))
    assert colors.grad is not None
    assert colors.grad[0, 0] == 0 and colors.grad[0, 2] == -1
    assert torch.equal(colors.grad[1], torch.tensor([1.0, -1.0, 1.0]))


def test_patch_terms_see_whole_patches_and_the_rest_stays_the_mean(dataset: Dataset) -> None:
    torch.manual_seed(0)
    renderer = build(dataclasses.replace(NET, norm="none"), dataset)
    pixels = load_pixels(dataset, TRUTH, "train", range(5))
    seen = []

    def of(colors: torch.Tensor, truth: torch.Tensor) -> torch.Tensor:
        seen.append((colors, truth))
        return 3 * (colors - truth).abs().mean()

    loss = pixel_loss(renderer, pixels, 64, np.random.default_rng(1), patch_terms=PatchTerms(size=32, number=1, of=of))
    alone = pixel_loss(renderer, pixels, 64, np.random.default_rng(1))
    colors, truth = seen[0]
    # At 32 pixels a patch is a whole view.
    views = pixels.rgb.view(5, 32, 32, 3).float() / 255
    assert any(torch.equal(truth[0], view) for view in views)
    expected = alone + 3 * (colors - truth).abs().mean()
    assert loss.item() == pytest.approx(expected.item(), rel=1e-5)


# The adversarial loss.


def test_the_discriminator_has_the_known_size_and_sees_70_pixels() -> None:
    net = PatchDiscriminator()
    assert sum(parameter.numel() for parameter in net.parameters()) == 2_764_737
    small = PatchDiscriminator(width=4)
    for place, layer in enumerate(small):
        if isinstance(layer, torch.nn.InstanceNorm2d):
            small[place] = torch.nn.Identity()  # Its means look at everything.
    pictures = torch.rand(1, 128, 128, 3, requires_grad=True)
    logits = small.judge(pictures)
    assert logits.shape == (1, 1, 14, 14)
    logits[0, 0, 7, 7].backward()
    assert pictures.grad is not None
    rows, columns = pictures.grad[0].abs().sum(dim=-1).nonzero(as_tuple=True)
    assert (rows.max() - rows.min() + 1, columns.max() - columns.min() + 1) == (70, 70)


def test_the_adversary_learns_to_tell_and_its_judgement_pulls_fakes_towards_the_truth() -> None:
    adversary = Adversary(lr=0.004, seed=0, device=CPU, width=8)
    generator = torch.Generator().manual_seed(0)
    fake = torch.zeros(1, requires_grad=True)
    for _ in range(6):
        real = 0.8 + 0.05 * torch.randn(1, 32, 32, 3, generator=generator)
        loss = adversary.loss(fake + 0.3 + 0.01 * torch.randn(1, 32, 32, 3, generator=generator), real)
    loss.backward()
    assert loss.item() > 0.75  # More than log 2: it is no longer guessing.
    assert fake.grad is not None and fake.grad.abs() > 0
    assert all(
        parameter.grad is None or not parameter.requires_grad for parameter in adversary.discriminator.parameters()
    )
    other = Adversary(lr=0.004, seed=1, device=CPU, width=8)
    other.load_state(adversary.state())
    assert torch.equal(other.discriminator.judge(real), adversary.discriminator.judge(real))


@pytest.mark.parametrize("method", ["paper", "dnr"])
def test_a_run_with_all_losses_resumes_to_the_bit(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, method: str
) -> None:
    net = {
        "paper": NET,
        "dnr": DnrConfig(texture_size=16, position_size=32, unet_width=4, crop=32),
    }[method]
    terms = LossConfig(vgg_weights="random", adversarial=0.01, adversarial_from=0.3, patch=32)
    config = dataclasses.replace(SMALL, method=method, net=net, loss=terms)
    # The discriminator has learned since step 2; the newest checkpoint is of step 4.
    assert_resumes(monkeypatch, config, dataset, tmp_path, stop=4)
    record = read_run(tmp_path / "parts")
    assert record.knowledge == "true geometry, VGG16 of random weights (a stand-in)" and record.config == config
    with pytest.raises(HyalineError, match="another"):
        check_trained_on(tmp_path / "parts", dataclasses.replace(config, loss=LossConfig()), dataset)


@pytest.mark.parametrize(
    ("terms", "error"),
    [
        ({"perceptual": 0.1}, "perceptual: there is no network"),
        ({"patch": 16}, "patch: is 16; expected at least 32"),
        ({"patch": 32}, "patch: has no effect without"),
        ({"softness": -1}, "softness: is -1; expected at least 0"),
    ],
)
def test_impossible_losses_are_refused(terms: dict[str, Any], error: str) -> None:
    with pytest.raises(HyalineError, match=error):
        LossConfig(**terms)
    small = dataclasses.replace(SMALL, method="dnr", net=DnrConfig(crop=16), loss=LossConfig(adversarial=0.01))
    with pytest.raises(HyalineError, match="adversarial: patches are 16 pixels wide"):
        check_losses(small, square(32))
    for earlier in (LossConfig(inpaint=True), LossConfig(vgg="vgg19")):
        with pytest.raises(HyalineError, match="loss: is one of an earlier version"):
            check_losses(dataclasses.replace(SMALL, loss=earlier), square(32))


# The difference of each pixel


class OneColor(Renderer):
    """Draws every pixel in one colour, which no 8-bit picture has."""

    def __init__(self) -> None:
        super().__init__()
        self.color = torch.nn.Parameter(torch.tensor([0.41, 0.52, 0.63]))

    def forward(self, rays: RayBatch, *, rng: np.random.Generator) -> torch.Tensor:
        return self.color.expand(len(rays.uv), 3)


@pytest.mark.parametrize("softness", [0.0, 0.03, 0.5])
def test_differences_below_the_softness_count_by_their_squares(dataset: Dataset, softness: float) -> None:
    training, renderer = load(NET, dataset, [0, 1]), OneColor()
    loss = renderer.loss(training, 500, np.random.default_rng(3), softness=softness)
    index = np.random.default_rng(3).integers(len(training.rgb), size=500)
    missed = renderer.color.detach().double().numpy() - training.rgb.numpy()[index] / 255
    assert loss.item() == pytest.approx(np.mean(np.hypot(missed, softness) - softness), rel=1e-4)
    loss.backward()
    slope = np.sign(missed) if not softness else missed / np.hypot(missed, softness)
    assert renderer.color.grad is not None
    np.testing.assert_allclose(renderer.color.grad.numpy(), slope.mean(axis=0) / 3, rtol=1e-4, atol=1e-7)
