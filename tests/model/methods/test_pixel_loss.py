"""Tests what the noise of training rays does to the loss of pixels."""

from dataclasses import dataclass

import numpy as np
import pytest
import torch
from jaxtyping import Bool, Float32, Int
from torch import Tensor

from datagen.data.cameras import Cameras
from model.batches.rays import PixelSource, mean_color, srgb_curve, variance_of_mean
from model.methods.renderer import noise_penalty, pixel_loss

pytestmark = pytest.mark.usefixtures("one_thread")

LAMP, GROUND, SAMPLES = 0.6, 0.3, 4
STEPS = 400


@dataclass(frozen=True, kw_only=True, eq=False)
class Glints(PixelSource[Tensor]):
    """Pixels in which each ray meets a lamp with the pixel's own probability, and the ground besides."""

    chance: Float32[Tensor, " pixel"]

    def take(self, index: Int[Tensor, " pixel"], rng: np.random.Generator | None) -> Bool[Tensor, "pixel sample"]:
        assert rng is not None
        chosen = rng.random((len(index), SAMPLES), dtype=np.float32)
        return torch.from_numpy(chosen) < self.chance[index][:, None]


class LampAndGround(torch.nn.Module):
    """Learns how bright lamp and ground are."""

    def __init__(self) -> None:
        super().__init__()
        self.lamp, self.ground = torch.nn.Parameter(torch.tensor(0.5)), torch.nn.Parameter(torch.tensor(0.5))

    def radiance(self, hits: Bool[Tensor, "pixel sample"]) -> Float32[Tensor, "pixel sample 3"]:
        return (self.ground + self.lamp * hits)[..., None].expand(-1, -1, 3)

    def whole(self, hits: Bool[Tensor, "pixel sample"]) -> tuple[Tensor, None]:
        return self.radiance(hits), None

    def apart(self, hits: Bool[Tensor, "pixel sample"]) -> tuple[Tensor, Tensor]:
        first, second = self.ground + self.lamp.detach() * hits, self.ground.detach() + self.lamp * hits
        return first[..., None].expand(-1, -1, 3), second[..., None].expand(-1, -1, 3)

    def forward(self, hits: Bool[Tensor, "pixel sample"], *, rng: np.random.Generator) -> Tensor:
        return mean_color(self.radiance(hits))


def learned_lamp(
    debias: float,
    *,
    softness: float,
    apart: bool = False,
    lamp: float = LAMP,
    chances: tuple[float, float] = (0.1, 0.9),
) -> float:
    """What is learned of a lamp."""
    chance = torch.linspace(*chances, 200).clamp_min(0)
    truth = (255 * srgb_curve(GROUND + lamp * chance)).round().to(torch.uint8)
    cameras = Cameras(width=200, height=1, fov_x=1.0, world_from_camera=np.eye(4)[None])
    rgb = truth[:, None].expand(-1, 3).contiguous()
    pixels, renderer = Glints(cameras=cameras, rgb=rgb, chance=chance), LampAndGround()
    radiance = renderer.apart if apart else renderer.whole
    optimizer = torch.optim.Adam(renderer.parameters(), lr=0.01)
    means = []
    for step in range(STEPS):
        rng = np.random.default_rng([4, step])
        loss = pixel_loss(renderer, pixels, 512, rng, softness=softness, radiance=radiance, debias=debias)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        means.append(renderer.lamp.item())
    return float(np.mean(means[STEPS // 2 :]))


def test_a_lamp_that_few_rays_meet_is_learned_as_bright_as_it_is() -> None:
    assert learned_lamp(1.0, softness=1.0) == pytest.approx(LAMP, rel=0.1)
    # The noise that a bright lamp makes costs more than what it explains.
    assert learned_lamp(0.0, softness=1.0) < 0.6 * LAMP


def test_so_is_one_much_brighter_than_the_penalty_is_soft_where_it_learns_by_squares() -> None:
    # Half of the pixels see the ground alone, which so is known.
    by_penalty, by_squares = (
        learned_lamp(1.0, apart=apart, lamp=2.0, chances=(-0.3, 0.3), softness=0.05) for apart in (False, True)
    )
    assert by_penalty < 0.6 * 2
    assert by_squares == pytest.approx(2.0, rel=0.15)  # Brighter: colours average in linear light, squares in sRGB.


@pytest.mark.parametrize("opposed", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("samples", [4, 16])
def test_the_variance_of_a_mean_color_is_what_it_is_over_many_draws(samples: int, opposed: float) -> None:
    generator = torch.Generator().manual_seed(samples)
    first, second, rest = torch.randn(3, 40_000, samples // 2, 3, generator=generator)
    pairs = torch.stack([first, -opposed * first + (1 - opposed) * second], dim=2) + 0.3 * rest[:, :, None]
    radiance = 0.4 + 0.05 * pairs.flatten(1, 2)
    estimate = variance_of_mean(radiance).mean().item()
    assert estimate == pytest.approx(mean_color(radiance).var(dim=0).mean().item(), rel=0.05)


def test_one_ray_tells_nothing_of_its_noise() -> None:
    assert torch.equal(variance_of_mean(torch.rand(5, 1, 3)), torch.zeros(5, 3))


def test_what_cancels_between_the_rays_of_a_pair_is_not_noise() -> None:
    """Else a renderer would be paid for contrasts inside of a pixel, such as ripples in a rough floor's reflections."""
    away = torch.rand(50, 2, 1, 3) * 0.3
    radiance = 0.4 + torch.cat([away, -away], dim=2).flatten(1, 2)
    assert variance_of_mean(radiance).max() < 1e-10


@pytest.mark.parametrize("missed", [0.01, 0.1, -0.3])
def test_the_noise_penalty_is_what_noise_adds_to_the_loss(missed: float) -> None:
    softness, deviation = 0.1, 0.02
    noise = deviation * torch.randn(400_000, 3, generator=torch.Generator().manual_seed(1))

    def penalty(differences: Tensor) -> Tensor:
        return (differences.square() + softness**2).sqrt()

    given = torch.full((1, 3), missed)
    added = (penalty(given + noise) - penalty(given) - given * noise / penalty(given)).mean().item()
    expected = noise_penalty(given, torch.full((1, 3), deviation**2), softness)
    assert added == pytest.approx(expected.mean().item(), rel=0.1)


@pytest.mark.parametrize("softness", [0.05, 0.2])
def test_noise_is_never_paid_for_however_large(softness: float) -> None:
    """Two pairs of rays, each too dark or too bright by as much: half of the time they cancel."""
    size = torch.linspace(0, 1, 200)[:, None]
    off, none = size.expand(-1, 3), torch.zeros(200, 3)
    missed = (off.square() + softness**2).sqrt() - softness
    cost = (missed - noise_penalty(off, none, softness) - noise_penalty(none + 1e-9, off.square(), softness)) / 2
    assert (cost.diff(dim=0) > -1e-7).all()


def test_a_white_truth_that_is_exceeded_asks_for_nothing() -> None:
    variance = torch.ones(2, 3, requires_grad=True)
    given = torch.tensor([[0.0, 0.1, 0.0], [0.2, 0.0, 0.0]])
    noise_penalty(given, variance, 0.05).sum().backward()
    assert variance.grad is not None
    assert torch.equal(variance.grad > 0, given > 0)
