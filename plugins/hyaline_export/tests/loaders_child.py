"""Opens an export with a tool's own loader and notes what it read. Runs in that tool's environment, without hyaline.

    python loaders_child.py LOADER EXPORT QUESTIONS.npz ANSWER.npz

Questions: for each picture, by name, some places in pixels (column, row), where (0.5, 0.5) is the centre of the upper
left one. The answer has the loader's ray through each of them, in the world of the export: a tool's own transforms of
the world (centring, scaling, rotating) are undone by the transform that the tool reports. Exit status 3: not installed.
"""

# None of these packages is in hyaline's environment.
# pyright: reportMissingImports=false

import json
import os
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np


@dataclass
class Answer:
    """All that a loader read of an export."""

    splits: dict[str, list[str]] = field(default_factory=dict)
    """Empty for a tool that knows none."""
    pictures: dict[str, dict[str, np.ndarray]] = field(default_factory=dict)
    """By name: 8-bit `colors` (h, w, channels), `origins` and `directions` (place, 3) of any length in the world, and
    `depth` (h, w) in metres along the axis where the loader reads it."""
    points: np.ndarray | None = None
    """(point, 3) metres, world."""
    colors: np.ndarray | None = None
    """(point, 3) 8-bit."""
    near_far: tuple[float, float] | None = None


Questions = dict[str, np.ndarray]


def read_nerfstudio_data(root: Path, questions: Questions) -> Answer:
    """nerfstudio-data with its defaults, depth and points."""
    from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig

    return _nerfstudio(lambda: NerfstudioDataParserConfig(data=root, load_3D_points=True).setup(), questions)


def read_nerfstudio_blender(root: Path, questions: Questions) -> Answer:
    """blender-data, with points where the export has any."""
    from nerfstudio.data.dataparsers.blender_dataparser import BlenderDataParserConfig

    ply = Path("points3d.ply") if (root / "points3d.ply").exists() else None
    return _nerfstudio(lambda: BlenderDataParserConfig(data=root, ply_path=ply).setup(), questions)


def read_nerfstudio_colmap(root: Path, questions: Questions) -> Answer:
    """colmap, with the path of the model, and its points."""
    from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig

    return _nerfstudio(lambda: ColmapDataParserConfig(data=root, colmap_path=Path("sparse/0")).setup(), questions)


def _nerfstudio(make_parser: Callable, questions: Questions) -> Answer:
    from nerfstudio.data.datasets.base_dataset import InputDataset
    from nerfstudio.data.datasets.depth_dataset import DepthDataset

    answer = Answer()
    for split in ("train", "val", "test"):
        outputs = make_parser().get_dataparser_outputs(split=split)
        scale, transform = outputs.dataparser_scale, outputs.dataparser_transform.double().numpy()
        has_depth = outputs.metadata.get("depth_filenames") is not None
        dataset = (DepthDataset if has_depth else InputDataset)(outputs)
        names = [Path(file).stem for file in outputs.image_filenames]
        for index, name in enumerate(names):
            origins, directions = _nerfstudio_rays(outputs.cameras, index, questions[name])
            picture = {
                "colors": dataset.get_data(index, image_type="uint8")["image"].numpy(),
                "origins": (origins / scale - transform[:, 3]) @ transform[:, :3],
                "directions": directions @ transform[:, :3],
            }
            if has_depth:
                picture["depth"] = dataset[index]["depth_image"][..., 0].double().numpy() / scale
            answer.pictures[name] = picture
        answer.splits[split] = names
        if (points := outputs.metadata.get("points3D_xyz")) is not None:
            answer.points = (points.double().numpy() / scale - transform[:, 3]) @ transform[:, :3]
            answer.colors = outputs.metadata["points3D_rgb"].numpy()
    return answer


