"""Workers of a Dask cluster that runs already."""

from __future__ import annotations

import logging
import platform
import socket
import time
import warnings
from concurrent.futures import CancelledError
from contextlib import contextmanager
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

from analysis.campaigns.errors import CampaignError
from analysis.campaigns.workers import Lost, unheard

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from analysis.campaigns.workers import Result

_CONNECT_S: Final = 5.0
_WORKERS_S: Final = 10.0
_LOOK_S: Final = 2.0
_GONE_S: Final = 30.0
"""How long a cluster may be without any worker: its nannies start them anew in seconds."""


@contextmanager
def dask_cluster(address: str) -> Iterator[DaskWorkers]:
    """Workers of a Dask cluster.

    They need this package, of the same version, and the session files under the same paths.

    Parameters
    ----------
    address : str
        Of its scheduler, such as ``tcp://10.0.0.5:8786``.

    Raises
    ------
    CampaignError
        Dask is not installed, nobody answers at the address, the cluster has no workers, or they
        are not of these versions.
    """
    try:
        distributed = _distributed()
    except ImportError as error:
        raise CampaignError(
            "--dask needs the optional packages: pip install 'rigd[dask]'."
        ) from error
    with _quiet():
        try:
            _knock(address)
            client = distributed.Client(address, timeout=_CONNECT_S, set_as_default=False)
        except (OSError, ValueError) as error:
            raise CampaignError(
                f"No Dask scheduler answers at {address} within {_CONNECT_S:g} s; start one with "
                "'dask scheduler' and its workers with 'dask worker ADDRESS', or leave --dask out."
            ) from error
        try:
            _check_workers(client, address)
            with client.as_current():
                yield DaskWorkers(client, address)
        finally:
            client.close()


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep from Dask what is told here in a sentence: what goes wrong, and versions that differ."""
    log = logging.getLogger("distributed.client")
    level = log.level
    log.setLevel(logging.CRITICAL)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="(?s).*Mismatched versions")
            yield
    finally:
        log.setLevel(level)


def _knock(address: str) -> None:
    """Raise an OSError if nobody listens; Dask's client would go on trying after it has failed."""
    name = address.rsplit("://", maxsplit=1)[-1]
    if "://" in address and not address.startswith(("tcp://", "tls://")):
        return
    host, _, port = name.rpartition(":")
    if not (host and port.isdecimal()):
        raise ValueError("no host and port")
    socket.create_connection((host.strip("[]"), int(port)), _CONNECT_S).close()


class DaskWorkers:
    """See `analysis.campaigns.workers.Workers`."""

    def __init__(self, client: Any, address: str) -> None:  # noqa: ANN401 - Dask has no types
        self._client, self._address = client, address

    def run(
        self,
        function: Callable[..., Result],
        arguments: Sequence[tuple[Any, ...]],
        on_done: Callable[[int], None] = unheard,
    ) -> list[Result | Lost]:
        """See `analysis.campaigns.workers.Workers.run`.

        The scheduler gives a task whose worker ended to another one, and gives it up when it has
        lost several so; with it those that happened to wait at the same workers. So what it gives
        up is tried once more, each task by itself.
        """
        results: dict[int, Result | Lost] = {}

        def done(number: int, result: Result) -> None:
            results[number] = result
            on_done(number)

        for number in self._round(function, dict(enumerate(arguments)), done):
            if self._round(function, {number: arguments[number]}, done):
                results[number] = Lost(
                    "every Dask worker that had it ended by itself: most often for lack of memory; "
                    "see the workers' logs"
                )
                on_done(number)
        return [results[number] for number in range(len(arguments))]

    def _round(
        self,
        function: Callable[..., Result],
        arguments: Mapping[int, tuple[Any, ...]],
        done: Callable[[int, Result], None],
    ) -> list[int]:
        """Run tasks and tell what they return; return the numbers of those that were given up."""
        # Each call counts, though arguments may be the same.
        with self._there():
            futures = {
                self._client.submit(function, *each, pure=False): i for i, each in arguments.items()
            }
        given_up = []
        seen = time.monotonic()
        while futures:
            finished, seen = self._finished(list(futures), seen)
            for future in finished:
                number = futures.pop(future)
                try:
                    with self._there():
                        result = future.result()
                except _distributed().KilledWorker:
                    given_up.append(number)
                else:
                    done(number, result)
        return given_up

    def _finished(self, futures: Sequence[Any], seen: float) -> tuple[set[Any], float]:
        """Wait for some, but not for long; return them, and when workers were last seen."""
        with self._there():
            try:
                done = _distributed().wait(futures, _LOOK_S, return_when="FIRST_COMPLETED").done
            except TimeoutError:
                done = set()
            return done, self._still_there(seen)

    @contextmanager
    def _there(self) -> Iterator[None]:
        """Tell in a sentence that the scheduler went away, which Dask does in many ways."""
        try:
            yield
        except (CancelledError, _distributed().comm.CommClosedError) as error:
            raise CampaignError(self._gone("went away")) from error
        except Exception as error:
            if self._client.status == "running" or isinstance(error, CampaignError):
                raise
            raise CampaignError(self._gone("went away")) from error

    def _still_there(self, seen: float) -> float:
        """Return when workers were last seen; raise if that is too long ago."""
        now = time.monotonic()
        if self._client.status != "running":
            raise CampaignError(self._gone("went away"))
        if self._client.scheduler_info(n_workers=-1)["workers"]:
            return now
        if now - seen > _GONE_S:
            raise CampaignError(self._gone(f"has had no workers for {_GONE_S:g} s"))
        return seen

    def _gone(self, what: str) -> str:
        return (
            f"The Dask scheduler at {self._address} {what}; look at its log and the workers', and "
            "start the campaign again, or leave --dask out."
        )


def _distributed() -> Any:  # noqa: ANN401 - Dask has no types
    return import_module("distributed")


def versions() -> dict[str, str]:
    """Versions on which results depend, and whether objects can be passed on."""
    import numpy as np

    import rigd

    python = ".".join(platform.python_version_tuple()[:2])
    return {
        "rigd": rigd.__version__, "Python": python, "numpy": np.__version__,
        "distributed": _distributed().__version__,
    }  # fmt: skip


def _check_workers(client: Any, address: str) -> None:  # noqa: ANN401 - Dask has no types
    """Raise if there are no workers, or one that lacks this package or has other versions."""
    try:
        client.wait_for_workers(1, timeout=_WORKERS_S)
    except TimeoutError as error:
        raise CampaignError(
            f"The Dask scheduler at {address} has no workers; start some with "
            f"'dask worker {address} --nthreads 1'."
        ) from error
    found: Mapping[str, dict[str, str] | Exception] = client.run(versions, on_error="return")
    here = versions()
    for worker, there in found.items():
        if isinstance(there, ModuleNotFoundError):
            raise CampaignError(
                f"The Dask worker at {worker} has no module {there.name}: install rigd "
                f"{here['rigd']} with its extra 'dask' there, and start it again."
            )
        if isinstance(there, Exception):
            raise CampaignError(f"The Dask worker at {worker} cannot be used: {there}.")
        other = [f"{name} {there[name]} and not {here[name]}" for name in here
                 if there[name] != here[name]]  # fmt: skip
        if other:
            raise CampaignError(
                f"The Dask worker at {worker} has {', '.join(other)}: install the versions of this "
                "machine there, and start it again."
            )
