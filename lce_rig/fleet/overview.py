"""What a fleet's table says of verdicts, causes, sensors and collection; counts and medians, no opinion."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from lce_rig.core.geometry import Array

OVERVIEW_COLUMNS = (
    "robot", "rig", "lidar", "camera_serial", "lidar_serial", "date", "status", "cause", "verdict",
    "findings", "severities", "refusals", "n_captures", "n_used", "n_refused", "reprojection_px",
    "sigma_rotation_deg", "sigma_translation_m", "laser_range_m", "laser_range_sigma_m", "lens_error",
    "lens_error_sigma", "collector", "site",
)  # fmt: skip
"""Columns of the table that this module requires."""

LENS = ("focal_length", "principal_point_x", "principal_point_y", "distortion")
"""Order of `lens_error`: relative; px; px; px in the image's corner."""


def verdicts(table: Any) -> Any:
    """Count sessions by verdict, or by why there is none: columns result, sessions, robots, share."""
    result = pc.if_else(pc.equal(table["status"], "ok"), table["verdict"], table["status"])
    counted = _counted(pa.table({"result": result, "robot": table["robot"]}), ["result"])
    share = pc.divide(pc.cast(counted["rows"], pa.float64()), max(len(table), 1))
    return counted.append_column("share", share)


def causes(table: Any) -> Any:
    """Rank why sessions have no result, fail or are marginal: columns severity, code, rows, robots."""
    known = pc.is_valid(table["cause"])
    failed = table.filter(known).select(["robot", "cause"])
    parts = [
        pa.table(
            {
                "severity": pa.array(["no result"] * len(failed), pa.string()),
                "code": failed["cause"],
                "robot": failed["robot"],
            }
        )
    ]
    codes, severities = table["findings"].combine_chunks(), table["severities"].combine_chunks()
    robots = table["robot"].take(pc.list_parent_indices(codes))
    each = pa.table(
        {"severity": pc.list_flatten(severities), "code": pc.list_flatten(codes), "robot": robots}
    )
    parts.append(each.filter(pc.is_in(each["severity"], value_set=pa.array(["error", "warning"]))))
    return _counted(pa.concat_tables(parts), ["severity", "code"])


def _counted(table: Any, keys: list[str]) -> Any:
    """Count rows and robots by keys, the most rows first."""
    grouped = table.group_by(keys, use_threads=False).aggregate(
        [("robot", "count"), ("robot", "count_distinct")]
    )
    grouped = grouped.rename_columns([*keys, "rows", "robots"])
    order = [("rows", "descending"), *((key, "ascending") for key in keys)]
    return grouped.sort_by(order)


def quality(table: Any) -> Any:
    """Compare the collection by person and site, where they are known.

    Returns:
        Columns collector, site, sessions, passed, marginal, failed, no_result (shares), captures, used
        (share of captures), sigma_rotation_deg, sigma_translation_m (medians), refusal (the most frequent).
    """
    known = table.filter(pc.or_(pc.is_valid(table["collector"]), pc.is_valid(table["site"])))
    result = pc.fill_null(pc.if_else(pc.equal(known["status"], "ok"), known["verdict"], "no_result"), "fail")
    columns = {
        "collector": known["collector"],
        "site": known["site"],
        **{
            name: pc.cast(pc.equal(result, value), pa.float64())
            for name, value in (
                ("passed", "pass"), ("marginal", "marginal"), ("failed", "fail"), ("no_result", "no_result"),
            )
        },
        **{
            name: known[name]
            for name in ("n_captures", "n_used", "sigma_rotation_deg", "sigma_translation_m")
        },
    }  # fmt: skip
    shares = ("passed", "marginal", "failed", "no_result")
    grouped = pa.table(columns).group_by(["collector", "site"], use_threads=False).aggregate(
        [
            ("passed", "count"),
            *((name, "mean") for name in shares),
            ("n_captures", "mean"),
            ("n_captures", "sum"),
            ("n_used", "sum"),
            ("sigma_rotation_deg", "approximate_median"),
            ("sigma_translation_m", "approximate_median"),
        ]
    )  # fmt: skip
    used = pc.divide(
        pc.cast(grouped["n_used_sum"], pa.float64()), pc.cast(grouped["n_captures_sum"], pa.float64())
    )
    refused = _most_refused(known)
    places = zip(grouped["collector"].to_pylist(), grouped["site"].to_pylist(), strict=True)
    return pa.table(
        {
            "collector": grouped["collector"],
            "site": grouped["site"],
            "sessions": grouped["passed_count"],
            **{name: grouped[f"{name}_mean"] for name in shares},
            "captures": grouped["n_captures_mean"],
            "used": used,
            "sigma_rotation_deg": grouped["sigma_rotation_deg_approximate_median"],
            "sigma_translation_m": grouped["sigma_translation_m_approximate_median"],
            "refusal": pa.array([refused.get(place) for place in places], pa.string()),
        }
    ).sort_by([("passed", "ascending"), ("sessions", "descending")])


