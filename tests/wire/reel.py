"""Data of the senders: packets and images of still boards at several places, simulated once."""

import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from lce_rig.core import velodyne
from lce_rig.core.data import Image, Scan
from lce_rig.core.findings import Refusal
from lce_rig.detect.finder import BoardFinder
from lce_rig.simulate import SimulationOptions
from lce_rig.simulate.live_scene import LiveScene
from lce_rig.simulate.stage import PLACEMENT
from wire.timing import PACKETS_PER_LOOP, SCANS_PER_LOOP
from wire.vlp16_packets import STREAMED_VLP16, Vlp16Packets

_T0_NS = 1_700_000_000_000_000_000
_N_PICTURES = 4
# Scans begin half a step behind the seam at the sensor's back.
_CUT = velodyne.AZIMUTH_STEPS / 2 + 20


@dataclass(frozen=True)
class Reel:
    """A folder with packets.bin, CAMERA.bin for each camera, and reel.json with these figures."""

    folder: str
    n_placements: int
    n_pictures: int
    picture_bytes: dict[str, int]

    @classmethod
    def load(cls, folder):
        """Read the figures of a reel."""
        return cls(**json.loads((folder / "reel.json").read_text()))

    def packets(self, placement):
        """Read the payloads of the data packets of a placement, one loop; their times are to be set."""
        n_bytes = PACKETS_PER_LOOP * velodyne.DATA_BYTES
        data = (Path(self.folder) / "packets.bin").read_bytes()[placement * n_bytes :][:n_bytes]
        return [data[k : k + velodyne.DATA_BYTES] for k in range(0, n_bytes, velodyne.DATA_BYTES)]

    def pictures(self, camera, placement):
        """Read a placement's images in sending order."""
        n_bytes = self.picture_bytes[camera]
        data = (Path(self.folder) / f"{camera}.bin").read_bytes()
        first = placement * self.n_pictures
        return [data[k * n_bytes : (k + 1) * n_bytes] for k in range(first, first + self.n_pictures)]


def make_reel(folder, rig, n_placements, seed=0):
    """Simulate a reel."""
    folder.mkdir(parents=True)
    scene = LiveScene(rig, seed, replace(SimulationOptions.for_rig(rig.name), carrier="person"))
    scene.stage = replace(scene.stage, models=dict.fromkeys(rig.lidars, STREAMED_VLP16))
    sender = Vlp16Packets()
    n_bytes = {}
    packets = bytearray()
    for index, (scans, images) in enumerate(_placements(scene, rig, n_placements)):
        for k, scan in enumerate(scans):
            stamp_ns = _T0_NS + (SCANS_PER_LOOP * index + k) * STREAMED_VLP16.period_ns
            sent = sender.feed(replace(scan, stamp_ns=stamp_ns))
            packets += b"".join(p.payload for p in sent if p.port == velodyne.DATA_PORT)
        for image in images:
            data = _encode(image, rig)
            n_bytes[image.sensor] = len(data)
            with (folder / f"{image.sensor}.bin").open("ab") as file:
                file.write(data)
    (folder / "packets.bin").write_bytes(_turn_evenly(packets))
    reel = Reel(str(folder), n_placements, _N_PICTURES, n_bytes)
    (folder / "reel.json").write_text(json.dumps(asdict(reel)))
    return reel


def _turn_evenly(packets):
    """Align the azimuths of all loops, so that the rotor turns evenly from one placement to the next.

    Each simulated placement begins anywhere within a step, by which it is turned here; 0.2 deg at most.
    """
    fields = np.frombuffer(packets, velodyne.DATA_PACKET).copy()
    fields = fields.reshape(-1, PACKETS_PER_LOOP)
    n_blocks = PACKETS_PER_LOOP * velodyne.N_BLOCKS
    turned = SCANS_PER_LOOP * velodyne.AZIMUTH_STEPS * np.arange(n_blocks) / n_blocks
    azimuth = np.rint(_CUT + turned).astype(np.int64) % velodyne.AZIMUTH_STEPS
    fields["blocks"]["azimuth"] = azimuth.reshape(PACKETS_PER_LOOP, velodyne.N_BLOCKS)
    return fields.tobytes()


def _placements(scene, rig, n):
    """Measure the board at places where every sensor finds it."""
    index = n_found = 0
    while n_found < n:
        scene.hold(scene.stage.place(index, scene.stage.rng(index, PLACEMENT)))
        index += 1
        taken = [list(scene.take(_T0_NS)) for _ in range(_N_PICTURES)]
        scans = [sample for turn in taken[:SCANS_PER_LOOP] for sample in turn if isinstance(sample, Scan)]
        images = [sample for turn in taken for sample in turn if isinstance(sample, Image)]
        found = [BoardFinder(rig).image(image) for image in images]
        seen = [BoardFinder(rig).scan(scan) for scan in scans]
        if not any(isinstance(each, Refusal) for each in [*found, *seen]):
            n_found += 1
            yield scans, images


def _encode(image, rig):
    height, width = image.pixels.shape[:2]
    if rig.cameras[image.sensor].driver.pixel_format != "UYVY":
        return image.grey.tobytes()
    y, cr, cb = cv2.split(cv2.cvtColor(image.pixels, cv2.COLOR_BGR2YCrCb))
    uyvy = np.empty((height, width, 2), np.uint8)
    uyvy[:, :, 1] = y
    uyvy[:, 0::2, 0], uyvy[:, 1::2, 0] = cb[:, 0::2], cr[:, 0::2]
    return uyvy.tobytes()
