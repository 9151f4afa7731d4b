"""The report of a fleet: robots that moved, and why results are missing or failed.

Each result of a robot, camera and LiDAR is compared with the one before it. With x the tangent from the
earlier pose to the later one,

    chi2 = x^T (C_1 + C_2)^-1 x,    C_k = cov - cov_shared

is chi-squared with 6 degrees of freedom if nothing moved. `cov_shared`, of errors that all sessions of one
profile and method have in common, counts only where profile or method differ. The limit is the quantile that
any of the fleet's comparisons exceeds with a probability of `FALSE_ALARMS` if no robot moved.
"""

import json
import shlex
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from lce_rig.core.findings import Finding
from lce_rig.core.geometry import Array, difference, tangent_sizes
from lce_rig.core.phrasing import as_line
from lce_rig.fleet.findings import MOVED
from lce_rig.fleet.registry import Registry, covariances, poses
from lce_rig.session.durable import write_atomically
from lce_rig.show.page import render

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
# Error of sensors far from the CAD model, whose results are usable; other errors mark them as wrong.
_FAR = "verdict.far_from_nominal"
# 0.01 mm and 0.0006 deg squared, so that zero covariances can be inverted.
_LEAST = 1e-10 * np.eye(6)


@dataclass(frozen=True, eq=False)
class History:
    """The usable results of a fleet, by robot, camera, LiDAR and date.

    Attributes:
        rows: `pyarrow.Table` of N results.
        is_compared: (N,) whether a result is compared with the one in the row before it.
        change: (N, 6) tangent from the pose in the row before, m and rad, axes of the camera; NaN if not
            compared.
        chi2: (N,) of it.
        limit: limit of `chi2`.
        robots: state of every robot in the registry.
    """

    rows: Any
    is_compared: NDArray[np.bool_]
    change: Array
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
    """Compare each result in a table with the previous one.

    Args:
        table: `pyarrow.Table` with at least `MOVED_COLUMNS`.
    """
    from scipy.special import chdtri

    order = [(name, "ascending") for name in (*_SENSORS, "date", "folder")]
    rows = table.take(pa.array(_usable(table))).sort_by(order)
    n = len(rows)
    # Whether each value equals the previous one; null equals null.
    same: dict[str, NDArray[np.bool_]] = {}
    for name in MOVED_COLUMNS[:10]:
        codes = pc.fill_null(rows[name].combine_chunks().dictionary_encode().indices, -1).to_numpy()
        same[name] = np.concatenate([np.zeros(min(n, 1), bool), codes[1:] == codes[:-1]])
    is_compared = np.logical_and.reduce([same[name] for name in _SENSORS]) if n else np.zeros(0, bool)
    for name in _SERIALS:
        is_known = rows[name].is_valid().to_numpy()
        is_compared[1:] &= same[name][1:] | ~is_known[1:] | ~is_known[:-1]
    # A copy of a session does not count as another session.
    is_compared &= ~(same["session_sha256"] & rows["session_sha256"].is_valid().to_numpy())
    change, chi2 = np.full((n, 6), np.nan), np.full(n, np.nan)
    k = np.flatnonzero(is_compared)
    limit = float(chdtri(6, FALSE_ALARMS / max(len(k), 1)))
    if len(k):
        T, cov, shared = poses(rows["T_cam_lidar"]), covariances(rows["cov"]), covariances(rows["cov_shared"])
        differs = ~(same["profile_sha256"] & same["method"])
        change[k] = difference(T[k], T[k - 1])
        both = cov[k] + cov[k - 1] - np.where(differs[k, None, None], 0.0, shared[k] + shared[k - 1]) + _LEAST
        chi2[k] = np.einsum("ki,ki->k", change[k], np.linalg.solve(both, change[k][..., None])[..., 0])
    robots: dict[str, State] = dict.fromkeys(sorted(pc.unique(table["robot"]).to_pylist()), "cannot_tell")
    names = rows["robot"].to_pylist()
    robots |= {names[i]: "steady" for i in k.tolist()}
    robots |= {names[i]: "moved" for i in k[chi2[k] > limit].tolist()}
    return History(rows, is_compared, change, chi2, limit, robots)


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


