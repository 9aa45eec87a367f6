"""What tests of fits share."""

import pytest


@pytest.fixture
def coarse_hulls(monkeypatch: pytest.MonkeyPatch) -> None:
    """Visual hulls of fewer voxels and faces."""
    monkeypatch.setattr("hyaline_photos.fit.hull.FACES", 3000)
    monkeypatch.setattr("hyaline_photos.fit.hull.COARSE", 24)
