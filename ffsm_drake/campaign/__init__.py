"""Campaigns: thousands of runs of dispersed scenarios, stored in one database and evaluated in one report.

spec -> sampling -> cases -> evaluate (in workers, by common.workers) -> store -> statistics -> report; ``run`` drives.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ffsm_drake.campaign.run import repeat_run, resume_campaign, start_campaign
    from ffsm_drake.campaign.spec import load_spec
    from ffsm_drake.campaign.store import open_store
    from ffsm_drake.common.workers import cluster_workers, local_workers

# Imported on first use, so that the command line starts fast.
_HOMES = {
    "cluster_workers": "common.workers",
    "load_spec": "campaign.spec",
    "local_workers": "common.workers",
    "open_store": "campaign.store",
    "repeat_run": "campaign.run",
    "resume_campaign": "campaign.run",
    "start_campaign": "campaign.run",
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
    return getattr(importlib.import_module(f"ffsm_drake.{_HOMES[name]}"), name)
