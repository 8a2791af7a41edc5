"""Clips onto the workers of a Dask cluster, whatever happens to the workers.

https://distributed.dask.org/en/stable/killed.html: a task whose worker dies is given to another one, until
more than ``allowed-failures`` workers died under it (KilledWorker); a worker is replaced by its nanny.
"""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from queue import Empty, Queue
from typing import TYPE_CHECKING, Any, TypeVar

from mvdyn_gtsam.batch.clips import BatchError, Clip
from mvdyn_gtsam.batch.job import ClipKilledError, one_line
from mvdyn_gtsam.batch.report import Row, State

if TYPE_CHECKING:
    from distributed import Client, Future

CONNECT_S = 10.0
FIRST_WORKER_S = 60.0
TICK_S = 2.0
"""How often the cluster is asked whether it has workers left."""
STOP_S = 15.0
"""How long clips that were told to stop are waited for; more than their guard gives them."""

_IGNORE_INTERRUPT = "import signal\nsignal.signal(signal.SIGINT, signal.SIG_IGN)\n"
"""Ctrl-C reaches every process of the terminal; the one that runs the batch ends the others in order."""

logger = logging.getLogger(__name__)

Started = TypeVar("Started")


def require_dask() -> None:
    """Raise BatchError unless Dask distributed is installed."""
    try:
        import distributed  # noqa: F401
    except ImportError as error:
        raise BatchError("batch needs Dask distributed: pip install 'mvdyn_gtsam[batch]'") from error


@contextmanager
def _quiet() -> Iterator[None]:
    """Dask tells of its inner workings; what matters of them is a row or a line of ours."""
    dask_logger = logging.getLogger("distributed")
    level = dask_logger.level
    dask_logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        dask_logger.setLevel(level)


def _begun(begin: Callable[[], Started]) -> Started:
    """What ``begin`` returns, at the second try if need be.

    Dask gives a thread of its own ten seconds to start and asserts that it did (``LoopRunner`` of
    distributed/utils.py); a machine that is busy or was asleep misses that. Raises BatchError when it does
    twice.
    """
    with suppress(AssertionError):
        return begin()
    try:
        return begin()
    except AssertionError as error:
        raise BatchError(
            "Dask twice could not start a thread within ten seconds: the machine is too busy; try again later"
        ) from error


@contextmanager
def local_cluster(workers: int, retries: int) -> Iterator[Client]:
    """Processes on this machine; one that dies is replaced, and its clip run again ``retries`` times."""
    import dask
    from distributed import Client, LocalCluster

    with (
        _quiet(),
        dask.config.set({"distributed.scheduler.allowed-failures": retries}),
        _begun(
            lambda: LocalCluster(
                n_workers=workers,
                threads_per_worker=1,
                processes=True,
                # What needs memory is not the worker but its child.
                memory_limit=0,
                # Any free port: 8787 may be taken, which would be warned of.
                dashboard_address=":0",
                silence_logs=logging.CRITICAL,
                preload=_IGNORE_INTERRUPT,
            )
        ) as cluster,
        Client(cluster) as client,
    ):
        yield client


@contextmanager
def remote_cluster(address: str) -> Iterator[Client]:
    """A running scheduler and its workers. Raises BatchError where there is none, or no worker."""
    from distributed import Client

    with ExitStack() as stack:
        stack.enter_context(_quiet())
        try:
            client = stack.enter_context(_begun(lambda: Client(address, timeout=CONNECT_S)))
        except (OSError, ValueError) as error:
            raise BatchError(
                f"{address}: no Dask scheduler answers there; start one: dask scheduler"
            ) from error
        try:
            client.wait_for_workers(1, timeout=FIRST_WORKER_S)
        except TimeoutError as error:
            raise BatchError(
                f"{address}: the scheduler has no workers; start some: dask worker {address}"
            ) from error
        yield client


def run_clips(
    client: Client,
    clips: Sequence[Clip],
    job: Callable[[Clip], Row],
    *,
    retries: int,
    on_row: Callable[[Row], None],
    stop: Callable[[], None],
) -> None:
    """Do ``job`` with every clip and hand each row to ``on_row`` as it comes.

    An exception of ``job`` is tried again ``retries`` times and then becomes a failed row. When interrupted,
    ``stop`` must make running jobs return soon; they are waited for. Raises BatchError when the scheduler is
    lost.
    """
    waiting, running = deque(clips), dict[Any, Clip]()
    finished: Queue[Any] = Queue()
    slots, warned = 1, False
    try:
        while waiting or running:
            threads = _threads(client)
            slots = max(slots, threads)
            # No more than the workers can begin: a clip in a dying worker's queue would be blamed, too.
            while waiting and len(running) < slots:
                clip = waiting.popleft()
                future = client.submit(job, clip, pure=False, retries=retries)
                running[future] = clip
                future.add_done_callback(finished.put)
            if not threads and not warned:
                logger.warning("the cluster has no workers left; it goes on when there are some again")
            warned = not threads
            with suppress(Empty):
                future = finished.get(timeout=TICK_S)
                on_row(_row(future, running.pop(future)))
    except BaseException:
        stop()
        _wait_for(finished, len(running))
        raise


def _threads(client: Client) -> int:
    """How many clips the cluster can run at once."""
    try:
        return sum(client.nthreads().values())
    except OSError as error:
        raise _lost() from error


def _wait_for(finished: Queue[Any], count: int) -> None:
    """Until jobs that were told to stop have returned, so that nothing is written after us."""
    end = time.monotonic() + STOP_S
    try:
        for _ in range(count):
            finished.get(timeout=max(0.0, end - time.monotonic()))
    except Empty:
        logger.warning("some clips have not stopped yet; they end with their workers")


def _lost() -> BatchError:
    return BatchError("the Dask scheduler was lost; what is finished is kept: give the same command again")


def _row(future: Future[Row], clip: Clip) -> Row:
    from distributed import KilledWorker

    if future.status in ("cancelled", "lost"):
        raise _lost()
    error = future.exception() if future.status == "error" else None
    if error is None:
        return future.result()
    if isinstance(error, KilledWorker):
        times = error.allowed_failures + 1
        problem = f"its worker died {times} times, for want of memory perhaps; try fewer --workers"
    elif isinstance(error, ClipKilledError):
        problem = f"{one_line(error).removeprefix('ClipKilledError: ')}; perhaps for want of memory"
    else:
        problem = one_line(error)
    return Row(clip.name, State.FAILED, problem=problem)