FORMAT_VERSION = 1
Count = tuple[Any, int, int]
_MOST_ROWS = 60
_STATE_WORDS = {"moved": "moved", "steady": "steady", "cannot_tell": "cannot tell yet"}


@dataclass(frozen=True, eq=False)
class FleetReport:
    """The content of a report.

    Attributes:
        registry: the registry's address.
        n_rows: number of rows of its table.
        history: results compared in time.
        findings: robots that moved.
        verdicts: (verdict, or status without a result), numbers of rows and robots; most rows first.
        causes: (severity, code) of missing, failed and marginal results, rows and robots, likewise.
    """

    registry: str
    n_rows: int
    history: History
    findings: tuple[Finding, ...]
    verdicts: list[Count]
    causes: list[Count]

    @classmethod
    def of(cls, registry: Registry) -> "FleetReport":
        """Build the report of a registry.

        Raises:
            SessionError: the registry has no table, or it cannot be read.
        """
        table = registry.read_table((*MOVED_COLUMNS, "cause"))
        history = history_of(table)
        names = ("robot", "status", "cause", "verdict", "findings", "severities")
        rows = table.select(names).to_pylist()
        results = [(row["verdict"] if row["status"] == "ok" else row["status"], row["robot"]) for row in rows]
        causes = [(("no result", row["cause"]), row["robot"]) for row in rows if row["cause"]]
        for row in rows:
            reasons = zip(row["severities"] or (), row["findings"] or (), strict=False)
            causes += [(reason, row["robot"]) for reason in reasons if reason[0] in ("error", "warning")]
        findings = tuple(history.finding(k) for k in history.moves)
        return cls(registry.place.url, len(rows), history, findings, _counted(results), _counted(causes))

    def write_json(self, path: Path) -> None:
        """Write findings, states and counts; raises SessionError."""
        document = {
            "format_version": FORMAT_VERSION,
            "n_rows": self.n_rows,
            "n_sessions": len(self.history.rows),
            "limit_chi2": self.history.limit,
            "findings": [finding.as_json() for finding in self.findings],
            "robots": dict(self.history.robots),
            "verdicts": [{"result": result, "rows": n, "robots": m} for result, n, m in self.verdicts],
            "causes": [
                {"severity": severity, "code": code, "rows": n, "robots": m}
                for (severity, code), n, m in self.causes
            ],
        }
        write_atomically(path, json.dumps(document, allow_nan=False) + "\n")

    def page(self) -> str:
        """Write the page, which loads no external files."""
        history = self.history
        states = [*history.robots.values()]
        dates = pc.min_max(history.rows["date"]).as_py() if len(history.rows) else {"min": "", "max": ""}
        shown = self.findings[:_MOST_ROWS]
        return render(
            "fleet.html",
            registry=self.registry,
            command=shlex.join(["lce-rig", "fleet", "report", "--registry", self.registry]),
            first=(dates["min"] or "")[:10],
            last=(dates["max"] or "")[:10],
            n_robots=len(states),
            n_rows=self.n_rows,
            n_sessions=len(history.rows),
            n_moved=states.count("moved"),
            n_compared=int(history.is_compared.sum()),
            states=[(_STATE_WORDS[state], states.count(state)) for state in STATES],
            moved=[(finding.subject, as_line(finding.text)) for finding in shown],
            n_moves=len(self.findings),
            action=as_line(str(MOVED.action)),
            verdicts=[(*count, f"{100 * count[1] / self.n_rows:.1f} %") for count in self.verdicts],
            causes=[(code, severity, n, m) for (severity, code), n, m in self.causes[:_MOST_ROWS]],
            limit=f"{history.limit:.1f}",
            false_alarms=f"{100 * FALSE_ALARMS:.0f} %",
        )


def _counted(pairs: Iterable[tuple[Any, str]]) -> list[Count]:
    """Count rows and robots by key, the most frequent first."""
    robots: dict[Any, list[str]] = {}
    for key, robot in pairs:
        robots.setdefault(key, []).append(robot)
    counts = [(key, len(names), len(set(names))) for key, names in robots.items()]
    return sorted(counts, key=lambda count: (-count[1], count[0]))
