"""Bombs by the command line: each must be refused soon, in little memory, with a documented exit code."""

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from fuzzing import bomb_files as files
from fuzzing import seeds_of_recordings as recordings
from fuzzing import seeds_of_sessions as sessions
from fuzzing.bomb_files import GB
from fuzzing.samples import CAMERA, Samples, simulated_samples, small_rig
from lce_rig.rig import dump_rig

MAX_SECONDS = 2.0
MAX_PEAK_BYTES = 500_000_000
_PATIENCE_S = 30
_TRIES = 3
_ROOT = Path(__file__).parents[2]
_MAIN = "from lce_rig.cli.main import main; main()"
# A process of its own, as the peak of a child counts from that of whoever forks it; it is small.
_LAUNCHER = """
import json, os, resource, signal, sys, time
patience_s, *command = sys.argv[1:]
resource.setrlimit(resource.RLIMIT_AS, (8 << 30, 8 << 30))
resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
began_s = time.monotonic()
pid = os.posix_spawn(command[0], command, os.environ, file_actions=[(os.POSIX_SPAWN_DUP2, 2, 1)])
signal.signal(signal.SIGALRM, lambda *_: os.kill(pid, signal.SIGKILL))
signal.alarm(int(patience_s))
_, status, usage = os.wait4(pid, 0)
print(json.dumps([os.waitstatus_to_exitcode(status), time.monotonic() - began_s, usage.ru_maxrss]))
"""
_REFUSED = frozenset(range(1, 8))

Build = Callable[[Samples, Path], object]


@dataclass(frozen=True)
class Bomb:
    """One hostile input and the command that meets it.

    Attributes:
        build: puts the files into an empty folder, in which rig.yaml is already.
        command: words behind `lce-rig`; {} is the folder.
        sound: puts sound files of the same kind there; the time and memory that the same command takes for
            them are the program's own.
        may_pass: whether the rest is worth going on with: a session with one bad capture.
    """

    build: Build
    command: str
    sound: Build
    may_pass: bool = False


@dataclass
class BombResult:
    """What became of one.

    Attributes:
        name: of the bomb.
        input_bytes: size of its files on the disk.
        exit_code: negative where it was killed.
        seconds: start-up included.
        start_s: what the same command takes for sound input.
        peak_mb: highest memory in use.
        start_mb: and that for sound input.
        wrong: what is wrong, "" where nothing is.
        said: last line of its error.
    """

    name: str
    input_bytes: int
    exit_code: int
    seconds: float
    start_s: float
    peak_mb: float
    start_mb: float
    wrong: str = ""
    said: str = ""


@dataclass
class BombReport:
    """What became of all.

    Attributes:
        n: bombs.
        n_wrong: that were not refused as they should be.
        bombs: each one's result.
        grown_bytes: always 0: each is a process of its own.
        seconds: how long all of it took.
    """

    n: int = 0
    n_wrong: int = 0
    bombs: list[BombResult] = field(default_factory=list)
    grown_bytes: int = 0
    seconds: float = 0.0


def fuzz_bombs(n: int, seed: int, *, names: Sequence[str] = ()) -> BombReport:
    """Run each bomb n times, and print a table.

    Args:
        n: times.
        seed: takes no part: bombs are always the same.
        names: of the bombs; all by default.
    """
    del seed
    report, began_s = BombReport(), time.monotonic()
    samples = simulated_samples()
    sound: dict[tuple[str, Build], tuple[float, float]] = {}
    print(
        f"{'bomb':34} {'exit':>4} {'start s':>8} {'more s':>7} {'start MB':>8} {'peak MB':>8}",
        file=sys.stderr,
    )
    for name in [name for name in (names or BOMBS) for _ in range(n)]:
        bomb = BOMBS[name]
        key = bomb.command, bomb.sound
        if key not in sound:
            # The second time, as the first one compiles and reads from the disk.
            runs = [_run(bomb.command, bomb.sound, samples) for _ in range(2)]
            sound[key] = min(run.seconds for run in runs), runs[1].peak_bytes / 1e6
        start_s, start_mb = sound[key]
        ran = _quickest(bomb, samples, start_s)
        result = BombResult(
            name,
            ran.input_bytes,
            ran.exit_code,
            round(ran.seconds, 2),
            round(start_s, 2),
            round(ran.peak_bytes / 1e6),
            round(start_mb),
            "; ".join(_faults(bomb, ran, start_s)),
            ran.said,
        )
        report.bombs.append(result)
        report.n += 1
        report.n_wrong += bool(result.wrong)
        line = f"{name:34} {result.exit_code:4} {start_s:8.2f} {ran.seconds - start_s:7.2f} {start_mb:8.0f}"
        print(f"{line} {result.peak_mb:8.0f} {result.wrong}", file=sys.stderr, flush=True)
    report.seconds = round(time.monotonic() - began_s, 1)
    return report


