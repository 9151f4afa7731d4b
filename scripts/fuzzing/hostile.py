"""Inputs that hang or swell a careless reader: false promises, bombs, devices and pipes."""

import bz2
import os
import shutil
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import cv2
import lz4.frame  # type: ignore[import-untyped]
import numpy as np
from saved_results import made_calibration, write_result

from lce_rig.rig import load_rig

BOMB_BYTES = 5_100_000_000
_BLOCK = bytes(1 << 24)
_SPARSE_BYTES = 100 << 30
# Number of valid pairs beside a bad file.
N_NEIGHBOURS = 3

Make = Callable[[Path, Path], list[str]]
"""From a new folder and a whole session of three captures to the words of a command line."""


def add_result(whole: Path) -> None:
    """Add a result to the session, for the verbs that need one."""
    rig = load_rig(whole / "rig.yaml")
    write_result(
        whole / "calibration" / "result.json", rig.name, [made_calibration(np.eye(4), 1e-6 * np.eye(6))]
    )


def _pairs(folder: Path, whole: Path) -> Path:
    """Write three intact pairs, and return the folder."""
    recording = folder / "recording"
    for name, file in (("img", "cam.frames.png"), ("pcd", "lidar.pcd")):
        (recording / name).mkdir(parents=True)
        for k in range(N_NEIGHBOURS):
            shutil.copy(whole / "captures" / f"{k:06d}" / file, recording / name / f"{k}{Path(file).suffix}")
    return recording


def _collect(folder: Path, whole: Path, path: Path) -> list[str]:
    return ["collect", "--rig", str(whole / "rig.yaml"), str(folder / "session"), "--from", str(path)]


def beside(name: str, write: Callable[[Path], None]) -> Make:
    """Put one bad file with a valid partner beside valid pairs."""

    def make(folder: Path, whole: Path) -> list[str]:
        recording = _pairs(folder, whole)
        is_image = Path(name).suffix in (".png", ".jpg", ".tif", ".pgm", ".bmp", ".webp")
        write(recording / ("img" if is_image else "pcd") / f"9{Path(name).suffix}")
        partner = "lidar.pcd" if is_image else "cam.frames.png"
        shutil.copy(
            whole / "captures" / "000000" / partner,
            recording / ("pcd" if is_image else "img") / f"9{Path(partner).suffix}",
        )
        return _collect(folder, whole, recording)

    return make


def recording(name: str, write: Callable[[Path], None]) -> Make:
    """Use one bad file as the recording."""

    def make(folder: Path, whole: Path) -> list[str]:
        write(folder / name)
        topics = ["--topic", "cam.frames=/camera/image", "--topic", "lidar=/points"]
        return _collect(folder, whole, folder / name) + topics

    return make


def words(write: Callable[[Path], None], *line: str, name: str = "input.yaml") -> Make:
    """Use one bad file as an argument, {} in a command line; {rig} and {session} are intact."""

    def make(folder: Path, whole: Path) -> list[str]:
        write(folder / name)
        places = {"rig": whole / "rig.yaml", "session": whole, "folder": folder}
        return [word.format(folder / name, **places) for word in line]

    return make


def data(content: bytes) -> Callable[[Path], None]:
    """Write these bytes."""
    return lambda path: _write(path, content)


def _write(path: Path, content: bytes) -> None:
    path.write_bytes(content)


def zeros(path: Path) -> None:
    """Link to a device without an end."""
    path.symlink_to("/dev/zero")


def pipe(path: Path) -> None:
    """Create a named pipe without a writer."""
    os.mkfifo(path)


def sparse(head: bytes = b"") -> Callable[[Path], None]:
    """Write a file of 100 GB that takes no space."""

    def write(path: Path) -> None:
        path.write_bytes(head)
        os.truncate(path, _SPARSE_BYTES)

    return write


def _png(width: int, height: int, claimed: int | None = None) -> bytes:
    """Write a PNG image that claims a size, or one chunk of a claimed length."""

    def chunk(kind: bytes, content: bytes, length: int | None = None) -> bytes:
        n = len(content) if length is None else length
        return struct.pack(">I", n) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    head = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    pixels = zlib.compress(bytes((width + 1) * min(height, 64)))
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", head)
        + chunk(b"tEXt", b"Comment\0" + bytes(64), claimed)
        + chunk(b"IDAT", pixels)
        + chunk(b"IEND", b"")
    )


def _las(n_vlrs: int = 0, n_points: int = 1, n_evlrs: int = 0) -> bytes:
    """Write the header of a LAS 1.4 file with one point."""
    head = struct.pack("<4sHH16sBB32s32sHHHIIBHI", b"LASF", 0, 0, bytes(16), 1, 4, b"", b"", 1, 2026, 375,
                       375, n_vlrs, 0, 20, min(n_points, 2**32 - 1))  # fmt: skip
    head += bytes(20) + struct.pack("<12d", *[0.001] * 3, *[0.0] * 9)
    head += struct.pack("<QQIQ", 0, 395 if n_evlrs else 0, n_evlrs, n_points)
    return head.ljust(375, b"\0") + bytes(20)


