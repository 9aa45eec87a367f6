"""What stands in the viewer's space: the dataset's cameras with their pictures, and the meshes of one geometry."""

from collections.abc import Callable, Iterator

import numpy as np
import viser

from datagen.data.cameras import Camera
from datagen.data.config import Split
from datagen.data.dataset import Dataset, View
from datagen.data.geometries import read_meshes
from datagen.data.meshes import is_there
from datagen.data.paths import TRUTH, view_name
from datagen.disk.errors import HyalineError
from datagen.look.view_pictures import object_colors
from model.view.cameras import window_pose

Triple = tuple[float, float, float]

COLORS: dict[str, tuple[int, int, int]] = {"train": (90, 140, 230), "interpolating": (70, 180, 110)}
"""Of the frames of cameras by split; other splits test how a renderer extrapolates, and are red."""
OTHERS = (220, 90, 80)
FRAME_SHARE = 0.05
"""The size of a camera's frame, as a share of its distance from the scene's middle."""
MOST_PIXELS = 160
"""The longer side of a picture in its frame; a larger one is thinned out."""
GLASS_OPACITY = 0.35


class Stage:
    """Puts a dataset into a viewer's space."""

    def __init__(
        self, server: viser.ViserServer, dataset: Dataset, on_click: Callable[[View], None], *, back: float
    ) -> None:
        """Cameras stand there at once, without pictures; meshes are shown when asked for.

        Args:
            on_click: called, in a thread of viser's, when somebody has clicked a camera and looks through it.
            back: how much farther away than the first test view one starts, as a share of the distance.
        """
        self._server, self._dataset, self._on_click = server, dataset, on_click
        meshes = read_meshes(dataset, TRUTH) if dataset.objects else ()  # Imported pictures may have none.
        corners = [mesh.vertices for mesh in meshes if is_there(mesh)] or [_places(dataset)]
        low, high = np.concatenate(corners).min(axis=0), np.concatenate(corners).max(axis=0)
        self.middle = (low + high).astype(np.float64) / 2
        first: Split = "interpolating" if "interpolating" in dataset.splits else dataset.splits[0]
        self._start = self._find_start(dataset.view(first, 0).camera, back)
        # Before the frames: viser 1.1 sends at most 128 messages together, and its page places its camera once, as soon
        # as any of these has come. Those behind a cut are lost, and it looks at the world's origin instead.
        self._place(server.initial_camera)
        server.initial_camera.up = (0.0, 0.0, 1.0)
        self._frames: dict[Split, list[viser.CameraFrustumHandle]] = {
            split: [self._add_frame(view) for view in dataset.views(split)] for split in dataset.splits
        }
        self._meshes: list[viser.MeshHandle] = []

    def restart(self, client: viser.ClientHandle) -> None:
        """Moves a browser's camera to where browsers begin."""
        with client.atomic():
            self._place(client.camera)

    def show_cameras(self, split: Split, *, visible: bool) -> None:
        for frame in self._frames[split]:
            frame.visible = visible

    def show_meshes(self, geometry: str | None) -> None:
        """The meshes of this geometry instead of those that are shown; None: of none.

        Raises:
            HyalineError: they were not made, or are damaged.
        """
        meshes = () if geometry is None else read_meshes(self._dataset, geometry)
        for handle in self._meshes:
            handle.remove()
        colors = object_colors(len(self._dataset.objects))[1:]
        self._meshes = [
            self._server.scene.add_mesh_simple(
                f"/meshes/{item.name}",
                mesh.vertices,
                mesh.faces,
                color=color,
                opacity=GLASS_OPACITY if item.is_glass else None,
                side="double",
            )
            for item, mesh, color in zip(self._dataset.objects, meshes, colors)
            if is_there(mesh)
        ]

    def pictures(self) -> Iterator[None]:
        """Puts the pictures into the cameras' frames, one at each step; a view that is not built keeps an empty one."""
        for split, frames in self._frames.items():
            for view, frame in zip(self._dataset.views(split), frames, strict=True):
                try:
                    picture = view.image
                except HyalineError:
                    continue
                step = -(-max(picture.shape[:2]) // MOST_PIXELS)
                frame.image = picture[::step, ::step]
                yield

    def _add_frame(self, view: View) -> viser.CameraFrustumHandle:
        camera = view.camera
        position, wxyz, fov_y = window_pose(camera)
        frame = self._server.scene.add_camera_frustum(
            f"/cameras/{view.split}/{view_name(view.index)}",
            fov_y,
            camera.width / camera.height,
            scale=FRAME_SHARE * float(np.linalg.norm(position - self.middle)),
            thickness=1.5,
            thickness_units="screen",
            color=COLORS.get(view.split, OTHERS),
            wxyz=wxyz,
            position=position,
        )

        @frame.on_click
        def _(event: viser.SceneNodePointerEvent[viser.CameraFrustumHandle]) -> None:
            if event.client is not None:
                self._look_through(event.client, camera)
                self._on_click(view)

        return frame

    def _find_start(self, camera: Camera, back: float) -> tuple[Triple, Triple, float]:
        """Where one begins, what one looks at, and the vertical field of view in radians."""
        position, _, fov_y = window_pose(camera)
        ahead = self._ahead(camera)
        return _triple(position + back * (position - ahead)), _triple(ahead), fov_y

    def _place(self, camera: viser.CameraHandle | viser.InitialCameraConfig) -> None:
        camera.position, camera.look_at, camera.fov = self._start

    def _look_through(self, client: viser.ClientHandle, camera: Camera) -> None:
        position, wxyz, fov_y = window_pose(camera)
        with client.atomic():
            client.camera.position = position
            client.camera.look_at = self._ahead(camera)
            client.camera.wxyz = wxyz
            client.camera.fov = fov_y

    def _ahead(self, camera: Camera) -> np.ndarray:
        """The point on a camera's axis around which to turn: as far away as the scene's middle."""
        position, forward = camera.world_from_camera[:3, 3], -camera.world_from_camera[:3, 2]
        return position + forward * max(float(np.linalg.norm(self.middle - position)), 1e-3)


def _places(dataset: Dataset) -> np.ndarray:
    """Where the cameras stand."""
    return np.concatenate([dataset.cameras(split).world_from_camera[:, :3, 3] for split in dataset.splits])


def _triple(point: np.ndarray) -> Triple:
    x, y, z = map(float, point)
    return x, y, z
