"""Work in a thread of its own that asks another thread for an answer now and then."""

import queue
import threading
from collections.abc import Callable
from typing import Any


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

    def start(self, work: Callable[[], Any], release: Callable[[], None] = lambda: None) -> None:
        """Begin the work; ``release`` follows it in any case."""

        def run() -> None:
            try:
                self._asked.put((False, work()))
            except Exception as error:  # whatever it is, it is the other thread's
                self._asked.put((False, error))
            finally:
                release()

        self._thread = threading.Thread(target=run, daemon=True)
        self._thread.start()

    def ask(self, question: Any) -> Any:
        """The answer to a question; within the work. Raises StoppedError."""
        self._asked.put((True, question))
        answer = self._answers.get()
        if answer is None:
            raise StoppedError
        return answer

    def answer(self, answer: Any) -> None:
        """Let the work go on."""
        self._answers.put(answer)

    def take(self) -> Any:
        """Wait for the next question, or for the result, after which nothing goes on. Raises what
        the work raised.
        """
        is_question, found = self._asked.get()
        if not is_question:
            assert self._thread is not None
            self._thread.join()
            self._thread = None
            if isinstance(found, Exception):
                raise found
        return found

    def stop(self) -> None:
        """End the work at its question, if it goes on."""
        if self._thread is not None:
            self._answers.put(None)
            self._thread.join()
            self._thread = None
