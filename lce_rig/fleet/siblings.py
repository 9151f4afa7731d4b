"""A robot beside its siblings: how sensors are mounted over a fleet, and who sits apart.

Siblings have the same profile's name, camera, LiDAR and nominal pose. Along each axis, d is a robot's
difference from the nominal pose, m the median over the siblings and s = 1.4826 median |d - m|:

    z = (d - m) / sqrt(s^2 + max(0, sigma^2 - median sigma^2))

with sigma the standard deviation of d itself. A robot sits apart beyond the limit of Student's distribution
that any of an ordinary fleet exceeds with a probability of 5 %.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from lce_rig.core.findings import Figure, Finding, ranked
from lce_rig.core.geometry import Array, difference
from lce_rig.fleet.history import COLUMNS, History, finding_of, history_of
from lce_rig.fleet.query import query
from lce_rig.fleet.registry import Registry
from lce_rig.fleet.table import Row, as_table, covariances, poses, result_columns
from lce_rig.pipeline.result_files import Result
from lce_rig.scene.alignment import AXES, IS_ROTATION
from lce_rig.session.session import PROFILE

FEWEST_SIBLINGS = 5
# Where more are apart, robots are of several kinds: nobody is odd.
_MOST_APART = 0.2
_FALSE_OUTLIERS = 0.05
_OF_NORMAL = 1.4826
# Rows whose nominal pose differs by no more than this are of one drawing.
_DIGITS = 6

MOUNTING_COLUMNS = ("rig", "nominal", "nominal_source", "nominal_tolerance_deg", "nominal_tolerance_m")
"""Columns of the table that `mountings` requires besides those of `history_of`."""


@dataclass(frozen=True, eq=False)
class Mounting:
    """How one camera and LiDAR are mounted over a fleet.

    Attributes:
        rig, camera, lidar: whose.
        source: "cad" or "typical" nominal pose; None without one: then the first robot takes its place.
        tolerance_deg, tolerance_m: of the nominal pose.
        robots: names.
        series: (R,) of each in the `History`.
        apart: (R, 6) from the nominal pose, m and rad.
        z: (R, 6) from the median of the siblings, in standard deviations of their spread.
        limit: of |z|; infinite for fewer than `FEWEST_SIBLINGS` siblings.
    """

    rig: str
    camera: str
    lidar: str
    source: str | None
    tolerance_deg: float | None
    tolerance_m: float | None
    robots: tuple[str, ...]
    series: NDArray[np.intp]
    apart: Array
    z: Array
    limit: float

    @property
    def median(self) -> Array:
        """(6,) of the robots."""
        return np.asarray(np.median(self.apart, axis=0))

    @property
    def spread(self) -> Array:
        """(6,) standard deviation by the median of the deviations."""
        return np.asarray(_OF_NORMAL * np.median(np.abs(self.apart - self.median), axis=0))

    @property
    def is_one_kind(self) -> bool:
        """Whether few robots are beyond the limit along any axis."""
        return float(np.mean(np.abs(self.z).max(axis=1) > self.limit)) <= _MOST_APART

    @property
    def outliers(self) -> list[tuple[int, int]]:
        """(robot, axis) beyond the limit, by their numbers; the farthest first. None if they are many."""
        found = np.argwhere(np.abs(self.z) > self.limit) if self.is_one_kind else np.empty((0, 2), int)
        order = np.argsort(-np.abs(self.z[found[:, 0], found[:, 1]]), kind="stable")
        return [(int(r), int(a)) for r, a in found[order]]


def limit_of(n_robots: int, n_asked: int) -> float:
    """Choose the limit of |z| among so many robots where so many of them are asked about."""
    from scipy.special import stdtrit

    if n_robots <= FEWEST_SIBLINGS:
        return float("inf")
    return float(-stdtrit(n_robots - 1, _FALSE_OUTLIERS / (2 * 6 * n_asked)))


def mountings(table: Any, history: History) -> tuple[Mounting, ...]:
    """Compare the robots of a fleet with the drawing and with each other.

    Args:
        table: that the history was made of, with `MOUNTING_COLUMNS`.
        history: the present mean of each robot.
    """
    if len(history.starts) < 2:
        return ()
    last = history.rows[history.starts[1:] - 1]
    own = table.select(MOUNTING_COLUMNS).take(pa.array(last))
    dates = history.dates.take(pa.array(history.starts[1:] - 1)).to_pylist()
    newest: dict[tuple[str, str, str], int] = {}
    names = zip(*(history.names[name].to_pylist() for name in ("robot", "camera", "lidar")), strict=True)
    for number, key in enumerate(names):
        # A sensor that was replaced ended its series.
        if key not in newest or dates[number] >= dates[newest[key]]:
            newest[key] = number
    rigs, nominals = own["rig"].to_pylist(), own["nominal"].to_pylist()
    groups: dict[tuple[Any, ...], list[int]] = {}
    for (_, camera, lidar), number in newest.items():
        drawing = nominals[number]
        rounded = None if drawing is None else tuple(round(value, _DIGITS) for value in drawing)
        groups.setdefault((rigs[number] or "", camera, lidar, rounded), []).append(number)
    robots = history.names["robot"].to_pylist()
    found = []
    for (rig, camera, lidar, drawing), members in groups.items():
        series = np.array(members, np.intp)
        T = history.T_now[series]
        nominal = T[0] if drawing is None else np.array(drawing).reshape(4, 4)
        sigma = np.sqrt(np.einsum("gii->gi", history.cov_now[series]))
        first = members[0]
        found.append(
            Mounting(
                rig=rig,
                camera=camera or "",
                lidar=lidar or "",
                source=own["nominal_source"][first].as_py(),
                tolerance_deg=own["nominal_tolerance_deg"][first].as_py(),
                tolerance_m=own["nominal_tolerance_m"][first].as_py(),
                robots=tuple(robots[k] for k in members),
                series=series,
                apart=difference(T, nominal),
                z=deviations(difference(T, nominal), sigma),
                limit=limit_of(len(members), len(members)),
            )
        )
    return tuple(sorted(found, key=lambda each: (-len(each.robots), each.rig, each.camera, each.lidar)))


def deviations(apart: Array, sigma: Array) -> Array:
    """Compute z (R, 6) of robots from differences from the nominal pose and their standard deviations."""
    off = apart - np.median(apart, axis=0)
    spread = _OF_NORMAL * np.median(np.abs(off), axis=0)
    excess = np.maximum(sigma**2 - np.median(sigma**2, axis=0), 0.0)
    return np.asarray(off / np.sqrt(np.maximum(spread**2 + excess, 1e-18)))


def with_registry(result: Result, registry: Registry) -> Result:
    """Add notes on how a result compares with those of a registry; the verdict does not change.

    Args:
        result: of one session.
        registry: with a table.

    Raises:
        SessionError: there is no table, or it cannot be read.
    """
    told, rig = result.provenance, result.session.rig
    name = rig.name.replace("'", "''")
    table = query(registry, f"rig = '{name}'", tuple(dict.fromkeys((*COLUMNS, *MOUNTING_COLUMNS))))
    base = Row(
        told.robot or rig.name,
        rig=rig.name,
        date=told.date or None,
        session_sha256=told.session_sha256,
        profile_sha256=result.document()["inputs_sha256"][PROFILE],
    )
    pairs = []
    for pair in result.pairs:
        notes = compare(replace(base, **result_columns(pair, rig, told.serials)), table)
        pairs.append(replace(pair, findings=ranked([*pair.findings, *notes])))
    return replace(result, pairs=tuple(pairs))


def compare(row: Row, table: Any) -> list[Finding]:
    """Compare a new result with earlier ones of its robot and with its siblings.

    Args:
        row: the new result; without a date it counts as the last.
        table: of a registry, with COLUMNS and MOUNTING_COLUMNS.

    Returns:
        Notes: where it differs from its robot's earlier sessions, and where it sits apart from its siblings.
    """
    assert row.T_cam_lidar is not None and row.cov is not None
    same = pc.and_(pc.equal(table["camera"], row.camera), pc.equal(table["lidar"], row.lidar))
    same = pc.and_(same, pc.fill_null(pc.equal(table["rig"], row.rig), False))
    if row.session_sha256 is not None:
        # Its own earlier result is no other session.
        same = pc.and_(same, pc.fill_null(pc.not_equal(table["session_sha256"], row.session_sha256), True))
    company = table.filter(same)
    return [*_since(row, company), *_beside(row, company)]


def _since(row: Row, company: Any) -> list[Finding]:
    own = company.filter(pc.equal(company["robot"], row.robot)).select(COLUMNS)
    earlier = own if row.date is None else own.filter(pc.less(own["date"], row.date))
    if not len(earlier):
        return []
    last = row.date or (pc.max(earlier["date"]).as_py() or "") + "~"
    new = as_table([{**vars(row), "date": last, "verdict": "pass", "folder": "~"}]).select(COLUMNS)
    history = history_of(pa.concat_tables([earlier.cast(new.schema), new]))
    series, end = len(history.starts) - 2, int(history.starts[-1] - history.starts[-2])
    for change in history.changes:
        found = change.found
        if change.series == series and found.kind == "step" and found.session == end - 1:
            return [finding_of(change)]
    return []


def _beside(row: Row, company: Any) -> list[Finding]:
    others = company.filter(pc.not_equal(company["robot"], row.robot))
    usable = pc.and_(pc.equal(others["status"], "ok"), pc.is_valid(others["T_cam_lidar"]))
    others = others.filter(pc.and_(usable, pc.not_equal(others["verdict"], "fail")))
    others = others.filter(_of_drawing(others["nominal"], row.nominal))
    # Of each robot the last session: rows are in the order of time.
    order = pc.sort_indices(others, sort_keys=[("robot", "ascending"), ("date", "ascending")])
    others = others.take(order)
    robots = np.array(others["robot"].to_pylist(), dtype=object)
    is_last = np.append(robots[1:] != robots[:-1], True)[: len(robots)]
    others = others.take(pa.array(np.flatnonzero(is_last)))
    if len(others) < FEWEST_SIBLINGS:
        return []
    T = np.concatenate([poses(others["T_cam_lidar"]), np.array(row.T_cam_lidar).reshape(1, 4, 4)])
    own_cov = as_table([row])["cov"]
    cov = np.concatenate([covariances(others["cov"]), covariances(own_cov)])
    nominal = T[0] if row.nominal is None else np.array(row.nominal).reshape(4, 4)
    *siblings, z = deviations(difference(T, nominal), np.sqrt(np.einsum("gii->gi", cov)))
    axis, limit = int(np.argmax(np.abs(z))), limit_of(len(T), n_asked=1)
    several_kinds = np.mean(np.abs(siblings).max(axis=1) > limit_of(len(T), len(T))) > _MOST_APART
    if several_kinds or abs(z[axis]) <= limit:
        return []
    apart = difference(T, nominal)[:, axis]
    unit, scale = ("deg", float(np.degrees(1.0))) if IS_ROTATION[axis] else ("m", 1.0)
    figures: dict[str, Figure] = {
        "axis": AXES[axis],
        f"apart_{unit}": scale * float(apart[-1] - np.median(apart[:-1])),
        "sigmas": float(abs(z[axis])),
        "limit_sigmas": limit,
        "n_siblings": len(T) - 1,
    }
    return [Finding("fleet.apart_from_siblings", "note", row.robot, figures)]


def _of_drawing(column: Any, nominal: Sequence[float] | None) -> Any:
    if nominal is None:
        return pc.is_null(column)
    given = column.combine_chunks()
    valid = given.is_valid().to_numpy(zero_copy_only=False)
    same = np.zeros(len(given), bool)
    same[valid] = np.all(np.abs(poses(given.drop_null()).reshape(-1, 16) - nominal) < 10.0**-_DIGITS, axis=1)
    return pa.array(same)
