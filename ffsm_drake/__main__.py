"""The command ``ffsm``, which is ``python -m ffsm_drake``."""

# The built-in module under ``signal``, so that no time passes.
import _signal  # type: ignore[import-not-found]
import gc
import os

# before the next import: Ctrl-C may fall into any of them
for _number in (_signal.SIGINT, _signal.SIGTERM, _signal.SIGHUP):
    if _signal.getsignal(_number) != _signal.SIG_IGN:
        _signal.signal(_number, lambda number, frame: os._exit(128 + number))

from ffsm_drake.common.interrupts import Interrupts, end_at_once, handle_signals  # noqa: E402

# New objects between two garbage collections: imports make many, and next to no garbage.
_MANY_OBJECTS = 10_000


def _in_utf8() -> None:
    """Begin anew in Python's UTF-8 mode where the locale has another encoding: files that are read
    on the way, also those of libraries, are UTF-8.
    """
    import locale
    import sys

    if locale.getencoding().lower() not in ("utf-8", "utf8") and not sys.flags.utf8_mode:
        words = [sys.executable, "-X", "utf8", *sys.orig_argv[1:]]
        os.execve(sys.executable, words, {**os.environ, "PYTHONUTF8": "1"})
    for stream in (sys.stdout, sys.stderr):
        if stream is not None and hasattr(stream, "reconfigure"):  # PYTHONIOENCODING
            stream.reconfigure(errors="backslashreplace")


def main() -> None:
    """Run the command line, and end the process."""
    interrupts = handle_signals()
    gc.set_threshold(_MANY_OBJECTS)
    try:
        _main(interrupts)
    except (OSError, ImportError) as error:  # raised by the imports
        if interrupts.number:  # within an import a signal becomes an ImportError
            interrupts.end(interrupts.number)
        os.write(2, f"error: {' '.join(str(error).split())}\n".encode("utf-8", "replace"))
        os._exit(2)


def _main(interrupts: Interrupts) -> None:
    try:
        os.getcwd()
    except FileNotFoundError:  # Python itself may fail to import modules from here on
        os.write(2, b"error: the current folder has been deleted; change to another one\n")
        os._exit(2)
    try:
        for end in (*os.pipe(), os.dup(2)):  # the watcher's pipe stays open beside an import
            os.close(end)
    except OSError:  # within an import it is anything
        os.write(2, b"error: too few files may be open; allow more, such as ulimit -n 256\n")
        os._exit(2)
    _in_utf8()
    interrupts.watch()
    import threading

    from ffsm_drake.cli import main as ffsm
    from ffsm_drake.cli.common import end_threads, forgiving_stderr
    from ffsm_drake.cli.progress import show_life
    from ffsm_drake.common.guard import user_code_is_loaded

    forgiving_stderr()
    over = threading.Event()
    threading.Thread(target=show_life, args=(over,), daemon=True).start()
    try:
        ffsm(prog_name="ffsm")
    except SystemExit as ending:
        end_at_once()
        end_threads(ending.code)
        if not user_code_is_loaded():  # its objects may write when freed, like open files
            gc.freeze()  # to search all objects for cycles is a tenth of a run's time
        raise
    finally:
        over.set()


if __name__ == "__main__":
    main()
