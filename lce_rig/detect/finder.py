"""Detection of a profile's board in images and scans, with the profile's limits.

All parts of the program detect boards here, live and offline, so that they agree.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

from lce_rig.core.camera import Intrinsics
from lce_rig.core.data import Image, Scan
from lce_rig.core.findings import Refusal
from lce_rig.core.geometry import Array
from lce_rig.core.results import ImageBoard, LidarBoard
from lce_rig.detect.image.search import find_image_board
from lce_rig.detect.lidar.measurement import Beam
from lce_rig.detect.lidar.search import Limits, find_lidar_boards, look_for_board
from lce_rig.detect.lidar.unstructured import find_unstructured_boards, look_for_unstructured_board
from lce_rig.detect.limits_met import gate_image_board, gate_lidar_boards
from lce_rig.rig import Rig

Boards = TypeVar("Boards", ImageBoard, list[LidarBoard])


@dataclass(frozen=True, eq=False)
class Search(Generic[Boards]):
    """The result of a search in one image or scan.

    Attributes:
        located: the board in an image, or the surfaces of its size in a scan, likeliest first, which can be
            followed into the next one; or why there are none.
        usable: what of them the profile's limits admit; else why they do not.
    """

    located: Boards | Refusal
    usable: Boards | Refusal


class BoardFinder:
    """Finds the board of one rig.

    Attributes:
        rig: the profile.
        board: its board.
    """

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        self.board = rig.board.to_board()
        self._intrinsics = {name: camera.to_intrinsics() for name, camera in rig.cameras.items()}

    def image(self, image: Image) -> ImageBoard | Refusal:
        """Find the board in one image, of a camera or made from events by others.

        Raises:
            ProfileError: the camera's intrinsics belong to images of another size.
        """
        return self.search_image(image).usable

    def scan(self, scan: Scan) -> list[LidarBoard] | Refusal:
        """Find the surfaces of the board's size in one scan, likeliest first."""
        return self.search_scan(scan).usable

    def search_image(
        self, image: Image, last: ImageBoard | None = None, *, is_thorough: bool = True
    ) -> Search[ImageBoard]:
        """Find the board in one image, near its last place first.

        Args:
            image: of a camera of the rig.
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
        """Find the board's corners by any intrinsics; the profile's limits on boards are not applied.

        Args:
            image: of a camera of the rig.
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
        """Find the surfaces of the board's size in a whole scan."""
        find = find_lidar_boards if self.rig.lidars[scan.sensor].has_rings else find_unstructured_boards
        return self._compared(find(scan, self.board, self._limits(scan.sensor)), scan)

    def follow_scan(self, scan: Scan, last: Sequence[LidarBoard]) -> Search[list[LidarBoard]]:
        """Find surfaces near where they were in the scan before; lost ones are omitted.

        Args:
            scan: the next one of the same LiDAR.
            last: what the search before located, at least one.
        """
        looked = [self._located(scan, previous.T_lidar_board) for previous in last]
        boards = [result for result in looked if isinstance(result, LidarBoard)]
        lost = [result for result in looked if isinstance(result, Refusal)]
        return self._compared(boards or lost[0], scan)

    def look_for(self, scan: Scan, T_lidar_board: Array) -> LidarBoard | Refusal:
        """Find the board in a scan about a predicted pose (4, 4)."""
        located = self._located(scan, T_lidar_board)
        usable = self._compared(located if isinstance(located, Refusal) else [located], scan).usable
        return usable if isinstance(usable, Refusal) else usable[0]

    def _located(self, scan: Scan, T_lidar_board: Array) -> LidarBoard | Refusal:
        look = look_for_board if self.rig.lidars[scan.sensor].has_rings else look_for_unstructured_board
        return look(scan, self.board, T_lidar_board, self._limits(scan.sensor))

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
        return Search(boards, gate_lidar_boards(boards, self.board, self.rig.quality))
