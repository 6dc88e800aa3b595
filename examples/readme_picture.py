"""Draw the picture of the README from a result folder: before on the left, after on the right.

dougong demo --out demo
python examples/readme_picture.py demo docs/images/hall.png
"""

import base64
import re
import sys
from pathlib import Path

import cv2
import numpy as np

from dougong.report.figures import find_place, overview
from dougong.report.layers import run_layers
from dougong.report.render import load

WIDTH = 620


def main(folder: Path, target: Path) -> None:
    """Write the picture of the result in `folder` to `target`."""
    layers = run_layers(folder, load(folder / "result.json"))
    pictures = []
    for figure in overview(layers, find_place(layers))[:2]:
        data = base64.b64decode(re.search(r"base64,([^\"]+)", figure.svg)[1])
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
        height = round(image.shape[0] * WIDTH / image.shape[1])
        # Shrunk with its alpha multiplied in, so that edges do not turn dark.
        image = image.astype(np.float32)
        image[..., :3] *= image[..., 3:] / 255
        image = cv2.resize(image, (WIDTH, height), interpolation=cv2.INTER_AREA)
        image[..., :3] *= 255 / np.maximum(image[..., 3:], 1)
        pictures.append(np.clip(image, 0, 255))
    both = np.hstack(pictures)
    # Sixteen steps a channel are enough for two hues in shade, and halve the file.
    both = (np.round(both / 17) * 17).astype(np.uint8)
    both[both[..., 3] == 0] = 0
    target.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(target), both, [cv2.IMWRITE_PNG_COMPRESSION, 9])
    print(f"{target}: {target.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
