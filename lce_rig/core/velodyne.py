"""Velodyne packets: their layout, their timing, and the names in their factory bytes.

References:
    VLP-16 User Manual, Velodyne 63-9243 Rev. D, chapters 6 and 9, appendix E; HDL-32E User's Manual 63-9113,
    VLP-32C User Manual 63-9325.
"""

from dataclasses import dataclass

import numpy as np

from lce_rig.core.data_sheets import find_data_sheet

DATA_PORT = 2368
POSITION_PORT = 8308
DATA_BYTES = 1206
POSITION_BYTES = 512

N_LASERS = 16
N_BLOCKS = 12
BLOCK_FLAG = 0xEEFF
#: Azimuths count 0.01 deg, clockwise from the y axis of the manual, which is the x axis of the lidar frame.
AZIMUTH_STEPS = 36_000
AZIMUTH_STEP_RAD = 2 * np.pi / AZIMUTH_STEPS
FIRING_NS = 2_304
SEQUENCE_NS = 55_296
#: A block holds two sequences of all lasers, or one return of two sequences in dual mode.
BLOCK_NS = 2 * SEQUENCE_NS
HOUR_US = 3_600_000_000

STRONGEST, LAST, DUAL = 0x37, 0x38, 0x39
RETURN_MODES = {STRONGEST: "strongest", LAST: "last", DUAL: "dual"}
VLP16 = 0x22
PRODUCTS = {
    0x21: "HDL-32E",
    VLP16: "VLP-16",
    0x24: "Puck Hi-Res",
    0x28: "VLP-32C",
    0x31: "Velarray",
    0xA1: "VLS-128",
}


@dataclass(frozen=True)
class Product:
    """A model with supported packets.

    Attributes:
        code: factory byte of the product.
        name: the maker's name.
        block_ns: from the first firing of a block to that of the next, with one return.
    """

    code: int
    name: str
    block_ns: int

    def packet_ns(self, is_dual: bool) -> int:
        """Return the time from the first firing of a packet to the first firing of the next."""
        return N_BLOCKS * self.block_ns // (2 if is_dual else 1)


#: A block holds 32 returns: two sequences of 16 lasers, or one of 32.
READ = tuple(
    Product(code, PRODUCTS[code], block_ns)
    for code, block_ns in ((VLP16, BLOCK_NS), (0x24, BLOCK_NS), (0x21, 46_080), (0x28, SEQUENCE_NS))
)


def product_of(model: str) -> Product | None:
    """Find the packet product of a model; None if not supported."""
    sheet = find_data_sheet(model)
    return next((each for each in READ if sheet is not None and each.name == sheet.name), None)


_RETURN = np.dtype([("range", "<u2"), ("reflectivity", "u1")])
DATA_BLOCK = np.dtype([("flag", "<u2"), ("azimuth", "<u2"), ("returns", _RETURN, (2 * N_LASERS,))])
#: `us` counts from the full hour to the first firing; even blocks of dual packets hold last returns.
DATA_PACKET = np.dtype(
    [("blocks", DATA_BLOCK, (N_BLOCKS,)), ("us", "<u4"), ("mode", "u1"), ("product", "u1")]
)

PPS_STATES = ("absent", "synchronising", "locked", "error")
PPS_LOCKED = 2
#: `nmea` is padded with zeros; the fields in between are unused here and not set by older firmware.
POSITION_PACKET = np.dtype(
    {
        "names": ["us", "pps", "nmea"],
        "formats": ["<u4", "u1", "S306"],
        "offsets": [0xC6, 0xCA, 0xCE],
        "itemsize": POSITION_BYTES,
    }
)
