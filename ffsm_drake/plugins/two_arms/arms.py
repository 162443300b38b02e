"""The closed chains of scenarios with several contacts, for the core."""

from ffsm_drake.plugins.two_arms.growth import growth_in_words
from ffsm_drake.plugins.two_arms.hand import beyond
from ffsm_drake.plugins.two_arms.laws import make_in_chain
from ffsm_drake.plugins.two_arms.motion import closed_chain, start_of
from ffsm_drake.systems.closed_chains import ClosedChains


class Arms(ClosedChains):
    """Arms of one spacecraft that hold one target."""

    start = staticmethod(start_of)
    solve = staticmethod(closed_chain)
    law = staticmethod(make_in_chain)
    growth = staticmethod(growth_in_words)
    beyond = staticmethod(beyond)


ARMS = Arms()
