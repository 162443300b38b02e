"""Check the installation by trying each part."""

import dataclasses
import platform
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

from ffsm_drake.common.errors import FfsmError, one_line
from ffsm_drake.scenario import load_scenario, override_scenario


@dataclasses.dataclass(frozen=True, kw_only=True)
class Check:
    """One part of the installation: ``status`` is "ok", "missing" (required) or "without" (optional and absent)."""

    name: str
    status: str
    detail: str


def examine() -> list[Check]:
    """Try every part; takes a few seconds."""
    parts: tuple[tuple[str, bool, Callable[[], str]], ...] = (
        ("Python", True, _python),
        ("packages", True, _packages),
        ("models", True, _models),
        ("a short run", True, _short_run),
        ("writing here", True, _writing),
        ("controllers", False, _controllers),
        ("Meshcat", False, _meshcat),
        ("Graphviz", False, lambda: _program("dot", "diagrams as .dot only")),
    )
    checks = []
    for name, needed, examine_part in parts:
        try:
            checks.append(Check(name=name, status="ok", detail=examine_part()))
        except (FfsmError, OSError, RuntimeError, ImportError) as error:
            checks.append(Check(name=name, status="missing" if needed else "without", detail=one_line(error)))
    return checks


def _python() -> str:
    return f"{platform.python_version()} on {platform.platform()}"


def _packages() -> str:
    from ffsm_drake.runs.record import software_versions

    versions = software_versions()
    return ", ".join(f"{name} {versions[name]}" for name in versions if name not in ("python", "platform"))


def _models() -> str:
    from ffsm_drake.spacecraft.nominal import make_true_plant
    from ffsm_drake.spacecraft.plant import models_dir

    make_true_plant(load_scenario("postcapture"))
    return str(models_dir())


def _short_run() -> str:
    from ffsm_drake.runs.simulate import simulate

    record = simulate(override_scenario(load_scenario("postcapture"), ["duration=0.5"]), check_stability=False)
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


def _meshcat() -> str:
    from ffsm_drake.show.meshcat import quiet_drake, start_meshcat

    with quiet_drake():
        return f"serves {start_meshcat().web_url()}, to this machine only"


def _program(name: str, without: str) -> str:
    found = shutil.which(name)
    if found is None:
        raise RuntimeError(f"'{name}' is not installed: {without}")
    return found
