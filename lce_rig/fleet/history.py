"""Each camera and LiDAR of each robot in time: what the table of results says about changes."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Any, Literal, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from lce_rig.core.findings import Figure, Finding
from lce_rig.core.geometry import Array, difference, perturb, tangent_sizes
from lce_rig.fleet.changes import (
    Found,
    Limits,
    References,
    Sessions,
    find_changes,
    pooled,
    references,
    rescaled,
    scale_of,
    statistics,
)
from lce_rig.fleet.table import covariances, poses

State = Literal["moved", "moved_last", "drifts", "creeps", "odd_session", "steady", "once"]
STATES: tuple[State, ...] = ("moved", "moved_last", "drifts", "creeps", "odd_session", "steady", "once")
"""The worst first. "moved_last": a step before the last session, which one more session must confirm;
"creeps": only a cumulative sum exceeds its limit; "once": a single session."""

_SERIES = ("robot", "camera", "lidar", "camera_serial", "lidar_serial")
_KEYS = (*_SERIES, "date", "folder", "session_sha256")
_MATRICES = ("date", "profile_sha256", "method", "T_cam_lidar", "cov", "cov_shared")
COLUMNS = (*_KEYS, "status", "verdict", "findings", "severities", *_MATRICES[1:])
"""Columns of the table that this requires."""
# A robot that is far from its drawing has moved, perhaps; other failures say that the result is wrong.
_NO_FAILURE = "verdict.far_from_nominal"
_CHUNK = 1 << 15
_FOR_SCALE = 50_000


@dataclass(frozen=True)
class Change:
    """A change of one camera and LiDAR of a robot.

    Attributes:
        series: its number.
        robot, camera, lidar: whose.
        found: the change.
        sensor: "camera" or "lidar" where one of them moved; "" if that cannot be told.
        before, after: dates of the last session before a step and the first after it; of an odd session
            twice; of the first and last session of a drift.
        folder: of the session `after`, in the registry.
        earliest, latest: dates between which a step lies, 95 %.
    """

    series: int
    robot: str
    camera: str
    lidar: str
    found: Found
    sensor: str
    before: str
    after: str
    folder: str
    earliest: str
    latest: str

    @property
    def is_confirmed(self) -> bool:
        """Whether more than one session shows it."""
        return self.found.kind == "drift" or self.found.n_after > 1

    @property
    def sizes(self) -> tuple[float, float]:
        """Rotation deg and translation m."""
        return tangent_sizes(np.array(self.found.tangent))


def finding_of(change: Change) -> Finding:
    """State a change as a fact."""
    found = change.found
    code = {"drift": "fleet.drifts", "odd": "fleet.odd_session"}.get(found.kind, "fleet.moved")
    if found.kind == "step" and not change.is_confirmed:
        code = "fleet.moved_last"
    figures: dict[str, Figure] = {
        "camera": change.camera,
        "lidar": change.lidar,
        "sensor": change.sensor,
        "before": change.before,
        "after": change.after,
        "axes": tuple(axis.axis for axis in found.axes),
        "changes": tuple(axis.change for axis in found.axes),
        "sigmas": tuple(axis.sigma for axis in found.axes),
        "chi2": found.chi2,
    }
    return Finding(code, "note", change.robot, figures)


@dataclass(frozen=True, eq=False)
class History:
    """All series of a fleet: the usable results of one camera and LiDAR of a robot, in the order of time.

    A sensor that was replaced, by its serial number, begins a series.

    Attributes:
        rows: (N,) of the sessions in the table given, series by series.
        starts: (G + 1,) first session of each series, and N.
        names: a row for each series: robot, camera, lidar, camera_serial, lidar_serial.
        dates, folders: (N,) of the sessions.
        state: (G,) of each series, index into STATES.
        T_now, cov_now: (G, 4, 4), (G, 6, 6) weighted mean since the last change; the covariance of what
            scatters between sessions.
        smallest: (G, 6) smallest change that one more session would show with 95 %; m and rad.
        apart, sigma: (N, 6) of each session from the mean of those before it since the last change, m and
            rad; NaN for the first.
        chi2: (N,) of it.
        cusum: (N, 6) cumulative sums.
        changes: of all series.
        limits: that were exceeded.
        scale: (6,) factors on the reported standard deviations, from `n_scale` differences of sessions.
        n_rows, n_failed: of the table; sessions with a result that must not be used.
    """

    rows: NDArray[np.intp]
    starts: NDArray[np.intp]
    names: Any
    dates: Any
    folders: Any
    state: NDArray[np.intp]
    T_now: Array
    cov_now: Array
    smallest: Array
    apart: Array
    sigma: Array
    chi2: Array
    cusum: Array
    changes: tuple[Change, ...]
    limits: Limits
    scale: Array
    n_scale: int
    n_rows: int
    n_failed: int

    @property
    def robots(self) -> dict[str, State]:
        """The worst state of each robot."""
        robot = self.names["robot"].combine_chunks().dictionary_encode()
        worst = np.full(len(robot.dictionary), len(STATES) - 1)
        np.minimum.at(worst, robot.indices.to_numpy(), self.state)
        return {name: STATES[k] for name, k in zip(robot.dictionary.to_pylist(), worst.tolist(), strict=True)}


def history_of(table: Any) -> History:
    """Find what changed when in a table of results.

    Args:
        table: `pyarrow.Table` with at least `COLUMNS`.
    """
    known, n_failed = _usable(table)
    keys = table.select(_KEYS)
    order = known[_order(keys if len(known) == len(table) else keys.take(pa.array(known)))]
    in_order = table.select(_KEYS).take(pa.array(order))
    starts = _starts(in_order)
    limits = Limits.of(np.diff(starts))
    reader = _Reader(table.select(_MATRICES), order, starts)
    scale, n_scale = scale_of(reader.sample(_FOR_SCALE))
    dates, folders = in_order["date"].combine_chunks(), in_order["folder"].combine_chunks()
    names = in_order.select(_SERIES).take(pa.array(starts[:-1]))
    parts: list[_Part] = []
    changes: list[Change] = []
    for first, last in reader.chunks():
        sessions, T = reader.read(first, last)
        part, found = _examine(rescaled(sessions, scale), T, limits)
        parts.append(part)
        for series, each in found:
            changes += [_named(first + series, one, names, starts, dates, folders) for one in each]
    by_series = _of_sensors(changes, names)
    creeps = np.concatenate([part.creeps for part in parts] or [np.zeros(0, bool)])
    return History(
        rows=order,
        starts=starts,
        names=names,
        dates=dates,
        folders=folders,
        state=_states(creeps, by_series, np.diff(starts)),
        T_now=_joined([part.T_now for part in parts], (4, 4)),
        cov_now=_joined([part.cov_now for part in parts], (6, 6)),
        smallest=_joined([part.smallest for part in parts], (6,)),
        apart=_joined([part.references.apart for part in parts], (6,)),
        sigma=_joined([part.references.sigma for part in parts], (6,)),
        chi2=_joined([part.references.chi2 for part in parts], ()),
        cusum=_joined([part.references.cusum for part in parts], (6,)),
        changes=by_series,
        limits=limits,
        scale=scale,
        n_scale=n_scale,
        n_rows=len(table),
        n_failed=n_failed,
    )


def _joined(arrays: list[Array], shape: tuple[int, ...]) -> Array:
    return np.concatenate(arrays) if arrays else np.zeros((0, *shape))


def _usable(table: Any) -> tuple[NDArray[np.intp], int]:
    """List the rows with a result that may be used, and count those with one that must not."""
    has = pc.and_(pc.is_valid(table["T_cam_lidar"]), pc.is_valid(table["cov"]))
    has = pc.and_(has, pc.and_(pc.is_valid(table["date"]), pc.equal(table["status"], "ok")))
    failed = pc.and_(has, pc.fill_null(pc.equal(table["verdict"], "fail"), True))
    index = np.flatnonzero(failed.to_numpy())
    some = table.select(["findings", "severities"]).take(pa.array(index))
    codes, severities = some["findings"].combine_chunks(), some["severities"].combine_chunks()
    is_error = pc.and_(
        pc.equal(pc.list_flatten(severities), "error"), pc.not_equal(pc.list_flatten(codes), _NO_FAILURE)
    ).to_numpy(zero_copy_only=False)
    wrong = np.bincount(pc.list_parent_indices(codes).to_numpy(), is_error, minlength=len(index)) > 0
    # A failure without its reasons is one.
    wrong |= (pc.fill_null(pc.list_value_length(codes), 0).to_numpy() == 0)[: len(index)]
    usable = has.to_numpy().copy()
    usable[index[wrong]] = False
    return np.flatnonzero(usable), int(np.count_nonzero(wrong))


def _order(table: Any) -> NDArray[np.intp]:
    """Sort by series and time; of one session's results in several folders, the last stays."""
    keys = [(name, "ascending") for name in ("robot", "camera", "lidar", "date", "folder")]
    order = pc.sort_indices(table, sort_keys=keys).to_numpy().astype(np.intp)
    same = np.ones(max(len(order) - 1, 0), bool)
    for name in ("robot", "camera", "lidar", "date", "session_sha256"):
        codes = _codes(table[name])[order]
        same &= (codes[1:] == codes[:-1]) & (codes[1:] >= 0)
    keep = np.ones(len(order), bool)
    keep[:-1] = ~same
    return np.asarray(order[keep])


