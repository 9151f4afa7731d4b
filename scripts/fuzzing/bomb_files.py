"""Small files that ask for much: memory, time, or other files than themselves."""

import bz2
import io
import json
import os
import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np

from fuzzing import layers
from fuzzing import seeds_of_recordings as recordings
from fuzzing.samples import Samples
from fuzzing.seeds_of_recordings import Files

GB = 1 << 30
_PIECE = 1 << 24
SECRET = b"this must never be read"


def zstd_of_zeros(n_bytes: int) -> bytes:
    """Compress zeros as one frame of Zstandard."""
    compressor = layers.zstd().ZstdCompressor()
    parts = [compressor.compress(bytes(_PIECE)) for _ in range(n_bytes // _PIECE)]
    return b"".join(parts) + bytes(compressor.flush())


def lz4_of_zeros(n_bytes: int) -> bytes:
    """Compress zeros as one frame of LZ4."""
    with layers.lz4().LZ4FrameCompressor() as compressor:
        parts = [compressor.begin(), *(compressor.compress(bytes(_PIECE)) for _ in range(n_bytes // _PIECE))]
        return b"".join(parts) + bytes(compressor.flush())


def bz2_of_zeros(n_bytes: int) -> bytes:
    """Compress zeros as streams of bzip2, one behind the other."""
    return bz2.compress(bytes(_PIECE)) * (n_bytes // _PIECE)


def deflated(content: bytes, n_bytes: int) -> bytes:
    """Compress the same piece again and again as one stream of deflate, without reading it as often."""
    compressor = zlib.compressobj(9, zlib.DEFLATED, -15)
    piece = content * (_PIECE // len(content))
    block = compressor.compress(piece) + compressor.flush(zlib.Z_FULL_FLUSH)
    return block * (n_bytes // _PIECE) + zlib.compressobj(9, zlib.DEFLATED, -15).flush()


def zip_of(members: dict[str, tuple[bytes, int]]) -> bytes:
    """Lay out a zip of deflated members with their declared sizes; the checksums of large ones do not fit."""
    body, directory = b"", b""
    for name, (packed, n_raw) in members.items():
        crc = zlib.crc32(zlib.decompress(packed, -15)) if n_raw <= _PIECE else 0
        fields = struct.pack("<HHHHHIII", 20, 0, 8, 0, 33, crc, len(packed), min(n_raw, 0xFFFFFFFF))
        ends = struct.pack("<HH", len(name), 0)
        at = len(body)
        body += b"PK\3\4" + fields + ends + name.encode() + packed
        entry = b"PK\1\2" + struct.pack("<H", 20) + fields + ends + struct.pack("<HHHII", 0, 0, 0, 0, at)
        directory += entry + name.encode()
    n = len(members)
    return body + directory + b"PK\5\6" + struct.pack("<HHHHIIH", 0, 0, n, n, len(directory), len(body), 0)


def npy_header(shape: str, kind: str = "<i8") -> bytes:
    """Lay out the head of a NumPy file."""
    text = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}"
    text += " " * (-(len(text) + 11) % 64) + "\n"
    return b"\x93NUMPY\1\0" + struct.pack("<H", len(text)) + text.encode()


def png(side_px: int) -> bytes:
    """Lay out a sound PNG of one bit a pixel, all black."""
    row = bytes(1 + -(-side_px // 8))
    compressor = zlib.compressobj(9)
    packed = b"".join(compressor.compress(row * 100) for _ in range(side_px // 100)) + compressor.flush()
    head = struct.pack(">IIBBBBB", side_px, side_px, 1, 0, 0, 0, 0)
    return layers.PNG_CHUNKS.join(b"", [b"IHDR" + head, b"IDAT" + packed, b"IEND"])


def jpeg(samples: Samples, side_px: int = 65_500) -> bytes:
    """Declare another size in a JPEG."""
    data = bytearray(recordings.image(".jpg")(samples)[0]["a.jpg"])
    at = data.index(b"\xff\xc0") + 5
    data[at : at + 4] = struct.pack(">HH", side_px, side_px)
    return bytes(data)


def bmp(samples: Samples, side_px: int = 60_000) -> bytes:
    """Declare another size in a BMP."""
    data = bytearray(recordings.image(".bmp")(samples)[0]["a.bmp"])
    data[18:26] = struct.pack("<ii", side_px, side_px)
    return bytes(data)


def tiff(side_px: int = 60_000) -> bytes:
    """Lay out a TIFF of one strip of that size, which is not there."""
    entries = [(256, 4, 1, side_px), (257, 4, 1, side_px), (258, 3, 1, 8), (259, 3, 1, 1), (262, 3, 1, 1)]
    entries += [(273, 4, 1, 8), (277, 3, 1, 1), (278, 4, 1, side_px), (279, 4, 1, side_px * side_px % 2**32)]
    packed = b"".join(struct.pack("<HHII", *entry) for entry in entries)
    return b"II*\0" + struct.pack("<I", 8) + struct.pack("<H", len(entries)) + packed + bytes(1000)


def pcd_of_fields(n_fields: int = 1500, count: int = 65_536, n_points: int = 1000) -> bytes:
    """Declare many fields of many numbers."""
    names = ["x", "y", "z", *(f"f{k}" for k in range(n_fields - 3))]
    counts = ["1", "1", "1"] + [str(count)] * (n_fields - 3)
    lines = ["VERSION 0.7", "FIELDS " + " ".join(names), "SIZE " + " ".join(["8"] * n_fields)]
    lines += ["TYPE " + " ".join(["F"] * n_fields), "COUNT " + " ".join(counts)]
    lines += [f"WIDTH {n_points}", "HEIGHT 1", f"POINTS {n_points}", "DATA ascii"]
    return ("\n".join(lines) + "\n" + "1 2 3\n" * n_points).encode()


def pcd_lzf(n_points: int) -> bytes:
    """Pack so many points of zeros with LZF, 88 times smaller."""
    n_raw = 12 * n_points
    head = f"VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {n_points}\nHEIGHT 1\n"
    packed = b"\x00\x00" + bytes([7 << 5, 255, 0]) * ((n_raw - 1) // 264)
    n_left = n_raw - 1 - 264 * ((n_raw - 1) // 264)
    packed += layers.lzf_literals(bytes(n_left))
    lengths = struct.pack("<II", len(packed), n_raw % 2**32)
    return f"{head}POINTS {n_points}\nDATA binary_compressed\n".encode() + lengths + packed


def mcap_chunk(
    kind: str, n_bytes: int, *, is_honest: bool, is_torn: bool = False
) -> Callable[[Samples], bytes]:
    """Let the chunk of an mcap unpack to many zeros, with its size or a small one declared."""

    def make(samples: Samples) -> bytes:
        packed = {"zstd": zstd_of_zeros, "lz4": lz4_of_zeros}[kind](n_bytes)
        sound = recordings.mcap_file(samples)
        data = layers.mcap_with_chunk(sound, packed, n_bytes if is_honest else 40_000, 0, kind.encode())
        return layers.mcap_unindexed(data) if is_torn else data

    return make


def ros1_chunk(
    kind: str, n_bytes: int, *, is_honest: bool, is_torn: bool = False
) -> Callable[[Samples], bytes]:
    """Let the chunk of a ROS 1 bag unpack to many zeros."""

    def make(samples: Samples) -> bytes:
        packed = {"bz2": bz2_of_zeros, "lz4": lz4_of_zeros}[kind](n_bytes)
        sound = recordings.bag(kind)(samples)[0]["a.bag"]
        data = layers.ros1_with_chunk(sound, packed, n_bytes if is_honest else 40_000)
        return layers.ros1_unindexed(data) if is_torn else data

    return make


def aedat4_packet(kind: str, n_bytes: int) -> Callable[[Samples], bytes]:
    """Put a packet that unpacks to many zeros in front of the others."""

    def make(samples: Samples) -> bytes:
        sound = recordings.aedat4("none")(samples)[0]["a.aedat4"]
        at = next(layers.aedat4_packets(sound))[0]
        packed = {"zstd": zstd_of_zeros, "lz4": lz4_of_zeros}[kind](n_bytes)
        return sound[:at] + struct.pack("<ii", 0, len(packed)) + packed + sound[at:]

    return make


def aedat4_entities(samples: Samples) -> bytes:
    """Let the text in the head of a file grow by nested entities."""
    from lce_rig.io.events.aedat4_file import MAGIC
    from lce_rig.io.events.aedat4_writer import _header

    entities = "".join(f'<!ENTITY a{k} "{f"&a{k - 1};" * 10}">' for k in range(1, 12))
    text = f'<?xml version="1.0"?><!DOCTYPE dv [<!ENTITY a0 "lol">{entities}]>'
    text += '<dv><node name="outInfo">&a11;</node></dv>'
    return MAGIC + _header(text.encode())


def hdf5_unwritten(path: Path, n_events: int = 10**12) -> None:
    """Declare events that were never written."""
    import h5py  # type: ignore[import-untyped]

    with h5py.File(path, "w") as file:
        for name, kind in (("t", "u4"), ("x", "u2"), ("y", "u2"), ("p", "u1")):
            file.create_dataset(f"events/{name}", shape=(n_events,), dtype=kind, chunks=(1 << 16,))


def hdf5_contiguous(path: Path, n_events: int = 10**9) -> None:
    """Declare events in one piece that was never allocated."""
    import h5py

    with h5py.File(path, "w") as file:
        for name, kind in (("t", "u4"), ("x", "u2"), ("y", "u2"), ("p", "u1")):
            file.create_dataset(f"events/{name}", shape=(n_events,), dtype=kind)


def hdf5_zeros(path: Path, n_events: int = 1 << 29) -> None:
    """Store one chunk of compressed zeros, larger than memory should be."""
    import h5py

    with h5py.File(path, "w") as file:
        for name, kind in (("t", "u4"), ("x", "u2"), ("y", "u2"), ("p", "u1")):
            own = file.create_dataset(
                f"events/{name}", shape=(n_events,), dtype=kind, chunks=(n_events,), compression="gzip"
            )
            n_raw = n_events * np.dtype(kind).itemsize
            own.id.write_direct_chunk((0,), b"\x78\x9c" + deflated(b"\0", n_raw) + b"\0\0\0\1")


def hdf5_external(path: Path, *, kind: str, target: Path) -> None:
    """Let columns lie in another file: by a link, as raw storage, or as a virtual data set."""
    import h5py

    with h5py.File(path, "w") as file:
        for name in "txyp":
            if kind == "link":
                file[f"events/{name}"] = h5py.ExternalLink(str(target), f"/{name}")
            elif kind == "storage":
                file.create_dataset(f"events/{name}", shape=(8,), dtype="u1", external=[(str(target), 0, 8)])
            else:
                layout = h5py.VirtualLayout(shape=(8,), dtype="u1")
                layout[:] = h5py.VirtualSource(str(target), name, shape=(8,))
                file.create_virtual_dataset(f"events/{name}", layout)
        file.attrs["width"] = file.attrs["height"] = 256


def yaml_aliases() -> bytes:
    """Let a list of lists grow by aliases."""
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]" for k in range(1, 12)]
    return "\n".join(lines).encode()


def json_depth(n: int = 100_000) -> bytes:
    """Nest lists."""
    return b"[" * n


def reference_of_digits(n: int) -> bytes:
    """Put a whole number of many digits into a matrix."""
    return b'{"T_cam_lidar": [[' + b"9" * n + b", 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}"


def write_line(path: Path, n_bytes: int, begin: bytes = b"") -> None:
    """Write a text without a newline."""
    with path.open("wb") as file:
        file.write(begin)
        for _ in range(n_bytes // _PIECE):
            file.write(b"7" * _PIECE)


def grow_sparse(path: Path, n_bytes: int = 1 << 40) -> None:
    """Let a file end 1 TB later, in a hole."""
    os.truncate(path, n_bytes)


def npz(members: dict[str, tuple[bytes, int]]) -> bytes:
    """Lay out an archive of events whose columns are small, but for those given."""
    buffer = io.BytesIO()
    columns = {name: np.zeros(4, np.int64) for name in ("t_us", "x", "y", "polarity")}
    np.savez(buffer, **columns)  # type: ignore[arg-type]
    with zipfile.ZipFile(buffer) as archive:
        all_members = {name: archive.read(name) for name in archive.namelist()}
    packed = {name: (zlib.compressobj(9, zlib.DEFLATED, -15), data) for name, data in all_members.items()}
    sound = {name: (c.compress(data) + c.flush(), len(data)) for name, (c, data) in packed.items()}
    return zip_of(sound | members)


def clouds_of_fields(samples: Samples) -> bytes:
    """Write PointCloud2 messages that declare more points than they hold."""
    messages = layers.messages_in(recordings.mcap_file(samples), ".mcap")
    changed = []
    for connection, stamp, raw in messages:
        data = bytearray(raw)
        if "PointCloud2" in connection.msgtype:
            # Header (stamp, frame_id), then height and width.
            (n,) = struct.unpack_from("<I", data, 12)
            at = 16 + n + -(16 + n - 4) % 4
            struct.pack_into("<II", data, at, 0x7FFFFFFF, 0x7FFFFFFF)
        changed.append((connection, stamp, bytes(data)))
    return layers.write_raw_messages(changed, ".mcap")


def with_bomb(files: Files, name: str, data: bytes) -> Files:
    """Replace one file of a session's first capture, and let the manifest vouch for it."""
    from fuzzing.seeds_of_sessions import CAPTURE, resealed

    return resealed(files | {f"{CAPTURE}/{name}": data})


def manifest_of_sizes(files: Files) -> Files:
    """Let a manifest declare sizes that no file has."""
    from fuzzing.seeds_of_sessions import CAPTURE

    manifest = json.loads(files[f"{CAPTURE}/meta.json"])
    for entry in manifest["files"]:
        entry["bytes"] = 10**15
    return files | {f"{CAPTURE}/meta.json": json.dumps(manifest).encode()}
