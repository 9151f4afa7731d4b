"""From data packets to points, by velodyne-decoder.

Two of its choices matter: it adds the vertical offsets of the lasers (up to 11 mm,
which ROS 1 drivers omit), and between two azimuths takes the rotor's mean speed over the packet, where
drivers interpolate block by block (up to 0.025 deg apart).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lce_rig.core import velodyne
from lce_rig.core.errors import SourceError

_MODELS = {"VLP-16": "VLP16", "Puck Hi-Res": "PuckHiRes", "HDL-32E": "HDL32E", "VLP-32C": "VLP32C"}
#: What a recording made elsewhere may lack.
OFFSETS_NOTE = "points include the lasers' vertical offsets (VLP-16: up to 11 mm), which ROS 1 drivers omit"
DUAL_NOTE = "dual returns: of each firing the brighter one is kept"


@dataclass(frozen=True, eq=False)
class PointBatch:
    """Points of some packets.

    Attributes:
        points: (N, 3) float32 m, frame lidar, in the order of firing.
        intensity: (N,) float32 reflectivity, 0 to 255.
        ring: (N,) int16, 0 = lowest.
        offset_ns: (N,) int64 firing time after the first packet's.
    """

    points: NDArray[np.float32]
    intensity: NDArray[np.float32]
    ring: NDArray[np.int16]
    offset_ns: NDArray[np.int64]


class Vlp16Decoder:
    """Decodes packets of one model, a VLP-16 by default, that were checked before.

    Raises:
        SourceError: velodyne-decoder is not installed.
    """

    def __init__(
        self, min_range_m: float, max_range_m: float, product: velodyne.Product = velodyne.READ[0]
    ) -> None:
        try:
            import velodyne_decoder  # type: ignore[import-untyped]
        except ImportError:
            raise SourceError(
                "velodyne-decoder is not installed", 'pip install "velodyne-decoder>=3,<4"'
            ) from None
        self._library: Any = velodyne_decoder
        config = velodyne_decoder.Config(
            model=getattr(velodyne_decoder.Model, _MODELS[product.name]),
            min_range=min_range_m,
            max_range=max_range_m,
            timestamp_first_packet=True,
        )
        self._decoder = velodyne_decoder.ScanDecoder(config)

    def decode(self, packets: NDArray[np.void], start_ns: Sequence[int]) -> PointBatch:
        """Decode packets of one return mode.

        Args:
            packets: (P,) of velodyne.DATA_PACKET; ranges of 0 give no point.
            start_ns: (P,) time of each one's first firing, rising.
        """
        # The library completes the hour by the host's time: a clock that agrees past the hour will do.
        zero_s = 3600.0 + int(packets["us"][0]) * 1e-6
        vector = self._library.PacketVector()
        for packet, at_ns in zip(packets, start_ns, strict=True):
            stamp_s = zero_s + (at_ns - start_ns[0]) * 1e-9
            vector.append(self._library.VelodynePacket(stamp_s, packet.tobytes()))
        _, cloud = self._decoder.decode(vector, True)
        points = np.stack([cloud["x"], cloud["y"], cloud["z"]], axis=1).astype(np.float32, copy=False)
        offset_ns = np.rint(cloud["time"].astype(np.float64) * 1e9).astype(np.int64)
        intensity, ring = cloud["intensity"].astype(np.float32), cloud["ring"].astype(np.int16)
        return PointBatch(points, intensity, ring, offset_ns)


def keep_brighter(packets: NDArray[np.void]) -> None:
    """Blank, in dual-mode packets (P,), the darker of two returns, or the last where they are alike.

    A board and the wall behind it may both answer one pulse at the board's rim; the brighter answer is what
    the sensor reports in its strongest mode.
    """
    returns = packets["blocks"]["returns"]
    last, strongest = returns[:, 0::2], returns[:, 1::2]
    is_last_kept = (last["range"] > 0) & (
        (strongest["range"] == 0) | (last["reflectivity"] > strongest["reflectivity"])
    )
    strongest["range"][is_last_kept] = 0
    last["range"][~is_last_kept] = 0