def _jpeg() -> bytes:
    """Change a JPEG image's header to 65,500 x 65,500 px."""
    plain = bytearray(cv2.imencode(".jpg", np.zeros((16, 16, 3), np.uint8))[1].tobytes())
    at = plain.index(b"\xff\xc0")
    plain[at + 5 : at + 9] = struct.pack(">HH", 65500, 65500)
    return bytes(plain)


def _tiff() -> bytes:
    """Write a TIFF image of 8,000 x 8,000 px with a strip of a stated size of 3 GB."""
    entries = [(256, 4, 8000), (257, 4, 8000), (258, 3, 8), (259, 3, 1), (262, 3, 1), (273, 4, 8),
               (277, 3, 1), (278, 4, 8000), (279, 4, 3_000_000_000)]  # fmt: skip
    rows = b"".join(struct.pack("<HHII", tag, kind, 1, value) for tag, kind, value in entries)
    return b"II*\0" + struct.pack("<I", 8) + struct.pack("<H", len(entries)) + rows + bytes(4)


def _pcd(*, points: int = 1, data: str = "binary", body: bytes = bytes(12), count: str = "1 1 1") -> bytes:
    fields = f"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT {count}\n"
    head = f"VERSION 0.7\n{fields}WIDTH {points}\nHEIGHT 1\nPOINTS {points}\nDATA {data}\n"
    return head.encode() + body


def _ply(n: int, encoding: str, body: bytes) -> bytes:
    properties = "".join(f"property float {axis}\n" for axis in "xyz")
    return f"ply\nformat {encoding} 1.0\nelement vertex {n}\n{properties}end_header\n".encode() + body


def _yaml_bomb() -> bytes:
    """Write nine levels of nine references each."""
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]" for k in range(1, 10)]
    return "\n".join([*lines, "name: rig", "cameras: *a9", "lidars: *a9", "robots: *a9", ""]).encode()


def _bomb(kind: str, n_bytes: int = BOMB_BYTES) -> bytes:
    """Compress zeros, without holding them."""
    from backports import zstd

    out, n_left = [], n_bytes
    if kind == "lz4":
        compressor = lz4.frame.LZ4FrameCompressor(block_size=lz4.frame.BLOCKSIZE_MAX4MB)
        out.append(compressor.begin())
    else:
        compressor = bz2.BZ2Compressor() if kind == "bz2" else zstd.ZstdCompressor()
    while n_left:
        piece = _BLOCK[: min(n_left, len(_BLOCK))]
        out.append(compressor.compress(piece))
        n_left -= len(piece)
    out.append(compressor.flush())
    return b"".join(out)


def _record(code: int, content: bytes) -> bytes:
    return struct.pack("<BQ", code, len(content)) + content


def _text(text: str) -> bytes:
    return struct.pack("<I", len(text)) + text.encode()


def _mcap(compression: str, packed: bytes, claimed: int, length: int | None = None) -> bytes:
    """Write an mcap file of one chunk, without an index."""
    chunk = (
        struct.pack("<QQQI", 0, 1, claimed, 0) + _text(compression) + struct.pack("<Q", len(packed)) + packed
    )
    record = struct.pack("<BQ", 6, len(chunk) if length is None else length) + chunk
    schema = _record(3, struct.pack("<H", 1) + _text("sensor_msgs/msg/Image") + _text("ros2msg") + _text(""))
    channel = _record(4, struct.pack("<HH", 1, 1) + _text("/camera/image") + _text("cdr") + _text(""))
    magic = b"\x89MCAP0\r\n"
    return (
        magic + _record(1, _text("ros2") + _text("")) + schema + channel + record
        + _record(15, bytes(4)) + _record(2, bytes(20)) + magic
    )  # fmt: skip


def _mcap_bomb(kind: str) -> Callable[[Path], None]:
    return lambda path: _write(path, _mcap(kind, _bomb(kind), BOMB_BYTES))


def _ros1_bomb(kind: str) -> Callable[[Path], None]:
    """Write a compressed ROS 1 bag of images with a chunk that unpacks to 5.1 GB."""

    def write(path: Path) -> None:
        from rosbags.rosbag1 import Writer
        from rosbags.typesys import Stores, get_typestore

        store = get_typestore(Stores.ROS1_NOETIC)
        writer = Writer(path)
        writer.set_compression(writer.CompressionFormat[kind.upper()])
        writer.compressor = lambda _: _bomb(kind)
        with writer:
            connection = writer.add_connection("/camera/image", "sensor_msgs/msg/Image", typestore=store)
            points = writer.add_connection("/points", "sensor_msgs/msg/PointCloud2", typestore=store)
            for k in range(3):
                writer.write(connection, 10**18 + k, bytes(100))
                writer.write(points, 10**18 + k, bytes(100))

    return write


def _pcap() -> bytes:
    head = struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 2**32 - 1, 1)
    return head + struct.pack("<IIII", 0, 0, 3_900_000_000, 3_900_000_000)


