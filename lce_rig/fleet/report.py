"""The report of a fleet: a page that a manager reads, and the tables behind it."""

import json
from collections.abc import Callable, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.compute as pc
import pyarrow.csv as pc_csv

from lce_rig.core.errors import SessionError
from lce_rig.core.findings import Figure, Finding
from lce_rig.core.geometry import Array
from lce_rig.fleet.changes import FALSE_ALARMS, FALSE_CUSUMS
from lce_rig.fleet.history import STATES, History, finding_of
from lce_rig.fleet.plots import MATRICES, beside_siblings, in_time
from lce_rig.fleet.siblings import Mounting
from lce_rig.fleet.tables import FleetTables
from lce_rig.scene.alignment import AXES, IS_ROTATION
from lce_rig.session.durable import write_atomically
from lce_rig.show.report.page import render
from lce_rig.words import as_json, as_line, describe, recommend
from lce_rig.words.extrinsics import motion_words

FORMAT_VERSION = 1
_MOST_ROWS, _MOST_DRAWINGS, _MOST_MOUNTINGS = 60, 12, 4
_CODE_WORDS = {
    "fleet.moved": "Moved",
    "fleet.moved_last": "Moved before the last session",
    "fleet.drifts": "Drift slowly",
    "fleet.creeps": "Small differences add up",
    "fleet.apart_from_siblings": "Mounted apart from their siblings",
    "fleet.odd_session": "One session differs",
}
_STATE_WORDS = {
    "moved": "moved",
    "moved_last": "moved before the last session, to be confirmed",
    "drifts": "drift slowly",
    "creeps": "small differences add up",
    "odd_session": "steady but for an odd session",
    "steady": "steady",
    "once": "of one session, nothing to compare with",
}


def findings(made: FleetTables) -> list[Finding]:
    """List what concerns single robots: moved first, then drifts, sums, siblings, odd sessions."""
    history = made.history
    named = [finding_of(change) for change in history.changes]
    creeping = np.flatnonzero(history.state == STATES.index("creeps"))
    named += [_creeping(history, int(series)) for series in creeping]
    named += [_apart(mounting, *each) for mounting in made.mountings for each in _one_axis(mounting)]
    order = ["fleet.moved", "fleet.moved_last", "fleet.drifts", "fleet.creeps", "fleet.apart_from_siblings"]
    rank = {code: k for k, code in enumerate(order)}
    return sorted(named, key=lambda each: (rank.get(each.code, len(order)), each.subject))


def _creeping(history: History, series: int) -> Finding:
    first, last = history.starts[series], history.starts[series + 1]
    own = history.cusum[first:last]
    k, axis = np.unravel_index(np.argmax(np.abs(own)), own.shape)
    figures: dict[str, Figure] = {
        "camera": history.names["camera"][series].as_py(),
        "lidar": history.names["lidar"][series].as_py(),
        "axis": AXES[int(axis)],
        "cusum": float(abs(own[k, axis])),
        "limit_cusum": history.limits.cusum,
    }
    return Finding("fleet.creeps", "note", history.names["robot"][series].as_py(), figures)


def _one_axis(mounting: Mounting) -> list[tuple[int, int]]:
    """List each outlier once, by its farthest axis."""
    seen: dict[int, int] = {}
    for robot, axis in mounting.outliers:
        seen.setdefault(robot, axis)
    return list(seen.items())


def _apart(mounting: Mounting, robot: int, axis: int) -> Finding:
    unit, scale = ("deg", float(np.degrees(1.0))) if IS_ROTATION[axis] else ("m", 1.0)
    figures: dict[str, Figure] = {
        "camera": mounting.camera,
        "lidar": mounting.lidar,
        "axis": AXES[axis],
        f"apart_{unit}": scale * float(mounting.apart[robot, axis] - mounting.median[axis]),
        "sigmas": float(abs(mounting.z[robot, axis])),
        "limit_sigmas": mounting.limit,
        "n_siblings": len(mounting.robots) - 1,
    }
    return Finding("fleet.apart_from_siblings", "note", mounting.robots[robot], figures)


def write_csv(made: FleetTables, folder: Path) -> list[Path]:
    """Write each table as a file of comma-separated values into a folder.

    Raises:
        SessionError: it cannot be written.
    """
    paths = []
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, table in (*made.tables.items(), ("sessions", made.sessions())):
            path = folder / f"{name}.csv"
            pc_csv.write_csv(table, path)
            paths.append(path)
    except OSError as error:
        raise SessionError(
            f"{folder}: cannot be written: {error.strerror or error}", "Free space or choose another folder."
        ) from error
    return paths


