"""Clouds opened in the browser of this computer, until they are closed."""

import webbrowser
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from dougong.errors import InputError
from dougong.pipeline.memory import Room
from dougong.pipeline.progress import Progress
from dougong.report.server import ViewServer
from dougong.report.streaming import Scene, prepare


@dataclass(frozen=True, slots=True)
class Viewing:
    """An open viewer: what to say about it, and how to end it."""

    document: dict[str, Any]
    server: ViewServer
    scratch: TemporaryDirectory[str]

    def close(self) -> None:
        """Stop serving and remove the temporary files."""
        self.server.close()
        self.scratch.cleanup()


def open_view(
    paths: Sequence[Path],
    *,
    port: int,
    open_browser: bool,
    work: Path | None,
    progress: Progress,
    pairs: Path | None = None,
    memory_bytes: int | None = None,
) -> Viewing:
    """Serve clouds or result folders to the browser of this computer.

    `pairs` is the CSV file that places picked in two clouds go to. What is converted first stays
    under `memory_bytes`.

    Raises
    ------
    InputError
        Nothing is named, a folder holds no result, or the port is taken.
    FormatError
        A file cannot be read.
    """
    if work is not None:
        work.mkdir(parents=True, exist_ok=True)
    scratch = TemporaryDirectory(prefix="dougong-view-", dir=work, ignore_cleanup_errors=True)
    try:
        scene = prepare(paths, Path(scratch.name), progress.stage, pairs, Room.of(memory_bytes))
        server = _server(scene, port)
    except BaseException:
        scratch.cleanup()
        raise
    document = {
        "url": server.url,
        "clouds": list(scene.clouds),
        "points": scene.points,
        "notes": list(scene.notes),
        "is_browser_open": open_browser and webbrowser.open(server.url),
    }
    return Viewing(document, server, scratch)


def _server(scene: Scene, port: int) -> ViewServer:
    try:
        return ViewServer(scene.things, port, scene.takes)
    except (OSError, OverflowError) as error:
        msg = f"port {port} cannot be used ({error}). Pass another --port, or none."
        raise InputError(msg) from error
