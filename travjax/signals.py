"""How SIGINT and SIGTERM end a program: one line, an exit code of 128 plus the signal's number, and no remains."""

import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any, NoReturn

ENDINGS = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated"}
"""Word that the program prints for each signal."""


class Terminated(KeyboardInterrupt):
    """Raised on SIGTERM, from a scheduler or a container, so that the same cleanup runs as after SIGINT."""


def end_at_once() -> None:
    """Lets a signal end the program at once while nothing needs cleanup: imports of libraries swallow exceptions."""
    for number in _heeded():
        signal.signal(number, _end)


@contextmanager
def raised() -> Iterator[None]:
    """Lets SIGINT raise KeyboardInterrupt and SIGTERM raise Terminated while the block runs."""
    before = {number: signal.signal(number, _raise) for number in _heeded()}
    hook = sys.unraisablehook

    def dropped(lost: Any) -> None:
        if isinstance(lost.exc_value, KeyboardInterrupt):
            _send_again(lost.exc_value)
        else:
            hook(lost)

    sys.unraisablehook = dropped
    try:
        yield
    finally:
        sys.unraisablehook = hook
        _restore(before)


@contextmanager
def postponed() -> Iterator[None]:
    """Lets a signal wait for the end of the block, because the library in it cannot be left halfway.

    Threads that Orbax has started would wait for each other for ever, and Python for them when it exits. A second
    signal does not wait.
    """
    came: list[int] = []

    def note(number: int, frame: FrameType | None) -> None:
        came.append(number)
        _restore(before)

    before = {number: signal.signal(number, note) for number in _heeded()}
    try:
        yield
    finally:
        _restore(before)
        for number in came:
            signal.raise_signal(number)


@contextmanager
def going_on(how: str) -> Iterator[None]:
    """Lets a program that is stopped within the block tell how to resume it."""
    try:
        yield
    except KeyboardInterrupt as error:
        error.add_note(how)
        raise


def ending(error: KeyboardInterrupt) -> tuple[int, str]:
    """Returns the exit code of a program that a signal ended, and its line; the error's notes tell how to resume."""
    number = _number(error)
    return 128 + number, "; ".join([ENDINGS[number], *getattr(error, "__notes__", [])])


def _heeded() -> list[signal.Signals]:
    """Returns the signals that are not set to be ignored, as nohup and a shell's & do when they start a program."""
    if threading.current_thread() is not threading.main_thread():
        return []
    return [number for number in ENDINGS if signal.getsignal(number) not in (signal.SIG_IGN, None)]


def _restore(handlers: dict[signal.Signals, Any]) -> None:
    for number, handler in handlers.items():
        signal.signal(number, handler)


def _send_again(error: BaseException) -> None:
    """Sends a signal again whose exception Python had to drop, in a destructor or a callback of the collector."""
    threading.Timer(0.01, os.kill, (os.getpid(), _number(error))).start()  # once destructor or callback has returned


def _number(error: BaseException) -> signal.Signals:
    return signal.SIGTERM if isinstance(error, Terminated) else signal.SIGINT


def _raise(number: int, frame: FrameType | None) -> NoReturn:
    raise Terminated if number == signal.SIGTERM else KeyboardInterrupt


def _end(number: int, frame: FrameType | None) -> NoReturn:
    try:
        os.write(2, f"travjax: {ENDINGS[signal.Signals(number)]}\n".encode())
    finally:
        os._exit(128 + number)