def document(made: FleetTables) -> dict[str, Any]:
    """Build what --json prints: findings, and the tables but that of all sessions."""
    history = made.history
    return {
        "format_version": FORMAT_VERSION,
        "n_rows": history.n_rows,
        "n_sessions": len(history.rows),
        "n_unusable": history.n_failed,
        "limit_chi2": _finite(history.limits.chi2),
        "limit_cusum": _finite(history.limits.cusum),
        "scale": history.scale.tolist(),
        "findings": [as_json(finding) for finding in findings(made)],
        "robots": history.robots,
        "tables": {
            name: [{k: _finite(v) for k, v in row.items()} for row in table.to_pylist()]
            for name, table in made.tables.items()
        },
    }


def _finite(value: Any) -> Any:
    return None if isinstance(value, float) and not np.isfinite(value) else value


def write_json(made: FleetTables, path: Path) -> None:
    """Write `document` into a file; raises SessionError."""
    write_atomically(path, json.dumps(document(made), allow_nan=False) + "\n")


def page(made: FleetTables, read: Callable[[Sequence[str]], Any], registry: str) -> str:
    """Write the page.

    Args:
        made: the tables.
        read: reads columns of the table that they were made of.
        registry: its name.
    """
    history, named = made.history, findings(made)
    states = list(history.robots.values())
    dates = pc.min_max(history.dates).as_py() if len(history.dates) else {"min": "", "max": ""}
    drawings = _drawings(history, read(MATRICES)) if history.changes else []
    robots = {each.subject for each in named if each.code == "fleet.apart_from_siblings"}
    tables = made.tables
    return render(
        "fleet.html",
        registry=registry,
        first=(dates["min"] or "")[:10],
        last=(dates["max"] or "")[:10],
        n_robots=made.n_robots,
        n_rows=history.n_rows,
        n_sessions=len(history.rows),
        n_unusable=history.n_failed,
        n_moved=states.count("moved") + states.count("moved_last"),
        n_drift=states.count("drifts") + states.count("creeps"),
        n_apart=len(robots),
        states=[(_STATE_WORDS[state], states.count(state)) for state in STATES if state in states],
        todo=_todo(named),
        most=_MOST_ROWS,
        seen=_seen(history),
        drawings=drawings,
        changes=[_change_cells(each) for each in tables["changes"].slice(0, _MOST_ROWS).to_pylist()],
        n_changes=len(tables["changes"]),
        mountings=[
            (each, beside_siblings(each)) for each in made.mountings[:_MOST_MOUNTINGS] if len(each.robots) > 1
        ],
        mounting_rows=[_mounting_cells(each) for each in tables["mounting"].slice(0, _MOST_ROWS).to_pylist()],
        verdicts=[
            (each["result"], each["rows"], each["robots"], f"{100 * each['share']:.1f} %")
            for each in tables["verdicts"].to_pylist()
        ],
        causes=[
            (each["code"], each["severity"], each["rows"], each["robots"])
            for each in tables["causes"].slice(0, _MOST_ROWS).to_pylist()
        ],
        lidars=[_lidar_cells(each) for each in tables["lidars"].slice(0, 20).to_pylist()],
        n_lidars=len(tables["lidars"]),
        cameras=[_camera_cells(each) for each in tables["cameras"].slice(0, 20).to_pylist()],
        n_cameras=len(tables["cameras"]),
        quality=[_quality_cells(each) for each in tables["quality"].slice(0, _MOST_ROWS).to_pylist()],
        limits=history.limits,
        scale=[(_short(axis), f"{value:.2f}") for axis, value in zip(AXES, history.scale, strict=True)],
        n_scale=history.n_scale,
        false_alarms=f"{100 * (FALSE_ALARMS + FALSE_CUSUMS):.0f} %",
    )


def _todo(named: list[Finding]) -> list[tuple[str, str, list[tuple[str, str]], int]]:
    """Group findings by their code: (what, action, (robot, sentence) of the first few, number of all)."""
    groups = []
    for code, each in groupby(named, key=lambda finding: finding.code):
        own = list(each)
        shown = [(finding.subject, as_line(describe(finding))) for finding in own[:_MOST_ROWS]]
        groups.append((_CODE_WORDS[code], as_line(recommend(own[0])), shown, len(own)))
    return groups


def _seen(history: History) -> list[tuple[str, str, str]]:
    """State the smallest change that a session would show, of the median robot and of the worst tenth."""
    lengths = np.diff(history.starts)
    known: Array = history.smallest[lengths > 1]
    if not len(known) or not np.isfinite(known).all():
        return []
    half, most = np.quantile(known, [0.5, 0.9], axis=0)
    return [(_short(axis), _size(half[k], k), _size(most[k], k)) for k, axis in enumerate(AXES)]


