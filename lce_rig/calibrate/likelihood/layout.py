"""Layout of the unknowns: the name of each, and its place in every vector, matrix and row of the likelihood.

The unknowns of each capture are y = [pose, own_shift]: the tangent of T_lidar_board, and what the capture
adds to the shift of ring ends. All captures share

    z = [camera 0, scale 0, camera 1, scale 1, ..., range, azimuth, elevation, lens, bow, shifts]

with camera the tangent of T_cam_lidar and scale the relative error of the camera's distances, positive for
too short; range, azimuth and elevation the errors of each laser. A row of the normal equations is
[y, z, residual].

A further constant error is an entry here, its derivative in the rows of `rays` or `images`, and a standard
deviation in `levels.Priors`.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.geometry import Array, perturb

Indices = NDArray[np.intp]
LASER = ("range", "azimuth", "elevation")
"""Constant errors of each laser, in m and rad."""
SHIFTS = ("d_0", "c", "d_1", "d_2", "d_3", "p", "along azimuth", "upwards", "beam's width", "beam's height")
"""Unknowns of ring ends: equation (3) of `rays`, the plate's shape, the displacement of ring ends, and
relative errors of a beam's two widths."""
_FIELDS = {"lens": 2, "bow": 2}
_OWN = {"pose": 6, "own_shift": 1}


class Columns:
    """Names of consecutive columns.

    Args:
        sizes: number of columns by name, in order.
    """

    def __init__(self, sizes: Mapping[str, int]) -> None:
        ends = np.cumsum(list(sizes.values())).tolist()
        self.size: int = ends[-1]
        self._slices = {name: slice(end - sizes[name], end) for name, end in zip(sizes, ends, strict=True)}

    def __iter__(self) -> Iterator[str]:
        return iter(self._slices)

    def __getitem__(self, name: str) -> slice:
        return self._slices[name]

    def span(self, first: str, last: str) -> slice:
        """Return the columns from one name to another."""
        return slice(self._slices[first].start, self._slices[last].stop)

    def of(self, names: Iterable[str]) -> Indices:
        """List the columns of several names, in their order."""
        slices = [self._slices[name] for name in names]
        return np.array([k for part in slices for k in range(part.start, part.stop)], dtype=np.intp)


_OF_LASER = dict.fromkeys(LASER, 1)
RING = Columns({"pose": 6, **_OF_LASER, **_FIELDS, "residual": 1})
"""Row of a return."""
END = Columns({"pose": 6, **_OF_LASER, **_FIELDS, "shifts": len(SHIFTS), "own_shift": 1, "residual": 1})
"""Row of a ring end."""
IMAGE = Columns({"camera": 6, "pose": 6, "scale": 1, "residual": 1})
"""Row of a board's pose in an image."""
OWN = Columns(_OWN)
"""Unknowns y of a capture."""


class Layout:
    """Places of the unknowns of C cameras and L rings.

    Args:
        n_cameras: C.
        n_rings: L.

    Attributes:
        z: places in the vector of the unknowns that captures share.
        row: places in a row [y, z, residual].
    """

    def __init__(self, n_cameras: int, n_rings: int) -> None:
        self.n_cameras, self.n_rings = n_cameras, n_rings
        common: dict[str, int] = {}
        for c in range(n_cameras):
            common |= {f"camera {c}": 6, f"scale {c}": 1}
        common |= {**dict.fromkeys(LASER, n_rings), **_FIELDS, "shifts": len(SHIFTS)}
        self.z = Columns(common)
        self.row = Columns({**_OWN, **common, "residual": 1})

    def camera(self, c: int) -> Indices:
        """Places in z of a camera's tangent (6,)."""
        return self.z.of([f"camera {c}"])

    @property
    def cameras(self) -> Indices:
        """Places in z of all cameras' tangents (C, 6)."""
        return np.array([self.camera(c) for c in range(self.n_cameras)], dtype=np.intp).reshape(-1, 6)

    @property
    def scales(self) -> Indices:
        """Places in z of the cameras' scales (C,)."""
        return self.z.of([f"scale {c}" for c in range(self.n_cameras)])

    @property
    def lasers(self) -> Indices:
        """Places in z of the lasers' errors (3, L), in the order of `LASER`."""
        return self.z.of(LASER).reshape(len(LASER), -1)

    @property
    def fields(self) -> Indices:
        """Places in z of lens and bow (4,)."""
        return self.z.of(_FIELDS)

    def image_row(self, c: int) -> Indices:
        """Places in a row of the columns of `IMAGE` for a camera."""
        return self.row.of(f"{name} {c}" if name in ("camera", "scale") else name for name in IMAGE)


@dataclass(frozen=True, eq=False)
class State:
    """Values of all unknowns.

    Attributes:
        layout: their places.
        T_cam_lidar: (C, 4, 4).
        T_lidar_board: (F, 4, 4).
        own_shift_m: (F,) shift of each capture's ring ends beyond that of all, like `SHIFTS`' d_0.
        z: (G,), zero in the places of the tangents.
    """

    layout: Layout
    T_cam_lidar: Array
    T_lidar_board: Array
    own_shift_m: Array
    z: Array

    @classmethod
    def without_errors(cls, T_cam_lidar: Array, T_lidar_board: Array, n_rings: int) -> "State":
        """Start with constant errors of zero."""
        layout = Layout(len(T_cam_lidar), n_rings)
        return cls(layout, T_cam_lidar, T_lidar_board, np.zeros(len(T_lidar_board)), np.zeros(layout.z.size))

    @property
    def lasers(self) -> Array:
        """(3, L) errors of each ring, in the order of `LASER`; positive for ranges too long."""
        return self.z[self.layout.lasers]

    @property
    def fields(self) -> Array:
        """(4,) displacement of the LiDAR's lens, and bow of the plate along its width and height."""
        return self.z[self.layout.fields]

    @property
    def shifts(self) -> Array:
        """(10,) of ring ends, `SHIFTS`."""
        return self.z[self.layout.z["shifts"]]

    @property
    def scale(self) -> Array:
        """(C,) relative error of each camera's distances, positive for too short."""
        return self.z[self.layout.scales]

    def moved(self, z: Array, y: Array) -> "State":
        """Apply a step z (G,) and y (F, 7)."""
        moved, cameras = self.z + z, self.layout.cameras
        moved[cameras] = 0
        return State(
            self.layout,
            perturb(self.T_cam_lidar, z[cameras]),
            perturb(self.T_lidar_board, y[:, OWN["pose"]]),
            self.own_shift_m + y[:, OWN["own_shift"]][:, 0],
            moved,
        )
