"""Closed loops are freed once they are released, however many Python systems they hold."""

import collections
import gc
import sys
import threading
import weakref

import pytest
from pydrake.systems.framework import LeafSystem

from ffsm_drake import load_scenario, make_nominal_plant, simulate
from ffsm_drake.common.lifetime import holds_diagrams
from ffsm_drake.mission import make_mission
from ffsm_drake.runs.rollout import Rollout
from ffsm_drake.systems.controllers import make_controller

pytestmark = pytest.mark.rounding

SCENARIOS = {
    "the paper's": ["controller=aismc"],
    "adaptive": ["controller=tde_aismc"],
    "from elsewhere": ["controller=pd_plus"],
    "in orbit": ["environment={altitude: 4e5}"],
    "with faults": [
        "sensing.velocity_quantization=1e-6",
        "sensing.delay=2",
        "actuation.quantization=0.1",
    ],
}


@pytest.mark.parametrize("overrides", SCENARIOS.values(), ids=SCENARIOS)
def test_a_released_rollout_is_freed(overrides):
    rollout = Rollout(load_scenario("postcapture", ["duration=0.05", *overrides]))
    log = rollout.run()
    loop = rollout.loop
    parts = [weakref.ref(part) for part in (loop.diagram, *loop.blocks.values())]
    rollout.release()
    del rollout, loop
    gc.collect()
    assert [part() for part in parts] == [None] * len(parts)
    assert log.metrics["isv"] > 0  # what it logged stays


class Idle(LeafSystem):
    """A controller as one would write it: its callback keeps it for ever, but not the loop that it
    was in.
    """

    def __init__(self, setup):
        super().__init__()
        for name, size in (
            ("estimated_state", 23),
            ("desired_state", 23),
            ("desired_acceleration", 11),
        ):
            self.DeclareVectorInputPort(name, size)
        self.DeclareStateOutputPort("generalized_force", self.DeclareDiscreteState(11))
        self.DeclarePeriodicDiscreteUpdateEvent(setup.sample_time, 0.0, self.update)

    def update(self, context, values):
        pass


@pytest.mark.long
@pytest.mark.parametrize("blocks", [None, {"controller": Idle}], ids=["shipped", "user-supplied"])
def test_simulating_again_and_again_takes_no_more_memory(blocks):
    """Drake 1.51 would take 2.3 MiB a call without a release."""
    scenario = load_scenario("postcapture", ["duration=0.02"])

    def memory_after(calls):
        for _ in range(calls):
            simulate(scenario, blocks=blocks)
            gc.collect()
        return pytest.importorskip("ffsm_drake.plugins.campaign.evaluate").resident_memory()

    before = memory_after(3)
    assert memory_after(5) < before + 8.0


@pytest.mark.smoke
def test_a_system_that_was_never_wired_is_freed():
    scenario = load_scenario("postcapture")
    nominal = make_nominal_plant(scenario)
    made = weakref.ref(make_controller(make_mission(scenario), nominal))
    gc.collect()
    assert made() is None


def test_a_release_is_needed_where_it_is_said_to_be():
    """When this fails, ``common.lifetime`` is to say something else of the installed Drake."""
    rollout = Rollout(load_scenario("postcapture", ["duration=0.05"]))
    controller = weakref.ref(rollout.loop.blocks["controller"])
    del rollout
    gc.collect()
    assert (controller() is not None) == holds_diagrams()


def test_a_profiler_in_another_thread_does_not_stop_the_building_of_loops():
    """Frames that somebody holds keep the variables of calls that have returned (a Dask worker's
    profiler does).
    """
    frames, done = collections.deque(maxlen=200), threading.Event()

    def watch():
        while not done.wait(2e-4):
            frames.append(sys._current_frames())

    interval = sys.getswitchinterval()
    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    sys.setswitchinterval(1e-5)
    try:
        for _ in range(25):
            Rollout(load_scenario("postcapture", ["duration=0.02"]))
    finally:
        done.set()
        watcher.join()
        sys.setswitchinterval(interval)
