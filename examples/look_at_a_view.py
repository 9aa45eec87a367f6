"""Opens a dataset, looks at a view and its layers, scores a simple prediction: `python examples/look_at_a_view.py`."""

import argparse
import sys

import numpy as np

import hyaline


def main(name: str | None) -> None:
    dataset = hyaline.open_dataset(name)
    view = dataset.view("interpolating", 0)
    layers = view.layers()
    names = ["nothing", *(item.name for item in dataset.objects)]
    row, column = (side // 2 for side in view.image.shape[:2])
    print(f"{dataset.name}: through the middle of view 0 a ray meets")
    for object_id, depth in zip(layers.object_id[:, row, column], layers.depth[:, row, column], strict=True):
        if object_id:
            print(f"  {names[object_id]} after {depth:.2f} m")

    mean = np.mean([train.image for train in dataset.views("train")], axis=(0, 1, 2)).astype(np.uint8)
    scores = hyaline.score(np.broadcast_to(mean, view.image.shape), view.image, view.mask("glass"))
    ceiling_db = dataset.noise_ceiling_db("interpolating")
    print(f"the mean training colour scores {scores.psnr_db:.2f} dB")
    if ceiling_db is not None:
        print(f"the noise of the truth allows {ceiling_db:.2f} dB")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Look at a view of a dataset and its layers, and score a prediction.")
    parser.add_argument("dataset", nargs="?", help="a dataset's folder, or its name under data/; default: the only one")
    try:
        main(parser.parse_args().dataset)
    except hyaline.HyalineError as error:
        sys.exit(f"error: {error}")
