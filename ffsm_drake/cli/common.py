"""Shared by the commands: options, errors as one line, the end of the process."""

import functools
import io
import math
import os
import re
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TextIO, cast

import click

from ffsm_drake.common.errors import (
    FfsmError,
    ModelError,
    ScenarioError,
    one_line,
    placed,
    warnings_as_lines,
)
from ffsm_drake.common.guard import guarded
from ffsm_drake.common.interrupts import exit_code, last_words
from ffsm_drake.common.registrations import Registry

# Each module imports slow packages inside of the command.
COMMANDS = Registry[click.Command]("commands")
EXIT_GOOD, EXIT_BAD_INPUT, EXIT_UNSTABLE = 0, 2, 3


def interrupted(how: str = "interrupted") -> int:
    """Return the exit code of an interrupted command, after its last line."""
    click.echo(last_words(how), err=True)
    return exit_code()


@contextmanager
def _usage_errors() -> Iterator[None]:
    """Begin the text of an unusable option with "error:", as all other errors do."""
    try:
        yield
    except click.ClickException as error:
        text = io.StringIO()
        error.show(text)
        click.echo(text.getvalue().replace("Error: ", "error: ", 1), err=True, nl=False)
        sys.exit(error.exit_code)


class CommandGroup(click.Group):
    """Commands in the order of use; errors of the package become one line and exit code 2."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(self.commands)

    def make_context(self, *args: Any, **extra: Any) -> click.Context:
        with _usage_errors():
            return super().make_context(*args, **extra)

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        for text in args:
            try:
                text.encode()
            except UnicodeEncodeError:  # undecodable bytes in a file name
                raise click.UsageError(
                    f"{text!r} is not UTF-8 text; rename the file or folder", ctx
                ) from None
        return super().parse_args(ctx, args)

    def invoke(self, ctx: click.Context) -> Any:
        with warnings_as_lines():
            try:
                with guarded, _usage_errors():
                    return super().invoke(ctx)
            except BrokenPipeError:  # the pipe was closed, as by ``| head``
                sys.stderr.close()
                sys.exit(EXIT_GOOD)
            except (FfsmError, OSError, MemoryError) as error:  # OSError: a full disk, ...
                click.echo(f"error: {one_line(error)}", err=True)
                sys.exit(EXIT_BAD_INPUT)
            except KeyboardInterrupt as interruption:
                sys.exit(interrupted(str(interruption) or "interrupted"))


class ExtensibleGroup(CommandGroup):
    """Commands and those of plug-ins, imported on first use.

    A command with an unloadable plug-in reports this, in the list and when it runs.
    """

    def list_commands(self, ctx: click.Context) -> list[str]:
        return sorted({*self.commands, *COMMANDS.offers()})

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        known = super().get_command(ctx, cmd_name)
        return (
            _command_of_plugin(cmd_name)
            if known is None and cmd_name in COMMANDS.offers()
            else known
        )


def _command_of_plugin(name: str) -> click.Command:
    try:
        found = COMMANDS.load(name, f"'{name}'")
        if isinstance(found, click.Command):
            return found
        kind = type(found).__name__
        problem = FfsmError(
            f"'{name}': plug-in offers an object of type {kind}, not a click command"
        )
    except FfsmError as error:
        problem = error

    def fail(arguments: tuple[str, ...]) -> None:
        raise problem

    return click.Command(
        name,
        callback=fail,
        params=[click.Argument(["arguments"], nargs=-1, type=click.UNPROCESSED)],
        context_settings={"ignore_unknown_options": True},
        help=str(problem),
        short_help="cannot be loaded",
    )


class _ForgivingStream:
    """A text stream that drops lines on write errors: a full disk must not end a run."""

    def __init__(self, stream: TextIO) -> None:
        self._stream, self.written = stream, time.monotonic()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        self.written = time.monotonic()
        with suppress(OSError):
            self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        with suppress(OSError):
            self._stream.flush()


def forgiving_stderr() -> None:
    """Keep going when standard error is closed, or its disk is full."""
    if sys.stderr is None:  # closed
        # for the process's life
        sys.stderr = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115
    sys.stderr = cast("TextIO", _ForgivingStream(sys.stderr))


def end_threads(code: Any) -> None:
    """End the process if a controller left threads running; Python would wait for them."""
    left = [
        thread.name
        for thread in threading.enumerate()
        if not thread.daemon and thread.ident != threading.get_ident()
    ]
    if left:
        click.echo(f"warning: threads were still running at the end: {', '.join(left)}", err=True)
        for stream in (sys.stdout, sys.stderr):
            with suppress(OSError, ValueError):
                stream.flush()
        os._exit(code if isinstance(code, int) else EXIT_GOOD)


def complete_scenario(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[Any]:
    """Complete with shipped names, then files."""
    from click.shell_completion import CompletionItem

    from ffsm_drake.scenario import shipped_scenarios

    names = [CompletionItem(name) for name in shipped_scenarios() if name.startswith(incomplete)]
    return names or [CompletionItem(incomplete, type="file")]


def complete_controller(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[str]:
    from ffsm_drake.systems.controllers import controller_names

    return [name for name in controller_names() if name.startswith(incomplete)]


scenario_argument = click.argument(
    "scenario", default="postcapture", metavar="[SCENARIO]", shell_complete=complete_scenario
)
rehearsal_option = click.option(
    "--rehearsal/--no-rehearsal",
    default=True,
    show_default=True,
    help="Also run the mission once, with limits and noise (takes the time of a run).",
)
json_option = click.option(
    "--json", "as_json", is_flag=True, help="Print one JSON document instead of text."
)
run_argument = click.argument("run", type=click.Path(path_type=Path), metavar="RUN_DIR")


def out_option(what: str = "DIR", **settings: Any) -> Callable[..., Any]:
    """Return the option --out: for a folder, or for a file with ``what`` "FILE"."""
    return click.option(
        "--out", type=click.Path(path_type=Path, dir_okay=what == "DIR"), metavar=what, **settings
    )


def _table_file(context: click.Context, option: click.Parameter, path: Path | None) -> Path | None:
    """Refuse a table's file of another format, before anything runs."""
    from ffsm_drake.show.table_files import FORMATS

    if path is not None and path.suffix not in FORMATS:
        raise click.BadParameter(f"must end in {' or '.join(FORMATS)}, not '{path}'")
    return path