def _quickest(bomb: Bomb, samples: Samples, start_s: float) -> "_Ran":
    """Run a bomb, again where it took too long but ended: a busy computer only ever adds time."""
    runs = [_run(bomb.command, bomb.build, samples)]
    while len(runs) < _TRIES and runs[-1].exit_code >= 0 and runs[-1].seconds - start_s > MAX_SECONDS:
        runs.append(_run(bomb.command, bomb.build, samples))
    return min(runs, key=lambda ran: ran.seconds)


@dataclass(frozen=True)
class _Ran:
    exit_code: int
    seconds: float
    peak_bytes: int
    input_bytes: int
    said: str
    all_said: str
    leaked: bool


def _run(command: str, build: Build, samples: Samples) -> _Ran:
    folder = Path(tempfile.mkdtemp(prefix="lce-rig-bomb-"))
    try:
        (folder / "rig.yaml").write_text(dump_rig(small_rig()))
        build(samples, folder)
        input_bytes = _disk_bytes(folder)
        words = [word.format(folder) for word in command.split()]
        log = folder / "said.log"
        environment = {**os.environ, "PYTHONPATH": str(_ROOT), "OMP_NUM_THREADS": "1", "COLUMNS": "300"}
        with log.open("wb") as out:
            launched = subprocess.run(
                [
                    sys.executable,
                    "-S",
                    "-c",
                    _LAUNCHER,
                    str(_PATIENCE_S),
                    sys.executable,
                    "-c",
                    _MAIN,
                    *words,
                ],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=out,
                env=environment,
                check=True,
            )
        exit_code, seconds, peak_kb = json.loads(launched.stdout)
        said = log.read_bytes()[-20_000:]
        lines = [line for line in said.decode(errors="replace").splitlines() if line.startswith("error")]
        leaked = files.SECRET in said or any(
            files.SECRET in _head(file) for file in (folder / "new").rglob("*")
        )
        text = said.decode(errors="replace")
        tail = lines[-1][:200] if lines else text[-200:]
        return _Ran(exit_code, seconds, peak_kb * 1024, input_bytes, tail, text, leaked)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _head(file: Path) -> bytes:
    if not file.is_file():
        return b""
    with file.open("rb") as stream:
        return stream.read(1 << 20)


def _disk_bytes(folder: Path) -> int:
    return sum(512 * entry.lstat().st_blocks for entry in folder.rglob("*") if not entry.is_dir())


def _faults(bomb: Bomb, ran: _Ran, start_s: float) -> list[str]:
    faults = []
    if ran.exit_code not in _REFUSED and not (bomb.may_pass and ran.exit_code == 0):
        killed = ran.exit_code == -signal.SIGKILL and ran.seconds > _PATIENCE_S - 1
        faults.append(f"hung for {_PATIENCE_S:g} s" if killed else f"exit {ran.exit_code}")
    if "Traceback" in ran.all_said:
        faults.append("a traceback")
    if ran.seconds - start_s > MAX_SECONDS:
        faults.append(f"{ran.seconds - start_s:.1f} s (limit {MAX_SECONDS:g} s)")
    if ran.peak_bytes > MAX_PEAK_BYTES:
        faults.append(f"{ran.peak_bytes / 1e6:.0f} MB (limit {MAX_PEAK_BYTES / 1e6:.0f} MB)")
    if ran.leaked:
        faults.append("read another file")
    return faults


# Where files go


def _sound_of(make: Callable[[Samples], list[dict[str, bytes]]]) -> Build:
    def build(samples: Samples, folder: Path) -> None:
        for name, data in make(samples)[0].items():
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)

    return build


_SOUND: dict[str, Build] = {
    "a.bag": _sound_of(recordings.bag()),
    "a.mcap": _sound_of(recordings.mcap()),
    "a.db3": _sound_of(recordings.db3),
    "a.pcap": _sound_of(recordings.pcap),
    "a.pcapng": _sound_of(recordings.pcapng),
    "a.aedat4": _sound_of(recordings.closed_aedat4),
    "a.raw": _sound_of(recordings.evt3),
    "a.h5": _sound_of(recordings.hdf5),
    "a.npz": _sound_of(recordings.npz_own),
    "a.txt": _sound_of(recordings.text),
    "a.zip": _sound_of(recordings.zipped_text),
    "a.json": _sound_of(sessions.reference),
    "result.json": _sound_of(sessions.result),
    "a.onnx": _sound_of(sessions.network),
    "s": _sound_of(sessions.session),
    "truth": _sound_of(sessions.truth),
}


