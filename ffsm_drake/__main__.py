"""The command ``ffsm``, which is ``python -m ffsm_drake``."""

from ffsm_drake.common.interrupts import handle_signals, ignore_signals


def main() -> None:
    """Run the command line; interrupts are handled before anything else is imported."""
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
