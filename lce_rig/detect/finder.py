"""Detection of a profile's board in images and scans, with the profile's limits.

All parts of the program detect boards here, live and offline, so that they agree. The profile's range offset
is subtracted from scans first.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Generic, Literal, TypeVar

import numpy as np

from lce_rig.core.board import Board
from lce_rig.core.camera import Intrinsics
from lce_rig.core.data import NO_RING, Image, Scan
from lce_rig.core.findings import Refusal
from lce_rig.core.geometry import Array
from lce_rig.core.results import ImageBoard, LidarBoard
from lce_rig.core.ring_apex import MAX_APEX_M, find_apex
from lce_rig.detect.findings import (
    IMAGE_NEAR_BORDER,
    IMAGE_SMALL_SQUARES,
    IMAGE_TILTED,
    LIDAR_OTHER_ORIGIN,
    LIDAR_OTHER_SIZE,
    LIDAR_RAGGED_EDGES,
    LIDAR_TOO_FEW_POINTS,
    TOO_NEAR_OR_FAR,
)
from lce_rig.detect.image.search import find_image_board
from lce_rig.detect.lidar.measurement import Beam
from lce_rig.detect.lidar.search import Limits, find_lidar_boards, look_for_board
from lce_rig.detect.lidar.unstructured import find_unstructured_boards, look_for_unstructured_board
from lce_rig.rig import QualitySettings, Rig

Boards = TypeVar("Boards", ImageBoard, list[LidarBoard])


@dataclass(frozen=True, eq=False)
class Search(Generic[Boards]):
    """The result of a search in one image or scan.

    Attributes:
        located: the board in an image, or the surfaces of its size in a scan, likeliest first, for tracking
            into the next sample; or the refusal.
        usable: boards within the profile's limits, or the refusal.
    """

    located: Boards | Refusal
    usable: Boards | Refusal


class BoardFinder:
    """Finds the board of one rig.

    Attributes:
        rig: the profile.
        board: the board to find.
    """

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        self.board = rig.board.to_board()
        self._intrinsics = {name: camera.to_intrinsics() for name, camera in rig.cameras.items()}

    def image(self, image: Image) -> ImageBoard | Refusal:
        """Find the board in one image from a camera, or reconstructed by another program.

        Raises:
            ProfileError: the camera's intrinsics belong to images of another size.
        """
        return self.search_image(image).usable

    def scan(self, scan: Scan) -> list[LidarBoard] | Refusal:
        """Find surfaces of the board's size in one scan, likeliest first."""
        return self.search_scan(scan).usable

    def search_image(
        self, image: Image, last: ImageBoard | None = None, *, is_thorough: bool = True
    ) -> Search[ImageBoard]:
        """Find the board in one image, starting near its last position.

        Args:
            image: image of a camera of the rig.
            last: the board in the image before.
            is_thorough: see `find_image_board`.

        Raises:
            ProfileError: the camera's intrinsics belong to images of another size.
        """
        found = self.corners(image, self._intrinsics[image.sensor], last, is_thorough=is_thorough)
        if isinstance(found, Refusal):
            return Search(found, found)
        found = replace(found, stamp_ns=image.stamp_ns)
        return Search(found, gate_image_board(found, self.rig.quality))

    def corners(
        self,
        image: Image,
        intrinsics: Intrinsics,
        last: ImageBoard | None = None,
        *,
        max_reprojection_px: float | None = None,
        is_thorough: bool = True,
    ) -> ImageBoard | Refusal:
        """Find the board's corners for any intrinsics, without checking the profile's limits for captures.

        Args:
            image: image of a camera of the rig.
            intrinsics: at the image's size.
            last: the board in the image before.
            max_reprojection_px: replaces the profile's.
            is_thorough: see `find_image_board`.

        Raises:
            ProfileError: the intrinsics belong to images of another size.
        """
        limits = self.rig.quality
        if max_reprojection_px is not None:
            limits = limits.model_copy(update={"max_reprojection_px": max_reprojection_px})
        channel = self.rig.cameras[image.sensor].channels.get(image.channel)
        is_from_events = channel is not None and channel.kind == "events"
        return find_image_board(
            image,
            self.board,
            intrinsics,
            last=last,
            limits=limits,
            is_from_events=is_from_events,
            is_thorough=is_thorough or is_from_events,
        )

    def search_scan(self, scan: Scan) -> Search[list[LidarBoard]]:
        """Find surfaces of the board's size in a whole scan; refuse scans in another frame."""
        moved = check_origin(scan)
        if moved is not None:
            return Search(moved, moved)
        scan = self.rig.corrected(scan)
        find = find_lidar_boards if self.rig.lidars[scan.sensor].has_rings else find_unstructured_boards
        return self._compared(find(scan, self.board, self._limits(scan.sensor)), scan)

    def look_in_scan(self, scan: Scan, poses: Sequence[Array]) -> Search[list[LidarBoard]]:
        """Find surfaces near poses T_lidar_board (4, 4) from the previous scan or predicted.

        Args:
            scan: scan of a LiDAR of the rig.
            poses: at least one pose; the result omits those where nothing is found.
        """
        scan = self.rig.corrected(scan)
        look = look_for_board if self.rig.lidars[scan.sensor].has_rings else look_for_unstructured_board
        looked = [look(scan, self.board, pose, self._limits(scan.sensor)) for pose in poses]
        boards = [result for result in looked if isinstance(result, LidarBoard)]
        missing = [result for result in looked if isinstance(result, Refusal)]
        return self._compared(boards or missing[0], scan)

    def _limits(self, sensor: str) -> Limits:
        lidar, quality = self.rig.lidars[sensor], self.rig.quality
        sheet = lidar.data_sheet()
        upright_rad = None if sheet is None or sheet.has_rings else sheet.divergence_rad[1]
        return Limits(
            rms_m=quality.max_thickness_m,
            min_rings=quality.min_rings,
            min_range_m=lidar.min_range_m,
            max_range_m=min(lidar.max_range_m, quality.max_distance_m),
            beam=Beam(lidar.beam_aperture_m, lidar.beam_divergence_rad, upright_rad),
        )

    def _compared(self, found: list[LidarBoard] | Refusal, scan: Scan) -> Search[list[LidarBoard]]:
        if isinstance(found, Refusal):
            return Search(found, found)
        boards = [replace(board, stamp_ns=scan.stamp_ns) for board in found]
        problems = [_lidar_problem(board, self.board, self.rig.quality) for board in boards]
        kept = [board for board, problem in zip(boards, problems, strict=True) if problem is None]
        return Search(boards, kept or problems[0] or [])


