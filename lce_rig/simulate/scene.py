"""The scene for ray casting: static meshes, meshes that move with the board, and the board."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.board import Board
from lce_rig.core.geometry import Array, invert, transform
from lce_rig.core.interrupts import without_interrupt
from lce_rig.core.pattern import is_dark
from lce_rig.simulate.surfaces import MATERIALS, Material, Mesh, albedo, rectangle

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

_Rows = TypeVar("_Rows", bound="DataclassInstance")
PLATE, INK, PLATE_BACK = (MATERIALS[name] for name in ("plate", "ink", "plate back"))


@dataclass(frozen=True, eq=False)
class Surface:
    """A mesh of one material, in world coordinates; prints are laid out in the frame T_world_surface."""

    name: str
    mesh: Mesh
    material: Material
    T_world_surface: Array


@dataclass(frozen=True, eq=False)
class Hits:
    """The first hits of rays.

    Attributes:
        range_m: (N,) distance along the unit ray; inf without a hit.
        surface: (N,) int32 index, -1 without a hit.
        normals: (N, 3) unit, towards the side the ray comes from; zero without a hit.
    """

    range_m: Array
    surface: NDArray[np.int32]
    normals: Array

    def select(self, rows: NDArray[np.intp]) -> "Hits":
        """Keep some hits by index."""
        return Hits(self.range_m[rows], self.surface[rows], self.normals[rows])


def put_rows(record: _Rows, rows: NDArray[Any], part: _Rows) -> _Rows:
    """Replace rows of a record of arrays of equal length by those of another."""
    values = {field.name: getattr(record, field.name).copy() for field in fields(record)}
    for name, value in values.items():
        value[rows] = getattr(part, name)
    return replace(record, **values)


def join_rows(parts: Sequence[_Rows]) -> _Rows:
    """Join records of arrays, at least one, one behind the other."""
    names = [field.name for field in fields(parts[0])]
    return replace(parts[0], **{name: np.concatenate([getattr(p, name) for p in parts]) for name in names})


class Raycaster:
    """Finds the first hit of rays on a fixed set of surfaces (Embree, float32)."""

    def __init__(self, surfaces: Sequence[Surface]) -> None:
        self.surfaces = tuple(surfaces)
        meshes = [surface.mesh for surface in surfaces]
        self._normals = np.concatenate([mesh.normals for mesh in meshes]) if meshes else np.zeros((0, 3))
        starts = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes])[:-1]
        corners = [mesh.triangles.astype(np.int64) + s for mesh, s in zip(meshes, starts, strict=True)]
        self._triangles = np.concatenate(corners) if meshes else np.zeros((0, 3), dtype=np.int64)
        self._first_triangle = np.cumsum([0] + [len(mesh.triangles) for mesh in meshes])[:-1]

    @cached_property
    def _engine(self) -> Any:
        with without_interrupt():
            import open3d as o3d

        engine = o3d.t.geometry.RaycastingScene(nthreads=1)
        for surface in self.surfaces:
            engine.add_triangles(
                o3d.core.Tensor.from_numpy(surface.mesh.vertices.astype(np.float32)),
                o3d.core.Tensor.from_numpy(surface.mesh.triangles),
            )
        return engine

    @staticmethod
    def _rays(origins: Array, directions: Array) -> Any:
        import open3d as o3d

        rays = np.empty((len(directions), 6), dtype=np.float32)
        rays[:, :3], rays[:, 3:] = origins, directions
        return o3d.core.Tensor.from_numpy(rays)

    def cast(self, origins: Array, directions: Array, *, with_normals: bool = True) -> Hits:
        """Find the first surface along each ray.

        Args:
            origins: (N, 3) or (3,) m, world.
            directions: (N, 3) unit, world.
            with_normals: False leaves the normals zero and halves the time.
        """
        if not self.surfaces:
            n = len(directions)
            return Hits(np.full(n, np.inf), np.full(n, -1, dtype=np.int32), np.zeros((n, 3)))
        answer = self._engine.cast_rays(self._rays(origins, directions), nthreads=1)
        range_m = answer["t_hit"].numpy().astype(np.float64)
        hit = np.flatnonzero(np.isfinite(range_m))
        surface = np.full(len(directions), -1, dtype=np.int32)
        surface[hit] = answer["geometry_ids"].numpy()[hit]
        if not with_normals:
            return Hits(range_m, surface, np.zeros((len(directions), 3)))
        triangle = self._first_triangle[surface[hit]] + answer["primitive_ids"].numpy()[hit]
        u, v = (column[:, None] for column in answer["primitive_uvs"].numpy()[hit].astype(np.float64).T)
        first, second, third = (self._normals[corner] for corner in self._triangles[triangle].T)
        normals = np.zeros((len(directions), 3))
        mixed = (1 - u - v) * first + u * second + v * third
        length = np.sqrt(np.einsum("nc,nc->n", mixed, mixed))
        side = np.where(np.einsum("nc,nc->n", mixed, directions[hit]) > 0, -1.0, 1.0)
        normals[hit] = mixed * (side / np.maximum(length, 1e-12))[:, None]
        return Hits(range_m, surface, normals)

    def is_blocked(self, origins: Array, targets: Array) -> NDArray[np.bool_]:
        """Find which straight lines from origins (N, 3) to targets (N, 3) or (3,) meet a surface."""
        if not self.surfaces:
            return np.zeros(len(origins), dtype=np.bool_)
        rays = self._rays(origins, targets - origins)
        blocked = self._engine.test_occlusions(rays, tnear=1e-3, tfar=0.999, nthreads=1)
        return np.asarray(blocked.numpy(), dtype=np.bool_)


class Scene:
    """The scene of one capture.

    Args:
        static: surfaces that stand still over a session.
        moving: surfaces of the board's carrier, which stand elsewhere in each capture.
        board: the board.
        T_world_board: (4, 4).
        print_reflectivity: reflectivity of the dark squares at 905 nm; the ink of LCE-Calib's boards is
            bright there.

    Surfaces are numbered static, then moving, then the board (`board_index`).
    """

    def __init__(
        self,
        static: Raycaster,
        moving: Sequence[Surface],
        board: Board,
        T_world_board: Array,
        print_reflectivity: float = INK.reflectivity,
    ) -> None:
        self.static = static
        self.moving = Raycaster(moving)
        self.board = board
        self.T_world_board = T_world_board
        self.print_reflectivity = print_reflectivity
        self.board_index = len(static.surfaces) + len(moving)
        self.surfaces = (*static.surfaces, *moving)

    def with_board_at(self, T_world_board: Array) -> "Scene":
        """Build the same scene with the board at another pose (4, 4); its carrier stays."""
        moved = Scene(self.static, (), self.board, T_world_board, self.print_reflectivity)
        moved.moving, moved.board_index, moved.surfaces = self.moving, self.board_index, self.surfaces
        return moved

    @cached_property
    def occluders(self) -> Raycaster:
        """The moving surfaces and the board, as occluders of light."""
        plate = rectangle(self.board.width_m, self.board.height_m).moved(self.T_world_board)
        return Raycaster([*self.moving.surfaces, Surface("board", plate, PLATE, self.T_world_board)])

    def cast(self, origins: Array, directions: Array, *, with_normals: bool = True) -> Hits:
        """Find the first hit of each ray; hits of the board are computed analytically, in float64."""
        hits = self.static.cast(origins, directions, with_normals=with_normals)
        return self._nearer(hits, self.cast_moving(origins, directions, with_normals=with_normals))

    def cast_moving(self, origins: Array, directions: Array, *, with_normals: bool = True) -> Hits:
        """Find each ray's first hit of carrier or board, ignoring the static surfaces."""
        hits = self.cast_board(origins, directions)
        if not self.moving.surfaces:
            return hits
        carrier = self.moving.cast(origins, directions, with_normals=with_normals)
        shift = np.where(carrier.surface >= 0, len(self.static.surfaces), 0).astype(np.int32)
        return self._nearer(Hits(carrier.range_m, carrier.surface + shift, carrier.normals), hits)

    def cast_board(self, origins: Array, directions: Array) -> Hits:
        """Intersect rays with the board's rectangle: p_z + s u_z = 0 in frame board."""
        # One axis at a time: three times as fast as a product with the whole rotation.
        axes, centre = self.T_world_board[:3, :3].T, self.T_world_board[:3, 3]
        start_x, start_y, start_z = ((origins - centre) @ axis for axis in axes)
        step_x, step_y, step_z = (directions @ axis for axis in axes)
        with np.errstate(divide="ignore", invalid="ignore"):
            range_m = -start_z / step_z
            is_hit = range_m > 1e-6
            is_hit &= np.abs(start_x + range_m * step_x) <= self.board.width_m / 2
            is_hit &= np.abs(start_y + range_m * step_y) <= self.board.height_m / 2
        normals = np.zeros((len(directions), 3))
        normals[is_hit] = -np.sign(step_z[is_hit])[:, None] * axes[2]
        return Hits(
            np.where(is_hit, range_m, np.inf),
            np.where(is_hit, self.board_index, -1).astype(np.int32),
            normals,
        )

    @staticmethod
    def _nearer(one: Hits, other: Hits) -> Hits:
        nearer = np.flatnonzero(other.range_m < one.range_m)
        return put_rows(one, nearer, other.select(nearer))

    def is_dark(self, points_world: Array) -> NDArray[np.bool_]:
        """Find which points (N, 3), taken straight onto the board, lie on a dark square."""
        from_centre = points_world - self.T_world_board[:3, 3]
        xy = np.stack([from_centre @ self.T_world_board[:3, k] for k in (0, 1)], axis=1)
        return is_dark(self.board, xy)

    def is_front(self, normals: Array) -> NDArray[np.bool_]:
        """Find which normals (N, 3) of hits on the board belong to its printed side."""
        return np.asarray(normals @ self.T_world_board[:3, 2] > 0)

    def reflectivity(self, hits: Hits, points_world: Array) -> Array:
        """Evaluate the reflectivity (N,) at the LiDAR's wavelength; 0 without a hit."""
        values = [surface.material.reflectivity for surface in self.surfaces]
        table = np.array([*values, PLATE.reflectivity, 0.0])
        out = np.asarray(table[hits.surface], dtype=np.float64)
        on_board = np.flatnonzero(hits.surface == self.board_index)
        is_front = self.is_front(hits.normals[on_board])
        out[on_board[~is_front]] = PLATE_BACK.reflectivity
        is_print = is_front & self.is_dark(points_world[on_board])
        out[on_board[is_print]] = self.print_reflectivity
        return out

    def colour(self, hits: Hits, points_world: Array) -> Array:
        """Evaluate the linear albedo (N, 3); 0 without a hit."""
        out = np.zeros((len(points_world), 3))
        for index in np.unique(hits.surface):
            rows = np.flatnonzero(hits.surface == index)
            if index == self.board_index:
                is_print = self.is_dark(points_world[rows])
                out[rows] = np.where(is_print[:, None], INK.colour, PLATE.colour)
                out[rows[~self.is_front(hits.normals[rows])]] = PLATE_BACK.colour
            elif index >= 0:
                out[rows] = surface_colour(self.surfaces[index], points_world[rows], hits.normals[rows])
        return out


def surface_colour(surface: Surface, points_world: Array, normals: Array) -> Array:
    """Evaluate a surface's printed texture (N, 3) at points and normals (N, 3) in world coordinates."""
    T_surface_world = invert(surface.T_world_surface)
    return albedo(
        surface.material, transform(T_surface_world, points_world), normals @ T_surface_world[:3, :3].T
    )