def _codes(column: Any) -> NDArray[np.intp]:
    """Number the values of a column of text; -1 for null."""
    encoded = column.combine_chunks().dictionary_encode()
    return np.asarray(pc.fill_null(encoded.indices, -1).to_numpy().astype(np.intp))


def _starts(table: Any) -> NDArray[np.intp]:
    begins = np.zeros(len(table), bool)
    begins[:1] = True
    for name in ("robot", "camera", "lidar"):
        codes = _codes(table[name])
        begins[1:] |= codes[1:] != codes[:-1]
    for name in ("camera_serial", "lidar_serial"):
        codes = _codes(table[name])
        begins[1:] |= (codes[1:] != codes[:-1]) & (codes[1:] >= 0) & (codes[:-1] >= 0)
    return np.append(np.flatnonzero(begins), len(table)).astype(np.intp)


@dataclass(frozen=True, eq=False)
class _Reader:
    """Reads series a chunk at a time, so that matrices of a large table never all exist."""

    table: Any
    order: NDArray[np.intp]
    starts: NDArray[np.intp]

    def chunks(self) -> Iterator[tuple[int, int]]:
        """Yield (first, last) series."""
        first, n = 0, len(self.starts) - 1
        while first < n:
            last = int(np.searchsorted(self.starts, self.starts[first] + _CHUNK, "right")) - 1
            last = min(max(last, first + 1), n)
            yield first, last
            first = last

    def sample(self, n_rows: int) -> Sessions:
        """Read series spread over the table."""
        chunks = list(self.chunks())
        step = max(1, round(len(chunks) * _CHUNK / n_rows))
        parts = [self.read(*each)[0] for each in chunks[::step]]
        if not parts:
            return Sessions(
                np.zeros(1, np.intp), np.zeros((0, 6)), *(np.zeros((0, 6, 6)),) * 2,
                np.zeros(0, np.intp), np.zeros(0),
            )  # fmt: skip
        offsets = np.cumsum([0, *(part.starts[-1] for part in parts)])
        starts = [part.starts[:-1] + offset for part, offset in zip(parts, offsets[:-1], strict=True)]
        return Sessions(
            np.append(np.concatenate(starts), offsets[-1]),
            *(
                np.concatenate([getattr(part, name) for part in parts])
                for name in ("tangents", "cov", "shared", "profile", "days")
            ),
        )

    def read(self, first: int, last: int) -> tuple[Sessions, Array]:
        """Read series `first` to `last`, and T_cam_lidar (G, 4, 4) of the first session of each."""
        own = self.starts[first : last + 1]
        part = self.table.take(pa.array(self.order[own[0] : own[-1]]))
        T, cov = poses(part["T_cam_lidar"]), covariances(part["cov"])
        shared = covariances(_zero_where_null(part["cov_shared"]))
        starts = own - own[0]
        lengths = np.diff(starts)
        T_first = T[starts[:-1]]
        tangents = difference(T, np.repeat(T_first, lengths, axis=0))
        instants = pc.strptime(part["date"], format="%Y-%m-%dT%H:%M:%SZ", unit="s", error_is_null=True)
        seconds = pc.fill_null(pc.cast(instants, pa.int64()), 0).to_numpy()
        days = seconds / 86400.0
        # Another method has other errors in common, as another profile has.
        method = _codes(part["method"])
        made_with = _codes(part["profile_sha256"]) * (method.max(initial=0) + 2) + method
        sessions = Sessions(starts, tangents, cov - shared, shared, made_with, days - days.min())
        return pooled(sessions), T_first


