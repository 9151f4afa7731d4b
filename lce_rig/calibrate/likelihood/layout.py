"""Layout of the unknowns: their names and indices in all vectors, matrices and rows of the likelihood.

The unknowns of each capture are y = [pose, own_shift]: the tangent of T_lidar_board, and the capture's own
shift of ring ends. All captures share

    z = [camera 0, ..., range, azimuth, elevation, lens, bow, stretch, contrast, shifts, squares, pattern,
         optics 0, ...]

with camera the tangent of T_cam_lidar; range, azimuth and elevation the errors of each laser; lens, bow,
stretch and contrast the displacements of `rays`; squares the relative error of the squares' size, positive
for squares that are larger than the profile's; pattern the displacement of the pattern's centre on the plate,
to the right and up, m; optics the errors of a camera's lens, in independent directions of unit variance. A
row of the normal equations is [y, z, residual].

A further constant error is an entry here, its derivative in the rows of `rays` or `images`, and a standard
deviation in `levels.Priors`.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.geometry import Array, perturb

Indices = NDArray[np.intp]
LASER = ("range", "azimuth", "elevation")
"""Constant errors of each laser, in m and rad."""
_OF_WIDTH = ("d_0", "c", "d_1", "d_2", "d_3")
_OF_ENDS = ("along azimuth", "upwards", "beam's width", "beam's height")
SHIFTS = (*_OF_WIDTH, "width", "height", *_OF_ENDS)
"""Unknowns of ring ends: equation (3) of `rays`, errors of the plate's width and height, the displacement of
ring ends, and relative errors of a beam's two widths."""
PLATE = slice(len(_OF_WIDTH), len(_OF_WIDTH) + 2)
"""Places of the plate's width and height in `SHIFTS`."""
_FIELDS = {"lens": 2, "bow": 2, "stretch": 1, "contrast": 1}
BOARD = {"squares": 1, "pattern": 2}
"""Errors of the print, in images."""
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


FIELDS = Columns(_FIELDS)
"""Places in `State.fields`."""
_OF_LASER = dict.fromkeys(LASER, 1)
RING = Columns({"pose": 6, **_OF_LASER, **_FIELDS, "residual": 1})
"""Row of a return."""
END = Columns({"pose": 6, **_OF_LASER, **_FIELDS, "shifts": len(SHIFTS), "own_shift": 1, "residual": 1})
"""Row of a ring end."""
OWN = Columns(_OWN)
"""Unknowns y of a capture."""


def image_columns(n_optics: int) -> Columns:
    """Name the columns of an image's row: a board's pose for a camera with n unknown lens parameters."""
    return Columns({"camera": 6, "pose": 6, **BOARD, "optics": n_optics, "residual": 1})


