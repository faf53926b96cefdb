"""Bags processed on a cluster, by Dask distributed. Its workers see the bags under the same paths."""

import os
import sys
from collections.abc import Iterator, Sequence
from importlib import import_module
from typing import Any

from knee_gap_core.bag.errors import BagError
from knee_gap_core.node.errors import ConfigurationError
from knee_gap_replay.whole_bags.one_bag import Job
from knee_gap_replay.whole_bags.pools import Ended, outcome

_CONNECT_SECONDS = 10
# How long it is waited for bags before the size of the cluster is looked at again [s].
_LOOK_SECONDS = 1.0


class ClusterPool:
    """A task for each bag, so many at once as the cluster's workers have threads. A `Pool`.

    Raises ConfigurationError if Dask is not installed, and BagError if no scheduler answers or has no worker.
    """

    def __init__(self, address: str) -> None:
        self._distributed = _distributed()
        try:
            self._client = self._distributed.Client(address, timeout=_CONNECT_SECONDS)
        except (OSError, ValueError, TypeError, ImportError) as error:
            reason = " ".join(str(error).split()) or type(error).__name__
            raise BagError(f"the scheduler {address} cannot be reached: {reason}") from None
        self._running: dict[Any, str] = {}
        if not self._threads():
            self._client.close()
            raise BagError(
                f"the scheduler {address} has no worker; start one: tools/env dask worker {address}"
            )

    @property
    def size(self) -> int:
        """Number of threads of all workers; 1 while there are none."""
        return max(self._threads(), 1)

    def start(self, bag: str, job: Job) -> None:
        """Process a bag on a worker."""
        job = job._replace(bag=os.path.abspath(job.bag), out=os.path.abspath(job.out))
        if job.params_file is not None:
            job = job._replace(params_file=os.path.abspath(job.params_file))
        # Not again by itself: what a bag wrote before its worker died is replaced by the next run only.
        self._running[self._client.submit(outcome, bag, job, pure=False, retries=0)] = bag

    def ended(self) -> Sequence[Ended]:
        """Return those that have ended, after waiting for one or for a moment."""
        try:
            done, _ = self._distributed.wait(
                list(self._running), timeout=_LOOK_SECONDS, return_when="FIRST_COMPLETED"
            )
        except TimeoutError:
            done = [future for future in self._running if future.done()]
        return [self._result(future) for future in done]

    def close(self) -> Iterator[Ended]:
        """Wait for the bags that were begun, which nobody can stop; interrupted again, leave them."""
        if self._running:
            words = f"{len(self._running)} bags are being processed on the cluster; waiting for them"
            print(f"process: {words}", file=sys.stderr, flush=True)
        try:
            while self._running:
                yield from self.ended()
        finally:
            self._client.close()

    def _result(self, future: Any) -> Ended:
        bag = self._running.pop(future)
        try:
            ended = future.result()
        except Exception as error:  # whatever the task raised, or an error of Dask's for a worker that died
            reason = " ".join(str(error).split()) or type(error).__name__
            return Ended(bag, "failed", f"on the cluster: {reason}", {})
        assert isinstance(ended, Ended)
        return ended

    def _threads(self) -> int:
        return sum(self._client.nthreads().values())


def _distributed() -> Any:
    """The library, which is not installed by the set-up."""
    try:
        return import_module("distributed")
    except ImportError:
        raise ConfigurationError(
            "--scheduler needs Dask distributed, here and on the workers: "
            "tools/env uv pip install --require-hashes -r tools/requirements/cluster.lock"
        ) from None
