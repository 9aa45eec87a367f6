"""Random scenes as a source: what `datagen build random-0007` finds."""

from typing import TYPE_CHECKING

from datagen.disk.errors import HyalineError
from datagen.scene.sources import SceneSource
from hyaline_random.names import FAMILIES, RANDOM, RandomName, parse_random

if TYPE_CHECKING:
    from datagen.data.config import Resolution
    from datagen.scene.description import Scene
    from datagen.scene.import_choices import ImportChoices


def _find(given: str, _resolution: "Resolution", _imports: "ImportChoices") -> "Scene":
    from hyaline_random.drawing import make_random

    name = parse_random(given)
    if name is None:
        raise HyalineError(
            f"scene {given}: is not a random scene; expected a name like random-0007 or random-table-0007"
        )
    return make_random(name)


RANDOM_SCENES = SceneSource(
    has=lambda given: given.startswith(RANDOM),
    find=_find,
    is_of_files=False,
    name_of=lambda seed, family: str(RandomName(seed=seed, chosen=family)),
    families=FAMILIES.names,
)
