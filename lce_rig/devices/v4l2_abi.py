"""The kernel's video interface, as 64-bit Linux lays it out; only what reading a camera takes.

References:
    https://docs.kernel.org/userspace-api/media/v4l/v4l2.html, linux/videodev2.h
"""

from ctypes import (
    POINTER,
    Structure,
    Union,
    c_char,
    c_int32,
    c_int64,
    c_long,
    c_uint8,
    c_uint32,
    c_uint64,
    c_ulong,
    c_void_p,
    sizeof,
)

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


class Capability(Structure):
    """Identity and capabilities of a device."""

    _fields_ = (
        ("driver", c_char * 16),
        ("card", c_char * 32),
        ("bus_info", c_char * 32),
        ("version", c_uint32),
        ("capabilities", c_uint32),
        ("device_caps", c_uint32),
        ("reserved", c_uint32 * 3),
    )


class FormatDescription(Structure):
    """One pixel format that a device offers."""

    _fields_ = (
        ("index", c_uint32),
        ("type", c_uint32),
        ("flags", c_uint32),
        ("description", c_char * 32),
        ("pixelformat", c_char * 4),
        ("mbus_code", c_uint32),
        ("reserved", c_uint32 * 3),
    )


class PixFormat(Structure):
    """Size and layout of images."""

    _fields_ = (
        ("width", c_uint32),
        ("height", c_uint32),
        ("pixelformat", c_char * 4),
        ("field", c_uint32),
        ("bytesperline", c_uint32),
        ("sizeimage", c_uint32),
        ("colorspace", c_uint32),
        ("priv", c_uint32),
        ("flags", c_uint32),
        ("ycbcr_enc", c_uint32),
        ("quantization", c_uint32),
        ("xfer_func", c_uint32),
    )


class _FormatUnion(Union):
    # The kernel's union also holds pointers, which align it to 8 bytes.
    _fields_ = (("pix", PixFormat), ("raw", c_uint8 * 200), ("aligned", c_void_p))


class Format(Structure):
    """Size and layout of images, by type of stream."""

    _fields_ = (("type", c_uint32), ("fmt", _FormatUnion))


class CaptureParameters(Structure):
    """Rate of images, as the time of one in numerator / denominator seconds."""

    _fields_ = (
        ("type", c_uint32),
        ("capability", c_uint32),
        ("capturemode", c_uint32),
        ("numerator", c_uint32),
        ("denominator", c_uint32),
        ("extendedmode", c_uint32),
        ("readbuffers", c_uint32),
        ("reserved", c_uint8 * 176),
    )


class BufferRequest(Structure):
    """How many buffers to set aside."""

    _fields_ = (
        ("count", c_uint32),
        ("type", c_uint32),
        ("memory", c_uint32),
        ("capabilities", c_uint32),
        ("flags", c_uint8),
        ("reserved", c_uint8 * 3),
    )


class _TimeValue(Structure):
    _fields_ = (("seconds", c_long), ("microseconds", c_long))


class _Memory(Union):
    _fields_ = (("offset", c_uint32), ("userptr", c_ulong))


class Buffer(Structure):
    """One buffer: where it lies, and what the kernel says about the image in it."""

    _fields_ = (
        ("index", c_uint32),
        ("type", c_uint32),
        ("bytesused", c_uint32),
        ("flags", c_uint32),
        ("field", c_uint32),
        ("timestamp", _TimeValue),
        ("timecode", c_uint8 * 16),
        ("sequence", c_uint32),
        ("memory", c_uint32),
        ("m", _Memory),
        ("length", c_uint32),
        ("reserved2", c_uint32),
        ("request_fd", c_int32),
    )


class ControlQuery(Structure):
    """One setting of a device, its kind and range."""

    _fields_ = (
        ("id", c_uint32),
        ("type", c_uint32),
        ("name", c_char * 32),
        ("minimum", c_int64),
        ("maximum", c_int64),
        ("step", c_uint64),
        ("default_value", c_int64),
        ("flags", c_uint32),
        ("elem_size", c_uint32),
        ("elems", c_uint32),
        ("nr_of_dims", c_uint32),
        ("dims", c_uint32 * 4),
        ("reserved", c_uint32 * 32),
    )


class _ControlUnion(Union):
    _pack_ = 1
    _layout_ = "ms"
    _fields_ = (("value", c_int32), ("value64", c_int64), ("pointer", c_void_p))


class V4l2Control(Structure):
    """The value of one setting."""

    _pack_ = 1
    _layout_ = "ms"
    _fields_ = (("id", c_uint32), ("size", c_uint32), ("reserved2", c_uint32), ("value", _ControlUnion))


class V4l2Controls(Structure):
    """The values of several settings."""

    _fields_ = (
        ("which", c_uint32),
        ("count", c_uint32),
        ("error_idx", c_uint32),
        ("request_fd", c_int32),
        ("reserved", c_uint32),
        ("controls", POINTER(V4l2Control)),
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
