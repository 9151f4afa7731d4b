"""The board's block of a profile."""

from typing import Annotated, Any

from pydantic import Field, field_validator, model_validator

from lce_rig.core.board import Board, BoardType
from lce_rig.core.pattern import DICTIONARIES, LEAST_CORNERS, n_markers_of
from lce_rig.rig.settings import Deviation, Figure, Settings, problem

# Limits of sizes, m; larger figures are in millimetres.
_Side = Annotated[float, Field(ge=0.005, le=5)]
_LEAST_SQUARE_M = 0.001
_Count = Annotated[int, Field(ge=2, le=100)]
_TagCount = Annotated[int, Field(ge=1, le=50)]
# The keys of each type of pattern beside those of all; the first counts its parts.
KEYS_OF_TYPE: dict[BoardType, tuple[str, ...]] = {
    "checkerboard": ("inner_corners",),
    "charuco": ("squares", "marker_m", "dictionary"),
    "aprilgrid": ("tags", "tag_spacing"),
    "plain": (),
}
# Corners per axis from the profile's number of parts: factor, and number added.
_CORNERS_OF_TYPE: dict[BoardType, tuple[int, int]] = {
    "checkerboard": (1, 0),
    "charuco": (1, -1),
    "aprilgrid": (2, 0),
}
APRILGRID_FAMILY = "APRILTAG_36h11"


