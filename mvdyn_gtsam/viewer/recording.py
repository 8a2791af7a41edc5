"""A result as one HTML file: a browser opens and plays it, without a server or a network."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from mvdyn_gtsam.progress import Progress
from mvdyn_gtsam.reconstruction.files import write_atomically
from mvdyn_gtsam.viewer.pictures import Choice
from mvdyn_gtsam.viewer.server import open_server
from mvdyn_gtsam.viewer.stage import Stage
from mvdyn_gtsam.viewer.views import ResultViews


def save_html(
    views: ResultViews, choice: Choice, times: Sequence[int], seconds: float, path: Path, progress: Progress
) -> None:
    """Write the instants ``times``, each shown for ``seconds``, as ``choice`` shows them.

    The whole recording is held in memory, some 10 bytes per point of each instant. Raises ResultError or
    CaptureError when a file is damaged and ResultError when ``path`` cannot be written.
    """
    scene = views.scene(choice)
    # A recording is taken of a server; nobody looks at this one.
    with open_server("127.0.0.1", 0) as server:
        stage = Stage(server)
        stage.begin(scene)
        recording = server.get_scene_serializer()
        for done, time in enumerate(times, start=1):
            stage.show(scene, views.picture(replace(choice, time=time)))
            if len(times) > 1:  # one instant is a scene that stands still, without a bar to play it
                recording.insert_sleep(seconds)
            progress.update("saving", done, len(times), f"frame {time}")
        content = recording.as_html()
    write_atomically(path, content.encode())
