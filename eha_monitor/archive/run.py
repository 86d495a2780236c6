"""Many bags at a time: processes of this machine, or the workers of a Dask cluster.

Both ways take a function that can be imported and one argument for each bag, and yield (argument,
answer, error); a worker that dies costs the bag that it had, and no other.
"""

import multiprocessing
import multiprocessing.connection
import os
import signal
import socket
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from typing import Any

from eha_monitor.errors import InputError, optional

DIED = "the process that read it was killed (by the system, out of memory?)"
PATIENCE = 5.0  # s in which a scheduler must answer
Answers = Iterator[tuple[Any, Any, str]]


def on_this_machine(function: Callable, arguments: Sequence, jobs: int, alone: int = 0,
                    apart: bool = True) -> Answers:
    """Answer in ``jobs`` processes.

    So many as ``alone`` go first, one by one: they compile for all.  ``apart`` : whether each
    process keeps to its share of the cores.
    """
    todo = list(arguments)
    suspects: list = []
    for batch, most in ((todo[:alone], 1), (todo[alone:], jobs)):
        for argument, answer, error in _pool(function, batch, most, apart):
            if error:
                suspects.append(argument)  # of those that ran together, one died
            else:
                yield argument, answer, ""
    for argument in suspects:
        yield from _pool(function, [argument], 1, apart)


def _pool(function: Callable, arguments: list, jobs: int, apart: bool) -> Answers:
    """Answer in one pool after the other: one that broke leaves what it had in work."""
    todo = list(reversed(arguments))
    while todo:
        size = min(jobs, len(todo))
        before = set(multiprocessing.active_children())
        context = multiprocessing.get_context("spawn")
        shares = context.SimpleQueue()
        cores = sorted(os.sched_getaffinity(0))
        for i in range(size):
            share = cores[i::size] or [cores[i % len(cores)]]
            shares.put(share if apart else cores)
        pool = ProcessPoolExecutor(size, context, _settle, (shares,))
        running: dict[Future, Any] = {}
        broken = False
        try:
            while (todo and not broken) or running:
                # No more than can run: what is under way when a pool breaks is then known.
                while todo and not broken and len(running) < size:
                    argument = todo.pop()
                    try:
                        running[pool.submit(function, argument)] = argument
                    except BrokenProcessPool:
                        todo.append(argument)
                        broken = True
                for future in wait(running, return_when=FIRST_COMPLETED).done:
                    argument = running.pop(future)
                    try:
                        answer = future.result()
                    except BrokenProcessPool:
                        broken = True
                        yield argument, None, DIED
                        continue
                    yield argument, answer, ""
            pool.shutdown()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for child in set(multiprocessing.active_children()) - before:
                child.terminate()
            raise


def _settle(shares) -> None:
    """Prepare a process of the pool: Ctrl-C is for its parent, and its cores are its own."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    os.sched_setaffinity(0, shares.get())
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """End this process when its parent has been killed: it would wait for ever for a bag."""
    multiprocessing.connection.wait([multiprocessing.parent_process().sentinel])
    os._exit(1)


class Cluster:
    """An existing Dask cluster; a context that ends the connection.

    Raises InputError if there is no ``distributed``, no scheduler at the address, or no worker.
    """

    def __init__(self, address: str):
        self.address = address
        with optional("--scheduler needs distributed, which cannot be imported ({}); ", "dask"):
            import distributed
        import logging

        # It tells of a lost connection in many lines; we do in one.
        logging.getLogger("distributed").setLevel(logging.CRITICAL)
        try:
            # A client that fails waits for seconds, and complains of itself as it is deleted.
            place = distributed.comm.get_address_host_port(address)
            socket.create_connection(place, PATIENCE).close()
            self.client = distributed.Client(address, timeout=PATIENCE, set_as_default=False)
        except (OSError, ValueError, TypeError) as problem:  # TimeoutError is an OSError
            reason = " ".join(str(problem).split())[:150]
            raise InputError(f"--scheduler {address}: no Dask scheduler answers there, expected "
                             f"an address such as tcp://host:8786 ({reason})") from problem
        try:
            self.client.wait_for_workers(1, timeout=PATIENCE)
        except OSError as problem:
            self.client.close()
            raise InputError(f"--scheduler {address}: the cluster has no workers") from problem

    def __enter__(self) -> "Cluster":
        return self

    def __exit__(self, *exception) -> None:
        self.close()

    def close(self) -> None:
        """End the connection; the cluster goes on."""
        self.client.close()

    def check(self, function: Callable, expected: Any, words: str) -> None:
        """Ask every worker; refuse a cluster of which one answers otherwise than expected."""
        try:
            found = self.client.run(function)
        except (ImportError, AttributeError) as problem:
            raise InputError(f"--scheduler {self.address}: a worker cannot import eha_monitor "
                             f"as it is here ({problem}); install it there") from problem
        except OSError as problem:
            raise InputError(f"--scheduler {self.address}: lost the cluster "
                             f"({problem})") from problem
        for worker, answer in found.items():
            if answer != expected:
                raise InputError(f"--scheduler {self.address}: worker {worker} has another "
                                 f"{words} ({answer}), expected {expected}")

    def answers(self, function: Callable, arguments: Sequence) -> Answers:
        """Answer on the cluster, in whatever order it does."""
        from distributed import as_completed

        futures = {self.client.submit(function, argument, pure=False): argument
                   for argument in arguments}
        try:
            for future in as_completed(futures, loop=self.client.loop):
                if future.status == "finished":
                    yield futures[future], future.result(), ""
                elif future.status == "error":
                    problem = future.exception()
                    reason = " ".join(str(problem).split())[:300]
                    yield futures[future], None, f"{type(problem).__name__}: {reason}"
                else:
                    raise InputError(f"--scheduler {self.address}: lost the cluster; finished "
                                     "results are kept, start again to resume")
                future.release()
        finally:
            if self.client.status == "running":
                self.client.cancel([one for one in futures if one.status == "pending"])
