"""Campaigns: thousands of runs of dispersed scenarios, stored in one database and evaluated in one
report.

spec, dispersion -> cases -> evaluate (in workers, by common.workers) -> store -> statistics ->
report; ``run`` drives.
"""

from ffsm_drake.campaign.run import (
    merge_campaigns,
    repeat_run,
    resume_campaign,
    start_campaign,
)
from ffsm_drake.campaign.spec import load_spec
from ffsm_drake.campaign.store import open_store
from ffsm_drake.common.workers import cluster_workers, local_workers

__all__ = [
    "cluster_workers",
    "load_spec",
    "local_workers",
    "merge_campaigns",
    "open_store",
    "repeat_run",
    "resume_campaign",
    "start_campaign",
]
