"""Pictures put into the 3D scene of a viser server."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import viser
from scipy.spatial.transform import Rotation

from mvdyn_gtsam.viewer.pictures import CameraPicture, Picture, Points, trajectory_lines
from mvdyn_gtsam.viewer.scene import Scene, Viewpoint, behind_camera, first_view, through_camera

LINE_PX = 2.5
"""Of trajectories and frusta, on the screen."""
BACKGROUND = "/background"
PATHS = "/paths/"


class Stage:
    """Draws into one server. ``nodes`` are those drawn, by name; those that a picture lacks are removed."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self.nodes: dict[str, viser.SceneNodeHandle] = {}
        self._background: Points | None = None
        self._through: str | None = None

    def begin(self, scene: Scene) -> None:
        """Clear the stage for another group of cameras: its paths, its up, the first view."""
        self._keep(set())
        self._background = None
        self._server.scene.set_up_direction(scene.up)
        view = first_view(scene)
        initial = self._server.initial_camera
        initial.position, initial.look_at, initial.up = view.position, view.look_at, view.up
        initial.fov = view.fov
        for client in self._server.get_clients().values():
            _look(client, view)
        self.draw_paths(scene)

    def draw_paths(self, scene: Scene) -> None:
        """The trajectories of all cameras of ``scene``, in place of those drawn before."""
        self._keep({name for name in self.nodes if not name.startswith(PATHS)})
        for name in scene.names:
            lines = trajectory_lines(scene.wTc[name])
            if len(lines):
                self.nodes[PATHS + name] = self._server.scene.add_line_segments(
                    PATHS + name, lines, scene.colours[name], thickness=LINE_PX, thickness_units="screen"
                )

    def show(self, scene: Scene, picture: Picture) -> None:
        """Replace what is seen by ``picture``."""
        choice = picture.choice
        with self._server.atomic():
            drawn = {name for name in self.nodes if name.startswith(PATHS)}
            for name in drawn:
                self.nodes[name].visible = name.removeprefix(PATHS) not in choice.hidden
            for camera in picture.cameras:
                name = f"/cameras/{camera.camera}/points"
                drawn |= self._draw_points(name, camera.points, camera.wTc, choice.point_size)
                if camera.camera != choice.through:  # its own picture would stand in the way
                    drawn |= self._draw_frustum(camera, choice.frustum_size)
            drawn |= self._draw_background(picture)
            self._keep(drawn)
            self._look_through(scene, picture)

    def _keep(self, names: set[str]) -> None:
        for name in set(self.nodes) - names:
            self.nodes.pop(name).remove()

    def _draw_background(self, picture: Picture) -> set[str]:
        """Sent again only where it is another: it is large."""
        points = picture.background
        if points is not None and points is self._background and BACKGROUND in self.nodes:
            node: Any = self.nodes[BACKGROUND]
            node.point_size = _half_width(points, picture.choice.point_size)
            return {BACKGROUND}
        self._background = points
        if points is None:
            return set()
        return self._draw_points(BACKGROUND, points, np.eye(4), picture.choice.point_size)

    def _draw_points(
        self, name: str, points: Points, wTf: npt.NDArray[np.float64], point_size: float
    ) -> set[str]:
        """Points of a frame f that stands at ``wTf`` ``(4, 4)``. Returns the names that were drawn."""
        if not len(points):  # browsers refuse an empty buffer
            return set()
        wxyz, position = _pose(wTf)
        self.nodes[name] = self._server.scene.add_point_cloud(
            name,
            points.positions,
            points.colours,
            point_size=_half_width(points, point_size),
            point_shading="flat",
            # Half of it is a fraction of a pixel in a camera's own frame, but visible steps in the world's.
            precision="float32" if name == BACKGROUND else "float16",
            wxyz=wxyz,
            position=position,
        )
        return {name}

    def _draw_frustum(self, camera: CameraPicture, size: float) -> set[str]:
        name = f"/cameras/{camera.camera}/frustum"
        wxyz, position = _pose(camera.wTc)
        self.nodes[name] = self._server.scene.add_camera_frustum(
            name,
            camera.fov,
            camera.aspect,
            scale=size,
            thickness=LINE_PX,
            thickness_units="screen",
            color=camera.colour,
            image=camera.image,
            format="jpeg",
            wxyz=wxyz,
            position=position,
        )
        return {name}

    def _look_through(self, scene: Scene, picture: Picture) -> None:
        """Carry everybody along with the camera that is looked through; a step back when they leave it."""
        time, through, left = picture.choice.time, picture.choice.through, self._through
        view = None if through is None else through_camera(scene, through, time)
        if through is None and left is not None and left in scene.names and scene.has_pose(left, time):
            view = behind_camera(scene, left, time)
        self._through = through
        if view is not None:
            for client in self._server.get_clients().values():
                _look(client, view)


def _look(client: viser.ClientHandle, view: Viewpoint) -> None:
    client.camera.position = view.position
    client.camera.look_at = view.look_at
    client.camera.up_direction = view.up
    client.camera.fov = view.fov


def _half_width(points: Points, point_size: float) -> float:
    """What viser takes for the size of a point."""
    return 0.5 * point_size * points.spacing


def _pose(wTc: npt.NDArray[np.float64]) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Quaternion ``wxyz`` and position of a node at ``wTc``."""
    return np.roll(Rotation.from_matrix(wTc[:3, :3]).as_quat(), 1), wTc[:3, 3]
