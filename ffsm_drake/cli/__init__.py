"""The command line ``ffsm``: parses, calls, prints. Slow imports wait until a command runs."""

import logging
import os
import sys
from pathlib import Path

import click

from ffsm_drake.cli.common import ExtensibleGroup
from ffsm_drake.cli.compare import compare
from ffsm_drake.cli.run import run
from ffsm_drake.cli.setup import completion, scenarios, schema, validate
from ffsm_drake.cli.show import plot
from ffsm_drake.common.errors import FfsmError
from ffsm_drake.common.threads import ONE_THREAD


@click.group(
    cls=ExtensibleGroup,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110},
)
@click.version_option(package_name="ffsm-drake")
def main() -> None:
    """Simulate and evaluate controllers of a free-flying space manipulator after debris capture.

    \b
    Examples:
      ffsm run                             the main job; open out/postcapture/report.html
      ffsm compare paper                   the paper's four controllers, overlaid and ranked
      ffsm run mine.yaml --controller my_module:MyController --set payload.truth.mass=120

    Exit codes: 0 good, 2 bad input, 3 diverged or unstable, 130 interrupted, 143 ended by SIGTERM,
    129 by SIGHUP.
    """
    if not (epoch := os.environ.get("SOURCE_DATE_EPOCH", "0")).isdecimal():  # NumPy reads it
        problem = f"must be whole seconds since 1970, not {epoch!r:.40}; unset it"
        raise FfsmError(f"SOURCE_DATE_EPOCH: {problem}")
    for name, threads in ONE_THREAD.items():
        os.environ.setdefault(name, threads)  # read when NumPy loads
    # figures go to files, so no window system is needed
    os.environ["MPLBACKEND"] = "agg"
    # it warns if the home folder is read-only
    logging.getLogger("matplotlib").setLevel(logging.ERROR)
    folder = str(Path.cwd())
    if folder not in sys.path:  # for module:Class; last, so that it shadows no installed module
        sys.path.append(folder)


for command in (
    compare, completion, plot, run, scenarios, schema, validate
):  # fmt: skip
    main.add_command(command)
