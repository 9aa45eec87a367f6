"""The pictures of a report: what draws each, and what it shows. matplotlib is loaded when one is drawn."""

from datagen.disk.names import file_name
from datagen.disk.records import Json, to_json
from eval.page.further import Further
from eval.page.report_folder import Drawing
from eval.score.scores import RunScores, SceneScores


def figures_of(scenes: list[SceneScores], further: list[Further]) -> dict[str, Drawing]:
    """A sheet per run, a comparison and the cameras per scene, then the analyses' figures, by file."""
    figures: dict[str, Drawing] = {}
    for scene in scenes:
        name = file_name(scene.title)
        for scores in scene.runs:
            figures[f"{name}_{file_name(scores.run.name)}.png"] = _contact_sheet(scene, scores)
        if len(scene.runs) > 1:
            figures[f"comparison_{name}.png"] = _comparison_sheet(scene)
        figures[f"cameras_{name}.png"] = _cameras(scene)
    for analyses in further:
        figures |= analyses.figures
    return figures


def shown_of_run(scores: RunScores) -> Json:
    """What a picture of a run depends on, beside the truth."""
    run = scores.run
    about = {"name": run.name, "method": run.method, "geometry": run.geometry, "label": run.label, "seed": run.seed}
    return to_json({**about, "config": run.config, "flags": run.flags, "pictures": scores.digests})


def shown_of_scene(scene: SceneScores) -> Json:
    """What a picture of a scene's truth depends on."""
    truths = {split: truth.digest for split, truth in scene.truths.items()}
    return to_json({"title": scene.title, "dataset": scene.dataset.seal, "truths": truths})


def _contact_sheet(scene: SceneScores, scores: RunScores) -> Drawing:
    def draw() -> bytes:
        from eval.figures.sheets import contact_sheet

        return contact_sheet(scene, scores)

    return Drawing(draw=draw, about=["sheet", shown_of_scene(scene), shown_of_run(scores)])


def _comparison_sheet(scene: SceneScores) -> Drawing:
    def draw() -> bytes:
        from eval.figures.sheets import comparison_sheet

        return comparison_sheet(scene, "all runs")

    return Drawing(draw=draw, about=["comparison", shown_of_scene(scene), *map(shown_of_run, scene.runs)])


def _cameras(scene: SceneScores) -> Drawing:
    def draw() -> bytes:
        from eval.figures.cameras import cameras_figure

        return cameras_figure(scene.dataset, scene.title)

    return Drawing(draw=draw, about=["cameras", scene.title, scene.dataset.seal])
