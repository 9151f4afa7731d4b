"""Fleets: hundreds of simulated sessions, broken sessions, large tables."""

import json
import os
import resource
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.fleet_sessions import BROKEN, TRUTH, break_sessions, make_fleet
from benchmarks.measured import measure
from benchmarks.tables import print_head, print_row
from lce_rig.core.geometry import perturb
from lce_rig.fleet.registry import SCHEMA, TABLE, Registry, as_table, in_order, table_bytes
from lce_rig.fleet.report import MOVED_COLUMNS, history_of
from lce_rig.fleet.storage import Storage

_FEW_ROBOTS, _FEW_SESSIONS = 10, 30
_TABLE_ROWS = 1_000_000


def bench_fleet(folder: Path, only: str = "") -> None:
    """Print the tables of docs/benchmarks.md.

    Args:
        folder: where simulated captures, sessions and registries are kept.
        only: one of the parts: sessions, broken, table.
    """
    folder = folder.resolve()
    parts = {
        "sessions": bench_sessions,
        "broken": bench_broken,
        "table": bench_table,
    }
    for name, part in parts.items():
        if only in ("", name):
            print(f"\n{name} (load of the computer before: {os.getloadavg()[0]:.1f})\n", flush=True)
            part(folder)


def few_sessions(folder: Path) -> Path:
    """Write thirty sessions of ten robots, unless they are there."""
    root = folder / "few"
    make_fleet(root, folder / "captures", _FEW_ROBOTS, _FEW_SESSIONS, 0)
    return root


def _command(root: str | Path, registry: str | Path, *options: str) -> list[str]:
    run = [sys.executable, "-m", "lce_rig", "fleet", "run", str(root), "--registry", str(registry), "--json"]
    return [*run, *options]


def run_cli(root: str | Path, registry: str | Path, *options: str) -> tuple[dict[str, Any], float, float]:
    """Run the command; return its summary, the time that it took and that of processors."""
    before, start_s = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
    done = subprocess.run(_command(root, registry, *options), check=True, capture_output=True, text=True)
    took_s, after = time.monotonic() - start_s, resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    summary: dict[str, Any] = json.loads(done.stdout)
    return summary, took_s, cpu_s


def rows_of(registry: Path) -> list[dict[str, Any]]:
    """Read the table of a registry as plain values."""
    rows: list[dict[str, Any]] = Registry(Storage.at(registry)).read_table().to_pylist()
    return rows


def bench_sessions(folder: Path) -> None:
    """Run a fleet of 500 sessions of 60 robots; a stopped run is resumed."""
    root, registry = folder / "fleet", folder / "registry"
    make_fleet(root, folder / "captures")
    summary, took_s, cpu_s = run_cli(root, registry, "--workers", "2")
    rows = rows_of(registry)
    in_sessions_s = sum(row["duration_s"] for row in rows)
    print_head(
        "sessions", "run now", "robots", "rows", "status", "s", "s of a core", "of it in sessions", "MB"
    )
    measure("fleet.session", "{:.1f} s", in_sessions_s / len(rows))
    megabytes = sum(path.stat().st_size for path in registry.rglob("*") if path.is_file()) / 1e6
    robots = len({row["robot"] for row in rows})
    states = ", ".join(f"{key} {n}" for key, n in summary["statuses"].items())
    n = summary["n_run"] + summary["n_held"]
    print_row(
        n, summary["n_run"], robots, len(rows), states, f"{took_s:.0f}", f"{cpu_s:.0f}",
        f"{in_sessions_s:.0f}", f"{megabytes:.0f}",
    )  # fmt: skip
    print(f"\ntruth: {root / TRUTH}, registry: {registry}", flush=True)
    compare_with_truth(root, registry)


