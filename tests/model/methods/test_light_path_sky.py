"""Tests that the sky that `light-path` learns is as fine as the light that it has to show."""

import dataclasses
import io
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from support.synthetic import synthetic_scene, write_synthetic_dataset

from datagen.machine.mitsuba_variant import use_mitsuba
from datagen.scene.description import EnvironmentMap
from model.methods.light_path import net
from model.methods.light_path.config import LightPathConfig
from model.methods.protocol import Inputs

use_mitsuba()


def test_the_learned_sky_has_the_rows_of_the_environment_map_within_bounds_unless_it_is_told_otherwise(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    dataset = write_synthetic_dataset(tmp_path / "data" / "synthetic", resolution=8)
    inputs = Inputs(dataset=dataset, geometry="truth", num_layers=0, layers_seal=dataset.seal)
    assert net.complete(LightPathConfig(), inputs).environment_size == 32
    scene = dataclasses.replace(synthetic_scene(), environment=EnvironmentMap(path="sky.exr"), folder=tmp_path)
    monkeypatch.setattr(net, "open_scene", lambda _: scene)
    for rows, expected in ((8, 32), (100, 64), (128, 128), (600, 256)):
        plane = np.ones((rows, 16), np.float16)
        buffer = io.BytesIO()
        OpenEXR.File({"type": OpenEXR.scanlineimage}, {"R": plane, "G": plane, "B": plane}).write(buffer)
        (tmp_path / "sky.exr").write_bytes(buffer.getvalue())
        assert net.complete(LightPathConfig(), inputs).environment_size == expected
    assert net.complete(LightPathConfig(environment_size=16), inputs).environment_size == 16
