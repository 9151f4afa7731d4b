"""Run many sessions on a Dask cluster, one task each, and update the registry's table."""

import logging
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from typing import Any

import dask
from distributed import Client, KilledWorker, LocalCluster, as_completed

from lce_rig.core.errors import LceRigError, SourceError
from lce_rig.core.progress import Progress, silent
from lce_rig.fleet.findings import WORKER_LOST
from lce_rig.fleet.jobs import Job
from lce_rig.fleet.registry import Row
from lce_rig.fleet.work import Settings, first_row, publish, run_apart, without_result

# A session cannot kill its worker; a worker that died was killed from outside.
_MOST_LOST_WORKERS = 100
# Interval between writes of the table: 100 times the last write's duration, at least 60 s. Results that are
# not in the table yet are in the folders.
_TABLE_SHARE, _TABLE_EVERY_S = 100, 60.0


@dataclass
class FleetRun:
    """The outcome of a run.

    Attributes:
        n_new: sessions that were run.
        n_held: sessions whose results the registry held.
        statuses: number of sessions by status, held ones included.
        causes: number of sessions without a result, by the code of the cause.
        table: the table, a `pyarrow.Table`.
    """

    n_new: int = 0
    n_held: int = 0
    statuses: Counter[str] = field(default_factory=Counter)
    causes: Counter[str] = field(default_factory=Counter)
    table: Any = None

    def count(self, rows: Sequence[Row]) -> None:
        """Count a session by its rows."""
        if all(row["is_new"] for row in rows):
            self.n_new += 1
        else:
            self.n_held += 1
        worst = next((row for row in rows if row["status"] != "ok"), rows[0])
        self.statuses[worst["status"]] += 1
        if worst["status"] != "ok":
            self.causes[worst["cause"]] += 1


@contextmanager
def cluster(workers: int, memory_limit_mb: float, scheduler: str | None = None) -> Iterator[Client]:
    """Connect to a scheduler, or start local workers and end them when the block ends.

    Args:
        workers: processes of one thread each; of a running cluster, its own count.
        memory_limit_mb: memory limit of each worker, besides that of its sessions.
        scheduler: address of a running scheduler, tcp://...

    Raises:
        SourceError: the scheduler does not answer.
    """
    if scheduler is not None:
        try:
            client = Client(scheduler, timeout="20s")
        except (OSError, ValueError) as error:
            raise SourceError(
                f"no scheduler answers at {scheduler}", "Start one: `dask scheduler`, then `dask worker`."
            ) from error
        with client:
            yield client
        return
    settings = {
        "distributed.scheduler.allowed-failures": _MOST_LOST_WORKERS,
        "distributed.scheduler.worker-saturation": 1.0,
        # Workers only wait for processes, so Dask's profiling of them, up to 100 times a second, is useless.
        "distributed.worker.profile.enabled": False,
        "distributed.admin.tick.interval": "1s",
        "distributed.admin.system-monitor.interval": "2s",
        # Ctrl-C reaches all processes of a terminal; this one ends the workers.
        "distributed.worker.preload": ["import signal\nsignal.signal(signal.SIGINT, signal.SIG_IGN)\n"],
    }
    # Do not log workers that end together with their scheduler.
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    with dask.config.set(settings):
        local = LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            memory_limit=int(memory_limit_mb * 1e6),
            host="127.0.0.1",
            dashboard_address="127.0.0.1:0",  # a free port: another fleet may run on this computer
            silence_logs=logging.CRITICAL,
        )
        with local, Client(local) as client:
            yield client


def run_fleet(
    jobs: Sequence[Job], settings: Settings, client: Client, *, progress: Progress = silent
) -> FleetRun:
    """Run the sessions without a result in the registry, and update its table.

    Results are kept after an interrupt or the loss of workers: run it again to continue.

    Args:
        jobs: the sessions.
        settings: settings of the run.
        client: client of the Dask cluster.
        progress: called with (done, total) sessions.

    Raises:
        SessionError: the registry cannot be written.
        SourceError: the scheduler is gone.
    """
    registry, run = settings.opened(), FleetRun()
    fresh: list[Row] = []
    run.table, due_s = registry.consolidate(), 0.0
    try:
        futures = client.map(run_job, jobs, settings=settings, pure=False)
        job_by_key = {future.key: job for future, job in zip(futures, jobs, strict=True)}
        for done, future in enumerate(as_completed(futures), 1):
            rows = _rows_of(future, job_by_key[future.key], settings)
            run.count(rows)
            fresh += rows
            if time.monotonic() > due_s:
                start_s = time.monotonic()
                run.table, fresh = registry.consolidate(fresh), []
                end_s = time.monotonic()
                due_s = end_s + max(_TABLE_EVERY_S, _TABLE_SHARE * (end_s - start_s))
            progress(done, len(jobs))
    finally:
        run.table = registry.consolidate(fresh)
    return run


def _rows_of(future: Any, job: Job, settings: Settings) -> list[Row]:
    """Return a task's rows; if all its workers died, a row with the cause."""
    try:
        rows: list[Row] = future.result()
        return rows
    except KilledWorker:
        row = without_result(first_row(job, settings), "crashed", WORKER_LOST(n=_MOST_LOST_WORKERS))
        return publish(settings.opened(), [row], time.monotonic())
    except LceRigError:
        raise
    except OSError as error:
        raise SourceError(f"the cluster cannot be reached: {error}", "Run it again to continue.") from error


def run_job(job: Job, settings: Settings) -> list[Row]:
    """Run one session in a separate process on a worker; return its rows.

    Raises:
        SessionError: the registry cannot be written.
    """
    start_s = time.monotonic()
    order = {"job": asdict(job), "settings": asdict(settings)}
    limits = (settings.time_limit_s, settings.memory_limit_mb)
    ended = run_apart("lce_rig.fleet.work:work_order", order, *limits)
    if ended.rows is not None or ended.cause is None:
        return ended.rows or []
    row = without_result(ended.known or first_row(job, settings), ended.status, ended.cause)
    return publish(settings.opened(), [row], start_s)