def compare_with_truth(root: Path, registry: Path) -> None:
    """Compare the robots and dates of the reported movements with the simulated ones."""
    truth: dict[str, Any] = json.loads((root / TRUTH).read_text())
    history = history_of(Registry(Storage.at(registry)).read_table(MOVED_COLUMNS))
    named = {robot for robot, state in history.robots.items() if state == "moved"}
    right = set()
    for k in history.moves:
        finding = history.finding(k)
        nudge = truth[finding.subject]
        if nudge is not None and str(finding.figures["after"])[:10] == nudge["date"]:
            right.add(finding.subject)
    nudged = {robot for robot, nudge in truth.items() if nudge is not None}
    unchanged = truth.keys() - nudged
    measure("fleet.named", "{} of {}", len(right), len(nudged))
    measure("fleet.false", "{} of {}", len(named & unchanged), len(unchanged))
    print_head("robots", "nudged", "named", "with date", "unchanged", "named")
    print_row(
        len(truth), len(nudged), len(named & nudged), len(right), len(unchanged), len(named & unchanged)
    )


def bench_broken(folder: Path) -> None:
    """A fifth of the sessions is broken; each must be named with its cause, the rest unharmed."""
    sound = folder / "registry-2"
    if not sound.exists():
        run_cli(few_sessions(folder), sound, "--workers", "2")
    root, registry = folder / "broken", folder / "registry-broken"
    shutil.rmtree(root, ignore_errors=True)
    shutil.rmtree(registry, ignore_errors=True)
    make_fleet(root, folder / "captures", _FEW_ROBOTS, _FEW_SESSIONS, 0)
    broken = break_sessions(root)
    run_cli(root, registry, "--workers", "2", "--time-limit", "60", "--memory-limit", "1000")
    rows = {row["source"]: row for row in rows_of(registry)}
    print_head("kind", "sessions", "status", "cause")
    for kind, (_, wanted) in BROKEN.items():
        own = [rows[path] for path, each in broken.items() if each == kind]
        named = sorted({f"{row['status']}: {row['cause']}" for row in own})
        right = sum(row["status"] == wanted for row in own)
        print_row(kind, len(own), f"{right} of {len(own)} {wanted}", ", ".join(named))
    same = [_same_result(registry, sound, row) for path, row in rows.items() if path not in broken]
    print(f"\nothers: {sum(same)} of {len(same)} with the same result as without broken ones", flush=True)


def _same_result(registry: Path, sound: Path, row: dict[str, Any]) -> bool:
    path = Path(row["folder"]) / "result.json"
    return row["status"] == "ok" and (registry / path).read_bytes() == (sound / path).read_bytes()


