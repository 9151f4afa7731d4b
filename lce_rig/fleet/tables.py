"""Tables of a fleet's report, as `pyarrow` tables that a page shows and programs read."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from lce_rig.core.geometry import Array
from lce_rig.fleet.history import COLUMNS, STATES, Change, History, history_of
from lce_rig.fleet.overview import OVERVIEW_COLUMNS, cameras, causes, lidars, quality, verdicts
from lce_rig.fleet.siblings import MOUNTING_COLUMNS, Mounting, mountings
from lce_rig.scene.alignment import AXES, IS_ROTATION

_UNIT = np.where(IS_ROTATION, np.degrees(1.0), 1.0)
_NAMES = [f"{axis}_{'deg' if turns else 'm'}" for axis, turns in zip(AXES, IS_ROTATION, strict=True)]


@dataclass(frozen=True, eq=False)
class FleetTables:
    """What a report says.

    Attributes:
        history: each robot in time.
        mountings: robots beside their siblings.
        tables: by name, for export; units in the names of columns.
        n_robots: in the registry, with a usable result or not.
    """

    history: History
    mountings: tuple[Mounting, ...]
    tables: dict[str, Any]
    n_robots: int

    def sessions(self) -> Any:
        """Each session against those before it, which is as long as the registry's table."""
        return _sessions(self.history)


def tables_of(read: Callable[[Sequence[str]], Any]) -> FleetTables:
    """Make the tables of a report.

    Args:
        read: reads columns of a registry's table; of a large one, a part is held at a time.
    """
    history = history_of(read(COLUMNS))
    siblings = mountings(read(MOUNTING_COLUMNS), history)
    table = read(OVERVIEW_COLUMNS)
    return FleetTables(
        history,
        siblings,
        {
            "robots": _robots(history),
            "changes": pa.Table.from_pylist([_change(each) for each in history.changes], schema=_CHANGES),
            "mounting": _mounting(siblings),
            "mounting_robots": _mounting_robots(siblings),
            "verdicts": verdicts(table),
            "causes": causes(table),
            "cameras": cameras(table),
            "lidars": lidars(table),
            "quality": quality(table),
        },
        len(pc.unique(table["robot"])),
    )


def _by_axis(prefix: str, values: Array) -> dict[str, Array]:
    scaled = values * _UNIT
    return {f"{prefix}_{name}": scaled[:, k] for k, name in enumerate(_NAMES)}


def _robots(history: History) -> Any:
    lengths = np.diff(history.starts)
    last, first = history.starts[1:] - 1, history.starts[:-1]
    sigma = np.sqrt(np.einsum("gii->gi", history.cov_now))
    columns = {name: history.names[name] for name in history.names.column_names}
    return pa.table(
        {
            **columns,
            "state": pa.array([STATES[k] for k in history.state.tolist()], pa.string()),
            "sessions": lengths,
            "first": history.dates.take(pa.array(first)),
            "last": history.dates.take(pa.array(last)),
            "last_chi2": pa.array(history.chi2[last], from_pandas=True),
            **_by_axis("sigma", sigma),
            **_by_axis("smallest", history.smallest),
        }
    )


_CHANGES = pa.schema(
    [
        *((name, pa.string()) for name in ("robot", "camera", "lidar", "kind", "before", "after")),
        *((name, pa.string()) for name in ("earliest", "latest", "sensor", "axes", "instead", "folder")),
        ("confirmed", pa.bool_()), ("sessions_before", pa.int64()), ("sessions_after", pa.int64()),
        ("axis_change", pa.float64()), ("axis_sigma", pa.float64()),
        ("chi2", pa.float64()), ("rotation_deg", pa.float64()), ("translation_m", pa.float64()),
        *((f"change_{name}", pa.float64()) for name in _NAMES),
    ]
)  # fmt: skip