def _zero_where_null(column: Any) -> Any:
    if not column.null_count:
        return column
    zeros = pa.scalar([0.0] * column.type.list_size, column.type)
    values = [zeros if not each.is_valid else each for each in column]
    return pa.array([each.as_py() for each in values], column.type)


class _Part(NamedTuple):
    """What is found of some series; attributes as of `History`."""

    creeps: NDArray[np.bool_]
    T_now: Array
    cov_now: Array
    smallest: Array
    references: References


def _examine(
    sessions: Sessions, T_first: Array, limits: Limits
) -> tuple[_Part, list[tuple[int, tuple[Found, ...]]]]:
    """Find the changes of some series, and compare their sessions with what was before."""
    starts = sessions.starts[:-1]
    tested = statistics(sessions)
    largest = np.maximum.reduceat(np.maximum(tested.step, tested.odd), starts)
    suspicious = np.flatnonzero(np.maximum(largest, tested.slope) > limits.chi2)
    keep, bounds, changes = np.ones(len(sessions.tangents), bool), [starts], []
    for g in suspicious.tolist():
        first, last = int(sessions.starts[g]), int(sessions.starts[g + 1])
        found = find_changes(sessions.part(first, last), limits, T_first[g])
        changes.append((g, found))
        keep[[first + each.session for each in found if each.kind == "odd"]] = False
        bounds.append(np.array([first + each.session for each in found if each.kind == "step"], np.intp))
    starts_now = np.append(np.unique(np.concatenate(bounds)), sessions.starts[-1]).astype(np.intp)
    compared = references(sessions, starts_now, keep, limits)
    now = np.searchsorted(starts_now, sessions.starts[1:]) - 1
    creeps = np.maximum.reduceat(np.abs(compared.cusum).max(axis=1), starts) > limits.cusum
    T_now = perturb(T_first, compared.mean[now])
    return _Part(creeps, T_now, compared.cov[now], compared.smallest[now], compared), changes


