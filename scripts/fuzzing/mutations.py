"""Intact files with random damage: the program must return data or an error message, within limits of time
and memory."""

import importlib
import os
import pkgutil
import random
import re
import resource
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import laspy
import numpy as np

import lce_rig.cli
import lce_rig.io
from fuzzing.hostile import add_result
from fuzzing.inputs import Outcome, run_limited
from fuzzing.report import Report
from lce_rig.cli.main import run
from lce_rig.fleet.registry import Registry, write_rows
from lce_rig.fleet.storage import Storage
from lce_rig.io.ros.bag_recorder import BagRecorder
from lce_rig.session import Session

# Time after which a command is ended, s, and limit of its data, bytes.
_STOP_S, _STOP_BYTES = 30, 3_500_000_000
_MOST_FLIPS, _MOST_BLOCK = 16, 4096
_NUMBER = re.compile(rb"-?\d+\.?\d*")
_ODD = (b"nan", b"-1", b"0", b"1e308", b"99999999999999999999", b"null", b"[]", b"{}", b"~", b"'x'")
_SUFFIXES_OF_TEXT = (".yaml", ".txt", ".json")
_CAMERA = """camera_name: cam
image_width: 1280
image_height: 720
camera_matrix: {rows: 3, cols: 3, data: [897.5, 0, 635.4, 0, 896.8, 375.3, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [-0.44, 0.23, -0.001, 0.0002, -0.07]}
projection_matrix: {rows: 3, cols: 4, data: [800.0, 0, 630, 0, 0, 850.0, 370, 0, 0, 0, 1, 0]}
"""
_CAMCHAIN = """cam0:
  camera_model: pinhole
  intrinsics: [897.5, 896.8, 635.4, 375.3]
  distortion_model: radtan
  distortion_coeffs: [-0.44, 0.23, -0.001, 0.0002]
  resolution: [1280, 720]
  rostopic: /camera/image_raw
"""
_OST = """# oST version 5.0 parameters


[image]

width
1280

height
720

[narrow_stereo]

camera matrix
897.5 0.0 635.4
0.0 896.8 375.3
0.0 0.0 1.0

distortion
-0.44 0.23 -0.001 0.0002 -0.07
"""


@dataclass
class MutationReport(Report):
    """Outcome of the damaged files.

    Attributes:
        longest_s, largest_mb: of all commands.
        ends: number of commands by kind of file and exit code.
    """

    longest_s: float = 0.0
    largest_mb: float = 0.0
    ends: dict[str, dict[int, int]] = field(default_factory=dict)


class Target(NamedTuple):
    """A file to damage, and the command that reads it.

    Attributes:
        file: in the folder of sound files, which is copied.
        words: of the command line; {} is the copy of the folder.
    """

    file: str
    words: str

    def line(self, place: Path) -> list[str]:
        """List the words with the folder's place."""
        return [word.replace("{}", str(place)) for word in self.words.split()]


_NEW = "rigs new new -o - --board 8x6,0.07,0.767x0.626"
_FOLDER = "collect --rig {}/rig.yaml {}/new --from {}/"
TARGETS = (
    Target("camera.yaml", f"{_NEW} --lidar VLP-16 --intrinsics {{}}/camera.yaml"),
    Target("camchain.yaml", f"{_NEW} --lidar VLP-16 --intrinsics {{}}/camchain.yaml"),
    Target("ost.txt", f"{_NEW} --lidar VLP-16 --intrinsics {{}}/ost.txt"),
    Target("rig.yaml", "rigs check {}/rig.yaml"),
    Target("las/pcd/0.las", f"{_FOLDER}las"),
    Target("las/img/0.png", f"{_FOLDER}las"),
    Target("pairs/pcd/0.pcd", f"{_FOLDER}pairs"),
    Target("bag.mcap", f"{_NEW} --lidar VLP-16 --from {{}}/bag.mcap --intrinsics {{}}/camera.yaml"),
    Target("bag.mcap", f"{_FOLDER}bag.mcap"),
    Target("session/calibration/result.json", "export {}/session -o {}/out"),
    Target("session/rig.yaml", "results {}/session"),
    Target("session/session.json", "captures {}/session"),
    Target("session/captures/000000/meta.json", "captures {}/session"),
    Target("registry/r1/a/result.json", "fleet table --registry {}/registry --rebuild"),
    Target("registry/r1/a/fleet.json", "fleet table --registry {}/registry --rebuild"),
    Target("registry/fleet.parquet", "fleet table --registry {}/registry"),
)


def mutate(whole: bytes, draw: random.Random, *, is_text: bool) -> bytes:
    """Flip bits, cut the end off, repeat or remove a block, fill one; in text also exchange a number."""

    def flip(data: bytearray) -> None:
        for _ in range(draw.randint(1, _MOST_FLIPS)):
            # Most headers are at an end of the file.
            near = min(len(data), _MOST_BLOCK)
            at = draw.choice([draw.randrange(near), -1 - draw.randrange(near), draw.randrange(len(data))])
            data[at] ^= 1 << draw.randrange(8)

    def cut(data: bytearray) -> None:
        del data[draw.randrange(len(data)) :]

    def block(data: bytearray) -> slice:
        begin = draw.randrange(len(data))
        return slice(begin, begin + draw.randint(1, _MOST_BLOCK))

    def repeat(data: bytearray) -> None:
        part = data[block(data)]
        at = draw.randrange(len(data))
        data[at:at] = part * draw.randint(1, 3)

    def remove(data: bytearray) -> None:
        del data[block(data)]

    def fill(data: bytearray) -> None:
        at = draw.randrange(len(data))
        part = draw.choice((4, 8))
        data[at : at + part] = draw.choice((b"\xff", b"\0", b"\x7f")) * part

    def exchange(data: bytearray) -> None:
        numbers = list(_NUMBER.finditer(data))
        if numbers:
            data[slice(*draw.choice(numbers).span())] = draw.choice(_ODD)

    changes: list[Callable[[bytearray], None]] = [flip, cut, repeat, remove, fill]
    changed = bytearray(whole)
    for change in draw.choices([*changes, *[exchange] * (4 * is_text)], k=draw.randint(1, 2)):
        if changed:
            change(changed)
    return bytes(changed)


