"""Parallel work on the cores of this machine (joblib's loky) or on a Dask cluster.

Items are independent and results come back in their order, so neither the number of workers nor the order in which they
finish changes anything.
"""

from __future__ import annotations

import asyncio
import logging
import os
import threading
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, wait
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import islice
from typing import Any, TypeVar

from .errors import InputError

Item = TypeVar("Item")
Outcome = TypeVar("Outcome")

# time limits, s: scheduler's answer, first worker, and return of a worker after all were lost
CONNECT_TIMEOUT_S = 5.0
WORKERS_TIMEOUT_S = 10.0
ALL_WORKERS_LOST_S = 60.0
# items queued per process, so that none waits for the next
HANDED_OUT = 2
# interval in which a worker process checks its parent, s
PARENT_LOOKED_FOR_S = 1.0


@dataclass(frozen=True)
class Workers:
    """Choice of workers. jobs: local processes, 0: one per core. dask: address of a scheduler, '' for none.

    Raises InputError for a negative number.
    """

    jobs: int = 1
    dask: str = ""

    def __post_init__(self) -> None:
        """Check the number of processes."""
        if not isinstance(self.jobs, int) or self.jobs < 0:
            raise InputError(f"jobs: {self.jobs!r} is no number of processes; give 0 for one per core")


@dataclass(frozen=True)
class Lost:
    """Outcome of an item that killed every worker that tried it. why: a sentence."""

    why: str


def run_all(
    work: Callable[[Item], Outcome],
    items: Sequence[Item],
    workers: Workers,
    on_progress: Callable[[float], None] = lambda _: None,
) -> list[Outcome]:
    """Return `work` of every item, in order. on_progress receives the finished share (0..1).

    Exceptions of `work` propagate. Raises InputError for a cluster that does not answer, or workers that died.
    """
    if len(items) == 1 and not workers.dask:
        workers = Workers(jobs=1)
    found: dict[int, Outcome] = {}
    for index, outcome in outcomes_as_done(work, items, workers):
        if isinstance(outcome, Lost):
            if workers.dask:
                raise InputError(f"--dask {workers.dask}: {outcome.why}; restart the cluster")
            raise InputError("a worker process was killed, perhaps for lack of memory; use fewer --jobs")
        found[index] = outcome
        on_progress(len(found) / len(items))
    return [found[index] for index in range(len(items))]


def outcomes_as_done(
    work: Callable[[Item], Outcome], items: Iterable[Item], workers: Workers
) -> Iterator[tuple[int, Outcome | Lost]]:
    """Yield index and `work` of each item as it finishes; `Lost` if the item killed its workers.

    On cores an item is read only when a process is about to be free. Exceptions of `work` propagate. Raises InputError
    for a cluster that does not answer or lost all workers.
    """
    if workers.dask:
        with _quiet_logs():
            yield from _as_done_on_dask(work, items, workers.dask)
    elif workers.jobs == 1:
        for index, item in enumerate(items):
            yield index, work(item)
    else:
        yield from _as_done_on_cores(work, items, workers.jobs or cores())


def cores() -> int:
    """Return the number of cores that this process may use."""
    from joblib import cpu_count

    count: int = cpu_count()
    return count


def _as_done_on_cores(
    work: Callable[[Item], Outcome], items: Iterable[Item], jobs: int
) -> Iterator[tuple[int, Outcome | Lost]]:
    remaining = enumerate(items)
    while suspects := (yield from _until_one_dies(work, remaining, jobs)):
        for suspect in suspects:
            if (yield from _until_one_dies(work, iter([suspect]), 1)):
                yield suspect[0], Lost("the process that worked on it was killed, perhaps for lack of memory")


def _until_one_dies(
    work: Callable[[Item], Outcome], remaining: Iterator[tuple[int, Item]], jobs: int
) -> Generator[tuple[int, Outcome | Lost], None, list[tuple[int, Item]]]:
    """Yield `work` of the items. Return the items in progress when a process died, none if all are done."""
    from joblib.externals.loky.process_executor import BrokenProcessPool, ProcessPoolExecutor

    under_way: dict[Any, tuple[int, Item]] = {}
    broken: list[tuple[int, Item]] = []
    # one thread of linear algebra per process: the matrices are small, and the processes fill the cores
    executor = ProcessPoolExecutor(
        jobs, initializer=_start_worker, initargs=(os.getpid(), work), env=dict.fromkeys(_THREADS, "1")
    )
    try:
        while not broken:
            for item in islice(remaining, HANDED_OUT * jobs - len(under_way)):
                try:
                    under_way[executor.submit(_work_on, item[1])] = item
                except BrokenProcessPool:
                    broken.append(item)
                    break
            if not under_way:
                break
            for future in wait(under_way, return_when=FIRST_COMPLETED).done:
                item = under_way.pop(future)
                try:
                    outcome = future.result()
                except BrokenProcessPool:
                    broken.append(item)
                else:
                    yield item[0], outcome
    finally:
        executor.shutdown(kill_workers=True)
    return [*broken, *under_way.values()]


