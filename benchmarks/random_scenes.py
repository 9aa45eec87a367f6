"""Whether random scenes can be drawn: seeds drawn and checked, and why draws were refused."""

import time
from collections import Counter
from dataclasses import asdict, dataclass, field

import numpy as np

from datagen.disk.errors import HyalineError
from datagen.scene.procedural.drawing import draw_scene
from datagen.scene.random_names import FAMILIES, RandomName
from datagen.terminal.command import track


@dataclass(kw_only=True)
class FamilySurvey:
    """The results for the seeds of one family."""

    family: str
    scenes: int = 0
    failed: list[str] = field(default_factory=list)
    """Errors of seeds without an accepted draw."""
    refused: dict[str, int] = field(default_factory=dict)
    """How many draws were refused, by reason."""
    glass_shares: list[float] = field(default_factory=list)
    objects: list[int] = field(default_factory=list)
    triangles: list[int] = field(default_factory=list)
    cpu_s: list[float] = field(default_factory=list)


def survey_seeds(first: int, count: int, chosen: str | None) -> list[FamilySurvey]:
    """Draws and checks the scenes of these seeds; nothing is rendered."""
    surveys = {family: FamilySurvey(family=family) for family in ([chosen] if chosen else FAMILIES.built_in)}
    for seed in track(range(first, first + count), label="draw", total=count):
        name = RandomName(seed=seed, chosen=chosen)
        survey = surveys[name.family]
        start = time.process_time()
        try:
            drawn = draw_scene(name)
        except HyalineError as error:
            survey.failed.append(str(error))
            continue
        survey.cpu_s.append(round(time.process_time() - start, 3))
        survey.scenes += 1
        survey.refused = dict(Counter(survey.refused) + Counter(drawn.refused))
        survey.glass_shares.append(round(drawn.glass_share, 4))
        survey.objects.append(len(drawn.scene.objects))
        survey.triangles.append(sum(len(item.mesh.faces) for item in drawn.scene.objects))
    return [survey for survey in surveys.values() if survey.scenes or survey.failed]


def survey_table(surveys: list[FamilySurvey]) -> str:
    """The surveys as a table, and a line for each reason for which a draw was refused."""
    head = ("family", "scenes", "failed", "refused draws", "glass, % of pixels", "objects", "triangles", "CPU s a seed")
    rows = [
        (
            survey.family,
            str(survey.scenes),
            str(len(survey.failed)),
            str(sum(survey.refused.values())),
            _span(100 * np.array(survey.glass_shares), "{:.0f}"),
            _span(np.array(survey.objects), "{:.0f}"),
            _span(np.array(survey.triangles), "{:,.0f}"),
            _span(np.array(survey.cpu_s), "{:.1f}"),
        )
        for survey in surveys
    ]
    widths = [max(map(len, column)) for column in zip(head, *rows, strict=True)]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) for row in (head, *rows)]
    for survey in surveys:
        lines += [f"{survey.family}: refused {count} times: {reason}" for reason, count in survey.refused.items()]
        lines += [f"{survey.family}: failed: {error}" for error in survey.failed]
    return "\n".join(line.rstrip() for line in lines)


def survey_json(surveys: list[FamilySurvey]) -> list[dict[str, object]]:
    """The surveys for other programs."""
    return [asdict(survey) for survey in surveys]


def _span(values: np.ndarray, form: str) -> str:
    """Least, median and largest."""
    if not len(values):
        return "-"
    return " / ".join(form.format(value) for value in (values.min(), np.median(values), values.max()))
