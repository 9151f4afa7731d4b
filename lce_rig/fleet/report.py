"""The report of a fleet: one page, and the tables behind it."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv as pc_csv
from markupsafe import Markup

from lce_rig.core.errors import SessionError
from lce_rig.core.findings import Finding
from lce_rig.core.geometry import difference
from lce_rig.core.phrasing import as_line
from lce_rig.fleet.findings import MOVED
from lce_rig.fleet.moved import FALSE_ALARMS, MOVED_COLUMNS, STATES, History, history_of
from lce_rig.fleet.registry import Registry
from lce_rig.fleet.table import covariances, poses
from lce_rig.session.durable import write_atomically
from lce_rig.show.report.drawing import BLUE, FAINT, RED, drawing, new_axes, style
from lce_rig.show.report.page import render

FORMAT_VERSION = 1
_CAUSE_COLUMNS = ("robot", "status", "cause", "verdict", "findings", "severities")
_AXES = tuple((f"{kind} {axis}", unit) for kind, unit in (("along", "m"), ("about", "deg")) for axis in "xyz")
_MOST_ROWS, _MOST_DRAWINGS, _MOST_SESSIONS = 60, 12, 400
_STATE_WORDS = {"moved": "moved", "steady": "steady", "cannot_tell": "cannot tell yet"}


@dataclass(frozen=True, eq=False)
class FleetReport:
    """The content of a report.

    Attributes:
        registry: its name.
        history: results compared in time.
        findings: robots that moved.
        tables: by name, for export; units in the names of columns.
        n_rows: of the registry's table.
    """

    registry: str
    history: History
    findings: tuple[Finding, ...]
    tables: dict[str, Any]
    n_rows: int

    @classmethod
    def of(cls, registry: Registry) -> "FleetReport":
        """Make the report of a registry.

        Raises:
            SessionError: the registry has no table, or it cannot be read.
        """
        history = history_of(registry.read_table(MOVED_COLUMNS))
        table = registry.read_table(_CAUSE_COLUMNS)
        sessions = _sessions(history)
        tables = {
            "robots": pa.table({"robot": [*history.robots], "state": [*history.robots.values()]}),
            "moves": sessions.take(pa.array(history.moves, pa.int64())),
            "sessions": sessions,
            "verdicts": _verdicts(table),
            "causes": _causes(table),
        }
        findings = tuple(history.finding(k) for k in history.moves)
        return cls(registry.place.name, history, findings, tables, len(table))

    def write_csv(self, folder: Path) -> None:
        """Write each table as a file of comma-separated values into a folder; raises SessionError."""
        try:
            folder.mkdir(parents=True, exist_ok=True)
            for name, table in self.tables.items():
                pc_csv.write_csv(table, folder / f"{name}.csv")
        except OSError as error:
            raise SessionError(
                f"{folder} cannot be written: {error.strerror or error}", "Choose another folder."
            ) from error

    def write_json(self, path: Path) -> None:
        """Write findings and all tables but that of the sessions, which is long; raises SessionError."""
        document = {
            "format_version": FORMAT_VERSION,
            "n_rows": self.n_rows,
            "n_sessions": len(self.history.rows),
            "limit_chi2": self.history.limit,
            "findings": [finding.as_json() for finding in self.findings],
            "robots": dict(self.history.robots),
            "tables": {name: table.to_pylist() for name, table in self.tables.items() if name != "sessions"},
        }
        write_atomically(path, json.dumps(document, allow_nan=False) + "\n")

    def page(self) -> str:
        """Write the page, which loads nothing."""
        history = self.history
        states = [*history.robots.values()]
        dates = pc.min_max(history.rows["date"]).as_py() if len(history.rows) else {"min": "", "max": ""}
        shown = self.findings[:_MOST_ROWS]
        return render(
            "fleet.html",
            registry=self.registry,
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
            drawings=_drawings(history),
            verdicts=[
                (row["result"], row["rows"], row["robots"], f"{100 * row['share']:.1f} %")
                for row in self.tables["verdicts"].to_pylist()
            ],
            causes=[
                (row["code"], row["severity"], row["rows"], row["robots"])
                for row in self.tables["causes"].slice(0, _MOST_ROWS).to_pylist()
            ],
            limit=f"{history.limit:.1f}",
            false_alarms=f"{100 * FALSE_ALARMS:.0f} %",
        )


def _sessions(history: History) -> Any:
    """List each usable result with its change from the one before; null where there is none."""
    columns = {name: history.rows[name] for name in ("robot", "camera", "lidar", "date", "folder")}
    before = pa.array([None, *columns["date"].to_pylist()][: len(history.rows)], pa.string())
    columns["before"] = pc.if_else(pa.array(history.is_compared), before, None)
    columns["chi2"] = pa.array(history.chi2, from_pandas=True)
    for k, (axis, unit) in enumerate(_AXES):
        factor = float(np.degrees(1.0)) if unit == "deg" else 1.0
        name = axis.replace(" ", "_")
        columns[f"change_{name}_{unit}"] = pa.array(factor * history.change[:, k], from_pandas=True)
        columns[f"sigma_{name}_{unit}"] = pa.array(factor * history.sigma[:, k], from_pandas=True)
    return pa.table(columns)


def _verdicts(table: Any) -> Any:
    """Count results by verdict, or by the status of those that there are not: result, rows, robots, share."""
    result = pc.if_else(pc.equal(table["status"], "ok"), table["verdict"], table["status"])
    counted = _counted(pa.table({"result": result, "robot": table["robot"]}), ["result"])
    share = pc.divide(pc.cast(counted["rows"], pa.float64()), max(len(table), 1))
    return counted.append_column("share", share)


def _causes(table: Any) -> Any:
    """Rank the reasons of missing, failed and marginal results: severity, code, rows, robots."""
    failed = table.filter(pc.is_valid(table["cause"]))
    severity = pa.array(["no result"] * len(failed), pa.string())
    missing = pa.table({"severity": severity, "code": failed["cause"], "robot": failed["robot"]})
    codes, severities = table["findings"].combine_chunks(), table["severities"].combine_chunks()
    reasons = pa.table(
        {
            "severity": pc.list_flatten(severities),
            "code": pc.list_flatten(codes),
            "robot": table["robot"].take(pc.list_parent_indices(codes)),
        }
    )
    reasons = reasons.filter(pc.is_in(reasons["severity"], value_set=pa.array(["error", "warning"])))
    return _counted(pa.concat_tables([missing, reasons]), ["severity", "code"])


def _counted(table: Any, keys: list[str]) -> Any:
    """Count rows and robots by keys, the most rows first."""
    counts = [("robot", "count"), ("robot", "count_distinct")]
    grouped = (
        table.group_by(keys, use_threads=False).aggregate(counts).rename_columns([*keys, "rows", "robots"])
    )
    return grouped.sort_by([("rows", "descending"), *((key, "ascending") for key in keys)])


def _drawings(history: History) -> list[tuple[str, str, Markup]]:
    """Draw the first few robots that moved along the axis that changed most: (title, note, drawing)."""
    drawn: dict[tuple[str, ...], tuple[str, str, Markup]] = {}
    is_start = ~history.is_compared
    for k in history.moves:
        robot, camera, lidar = (history.rows[name][k].as_py() for name in ("robot", "camera", "lidar"))
        if len(drawn) == _MOST_DRAWINGS or (robot, camera, lidar) in drawn:
            continue
        starts = np.flatnonzero(is_start[: k + 1])
        ends = np.flatnonzero(is_start[k + 1 :])
        first = max(int(starts[-1]), k - _MOST_SESSIONS // 2)
        last = min(k + 1 + (int(ends[0]) if len(ends) else len(history.rows)), k + _MOST_SESSIONS // 2)
        axis = int(np.argmax(np.abs(history.change[k] / history.sigma[k])))
        title, note = f"{robot}: {camera} and {lidar}", f"{_AXES[axis][0]} of the camera"
        drawn[robot, camera, lidar] = (title, note, _in_time(history, first, last, axis, title))
    return list(drawn.values())


def _in_time(history: History, first: int, last: int, axis: int, label: str) -> Markup:
    """Draw rows first to last along one axis, with bars of two independent standard deviations."""
    from matplotlib import dates

    rows = history.rows.slice(first, last - first)
    T, cov = poses(rows["T_cam_lidar"]), covariances(rows["cov"]) - covariances(rows["cov_shared"])
    unit = float(np.degrees(1.0)) if _AXES[axis][1] == "deg" else 1e3
    values = unit * difference(T, np.broadcast_to(T[0], T.shape))[:, axis]
    sigma = unit * np.sqrt(np.maximum(cov[:, axis, axis], 0.0))
    days: Any = np.array([date.removesuffix("Z") for date in rows["date"].to_pylist()], dtype="datetime64[s]")
    module: Any = dates
    with style():
        figure, (axes,) = new_axes(2.2, left_in=0.62, top_in=0.08)
        axes.errorbar(days, values, 2 * sigma, fmt="none", lw=0.8, ecolor=FAINT)
        axes.plot(days, values, "o", ms=3.5, color=BLUE, mew=0)
        for k in history.moves:
            if first < k < last:
                axes.axvspan(days[k - first - 1], days[k - first], color=RED, alpha=0.25, lw=0)
        axes.set_ylabel("deg" if _AXES[axis][1] == "deg" else "mm")
        axes.grid(axis="y")
        locator = module.AutoDateLocator(maxticks=6)
        axes.xaxis.set_major_locator(locator)
        axes.xaxis.set_major_formatter(module.ConciseDateFormatter(locator))
        return drawing(figure, label)
