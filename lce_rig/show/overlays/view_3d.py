"""The coloured point cloud and the cameras of a capture in 3D, in a window or as an image, by Open3D."""

import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory, gettempdir
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.calibration import Calibration
from lce_rig.core.camera import Intrinsics
from lce_rig.core.errors import SessionError, SourceError
from lce_rig.core.geometry import Array, invert, pose, transform
from lce_rig.judge.reach import outermost_pixels
from lce_rig.scene.colouring import colour_points
from lce_rig.session import Capture, Session
from lce_rig.session.durable import write_atomically

_WIDTH_PX, _HEIGHT_PX = 1600, 1000
_HINT = "Install OpenGL and EGL (`apt install libgl1 libegl1`), or run on a computer with a display."
_PICTURES = (".png", ".jpg", ".jpeg")
_NEXT, _PREVIOUS = ord("N"), ord("P")


@dataclass(frozen=True, eq=False)
class CaptureIn3D:
    """The points of one capture, frame lidar.

    Attributes:
        name: name of the capture.
        points: (N, 3) m.
        colours: (N, 3) RGB.
        is_seen: (N,) whether a camera gave the colour.
    """

    name: str
    points: NDArray[np.float32]
    colours: NDArray[np.uint8]
    is_seen: NDArray[np.bool_]

    @classmethod
    def of(cls, session: Session, capture: Capture, calibrations: Sequence[Calibration]) -> "CaptureIn3D":
        """Colour the points of a capture; of several cameras, the first that sees a point gives its colour.

        Raises:
            SessionError: the capture is damaged, or has no scan of the LiDAR.
        """
        lidar = calibrations[0].lidar
        if lidar not in capture.lidars:
            raise SessionError(f"capture {capture.name} has no scan of {lidar}", "Choose another capture.")
        scan = session.scan(capture, lidar)
        colours, is_seen = np.zeros((len(scan.points), 3), np.uint8), np.zeros(len(scan.points), bool)
        for c in calibrations:
            for channel in c.channels:
                if capture.has_image(c.camera, channel):
                    pixels = capture.image(c.camera, channel).pixels
                    own, is_own = colour_points(scan, pixels, c.T_cam_lidar, session.rig.lens_of(c))
                    colours[is_own & ~is_seen] = own[is_own & ~is_seen]
                    is_seen |= is_own
        is_finite = np.isfinite(scan.points).all(axis=1)
        points = scan.points[is_finite].astype(np.float32)
        return cls(capture.name, points, colours[is_finite], is_seen[is_finite])


