"""Run many sessions on a Dask cluster, one task each, and keep the registry's table."""

import atexit
import logging
import threading
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, fields
from itertools import islice
from typing import Any

import dask
from distributed import Client, KilledWorker, LocalCluster, as_completed

from lce_rig.core.errors import LceRigError, SourceError
from lce_rig.core.findings import Figure, Finding
from lce_rig.fleet.jobs import Job
from lce_rig.fleet.process import Ended, SessionServer
from lce_rig.fleet.table import Row, Status
from lce_rig.fleet.work import Settings, first_row, publish, without_result, work
from lce_rig.pipeline.detect_session import Progress, silent

# Tasks that wait beside those that run: enough to keep workers busy, few enough for any scheduler.
_WAITING_PER_THREAD, _FEWEST_TASKS = 4, 16
# Sessions cannot end a worker: whoever does, does not mean them.
_MOST_LOST_WORKERS = 100
# The table is written again after so many times the time that it took; what is not in it is in the folders.
_TABLE_SHARE, _TABLE_EVERY_S = 100, 60.0
_local = threading.local()


@dataclass
class FleetRun:
    """What a run did.

    Attributes:
        n_new: sessions that were run.
        n_held: sessions whose results the registry held.
        statuses: how many sessions ended how, held ones included.
        causes: how many sessions have no result, by the code of the cause.
        table: the table, a `pyarrow.Table`.
    """

    n_new: int = 0
    n_held: int = 0
    statuses: Counter[str] = field(default_factory=Counter)
    causes: Counter[str] = field(default_factory=Counter)
    table: Any = None


@contextmanager
def cluster(workers: int, memory_limit_mb: float, scheduler: str | None = None) -> Iterator[Client]:
    """Connect to a scheduler, or start workers on this computer and end them when the block ends.

    Args:
        workers: processes of one thread each; of a running cluster, its own count.
        memory_limit_mb: of each, beside that of its sessions.
        scheduler: address of a running one, tcp://...

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
        "distributed.scheduler.active-memory-manager.start": False,
        # Workers wait for processes: what Dask watches in them, up to a hundred times a second, is of no use.
        "distributed.worker.profile.enabled": False,
        "distributed.admin.tick.interval": "1s",
        "distributed.admin.system-monitor.interval": "2s",
        # Ctrl-C reaches all processes of a terminal; this one ends the workers.
        "distributed.worker.preload": ["import signal\nsignal.signal(signal.SIGINT, signal.SIG_IGN)\n"],
        "distributed.admin.large-graph-warning-threshold": "1GB",
    }
    # Workers that end while their scheduler does are no news.
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    with dask.config.set(settings), warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # another cluster has the usual port of the dashboard
        local = LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            memory_limit=int(memory_limit_mb * 1e6),
            host="127.0.0.1",
            dashboard_address="127.0.0.1:8787",
            silence_logs=logging.CRITICAL,
        )
        with local, Client(local) as client:
            yield client


def run_fleet(
    jobs: Sequence[Job], settings: Settings, client: Client, *, progress: Progress = silent
) -> FleetRun:
    """Run sessions that the registry has no result of, and bring its table in line.

    An interrupt, or the loss of workers, loses nothing that was written: run it again to continue.

    Args:
        jobs: the sessions.
        settings: of the run.
        client: of the Dask cluster.
        progress: called with (done, total) sessions.

    Raises:
        SessionError: the registry cannot be written.
        SourceError: the scheduler is gone.
    """
    registry = settings.opened()
    run, fresh = FleetRun(), _Fresh(registry.consolidate)
    fresh.write()
    waiting = iter(jobs)
    by_key: dict[Any, Job] = {}
    try:
        n_threads = sum(client.nthreads().values()) or 1
        ahead = max(_FEWEST_TASKS, (1 + _WAITING_PER_THREAD) * n_threads)

        def send(job: Job) -> Any:
            future = client.submit(run_job, job, settings, pure=False)
            by_key[future.key] = job
            return future

        futures = as_completed([send(job) for job in islice(waiting, ahead)])
        for done, future in enumerate(futures, 1):
            job = by_key.pop(future.key)
            rows = _rows_of(future, job, settings)
            for following in islice(waiting, 1):
                futures.add(send(following))
            _count(run, rows)
            fresh.add(rows)
            progress(done, len(jobs))
    finally:
        run.table = fresh.write()
    return run


class _Fresh:
    """Rows that the table lacks; they are written from time to time."""

    def __init__(self, consolidate: Callable[..., Any]) -> None:
        self._consolidate = consolidate
        self._rows: list[Mapping[str, Any]] = []
        self._due_s = 0.0

    def add(self, rows: list[dict[str, Any]]) -> None:
        self._rows += rows
        if time.monotonic() > self._due_s:
            self.write()

    def write(self) -> Any:
        start_s = time.monotonic()
        table = self._consolidate(self._rows)
        self._rows = []
        took_s = time.monotonic() - start_s
        self._due_s = time.monotonic() + max(_TABLE_EVERY_S, _TABLE_SHARE * took_s)
        return table


def _count(run: FleetRun, rows: list[dict[str, Any]]) -> None:
    if all(row["is_new"] for row in rows):
        run.n_new += 1
    else:
        run.n_held += 1
    worst = next((row for row in rows if row["status"] != "ok"), rows[0])
    run.statuses[worst["status"]] += 1
    if worst["status"] != "ok":
        run.causes[worst["cause"]] += 1


def _rows_of(future: Any, job: Job, settings: Settings) -> list[dict[str, Any]]:
    """Take a task's rows; of one that no worker survived, write the cause."""
    try:
        rows: list[dict[str, Any]] = future.result()
        return rows
    except KilledWorker:
        cause = Finding("fleet.worker_lost", figures={"n": _MOST_LOST_WORKERS})
        row = without_result(first_row(job, settings), "crashed", cause)
        return publish(settings.opened(), [row], time.monotonic())
    except LceRigError:
        raise
    except OSError as error:
        raise SourceError(f"the cluster cannot be reached: {error}", "Run it again to continue.") from error