def _most_refused(known: Any) -> dict[tuple[Any, Any], str]:
    """Name the most frequent refusal by collector and site."""
    refusals = known["refusals"].combine_chunks()
    parents = pc.list_parent_indices(refusals)
    each = pa.table(
        {
            "collector": known["collector"].take(parents),
            "site": known["site"].take(parents),
            "code": pc.list_flatten(refusals),
        }
    )
    counted = each.group_by(["collector", "site", "code"], use_threads=False).aggregate([("code", "count")])
    found: dict[tuple[Any, Any], str] = {}
    for row in counted.sort_by([("code_count", "descending"), ("code", "ascending")]).to_pylist():
        found.setdefault((row["collector"], row["site"]), row["code"])
    return found


def cameras(table: Any) -> Any:
    """Rank cameras by how far the boards contradict their profile's lens, and by how that changes in time.

    The error of a lens, given less seen, is averaged over sessions with the weights of their variances;
    `sigmas` is the largest of its four errors in standard deviations, `change_sigmas` of the second half of
    the sessions less the first.

    Returns:
        Columns camera_serial, robot, sessions, reprojection_px (median), sigmas, error (which), value,
        sigma, change_sigmas, changed (which).
    """
    rows = table.filter(pc.and_(pc.is_valid(table["lens_error"]), pc.is_valid(table["lens_error_sigma"])))
    values, sigma = _lists(rows["lens_error"], len(LENS)), _lists(rows["lens_error_sigma"], len(LENS))
    found = []
    for (serial, robot), own in _groups(rows, ("camera_serial", "robot"), values, sigma):
        order = np.argsort(rows["date"].take(pa.array(own)).to_numpy(zero_copy_only=False).astype(str))
        own = own[order]
        mean, deviation = _mean(values[own], sigma[own])
        half = len(own) // 2
        change = np.zeros(len(LENS))
        if half:
            first, second = (
                _mean(values[own[:half]], sigma[own[:half]]),
                _mean(values[own[half:]], sigma[own[half:]]),
            )
            change = (second[0] - first[0]) / np.hypot(first[1], second[1])
        worst, changed = int(np.argmax(np.abs(mean / deviation))), int(np.argmax(np.abs(change)))
        median = pc.approximate_median(rows["reprojection_px"].take(pa.array(own))).as_py()
        found.append(
            {
                "camera_serial": serial,
                "robot": robot,
                "sessions": len(own),
                "reprojection_px": median,
                "sigmas": float(abs(mean[worst] / deviation[worst])),
                "error": LENS[worst],
                "value": float(mean[worst]),
                "sigma": float(deviation[worst]),
                "change_sigmas": float(abs(change[changed])),
                "changed": LENS[changed],
            }
        )
    schema = pa.schema(
        [
            ("camera_serial", pa.string()), ("robot", pa.string()), ("sessions", pa.int64()),
            ("reprojection_px", pa.float64()), ("sigmas", pa.float64()), ("error", pa.string()),
            ("value", pa.float64()), ("sigma", pa.float64()), ("change_sigmas", pa.float64()),
            ("changed", pa.string()),
        ]
    )  # fmt: skip
    return pa.Table.from_pylist(found, schema=schema).sort_by([("change_sigmas", "descending")])


