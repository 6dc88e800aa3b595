"""Run the tutorial's commands and keep what they print: ``python docs/make_tutorial.py DATA``.

DATA holds ``street_pair/`` and ``espacio_escultorico/``; the page says where both come from. What
is kept under ``docs/tutorial/`` is what the page shows, word for word.
"""

import subprocess
import sys
import tempfile
from pathlib import Path

OUT = Path(__file__).parent / "tutorial"
COMMANDS = {
    "info": "dougong info ring.laz",
    "check": "dougong check ring.laz",
    "filter": "dougong filter ring.laz clean.laz --kind photogrammetry --mark",
    "register": "dougong register source.ply target.ply --out pose --source-kind lidar"
    " --target-kind lidar",
    "transform": "dougong transform source.ply moved.ply --matrix pose/registration.json"
    " --accept-best",
}
FILES = {
    "ring.laz": "espacio_escultorico/espacio_escultorico_uav_lod3.laz",
    "source.ply": "street_pair/source.ply",
    "target.ply": "street_pair/target.ply",
}


def main() -> None:
    """Run every command in an empty folder that holds the files under their short names."""
    data = Path(sys.argv[1]).resolve()
    OUT.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        for name, path in FILES.items():
            (Path(folder) / name).symlink_to(data / path)
        for name, command in COMMANDS.items():
            run = subprocess.run(
                command.split(),
                cwd=folder,
                check=False,
                text=True,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
            )
            if run.returncode not in (0, 3):  # 3: ambiguous, which the page explains
                raise SystemExit(f"{command}: exit {run.returncode}\n{run.stdout}")
            (OUT / f"{name}.txt").write_text(f"$ {command}\n{run.stdout}", encoding="utf-8")


if __name__ == "__main__":
    main()