table_option = click.option(
    "--table",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    callback=_table_file,
    help="Also write the table, to FILE.tex (LaTeX, booktabs) or FILE.csv.",
)


def controller_option(*, multiple: bool = False, **settings: Any) -> Callable[..., Any]:
    return click.option(
        "--controller",
        "-c",
        multiple=multiple,
        metavar="NAME",
        shell_complete=complete_controller,
        **settings,
    )


_CONTROLLER_HELP = (
    "A controller listed by 'ffsm doctor', or module:Class. Default: the scenario's own."
)


def override_options(
    *,
    multiple: bool = False,
    help: str = _CONTROLLER_HELP,
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Add --controller, --set and --seed. The command receives ``overrides`` in order of
    precedence: later ones win, --controller and --seed come last.

    With ``multiple`` --controller may be repeated, and comes as ``controllers``.
    """

    def decorate(command: Callable[..., Any]) -> Callable[..., Any]:
        @controller_option(multiple=multiple, help=help)
        @click.option(
            "--set",
            "overrides",
            multiple=True,
            metavar="KEY=VALUE",
            help="Override a scenario value; repeatable.",
        )
        @click.option("--seed", type=int, help="Noise seed; short for --set random_seed=N.")
        @functools.wraps(command)
        def wrapped(
            *, controller: Any, overrides: tuple[str, ...], seed: int | None, **rest: Any
        ) -> Any:
            if multiple:
                rest["controllers"] = controller
            elif controller:
                overrides = (*overrides, f"controller={controller}")
            if seed is not None:
                overrides = (*overrides, f"random_seed={seed}")
            return command(overrides=overrides, **rest)

        return wrapped

    return decorate


def scenario_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add SCENARIO, --controller, --set and --seed; the command gets one loaded ``scenario``."""

    @scenario_argument
    @override_options()
    @functools.wraps(command)
    def wrapped(scenario: str, overrides: tuple[str, ...], **rest: Any) -> Any:
        from ffsm_drake.scenario import load_scenario

        with located_errors(scenario, overrides):
            return command(scenario=load_scenario(scenario, overrides), **rest)

    return wrapped


@contextmanager
def located_errors(
    scenario: str, overrides: Sequence[str] = (), controller: str = ""
) -> Iterator[None]:
    """Add the source of a scenario key, file or override, to errors raised after loading;
    ``controller``: source of the controller's name, unless the scenario gives it.
    """
    from ffsm_drake.scenario import Scenario, place_of, schema_fields

    try:
        yield
    except ScenarioError as error:
        if re.split(r"[.\[]", error.key)[0] not in (schema_fields(Scenario) or {}):
            raise
        if controller and error.key == "controller":
            raise ScenarioError(controller, error.problem) from error
        raise error.located(place_of(error.key, scenario, overrides)) from error
    except ModelError as error:
        place = place_of(str(error).partition(":")[0], scenario, overrides)
        raise ModelError(placed(place, str(error))) from error


def scenario_stem() -> str:
    """Return a folder name for the current command's SCENARIO."""
    return (repeated_run() or Path(click.get_current_context().params["scenario"])).stem


def repeated_run() -> Path | None:
    """Return the run's folder if the current command's SCENARIO is one, else None."""
    from ffsm_drake.scenario import MANIFEST_FILE

    path = Path(click.get_current_context().params["scenario"])
    folder = path.parent if path.name == MANIFEST_FILE else path
    return folder.resolve() if (folder / MANIFEST_FILE).is_file() else None


def print_json(data: Any) -> None:
    from ffsm_drake.runs.record import to_json

    click.echo(to_json(data), nl=False)


def print_result(as_json: bool, data: Any, text: str) -> None:
    """Print a command's result: its data as JSON, or its text."""
    if as_json:
        print_json(data)
    else:
        click.echo(text)


class FiniteFloat(click.FloatRange):
    """A number that is neither NaN nor infinite."""

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        number = float(super().convert(value, param, ctx))
        if not math.isfinite(number):
            self.fail(f"{value!r} is not a finite number.", param, ctx)
        return number