def _short(axis: str) -> str:
    return f"{'about' if axis.startswith('rotation') else 'along'} {axis[-1]}"


def _size(value: float, axis: int) -> str:
    return f"{np.degrees(value):.2f} deg" if IS_ROTATION[axis] else f"{1e3 * value:.1f} mm"


def _drawings(history: History, table: Any) -> list[tuple[str, str, Any]]:
    """Draw the robots that changed, the first few of them: (title, sentence, drawing)."""
    order = sorted(history.changes, key=lambda each: (each.found.kind == "odd", each.robot))
    drawn: dict[int, tuple[str, str, Any]] = {}
    for change in order:
        if len(drawn) < _MOST_DRAWINGS and change.series not in drawn:
            title = f"{change.robot}: {change.camera} and {change.lidar}"
            note = f"{motion_words(change.found.axes[0].axis)}; below, its cumulative sum".capitalize()
            drawn[change.series] = (title, note, in_time(history, table, change))
    return list(drawn.values())


def _change_cells(row: dict[str, Any]) -> tuple[Any, ...]:
    first = row["axes"].split()[0]
    kind = {"step": "moved", "drift": "drifts", "odd": "odd session"}[row["kind"]]
    sensor = {"": "either", "lidar": row["lidar"], "camera": row["camera"]}[row["sensor"]]
    size, sigma = row["axis_change"], row["axis_sigma"]
    if first.startswith("rotation"):
        told = f"{size:+.2f} +- {sigma:.2f} deg"
    else:
        told = f"{1e3 * size:+.1f} +- {1e3 * sigma:.1f} mm"
    return (
        row["robot"], f"{row['camera']}, {row['lidar']}", kind, sensor,
        ", ".join(map(_short, row["axes"].split())), row["before"][:10], row["after"][:10], told,
        f"{row['sessions_before']}, {row['sessions_after']}",
    )  # fmt: skip


def _mounting_cells(row: dict[str, Any]) -> tuple[Any, ...]:
    scale, unit = (1.0, "deg") if row["unit"] == "deg" else (1e3, "mm")
    places = 2 if unit == "deg" else 1
    values = [row[name] for name in ("mean", "standard_deviation", "median", "robust_deviation", "largest")]
    tolerance = row["tolerance"]
    return (
        f"{row['rig']}: {row['camera']}, {row['lidar']}",
        f"{_short(row['axis'])}, {unit}", row["robots"],
        *(f"{scale * value:.{places}f}" for value in values),
        "-" if tolerance is None or row["nominal"] != "cad" else f"{scale * tolerance:g}",
    )  # fmt: skip


def _lidar_cells(row: dict[str, Any]) -> tuple[Any, ...]:
    mm = [f"{1e3 * row[name]:.1f}" for name in ("range_m", "model_m", "sigma_m")]
    return (
        row["lidar_serial"] or "-",
        row["rig"],
        row["sessions"],
        row["laser"],
        *mm,
        f"{row['sigmas']:.1f}",
    )


def _camera_cells(row: dict[str, Any]) -> tuple[Any, ...]:
    names = {"focal_length": "focal length", "distortion": "distortion"}
    error, changed = (names.get(row[key], row[key].replace("_", " ")) for key in ("error", "changed"))
    if row["error"] == "focal_length":
        value = f"{100 * row['value']:+.2f} +- {100 * row['sigma']:.2f} %"
    else:
        value = f"{row['value']:+.1f} +- {row['sigma']:.1f} px"
    return (
        row["camera_serial"] or "-", row["robot"], changed, error, row["sessions"],
        f"{row['change_sigmas']:.1f}", f"{row['sigmas']:.1f}", value,
        "-" if row["reprojection_px"] is None else f"{row['reprojection_px']:.2f}",
    )  # fmt: skip


def _quality_cells(row: dict[str, Any]) -> tuple[Any, ...]:
    shares = [f"{100 * row[name]:.0f} %" for name in ("passed", "marginal", "failed", "no_result")]
    return (
        row["collector"] or "-", row["site"] or "-", row["refusal"] or "-", row["sessions"], *shares,
        *("-" if row[n] is None else f"{row[n]:.1f}" for n in ("captures",)),
        "-" if row["used"] is None else f"{100 * row['used']:.0f} %",
        "-" if row["sigma_rotation_deg"] is None else f"{row['sigma_rotation_deg']:.3f}",
        "-" if row["sigma_translation_m"] is None else f"{1e3 * row['sigma_translation_m']:.1f}",
    )  # fmt: skip
