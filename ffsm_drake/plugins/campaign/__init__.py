"""Campaigns: thousands of runs with dispersed values, in one database, with one report.

spec, dispersion -> cases -> evaluate (by the plug-in ``workers``) -> store -> statistics ->
page; ``run`` drives.
"""

import importlib
from typing import Any

# Imported on first use: the command's help should not wait for Drake.
_HOMES = {
    "cluster_workers": "ffsm_drake.plugins.workers.cluster",
    "load_spec": f"{__name__}.spec",
    "local_workers": "ffsm_drake.plugins.workers.pool",
    "merge_campaigns": f"{__name__}.run",
    "open_store": f"{__name__}.store",
    "repeat_run": f"{__name__}.run",
    "resume_campaign": f"{__name__}.run",
    "start_campaign": f"{__name__}.run",
}
__all__ = list(_HOMES)


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    return getattr(importlib.import_module(_HOMES[name]), name)
