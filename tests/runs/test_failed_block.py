"""User-supplied code that fails in a run: which block is named, and what is kept."""

import re
import signal
import sys
import time

import numpy as np
import pytest
from children import PIPE, child
from pydrake.systems.framework import LeafSystem

from ffsm_drake import BlockError, ControlLaw, RunRecord, load_scenario, simulate
from ffsm_drake.loop.blocks import READ_BY_FORCES, REPORTED_UNITS
from ffsm_drake.spacecraft.plant import configuration
from ffsm_drake.systems.controllers.laws.pd_plus import PdPlus
from ffsm_drake.systems.controllers.laws.tdc import Tdc

SHORT = ["duration=0.2", "sample_time=0.01"]


class Given(LeafSystem):
    """A block that gives what ``value(time, size)`` says on its ports."""

    sizes = ()

    def __init__(self, setup):
        super().__init__()
        nv = len(setup.coordinates.names)
        posture = setup.scenario.initial_posture
        self.q = configuration(setup.nominal.coordinates, posture, key="initial_posture")
        for name, kind in self.sizes:
            size = {"state": 2 * nv + 1, "force": nv}[kind]
            self.DeclareVectorOutputPort(
                name,
                size,
                lambda context, output, size=size: output.SetFromVector(
                    self.value(context.get_time(), size)
                ),
                {self.time_ticket()},
            )


class Still(Given):
    sizes = (("desired_state", "state"), ("desired_acceleration", "force"))

    def value(self, time, size):
        if size == self.q.size - 1:
            return np.zeros(size)
        return np.r_[self.q[:4] * (time < 0.095), self.q[4:], np.zeros(self.q.size - 1)]


class Blows(Given):
    sizes = (("generalized_force", "force"),)

    def value(self, time, size):
        return np.full(size, np.nan if time > 0.095 else 0.0)


class Raises(Given):
    sizes = (("generalized_force", "force"),)

    def value(self, time, size):
        return np.zeros(size) if time < 0.095 else np.zeros(size) + 1 / len([])


class Fails(PdPlus):
    """At the eleventh sample."""

    def initial_state(self):
        return {"count": np.zeros(1)}

    def step(self, sample, state):
        if state["count"][0] >= 10:
            raise self.error()
        force, _ = super().step(sample, {})
        return force, {"count": state["count"] + 1}

    error = KeyboardInterrupt


def failed(blocks, *overrides):
    with pytest.raises(BlockError) as caught:
        simulate(load_scenario("postcapture", [*SHORT, *overrides]), blocks=blocks)
    assert "\n" not in str(caught.value)
    return caught.value


@pytest.mark.smoke
@pytest.mark.parametrize(
    ("block", "factory", "expected"),
    [
        (
            "reference",
            Still,
            r"blocks.reference 'Still': its desired_state has a quaternion of norm 0; it must be "
            r"finite, \[q; v\] with a unit quaternion; at t = 0.10 s",
        ),
        (
            "forces.blow",
            Blows,
            r"blocks.forces.blow 'Blows': its generalized_force is not finite; it must be finite",
        ),
        (
            "forces.raise",
            Raises,
            r"blocks.forces.raise 'Raises' failed at t = 0.\d\d s: ZeroDivisionError: .* "
            r"\(in Raises.value: .*test_failed_block.py, line \d+\)",
        ),
        (
            "controller",
            Fails,
            r"controller 'Fails' failed at t = 0.10 s: KeyboardInterrupt: .*\(in Fails.step: .*\); "
            "raise an Exception to end a run",
        ),
    ],
)
def test_the_block_is_named_and_the_run_up_to_then_kept(block, factory, expected, tmp_path):
    error = failed({block: factory})
    assert re.search(expected, str(error))
    record = error.record
    assert record.outcome.status == "failed"
    assert 9 <= record.dataset.sizes["time"] <= 10
    record.save(tmp_path / "kept")
    again = RunRecord.load(tmp_path / "kept")
    assert again.ending.is_failure
    assert str(error) in again.outcome.message


def reading(port, outputs):
    """A block that reads an input port, which a loop may leave unconnected."""

    class Reads(Given):
        sizes = outputs

        def __init__(self, setup):
            super().__init__(setup)
            if not self.HasInputPort("state"):
                self.DeclareVectorInputPort("state", self.q.size + len(setup.coordinates.names))
            self.read = self.DeclareVectorInputPort(port, 3)
            self.DeclarePeriodicDiscreteUpdateEvent(0.01, 0.0, self.update)

        def update(self, context, values):
            self.read.Eval(context)

        def value(self, time, size):
            return np.zeros(size)

    return Reads


