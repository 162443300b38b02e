"""The command ``ffsm``, which is ``python -m ffsm_drake``."""

# The built-in module under ``signal``, so that no time passes.
import _signal  # type: ignore[import-not-found]
import gc
import os

# before the next import: Ctrl-C may fall into any of them
for _number in (_signal.SIGINT, _signal.SIGTERM, _signal.SIGHUP):
    if _signal.getsignal(_number) != _signal.SIG_IGN:
        _signal.signal(_number, lambda number, frame: os._exit(128 + number))

from ffsm_drake.common.interrupts import handle_signals, ignore_signals  # noqa: E402

# New objects between two garbage collections: imports make many, and next to no garbage.
_MANY_OBJECTS = 10_000


def main() -> None:
    """Run the command line, and end the process."""
    handle_signals()
    gc.set_threshold(_MANY_OBJECTS, *gc.get_threshold()[1:])
    try:
        os.getcwd()
    except FileNotFoundError:  # Python itself may fail to import what follows
        os.write(2, b"error: the current folder has been deleted; change to another one\n")
        os._exit(2)
    import sys
    import threading

    from ffsm_drake.cli import main as ffsm
    from ffsm_drake.cli.common import end_process, end_threads, forgiving_stderr, show_life

    forgiving_stderr()
    over = threading.Event()
    threading.Thread(target=show_life, args=(over,), daemon=True).start()
    try:
        ffsm(prog_name="ffsm")
    except SystemExit as ending:
        end_threads(ending.code)
        ignore_signals()
        end_process(ending.code, sys._getframe().f_back)
        raise
    finally:
        over.set()


if __name__ == "__main__":
    main()
