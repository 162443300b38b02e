"""Signals that stop a block of code."""

import os
import signal
import threading
import time

import pytest

from ffsm_drake.common.interrupts import stopping


@pytest.mark.smoke
def test_handlers_are_as_before_afterwards():
    before = signal.getsignal(signal.SIGINT)
    stop = threading.Event()
    with stopping(stop.set):
        os.kill(os.getpid(), signal.SIGINT)
        assert stop.is_set()
        time.sleep(0.3)  # at once it would be the same one, sent twice
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is before
