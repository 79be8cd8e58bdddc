"""Runs Orbax without its printed output, on event loops that wait for their own tasks and threads."""

import asyncio
import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import uvloop

from travjax.signals import postponed


def _not_from_orbax(record: logging.LogRecord) -> bool:
    return "orbax" not in Path(record.pathname).parts


class _PatientLoop(asyncio.SelectorEventLoop):
    """An event loop that ends no earlier than its tasks and threads.

    Orbax closes its own loop at the first error while other reads and writes are still running: they would go on, print
    a traceback each, and create removed files again.
    """

    def close(self) -> None:
        if not self.is_closed():
            self.run_until_complete(self._finish())
        super().close()

    async def _finish(self) -> None:
        others = asyncio.all_tasks() - {asyncio.current_task()}
        await asyncio.gather(*others, return_exceptions=True)
        await self.shutdown_default_executor()


class _PatientPolicy(asyncio.DefaultEventLoopPolicy):
    _loop_factory = _PatientLoop


@contextmanager
def patient_loops() -> Iterator[None]:
    """Makes asyncio, and uvloop, whose loops Orbax also runs, create patient loops."""
    policy, new_event_loop = asyncio.get_event_loop_policy(), uvloop.new_event_loop
    asyncio.set_event_loop_policy(_PatientPolicy())
    uvloop.new_event_loop = lambda: _PatientLoop()  # type: ignore
    try:
        yield
    finally:
        asyncio.set_event_loop_policy(policy)
        uvloop.new_event_loop = new_event_loop


@contextmanager
def quiet_orbax() -> Iterator[Any]:
    """Provides Orbax with patient loops, and without its warnings and its log, which repeats each error it raises.

    A signal waits until Orbax is done.
    """
    logging.getLogger("absl").addFilter(_not_from_orbax)  # adding it again changes nothing
    with postponed(), warnings.catch_warnings(), patient_loops():
        warnings.simplefilter("ignore")
        from orbax.checkpoint import v1 as ocp

        yield ocp
