"""ONNX files of policies for tests."""

import json

import numpy as np
import pytest

policy = pytest.importorskip("ffsm_drake.plugins.policy.policy")
onnx = pytest.importorskip("onnx", reason="needs onnx, of the extra test")

FLOAT = onnx.TensorProto.FLOAT


def network(nodes, inputs, outputs, constants, metadata):
    """A model of nodes (arguments of ``make_node``), ports (name -> type, shape) and constants."""
    ports = [
        [onnx.helper.make_tensor_value_info(name, *port) for name, port in each.items()]
        for each in (inputs, outputs)
    ]
    graph = onnx.helper.make_graph(
        [onnx.helper.make_node(*each[:3], **dict(*each[3:])) for each in nodes],
        "graph",
        *ports,
        [onnx.numpy_helper.from_array(value, name) for name, value in constants.items()],
    )
    model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 17)])
    model.ir_version = 9
    onnx.helper.set_model_props(model, metadata)
    return model


def linear_policy(weights, metadata, size=None):
    """A model whose actions are weights (actions, observations) times ``size`` observations."""
    actions, observations = weights.shape
    given = np.zeros((size or observations, actions), np.float32)
    given[:observations] = weights.T
    ports = {"x": (FLOAT, [1, len(given)])}, {"y": (FLOAT, [1, actions])}
    return network([("MatMul", ["x", "w"], ["y"])], *ports, {"w": given}, metadata)


def metadata_of(scenario, coordinates, **changes):
    """Metadata that fit a scenario."""
    names = policy.observation_names(scenario, coordinates, tracks_frame=False)
    return {
        "observation_names": json.dumps(names),
        "action_names": json.dumps(coordinates.names),
        "scale": json.dumps([1000.0] * len(coordinates.names)),
        "action": "force",
        **changes,
    }
