"""Tests of the perceptual and the adversarial loss and of in-painting."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.signal import correlate2d
from support.synthetic import write_synthetic_dataset
from support.training import assert_resumes, build, load

from datagen.data.config import Resolution, square
from datagen.data.dataset import Dataset
from datagen.data.paths import TRUTH
from datagen.disk.errors import HyalineError
from datagen.disk.storage import sha256
from datagen.machine.mitsuba_variant import use_mitsuba
from model.batches.layers import load_pixels
from model.batches.rays import RayBatch, take_colors
from model.losses.patch_losses import (
    IMAGENET_MEAN,
    IMAGENET_STD,
    Adversary,
    Inpainter,
    Losses,
    PatchDiscriminator,
    PerceptualLoss,
    count_visits,
    find_vgg,
    patches_around,
    vgg_layers,
)
from model.losses.pixel_losses import PatchTerms, difference, pixel_loss
from model.methods.paper.config import DnrConfig, PaperConfig
from model.methods.renderer import Renderer
from model.run.preparation import check_losses
from model.run.run_folder import TrainConfig, check_same_run, read_run
from model.run.train import train
from model.settings import LossConfig

pytestmark = pytest.mark.usefixtures("one_thread")


CPU = torch.device("cpu")
NET = PaperConfig(width=16, texture_size=100, position_size=32)
SMALL = TrainConfig(method="paper", geometry=TRUTH, net=NET, steps=5, batch=128, evaluate_every=5, checkpoint_every=2)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return write_synthetic_dataset(tmp_path_factory.mktemp("losses") / "data" / "synthetic", train_views=5)


# The perceptual loss.


def test_its_first_layers_equal_scipy() -> None:
    loss = PerceptualLoss("vgg16", "random")
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


def test_it_compares_after_the_last_activation_of_three_stages() -> None:
    convolutions = {"vgg16": [0, 2, 5, 7, 10, 12, 14], "vgg19": [0, 2, 5, 7, 10, 12, 14, 16]}  # As torchvision counts.
    for kind, places in convolutions.items():
        loss = PerceptualLoss(kind, "random")  # pyright: ignore[reportArgumentType]
        layers = list(loss.features)
        assert [place for place, layer in enumerate(layers) if isinstance(layer, torch.nn.Conv2d)] == places
        assert isinstance(layers[-1], torch.nn.ReLU) and not any(value.requires_grad for value in loss.parameters())
    generator = torch.Generator().manual_seed(0)
    truth = torch.rand(2, 32, 32, 3, generator=generator)
    assert float(loss(truth, truth)) == 0
    off = truth + 0.1 * torch.randn(truth.shape, generator=generator)
    assert 0 < float(loss(0.5 * (truth + off), truth)) < float(loss(off, truth))


def test_weights_come_from_a_file_and_only_the_features_are_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    place = tmp_path / "hub/checkpoints/vgg16-397923af.pth"
    with pytest.raises(HyalineError, match=r"hub/checkpoints/vgg16-397923af.pth: no VGG16 weights; put torchvision's"):
        find_vgg(LossConfig(vgg_weights="auto"))
    trained = vgg_layers("vgg16")
    state = {f"features.{name}": value for name, value in trained.state_dict().items()}
    place.parent.mkdir(parents=True)
    torch.save({**state, "classifier.0.weight": "whatever"}, place)
    with pytest.raises(HyalineError, match="damaged, its SHA-256 is"):
        find_vgg(LossConfig(vgg_weights="auto"))  # Not the file that the name promises.
    source = find_vgg(LossConfig(vgg_weights=str(place)))
    assert source.vgg_sha256 == sha256(place.read_bytes()) and source.describe() == "pre-trained VGG16"
    loss = PerceptualLoss("vgg16", str(place))
    assert all(torch.equal(value, trained.state_dict()[name]) for name, value in loss.features.state_dict().items())
    with pytest.raises(HyalineError, match="not the weights of these layers"):
        PerceptualLoss("vgg19", str(place))
    place.write_bytes(b"no weights")
    with pytest.raises(HyalineError, match="not the weights of these layers"):
        PerceptualLoss("vgg16", str(place))
    assert LossConfig(vgg="vgg19", vgg_weights="random").describe() == "VGG19 of random weights (a stand-in)"


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
    seals = {"dataset_seal": dataset.seal, "layers_seal": record.layers_seal}
    with pytest.raises(HyalineError, match="another"):
        check_same_run(tmp_path / "parts", dataclasses.replace(config, loss=LossConfig()), **seals)


@pytest.mark.parametrize(
    ("terms", "error"),
    [
        ({"inpaint": True}, "inpaint: needs the discriminator"),
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


# In-painting.


def test_visits_are_where_gradients_arrive(dataset: Dataset) -> None:
    renderer = build(NET, dataset)
    pixels = load_pixels(dataset, TRUTH, "train", range(5))
    rays = pixels.take(torch.arange(len(pixels.rgb)), None)
    renderer.textures(rays.uv, rays.object_id).sum().backward()
    gradient = renderer.get_parameter("textures.table").grad
    assert gradient is not None
    visits = count_visits(renderer.textures, pixels)  # pyright: ignore[reportArgumentType]
    assert torch.equal(visits > 0, gradient[:, 0] > 0)
    assert 0 < (visits == 0).sum() < len(visits)
    assert (rays.object_id > 0).sum() < visits.sum() <= 4 * (rays.object_id > 0).sum()


def test_patches_lie_around_their_pixels_inside_their_views() -> None:
    pixel = torch.tensor([0, 24 * 16 - 1, 24 * 16 + 8 * 24 + 12])  # Two corners of one view, the middle of the next.
    index = patches_around(pixel, 5, Resolution(width=24, height=16))
    assert [int(part.min()) for part in index] == [0, 11 * 24 + 19, 24 * 16 + 6 * 24 + 10]
    assert [int(part.max()) for part in index] == [4 * 24 + 4, 24 * 16 - 1, 24 * 16 + 10 * 24 + 14]
    assert all(place in part for place, part in zip(pixel, index))


def make_inpainter(dataset: Dataset, renderer: torch.nn.Module) -> Inpainter:
    use_mitsuba()
    training = load_pixels(dataset, TRUTH, "train", range(5))
    return Inpainter(renderer, training, dataset, TRUTH, num_layers=4, seed=0, device=CPU)


def test_only_texels_without_visits_get_a_gradient(dataset: Dataset) -> None:
    torch.manual_seed(0)
    renderer = build(dataclasses.replace(NET, texture_levels=2), dataset).train()
    for parameter in renderer.parameters():
        torch.nn.init.normal_(parameter, std=0.3)
    inpainter = make_inpainter(dataset, renderer)
    before = {name: value.clone() for name, value in renderer.state_dict().items()}
    colors = inpainter.render(renderer, 2, 32, np.random.default_rng(0))
    colors.sum().backward()
    assert colors.shape == (2, 32, 32, 3) and renderer.training
    assert all(torch.equal(value, before[name]) for name, value in renderer.state_dict().items())  # Running statistics.
    for name, parameter in renderer.named_parameters():
        if not name.startswith("textures."):
            assert parameter.grad is None
    table = renderer.get_parameter("textures.0.table")
    assert table.grad is not None
    visits = inpainter.visits["textures.0.table"]
    assert (table.grad[visits > 0] == 0).all() and table.grad[visits == 0].abs().sum() > 0
    # What is seen is what the renderer itself draws there.
    index = patches_around(
        inpainter.showing[torch.from_numpy(np.random.default_rng(0).integers(len(inpainter.showing), size=2))],
        32,
        square(32),
    )
    with torch.no_grad():
        expected = renderer.eval()(inpainter.pixels.take(index, None)).view(2, 32, 32, 3)
    torch.testing.assert_close(colors, expected)
    assert (take_colors(inpainter.pixels, index.flatten()) == 0).all()  # Poses without truth.


def test_in_painting_fills_what_training_never_saw_and_resumes_to_the_bit(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make_inpainter(dataset, build(NET, dataset))  # Skips where Mitsuba cannot.
    # Textures of any size are moved as a whole: lazy moves would also reach the texels that training has seen.
    monkeypatch.setattr("model.run.optimizer.TEXELS_A_PIXEL", 0)
    monkeypatch.setattr("model.run.optimizer.LazyAdam", None)
    terms = LossConfig(adversarial=0.01, adversarial_from=0.3, inpaint=True, patch=32)
    config = dataclasses.replace(SMALL, loss=terms)
    assert_resumes(monkeypatch, config, dataset, tmp_path, stop=4)
    weights = torch.load(tmp_path / "whole/weights.pt", weights_only=True)["renderer"]["textures.table"]
    training = load(NET, dataset, [0, 1, 3, 4])
    visits = count_visits(build(NET, dataset).textures, training)  # pyright: ignore
    assert (weights[visits == 0] != 0).any()  # Without in-painting they would still be the zeros of the start.
    with pytest.raises(HyalineError, match="inpaint: needs stored layers to count which texels are visited"):
        many = dataclasses.replace(config, net=dataclasses.replace(NET, train_samples=4))
        train(many, dataset, tmp_path / "many", label="a", device=CPU)
    assert not (tmp_path / "many").exists()
    assert json.loads((tmp_path / "whole/run.json").read_text())["config"]["loss"]["inpaint"]


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
    losses = Losses(LossConfig(softness=softness), steps=1, seed=0, device=CPU, make_inpainter=lambda: pytest.fail(""))
    loss = losses.loss(renderer.loss, renderer, training, 500, np.random.default_rng(3), step=0)
    index = np.random.default_rng(3).integers(len(training.rgb), size=500)
    missed = renderer.color.detach().double().numpy() - training.rgb.numpy()[index] / 255
    assert loss.item() == pytest.approx(np.mean(np.hypot(missed, softness) - softness), rel=1e-4)
    loss.backward()
    slope = np.sign(missed) if not softness else missed / np.hypot(missed, softness)
    assert renderer.color.grad is not None
    np.testing.assert_allclose(renderer.color.grad.numpy(), slope.mean(axis=0) / 3, rtol=1e-4, atol=1e-7)