def check_origin(scan: Scan) -> Refusal | None:
    """Refuse a scan whose rings meet far from the frame's origin: it was transformed to another frame.

    Beams are assumed to begin at the origin; otherwise ring ends and ranges are wrong at every distance.
    """
    if not np.any(scan.ring != NO_RING):
        return None
    apex = find_apex(scan.points, scan.ring)
    if apex is None or not apex.is_beyond(MAX_APEX_M):
        return None
    x_m, y_m, z_m = (np.round(apex.position_m, 2) + 0.0).tolist()  # rounded to 1 cm, so that scans agree
    return LIDAR_OTHER_ORIGIN.refusal(x_m=x_m, y_m=y_m, z_m=z_m, limit_m=MAX_APEX_M)


def gate_image_board(sighting: ImageBoard, limits: QualitySettings) -> ImageBoard | Refusal:
    """Compare a board detected in an image with the profile's limits.

    Args:
        sighting: the board; without quality figures it is judged by its pose alone.
        limits: `quality` of the rig profile.
    """
    q = sighting.quality
    if q is not None and q.square_px < limits.min_square_px:
        closer_m = sighting.distance_m * (1 - q.square_px / limits.min_square_px)
        figures = {"square_px": q.square_px, "min_square_px": limits.min_square_px, "closer_m": closer_m}
        return IMAGE_SMALL_SQUARES.refusal(**figures)
    if q is not None and q.border_px < limits.min_border_px:
        return IMAGE_NEAR_BORDER.refusal(border_px=q.border_px, min_border_px=limits.min_border_px)
    if sighting.tilt_deg > limits.max_tilt_deg:
        turn_deg = sighting.tilt_deg - limits.max_tilt_deg + 5
        figures = {"tilt_deg": sighting.tilt_deg, "max_tilt_deg": limits.max_tilt_deg, "turn_deg": turn_deg}
        return IMAGE_TILTED.refusal(**figures)
    return _gate_distance("image", sighting.distance_m, limits) or sighting


def _lidar_problem(candidate: LidarBoard, board: Board, limits: QualitySettings) -> Refusal | None:
    q = candidate.quality
    if q.n_points < limits.min_points:
        closer_m = max(0.1, q.distance_m * (1 - (q.n_points / limits.min_points) ** 0.5))
        return LIDAR_TOO_FEW_POINTS.refusal(
            n_points=q.n_points, min_points=limits.min_points, closer_m=closer_m
        )
    for side, wanted_m, measured_m, sigma_m in (
        ("width", board.width_m, q.width_m, q.width_sigma_m),
        ("height", board.height_m, q.height_m, q.height_sigma_m),
    ):
        excess = abs(measured_m - wanted_m) - 3 * sigma_m - limits.max_size_error * wanted_m
        if excess > 0:
            return LIDAR_OTHER_SIZE.refusal(
                side=side, measured_m=measured_m, sigma_m=sigma_m, profile_m=wanted_m
            )
    if q.edge_rms_m > limits.max_edge_rms_m:
        return LIDAR_RAGGED_EDGES.refusal(rms_m=q.edge_rms_m, max_rms_m=limits.max_edge_rms_m)
    return _gate_distance("lidar", q.distance_m, limits)


def _gate_distance(
    stage: Literal["image", "lidar"], distance_m: float, limits: QualitySettings
) -> Refusal | None:
    """Refuse a board that is too near or too far."""
    low_m, high_m = limits.min_distance_m, limits.max_distance_m
    near, far = TOO_NEAR_OR_FAR[stage]
    if distance_m < low_m:
        move_m = low_m - distance_m + 0.05
        return near.refusal(distance_m=distance_m, min_distance_m=low_m, move_m=move_m)
    if distance_m > high_m:
        move_m = distance_m - high_m + 0.05
        return far.refusal(distance_m=distance_m, max_distance_m=high_m, move_m=move_m)
    return None