def _named(
    series: int, found: Found, names: Any, starts: NDArray[np.intp], dates: Any, folders: Any
) -> Change:
    robot, camera, lidar = (names[name][series].as_py() for name in ("robot", "camera", "lidar"))
    first = int(starts[series])
    at = first + found.session
    if found.kind == "step":
        before, after, earliest, latest = at - 1, at, first + found.earliest - 1, first + found.latest
    else:
        before, after = at, first + found.end - 1
        earliest, latest = before, after
    return Change(
        series=series,
        robot=robot,
        camera=camera or "",
        lidar=lidar or "",
        found=found,
        sensor=found.sensor,
        before=dates[before].as_py(),
        after=dates[after].as_py(),
        folder=folders[after].as_py() or "",
        earliest=dates[earliest].as_py(),
        latest=dates[latest].as_py(),
    )


def _of_sensors(changes: Sequence[Change], names: Any) -> tuple[Change, ...]:
    """Name the sensor that moved where a LiDAR has several cameras.

    If all of them changed at once, the LiDAR moved; if one alone did, that camera.
    """
    robots = names["robot"].to_pylist()
    cameras: dict[tuple[str, str], set[str]] = {}
    for change in changes:
        cameras.setdefault((change.robot, change.lidar), set())
    if cameras:
        for robot, camera, lidar in zip(
            robots, names["camera"].to_pylist(), names["lidar"].to_pylist(), strict=True
        ):
            if (robot, lidar) in cameras:
                cameras[robot, lidar].add(camera)

    def key(change: Change) -> tuple[str, str]:
        return change.robot, change.lidar

    told = []
    for own, group in groupby(changes, key=key):
        each = list(group)
        for change in each:
            together = {other.camera for other in each if _is_at_once(other, change)}
            sensor = change.sensor
            if change.found.kind == "step" and len(cameras[own]) > 1:
                sensor = "lidar" if together == cameras[own] else "camera" if len(together) == 1 else sensor
            told.append(replace(change, sensor=sensor))
    return tuple(told)


def _is_at_once(first: Change, second: Change) -> bool:
    return (
        first.found.kind == second.found.kind == "step"
        and first.earliest <= second.latest
        and second.earliest <= first.latest
    )


def _states(
    creeps: NDArray[np.bool_], changes: Sequence[Change], lengths: NDArray[np.intp]
) -> NDArray[np.intp]:
    index = {state: k for k, state in enumerate(STATES)}
    state = np.where(creeps, index["creeps"], np.where(lengths > 1, index["steady"], index["once"]))
    for change in changes:
        kind = change.found.kind
        own: State = "odd_session" if kind == "odd" else "drifts" if kind == "drift" else "moved"
        if own == "moved" and not change.is_confirmed:
            own = "moved_last"
        state[change.series] = min(state[change.series], index[own])
    return np.asarray(state)
