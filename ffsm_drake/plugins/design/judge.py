"""The judge of missions for the core and the report."""

from typing import Any

from ffsm_drake.mission import Mission
from ffsm_drake.plugins.design.layers import layer_remarks
from ffsm_drake.plugins.design.remarks import plan_remarks
from ffsm_drake.plugins.design.remedy_file import write_remedy
from ffsm_drake.plugins.design.stability.own_adaptation import own_adaptation
from ffsm_drake.plugins.design.verdict import helpful_remarks, mission, verdict
from ffsm_drake.runs.judge import Judge
from ffsm_drake.spacecraft.free_floating import driven_model
from ffsm_drake.systems.reference import make_motion


class LinearJudge(Judge):
    """Judges by the linear loop, and rehearsals where they are asked for."""

    remarks = staticmethod(plan_remarks)
    validate = staticmethod(mission)
    layers = staticmethod(layer_remarks)
    advice = staticmethod(helpful_remarks)
    remedy = staticmethod(write_remedy)

    def warnings(self, mission: Mission) -> list[str]:
        """See Judge."""
        return verdict(mission, rehearsal=False).warnings

    def uncovered(self, mission: Mission, law: Any) -> str:
        """See Judge."""
        model = driven_model(mission.craft.nominal())
        return own_adaptation(law, mission.scenario, model, make_motion(mission)).uncovered

    def distance(self, mission: Mission) -> float:
        """See Judge."""
        from ffsm_drake.plugins.design.limit import find_limit  # slow to import

        return find_limit(mission).distance


JUDGE = LinearJudge()