_CONTENTS: dict[str, Callable[[Path], None]] = {
    "empty": data(b""),
    "zero": zeros,
    "pipe": pipe,
    "bomb": data(_yaml_bomb()),
    "deep": data(b"[" * 100_000),
    "wide": data(b"name: rig\ncameras: [" + b"x, " * 1_000_000 + b"]\n"),
    "100gb": sparse(),
}
_NEW = "rigs new new -o - --board 8x6,0.07,0.767x0.626 --lidar VLP-16 --camera cam --intrinsics {}"
_RUN = "fleet run {session} --workers 1"


def _each(what: str, contents: str, line: str, name: str = "input.yaml") -> dict[str, Make]:
    """Use a file of each content as the same argument of a command line."""
    return {f"{what}_{of}": words(_CONTENTS[of], *line.split(), name=name) for of in contents.split()}


# Four bytes that claim to unpack to 4 GB.
_LZF = struct.pack("<III", 4, 2**32 - 1, 0)
_SUFFIXES = (".bag", ".mcap", ".db3", ".pcap", ".aedat4", ".raw", ".h5")

HOSTILE: dict[str, Make] = {
    "las_vlrs": beside("a.las", data(_las(n_vlrs=2**32 - 1))),
    "las_evlrs": beside("a.las", data(_las(n_evlrs=2**32 - 1))),
    "las_points": beside("a.las", data(_las(n_points=2**40))),
    "pcd_count": beside("a.pcd", data(_pcd(count="1 1 9999999"))),
    "pcd_points": beside("a.pcd", data(_pcd(points=10**12))),
    "pcd_ascii_points": beside("a.pcd", data(_pcd(points=10**12, data="ascii", body=b"1 2 3\n"))),
    "pcd_lzf": beside("a.pcd", data(_pcd(data="binary_compressed", body=_LZF))),
    "ply_points": beside("a.ply", data(_ply(10**12, "binary_little_endian", bytes(12)))),
    "ply_ascii_points": beside("a.ply", data(_ply(10**12, "ascii", b"1 2 3\n"))),
    "png_chunk": beside("a.png", data(_png(64, 64, 3_400_000_000))),
    "png_chunk_2g": beside("a.png", data(_png(64, 64, 2_100_000_000))),
    "png_size": beside("a.png", data(_png(60000, 60000))),
    "png_64mpx": beside("a.png", data(_png(8000, 8000))),
    "jpeg_size": beside("a.jpg", data(_jpeg())),
    "tiff_strip": beside("a.tif", data(_tiff())),
    "pgm_size": beside("a.pgm", data(b"P5 60000 60000 255\n" + bytes(100))),
    "png_100gb": beside("a.png", sparse(b"\x89PNG\r\n\x1a\n")),
    "pcd_100gb": beside("a.pcd", sparse(_pcd())),
    "png_zero": beside("a.png", zeros),
    "png_pipe": beside("a.png", pipe),
    "pcd_zero": beside("a.pcd", zeros),
    "pcd_pipe": beside("a.pcd", pipe),
    "mcap_lz4": recording("a.mcap", _mcap_bomb("lz4")),
    "mcap_zstd": recording("a.mcap", _mcap_bomb("zstd")),
    "mcap_false_size": recording("a.mcap", lambda path: _write(path, _mcap("zstd", _bomb("zstd"), 100))),
    "mcap_length": recording("a.mcap", data(_mcap("", b"", 0, 2**62))),
    "mcap_100gb": recording("a.mcap", sparse(b"\x89MCAP0\r\n")),
    "bag_lz4": recording("a.bag", _ros1_bomb("lz4")),
    "bag_bz2": recording("a.bag", _ros1_bomb("bz2")),
    "db3_zstd": recording("a.db3.zstd", lambda path: _write(path, _bomb("zstd"))),
    "pcap_length": recording("a.pcap", data(_pcap())),
    "pcap_100gb": recording("a.pcap", sparse(_pcap())),
    **{f"{suffix[1:]}_zero": recording(f"a{suffix}", zeros) for suffix in _SUFFIXES},
    **{f"{suffix[1:]}_pipe": recording(f"a{suffix}", pipe) for suffix in _SUFFIXES},
    **_each("metadata", "zero pipe bomb", "collect --rig {rig} {folder}/s --from {folder}", "metadata.yaml"),
    **_each("rig", "zero pipe bomb deep wide 100gb", "rigs check {}"),
    **_each("intrinsics", "zero pipe bomb deep wide 100gb", _NEW),
    **_each("manifest", "zero pipe bomb deep", _RUN + " --registry {folder}/r --manifest {}"),
    **_each("targets", "zero pipe bomb", "deploy {session} --target x --targets {}"),
    **_each("reference", "zero pipe", "calibrate {session} --reference {}"),
    **_each("into", "zero pipe", "export {session} --into {}", "robot.urdf"),
    **_each("registry", "zero pipe", "fleet table --registry {}", "registry"),
    **_each("registry_null", "empty", "fleet table --registry /dev/null"),
    **_each("registry_zip", "empty", "fleet table --registry zip://a.zip"),
    **_each("registry_run", "empty", _RUN + " --registry /dev/null"),
}
"""By name: what writes the input and gives the command line."""