# the function of a worker process, set once by `_start_worker`
_work: Callable[[Any], Any]


def _start_worker(parent: int, work: Callable[[Any], Any]) -> None:
    global _work
    _work = work
    threading.Thread(target=_end_with_parent, args=(parent,), daemon=True).start()


def _work_on(item: Any) -> Any:
    return _work(item)


def _end_with_parent(parent: int) -> None:
    """End this process when its parent ends; a killed parent cannot tell it to."""
    while os.getppid() == parent:
        time.sleep(PARENT_LOOKED_FOR_S)
    os._exit(1)


_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def _as_done_on_dask(
    work: Callable[[Item], Outcome], items: Iterable[Item], address: str
) -> Iterator[tuple[int, Outcome | Lost]]:
    """Yield outcomes from a Dask cluster as they come. Raises InputError without scheduler or workers."""
    try:
        from distributed import Client
        from distributed.comm.core import CommClosedError
    except ImportError as error:
        raise InputError(f"--dask needs Dask ({error}); pip install 'dvl_calib_ros[dask]'") from error
    try:
        asyncio.run(_greet(address))  # Client's own timeout does not work for an open but silent port
        client = Client(address, timeout=CONNECT_TIMEOUT_S, set_as_default=False)
    except (OSError, TimeoutError, ValueError, RuntimeError) as error:
        raise InputError(f"--dask {address}: no scheduler answers there; start one, or leave --dask out") from error
    with client, client.as_current():
        try:
            client.wait_for_workers(1, timeout=WORKERS_TIMEOUT_S)
        except TimeoutError as error:
            raise InputError(f"--dask {address}: the scheduler has no workers; start workers") from error
        # Dask repeats the work of a dead worker elsewhere, as long as the futures exist
        try:
            yield from _as_done(client, dict(enumerate(client.map(work, list(items), pure=False))), address)
        except ImportError as error:
            raise InputError(
                f"--dask {address}: workers lack something ({error}); install this package there"
            ) from error
        except (CancelledError, CommClosedError) as error:
            raise InputError(f"--dask {address}: the connection to the cluster was lost; restart it") from error


async def _greet(address: str) -> None:
    """Check that a scheduler answers. Raises OSError if none does."""
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
    except Exception as error:  # an unrelated service's bytes can be decoded to anything, even a MemoryError
        raise OSError(f"{type(error).__name__}: {error}") from error


@contextmanager
def _quiet_logs() -> Iterator[None]:
    """Silence Dask, which logs a traceback for each error that it raises."""
    before = logging.root.manager.disable
    logging.disable(logging.ERROR)
    try:
        yield
    finally:
        logging.disable(before)


def _as_done(client: Any, pending: dict[int, Any], address: str) -> Iterator[tuple[int, Any]]:
    """Yield outcomes of futures. Raises InputError after ALL_WORKERS_LOST_S without a worker."""
    from distributed import KilledWorker
    from distributed import wait as wait_for

    while pending:
        with suppress(TimeoutError):
            wait_for(list(pending.values()), timeout=ALL_WORKERS_LOST_S, return_when="FIRST_COMPLETED")
        done = [index for index, future in pending.items() if future.done()]
        if not done and not client.scheduler_info().get("workers"):
            raise InputError(f"--dask {address}: all workers are gone, {len(pending)} pieces not done; start workers")
        for index in done:
            try:
                outcome = pending[index].result(timeout=ALL_WORKERS_LOST_S)
            except KilledWorker:
                outcome = Lost("the workers that worked on it were killed, perhaps for lack of memory")
            except TimeoutError:
                if pending[index].status == "error":
                    raise
                continue  # its worker died before sending the outcome: it is repeated
            del pending[index]
            yield index, outcome
