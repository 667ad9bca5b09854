"""Score the detector of train_detector.py in fog (docs/robust-detector.md explains the steps)."""

import json
import sys
from pathlib import Path

import cv2
import numpy as np
import torch
from torch.nn.functional import max_pool2d
from train_detector import RENDER, STREET, train

from augment.output.codecs import decode_image
from augment.scores.probe import probe
from tools.cli import main as climategs

TEST_STREET = STREET.replace("seed=1", "seed=2")
SELECTION = ["--cameras", "front", "--frames", "::4", "--effects", "fog", "--levels", "1,3,5"]


@torch.no_grad()
def detect(network, rgb):
    """Return the cars in an image uint8 [96, 160, 3]: left, top, width and height, and score."""
    image = torch.from_numpy(rgb).permute(2, 0, 1) / 255
    scores, sides = network(image[None])[0].split([1, 4])
    _, y, x = torch.nonzero((scores == max_pool2d(scores, 5, 1, 2)) & (scores > -3)).T
    left, top, right, bottom = 10 * sides[:, y, x].exp()
    boxes = torch.stack([4 * x + 2 - left, 4 * y + 2 - top, left + right, top + bottom], dim=1)
    return zip(boxes.tolist(), scores[0, y, x].sigmoid().tolist(), strict=True)


def main(output_dir: Path) -> None:
    """Write suite/, predictions/ with score.html, and robust_detector.png: clear air and fog."""
    suite_dir = output_dir / "suite"
    climategs([*RENDER, str(output_dir / "street")])
    climategs(["suite", "weather-c", TEST_STREET, "--out", str(suite_dir), *SELECTION])
    network = train(output_dir / "street")[0]

    def load_image(path):
        return decode_image((suite_dir / path).read_bytes())

    suite = json.loads((suite_dir / "suite.json").read_text())
    for variant, facts in suite["variants"].items():  # clean-0, fog-1, fog-3, fog-5
        paths = [path for path in suite["files"] if f"/{facts['folder']}/images/" in path]
        results = [
            {"image_id": path, "category_id": 1, "bbox": bbox, "score": score}
            for path in paths
            for bbox, score in detect(network, load_image(path))
        ]
        meta = {"variant": variant, "probe": probe(load_image, facts["probes"]), "image_ids": paths}
        out = output_dir / "predictions" / variant
        out.mkdir(parents=True, exist_ok=True)
        (out / "results.json").write_text(json.dumps(results))
        (out / "meta.json").write_text(json.dumps(meta))
    options = ["--predictions", str(output_dir / "predictions"), "--categories", "Car=Car"]
    climategs(["score", str(suite_dir), *options])

    pictures = [load_image(suite["variants"][name]["probes"][0]) for name in ("clean-0", "fog-5")]
    cv2.imwrite(f"{output_dir}/robust_detector.png", np.hstack(pictures)[..., ::-1])
    print(f"picture: {output_dir}/robust_detector.png")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "out/examples"))
