"""Missions as Gymnasium environments, for one spacecraft or several.

Importing it registers ``ffsm/PostCapture-v0``, ``ffsm/TumblingCapture-v0`` and
``ffsm/FreeFloating-v0``. Needs ``pip install 'ffsm-drake[gymnasium]'``.
"""

import gymnasium

for _id, _scenario in {
    "ffsm/PostCapture-v0": "postcapture",
    "ffsm/TumblingCapture-v0": "tumbling_capture",
    "ffsm/FreeFloating-v0": "free_floating",
}.items():
    gymnasium.register(
        id=_id,
        entry_point=f"{__name__}.environment:MissionEnv",
        vector_entry_point=f"{__name__}.vector:MissionVectorEnv",
        kwargs={"scenario": _scenario},
    )
