"""PointCloud2 of any layout, without a bag around it."""

from types import SimpleNamespace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from lce_rig.io.ros.messages import decode_pointcloud2

CODES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}


def message(dtype, rows, row_step, is_bigendian):
    fields = [
        SimpleNamespace(
            name=name,
            offset=dtype.fields[name][1],
            datatype=CODES[dtype[name].base.str[1:]],
            count=dtype[name].shape[0] if dtype[name].shape else 1,
        )
        for name in dtype.names
    ]
    data = b"".join(row.tobytes() + bytes(row_step - row.nbytes) for row in rows)
    return SimpleNamespace(
        fields=fields, is_bigendian=is_bigendian, width=rows.shape[1], height=rows.shape[0],
        point_step=dtype.itemsize, row_step=row_step, data=np.frombuffer(data, np.uint8),
    )  # fmt: skip


@st.composite
def layouts(draw):
    """Fields in any order with gaps between them, and rows with gaps behind them."""
    is_bigendian = draw(st.booleans())
    names, formats, offsets, place = [], [], [], 0
    for k, kind in enumerate(draw(st.lists(st.sampled_from(list(CODES)), min_size=1, max_size=6))):
        place += draw(st.integers(0, 5))
        count = draw(st.integers(1, 3))
        base = np.dtype((">" if is_bigendian else "<") + kind)
        names.append(f"f{k}")
        formats.append(base if count == 1 else (base, (count,)))
        offsets.append(place)
        place += base.itemsize * count
    order = draw(st.permutations(range(len(names))))
    itemsize = place + draw(st.integers(0, 7))
    dtype = np.dtype({
        "names": [names[k] for k in order], "formats": [formats[k] for k in order],
        "offsets": [offsets[k] for k in order], "itemsize": itemsize,
    })  # fmt: skip
    height, width = draw(st.integers(1, 4)), draw(st.integers(1, 9))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    rows = np.zeros((height, width), dtype)
    for name in names:
        rows[name] = rng.integers(0, 100, rows[name].shape)
    return dtype, rows, width * itemsize + draw(st.integers(0, 9)), is_bigendian


@given(layouts())
def test_every_layout_gives_back_its_points_in_order(layout):
    dtype, rows, row_step, is_bigendian = layout
    cloud = decode_pointcloud2(message(dtype, rows, row_step, is_bigendian))
    for name in dtype.names:
        np.testing.assert_array_equal(cloud[name], rows[name].reshape(cloud[name].shape))


def test_rows_without_a_step_and_empty_clouds_are_read():
    dtype = np.dtype([("x", "<f4")])
    rows = np.arange(3, dtype="<f4").view(dtype).reshape(1, 3)
    no_step = message(dtype, rows, 12, False)
    no_step.row_step = 0
    assert decode_pointcloud2(no_step)["x"].tolist() == [0, 1, 2]
    no_step.width = 0
    assert len(decode_pointcloud2(no_step)) == 0
