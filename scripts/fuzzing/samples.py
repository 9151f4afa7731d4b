"""What seeds are made of: a few simulated samples of a small rig, the same bytes each time."""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from lce_rig.core.data import Events, Image, Scan
from lce_rig.rig import Rig, load_rig

SIZE = (80, 60)
CAMERA, LIDAR = "davis", "lidar"
_DURATION_S = 0.21
_EVERY_POINT = 60


@dataclass(frozen=True, eq=False)
class Samples:
    """Of one short recording.

    Attributes:
        rig: a VLP-16 and an event camera of SIZE pixels that takes frames as well.
        images: grey, (60, 80).
        scans: thinned to a few hundred points, so that files of them are small.
        whole_scans: as the LiDAR took them.
        events: one stretch.
    """

    rig: Rig
    images: list[Image]
    scans: list[Scan]
    whole_scans: list[Scan]
    events: Events

    @property
    def truth_like(self) -> np.ndarray:
        """A plausible T_cam_lidar (4, 4)."""
        entry = self.rig.nominal_extrinsics[0]
        return np.asarray(entry.to_matrix())


def small_rig() -> Rig:
    """Build the profile: rig rles with an eighteenth of its pixels."""
    rles = load_rig("rles")
    camera = rles.cameras[CAMERA]
    scale = SIZE[0] / camera.resolution_px[0]
    given = camera.intrinsics
    lens = given.model_copy(
        update={
            "fx_px": round(given.fx_px * scale, 3),
            "fy_px": round(given.fy_px * scale, 3),
            "cx_px": (SIZE[0] - 1) / 2,
            "cy_px": (SIZE[1] - 1) / 2,
        }
    )
    small = camera.model_copy(update={"resolution_px": SIZE, "intrinsics": lens})
    return rles.model_copy(update={"name": "fuzz", "cameras": {CAMERA: small}})


@cache
def simulated_samples() -> Samples:
    """Simulate once."""
    from lce_rig.simulate import simulate_recording

    rig = small_rig()
    images: list[Image] = []
    scans: list[Scan] = []
    packets: list[Events] = []
    for sample in simulate_recording(rig, duration_s=_DURATION_S, seed=0):
        if isinstance(sample, Image):
            images.append(replace(sample, pixels=sample.grey))
        elif isinstance(sample, Scan):
            scans.append(sample)
        else:
            packets.append(sample)
    columns = {
        name: np.concatenate([getattr(packet, name) for packet in packets])
        for name in ("t_ns", "x", "y", "polarity")
    }
    events = Events(CAMERA, **columns, width_px=SIZE[0], height_px=SIZE[1], host_ns=packets[0].host_ns)
    thinned = [scan.select(slice(None, None, _EVERY_POINT)) for scan in scans]
    return Samples(rig, images[:2], thinned[:2], scans[:2], events)
