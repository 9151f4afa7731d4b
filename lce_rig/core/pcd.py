"""The PCD point cloud format as bytes and back.

References:
    https://pointclouds.org/documentation/tutorials/pcd_file_format.html
"""

import io
import re
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray


def decode_pcd(data: bytes) -> NDArray[Any]:
    """Decode a whole PCD file in any of its three encodings.

    Args:
        data: the file's bytes.

    Returns:
        Structured (N,) with the fields as named in the header; one of count c > 1 as c fields.

    Raises:
        ValueError: points are missing.
        Exception: as pypcd4 raises it about damaged files.
    """
    if not data:
        raise ValueError("it is empty")
    from pypcd4.pypcd4 import PointCloud  # Commands that read no point cloud need not wait for it.

    # Comments need not be UTF-8; MATLAB's hold a trade mark sign.
    data = re.sub(rb"\A(?:#[^\n]*\n)+", b"", data)
    cloud = PointCloud.from_fileobj(io.BufferedReader(io.BytesIO(data)))
    points = np.atleast_1d(cloud.pc_data)
    if len(points) != cloud.metadata.points:
        raise ValueError(f"it is truncated: {len(points)} of {cloud.metadata.points} points are there")
    return points


def encode_pcd(cloud: NDArray[Any], comments: Iterable[str] = ()) -> bytes:
    """Encode a point cloud as binary PCD, `decode_pcd`'s inverse.

    Args:
        cloud: structured (N,) of scalar fields.
        comments: lines for the head of the file.
    """
    names = cloud.dtype.names or ()
    dtypes = [cloud.dtype[name] for name in names]
    packed = np.empty(
        len(cloud), dtype=[(n, d.newbyteorder("<")) for n, d in zip(names, dtypes, strict=True)]
    )
    for name in names:
        packed[name] = cloud[name]
    lines = [
        "# .PCD v0.7 - Point Cloud Data file format",
        *(f"# {comment}" for comment in comments),
        "VERSION 0.7",
        "FIELDS " + " ".join(names),
        "SIZE " + " ".join(str(d.itemsize) for d in dtypes),
        "TYPE " + " ".join(d.kind.upper() for d in dtypes),
        "COUNT " + " ".join("1" for _ in dtypes),
        f"WIDTH {len(cloud)}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {len(cloud)}",
        "DATA binary",
    ]
    return ("\n".join(lines) + "\n").encode("ascii") + packed.tobytes()