def _nerfstudio_rays(cameras, index: int, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    import torch

    coords = torch.from_numpy(places[:, ::-1].astype(np.float32).copy())  # Row, column.
    rays = cameras.generate_rays(camera_indices=torch.full((len(places), 1), index), coords=coords)
    return rays.origins.double().numpy(), rays.directions.double().numpy()


def read_pycolmap(root: Path, questions: Questions) -> Answer:
    """COLMAP's own reader; it knows no splits."""
    import pycolmap

    model = pycolmap.Reconstruction(str(root / "sparse" / "0"))
    answer = Answer()
    for image in model.images.values():
        name, camera = Path(image.name).stem, model.cameras[image.camera_id]
        matrix = np.asarray(image.cam_from_world().matrix())
        flat = np.asarray(camera.cam_from_img(questions[name].astype(np.float64)))
        picture = pycolmap.Bitmap.read(str(root / "images" / image.name), as_rgb=True)
        assert picture is not None
        answer.pictures[name] = {
            "colors": picture.to_array(),
            "origins": np.tile(-matrix[:, :3].T @ matrix[:, 3], (len(flat), 1)),
            "directions": np.pad(flat, ((0, 0), (0, 1)), constant_values=1) @ matrix[:, :3],
        }
    ids = sorted(model.points3D)
    answer.points = np.array([model.points3D[number].xyz for number in ids])
    answer.colors = np.array([model.points3D[number].color for number in ids], np.uint8)
    return answer


def read_datasets(root: Path, questions: Questions) -> Answer:
    """Hugging Face's `load_dataset` of the folder; cameras by their convention, for it has none of its own."""
    os.environ["HF_HUB_OFFLINE"] = "1"
    import datasets

    answer = Answer()
    with tempfile.TemporaryDirectory() as cache:
        for split, rows in datasets.load_dataset(str(root), cache_dir=cache).items():
            role = {"train": "train", "validation": "val"}.get(split, "test")
            for row in rows:
                name, depth = row["name"], np.asarray(row["depth"]) / 1000
                answer.pictures[name] = _by_convention(row, questions[name], np.asarray(row["image"]), depth)
                answer.splits.setdefault(role, []).append(name)
                answer.near_far = row["near"], row["far"]
    return answer


def _by_convention(lens: dict, places: np.ndarray, colors: np.ndarray, depth: np.ndarray) -> dict[str, np.ndarray]:
    """A picture with the camera keys of transforms.json."""
    matrix = np.array(lens["transform_matrix"])
    x = (places[:, 0] - lens["cx"]) / lens["fl_x"]
    y = (places[:, 1] - lens["cy"]) / lens["fl_y"]
    return {
        "colors": colors,
        "origins": np.tile(matrix[:3, 3], (len(places), 1)),
        "directions": np.stack([x, -y, -np.ones_like(x)], axis=-1) @ matrix[:3, :3].T,
        "depth": depth,
    }


LOADERS: dict[str, Callable[[Path, Questions], Answer]] = {
    "nerfstudio-data": read_nerfstudio_data,
    "nerfstudio-blender": read_nerfstudio_blender,
    "nerfstudio-colmap": read_nerfstudio_colmap,
    "pycolmap": read_pycolmap,
    "datasets": read_datasets,
}


def write_answer(answer: Answer, path: Path) -> None:
    """Arrays by name, and all else as JSON; no pickle."""
    about = {"names": list(answer.pictures), "splits": answer.splits, "near_far": answer.near_far}
    arrays = {f"{name}/{key}": array for name, picture in answer.pictures.items() for key, array in picture.items()}
    if answer.points is not None and answer.colors is not None:
        arrays["points"], arrays["colors"] = answer.points, answer.colors
    # numpy's stubs take the names for their own arguments.
    np.savez(path, about=json.dumps(about), **arrays)  # pyright: ignore[reportArgumentType]


if __name__ == "__main__":
    loader, root, questions, out = sys.argv[1:]
    with np.load(questions) as file:
        asked = {name: file[name] for name in file.files}
    try:
        answer = LOADERS[loader](Path(root), asked)
    except ImportError as error:
        print(f"{type(error).__name__}: {error}", file=sys.stderr)
        sys.exit(3)
    write_answer(answer, Path(out))
