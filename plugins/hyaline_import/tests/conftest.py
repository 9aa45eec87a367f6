"""Imports in tests lay out texture coordinates at once; how well the real atlas does is tested in test_mending.py."""

import pytest

from datagen.scene.atlas import faces_apart


@pytest.fixture(autouse=True)
def quick_atlas(monkeypatch: pytest.MonkeyPatch) -> None:
    """An atlas of a sphere takes seconds, unless it is in the user's cache."""
    monkeypatch.setattr(
        "datagen.scene.mending.unwrap_all", lambda meshes: {name: faces_apart(mesh) for name, mesh in meshes.items()}
    )