class Layout:
    """Indices of the unknowns of C cameras and L rings.

    Args:
        n_optics: number of unknowns of each lens.
        n_rings: L.
        lens_of: lens index of each camera; by default each has its own. A camera that moved counts as two.
        base: without a LiDAR, the camera in whose frame the boards' poses are expressed.

    Attributes:
        z: indices in the vector of the unknowns shared by all captures.
        row: indices in a row [y, z, residual].
    """

    def __init__(
        self,
        n_optics: Sequence[int],
        n_rings: int,
        lens_of: Sequence[int] | None = None,
        base: int | None = None,
    ) -> None:
        self._lens_of = range(len(n_optics)) if lens_of is None else lens_of
        self.base = base
        self.n_cameras, self.n_rings = len(self._lens_of), n_rings
        common = {f"camera {c}": 6 for c in range(self.n_cameras)}
        common |= {**dict.fromkeys(LASER, n_rings), **_FIELDS, "shifts": len(SHIFTS)}
        if n_optics:
            common |= BOARD
        common |= {f"optics {c}": n for c, n in enumerate(n_optics)}
        self.z = Columns(common)
        self.row = Columns({**_OWN, **common, "residual": 1})

    def camera(self, c: int) -> Indices:
        """Indices in z of a camera's tangent (6,)."""
        return self.z.of([f"camera {c}"])

    @property
    def cameras(self) -> Indices:
        """Indices in z of all cameras' tangents (C, 6)."""
        return np.array([self.camera(c) for c in range(self.n_cameras)], dtype=np.intp).reshape(-1, 6)

    def errors(self, c: int) -> Indices:
        """Indices in z of the errors that shift the board poses in a camera's images: pattern and lens."""
        return self.z.of([*BOARD, f"optics {self._lens_of[c]}"])

    def optics(self, c: int) -> Indices:
        """Indices in z of the errors of a camera's lens."""
        return self.z.of([f"optics {self._lens_of[c]}"])

    @property
    def plate(self) -> Indices:
        """Indices in z of the errors of the plate's width and height (2,)."""
        return self.z.of(["shifts"])[PLATE]

    @property
    def shape(self) -> Indices:
        """Indices in z of the plate's bow, width and height (4,)."""
        return np.concatenate([self.z.of(["bow"]), self.plate])

    @property
    def lasers(self) -> Indices:
        """Indices in z of the lasers' errors (3, L), in the order of `LASER`."""
        return self.z.of(LASER).reshape(len(LASER), -1)

    @property
    def fields(self) -> Indices:
        """Indices in z of the displacements of points (6,)."""
        return self.z.of(_FIELDS)

    def image_row(self, c: int) -> Indices:
        """Indices in a camera's row of the columns of `image_columns`."""
        return self.row.of([f"camera {c}", "pose", *BOARD, f"optics {self._lens_of[c]}", "residual"])


@dataclass(frozen=True, eq=False)
class State:
    """Values of all unknowns.

    Attributes:
        layout: places of the unknowns.
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
    def without_errors(
        cls,
        T_cam_lidar: Array,
        T_lidar_board: Array,
        n_rings: int,
        n_optics: Sequence[int],
        base: int | None = None,
    ) -> "State":
        """Start with constant errors of zero; `n_optics` and `base` as in `Layout`."""
        layout = Layout(n_optics, n_rings, base=base)
        return cls(layout, T_cam_lidar, T_lidar_board, np.zeros(len(T_lidar_board)), np.zeros(layout.z.size))

    @property
    def lasers(self) -> Array:
        """(3, L) errors of each ring, in the order of `LASER`; positive for ranges too long."""
        return self.z[self.layout.lasers]

    @property
    def fields(self) -> Array:
        """(6,) displacement of the LiDAR's lens, bow of the plate along its width and height, relative error
        of ranges, and their error by the pattern's contrast."""
        return self.z[self.layout.fields]

    @property
    def shifts(self) -> Array:
        """(11,) of ring ends, `SHIFTS`."""
        return self.z[self.layout.z["shifts"]]

    @property
    def squares(self) -> float:
        """Relative error of the squares' size, positive if they are larger than the profile states."""
        return float(self.z[self.layout.z["squares"]][0])

    def common_to(self, layout: Layout, rings: NDArray[np.int16], other_rings: NDArray[np.int16]) -> Array:
        """Copy the values of constant errors of LiDAR and board into another layout: z (G,).

        Args:
            layout: the other one.
            rings: (L,) ring numbers of this one.
            other_rings: rings of the other layout.
        """
        z = np.zeros(layout.z.size)
        _, here, there = np.intersect1d(rings, other_rings, return_indices=True)
        z[layout.lasers[:, there]] = self.z[self.layout.lasers[:, here]]
        for name in {*_FIELDS, "shifts", *BOARD} & set(layout.z) & set(self.layout.z):
            z[layout.z[name]] = self.z[self.layout.z[name]]
        return z

    def moved(self, z: Array, y: Array) -> "State":
        """Return the state after a step z (G,) and y (F, 7)."""
        moved, cameras = self.z + z, self.layout.cameras
        moved[cameras] = 0
        return State(
            self.layout,
            perturb(self.T_cam_lidar, z[cameras]),
            perturb(self.T_lidar_board, y[:, OWN["pose"]]),
            self.own_shift_m + y[:, OWN["own_shift"]][:, 0],
            moved,
        )
