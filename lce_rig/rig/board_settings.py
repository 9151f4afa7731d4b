"""The board's block of a profile."""

from typing import Annotated

from pydantic import Field, model_validator

from lce_rig.core.board import Board
from lce_rig.rig.settings import Figure, Settings, problem

# Beyond these the figure is in millimetres.
_Side = Annotated[float, Field(ge=0.005, le=5)]
_Deviation = Annotated[float, Field(ge=0, le=0.2)]


class BoardSettings(Settings):
    """A checkerboard printed on a rectangular plate.

    Attributes:
        inner_corners: (cols, rows) where four squares meet, one fewer each way than there are squares.
        square_m: side of one square, measured over many squares on the pattern itself.
        width_m: outer width of the plate, along the columns.
        height_m: outer height of the plate, along the rows.
        pattern_offset_m: (x right, y up) of the pattern's centre from the plate's centre.
        square_sigma_m: standard deviation of `square_m`; by default 0.2 % of it.
        pattern_offset_sigma_m: standard deviation of each coordinate of `pattern_offset_m`.
        plate_sigma_m: standard deviation of `width_m` and of `height_m`.
        bow_sigma_m: standard deviation of the height of the plate's middle over its ends.
    """

    inner_corners: tuple[Annotated[int, Field(ge=2, le=100)], Annotated[int, Field(ge=2, le=100)]]
    square_m: Annotated[float, Field(ge=0.001, le=1)]
    width_m: _Side
    height_m: _Side
    pattern_offset_m: tuple[Figure, Figure] = (0.0, 0.0)
    square_sigma_m: _Deviation | None = None
    pattern_offset_sigma_m: _Deviation = 0.003
    plate_sigma_m: _Deviation = 0.002
    bow_sigma_m: _Deviation = 0.001

    @model_validator(mode="after")
    def _pattern_fits_on_plate(self) -> "BoardSettings":
        cols, rows = self.inner_corners
        width, height = (cols + 1) * self.square_m, (rows + 1) * self.square_m
        offset_x, offset_y = (2 * abs(offset) for offset in self.pattern_offset_m)
        # If the pattern fills the plate, both are measured to a millimetre.
        if width + offset_x <= self.width_m + 1e-3 and height + offset_y <= self.height_m + 1e-3:
            return self
        what = (
            f"the pattern of {cols + 1}x{rows + 1} squares of {1e3 * self.square_m:g} mm is "
            f"{width:.3g} x {height:.3g} m and does not fit on a plate {self.width_m:g} x {self.height_m:g} m"
        )
        if offset_x or offset_y:
            x, y = self.pattern_offset_m
            what += f" with its centre {x:g}, {y:g} m from the plate's"
        if width + offset_y <= self.height_m + 1e-3 and height + offset_x <= self.width_m + 1e-3:
            what += "; swap width_m and height_m, or inner_corners [cols, rows]"
        elif (cols - 1) * self.square_m <= self.width_m and (rows - 1) * self.square_m <= self.height_m:
            what += "; count inner corners, one fewer than squares in each direction"
        raise problem(what)

    def to_board(self) -> Board:
        """Build the board for the algorithms."""
        cols, rows = self.inner_corners
        return Board(cols, rows, self.square_m, self.width_m, self.height_m, self.pattern_offset_m)