def make_sound(folder: Path) -> None:
    """Write a session with a result, and from it the other sound files.

    Raises:
        AssertionError: the session could not be simulated.
    """
    session = folder / "session"
    made = run_limited(["simulate", "--rig", "rlfs", "--captures", "1", str(session)])
    assert made.code == 0, made.text
    add_result(session)
    shutil.rmtree(session / "detections", ignore_errors=True)
    for name, text in (("camera.yaml", _CAMERA), ("camchain.yaml", _CAMCHAIN), ("ost.txt", _OST)):
        (folder / name).write_text(text)
    shutil.copy(session / "rig.yaml", folder)
    opened = Session.open(session)
    (capture,) = opened.captures
    for name in ("las", "pairs"):
        for part in ("img", "pcd"):
            (folder / name / part).mkdir(parents=True)
        shutil.copy(session / "captures/000000/cam.frames.png", folder / name / "img/0.png")
    shutil.copy(session / "captures/000000/lidar.pcd", folder / "pairs/pcd/0.pcd")
    scan, image = capture.scan("lidar"), capture.image("cam", "frames")
    las = laspy.create(point_format=3, file_version="1.2")
    las.header.scales = np.full(3, 0.001)
    las.x, las.y, las.z = scan.points.astype(np.float64).T
    las.write(str(folder / "las/pcd/0.las"))
    with BagRecorder(folder / "bag", opened.rig) as bag:
        for sample in (scan, image):
            bag.write(sample)
    shutil.move(next((folder / "bag").glob("*.mcap")), folder / "bag.mcap")
    shutil.rmtree(folder / "bag")
    registry = Registry(Storage.at(folder / "registry"))
    names = {"robot": "r1", "folder": "r1/a", "source": "s", "rig": "rlfs", "status": "ok"}
    row = {**names, "date": "2026-01-05T10:00:00Z", "finished": "2026-01-05T10:00:00Z"}
    with registry.result("r1/a") as draft:
        shutil.copy(session / "calibration/result.json", draft)
        write_rows(draft, [row])
    registry.consolidate()


def import_all() -> None:
    """Import the commands' modules once for all children."""
    for parent in (lce_rig.cli, lce_rig.io):
        for module in pkgutil.walk_packages(parent.__path__, f"{parent.__name__}."):
            importlib.import_module(module.name)


def run_forked(words: list[str]) -> Outcome:
    """Run a command line in a child of this process, which has imported it, and end it if it hangs."""
    with tempfile.TemporaryFile() as log:
        began_s = time.monotonic()
        child = os.fork()
        if not child:
            code = 1
            try:
                os.setsid()
                for stream in (1, 2):
                    os.dup2(log.fileno(), stream)
                resource.setrlimit(resource.RLIMIT_DATA, (_STOP_BYTES, _STOP_BYTES))
                signal.alarm(_STOP_S)
                code = run(words)
                sys.stdout.flush()
                sys.stderr.flush()
            finally:
                os._exit(code)
        _, status, usage = os.wait4(child, 0)
        seconds = time.monotonic() - began_s
        log.seek(0)
        text = log.read().decode(errors="replace")
    return Outcome(os.waitstatus_to_exitcode(status), seconds, usage.ru_maxrss / 1024, text)


def fuzz_mutations(n: int, seed: int) -> MutationReport:
    """Run the program on n damaged files of each kind, with separate random numbers."""
    report = MutationReport()
    with tempfile.TemporaryDirectory() as folder:
        sound, place = Path(folder) / "sound", Path(folder) / "place"
        sound.mkdir()
        make_sound(sound)
        import_all()
        for target in TARGETS:
            shutil.copytree(sound, place)
            outcome = run_forked(target.line(place))
            assert outcome.code == 0, (target.words, outcome.text)
            shutil.rmtree(place)
        began_s = time.monotonic()
        for k in range(n):
            target = TARGETS[k % len(TARGETS)]
            draw = random.Random(f"{seed} {k}")
            shutil.copytree(sound, place)
            file = place / target.file
            is_text = file.suffix in _SUFFIXES_OF_TEXT
            file.write_bytes(mutate(file.read_bytes(), draw, is_text=is_text))
            outcome = run_forked(target.line(place))
            report.n += 1
            report.longest_s = max(report.longest_s, round(outcome.seconds, 1))
            report.largest_mb = max(report.largest_mb, round(outcome.peak_mb))
            ends = report.ends.setdefault(f"{target.file}: {target.words.split()[0]}", {})
            ends[outcome.code] = ends.get(outcome.code, 0) + 1
            faults = [f"{k}: {target.file}: {fault}" for fault in outcome.faults]
            report.wrong += faults
            for fault in faults:
                print(f"{fault}: {outcome.text[-1500:]}", file=sys.stderr, flush=True)
            shutil.rmtree(place)
        report.seconds = round(time.monotonic() - began_s, 1)
    return report
