"""The command ``ffsm doctor``: the installation is checked by trying each part."""

import platform
import re
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterable
from functools import partial
from importlib.metadata import PackageNotFoundError, entry_points, requires, version
from pathlib import Path
from typing import Any

import click

from ffsm_drake.cli.common import EXIT_BAD_INPUT, json_option, print_result
from ffsm_drake.common.errors import FfsmError, one_line
from ffsm_drake.common.registrations import (
    Plugin,
    Registry,
    offered,
    own_plugins,
    plugin_of,
)


@click.command()
@json_option
def doctor(as_json: bool) -> None:
    """Check the installation: versions, models, controllers, a short run, the browser, Graphviz.

    Exits with 2 when something required is missing.

    \b
    Example:
      ffsm doctor
    """
    checks = examine()
    lines = [f"[{check['status']:^7}] {check['name']}: {check['detail']}" for check in checks]
    print_result(as_json, checks, "\n".join(lines))
    sys.exit(EXIT_BAD_INPUT if any(check["status"] == "missing" for check in checks) else 0)


def examine() -> list[dict[str, str]]:
    """Try every part of the installation, in seconds; each gets a name, a detail and a status.

    The status is "ok", "missing" (required), "without" (optional and absent) or "remark".
    """
    parts: tuple[tuple[str, str, Callable[[], str]], ...] = (
        ("Python", "missing", lambda: f"{platform.python_version()} on {platform.platform()}"),
        ("packages", "missing", _packages),
        ("Drake", "remark", _drake),
        ("models", "missing", _models),
        ("a short run", "missing", _short_run),
        ("writing here", "missing", _writing),
        ("controllers", "without", _controllers),
        *(
            (f"plug-in {name}", "without", partial(_plugin, plugin))
            for name, plugin in own_plugins().items()
        ),
        ("other plug-ins", "without", _other_plugins),
        ("Meshcat", "without", _meshcat),
        ("Graphviz", "without", _graphviz),
    )
    checks = []
    for name, otherwise, examine_part in parts:
        try:
            status, detail = "ok", examine_part()
        except (FfsmError, OSError, RuntimeError, ImportError) as error:
            status, detail = otherwise, one_line(error)
        checks.append({"name": name, "status": status, "detail": detail})
    return checks


def _packages() -> str:
    from ffsm_drake.runs.record import software_versions

    versions = software_versions()
    return ", ".join(
        f"{name} {versions[name]}" for name in versions if name not in ("python", "platform")
    )


def _drake() -> str:
    from ffsm_drake.common import versions

    first, last = versions.TESTED_DRAKE
    installed = version("drake")
    if not versions.release(first) <= versions.release(installed) <= versions.release(last):
        raise RuntimeError(f"{installed} is outside the tested range, {first} to {last}")
    return f"{installed}, in the tested range {first} to {last}"


def _models() -> str:
    from ffsm_drake.scenario import load_scenario
    from ffsm_drake.spacecraft.craft import make_true_plant
    from ffsm_drake.spacecraft.plant import models_dir

    make_true_plant(load_scenario("postcapture"))
    return str(models_dir())


def _short_run() -> str:
    from ffsm_drake.runs.simulate import simulate
    from ffsm_drake.scenario import load_scenario, override_scenario

    record = simulate(
        override_scenario(load_scenario("postcapture"), ["duration=0.5"]), check_stability=False
    )
    return f"{record.outcome.message} of simulated time in {record.wall_time['total']:.2f} s"


def _writing() -> str:
    with tempfile.NamedTemporaryFile(dir=Path.cwd(), prefix=".ffsm-doctor-"):
        free = shutil.disk_usage(Path.cwd()).free
    return f"{Path.cwd()}, {free / 1e9:.1f} GB free"


def _controllers() -> str:
    from ffsm_drake.systems.registry import block_names, find_factory

    names = block_names("controller")
    for name in names:
        find_factory("controller", name)
    return ", ".join(names) + ", or module:attribute"


def _plugin(plugin: Plugin) -> str:
    brought = [
        f"{group.replace('_', ' ')}: {_loaded(group, names)}"
        for group, names in plugin.brings.items()
    ]
    found = "; ".join((plugin.about, *brought))
    extras = ",".join(extra for extra in plugin.extras if _lacks(extra))
    if extras:
        raise FfsmError(f"{found}; for all of it: pip install 'ffsm-drake[{extras}]'")
    return found


def _loaded(group: str, names: Iterable[str]) -> str:
    """The names of objects, each of which is imported."""
    for name in names:
        Registry[Any](group).load(name, name)
    return ", ".join(names)


def _lacks(extra: str) -> bool:
    """Whether a library of an extra of the installation is missing."""
    for requirement in requires("ffsm-drake") or ():
        library, _, of = requirement.partition("; extra == ")
        try:
            if of.strip("'") == extra:
                version(re.split("[^-.\\w]", library)[0])
        except PackageNotFoundError:
            return True
    return False


def _other_plugins() -> str:
    found = []
    for group in sorted(entry_points().groups):
        kind = group.removeprefix("ffsm_drake.")
        others = [name for name, each in offered(kind).items() if not plugin_of(each.module)]
        if others and kind != group:
            found.append(f"{kind.replace('_', ' ')}: {_loaded(kind, others)}")
    return "; ".join(found) or "none"


def _meshcat() -> str:
    from ffsm_drake.show.outputs import MESHCAT_SERVERS

    start_meshcat = MESHCAT_SERVERS.only("Meshcat")
    return f"serves {start_meshcat().web_url()}, to this machine only"


def _graphviz() -> str:
    found = shutil.which("dot")
    if found is None:
        raise RuntimeError("'dot' is not installed: diagrams as .dot only")
    return found
