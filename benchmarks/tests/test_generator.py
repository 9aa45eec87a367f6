"""Tests the benches at tiny sizes: that they check what they time, and count right. Speed is not asserted here."""

import dataclasses

import numpy as np
import pytest
import trimesh
from support.commands import call
from support.meshes import mesh_of
from support.rigs import config
from support.synthetic import synthetic_scene

from datagen.machine.mitsuba_variant import use_mitsuba
from datagen.scene.description import SceneObject
from datagen.scene.finding import find_scene
from datagen.scene.materials import Dielectric
from datagen.scene.rig import make_cameras

use_mitsuba()

from benchmarks.peel import compare_objects  # noqa: E402
from benchmarks.truth import Goal, bench_truth, fit_noise  # noqa: E402
from datagen.trace.peel import Peeler  # noqa: E402


def test_a_wrong_engine_fails_the_check() -> None:
    scene = find_scene("glass_table")
    meshes, cameras = tuple(item.mesh for item in scene.objects), make_cameras(scene.cameras, config(views=2))["train"]
    assert compare_objects(meshes, Peeler(meshes), cameras, 4)[0]
    passed, detail = compare_objects(meshes, Peeler(meshes[::-1]), cameras, 4)
    assert not passed
    assert "of the pixels; expected at least 98%" in detail


@pytest.mark.full
def test_truth_is_checked_and_its_noise_extrapolated() -> None:
    ball = mesh_of(trimesh.creation.icosphere(2, 0.4))
    scene = synthetic_scene()
    glass = SceneObject(name="ball", mesh=ball, material=Dielectric(ior=1.5, absorption=(3.0, 1.0, 2.0)))
    drop = mesh_of(trimesh.creation.icosphere(2, 0.2).apply_translation((0.3, 0, 0)))
    water = SceneObject(name="drop", mesh=drop, material=Dielectric(ior=1.33, priority=-1))
    scene = dataclasses.replace(scene, objects=(*scene.objects[1:], glass, water))
    cameras = make_cameras(scene.cameras, config(views=2))["train"]
    goal = Goal(ceiling_db=45, at_least=5, low_spp=4, high_spp=16)
    report = bench_truth(scene, cameras, goal, mean_spp=256, rounds=3)
    assert [check.passed for check in report.checks] == [True], report.checks
    assert report.facts["solids left out, which reach into others"] == 1
    ours = report.facts["datagen build: samples per pixel for 45 dB"]
    default = report.facts["mitsuba's defaults: samples per pixel for 45 dB"]
    assert isinstance(ours, float) and isinstance(default, float)
    assert 1 < ours < default
    assert report.gates[0].ratio is not None


def test_noise_of_a_known_law_is_extrapolated_exactly() -> None:
    def radiance(*, spp: int, seed: int) -> tuple[np.ndarray, int]:
        # In the linear range of the sRGB curve, whose slope is 12.92.
        noise = np.random.default_rng(seed).normal(size=(64, 64, 3)) * 1e-4 / np.sqrt(spp)
        return (0.0015 + noise).astype(np.float32), spp

    law = fit_noise(radiance, Goal(ceiling_db=60, at_least=5, low_spp=4, high_spp=64))
    assert law.exponent == pytest.approx(1, abs=0.02)
    assert law.spp_for(60) == pytest.approx((12.92 * 1e-4) ** 2 / 1e-6, rel=0.05)


def test_the_command_lists_its_benches_and_prints_tables() -> None:
    answer = call("benchmarks --help")
    assert all(name in answer.out for name in ("peel", "truth", "step"))
    answer = call("benchmarks peel --size 16 --rounds 3")
    assert answer.status == (1 if "FAILED" in answer.out else 0)
    assert all(name in answer.out for name in ("mitsuba-eager", "mitsuba-fused", "light-path-loop", "same light paths"))
