"""The same work on the cores of this machine (joblib) or on a Dask cluster.

Items are independent and results come back in the order of the items, so that neither the number of workers nor the
order in which they finish changes anything.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any, TypeVar

from .errors import InputError

Item = TypeVar("Item")
Outcome = TypeVar("Outcome")

# A scheduler that has not answered, or has no worker, after this long will not; nor will one come back
CONNECT_TIMEOUT_S = 5.0
WORKERS_TIMEOUT_S = 10.0
ALL_WORKERS_LOST_S = 60.0


@dataclass(frozen=True)
class Workers:
    """Where to work. jobs: processes on this machine, 0: one per core. dask: address of a scheduler, '' for none."""

    jobs: int = 1
    dask: str = ""


def run_all(
    work: Callable[[Item], Outcome],
    items: Sequence[Item],
    workers: Workers,
    on_progress: Callable[[float], None] = lambda _: None,
) -> list[Outcome]:
    """`work` of every item, in order; on_progress is told the share (0..1) that is done.

    Exceptions of `work` go through. Raises InputError for a cluster that does not answer, or workers that died.
    """
    if workers.dask:
        with _quiet_logs():
            return _on_dask(work, items, workers.dask, on_progress)
    if workers.jobs == 1 or len(items) == 1:
        outcomes = []
        for done, item in enumerate(items, start=1):
            outcomes.append(work(item))
            on_progress(done / len(items))
        return outcomes
    return _on_cores(work, items, workers.jobs, on_progress)


def _on_cores(
    work: Callable[[Item], Outcome], items: Sequence[Item], jobs: int, on_progress: Callable[[float], None]
) -> list[Outcome]:
    outcomes = []
    for done in outcomes_on_cores(work, items, jobs):
        outcomes.append(done)
        on_progress(len(outcomes) / len(items))
    return outcomes


def outcomes_on_cores(work: Callable[[Item], Outcome], items: Iterable[Item], jobs: int) -> Iterator[Outcome]:
    """`work` of every item in order, each as soon as it and those before it are done. jobs: processes, 0: one per core.

    Exceptions of `work` go through. Raises InputError for a worker that died.
    """
    from joblib import Parallel, delayed, parallel_config
    from joblib.externals.loky.process_executor import TerminatedWorkerError

    try:
        # one thread of linear algebra per worker: the matrices are tiny, and the workers fill the cores
        with parallel_config(backend="loky", inner_max_num_threads=1):
            yield from Parallel(n_jobs=jobs or -1, return_as="generator")(delayed(work)(item) for item in items)
    except TerminatedWorkerError as error:
        raise InputError("a worker process was killed, perhaps for want of memory; use fewer --jobs") from error


def _on_dask(
    work: Callable[[Item], Outcome], items: Sequence[Item], address: str, on_progress: Callable[[float], None]
) -> list[Outcome]:
    try:
        from distributed import Client, KilledWorker
        from distributed.comm.core import CommClosedError
    except ImportError as error:
        raise InputError(f"--dask needs Dask ({error}); pip install 'dvl_calib_ros[dask]'") from error
    try:
        asyncio.run(_greet(address))  # Client's own timeout does not hold where a port is open and silent
        client = Client(address, timeout=CONNECT_TIMEOUT_S, set_as_default=False)
    except (OSError, TimeoutError, ValueError, RuntimeError) as error:
        raise InputError(f"--dask {address}: no scheduler answers there; start one, or leave --dask out") from error
    with client, client.as_current():
        try:
            client.wait_for_workers(1, timeout=WORKERS_TIMEOUT_S)
        except TimeoutError as error:
            raise InputError(f"--dask {address}: the scheduler has no workers; start some") from error
        # Dask runs what a dead worker had done or was doing again elsewhere, as long as somebody holds the futures
        futures = client.map(work, items, pure=False)
        try:
            _wait(client, futures, address, on_progress)
            outcomes: list[Outcome] = client.gather(futures)
        except ImportError as error:
            raise InputError(
                f"--dask {address}: workers lack something ({error}); install this package there"
            ) from error
        except (CancelledError, CommClosedError, KilledWorker) as error:
            raise InputError(f"--dask {address}: the cluster was lost on the way; start it anew") from error
        return outcomes


async def _greet(address: str) -> None:
    """See that a scheduler answers. Raises OSError if none does."""
    from distributed.comm.core import connect
    from distributed.security import Security

    async def greet() -> None:
        comm = await connect(address, **Security().get_connection_args("client"))
        try:
            await comm.write({"op": "identity", "reply": True})
            await comm.read()
        finally:
            comm.abort()

    try:
        await asyncio.wait_for(greet(), CONNECT_TIMEOUT_S)
    except Exception as error:  # what another service says is read as anything, MemoryError among it
        raise OSError(f"{type(error).__name__}: {error}") from error


@contextmanager
def _quiet_logs() -> Iterator[None]:
    """Dask logs what it raises as well, with tracebacks."""
    before = logging.root.manager.disable
    logging.disable(logging.ERROR)
    try:
        yield
    finally:
        logging.disable(before)


def _wait(client: Any, futures: Sequence[Any], address: str, on_progress: Callable[[float], None]) -> None:
    """Wait for all futures. Raises InputError once there has been no worker for ALL_WORKERS_LOST_S."""
    from distributed import wait

    pending = list(futures)
    while pending:
        with suppress(TimeoutError):
            wait(pending, timeout=ALL_WORKERS_LOST_S, return_when="FIRST_COMPLETED")
        left = [future for future in pending if not future.done()]
        if len(left) == len(pending) and not client.scheduler_info().get("workers"):
            raise InputError(f"--dask {address}: all workers are gone, {len(left)} pieces not done; start some")
        pending = left
        on_progress(1.0 - len(pending) / len(futures))