@dataclass(frozen=True, eq=False)
class CameraIn3D:
    """A camera: its lens and T_cam_lidar (4, 4)."""

    lens: Intrinsics
    T_cam_lidar: Array

    def frustum(self) -> tuple[Array, NDArray[np.int32]]:
        """Return the camera and its view's corners at 0.5 m (5, 3), frame lidar, and the lines (8, 2)."""
        rays = self.lens.unproject(outermost_pixels(self.lens))
        corners = np.concatenate([np.zeros((1, 3)), 0.5 * rays])
        edges = [(0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (2, 4), (4, 3), (3, 1)]
        return transform(invert(self.T_cam_lidar), corners), np.array(edges, np.int32)


def show_window(captures: Sequence[CaptureIn3D], cameras: Sequence[CameraIn3D], first: int = 0) -> None:
    """Open a window with a capture; N and P change to the next and the previous one. Returns when it closes.

    Raises:
        SourceError: the computer has no display, or no window can be opened.
    """
    if sys.platform.startswith("linux") and not (
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    ):
        raise SourceError(
            "there is no display for a window",
            "Write an image instead: `lce-rig view SESSION --output view.png`",
        )
    o3d = _open3d()
    window = _opened(o3d.visualization.VisualizerWithKeyCallback(), is_visible=True)
    at = first
    cloud = _cloud(o3d, captures[at])

    def change(step: int) -> bool:
        nonlocal at
        at = (at + step) % len(captures)
        other = _cloud(o3d, captures[at])
        cloud.points, cloud.colors = other.points, other.colors
        window.update_geometry(cloud)
        return True

    _fill(o3d, window, cloud, cameras)
    window.register_key_callback(_NEXT, lambda _: change(1))
    window.register_key_callback(_PREVIOUS, lambda _: change(-1))
    window.run()
    window.destroy_window()


def draw_picture(path: Path, capture: CaptureIn3D, cameras: Sequence[CameraIn3D]) -> None:
    """Render the capture in 3D to a PNG or JPEG file; the suffix selects the format.

    Raises:
        SourceError: rendering is not possible on this computer, or the suffix is not supported.
        SessionError: the file cannot be written.
    """
    if path.suffix.lower() not in _PICTURES:
        raise SourceError(f"{path} is not an image file name", "Name a PNG or JPEG file.")
    o3d = _open3d()
    window = _opened(o3d.visualization.Visualizer(), is_visible=False)
    _fill(o3d, window, _cloud(o3d, capture), cameras)
    window.poll_events()
    window.update_renderer()
    with TemporaryDirectory(prefix="lce-rig-") as folder:
        drawn = Path(folder) / f"view{path.suffix.lower()}"
        window.capture_screen_image(str(drawn), do_render=True)
        window.destroy_window()
        if not drawn.exists():
            raise SourceError("Open3D did not write an image", _HINT)
        write_atomically(path, drawn.read_bytes())


def _open3d() -> Any:
    # Without a desktop, a graphics library complains if this variable is not set.
    os.environ.setdefault("XDG_RUNTIME_DIR", gettempdir())
    try:
        import open3d
    except (ImportError, OSError) as error:
        raise SourceError(f"Open3D cannot be loaded: {error}", _HINT) from error
    open3d.utility.set_verbosity_level(open3d.utility.VerbosityLevel.Error)
    return open3d


def _opened(window: Any, *, is_visible: bool) -> Any:
    if not window.create_window("lce-rig view", _WIDTH_PX, _HEIGHT_PX, visible=is_visible):
        raise SourceError("Open3D cannot open a window", _HINT)
    return window


def _cloud(o3d: Any, capture: CaptureIn3D) -> Any:
    colours = np.where(capture.is_seen[:, None], capture.colours / 255, (0.45, 0.47, 0.5))
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(capture.points.astype(np.float64)))
    cloud.colors = o3d.utility.Vector3dVector(colours)
    return cloud


def _fill(o3d: Any, window: Any, cloud: Any, cameras: Sequence[CameraIn3D]) -> None:
    """Add point cloud, axes of the LiDAR and frusta, and look from behind the first camera."""
    window.add_geometry(cloud)
    window.add_geometry(o3d.geometry.TriangleMesh.create_coordinate_frame(0.2))
    for camera in cameras:
        corners, edges = camera.frustum()
        lines = o3d.geometry.LineSet(o3d.utility.Vector3dVector(corners), o3d.utility.Vector2iVector(edges))
        lines.paint_uniform_color((1.0, 0.7, 0.1))
        window.add_geometry(lines)
    options = window.get_render_option()
    options.background_color, options.point_size = np.array([0.06, 0.07, 0.08]), 4.0
    _look_from_behind(o3d, window, invert(cameras[0].T_cam_lidar))


def _look_from_behind(o3d: Any, window: Any, T_lidar_cam: Array) -> None:
    """Place the viewpoint behind and above a camera, at a fixed distance, m: point clouds may reach far."""
    forward, up = T_lidar_cam[:3, 2], np.array([0.0, 0.0, 1.0])
    eye = T_lidar_cam[:3, 3] - 1.6 * forward + 0.8 * up
    z = T_lidar_cam[:3, 3] + 2.0 * forward - eye
    z /= np.linalg.norm(z)
    x = np.cross(z, up) if abs(z @ up) < 0.99 else T_lidar_cam[:3, 0]
    x /= np.linalg.norm(x)
    view = window.get_view_control()
    # By default the view is clipped to the point cloud's size.
    view.set_constant_z_near(0.05)
    view.set_constant_z_far(300.0)
    parameters = view.convert_to_pinhole_camera_parameters()
    parameters.extrinsic = invert(pose(np.stack([x, np.cross(z, x), z], axis=1), eye))
    view.convert_from_pinhole_camera_parameters(parameters, allow_arbitrary=True)