def _change(change: Change) -> dict[str, Any]:
    found = change.found
    rotation_deg, translation_m = change.sizes
    return {
        **{name: getattr(change, name) for name in ("robot", "camera", "lidar", "before", "after")},
        **{name: getattr(change, name) for name in ("earliest", "latest", "sensor", "folder")},
        "kind": found.kind,
        "axes": " ".join(axis.axis for axis in found.axes),
        "instead": " ".join(other for axis in found.axes for other in axis.instead),
        "axis_change": found.axes[0].change,
        "axis_sigma": found.axes[0].sigma,
        "confirmed": change.is_confirmed,
        "sessions_before": found.n_before,
        "sessions_after": found.n_after,
        "chi2": found.chi2,
        "rotation_deg": rotation_deg,
        "translation_m": translation_m,
        **{
            f"change_{name}": float(value)
            for name, value in zip(_NAMES, np.array(found.tangent) * _UNIT, strict=True)
        },
    }  # fmt: skip


def _mounting(siblings: tuple[Mounting, ...]) -> Any:
    rows = []
    for each in siblings:
        mean, spread = each.apart.mean(axis=0), each.apart.std(axis=0, ddof=min(1, len(each.robots) - 1))
        for k, axis in enumerate(AXES):
            rows.append(
                {
                    "rig": each.rig,
                    "camera": each.camera,
                    "lidar": each.lidar,
                    "nominal": each.source or "none",
                    "axis": axis,
                    "unit": "deg" if IS_ROTATION[k] else "m",
                    "robots": len(each.robots),
                    "mean": float(mean[k] * _UNIT[k]),
                    "standard_deviation": float(spread[k] * _UNIT[k]),
                    "median": float(each.median[k] * _UNIT[k]),
                    "robust_deviation": float(each.spread[k] * _UNIT[k]),
                    "largest": float(np.abs(each.apart[:, k]).max() * _UNIT[k]),
                    "tolerance": each.tolerance_deg if IS_ROTATION[k] else each.tolerance_m,
                }
            )
    names = ("rig", "camera", "lidar", "nominal", "axis", "unit")
    figures = ("mean", "standard_deviation", "median", "robust_deviation", "largest", "tolerance")
    schema = pa.schema(
        [*((n, pa.string()) for n in names), ("robots", pa.int64()), *((n, pa.float64()) for n in figures)]
    )
    return pa.Table.from_pylist(rows, schema=schema)


def _mounting_robots(siblings: tuple[Mounting, ...]) -> Any:
    parts = [
        pa.table(
            {
                "robot": pa.array(each.robots, pa.string()),
                "rig": pa.array([each.rig] * len(each.robots), pa.string()),
                "camera": pa.array([each.camera] * len(each.robots), pa.string()),
                "lidar": pa.array([each.lidar] * len(each.robots), pa.string()),
                "siblings": pa.array([len(each.robots) - 1] * len(each.robots), pa.int64()),
                "is_outlier": each.is_one_kind & (np.abs(each.z).max(axis=1) > each.limit),
                **_by_axis("apart", each.apart),
                **{f"sigmas_{axis}": each.z[:, k] for k, axis in enumerate(AXES)},
            }
        )
        for each in siblings
    ]
    return pa.concat_tables(parts) if parts else pa.table({"robot": pa.array([], pa.string())})


def _sessions(history: History) -> Any:
    group = np.repeat(np.arange(len(history.starts) - 1), np.diff(history.starts))
    names = history.names.select(["robot", "camera", "lidar"])
    robot, camera, lidar = (names[name].combine_chunks().take(pa.array(group)) for name in names.column_names)
    return pa.table(
        {
            "robot": robot,
            "camera": camera,
            "lidar": lidar,
            "date": history.dates,
            "folder": history.folders,
            "chi2": pa.array(history.chi2, from_pandas=True),
            **{k: pa.array(v, from_pandas=True) for k, v in _by_axis("change", history.apart).items()},
            **{k: pa.array(v, from_pandas=True) for k, v in _by_axis("sigma", history.sigma).items()},
            **{f"cusum_{axis}": history.cusum[:, k] for k, axis in enumerate(AXES)},
        }
    )
