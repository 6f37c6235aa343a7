"""`gnmreg debug --view`: a fit in 3D, stage after stage, with the capture's scan and cameras.

The page reads the files of `registration.report.stage_snapshots.write_stage` and shows a stage once it is written.
"""

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from registration.capture.origin import capture_origin
from registration.capture.pixels import read_view
from registration.capture.scan import Scan, read_scan
from registration.frames import MM_PER_M, linear_to_srgb
from registration.geometry.closest_point import ClosestPointQuery
from registration.report.glb import static_glb
from registration.report.heat_map import scale_limit_mm
from registration.report.pictures import scale_colours
from registration.types import Camera, Capture
from workflows.web import panels
from workflows.web.server import PageServer, literal

TO_SCAN, MOTION, PLAIN = "distance to the scan", "motion in this stage", "nothing"
_SKIN, _SCAN = (206, 176, 158), (96, 110, 128)
_MAX_POINTS = 60_000  # of the scan, displayed
_MAX_THUMBNAIL_PX = 200  # height of the images in the cameras' frusta
_POLL_S = 0.5
_FOV = float(np.radians(38))  # vertical, of the viewer
_HEAD_DISTANCE_M = 0.8  # of the viewer, at first
_FRUSTUM_M = 0.05  # size of a camera


class FitPage(PageServer):
    """The page of one fit; all browsers share one state."""

    def __init__(self, stages: Path, capture: Capture, outside: Bool[np.ndarray, "V"], port: int = 0):
        """Start the server.

        Args:
            stages: folder of the snapshots; it need not exist yet.
            capture: the capture that is registered.
            outside: vertices that a scan can contain.
            port: port on the loopback interface; 0: any free one.

        Raises:
            InputError: the scan cannot be read, or the port is in use.
        """
        self._origin = capture_origin([view.camera for view in capture.views])  # of the page: browsers use float32
        self._folder, self._outside = Path(stages), outside
        self._capture = capture.cameras_relative_to(self._origin)
        self._scan = None if capture.scan is None else self._read_mesh(capture.scan)
        self._meshes: dict[str, Scan] = {}  # stage -> its mesh
        self._viewpoint: _Viewpoint | None = None  # once there is a mesh
        self._lock, self._closed = threading.RLock(), threading.Event()
        super().__init__(port, "Fit")
        self._build()
        threading.Thread(target=self._live, daemon=True).start()

    def close(self) -> None:
        """Stop the server and the thread that reads snapshots."""
        self._closed.set()
        super().close()

    @property
    def stages(self) -> list[str]:
        """Names of the stages read so far."""
        return list(self._meshes)

    def _read_mesh(self, file: Path) -> Scan:
        mesh = read_scan(file)
        return replace(mesh, vertices=mesh.vertices - self._origin)

    def _build(self) -> None:
        """Create the scene and the controls."""
        gui, scene, capture = self._server.gui, self._server.scene, self._capture
        gui.add_markdown(f"### {literal(capture.subject)}, {literal(capture.expression)}\n{len(capture.views)} views")
        # viser's setters have types of their own that type checkers take for read-only properties.
        self._stage: Any = gui.add_dropdown("Stage", ("waiting",))
        self._colours: Any = gui.add_dropdown("Colours show", (*([TO_SCAN] if self._scan else []), MOTION, PLAIN))
        self._bar = gui.add_html("")
        scan: Any = gui.add_checkbox("Scan", False, disabled=self._scan is None)
        cameras: Any = gui.add_checkbox("Cameras", False)
        gui.add_markdown("Target, rendering, their difference (x 4), normals:")
        self._sheet: Any = gui.add_image(np.full((2, 4, 3), 255, np.uint8))
        self._points: Any = None
        if self._scan is not None:
            step = -(-len(self._scan.vertices) // _MAX_POINTS)
            points = self._scan.vertices[::step].astype(np.float32)
            self._points = scene.add_point_cloud("/scan", points, _SCAN, point_size=5e-4, precision="float32")
            self._points.visible = False
        self._frusta: Any = scene.add_frame("/cameras", show_axes=False, visible=False)
        self._stage.on_update(lambda _: self._show())
        self._colours.on_update(lambda _: self._show())
        scan.on_update(lambda _: setattr(self._points, "visible", scan.value))
        cameras.on_update(lambda _: self._show_cameras(cameras.value))

    def _live(self) -> None:
        """Read new stages, and the cameras' images, which take seconds."""
        for view in self._capture.views:
            self.refresh()
            camera = view.camera
            bare = replace(view, mask=None, normals=None, segmentation=None)
            pixels = read_view(bare, self._capture, downsample=-(-camera.height_px // _MAX_THUMBNAIL_PX))
            image = (np.clip(linear_to_srgb(pixels.rgb), 0, 1) * 255).astype(np.uint8)
            if self._closed.is_set():
                return
            rotation = Rotation.from_matrix(camera.T_cam_world[:3, :3].T).as_quat(scalar_first=True)
            self._server.scene.add_camera_frustum(
                f"/cameras/{view.name}",
                fov=2 * float(np.arctan(camera.height_px / 2 / camera.intrinsics[1, 1])),
                aspect=camera.width_px / camera.height_px,
                scale=_FRUSTUM_M,
                thickness=1e-3,
                image=image,
                wxyz=rotation,
                position=camera.centre,
            )
        while not self._closed.wait(_POLL_S):
            self.refresh()

    def refresh(self) -> None:
        """Read new stages; select the last one if the previously last one was selected."""
        with self._lock:
            new = [file for file in sorted(self._folder.glob("[0-9]*.ply")) if file.stem not in self._meshes]
            if not new:
                return
            follows = not self._meshes or self._stage.value == self.stages[-1]
            if not self._meshes:
                self._look_at(self._read_mesh(new[0]).vertices)
            self._meshes |= {file.stem: self._read_mesh(file) for file in new}
            self._stage.options = tuple(self.stages)  # the selection is kept; the first stages replace "waiting"
            if follows:
                self._stage.value = self.stages[-1]

    def _look_at(self, head: Float[np.ndarray, "V 3"]) -> None:
        """Place the viewer at the mean direction of the cameras, with their mean up direction."""
        view = self._viewpoint = _Viewpoint.of([view.camera for view in self._capture.views], head.mean(0))
        self._server.scene.set_up_direction(view.up)
        self._server.scene.add_light_directional("/key", intensity=1.6, position=view.front + view.up)
        self._view_from(view, _HEAD_DISTANCE_M)

    def _show_cameras(self, shown: bool) -> None:
        """Show the cameras and step back until all of them are in view; or hide them and return to the head."""
        with self._lock:
            self._frusta.visible = shown
            if (view := self._viewpoint) is not None:
                self._view_from(view, view.radius / np.sin(_FOV / 2) if shown else _HEAD_DISTANCE_M)

    def _view_from(self, view: "_Viewpoint", distance: float) -> None:
        """Look at the head from the front, in all browsers; in a window that is higher than wide from further away."""
        camera = self._server.initial_camera
        camera.fov, camera.look_at, camera.position = _FOV, view.center, view.center + distance * view.front
        for client in self._server.get_clients().values():
            narrow = max(1.0, 1.0 / max(client.camera.aspect, 0.2))
            client.camera.fov, client.camera.up_direction = _FOV, view.up
            client.camera.position = view.center + narrow * distance * view.front
            client.camera.look_at = view.center

    def _show(self) -> None:
        """Show the selected stage in the selected colours."""
        with self._lock:
            name = self._stage.value
            if name not in self._meshes:
                return
            mesh = self._meshes[name]
            distance = self._distance_mm(name)
            if distance is None:
                colours, self._bar.content = np.tile(np.array(_SKIN, float), (len(mesh.vertices), 1)), ""
            else:
                limit = scale_limit_mm(distance[self._outside])
                self._bar.content = panels.colour_bar(limit, self._colours.value)
                colours = scale_colours(distance / limit)
            self._server.scene.add_glb("/head", static_glb(mesh.vertices, mesh.triangles, colours))
            sheet = cv2.imread(str(self._folder / f"{name}.png"))
            if sheet is not None:
                self._sheet.image = sheet[..., ::-1]

    @cached_property
    def _from_scan(self) -> Callable[[Float[np.ndarray, "P 3"]], Float[np.ndarray, "P"]]:
        """Distances of points from the scan, metres; from its points if it is a point cloud."""
        assert self._scan is not None  # otherwise the choice is not offered
        if len(self._scan.triangles):
            surface = ClosestPointQuery(self._scan.vertices, self._scan.triangles)
            return lambda points: surface.closest(points)[0]
        tree = cKDTree(self._scan.vertices)
        return lambda points: np.asarray(tree.query(points)[0])

    def _distance_mm(self, name: str) -> Float[np.ndarray, "V"] | None:
        mesh, kind = self._meshes[name], self._colours.value
        if kind == MOTION:
            earlier = self.stages[max(self.stages.index(name) - 1, 0)]
            return np.linalg.norm(mesh.vertices - self._meshes[earlier].vertices, axis=1) * MM_PER_M
        if kind == TO_SCAN:
            return self._from_scan(mesh.vertices) * MM_PER_M
        return None


@dataclass(frozen=True)
class _Viewpoint:
    """Where a viewer looks at the head from: the capture's world, metres."""

    center: Float[np.ndarray, "3"]  # of the head
    front: Float[np.ndarray, "3"]  # unit vector towards the viewer
    up: Float[np.ndarray, "3"]  # unit vector
    radius: float  # of a ball around the center that contains the cameras

    @classmethod
    def of(cls, cameras: Sequence[Camera], center: Float[np.ndarray, "3"]) -> "_Viewpoint":
        """Return the mean direction of the cameras from the head, with their mean up direction."""
        offsets = np.array([camera.centre for camera in cameras]) - center
        distances = np.linalg.norm(offsets, axis=1)
        front = (offsets / np.maximum(distances, 1e-9)[:, None]).mean(0)
        up = -np.mean([camera.T_cam_world[1, :3] for camera in cameras], axis=0)
        front, up = (axis / max(np.linalg.norm(axis), 1e-9) for axis in (front, up))
        return cls(center, front, up, float(distances.max()) + _FRUSTUM_M)
