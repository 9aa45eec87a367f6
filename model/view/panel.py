"""The viewer's panel: what the free camera sees, which cameras and meshes stand around, how far the run is."""

import threading
from collections.abc import Callable
from typing import Literal

import viser

from datagen.data.config import Split
from datagen.data.dataset import Dataset, View
from datagen.data.geometries import list_geometries
from datagen.data.paths import TRUTH
from datagen.disk.errors import HyalineError

Sight = Literal["prediction", "layer", "nothing"]

NO_MESHES = "none"
USUAL_LAYERS = 8
"""Layers to choose from where none were peeled."""


class Panel:
    """Choices of whoever looks, the same for all; they change in threads of viser's."""

    def __init__(
        self,
        server: viser.ViserServer,
        dataset: Dataset,
        *,
        has_run: bool,
        on_sight: Callable[[], None],
        on_cameras: Callable[[Split, bool], None],
        on_meshes: Callable[[str | None], None],
    ) -> None:
        """
        Args:
            on_sight: called when the free camera is to see something else.
            on_cameras: called with a split, and whether its cameras are to be seen.
            on_meshes: called with the geometry whose meshes are to be seen; it may raise a HyalineError.
        """
        gui, geometries = server.gui, list_geometries(dataset) if dataset.objects else []
        self._status, self._trouble = gui.add_markdown(dataset.name), gui.add_markdown("", visible=False)
        layer: list[Sight] = ["layer"] if geometries else []
        sights: list[Sight] = [*(["prediction"] if has_run else []), *layer, "nothing"]
        first: Sight = "prediction" if has_run else "nothing"
        self._sight = gui.add_dropdown("the camera sees", sights, initial_value=first)
        self._layer = gui.add_slider("layer", 0, _num_layers(dataset) - 1, 1, 0, visible=False)
        self._geometry = gui.add_dropdown("layers of", geometries or (TRUTH,), initial_value=TRUTH, visible=False)
        shown = NO_MESHES if has_run or not geometries else TRUTH
        meshes = gui.add_dropdown("meshes", (NO_MESHES, *geometries), initial_value=shown)
        self._pause = gui.add_checkbox("pause", False, hint="Draw nothing, and leave the machine alone.")
        for split in dataset.splits:
            box = gui.add_checkbox(f"{split} cameras", not has_run)  # They stand in front of what is predicted.
            box.on_update(lambda event, split=split: on_cameras(split, event.target.value))
            on_cameras(split, not has_run)
        self._view = gui.add_markdown("Click a camera to look through it.")
        self._truth: viser.GuiImageHandle | None = None
        self._gui = gui

        def show_sight(_: object) -> None:
            self._layer.visible = self._geometry.visible = self.sight == "layer"
            on_sight()

        self._sight.on_update(show_sight)
        for control in (self._layer, self._geometry, self._pause):
            control.on_update(lambda _: on_sight())
        choosing = threading.Lock()

        def show_meshes(_: object) -> None:
            with choosing:  # Two threads would remove the same meshes, and the last choice might not be the last shown.
                try:
                    on_meshes(None if meshes.value == NO_MESHES else meshes.value)
                except HyalineError as error:
                    self.tell_trouble(str(error))

        meshes.on_update(show_meshes)
        on_meshes(None if shown == NO_MESHES else shown)

    @property
    def sight(self) -> Sight:
        """What the free camera sees."""
        return self._sight.value

    @property
    def layer(self) -> int:
        return self._layer.value

    @property
    def num_layers(self) -> int:
        return int(self._layer.max) + 1

    @property
    def geometry(self) -> str:
        """Whose layers the camera sees."""
        return self._geometry.value

    @property
    def is_paused(self) -> bool:
        return self._pause.value

    def tell_run(self, status: str) -> None:
        """How far the run is."""
        if self._status.content != status:
            self._status.content = status

    def tell_trouble(self, trouble: str) -> None:
        """Why the camera sees nothing; empty: it sees what it should."""
        if self._trouble.content != trouble:
            self._trouble.content, self._trouble.visible = trouble, bool(trouble)

    def show_view(self, view: View) -> None:
        """The truth of a view that somebody looks through."""
        self._view.content = f"{view.split} view {view.index}: truth"
        try:
            picture = view.image
        except HyalineError:
            self._view.content = f"{view.split} view {view.index}: not built"
            return
        if self._truth is None:
            self._truth = self._gui.add_image(picture, format="png")
        self._truth.image = picture


def _num_layers(dataset: Dataset) -> int:
    try:
        return dataset.layer_store().head.num_layers
    except HyalineError:
        return USUAL_LAYERS