def _sound_folder(samples: Samples, folder: Path) -> None:
    image, cloud = recordings.image(".png")(samples)[0]["a.png"], recordings.pcd_binary(samples)[0]["a.pcd"]
    for kind, data in (("img/0.png", image), ("pcd/0.pcd", cloud)):
        path = folder / "f" / kind
        path.parent.mkdir(parents=True)
        path.write_bytes(data)


def _sound_profile(_samples: Samples, folder: Path) -> None:
    (folder / "a.yaml").write_text(dump_rig(small_rig()))


_COLLECT = "collect --rig {0}/rig.yaml {0}/new --from {0}/"
_RECONSTRUCT = "reconstruct {0}/%s -o {0}/new --event-image map"


def _recording(name: str, build: Build, *, is_reconstructed: bool = False) -> Bomb:
    command = _RECONSTRUCT % name if is_reconstructed else _COLLECT + name
    return Bomb(build, command, _SOUND[name])


def _data(name: str, make: Callable[[Samples], bytes]) -> Build:
    return lambda samples, folder: (folder / name).write_bytes(make(samples))


def _in_folder(place: str, make: Callable[[Samples], bytes]) -> Bomb:
    def build(samples: Samples, folder: Path) -> None:
        _sound_folder(samples, folder)
        old = next((folder / "f" / place).parent.iterdir())
        old.unlink()
        (folder / "f" / place).write_bytes(make(samples))

    return Bomb(build, _COLLECT + "f", _sound_folder)


def _in_session(name: str, make: Callable[[Samples], bytes], verb: str = "check {0}/s") -> Bomb:
    def build(samples: Samples, folder: Path) -> None:
        sound = sessions.session(samples)[0]
        for path, data in files.with_bomb(sound, name, make(samples)).items():
            file = folder / path
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_bytes(data)

    return Bomb(build, verb, _SOUND["s"], may_pass=True)


def _session_file(
    name: str, change: Callable[[Path], object], verb: str = "check {0}/s", *, may_pass: bool = False
) -> Bomb:
    """Change one file of a sound session."""

    def build(samples: Samples, folder: Path) -> None:
        _SOUND["truth" if name == "truth.json" else "s"](samples, folder)
        change(folder / "s" / name)

    return Bomb(build, verb, _SOUND["truth" if name == "truth.json" else "s"], may_pass=may_pass)


def _document(name: str, verb: str, change: Callable[[Path], object]) -> Bomb:
    """Change a document that is given beside a sound session."""

    def sound(samples: Samples, folder: Path) -> None:
        _SOUND["s"](samples, folder)
        _SOUND[name](samples, folder)

    def build(samples: Samples, folder: Path) -> None:
        sound(samples, folder)
        change(folder / name)

    return Bomb(build, verb, _SOUNDS.setdefault(verb, sound))


_SOUNDS: dict[str, Build] = {}
_CALIBRATE, _VERIFY = "calibrate {0}/s --reference {0}/a.json", "verify {0}/s --result {0}/result.json"
_PROFILE = "rigs check {0}/a.yaml"
_NETWORK = "reconstruct {0}/a.txt -o {0}/new --model {0}/a.onnx"


def _fifo(path: Path) -> None:
    path.unlink(missing_ok=True)
    os.mkfifo(path)


def _endless(path: Path) -> None:
    path.unlink(missing_ok=True)
    path.symlink_to("/dev/zero")


def _loop(path: Path) -> None:
    path.unlink(missing_ok=True)
    path.symlink_to(path.name)


def _sparse(path: Path) -> None:
    files.grow_sparse(path)


def _gzipped(path: Path) -> None:
    import gzip

    path.write_bytes(gzip.compress(path.read_bytes(), mtime=0))


def _line(path: Path) -> None:
    files.write_line(path, 200 << 20)


def _of(data: bytes) -> Callable[[Path], object]:
    return lambda path: path.write_bytes(data)


def _changed(name: str, change: Callable[[Path], object]) -> Build:
    def build(samples: Samples, folder: Path) -> None:
        _SOUND[name](samples, folder)
        change(folder / name)

    return build


