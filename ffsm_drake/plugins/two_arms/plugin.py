from ffsm_drake.common.registrations import Plugin

PLUGIN = Plugin(
    about="Two arms that hold one target: the closed chain, laws in it, and its internal force",
    page="two_arms",
    brings={
        "sections": {"forces.contacts": "two_arms.contact:Contacts"},
        "services": {
            "closed_chain": "two_arms.motion:closed_chain",
            "closed_chain_growth": "two_arms.growth:growth_in_words",
            "closed_chain_law": "two_arms.laws:make_in_chain",
            "closed_chain_motion": "two_arms.motion:ChainMotion",
            "closed_chain_start": "two_arms.motion:start_of",
            "later_hands_rollout": "two_arms.hand:LaterHandsRollout",
        },
    },
)
