"""Small sound recordings of every kind, made by this program's own writers and by the formats' libraries."""

import io
import json
import struct
import tempfile
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from fuzzing import layers
from fuzzing.samples import CAMERA, SIZE, Samples
from lce_rig.core.data import Events, Scan
from lce_rig.core.event_file import encode_events
from lce_rig.core.pcd import encode_pcd

Files = dict[str, bytes]
"""Content by path in a folder."""


def _written(write: Callable[[Path], object], name: str) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / name
        write(path)
        return path.read_bytes()


# Clouds


def cloud_of(scan: Scan) -> np.ndarray:
    """Lay a scan out as a cloud of x, y, z, intensity, ring and time."""
    cloud = np.empty(
        len(scan.points),
        dtype=[
            ("x", "<f4"),
            ("y", "<f4"),
            ("z", "<f4"),
            ("intensity", "<f4"),
            ("ring", "<u2"),
            ("time", "<f4"),
        ],
    )
    cloud["x"], cloud["y"], cloud["z"] = scan.points.T
    cloud["intensity"], cloud["ring"] = scan.intensity, scan.ring
    cloud["time"] = 0 if scan.offset_ns is None else scan.offset_ns * 1e-9
    return cloud


def pcd_binary(samples: Samples) -> list[Files]:
    """Two clouds."""
    return [{"a.pcd": encode_pcd(cloud_of(scan), ["a comment"])} for scan in samples.scans]


def pcd_ascii(samples: Samples) -> list[Files]:
    """Two clouds, one without rings."""
    seeds = []
    for scan, names in zip(
        samples.scans, (("x", "y", "z", "intensity", "ring", "time"), ("x", "y", "z")), strict=True
    ):
        cloud = cloud_of(scan)
        head = encode_pcd(cloud[list(names)]).split(b"DATA")[0]
        rows = "\n".join(
            " ".join(repr(v.item()) for v in row) for row in zip(*(cloud[n] for n in names), strict=True)
        )
        seeds.append({"a.pcd": head + b"DATA ascii\n" + rows.encode() + b"\n"})
    return seeds


def pcd_compressed(samples: Samples) -> list[Files]:
    """Two clouds; one packed as literals, one with references, of a constant column."""
    seeds = []
    for scan in samples.scans:
        cloud = cloud_of(scan)
        raw = b"".join(cloud[name].tobytes() for name in cloud.dtype.names or ())
        packed = layers.lzf_literals(raw)
        head = encode_pcd(cloud).split(b"DATA")[0] + b"DATA binary_compressed\n"
        seeds.append({"a.pcd": head + struct.pack("<II", len(packed), len(raw)) + packed})
    zeros = np.zeros(500, dtype=[("x", "<f4"), ("y", "<f4"), ("z", "<f4")])
    zeros["x"] = 1
    raw = zeros["x"].tobytes() + bytes(4000)
    # A literal zero, then references to it of 264 bytes each.
    packed = layers.lzf_literals(zeros["x"].tobytes()) + b"\x00\x00"
    n_left = 3999
    while n_left >= 9:
        length = min(n_left, 264)
        packed += bytes([7 << 5, length - 9, 0])
        n_left -= length
    packed += layers.lzf_literals(bytes(n_left)) if n_left else b""
    head = encode_pcd(zeros).split(b"DATA")[0] + b"DATA binary_compressed\n"
    return [*seeds, {"a.pcd": head + struct.pack("<II", len(packed), len(raw)) + packed}]


def ply(encoding: str) -> Callable[[Samples], list[Files]]:
    """Two clouds in one of PLY's encodings; the second has an element in front of the vertices."""
    kinds = {"f4": "float", "u2": "ushort"}

    def make(samples: Samples) -> list[Files]:
        seeds = []
        for number, scan in enumerate(samples.scans):
            cloud = cloud_of(scan)
            names = cloud.dtype.names or ()
            extra = b"element camera 1\nproperty float view\n" if number else b""
            head = f"ply\nformat {encoding} 1.0\ncomment made here\n".encode() + extra
            head += f"element vertex {len(cloud)}\n".encode()
            head += b"".join(f"property {kinds[cloud.dtype[n].str[1:]]} {n}\n".encode() for n in names)
            head += b"end_header\n"
            if encoding == "ascii":
                rows = (
                    " ".join(repr(v.item()) for v in row)
                    for row in zip(*(cloud[n] for n in names), strict=True)
                )
                body = ("1.5\n" if number else "") + "\n".join(rows) + "\n"
                seeds.append({"a.ply": head + body.encode()})
            else:
                order = "<" if "little" in encoding else ">"
                packed = cloud.astype([(n, order + cloud.dtype[n].str[1:]) for n in names])
                first = struct.pack(f"{order}f", 1.5) if number else b""
                seeds.append({"a.ply": head + first + packed.tobytes()})
        return seeds

    return make