def _network_bomb(change: Callable[[Path], object]) -> Bomb:
    def sound(samples: Samples, folder: Path) -> None:
        _SOUND["a.onnx"](samples, folder)
        _SOUND["a.txt"](samples, folder)

    def build(samples: Samples, folder: Path) -> None:
        sound(samples, folder)
        change(folder / "a.onnx")

    return Bomb(build, _NETWORK, _SOUNDS.setdefault(_NETWORK, sound))


def _profile_bomb(change: Callable[[Path], object], command: str = _PROFILE) -> Bomb:
    def build(samples: Samples, folder: Path) -> None:
        _sound_profile(samples, folder)
        change(folder / "a.yaml")

    return Bomb(build, command, _sound_profile)


def _external(kind: str, target: str) -> Build:
    def build(_samples: Samples, folder: Path) -> None:
        path = Path(target)
        if target == "secret":
            path = folder / "secret"
            path.write_bytes(files.SECRET)
        files.hdf5_external(folder / "a.h5", kind=kind, target=path)

    return build


def _pictured(encoded: Callable[[Samples], bytes]) -> Build:
    return _data("a.bag", lambda samples: recordings.bag_of_encoded(samples, [encoded(samples)] * 2))


def _cache_bomb(make: Callable[[Path], object]) -> Bomb:
    """Fill the cache by one `check`, then put a bomb in place of each entry."""

    def build(samples: Samples, folder: Path) -> None:
        _SOUND["s"](samples, folder)
        environment = {**os.environ, "PYTHONPATH": str(_ROOT)}
        command = [sys.executable, "-c", _MAIN, "check", str(folder / "s")]
        subprocess.run(command, env=environment, capture_output=True, check=False)
        entries = list((folder / "s" / "detections").rglob("*.npz"))
        assert entries, "check has stored nothing"
        for entry in entries:
            make(entry)

    return Bomb(build, "check {0}/s", _SOUND["s"], may_pass=True)


def _cached_zeros(path: Path) -> None:
    packed = files.deflated(b"\0", 2 * GB)
    path.write_bytes(files.zip_of({"head.npy": (packed, 2 * GB), "values_json.npy": (packed, 2 * GB)}))


def _loop_of_folders(samples: Samples, folder: Path) -> None:
    _sound_folder(samples, folder)
    for place in ("img/again", "pcd/again"):
        (folder / "f" / place).symlink_to(folder / "f")


def _metadata_bomb(data: bytes) -> Bomb:
    def build(samples: Samples, folder: Path) -> None:
        _sound_of(recordings.ros2_folder)(samples, folder)
        (folder / "bag" / "metadata.yaml").write_bytes(data)

    return Bomb(build, _COLLECT + "bag", _ROS2)


_ROS2 = _sound_of(recordings.ros2_folder)
_SUFFIXES = ("bag", "mcap", "db3", "pcap", "pcapng", "aedat4", "raw", "h5", "npz", "txt", "zip")


def _npz_zeros(_samples: Samples) -> bytes:
    return files.npz({"t_us.npy": (files.deflated(b"\0", 4 * GB), 4 * GB - 1)})


def _npz_declared(_samples: Samples) -> bytes:
    import zlib

    head = files.npy_header("(1000000000000,)")
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    return files.npz({"t_us.npy": (packer.compress(head) + packer.flush(), len(head))})


def _zip_line(_samples: Samples) -> bytes:
    return files.zip_of({"events.txt": (files.deflated(b"7", 3 * GB), 3 * GB)})


def _png_bomb(side_px: int) -> Callable[[Samples], bytes]:
    return lambda _samples: files.png(side_px)


