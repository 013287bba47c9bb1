"""Spreads work over workers by joblib: processes on this machine, or a cluster of Ray or Dask."""

from __future__ import annotations

import logging
import os
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import cache, partial
from itertools import islice
from typing import Any, TypeVar

from curation_ros.core.errors import ConfigError, CurationError

#: Ways to spread work: processes on this machine, or a cluster of Ray or Dask.
BACKENDS = ("loky", "ray", "dask")
#: Tasks that are handed out ahead of the results, for each worker.
AHEAD = 2
# Tasks per batch for each Ray worker.
_RAY_AHEAD = 4
# How often a worker checks that the process that started it still runs.
_WATCH_S = 0.5

Result = TypeVar("Result")


class WorkerDiedError(CurationError):
    """A worker was killed or ran out of memory; the results before that are complete."""


def check_workers(jobs: int, backend: str) -> None:
    """Refuse a number or a kind of workers that does not exist.

    Raises:
        ConfigError: naming what was found and what is expected.
    """
    if backend not in BACKENDS:
        raise ConfigError(f"backend {backend!r} is none of {', '.join(BACKENDS)}")
    if jobs == 0 or jobs < -1:
        raise ConfigError(f"jobs {jobs}: expected a number of workers, or -1 for all cores")


def in_flight(jobs: int, backend: str, ray_ahead: int = _RAY_AHEAD) -> int:
    """The most tasks that `spread` has handed out without a result at any time."""
    return ray_ahead * max(jobs, _RAY_AHEAD) if backend == "ray" else AHEAD * jobs


def spread(
    function: Callable[..., Result],
    tasks: Iterable[tuple[Any, ...]],
    *,
    jobs: int = 1,
    backend: str = "loky",
    in_order: bool = True,
    ray_ahead: int = _RAY_AHEAD,
) -> Iterator[Result]:
    """Call a function for every task, and yield the results.

    Memory does not grow with the number of tasks: workers get only a few ahead.

    Args:
        function: goes to the workers with each task; its module must be importable there.
        tasks: its arguments; an iterator runs in this process.
        jobs: workers; 1 works in this process, -1 takes all cores.
        backend: one of BACKENDS, used with several workers.
        in_order: yield results in the order of the tasks; False: as they arrive (Ray keeps the
            order).
        ray_ahead: tasks per batch for each Ray worker, and for at least four workers. Ray's joblib
            backend returns no result before a batch is complete.

    Raises:
        ConfigError: if the backend does not exist or is not installed.
        WorkerDiedError: if a worker died.
    """
    check_workers(jobs, backend)
    if jobs == 1:
        yield from (function(*task) for task in tasks)
        return
    from joblib import Parallel, delayed

    # After an interrupt, the tasks ahead are of no interest.
    warnings.filterwarnings("ignore", "[0-9]+ tasks ", UserWarning)
    # loky replaces a worker that has grown by 100 MB, as simulators and torch do. A worker that
    # died is a WorkerDiedError.
    warnings.filterwarnings("ignore", "A worker stopped while some jobs ", UserWarning)
    with workers(backend, jobs), _deaths():
        if backend == "ray":
            parallel = Parallel(n_jobs=jobs)
            ahead = iter(tasks)
            while window := list(islice(ahead, in_flight(jobs, backend, ray_ahead))):
                yield from parallel(delayed(function)(*task) for task in window)
        else:
            kind = "generator" if in_order else "generator_unordered"
            parallel = Parallel(n_jobs=jobs, return_as=kind, pre_dispatch=f"{AHEAD} * n_jobs")
            call = delayed(partial(_with_parent, function) if backend == "loky" else function)
            yield from parallel(call(*task) for task in tasks)


def _with_parent(function: Callable[..., Result], *task: Any) -> Result:
    """Call a function in a worker that must not outlive the process that started it."""
    _watch_parent()
    return function(*task)


@cache
def _watch_parent() -> None:
    """Once per process: end it when its parent is gone. A killed parent cannot end its workers."""
    parent = os.getppid()

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(_WATCH_S)
        os._exit(1)

    threading.Thread(target=watch, name="watch-parent", daemon=True).start()


@contextmanager
def _deaths() -> Iterator[None]:
    """Turn the errors of the backends for a worker that died into one of ours."""
    from joblib.externals.loky.process_executor import TerminatedWorkerError

    deaths: list[type[BaseException]] = [TerminatedWorkerError]
    if ray := sys.modules.get("ray"):
        deaths.append(ray.exceptions.WorkerCrashedError)
        deaths.append(ray.exceptions.RayActorError)
    if distributed := sys.modules.get("distributed"):
        deaths.append(distributed.KilledWorker)
    try:
        yield
    except tuple(deaths) as err:
        raise WorkerDiedError("a worker died (killed, or out of memory)") from err


@contextmanager
def workers(backend: str, jobs: int) -> Iterator[None]:
    """Make joblib use a kind of workers.

    RAY_ADDRESS and DASK_SCHEDULER_ADDRESS name a cluster. If they are not set, one is started on
    this machine and stopped at the end.

    Raises:
        ConfigError: if the backend is not installed.
    """
    from joblib import parallel_config

    try:
        make = {"loky": _loky, "ray": _ray, "dask": _dask}[backend]
        with make(jobs), parallel_config(backend=backend, n_jobs=jobs):
            yield
    except ModuleNotFoundError as err:
        raise ConfigError(
            f"backend {backend!r} needs {err.name}: pip install 'curation_ros[{backend}]'"
        ) from err


@contextmanager
def _loky(jobs: int) -> Iterator[None]:
    from joblib import Parallel, delayed, effective_n_jobs

    # Ctrl-C goes to all processes of a terminal, but this process ends the workers, and none of
    # them may print a traceback. A signal that is blocked when they start stays blocked in them.
    # Here it is only delayed.
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        Parallel(n_jobs=jobs, backend="loky")(
            delayed(int)() for _ in range(effective_n_jobs(jobs))
        )
    finally:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    yield


@contextmanager
def _ray(jobs: int) -> Iterator[None]:
    import ray
    from ray.util.joblib import register_ray

    logging.getLogger("ray").setLevel(logging.ERROR)
    cores = None if jobs < 0 or "RAY_ADDRESS" in os.environ else jobs
    ray.init(num_cpus=cores, include_dashboard=False, log_to_driver=False)
    try:
        register_ray()  # type: ignore[no-untyped-call]
        yield
    finally:
        ray.shutdown()


@contextmanager
def _dask(jobs: int) -> Iterator[None]:
    from dask.distributed import Client

    address = os.environ.get("DASK_SCHEDULER_ADDRESS")
    started = {} if address else {"n_workers": None if jobs < 0 else jobs, "threads_per_worker": 1}
    with Client(address, dashboard_address=None, **started):  # type: ignore[no-untyped-call, unused-ignore]
        yield