# Images


def image(suffix: str, *, is_deep: bool = False) -> Callable[[Samples], list[Files]]:
    """A grey image and one in colour, as one kind of file."""

    def make(samples: Samples) -> list[Files]:
        import cv2

        grey = samples.images[0].pixels
        colour = np.stack([grey, np.roll(grey, 3, 0), np.roll(grey, 5, 1)], axis=2)
        seeds = []
        for pixels in (grey,) if suffix == ".pgm" else (colour,) if suffix == ".ppm" else (grey, colour):
            data = pixels.astype(np.uint16) * 16 if is_deep else pixels
            is_done, encoded = cv2.imencode(suffix, data)
            assert is_done, suffix
            seeds.append({f"a{suffix}": encoded.tobytes()})
        return seeds

    return make


def y4m(samples: Samples) -> list[Files]:
    """Two images in Y4M."""
    pixels = [each.pixels for each in samples.images]
    frames = b"".join(b"FRAME\n" + p.tobytes() + bytes([128]) * (p.size // 2) for p in pixels)
    mono = b"".join(b"FRAME\n" + p.tobytes() for p in pixels)
    head = f"YUV4MPEG2 W{SIZE[0]} H{SIZE[1]} F30:1 Ip A1:1 "
    return [{"a.y4m": f"{head}C420jpeg\n".encode() + frames}, {"a.y4m": f"{head}Cmono\n".encode() + mono}]


def jpeg_stream(samples: Samples) -> list[Files]:
    """Two JPEGs one behind the other."""
    parts = [seed["a.jpg"] for seed in image(".jpg")(samples)]
    return [{"a.mjpeg": b"".join(parts)}, {"a.mjpeg": parts[1] + parts[0]}]


def pnm_stream(samples: Samples) -> list[Files]:
    """A PGM and a PPM, one behind the other."""
    grey, colour = image(".pgm")(samples)[0]["a.pgm"], image(".ppm")(samples)[0]["a.ppm"]
    return [{"a.pnm": grey + grey}, {"a.pnm": colour + colour}]


# Bags


def bag(compression: str = "") -> Callable[[Samples], list[Files]]:
    """A ROS 1 bag of images, scans and events; and one whose images are compressed."""

    def make(samples: Samples) -> list[Files]:
        plain = _recorded(samples, "a.bag")
        return [
            {"a.bag": _ros1_recompressed(data, compression)} for data in (plain, _compressed_images(samples))
        ]

    return make


def torn_bag(samples: Samples) -> list[Files]:
    """ROS 1 bags without an index."""
    return [
        {"a.bag": layers.ros1_unindexed(seed["a.bag"])} for kind in ("", "lz4") for seed in bag(kind)(samples)
    ]


def mcap(compression: str = "") -> Callable[[Samples], list[Files]]:
    """A single mcap file of images, scans and events."""

    def make(samples: Samples) -> list[Files]:
        return [{"a.mcap": layers.mcap_recompressed(mcap_file(samples), compression)}]

    return make


def torn_mcap(samples: Samples) -> list[Files]:
    """mcap files without a summary."""
    return [{"a.mcap": layers.mcap_unindexed(mcap(kind)(samples)[0]["a.mcap"])} for kind in ("", "zstd")]


def db3(samples: Samples) -> list[Files]:
    """A single sqlite3 file."""
    return [{"a.db3": layers.write_raw_messages(layers.messages_in(mcap_file(samples), ".mcap"), ".db3")}]


def ros2_folder(samples: Samples) -> list[Files]:
    """Folders of a ROS 2 bag: mcap, sqlite3, and sqlite3 with compressed messages."""
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

    messages = layers.messages_in(mcap_file(samples), ".mcap")
    seeds = []
    for plugin, is_packed in (
        (StoragePlugin.MCAP, False),
        (StoragePlugin.SQLITE3, False),
        (StoragePlugin.SQLITE3, True),
    ):
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "bag"
            writer: Any = Writer(path, version=9, storage_plugin=plugin)
            if is_packed:
                writer.set_compression(CompressionMode.MESSAGE, CompressionFormat.ZSTD)
            with writer:
                layers.add_raw_messages(writer, messages, is_ros1=False)
            seeds.append({f"bag/{file.name}": file.read_bytes() for file in sorted(path.iterdir())})
    return seeds


def _recorded(samples: Samples, name: str) -> bytes:
    from lce_rig.io.ros.bag_recorder import BagRecorder

    def write(path: Path) -> None:
        with BagRecorder(path, samples.rig) as recorder:
            for sample in (*samples.scans, *samples.images, samples.events):
                recorder.write(sample)

    return _written(write, name)


def mcap_file(samples: Samples) -> bytes:
    """Record images, scans and events as mcap, without the folder's metadata."""
    from lce_rig.io.ros.bag_recorder import BagRecorder

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bag"
        with BagRecorder(path, samples.rig) as recorder:
            for sample in (*samples.scans, *samples.images, samples.events):
                recorder.write(sample)
        return next(path.glob("*.mcap")).read_bytes()


def _ros1_recompressed(data: bytes, compression: str) -> bytes:
    if not compression:
        return data
    from rosbags.rosbag1 import Writer

    messages = layers.messages_in(data, ".bag")

    def write(path: Path) -> None:
        writer = Writer(path)
        writer.set_compression(Writer.CompressionFormat[compression.upper()])
        with writer:
            layers.add_raw_messages(writer, messages, is_ros1=True)

    return _written(write, "a.bag")


def _compressed_images(samples: Samples) -> bytes:
    encoded = [image(suffix)(samples)[0][f"a{suffix}"] for suffix in (".jpg", ".png")]
    return bag_of_encoded(samples, encoded)


def bag_of_encoded(samples: Samples, encoded: Sequence[bytes]) -> bytes:
    """Write encoded images as sensor_msgs/CompressedImage into a ROS 1 bag, and clouds as they are."""
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    types: Any = store.types
    name = "sensor_msgs/msg/CompressedImage"
    clouds = [
        m for m in layers.messages_in(_recorded(samples, "a.bag"), ".bag") if "PointCloud2" in m[0].msgtype
    ]

    def write(path: Path) -> None:
        with Writer(path) as writer:
            layers.add_raw_messages(writer, clouds, is_ros1=True)
            connection = writer.add_connection("/davis/image_raw", name, typestore=store)
            for each, data, form in zip(samples.images, encoded, ("jpeg", "png"), strict=True):
                stamp_ns = each.stamp_ns or 0
                stamp = types["builtin_interfaces/msg/Time"](sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
                header = types["std_msgs/msg/Header"](seq=0, stamp=stamp, frame_id="cam")
                message = types[name](header=header, format=form, data=np.frombuffer(data, np.uint8))
                writer.write(connection, stamp_ns, store.serialize_ros1(message, name))

    return _written(write, "a.bag")


def event_packets(suffix: str) -> Callable[[Samples], list[Files]]:
    """Bags of event_camera_msgs/EventPacket in each of the drivers' encodings."""
    definition = (
        "std_msgs/Header header\nuint32 height\nuint32 width\nuint64 seq\nuint64 time_base\n"
        "string encoding\nbool is_bigendian\nuint8[] events\n"
    )

    def make(samples: Samples) -> list[Files]:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        is_ros1 = suffix == ".bag"
        store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
        name = "event_camera_msgs/msg/EventPacket"
        store.register(get_types_from_msg(definition, name))
        types: Any = store.types
        first_ns = int(samples.events.t_ns[0])
        seeds = []
        for encoding, payload in _payloads(samples.events).items():
            stamp = types["builtin_interfaces/msg/Time"](sec=first_ns // 10**9, nanosec=first_ns % 10**9)
            header = types["std_msgs/msg/Header"](
                **({"seq": 0} if is_ros1 else {}), stamp=stamp, frame_id="cam"
            )
            pack = store.serialize_ros1 if is_ros1 else store.serialize_cdr
            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder) / ("a.bag" if is_ros1 else "a")
                with layers.bag_writer(path, suffix) as writer:
                    connection = writer.add_connection("/davis/events", name, typestore=store)
                    for k in range(1 if encoding == "evt3" else 3):
                        base_ns = 0 if encoding == "evt3" else first_ns + k * 10**9
                        message = types[name](
                            header=header, height=SIZE[1], width=SIZE[0], seq=k, time_base=base_ns,
                            encoding=encoding, is_bigendian=False, events=np.frombuffer(payload, np.uint8),
                        )  # fmt: skip
                        writer.write(connection, first_ns + k * 10**9, bytes(pack(message, name)))
                file = path if is_ros1 else next(path.glob(f"*{suffix}"))
                seeds.append({f"a{suffix}": file.read_bytes()})
        return seeds

    return make


def _payloads(events: Events) -> dict[str, bytes]:
    """Encode events as the drivers do: EVT3, and a word of 64 bits for each event."""
    t_us = events.t_ns // 1000 - int(events.t_ns[0]) // 1000
    polarity = events.polarity.astype(np.uint64)
    x, y, t = events.x.astype(np.uint64), events.y.astype(np.uint64), t_us.astype(np.uint64)
    mono = polarity << np.uint64(63) | y << np.uint64(48) | x << np.uint64(32) | t * np.uint64(1000)
    libcaer = (
        (t << np.uint64(32))
        | x << np.uint64(17)
        | y << np.uint64(2)
        | polarity << np.uint64(1)
        | np.uint64(1)
    )
    return {
        "evt3": evt3_words(events),
        "mono": mono.astype("<u8").tobytes(),
        "libcaer": libcaer.astype("<u8").tobytes(),
    }


# Packets of the network


def pcap(samples: Samples) -> list[Files]:
    """A pcap file of two revolutions of a VLP-16, position packets between them."""
    from lce_rig.io.velodyne.datagrams import PcapWriter

    def write(path: Path) -> None:
        with PcapWriter(path) as writer:
            for datagram in _datagrams(samples):
                writer.write(datagram)

    return [{"a.pcap": _written(write, "a.pcap")}]


def pcapng(samples: Samples) -> list[Files]:
    """The same as a pcapng file, with options, a packet of each kind."""
    from lce_rig.io.velodyne.datagrams import build_frame

    def block(kind: int, body: bytes) -> bytes:
        body += bytes(-len(body) % 4)
        size = struct.pack("<I", 12 + len(body))
        return struct.pack("<I", kind) + size + body + size

    section = block(0x0A0D0D0A, struct.pack("<IHHq", 0x1A2B3C4D, 1, 0, -1))
    options = struct.pack("<HHB3x", 9, 1, 9) + struct.pack("<HHq", 14, 8, 0) + struct.pack("<HH", 0, 0)
    data = section + block(1, struct.pack("<HHI", 1, 0, 65535) + options)
    for datagram in _datagrams(samples):
        frame = build_frame(datagram)
        high, low = divmod(datagram.host_ns, 1 << 32)
        data += block(6, struct.pack("<IIIII", 0, high, low, len(frame), len(frame)) + frame)
    simple = build_frame(_datagrams(samples)[0])
    return [{"a.pcapng": data + block(3, struct.pack("<I", len(simple)) + simple)}]


def _datagrams(samples: Samples) -> list[Any]:
    from wire.vlp16_packets import Vlp16Packets

    from lce_rig.io.velodyne.datagrams import Datagram

    packets = Vlp16Packets()
    sent = [packet for scan in samples.whole_scans for packet in packets.feed(scan)] + packets.finish()
    return [
        Datagram(packet.sent_ns + 500_000, "192.168.1.201", packet.port, packet.port, packet.payload)
        for packet in sent
    ]


# Files of event cameras


def aedat4(compression: str) -> Callable[[Samples], list[Files]]:
    """An AEDAT4 file of events, as this program writes it, never closed."""
    packs: dict[str, Callable[[bytes], bytes]] = {
        "none": bytes,
        "lz4": lambda data: bytes(layers.lz4().compress(data)),
        "zstd": lambda data: bytes(layers.zstd().compress(data)),
    }

    def make(samples: Samples) -> list[Files]:
        return [{"a.aedat4": layers.aedat4_recompressed(_open_aedat4(samples), packs[compression])}]

    return make


def closed_aedat4(samples: Samples) -> list[Files]:
    """An AEDAT4 file with its table of packets."""
    from lce_rig.io.events.aedat4_writer import write_aedat4

    return [{"a.aedat4": _written(lambda path: write_aedat4(path, _halves(samples.events)), "a.aedat4")}]


def aedat4_frames(samples: Samples) -> list[Files]:
    """An AEDAT4 file of events and frames: the frames' packets are laid out here."""
    events = _open_aedat4(samples)
    packets = list(layers.aedat4_packets(events))
    head = events[: packets[0][0]].replace(b"</dv>", b"")
    xml_at = head.index(b"<dv")
    xml = events[xml_at : packets[0][0]].rstrip(b"\0")
    stream = xml[xml.index(b'  <node name="0"') : xml.rindex(b" </node>\n</dv>")]
    frames = (
        stream.replace(b'name="0"', b'name="1"')
        .replace(b"outInfo/0/", b"outInfo/1/")
        .replace(b"EVTS", b"FRME")
    )
    text = xml.replace(b" </node>\n</dv>", frames + b" </node>\n</dv>")
    from lce_rig.io.events.aedat4_file import MAGIC
    from lce_rig.io.events.aedat4_writer import _header

    body = MAGIC + _header(text)
    for at, packet in packets:
        body += events[at : at + 8] + packet
    for each in samples.images:
        table = frame_table((each.stamp_ns or 0) // 1000, 4000, each.pixels)
        body += struct.pack("<ii", 1, len(table)) + table
    return [{"a.aedat4": body}]


def frame_table(start_us: int, exposure_us: int, pixels: np.ndarray) -> bytes:
    """Lay out dv's flatbuffer Frame with the fields that dv-processing writes."""
    slots = {0: 8, 3: 16, 4: 24, 6: 32, 7: 34, 10: 36, 11: 40}
    n_slots = 12
    vtable = struct.pack("<HH", 4 + 2 * n_slots, 48) + b"".join(
        struct.pack("<H", slots.get(index, 0)) for index in range(n_slots)
    )
    vtable_at = 8
    table_at = -(-(vtable_at + len(vtable)) // 8) * 8
    height, width = pixels.shape[:2]
    inline = struct.pack(
        "<i4xqqqhhIq",
        table_at - vtable_at,
        start_us,
        start_us,
        start_us + exposure_us,
        width,
        height,
        12,
        exposure_us,
    )
    body = struct.pack("<I4s", table_at, b"FRME") + vtable + bytes(table_at - vtable_at - len(vtable))
    body += inline + struct.pack("<I", pixels.size) + pixels.tobytes() + b"\0"
    return struct.pack("<I", len(body)) + body


def _open_aedat4(samples: Samples) -> bytes:
    """Write the file and cut its table off, as a recorder that was killed leaves it."""
    from lce_rig.io.events.aedat4_file import read_header
    from lce_rig.io.events.aedat4_writer import _END_AT

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.aedat4"
        path.write_bytes(closed_aedat4(samples)[0]["a.aedat4"])
        header, data = read_header(path), bytearray(path.read_bytes())
    data[_END_AT : _END_AT + 8] = struct.pack("<q", -1)
    return bytes(data[: header.end])


def _halves(events: Events) -> list[Events]:
    middle = len(events) // 2
    return [events.select(slice(0, middle)), events.select(slice(middle, None))]


def _from_zero_us(events: Events) -> np.ndarray:
    return np.asarray(events.t_ns // 1000 - int(events.t_ns[0]) // 1000 + 100)


def evt2(samples: Samples) -> list[Files]:
    """EVT2 files with heads of both styles."""
    words, high = list[int](), -1
    for t, x, y, p in _listed(samples.events):
        if t >> 6 != high:
            high = t >> 6
            words.append(8 << 28 | high & 0xFFFFFFF)
        words.append(p << 28 | (t & 0x3F) << 22 | x << 11 | y)
    body = struct.pack(f"<{len(words)}I", *words)
    return [{"a.raw": head.encode() + body} for head in _heads("2")]


def evt21(samples: Samples) -> list[Files]:
    """EVT2.1 files: one event a word."""
    words, high = list[int](), -1
    for t, x, y, p in _listed(samples.events):
        if t >> 6 != high:
            high = t >> 6
            words.append(8 << 60 | (high & 0xFFFFFFF) << 32)
        words.append(p << 60 | (t & 0x3F) << 54 | x << 43 | y << 32 | 1)
    body = struct.pack(f"<{len(words)}Q", *words)
    return [{"a.raw": head.encode() + body} for head in _heads("21")]


def evt3(samples: Samples) -> list[Files]:
    """EVT3 files."""
    return [{"a.raw": head.encode() + evt3_words(samples.events)} for head in _heads("3")]


def evt3_words(events: Events) -> bytes:
    """Encode events as EVT3, every third as a vector."""
    words: list[int] = []
    high = low = row = -1
    for k, (t, x, y, p) in enumerate(_listed(events)):
        if t >> 12 != high:
            high, low = t >> 12, -1
            words.append(8 << 12 | high & 0xFFF)
        if t & 0xFFF != low:
            low = t & 0xFFF
            words.append(6 << 12 | low)
        if y != row:
            row = y
            words.append(y)
        words += [2 << 12 | p << 11 | x] if k % 3 else [3 << 12 | p << 11 | x, 4 << 12 | 1, 5 << 12]
    return struct.pack(f"<{len(words)}H", *words)


def _heads(version: str) -> Sequence[str]:
    width, height = SIZE
    dotted = {"2": "2.0", "21": "2.1", "3": "3.0"}[version]
    return (
        f"% evt {dotted}\n% geometry {width}x{height}\n% end\n",
        f"% camera_integrator_name X\n% format EVT{version};height={height};width={width}\n% end\n",
    )


def _listed(events: Events) -> list[tuple[int, int, int, int]]:
    columns = (_from_zero_us(events), events.x, events.y, events.polarity.astype(int))
    return list(zip(*(column.tolist() for column in columns), strict=True))


def hdf5(samples: Samples) -> list[Files]:
    """DSEC's layout, plain, and in compressed chunks with checksums."""
    packed = {"compression": "gzip", "chunks": (64,), "fletcher32": True}
    columns = _dsec_columns(samples.events)
    seeds = [_written(lambda path, o=o: _write_dsec(path, columns, {}, o), "a.h5") for o in ({}, packed)]  # type: ignore[misc]
    return [{"a.h5": data} for data in seeds]


def hdf5_strange(samples: Samples) -> list[Files]:
    """Columns and attributes of types that no recorder writes."""
    import h5py  # type: ignore[import-untyped]

    columns = _dsec_columns(samples.events)
    n = len(columns["t"])
    strange: tuple[Any, ...] = (
        np.zeros(n, dtype=[("a", "<i4"), ("b", "<f4")]),
        np.array([b"12"] * n),
        np.zeros((n, 2), np.uint16),
        np.uint16(3),
        np.full(n, np.nan),
        np.zeros(n, np.complex128),
        h5py.Empty("<u2"),
    )
    seeds = [
        _written(lambda path, k=k, v=v: _write_dsec(path, columns, {"txyp"[k % 4]: v}, {}), "a.h5")  # type: ignore[misc]
        for k, v in enumerate(strange)
    ]

    def write_text(path: Path) -> None:
        with h5py.File(path, "w") as file:
            for name, values in columns.items():
                file[f"events/{name}"] = values
            del file["events/x"]
            file["events/x"] = np.array(["a"] * n, dtype=h5py.string_dtype())
            file.attrs["width"], file["events"].attrs["height"] = h5py.Empty("<i4"), "high"
            file["t_offset"] = np.zeros(0)

    return [{"a.h5": data} for data in (*seeds, _written(write_text, "a.h5"))]


def _dsec_columns(events: Events) -> dict[str, np.ndarray]:
    t_us = _from_zero_us(events).astype(np.uint32)
    return {"t": t_us, "x": events.x, "y": events.y, "p": events.polarity.astype(np.uint8)}


def _write_dsec(
    path: Path, columns: dict[str, np.ndarray], changed: dict[str, Any], options: dict[str, Any]
) -> None:
    import h5py

    with h5py.File(path, "w") as file:
        for name, values in {**columns, **changed}.items():
            file.create_dataset(f"events/{name}", data=values, **(options if name not in changed else {}))
        file["t_offset"] = 10**15
        file.attrs["width"], file.attrs["height"] = SIZE


def npz_own(samples: Samples) -> list[Files]:
    """The program's own archive of events."""
    shifted = replace(samples.events, t_ns=samples.events.t_ns + 1, host_ns=5)
    return [{"a.npz": encode_events(events)} for events in (samples.events, shifted)]


def npz_foreign(samples: Samples) -> list[Files]:
    """Archives of other programs: other names, times in seconds, compressed."""
    events = samples.events
    seconds = {
        "t": events.t_ns * 1e-9,
        "x": events.x.astype(float),
        "y": events.y,
        "p": events.polarity.astype(int),
    }
    short = {"ts": events.t_ns // 1000, "xs": events.x, "ys": events.y, "pol": events.polarity}
    seeds = []
    for columns, save in ((seconds, np.savez), (short, np.savez_compressed)):
        buffer = io.BytesIO()
        save(buffer, **columns)  # type: ignore[operator]
        seeds.append({"a.npz": buffer.getvalue()})
    return seeds


def text(samples: Samples) -> list[Files]:
    """E2VID's text with and without its size."""
    lines = [f"{t // 10**6}.{t % 10**6:06d} {x} {y} {p}" for t, x, y, p in _listed(samples.events)]
    return [
        {"a.txt": ("\n".join([f"{SIZE[0]} {SIZE[1]}", *lines]) + "\n").encode()},
        {"a.txt": ("\n".join(["# t x y p", *lines]) + "\n").encode()},
    ]


def zipped_text(samples: Samples) -> list[Files]:
    """The same in a zip."""
    seeds = []
    for seed in text(samples):
        buffer = io.BytesIO()
        with zipfile.ZipFile(buffer, "w") as archive:
            archive.writestr(zipfile.ZipInfo("events.txt"), seed["a.txt"], zipfile.ZIP_DEFLATED)
        seeds.append({"a.zip": buffer.getvalue()})
    return seeds


# Folders


def folder(samples: Samples) -> list[Files]:
    """Images and clouds side by side; names are listed in a file, as names are damaged, too."""
    names = {
        "by stem": [
            f"{kind}/{k:05d}.{suffix}" for k in range(2) for kind, suffix in (("img", "png"), ("pcd", "pcd"))
        ],
        "by time": [
            f"{kind}/{1700000000 + k}.{k}5.{suffix}"
            for k in range(2)
            for kind, suffix in (("img", "png"), ("pcd", "pcd"))
        ],
        "by camera": [f"img/{CAMERA}/1700000000000000000.png", "pcd/1700000000000000000.pcd"],
    }
    contents = {"image": image(".png")(samples)[0]["a.png"], "cloud": pcd_binary(samples)[0]["a.pcd"]}
    return [{"names.txt": "\n".join(listed).encode(), **contents} for listed in names.values()]


def recorded_folder(samples: Samples) -> list[Files]:
    """A folder that several recorders filled: a bag, packets and an event camera's file."""
    return [
        {
            "folder/recording.bag": bag()(samples)[0]["a.bag"],
            f"folder/{CAMERA}.aedat4": closed_aedat4(samples)[0]["a.aedat4"],
        }
    ]


def velodyne_web(_samples: Samples) -> list[Files]:
    """What a VLP-16's web page answers."""
    host = {"addr": "255.255.255.255", "dport": "2368", "tport": 8308}
    fov, gps = {"start": 0, "end": 359}, {"pps_state": "Locked", "position": "4807.038N 01131.000E"}
    motor, laser = {"state": "On", "rpm": 600}, {"state": "On"}
    pages = {
        "info": {"model": "VLP-16", "serial": "AG29123456789", "major": {"version": "3.0.37.0"}},
        "status": {"gps": gps, "motor": motor, "laser": laser},
        "settings": {"rpm": "600", "returns": "Strongest", "fov": fov, "host": host, "laser": "On"},
        "diag": {"volt_temp": {"top": {"lm20_temp": 2000}, "bot": {"lm20_temp": 2100}}},
    }
    return [{"pages.json": json.dumps(pages).encode()}]