BOMBS: dict[str, Bomb] = {
    # Chunks that unpack to much
    **{
        f"mcap-{kind}-{'declared' if is_honest else 'hidden'}{'-torn' if is_torn else ''}": _recording(
            "a.mcap", _data("a.mcap", files.mcap_chunk(kind, size, is_honest=is_honest, is_torn=is_torn))
        )
        for kind, size in (("zstd", 4 * GB), ("lz4", GB))
        for is_honest in (True, False)
        for is_torn in (True, False)
    },
    **{
        f"ros1-{kind}-{'declared' if is_honest else 'hidden'}{'-torn' if is_torn else ''}": _recording(
            "a.bag", _data("a.bag", files.ros1_chunk(kind, size, is_honest=is_honest, is_torn=is_torn))
        )
        for kind, size in (("bz2", 3 * GB), ("lz4", GB))
        for is_honest in (True, False)
        for is_torn in (True, False)
    },
    "aedat4-zstd": _recording("a.aedat4", _data("a.aedat4", files.aedat4_packet("zstd", 4 * GB))),
    "aedat4-lz4": _recording("a.aedat4", _data("a.aedat4", files.aedat4_packet("lz4", GB))),
    "aedat4-entities": _recording("a.aedat4", _data("a.aedat4", files.aedat4_entities)),
    "npz-zeros": _recording("a.npz", _data("a.npz", _npz_zeros)),
    "npz-declared": _recording("a.npz", _data("a.npz", _npz_declared)),
    "npz-zeros-reconstruct": _recording("a.npz", _data("a.npz", _npz_zeros), is_reconstructed=True),
    "zip-of-one-line": _recording("a.zip", _data("a.zip", _zip_line)),
    "zip-of-one-line-reconstruct": _recording("a.zip", _data("a.zip", _zip_line), is_reconstructed=True),
    "text-of-one-line": _recording("a.txt", lambda _s, folder: _line(folder / "a.txt")),
    "text-of-one-line-reconstruct": _recording(
        "a.txt", lambda _s, folder: _line(folder / "a.txt"), is_reconstructed=True
    ),
    # Sizes that are declared
    "png-30000-in-folder": _in_folder("img/0.png", _png_bomb(30_000)),
    "png-50000-in-folder": _in_folder("img/0.png", _png_bomb(50_000)),
    "jpeg-65500-in-folder": _in_folder("img/0.jpg", files.jpeg),
    "bmp-60000-in-folder": _in_folder("img/0.bmp", files.bmp),
    "tiff-60000-in-folder": _in_folder("img/0.tiff", lambda _samples: files.tiff()),
    "pgm-60000-in-folder": _in_folder("img/0.pgm", lambda _samples: b"P5\n60000 60000\n255\n" + bytes(1000)),
    "png-30000-in-session": _in_session(f"{CAMERA}.frames.png", _png_bomb(30_000)),
    "png-50000-in-session": _in_session(f"{CAMERA}.frames.png", _png_bomb(50_000)),
    "png-50000-calibrate": _in_session(f"{CAMERA}.frames.png", _png_bomb(50_000), "calibrate {0}/s"),
    "png-50000-intrinsics": _in_session(f"{CAMERA}.frames.png", _png_bomb(50_000), "intrinsics {0}/s"),
    "png-30000-in-bag": _recording("a.bag", _pictured(_png_bomb(30_000))),
    "cloud-declared-in-bag": _recording("a.mcap", _data("a.mcap", files.clouds_of_fields)),
    "pcd-fields-in-folder": _in_folder("pcd/0.pcd", lambda _samples: files.pcd_of_fields()),
    "pcd-fields-in-session": _in_session("lidar.pcd", lambda _samples: files.pcd_of_fields()),
    "pcd-lzf-in-folder": _in_folder("pcd/0.pcd", lambda _samples: files.pcd_lzf(60_000_000)),
    "pcd-lzf-in-session": _in_session("lidar.pcd", lambda _samples: files.pcd_lzf(60_000_000)),
    "npz-in-session": _in_session(f"{CAMERA}.events.npz", _npz_zeros),
    "manifest-sizes": _session_file(
        "captures/000000/meta.json",
        lambda path: path.write_bytes(path.read_bytes().replace(b'"bytes": ', b'"bytes": 9999999999')),
        may_pass=True,
    ),
    "hdf5-unwritten": _recording("a.h5", lambda _s, folder: files.hdf5_unwritten(folder / "a.h5")),
    "hdf5-unwritten-reconstruct": _recording(
        "a.h5", lambda _s, folder: files.hdf5_unwritten(folder / "a.h5"), is_reconstructed=True
    ),
    "hdf5-never-allocated": _recording("a.h5", lambda _s, folder: files.hdf5_contiguous(folder / "a.h5")),
    "hdf5-one-chunk": _recording("a.h5", lambda _s, folder: files.hdf5_zeros(folder / "a.h5")),
    **{
        f"hdf5-external-{kind}-{target.rpartition('/')[2]}": _recording(
            "a.h5", _external(kind, target), is_reconstructed=True
        )
        for kind in ("link", "storage", "virtual")
        for target in ("secret", "/etc/hostname")
    },
    "detection-cache": _cache_bomb(_cached_zeros),
    # Documents
    "profile-aliases": _profile_bomb(_of(files.yaml_aliases())),
    "profile-aliases-collect": _profile_bomb(
        _of(files.yaml_aliases()), "collect --rig {0}/a.yaml {0}/new --from {0}"
    ),
    "profile-depth": _profile_bomb(_of(files.json_depth())),
    "profile-of-one-line": _profile_bomb(_line),
    "profile-infinite": _profile_bomb(
        lambda path: path.write_text(path.read_text().replace("cy_px: 29.5", "cy_px: 1.0e+308"))
    ),
    "metadata-aliases": _metadata_bomb(files.yaml_aliases()),
    "metadata-depth": _metadata_bomb(files.json_depth()),
    "session-depth": _session_file("session.json", _of(files.json_depth())),
    "session-infinite": _session_file("session.json", _of(b'{"format_version": 1e999, "rig": "fuzz"}')),
    "session-of-one-line": _session_file("session.json", _line),
    "session-rig-aliases": _session_file("rig.yaml", _of(files.yaml_aliases())),
    "manifest-depth": _session_file("captures/000000/meta.json", _of(files.json_depth()), may_pass=True),
    "manifest-of-one-line": _session_file("captures/000000/meta.json", _line, may_pass=True),
    "truth-depth": _session_file(
        "truth.json", _of(files.json_depth()), _COLLECT.replace("new", "s") + "a.bag"
    ),
    "reference-of-401-digits": _document("a.json", _CALIBRATE, _of(files.reference_of_digits(401))),
    "reference-of-5000-digits": _document("a.json", _CALIBRATE, _of(files.reference_of_digits(5000))),
    "reference-depth": _document("a.json", _CALIBRATE, _of(files.json_depth())),
    "reference-of-one-line": _document("a.json", _CALIBRATE, _line),
    "result-depth": _document("result.json", _VERIFY, _of(files.json_depth())),
    "result-of-one-line": _document("result.json", _VERIFY, _line),
    "network-of-zeros": _network_bomb(lambda path: path.write_bytes(bytes(1000))),
    # Pipes, devices, links and holes in place of files
    **{
        f"{how}-{suffix}": _recording(f"a.{suffix}", _changed(f"a.{suffix}", change))
        for how, change in (
            ("fifo", _fifo),
            ("endless", _endless),
            ("loop", _loop),
            ("sparse", _sparse),
            ("gzip", _gzipped),
        )
        for suffix in _SUFFIXES
    },
    **{
        f"{how}-{kind}-in-folder": Bomb(
            lambda samples, folder, place=place, change=change: (  # type: ignore[misc]
                _sound_folder(samples, folder),
                change(folder / "f" / place),
            ),
            _COLLECT + "f",
            _sound_folder,
        )
        for how, change in (("fifo", _fifo), ("endless", _endless), ("loop", _loop), ("sparse", _sparse))
        for kind, place in (("image", "img/0.png"), ("cloud", "pcd/0.pcd"))
    },
    "loops-of-folders": Bomb(_loop_of_folders, _COLLECT + "f", _sound_folder, may_pass=True),
    **{
        f"{how}-{name.rpartition('/')[2]}": _session_file(
            name, change, may_pass=name.startswith(("captures", "journal"))
        )
        for how, change in (("fifo", _fifo), ("endless", _endless), ("loop", _loop), ("sparse", _sparse))
        for name in (
            "session.json",
            "rig.yaml",
            "captures/000000/meta.json",
            "captures/000000/lidar.pcd",
            f"captures/000000/{CAMERA}.frames.png",
        )
    },
    **{
        f"{how}-cache": _cache_bomb(change)
        for how, change in (("fifo", _fifo), ("endless", _endless), ("sparse", _sparse))
    },
    **{
        f"{how}-profile": _profile_bomb(change)
        for how, change in (("fifo", _fifo), ("endless", _endless), ("loop", _loop), ("sparse", _sparse))
    },
    **{
        f"{how}-reference": _document("a.json", _CALIBRATE, change)
        for how, change in (("fifo", _fifo), ("endless", _endless), ("loop", _loop), ("sparse", _sparse))
    },
    **{
        f"{how}-result": _document("result.json", _VERIFY, change)
        for how, change in (("fifo", _fifo), ("endless", _endless), ("loop", _loop), ("sparse", _sparse))
    },
    **{
        f"{how}-network": _network_bomb(change)
        for how, change in (("fifo", _fifo), ("endless", _endless), ("loop", _loop), ("sparse", _sparse))
    },
}
"""By name."""
