"""Tests what fits draw with the textures of a room."""

import numpy as np
import pytest
from support.traced_dataset import write_traced_dataset

from datagen.data.geometries import read_meshes
from datagen.scene.folder import open_scene
from hyaline_photos.fit import room
from hyaline_photos.fit.boxes import Box
from hyaline_photos.fit.room import FROSTED_RAYS, RAYS, Room

BALL = 2
SHAPE = Box(center=np.array([0.0, 0.0, 0.1]), axes=np.eye(3), half_sizes=np.full(3, 0.05), rounding=0.01)


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> Room:
    """A room whose ball became a box of glass, with textures that know nothing yet."""
    dataset = write_traced_dataset(tmp_path_factory.mktemp("room") / "glasses", resolution=24)
    scene = open_scene(dataset)
    meshes, materials = list(read_meshes(dataset, "truth")), [item.material for item in scene.objects]
    meshes[BALL - 1], materials[BALL - 1] = SHAPE.bodies()[0]
    pixels = room.load_pixels(dataset, scene, tuple(meshes), tuple(materials), room.COARSE)
    rows = np.arange(len(pixels.rgb))
    sky = room.SeenSky(rows=rows[:0], directions=np.zeros((0, 3), np.float32))
    state = room.room_state(room.learn(pixels, rows, sky, 1, seed=0))
    return room.load_room(state, pixels, rows)


def test_frosted_glass_is_drawn_by_more_rays_which_it_needs(drawn: Room, monkeypatch: pytest.MonkeyPatch) -> None:
    frosted = SHAPE.having(roughness=0.2)
    drawn.put((BALL,), frosted)
    rows = np.arange(0, len(drawn.pixels.rgb), 3)
    best, few, many = (drawn.draw(rows, samples) for samples in (16 * FROSTED_RAYS, RAYS, FROSTED_RAYS))
    assert 0 < np.square(many - best).mean() < 0.5 * np.square(few - best).mean()

    asked = []
    draw = Room.draw
    monkeypatch.setattr(Room, "draw", lambda self, rows, samples: asked.append(samples) or draw(self, rows, samples))
    misses = drawn.misses((BALL,), rows, (SHAPE,))
    assert misses(SHAPE).shape == misses(frosted).shape == (len(rows), 3)
    assert asked == [RAYS, FROSTED_RAYS]
