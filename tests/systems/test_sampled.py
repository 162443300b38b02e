"""Blocks as pure functions, in Drake diagrams."""

import re
from dataclasses import dataclass, replace

import numpy as np
import pytest
from entry_points import needs
from own_stage import Mean

from ffsm_drake import BlockError, Sampled, load_scenario, make_closed_loop, simulate

SHORT = ("duration=0.3", "sensing.position_noise=0", "sensing.velocity_noise=0")


def test_a_block_steps_at_each_sample():
    data = simulate(load_scenario("postcapture", SHORT), blocks={"sensing.mean": Mean}).dataset
    true = np.hstack([data["position"].values, data["velocity"].values])
    measured = np.hstack([data["measured_position"].values, data["measured_velocity"].values])
    before = np.vstack([true[:1], true[:-1]])
    offset = np.outer(np.arange(len(true)) >= 10, 1e-7 * np.arange(true.shape[1]))
    # the measurement of a sample is that of the last step
    assert np.array_equal(measured, 0.98 * true + 0.02 * before + offset)


def made(**methods):
    kind = type("Odd", (Mean,), methods)
    return dataclass(frozen=True, kw_only=True)(kind)


def raising(self, inputs, memory, now):
    raise ValueError("no")


def writing(self, inputs, memory, now):
    inputs["state"][0] = 0.0
    return {"estimated_state": inputs["state"]}, memory


ODD = {
    "an unknown port": ({"inputs": ("stat",)}, "unknown port 'stat'; known: .*state"),
    "no step": ({"step": Sampled.step}, "NotImplementedError: Odd has no step"),
    "an error": ({"step": raising}, "failed at t = 0.00 s: ValueError: no"),
    "a change of its inputs": ({"step": writing}, "read-only"),
    "no pair": ({"step": lambda *_: {}}, r"must return \(outputs, memory\)"),
    "no outputs": ({"step": lambda *_: ({}, {})}, "must return outputs estimated_state, not none"),
    "other memory": (
        {"step": lambda s, i, m, n: ({"estimated_state": i["state"]}, {})},
        "must return memory before, not none",
    ),
    "another shape": (
        {"step": lambda s, i, m, n: ({"estimated_state": i["state"][1:]}, m)},
        r"returned 'estimated_state' of shape \(22,\); it must be \(23,\)",
    ),
    "text": (
        {"step": lambda s, i, m, n: ({"estimated_state": "1"}, m)},
        "returned 'estimated_state'",
    ),
    "memory that cannot be": ({"start": lambda s, state=None: 1}, "start must return a mapping"),
    "memory that is text": ({"start": lambda s, state=None: {"a": "x"}}, "start returned 'a'"),
    "a jagged memory": ({"start": lambda s, state=None: {"a": [[1], [1, 2]]}}, "start"),
    "memory of another size": (
        {"start": lambda s, state=None: {"a": np.zeros(1 if state is None else 2)}},
        "the same names and shapes for a state as for None",
    ),
    "memory of another name": (
        {"start": lambda s, state=None: {"a" if state is None else "b": np.zeros(1)}},
        "the same names and shapes for a state as for None",
    ),
    "a phase that is text": ({"phase": lambda s, sample: ["x"]}, "phase, an array of"),
    "a late phase": ({"phase": lambda s, sample: [1 // (2 - sample)]}, "ZeroDivisionError"),
    "no ports": ({"outputs": None}, "ports are a tuple of names or sizes by name, not None"),
    "a name as ports": ({"inputs": "state"}, "not 'state'"),
    "a negative size": ({"inputs": {"state": -3}}, "port 'state' has a number of entries, not -3"),
}


@pytest.mark.parametrize("case", ODD)
def test_a_block_that_breaks_the_contract_is_one_line(case):
    methods, said = ODD[case]
    with pytest.raises(BlockError) as error:
        simulate(load_scenario("postcapture", SHORT), blocks={"sensing.odd": made(**methods)})
    assert re.search(said, str(error.value)), str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("place", ["actuation", "supervisor"])
def test_a_block_that_acts_between_samples_is_refused(place):
    with pytest.raises(BlockError, match="a Sampled block is one of sensing, reference, forces"):
        make_closed_loop(load_scenario("postcapture", SHORT), blocks={place: Mean})


def of_time(self, inputs, memory, now):
    state = np.concatenate([[1.0, 0.0, 0.0, 0.0], np.full(self.offset.size - 4, now.time)])
    return {"desired_state": state, "desired_acceleration": np.zeros(11)}, memory


def test_a_block_without_inputs_follows_time():
    Clock = made(
        inputs=(),
        outputs=("desired_state", "desired_acceleration"),
        start=Sampled.start,
        step=of_time,
    )
    record = simulate(load_scenario("postcapture", SHORT), blocks={"reference": Clock})
    shown = record.dataset["desired_position"].values
    assert np.array_equal(shown[:, -1], record.dataset["time"].values)


@pytest.mark.parametrize(
    ("key", "block"),
    [
        ("environment={altitude: 7.0e5, gravity_gradient: true}", "forces.environment"),
        pytest.param(
            "faults.events={it: {unit: joints.joint_1, kind: jammed, time: [0.0]}}",
            "forces.jam",
            marks=needs("faults"),
        ),
    ],
)
def test_a_payload_is_that_of_its_context(key, block):
    """Contexts of one loop with other payloads, read in turns."""
    loop = make_closed_loop(load_scenario("postcapture", [key]))
    contexts = [loop.diagram.CreateDefaultContext() for _ in range(2)]
    truth = loop.scenario.payload.truth
    for context, share in zip(contexts, (1.0, 3.0), strict=True):
        loop.initialize(loop.diagram, context)
        loop.set_payload(context, replace(truth, mass=share * truth.mass))
    system = loop.blocks[block]
    port = next(filter(system.HasOutputPort, ("next_generalized_force", "generalized_force")))

    def force(context):
        context.SetTime(context.get_time() + 1e-9)  # computed anew
        return system.GetOutputPort(port).Eval(system.GetMyContextFromRoot(context)).copy()

    first, other, again = force(contexts[0]), force(contexts[1]), force(contexts[0])
    assert np.abs(first - again).max() < 0.01 * np.abs(first - other).max()
