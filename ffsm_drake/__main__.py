"""The command ``ffsm``, which is ``python -m ffsm_drake``."""

import os
import signal

for _number in (signal.SIGINT, signal.SIGTERM):  # before the next import: Ctrl-C may fall into any of them
    if signal.getsignal(_number) != signal.SIG_IGN:
        signal.signal(_number, lambda number, frame: os._exit(128 + number))

from ffsm_drake.common.interrupts import handle_signals, ignore_signals  # noqa: E402


def main() -> None:
    """Run the command line."""
    handle_signals()
    from ffsm_drake.cli import main as ffsm
    from ffsm_drake.cli.common import end_threads, forgiving_stderr

    forgiving_stderr()
    try:
        ffsm(prog_name="ffsm")
    except SystemExit as ending:
        end_threads(ending.code)
        ignore_signals()
        raise


if __name__ == "__main__":
    main()
