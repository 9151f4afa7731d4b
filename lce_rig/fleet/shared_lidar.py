"""The sessions of one LiDAR in a registry, from which its constant errors are estimated together."""

from dataclasses import dataclass
from typing import Any

import pyarrow.compute as pc

from lce_rig.core.errors import NotEnoughDataError, UsageError
from lce_rig.fleet.storage import Storage
from lce_rig.session import Session
from lce_rig.session.identity import MARKER

LIDAR_COLUMNS = ("robot", "lidar", "lidar_serial", "source", "date", "status", "verdict", "time_offset_s")
"""Columns of the table that this module requires."""


@dataclass(frozen=True)
class LidarSessions:
    """Sessions of one LiDAR.

    Attributes:
        serial: its number.
        lidar: its name in the profiles.
        sessions: at hand on this computer, by date; those whose boards moved are not among them.
        n_moving: whose boards moved.
        n_elsewhere: that are not on this computer, or no longer.
    """

    serial: str
    lidar: str
    sessions: tuple[Session, ...]
    n_moving: int
    n_elsewhere: int


def serials(table: Any) -> list[tuple[str, int, int]]:
    """List (serial number, sessions, robots) of each LiDAR with a usable result, most sessions first."""
    used = _usable(table)
    used = used.filter(pc.is_valid(used["lidar_serial"]))
    grouped = used.group_by("lidar_serial", use_threads=False).aggregate(
        [("source", "count_distinct"), ("robot", "count_distinct")]
    )
    rows = grouped.sort_by(
        [("source_count_distinct", "descending"), ("lidar_serial", "ascending")]
    ).to_pylist()
    return [(r["lidar_serial"], r["source_count_distinct"], r["robot_count_distinct"]) for r in rows]


def sessions_of(table: Any, serial: str) -> LidarSessions:
    """Open the sessions of a LiDAR.

    Args:
        table: of a registry, with `LIDAR_COLUMNS`.
        serial: its number.

    Raises:
        UsageError: the registry knows no such LiDAR.
        NotEnoughDataError: none of its sessions can be used.
    """
    used = _usable(table)
    own = used.filter(pc.equal(used["lidar_serial"], serial)).sort_by("date").to_pylist()
    if not own:
        known = ", ".join(each for each, _, _ in serials(table)[:20]) or "none"
        raise UsageError(f"no result of a LiDAR {serial!r}", f"Serial numbers with results: {known}.")
    still = {row["source"] for row in own if row["time_offset_s"] is None}
    moving = {row["source"] for row in own} - still
    opened = []
    # A session with several cameras has several rows.
    for source in dict.fromkeys(row["source"] for row in own if row["source"] in still):
        place = Storage.at(source).local
        if place is not None and (place / MARKER).exists():
            opened.append(Session.open(place))
    if not opened:
        raise NotEnoughDataError(
            f"none of {len(still)} sessions of LiDAR {serial} with still boards is on this computer",
            "Copy sessions here and run `lce-rig lidar-intrinsics SESSION...`.",
        )
    return LidarSessions(serial, own[0]["lidar"], tuple(opened), len(moving), len(still) - len(opened))


def _usable(table: Any) -> Any:
    return table.filter(pc.and_(pc.equal(table["status"], "ok"), pc.not_equal(table["verdict"], "fail")))
