"""Robots that moved: two results of one robot that differ beyond their own independent covariance.

Each result of a robot, camera and LiDAR is compared with the one before it. With x the tangent from the
earlier pose to the later one,

    chi2 = x^T (C_1 + C_2)^-1 x,    C_k = cov - cov_shared

is chi-squared with 6 degrees of freedom if nothing moved. `cov_shared`, of errors that all sessions of one
profile and method have in common, counts only where profile or method differ. The limit is the quantile that
any of the fleet's comparisons exceeds with a probability of `FALSE_ALARMS` if no robot moved.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from lce_rig.core.findings import Finding
from lce_rig.core.geometry import Array, difference, tangent_sizes
from lce_rig.fleet.findings import MOVED
from lce_rig.fleet.table import covariances, poses

State = Literal["moved", "steady", "cannot_tell"]
STATES: tuple[State, ...] = ("moved", "steady", "cannot_tell")
"""The worst first. "cannot_tell": no two usable results of the same sensors."""
FALSE_ALARMS = 0.01
"""Probability that a fleet in which nothing moved names any robot."""
_SENSORS = ("robot", "camera", "lidar")
_SERIALS = ("camera_serial", "lidar_serial")
MOVED_COLUMNS = (
    *(*_SENSORS, *_SERIALS, "date", "folder", "session_sha256", "profile_sha256", "method", "status"),
    *("verdict", "findings", "severities", "T_cam_lidar", "cov", "cov_shared"),
)
"""Columns of the table that this module requires."""
# Sensors that moved far from the CAD model fail by this; other errors say that the result is wrong.
_FAR = "verdict.far_from_nominal"
# 0.01 mm and 0.0006 deg, so that a covariance of zeros can be inverted.
_LEAST = 1e-10 * np.eye(6)


@dataclass(frozen=True, eq=False)
class History:
    """The usable results of a fleet, by robot, camera, LiDAR and date.

    Attributes:
        rows: `pyarrow.Table` of N results.
        is_compared: (N,) whether a result is compared with the one in the row before it.
        change: (N, 6) tangent from the pose in the row before, m and rad, axes of the camera; NaN if not
            compared.
        sigma: (N, 6) its standard deviations.
        chi2: (N,) of it.
        limit: of `chi2`.
        robots: state of every robot in the registry.
    """

    rows: Any
    is_compared: NDArray[np.bool_]
    change: Array
    sigma: Array
    chi2: Array
    limit: float
    robots: Mapping[str, State]

    @property
    def moves(self) -> list[int]:
        """Rows before which a robot moved."""
        return [int(k) for k in np.flatnonzero(self.is_compared & (self.chi2 > self.limit))]

    def finding(self, k: int) -> Finding:
        """State the move before row k."""
        row, before = self.rows.slice(k, 1).to_pylist()[0], self.rows["date"][k - 1].as_py()
        rotation_deg, translation_m = tangent_sizes(self.change[k])
        return MOVED(
            row["robot"],
            camera=row["camera"],
            lidar=row["lidar"],
            before=before,
            after=row["date"],
            rotation_deg=rotation_deg,
            translation_m=translation_m,
            chi2=float(self.chi2[k]),
            limit_chi2=self.limit,
        )


def history_of(table: Any) -> History:
    """Compare each result in a table with the one before it.

    Args:
        table: `pyarrow.Table` with at least `MOVED_COLUMNS`.
    """
    from scipy.special import chdtri

    order = [(name, "ascending") for name in (*_SENSORS, "date", "folder")]
    rows = table.take(pa.array(_usable(table))).sort_by(order)
    n = len(rows)
    same = {name: _is_repeated(rows[name]) for name in MOVED_COLUMNS[:10]}
    is_compared = np.logical_and.reduce([same[name] for name in _SENSORS]) if n else np.zeros(0, bool)
    for name in _SERIALS:
        is_known = rows[name].is_valid().to_numpy()
        is_compared[1:] &= same[name][1:] | ~is_known[1:] | ~is_known[:-1]
    # A copy of a session is not another one.
    is_compared &= ~(same["session_sha256"] & rows["session_sha256"].is_valid().to_numpy())
    change, sigma, chi2 = np.full((n, 6), np.nan), np.full((n, 6), np.nan), np.full(n, np.nan)
    k = np.flatnonzero(is_compared)
    limit = float(chdtri(6, FALSE_ALARMS / max(len(k), 1)))
    if len(k):
        T, cov, shared = poses(rows["T_cam_lidar"]), covariances(rows["cov"]), covariances(rows["cov_shared"])
        differs = ~(same["profile_sha256"] & same["method"])
        change[k] = difference(T[k], T[k - 1])
        both = cov[k] + cov[k - 1] - np.where(differs[k, None, None], 0.0, shared[k] + shared[k - 1]) + _LEAST
        sigma[k] = np.sqrt(np.einsum("kii->ki", both))
        chi2[k] = np.einsum("ki,ki->k", change[k], np.linalg.solve(both, change[k][..., None])[..., 0])
    robots: dict[str, State] = dict.fromkeys(sorted(pc.unique(table["robot"]).to_pylist()), "cannot_tell")
    names = rows["robot"].to_pylist()
    robots |= {names[i]: "steady" for i in k.tolist()}
    robots |= {names[i]: "moved" for i in k[chi2[k] > limit].tolist()}
    return History(rows, is_compared, change, sigma, chi2, limit, robots)


def _usable(table: Any) -> NDArray[np.intp]:
    """List rows with a dated result that did not fail, or failed only by its distance from the CAD model."""
    known = pc.and_(pc.equal(table["status"], "ok"), pc.is_valid(table["date"]))
    for name in ("T_cam_lidar", "cov", "cov_shared"):
        known = pc.and_(known, pc.is_valid(table[name]))
    is_usable = known.to_numpy().copy()
    has_failed = pc.fill_null(pc.equal(table["verdict"], "fail"), True).to_numpy()
    for k in np.flatnonzero(is_usable & has_failed).tolist():
        codes, severities = table["findings"][k].as_py() or (), table["severities"][k].as_py() or ()
        errors = {code for code, severity in zip(codes, severities, strict=False) if severity == "error"}
        is_usable[k] = errors == {_FAR}
    return np.flatnonzero(is_usable)


def _is_repeated(column: Any) -> NDArray[np.bool_]:
    """Return whether each value equals the one before it; null equals null."""
    codes = pc.fill_null(column.combine_chunks().dictionary_encode().indices, -1).to_numpy()
    repeated = np.zeros(len(codes), bool)
    repeated[1:] = codes[1:] == codes[:-1]
    return repeated
