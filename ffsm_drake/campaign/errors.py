"""Errors of a campaign's specification, database or workers."""

from ffsm_drake.common.errors import FfsmError


class CampaignError(FfsmError):
    """A campaign that cannot be planned, run or read; its text is one line."""


class InterruptedCampaign(KeyboardInterrupt):
    """The campaign was asked to stop; finished runs are stored."""

    def __init__(self, done: int, total: int) -> None:
        self.done, self.total = done, total
        super().__init__(f"interrupted with {done} of {total} runs stored; 'ffsm campaign resume' finishes them")
