"""Makes the masks that `datagen capture` needs from a few clicks, with a segmentation network (SAM 2).

    pip install sam2                    # brings torchvision; into an environment of its own, if that is a problem
    python examples/masks_by_clicks.py kitchen --click tumbler IMG_0001 412 260 --click tumbler IMG_0001 405 400
    python examples/masks_by_clicks.py kitchen --click tumbler IMG_0044 300 220 --beside tumbler IMG_0044 350 300

A click is an object's name, a picture, and a column and a row in it: `--click` on the object, `--beside` next to it.
SAM 2 follows each object through the other pictures, in the order of their names, forwards and back; so take pictures
along a walk. Masks are written to kitchen/masks/OBJECT/PICTURE.png. Look at them: where one is wrong, run the command
again with all clicks so far and some in that picture.

We could not run this script to its end, since the network's weights (from Hugging Face) cannot be had where we work.
"""

import argparse
import tempfile
from collections import defaultdict
from pathlib import Path

import numpy as np
from PIL import Image

ENDINGS = (".png", ".jpg", ".jpeg", ".webp")


def main() -> None:
    parser = argparse.ArgumentParser(description="Make masks of glass from clicks.")
    parser.add_argument("folder", type=Path, help="with images/; masks/ is written beside it")
    click = ("OBJECT", "PICTURE", "COLUMN", "ROW")
    parser.add_argument("--click", nargs=4, action="append", required=True, metavar=click, help="a pixel of the object")
    parser.add_argument("--beside", nargs=4, action="append", default=[], metavar=click, help="a pixel beside it")
    parser.add_argument("--model", default="facebook/sam2.1-hiera-small", help="default: %(default)s")
    parser.add_argument("--device", default="cpu", help="cpu, cuda or mps; default: %(default)s")
    choices = parser.parse_args()
    pictures = sorted(path for path in (choices.folder / "images").iterdir() if path.suffix.lower() in ENDINGS)
    clicks = read_clicks(choices.click, choices.beside, [path.stem for path in pictures])
    names = list(dict.fromkeys(name for name, _ in clicks))
    for name in names:
        (choices.folder / "masks" / name).mkdir(parents=True, exist_ok=True)
    for frame, object_id, mask in track(pictures, clicks, names, choices.model, choices.device):
        Image.fromarray(np.where(mask, 255, 0).astype(np.uint8)).save(
            choices.folder / "masks" / names[object_id] / f"{pictures[frame].stem}.png"
        )
    print(choices.folder / "masks")


def read_clicks(on: list, beside: list, stems: list[str]) -> dict[tuple[str, int], tuple[list, list]]:
    """Points and labels (1: on it, 0: beside it) by object and frame."""
    clicks = defaultdict(lambda: ([], []))
    for label, given in ((1, on), (0, beside)):
        for name, picture, column, row in given:
            if Path(picture).stem not in stems:
                raise SystemExit(f"{picture}: is not in images/")
            points, labels = clicks[name, stems.index(Path(picture).stem)]
            points.append((float(column), float(row)))
            labels.append(label)
    return dict(clicks)


def track(pictures, clicks, names, model, device):
    """Frame, place of the object and mask, for every picture and object."""
    import torch
    from sam2.sam2_video_predictor import SAM2VideoPredictor

    predictor = SAM2VideoPredictor.from_pretrained(model, device=device)
    with tempfile.TemporaryDirectory() as folder, torch.inference_mode():
        for frame, path in enumerate(pictures):  # It reads numbered JPEG files alone.
            Image.open(path).convert("RGB").save(Path(folder) / f"{frame:05d}.jpg", quality=95)
        state = predictor.init_state(video_path=folder, offload_video_to_cpu=True)
        for (name, frame), (points, labels) in clicks.items():
            arrays = np.array(points, np.float32), np.array(labels, np.int32)
            predictor.add_new_points_or_box(state, frame, names.index(name), points=arrays[0], labels=arrays[1])
        first = min(frame for _, frame in clicks)
        for reverse in (False, True):
            for frame, ids, logits in predictor.propagate_in_video(state, start_frame_idx=first, reverse=reverse):
                for object_id, each in zip(ids, logits, strict=True):
                    yield frame, object_id, (each[0] > 0).cpu().numpy()


if __name__ == "__main__":
    main()