def lidars(table: Any) -> Any:
    """Rank LiDARs by their lasers' range offsets, each against the same laser of the others of its model.

    Returns:
        Columns lidar_serial, rig, sessions, laser (the farthest), range_m (its offset about the mean of its
        LiDAR), model_m (median of its model), sigma_m, sigmas.
    """
    rows = table.filter(
        pc.and_(pc.is_valid(table["laser_range_m"]), pc.is_valid(table["laser_range_sigma_m"]))
    )
    by_serial: list[dict[str, Any]] = []
    offsets: dict[tuple[str, int], list[Array]] = {}
    if len(rows):
        length = pc.list_value_length(rows["laser_range_m"])
        for n in pc.unique(length).to_pylist():
            part = rows.filter(pc.equal(length, n))
            values, sigma = _lists(part["laser_range_m"], n), _lists(part["laser_range_sigma_m"], n)
            for (serial, rig, _), own in _groups(part, ("lidar_serial", "rig", "lidar"), values, sigma):
                mean, deviation = _mean(values[own] - values[own].mean(axis=1, keepdims=True), sigma[own])
                by_serial.append(
                    {"lidar_serial": serial, "rig": rig, "sessions": len(own), "mean": mean, "own": deviation}
                )
                offsets.setdefault((rig, n), []).append(mean)
    medians = {key: np.median(each, axis=0) for key, each in offsets.items()}
    found = []
    for each in by_serial:
        model = medians[each["rig"], len(each["mean"])]
        sigmas = np.abs(each["mean"] - model) / each["own"]
        worst = int(np.argmax(sigmas))
        found.append(
            {
                "lidar_serial": each["lidar_serial"],
                "rig": each["rig"],
                "sessions": each["sessions"],
                "laser": worst,
                "range_m": float(each["mean"][worst]),
                "model_m": float(model[worst]),
                "sigma_m": float(each["own"][worst]),
                "sigmas": float(sigmas[worst]),
            }
        )
    schema = pa.schema(
        [
            ("lidar_serial", pa.string()), ("rig", pa.string()), ("sessions", pa.int64()),
            ("laser", pa.int64()), ("range_m", pa.float64()), ("model_m", pa.float64()),
            ("sigma_m", pa.float64()), ("sigmas", pa.float64()),
        ]
    )  # fmt: skip
    return pa.Table.from_pylist(found, schema=schema).sort_by([("sigmas", "descending")])


def _lists(column: Any, n: int) -> Array:
    values = column.combine_chunks().flatten().to_numpy(zero_copy_only=False)
    return np.asarray(values, dtype=np.float64).reshape(-1, n)


def _mean(values: Array, sigma: Array) -> tuple[Array, Array]:
    """Average (K, n) with the weights of their variances: (n,) and its standard deviation."""
    weights = 1 / np.maximum(sigma, 1e-12) ** 2
    total = weights.sum(axis=0)
    return (weights * values).sum(axis=0) / total, np.sqrt(1 / total)


def _groups(table: Any, keys: Sequence[str], *finite: Array) -> list[tuple[tuple[Any, ...], Any]]:
    """List rows by keys; without those that hold what is not finite."""
    good = np.all([np.isfinite(each).all(axis=1) for each in finite], axis=0) if len(table) else np.zeros(0)
    members: dict[tuple[Any, ...], list[int]] = {}
    columns = [table[key].to_pylist() for key in keys]
    for row, key in enumerate(zip(*columns, strict=True)):
        if good[row]:
            members.setdefault(tuple("" if each is None else each for each in key), []).append(row)
    return [(key, np.array(own)) for key, own in members.items()]
