"""Tests of texels that hardly any ray met: what is known around them fills them in, and what is known stays."""

import pytest
import torch
from torch import Tensor

from model.nets.filling import add_visits, fill_in, filled_layout
from model.nets.texture import TexturePyramid, object_layout

SIZE = 32


def pyramid(*sizes: int) -> TexturePyramid:
    """Random texels, one image for each size."""
    torch.manual_seed(0)
    layouts = [object_layout([size >> level for size in sizes]) for level in range(3)]
    textures = TexturePyramid(layouts, 4, finer_counts=0.5)
    for table in textures.tables():
        torch.nn.init.normal_(table)
    return textures


def shown(textures: TexturePyramid, object_id: int, rows: slice, columns: slice) -> Tensor:
    """Features at centres of the filled level's texels."""
    size = filled_layout(textures).sizes[object_id - 1]
    place = (torch.arange(size) + 0.5) / size
    v, u = torch.meshgrid(1 - place, place, indexing="ij")
    uv = torch.stack([u, v], dim=-1)[rows, columns].reshape(-1, 1, 2)
    ids = torch.full((len(uv), 1), object_id, dtype=torch.uint8)
    return textures(uv, ids)[:, 0].detach()


def paint(textures: TexturePyramid, value: Tensor, *, columns: slice) -> None:
    """Makes the columns of the first surface show one value, by its filled level, whatever the coarser ones say."""
    size = filled_layout(textures).sizes[0]
    change = value - shown(textures, 1, slice(None), slice(None)).view(size, size, -1)
    table = textures.tables()[1].data[: size * size].view(size, size, -1)
    # The level counts half as much as the coarsest.
    table[:, columns] += 2 * change[:, columns]


def silent_finest(textures: TexturePyramid) -> TexturePyramid:
    textures.tables()[0].data.zero_()
    return textures


def test_what_no_ray_met_shows_what_is_known_beside_it() -> None:
    textures = silent_finest(pyramid(SIZE))
    value = torch.tensor([1.0, -2.0, 3.0, 0.5])
    paint(textures, value, columns=slice(0, 8))
    met = torch.zeros(SIZE // 2, SIZE // 2)
    met[:, :8] = 100
    fill_in(textures, met.flatten())
    for columns in (slice(0, 8), slice(8, 16)):
        torch.testing.assert_close(shown(textures, 1, slice(None), columns), value.expand(128, 4), atol=0.01, rtol=0.01)


def test_what_many_rays_met_stays_as_it_was_learned() -> None:
    textures = pyramid(SIZE)
    before = [table.detach().clone() for table in textures.tables()]
    fill_in(textures, torch.full((SIZE * SIZE // 4,), 1e6))
    for old, new in zip(before, textures.tables(), strict=True):
        torch.testing.assert_close(new.detach(), old, atol=1e-4, rtol=0)


def test_only_one_level_changes_and_surfaces_do_not_mix() -> None:
    met = torch.zeros(16 * 16 + 8 * 8)
    met[: 16 * 8] = 100
    met_too = met.clone()
    met_too[16 * 16 :: 2] = 1
    one, other = pyramid(SIZE, 16), pyramid(SIZE, 16)
    before = [table.detach().clone() for table in one.tables()]
    fill_in(one, met)
    fill_in(other, met_too)
    assert [bool((old == new).all()) for old, new in zip(before, one.tables(), strict=True)] == [True, False, True]
    everything = slice(None), slice(None)
    assert bool((shown(one, 1, *everything) == shown(other, 1, *everything)).all())
    assert not bool((shown(one, 2, *everything) == shown(other, 2, *everything)).any())


@pytest.mark.parametrize(("contrast", "is_believed"), [(0.05, False), (3.0, True)])
def test_a_texel_met_once_is_believed_where_its_surface_has_a_pattern(contrast: float, is_believed: bool) -> None:
    textures = silent_finest(pyramid(SIZE))
    paint(textures, torch.zeros(4), columns=slice(None))
    table = textures.tables()[1].data.view(SIZE // 2, SIZE // 2, 4)
    # The level counts one half.
    table += 2 * contrast * torch.randn(SIZE // 2, SIZE // 2, 4)
    table[8, 8] += 2
    before = shown(textures, 1, slice(8, 9), slice(8, 9))
    met = torch.full((SIZE // 2, SIZE // 2), 1e4)
    met[8, 8] = 0.1
    fill_in(textures, met.flatten())
    change = (shown(textures, 1, slice(8, 9), slice(8, 9)) - before).mean()
    assert abs(change + (0 if is_believed else 1)) < 0.2


def test_visits_are_squares_of_what_a_texel_counts_in_its_pixel() -> None:
    layout = object_layout([4, 2])
    met = torch.zeros(layout.num_texels)
    uv = torch.tensor([[0.375, 0.875], [0.5, 0.875], [0.25, 0.75], [0.9, 0.1]])
    object_id = torch.tensor([1, 1, 2, 0], dtype=torch.uint8)
    add_visits(met, layout, uv, object_id, torch.tensor([0.5, 1.0, 0.1, 1.0]))
    expected = torch.zeros(20)
    expected[1] = 0.25 + 0.5  # The first lies on its centre, the second between it and the next.
    expected[2] = 0.5
    expected[16] = 0.01
    torch.testing.assert_close(met, expected)