UNFED = [("forces", port, (("generalized_force", "force"),)) for port in READ_BY_FORCES]
UNFED += [("sensing", port, (("estimated_state", "state"),)) for port in REPORTED_UNITS]


@pytest.mark.parametrize(("kind", "port", "outputs"), UNFED)
def test_an_input_that_nothing_feeds_is_named(kind, port, outputs):
    error = failed({f"{kind}.own": reading(port, outputs)})
    assert re.fullmatch(
        rf"blocks.{kind}.own: nothing is connected to its input port '{port}': .*", str(error)
    )
    assert isinstance(error.__cause__, RuntimeError)


@pytest.mark.parametrize("kind", [KeyboardInterrupt, SystemExit, GeneratorExit, ValueError])
def test_the_original_is_the_cause(kind):
    law = type("Own", (Fails,), {"error": kind})
    assert type(failed({"controller": law}).__cause__) is kind


def test_an_error_of_the_callers_own_function_is_the_callers():
    def progress(time, duration):
        raise LookupError("mine")

    with pytest.raises(LookupError, match="mine"):
        simulate(load_scenario("postcapture", SHORT), progress=progress)


class FailsLater(Tdc):
    """After the grasp."""

    def step(self, e, e_dot, a_d, state):
        u, memory = super().step(e, e_dot, a_d, state)
        return u, {**memory, "count": state["count"] + 1}

    def initial_state(self):
        return {**super().initial_state(), "count": np.zeros(1)}

    def resume(self, state, ratio):
        return {"count": np.full(1, self.counted)}

    counted = np.nan


@pytest.mark.slow
def test_what_resume_returns_is_checked_and_the_approach_kept():
    law = type("Own", (FailsLater,), {"counted": "text"})
    with pytest.raises(BlockError, match="resume returned 'count', an array of <U4; it must be"):
        simulate(
            load_scenario("tumbling_capture"), blocks={"controller": law}, check_stability=False
        )


class Boundless(ControlLaw):
    def __init__(self, returned):
        self.returned = returned

    def initial_state(self):
        return self.returned

    def step(self, sample, state):
        return np.zeros_like(sample.e), state


@pytest.mark.parametrize(
    ("returned", "expected"),
    [
        ({"a": object()}, "initial_state returned 'a', an array of object; it must be a vector of"),
        ({"a": "text"}, "initial_state returned 'a', an array of <U4"),
        ({"a": np.zeros((2, 2))}, r"initial_state returned 'a' of shape \(2, 2\)"),
        ({"a": np.broadcast_to(0.0, 10**12)}, r"of shape \(1000000000000,\); it must be a vector"),
        ({f"a{k}": np.zeros(60_000) for k in range(2)}, "has 120000 numbers; at most 100000"),
        ({"has_previous": np.zeros(1)}, "names 'has_previous', which is the controller's"),
        ({1: np.zeros(1)}, "must return a mapping of names to arrays, not dict"),
        (None, "must return a mapping of names to arrays, not NoneType"),
    ],
)
def test_a_memory_is_a_mapping_of_vectors(returned, expected):
    error = failed({"controller": lambda setup: Boundless(returned)})
    assert re.search(expected, str(error))


ENDLESS = """
from ffsm_drake.systems.controllers.laws.pd_plus import PdPlus

class Endless(PdPlus):
    def step(self, sample, state):
        if sample.q_d[4] < 0.0999999:
            print("now", flush=True)
        while sample.q_d[4] < 0.0999999:
            pass
        return super().step(sample, state)
"""


@pytest.mark.slow
def test_ctrl_c_ends_a_step_that_never_returns(tmp_path):
    (tmp_path / "endless.py").write_text(ENDLESS)
    command = [sys.executable, "-m", "ffsm_drake", "run", "-c", "endless:Endless", "--no-report"]
    command += ["--set", "duration=3", "--out", "out"]
    with child(command, cwd=tmp_path, stdout=PIPE, stderr=PIPE, text=True) as process:
        assert process.stdout.readline() == "now\n"
        time.sleep(0.2)
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=60)
    assert process.returncode == 130, errors
    assert "Traceback" not in errors
    assert RunRecord.load(tmp_path / "out").outcome.status == "interrupted"