class BoardSettings(Settings):
    """A pattern printed on a rectangular plate, or a plain plate.

    Attributes:
        type: checkerboard, charuco (OpenCV) or aprilgrid (Kalibr); plain for a plate without a pattern, which
            only LiDARs detect.
        inner_corners: checkerboard: (cols, rows) of the points where four squares meet, one fewer than the
            squares in each direction.
        squares: charuco: (cols, rows) of squares.
        tags: aprilgrid: (cols, rows) of tags, Kalibr's tagCols and tagRows.
        square_m: side of one square, or of one tag (tagSize), measured over many of them on the print.
        marker_m: charuco: side of a marker, its black border included.
        tag_spacing: aprilgrid: gap between tags over their side, Kalibr's tagSpacing.
        dictionary: charuco: OpenCV's name of the marker dictionary, without DICT_. AprilGrids use tag36h11.
        first_id: charuco, aprilgrid: id of the first marker; 0 by default.
        width_m: outer width of the plate, along the columns.
        height_m: outer height of the plate, along the rows.
        pattern_offset_m: (right, up) from the plate's centre to the pattern's.
        square_sigma_m: standard deviation of `square_m`; by default 0.2 % of it.
        pattern_offset_sigma_m: standard deviation of each coordinate of `pattern_offset_m`.
        plate_sigma_m: standard deviation of `width_m` and of `height_m`.
        bow_sigma_m: standard deviation of the height of the plate's middle over its ends.
    """

    type: BoardType = "checkerboard"
    inner_corners: tuple[_Count, _Count] | None = None
    squares: tuple[_Count, _Count] | None = None
    tags: tuple[_TagCount, _TagCount] | None = None
    square_m: Annotated[float, Field(ge=0, le=1)] = 0.0
    marker_m: Annotated[float, Field(ge=0.001, le=1)] | None = None
    tag_spacing: Annotated[float, Field(ge=0.1, le=1)] | None = None
    dictionary: str | None = None
    first_id: Annotated[int, Field(ge=0, le=1023)] | None = None
    width_m: _Side
    height_m: _Side
    pattern_offset_m: tuple[Figure, Figure] = (0.0, 0.0)
    square_sigma_m: Deviation | None = None
    pattern_offset_sigma_m: Deviation = 0.003
    plate_sigma_m: Deviation = 0.002
    bow_sigma_m: Deviation = 0.001

    @field_validator("dictionary")
    @classmethod
    def _dictionary_exists(cls, value: str | None) -> str | None:
        if value is not None and value.removeprefix("DICT_") not in DICTIONARIES:
            raise problem(f"{value} is not a dictionary; choose one of {', '.join(DICTIONARIES)}")
        return None if value is None else value.removeprefix("DICT_")

    @model_validator(mode="after")
    def _keys_are_of_the_type(self) -> "BoardSettings":
        wanted = KEYS_OF_TYPE[self.type]
        if self.type == "plain" and self.square_m:
            raise problem("does not belong to a plain plate; correct board.type, or remove it", "square_m")
        if self.type != "plain" and self.square_m < _LEAST_SQUARE_M:
            what = f"{self.square_m:g} m: a square has {_LEAST_SQUARE_M:g} m or more"
            raise problem(what if "square_m" in self.model_fields_set else "is missing", "square_m")
        for key in wanted:
            if getattr(self, key) is None:
                raise problem(f"is missing: a {self.type} has it", key)
        others = {key for keys in KEYS_OF_TYPE.values() for key in keys} - set(wanted)
        others |= {"first_id"} if self.type in ("checkerboard", "plain") else set()
        for key in sorted(others):
            if getattr(self, key) is not None:
                raise problem(f"does not belong to a {self.type}; correct board.type, or remove it", key)
        if self.marker_m is not None and not 0.3 < self.marker_m / self.square_m < 0.95:
            raise problem(f"{self.marker_m:g} m does not fit squares of {self.square_m:g} m", "marker_m")
        return self

    @model_validator(mode="after")
    def _has_markers_enough(self) -> "BoardSettings":
        board = self.to_board()
        if board.has_markers:
            if min(board.cols, board.rows) < 2 or board.cols * board.rows < LEAST_CORNERS:
                what = f"{board.cols}x{board.rows} corners are too few: 2 each way, {LEAST_CORNERS} in all"
                raise problem(what, KEYS_OF_TYPE[self.type][0])
            n_needed, n_there = board.first_id + board.n_markers, n_markers_of(board.dictionary)
            if n_needed > n_there:
                raise problem(f"{board.dictionary} has {n_there} markers, the board needs {n_needed}")
        return self

    @model_validator(mode="after")
    def _pattern_fits_on_plate(self) -> "BoardSettings":
        board = self.to_board()
        if board.type == "plain":
            return self
        width, height = board.pattern_size_m
        offset_x, offset_y = (2 * abs(offset) for offset in self.pattern_offset_m)
        # If the pattern fills the plate, both are measured to a millimetre.
        if width + offset_x <= self.width_m + 1e-3 and height + offset_y <= self.height_m + 1e-3:
            return self
        what = (
            f"the pattern of {board.summary} is "
            f"{width:.3g} x {height:.3g} m and does not fit on a plate {self.width_m:g} x {self.height_m:g} m"
        )
        if offset_x or offset_y:
            x, y = self.pattern_offset_m
            what += f" with its centre {x:g}, {y:g} m from the plate's"
        if width + offset_y <= self.height_m + 1e-3 and height + offset_x <= self.width_m + 1e-3:
            what += f"; swap width_m and height_m, or {KEYS_OF_TYPE[self.type][0]} [cols, rows]"
        elif board.type == "checkerboard":
            inner_width, inner_height = width - 2 * self.square_m, height - 2 * self.square_m
            if inner_width <= self.width_m and inner_height <= self.height_m:
                what += "; count inner corners, one fewer than squares in each direction"
        raise problem(what)

    def to_board(self) -> Board:
        """Build the board for the algorithms."""
        if self.type == "plain":
            return Board(0, 0, 0.0, self.width_m, self.height_m, type="plain")
        cols, rows = getattr(self, KEYS_OF_TYPE[self.type][0])
        factor, extra = _CORNERS_OF_TYPE[self.type]
        return Board(
            factor * cols + extra,
            factor * rows + extra,
            self.square_m,
            self.width_m,
            self.height_m,
            self.pattern_offset_m,
            self.type,
            marker_share=(self.marker_m or 0.0) / self.square_m,
            gap_share=self.tag_spacing or 0.0,
            dictionary=APRILGRID_FAMILY if self.type == "aprilgrid" else self.dictionary or "",
            first_id=self.first_id or 0,
        )


def board_block(board: Board) -> dict[str, Any]:
    """List the keys of a board in a profile, without standard deviations."""
    if board.type == "plain":
        return {"type": "plain", "width_m": board.width_m, "height_m": board.height_m}
    factor, extra = _CORNERS_OF_TYPE[board.type]
    counts = [(n - extra) // factor for n in (board.cols, board.rows)]
    of_type = {
        "marker_m": round(board.marker_share * board.square_m, 6),
        "tag_spacing": board.gap_share,
        "dictionary": board.dictionary,
    }
    block: dict[str, Any] = {"type": board.type} if board.has_markers else {}
    block |= {KEYS_OF_TYPE[board.type][0]: counts, "square_m": board.square_m}
    block |= {key: of_type[key] for key in KEYS_OF_TYPE[board.type][1:]}
    block |= {"first_id": board.first_id} if board.first_id else {}
    return block | {
        "width_m": board.width_m,
        "height_m": board.height_m,
        "pattern_offset_m": list(board.pattern_offset_m),
    }
