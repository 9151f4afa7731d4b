"""AEDAT4 files of a DAVIS, events and frames, laid out independently of the readers."""

import struct
from dataclasses import dataclass

import numpy as np

Value = tuple[str, int] | bytes
"""A number with its struct code, or the content of a vector of bytes or of structs."""

NAMES = {"EVTS": "events", "FRME": "frames"}
XML = """<dv version="2.0"><node name="outInfo" path="/mainloop/Recorder/outInfo/">{streams}</node></dv>"""
STREAM = """<node name="{number}" path="/mainloop/Recorder/outInfo/{number}/">
<attr key="compression" type="string">NONE</attr>
<attr key="originalModuleName" type="string">capture</attr>
<attr key="originalOutputName" type="string">{name}</attr>
<attr key="typeDescription" type="string">{kind}</attr>
<attr key="typeIdentifier" type="string">{kind}</attr>
<node name="info" path="/mainloop/Recorder/outInfo/{number}/info/">
<attr key="sizeX" type="int">{width}</attr><attr key="sizeY" type="int">{height}</attr>
<attr key="source" type="string">{camera}</attr></node></node>"""


@dataclass(frozen=True, eq=False)
class RawFrame:
    """A frame as it is written; `style` selects the fields by program."""

    start_us: int
    exposure_us: int
    pixels: np.ndarray
    style: str = "dv-processing"


def flatbuffer(identifier, fields, n_of_vector=None):
    """Lay out one table with its size in front, from which alignment counts; eight bytes a field."""
    n_slots = max(fields) + 1
    vtable_bytes = 4 + 2 * n_slots
    table_at = -(-(8 + vtable_bytes) // 8) * 8
    inline, tail = bytearray(4 + 8 * len(fields)), bytearray()
    slots = [0] * n_slots
    for place, (index, value) in enumerate(sorted(fields.items())):
        slots[index] = 4 + 8 * place
        if isinstance(value, bytes):
            # Structs begin at multiples of eight, behind their number.
            tail += bytes(-(table_at + len(inline) + len(tail)) % 8)
            begin = table_at + len(inline) + len(tail)
            struct.pack_into("<I", inline, slots[index], begin - table_at - slots[index])
            tail += struct.pack("<I", len(value) if n_of_vector is None else n_of_vector) + value + b"\0"
        else:
            struct.pack_into(f"<{value[0]}", inline, slots[index], value[1])
    vtable_at = table_at - vtable_bytes
    struct.pack_into("<i", inline, 0, vtable_bytes)
    head = struct.pack("<I4s", table_at, identifier) + bytes(vtable_at - 8)
    vtable = struct.pack(f"<HH{n_slots}H", vtable_bytes, len(inline), *slots)
    body = head + vtable + bytes(inline) + bytes(tail)
    return struct.pack("<I", len(body)) + body


def event_packet(events):
    """Lay out EventPacket."""
    raw = np.zeros(len(events), [("t", "<i8"), ("x", "<i2"), ("y", "<i2"), ("on", "?"), ("pad", "V3")])
    raw["t"], raw["x"], raw["y"], raw["on"] = events.t_ns // 1000, events.x, events.y, events.polarity
    return flatbuffer(b"EVTS", {0: raw.tobytes()}, len(events))


def frame_packet(frame):
    """Lay out Frame: DV stamps the middle of the exposure, dv-processing its start."""
    height, width = frame.pixels.shape[:2]
    end_us = frame.start_us + frame.exposure_us
    fields = {6: ("h", width), 7: ("h", height), 10: frame.pixels.tobytes()}
    if frame.pixels.ndim == 3:
        fields[5] = ("b", {3: 16, 4: 24}[frame.pixels.shape[2]])
    if frame.style == "dv":
        fields |= {
            0: ("q", (frame.start_us + end_us) // 2),
            1: ("q", frame.start_us - 9000),
            2: ("q", end_us + 9000),
        }
        fields |= {3: ("q", frame.start_us), 4: ("q", end_us)}
    elif frame.style == "dv-processing":
        fields |= {
            0: ("q", frame.start_us),
            3: ("q", frame.start_us),
            4: ("q", end_us),
            11: ("q", frame.exposure_us),
        }
    else:
        fields |= {0: ("q", frame.start_us)}
    return flatbuffer(b"FRME", fields)


def write_davis(path, events, frames, resolution_px=(346, 260), camera="DAVIS346_0"):
    """Write a file whose recorder was not closed: packets by time of their first stamp."""
    width, height = resolution_px
    kinds = (["EVTS"] if events or not frames else []) + (["FRME"] if frames else [])
    streams = "".join(
        STREAM.format(number=n, kind=kind, name=NAMES[kind], width=width, height=height, camera=camera)
        for n, kind in enumerate(kinds)
    )
    header = flatbuffer(b"IOHE", {1: ("q", -1), 2: XML.format(streams=streams).encode()})
    packets = [(int(e.t_ns[0]) // 1000, kinds.index("EVTS"), event_packet(e)) for e in events]
    packets += [(f.start_us, kinds.index("FRME"), frame_packet(f)) for f in frames]
    with path.open("wb") as file:
        file.write(b"#!AER-DAT4.0\r\n" + header)
        for _, number, data in sorted(packets, key=lambda packet: packet[:2]):
            file.write(struct.pack("<ii", number, len(data)) + data)
    return path


def write_aedat4(path, stretches, camera="lce_rig"):
    """Write events as a DVXplorer's recorder does, in packets of 8192; without any, an empty stream."""
    parts = list(stretches)
    packets = [part.select(slice(k, k + 8192)) for part in parts for k in range(0, len(part), 8192)]
    size = (parts[0].width_px, parts[0].height_px) if parts else (346, 260)
    write_davis(path, packets, [], size, camera)