def large_table(n_rows: int) -> Any:
    """Make a table of results as they are, drawn at random: 2000 robots, dates of five years."""
    import pyarrow as pa

    rng = np.random.default_rng(0)
    n_kinds = 1000
    codes = ("verdict.rotation_uncertain", "verdict.translation_uncertain", "verdict.may_be_off")
    rows = [
        {
            "rig": "rlfs", "camera": "cam", "lidar": "lidar", "program": "lce-rig 0.1.0", "method": "paper",
            "status": "ok" if rng.random() > 0.03 else "failed",
            "verdict": str(rng.choice(["pass", "marginal", "fail"], p=[0.7, 0.25, 0.05])),
            "findings": codes[:n_findings], "severities": ["warning"] * n_findings,
        }
        for n_findings in rng.integers(1, 4, n_kinds).tolist()
    ]  # fmt: skip
    table = as_table([{"robot": "", "folder": "", **row} for row in rows]).take(
        pa.array(rng.integers(0, n_kinds, n_rows))
    )
    robots = rng.integers(0, 2000, n_rows)
    days = np.datetime64("2021-01-01T00:00:00") + rng.integers(0, 5 * 365 * 86400, n_rows)
    dates = np.char.add(days.astype(str), "Z")
    digests = [bytes(each).hex() for each in rng.integers(0, 256, (n_rows, 32), dtype=np.uint8)]
    names = [f"r{robot:04d}" for robot in robots]
    columns: dict[str, Any] = {
        "robot": names,
        "date": dates.tolist(),
        "session_sha256": digests,
        "folder": [f"{r}/{d}-{h[:12]}" for r, d, h in zip(names, dates, digests, strict=True)],
        "source": [f"s3://sessions/{r}/{d}" for r, d in zip(names, dates, strict=True)],
        "lidar_serial": [f"L-{name}" for name in names],
        "camera_serial": [f"C-{name}" for name in names],
    }
    # Robots are mounted with a spread of a centimetre and half a degree; sessions err by a tenth of that.
    mounted = perturb(np.broadcast_to(np.eye(4), (2000, 4, 4)), 0.01 * rng.standard_normal((2000, 6)))
    T = perturb(mounted[robots], 0.001 * rng.standard_normal((n_rows, 6)))
    variances = np.zeros(21)
    variances[[0, 6, 11, 15, 18, 20]] = 1e-6  # the diagonal of a packed upper triangle
    for name, values in (
        ("T_cam_lidar", T.reshape(n_rows, 16)),
        ("cov", np.broadcast_to(variances, (n_rows, 21))),
        ("cov_shared", np.zeros((n_rows, 21))),
    ):
        columns[name] = pa.FixedSizeListArray.from_arrays(pa.array(values.ravel()), values.shape[1])
    for name in ("sigma_rotation_deg", "sigma_translation_m", "mpe_m", "mee_m", "duration_s"):
        columns[name] = rng.random(n_rows)
    for name, values in columns.items():
        index = SCHEMA.get_field_index(name)
        table = table.set_column(index, SCHEMA.field(name), pa.array(values, SCHEMA.field(name).type))
    return in_order(table)


def bench_table(folder: Path) -> None:
    """Write and query a table of a million rows."""
    registry = folder / "registry-large"
    registry.mkdir(parents=True, exist_ok=True)
    if not (registry / TABLE).exists():
        table = large_table(_TABLE_ROWS)
        start_s = time.monotonic()
        (registry / TABLE).write_bytes(table_bytes(table))
        took_s, size = time.monotonic() - start_s, (registry / TABLE).stat().st_size
        print(f"{_TABLE_ROWS} rows: {size / 1e6:.0f} MB, written in {took_s:.1f} s\n")
    print_head("command", "rows", "s", "s of a core", "peak MB")
    at = ("--registry", str(registry))
    for where in (
        "verdict = 'fail' and date > '2025-10-01'",
        "robot = 'r0017'",
        "list_contains(findings, 'verdict.may_be_off') and sigma_rotation_deg > 0.999",
    ):
        words = (
            "table",
            *at,
            "--where",
            where,
            "--json",
            "--columns",
            "robot,date,verdict,sigma_rotation_deg",
        )
        _print_cost(f'`table --where "{where}"`', *words)
    _print_cost("`report`", "report", *at, "--output", str(registry / "report.html"))


def _print_cost(what: str, *words: str) -> None:
    """Run a command of `fleet`; print the rows of its output, its time and memory.

    A process of its own starts it: the memory of this one would count as that of its children.
    """
    command = [sys.executable, "-m", "lce_rig", "fleet", *words]
    measured = (
        "import json, os, subprocess, sys, time\n"
        "start_s = time.monotonic()\n"
        "process = subprocess.Popen(sys.argv[1:], stdout=subprocess.PIPE, text=True)\n"
        "n = max(sum(1 for _ in process.stdout) - 1, 0)\n"
        "_, status, used = os.wait4(process.pid, 0)\n"
        "took_s = time.monotonic() - start_s\n"
        "cpu_s = used.ru_utime + used.ru_stime\n"
        "print(json.dumps([status, n, took_s, cpu_s, used.ru_maxrss / 1024]))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", measured, *command], capture_output=True, text=True, check=True
    )
    status, n, took_s, cpu_s, peak_mb = json.loads(done.stdout)
    if status:
        raise RuntimeError(done.stderr)
    print_row(what, n, f"{took_s:.1f}", f"{cpu_s:.1f}", f"{peak_mb:.0f}")
