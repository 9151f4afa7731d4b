"""Profiles of rigs with senders on this computer as sensors, and the running senders."""

import json
import os
import subprocess
import sys
from pathlib import Path

from lce_rig.rig import dump_rig, load_rig
from wire.vlp16_packets import free_ports

_TESTS = Path(__file__).parents[1]
ENVIRONMENT = {**os.environ, "PYTHONPATH": f"{_TESTS}:{_TESTS.parent}", "OMP_NUM_THREADS": "1"}
"""For processes of these senders and of lce-rig."""


def small_rig(*, is_guided=True):
    """Build a rig of a VLP-16 and the camera `cam` of 346x260 px."""
    rles = load_rig("rles")
    davis = rles.cameras["davis"]
    cam = davis.model_copy(update={"model": "wire", "channels": {"frames": davis.channels["frames"]}})
    nominal = rles.nominal_extrinsics[0].model_copy(update={"camera": "cam"})
    quality = rles.quality if is_guided else rles.quality.model_copy(update={"min_captures": 10_000})
    return rles.model_copy(
        update={
            "name": "wire",
            "cameras": {"cam": cam},
            "nominal_extrinsics": (nominal,) if is_guided else (),
            "quality": quality,
        }
    )


class WireRig:
    """A rig whose VLP-16 sends while the `with` block lasts; its cameras send when read."""

    def __init__(self, folder, rig, reel, loops_per_hold, **camera):
        """Prepare."""
        self._folder, self._reel, self._loops = folder, reel, loops_per_hold
        self._ports = free_ports()
        self._camera = {"rate": 30, "unplug": folder / "unplugged", **camera}
        self.rig = self._reachable(rig)
        self.profile = folder / "wire.yaml"
        self.profile.write_text(dump_rig(self.rig))
        self.sent = {}

    def __enter__(self):
        """Start the VLP-16; it sends when somebody listens."""
        ports = ["--port", str(self._ports[0]), "--position-port", str(self._ports[1])]
        command = [sys.executable, "-m", "wire.send_packets", self._reel.folder, "--loops", str(self._loops)]
        self._sensor = subprocess.Popen(
            command + ports, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=ENVIRONMENT
        )
        assert self._sensor.stdout.readline() == "ready\n"
        return self

    def __exit__(self, kind, error, trace):
        """End the VLP-16."""
        self._sensor.kill()
        self._sensor.communicate()

    @property
    def pid(self):
        """Of the VLP-16."""
        return self._sensor.pid

    def tell(self, order):
        """Send a command to the VLP-16; see send_packets.py."""
        self._sensor.stdin.write(order + "\n")
        self._sensor.stdin.flush()

    def stop(self):
        """Let the VLP-16 fall silent for good, and give the numbers of packets `sent` and `withheld`."""
        self.tell("stop")
        self.sent = json.loads(self._sensor.stdout.readline())
        return self.sent

    def unplug(self):
        """Take the cameras away."""
        self._camera["unplug"].touch()

    def plug_in(self):
        """Bring the cameras back."""
        self._camera["unplug"].unlink()

    def _reachable(self, rig):
        def driven(sensor, **driver):
            return sensor.model_copy(update={"driver": sensor.driver.model_copy(update=driver)})

        port, position_port = self._ports
        udp = {"port": port, "address": "127.0.0.1", "controls": {"position_port": position_port}}
        lidars = {name: driven(lidar, **udp) for name, lidar in rig.lidars.items()}
        cameras = {}
        for name, camera in rig.cameras.items():
            pipe = {"type": "command", "device": None, "controls": {}, "command": self._command(name)}
            cameras[name] = driven(camera, **pipe, pixel_format=camera.driver.pixel_format or "GREY")
        return rig.model_copy(update={"lidars": lidars, "cameras": cameras})

    def _command(self, camera):
        options = [text for key, value in self._camera.items() for text in (f"--{key}", str(value))]
        interpreter = ("env", f"PYTHONPATH={ENVIRONMENT['PYTHONPATH']}", sys.executable)
        where = (self._reel.folder, camera, "--loops", str(self._loops))
        return (*interpreter, "-m", "wire.send_pictures", *where, *options)
