"""Campaigns: thousands of runs of dispersed scenarios, stored in one database and evaluated in one report.

spec -> sampling -> cases -> evaluate (in workers, by executor) -> store -> statistics -> report; ``run`` drives.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ffsm_drake.campaign.executor import cluster_workers, local_workers
    from ffsm_drake.campaign.run import repeat_run, resume_campaign, start_campaign
    from ffsm_drake.campaign.spec import load_spec
    from ffsm_drake.campaign.store import open_store

# Imported on first use, so that the command line starts fast.
_HOMES = {
    "cluster_workers": "executor",
    "load_spec": "spec",
    "local_workers": "executor",
    "open_store": "store",
    "repeat_run": "run",
    "resume_campaign": "run",
    "start_campaign": "run",
}

__all__ = [
    "cluster_workers",
    "load_spec",
    "local_workers",
    "open_store",
    "repeat_run",
    "resume_campaign",
    "start_campaign",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