def run_job(job: Job, settings: Settings) -> list[dict[str, Any]]:
    """Run one session in a process of its own, on a worker; return its rows.

    Raises:
        SessionError: the registry cannot be written.
    """
    start_s = time.monotonic()
    ended = _own_server().run(
        "lce_rig.fleet.run:run_order",
        {"job": asdict(job), "settings": asdict(settings)},
        settings.time_limit_s,
        settings.memory_limit_mb,
    )
    if ended.rows is not None:
        return ended.rows
    names = {each.name for each in fields(Row)}
    known = {name: value for name, value in ended.known.items() if name in names}
    row = Row(**known) if known else first_row(job, settings)
    return publish(settings.opened(), [without_result(row, *_cause(ended, settings))], start_s, used=ended)


def run_order(
    arguments: Mapping[str, Any], tell: Callable[[Mapping[str, Any]], None]
) -> list[dict[str, Any]]:
    """Run one session in this process, from the JSON values of its job and settings."""
    return work(Job(**arguments["job"]), Settings(**arguments["settings"]), tell)


def _cause(ended: Ended, settings: Settings) -> tuple[Status, Finding]:
    """Say why a session's process ended without rows."""
    if ended.reason == "timed_out":
        return "timed_out", Finding("fleet.timed_out", figures={"limit_s": settings.time_limit_s})
    # What C++ says where it finds no memory.
    if ended.reason == "out_of_memory" or "std::bad_alloc" in ended.detail:
        return "out_of_memory", Finding("fleet.out_of_memory", figures={"limit_mb": settings.memory_limit_mb})
    if ended.reason == "bug":
        return "crashed", Finding("fleet.bug", figures={"what": ended.detail})
    if ended.exit_code < 0:
        figures: dict[str, Figure] = {"signal": -ended.exit_code, "what": ended.detail}
        return "crashed", Finding("fleet.signal", figures=figures)
    return "crashed", Finding("fleet.exited", figures={"code": ended.exit_code, "what": ended.detail})


def _own_server() -> SessionServer:
    """Return the server of this thread; start one where there is none."""
    server: SessionServer | None = getattr(_local, "server", None)
    if server is None or not server.is_alive:
        if server is not None:
            with suppress(OSError):
                server.close()
        server = _local.server = SessionServer()
        atexit.register(server.close)
    return server
