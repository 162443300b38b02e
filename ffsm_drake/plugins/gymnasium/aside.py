"""Work in a separate thread with occasional questions to another thread.

A thread still within Drake at the end of the interpreter aborts the process. So the work has an
owner: it ends with the owner, or at the interpreter's exit, whichever is first.
"""

import atexit
import queue
import threading
import weakref
from collections.abc import Callable
from typing import Any

from ffsm_drake.common.errors import FfsmError


class StoppedError(Exception):
    """The other thread gives no more answers."""


class Aside:
    """The work, and where the two threads meet."""

    def __init__(self) -> None:
        self._asked = queue.SimpleQueue[Any]()
        self._answers = queue.SimpleQueue[Any]()
        self._thread: threading.Thread | None = None

    @property
    def goes_on(self) -> bool:
        """Whether the work has begun, and its end was not taken yet."""
        return self._thread is not None

    def start(
        self, work: Callable[[], Any], release: Callable[[], None] = lambda: None, *, owner: object
    ) -> None:
        """Begin the work; ``release`` follows it in any case.

        Args:
          owner: the work ends with it, and must not refer to it.

        Raises: FfsmError, while the interpreter ends.
        """
        if not threading.main_thread().is_alive():
            raise FfsmError("no run can begin while the interpreter ends")

        def run() -> None:
            try:
                found = False, work()
            except BaseException as error:  # any exception is passed to the other thread
                found = False, error
            try:
                release()
            finally:
                self._asked.put(found)

        self._thread = threading.Thread(target=run, daemon=True)
        self._thread.start()
        self._ending = weakref.finalize(owner, self.stop)  # called at the interpreter's exit, too

    def ask(self, question: Any) -> Any:
        """Return the answer to a question; within the work. Raises StoppedError."""
        self._asked.put((True, question))
        answer = self._answers.get()
        if answer is None:
            self._answers.put(None)  # also for repeated questions
            raise StoppedError
        return answer

    def answer(self, answer: Any) -> None:
        """Let the work go on."""
        self._answers.put(answer)

    def take(self) -> Any:
        """Wait for the next question, or for the final result. Raises the errors of the work, and
        FfsmError if it was stopped.
        """
        if self._thread is None:
            raise FfsmError("the run has ended")
        try:
            is_question, found = self._asked.get()
        except BaseException:  # Ctrl-C: a question in the meantime would count as the next one
            self.stop()
            raise
        if not is_question:
            self._join()
            if isinstance(found, BaseException):
                raise found
        return found

    def stop(self) -> None:
        """End the work at its next question."""
        if self._thread is not None:
            self._answers.put(None)
            self._join()

    def _join(self) -> None:
        assert self._thread is not None
        self._ending.detach()
        if self._thread is threading.current_thread():  # it happens to collect the owner
            atexit.register(self._thread.join)
        else:
            self._thread.join()
        self._thread = None
