"""V4L2 structures and ioctl numbers of 64-bit Linux, limited to capture.

References:
    https://docs.kernel.org/userspace-api/media/v4l/v4l2.html, linux/videodev2.h
"""

import ctypes
from ctypes import Structure, Union, c_int32, sizeof
from typing import Any

VIDEO_CAPTURE = 1
MEMORY_MMAP = 1
FIELD_NONE = 1

CAP_VIDEO_CAPTURE = 0x0000_0001
CAP_STREAMING = 0x0400_0000
CAP_DEVICE_CAPS = 0x8000_0000

BUFFER_ERROR = 0x40
STAMP_SOURCE_MASK, STAMP_SOURCE_SOE = 0x7_0000, 0x1_0000

NEXT_CONTROL = 0x8000_0000
CONTROL_DISABLED = 0x1
INTEGER, BOOLEAN, MENU, INTEGER64, BITMASK, INTEGER_MENU = 1, 2, 3, 5, 8, 9
EXPOSURE_ABSOLUTE_ID = 0x009A_0902
"""V4l2Control of the exposure, in units of 100 us."""

_KINDS: dict[str, Any] = {
    "char": ctypes.c_char,
    "u8": ctypes.c_uint8,
    "u32": ctypes.c_uint32,
    "s32": ctypes.c_int32,
    "u64": ctypes.c_uint64,
    "s64": ctypes.c_int64,
    "long": ctypes.c_long,
    "pointer": ctypes.c_void_p,
}


def _lay_out(name: str, fields: str, base: type = Structure, **kinds: Any) -> Any:
    """Lay out a structure of the kernel.

    Args:
        name: name of the structure.
        fields: name, type and, for arrays, length of each, such as "driver char 16, version u32".
        base: Structure or Union.
        kinds: nested structures, by the names of their fields.
    """
    layout = []
    for field in fields.split(","):
        label, kind, *n = field.split()
        element = kinds[label] if label in kinds else _KINDS[kind]
        layout.append((label, element * int(n[0]) if n else element))
    return type(name, (base,), {"_fields_": layout})


Capability = _lay_out(
    "Capability",
    "driver char 16, card char 32, bus_info char 32, version u32, capabilities u32, device_caps u32, "
    "reserved u32 3",
)
FormatDescription = _lay_out(
    "FormatDescription",
    "index u32, type u32, flags u32, description char 32, pixelformat char 4, mbus_code u32, reserved u32 3",
)
PixFormat = _lay_out(
    "PixFormat",
    "width u32, height u32, pixelformat char 4, field u32, bytesperline u32, sizeimage u32, colorspace u32, "
    "priv u32, flags u32, ycbcr_enc u32, quantization u32, xfer_func u32",
)
# The kernel's union also holds pointers, which align it to 8 bytes.
_FormatUnion = _lay_out("_FormatUnion", "pix struct, raw u8 200, aligned pointer", Union, pix=PixFormat)
Format = _lay_out("Format", "type u32, fmt union", fmt=_FormatUnion)
CaptureParameters = _lay_out(
    "CaptureParameters",
    "type u32, capability u32, capturemode u32, numerator u32, denominator u32, extendedmode u32, "
    "readbuffers u32, reserved u8 176",
)
"""Rate of images, as the time of one in numerator / denominator seconds."""
BufferRequest = _lay_out(
    "BufferRequest", "count u32, type u32, memory u32, capabilities u32, flags u8, reserved u8 3"
)
_TimeValue = _lay_out("_TimeValue", "seconds long, microseconds long")
_Memory = _lay_out("_Memory", "offset u32, userptr u64", Union)
Buffer = _lay_out(
    "Buffer",
    "index u32, type u32, bytesused u32, flags u32, field u32, timestamp struct, timecode u8 16, "
    "sequence u32, memory u32, m union, length u32, reserved2 u32, request_fd s32",
    timestamp=_TimeValue,
    m=_Memory,
)
ControlQuery = _lay_out(
    "ControlQuery",
    "id u32, type u32, name char 32, minimum s64, maximum s64, step u64, default_value s64, flags u32, "
    "elem_size u32, elems u32, nr_of_dims u32, dims u32 4, reserved u32 32",
)


class _ControlUnion(Union):
    _pack_ = 1
    _layout_ = "ms"
    _fields_ = (("value", c_int32), ("value64", ctypes.c_int64), ("pointer", ctypes.c_void_p))


class V4l2Control(Structure):
    """The value of one setting."""

    _pack_ = 1
    _layout_ = "ms"
    _fields_ = (
        ("id", ctypes.c_uint32),
        ("size", ctypes.c_uint32),
        ("reserved2", ctypes.c_uint32),
        ("value", _ControlUnion),
    )


V4l2Controls = _lay_out(
    "V4l2Controls",
    "which u32, count u32, error_idx u32, request_fd s32, reserved u32, controls pointer",
    controls=ctypes.POINTER(V4l2Control),
)


def _code(direction: int, number: int, kind: type[Structure] | type[c_int32]) -> int:
    return direction << 30 | sizeof(kind) << 16 | ord("V") << 8 | number


_WRITE, _READ, _BOTH = 1, 2, 3
QUERY_CAPABILITY = _code(_READ, 0, Capability)
ENUMERATE_FORMATS = _code(_BOTH, 2, FormatDescription)
SET_FORMAT = _code(_BOTH, 5, Format)
REQUEST_BUFFERS = _code(_BOTH, 8, BufferRequest)
QUERY_BUFFER = _code(_BOTH, 9, Buffer)
QUEUE_BUFFER = _code(_BOTH, 15, Buffer)
DEQUEUE_BUFFER = _code(_BOTH, 17, Buffer)
STREAM_ON = _code(_WRITE, 18, c_int32)
STREAM_OFF = _code(_WRITE, 19, c_int32)
SET_PARAMETERS = _code(_BOTH, 22, CaptureParameters)
GET_CONTROLS = _code(_BOTH, 71, V4l2Controls)
SET_CONTROLS = _code(_BOTH, 72, V4l2Controls)
QUERY_CONTROL = _code(_BOTH, 103, ControlQuery)
