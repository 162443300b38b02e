from ffsm_drake.common.registrations import Plugin

PLUGIN = Plugin(
    about="Two arms that hold one target: the closed chain, laws in it, and its internal force",
    page="two_arms",
    needs=("equations", "tape"),
    uses=("faults", "task_space"),
    brings={
        "planned_chains": {"contacts": "two_arms.programs:ChainPrograms"},
        "sections": {"forces.contacts": "two_arms.contact:Contacts"},
        "closed_chains": {"two_arms": "two_arms.arms:ARMS"},
        "supervised_chains": {"contacts": "two_arms.supervised:SupervisedChain"},
        "followers": {"contacts": "two_arms.motion:closed_motion"},
        "mission_phases": {"later_hands": "two_arms.hand:phases_of_later_hands"},
    },
)
