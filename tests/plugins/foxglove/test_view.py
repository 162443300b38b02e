"""A run live in Foxglove, as a client sees it."""

import numpy as np
import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from ffsm_drake import load_scenario, simulate
from ffsm_drake.plugins.foxglove.view import watch

pytest.importorskip("foxglove", reason="needs foxglove-sdk")


def heard(address):
    """What a server of Foxglove's protocol tells who connects, up to the topics."""
    with connect(address, subprotocols=["foxglove.sdk.v1"], max_size=None) as line:
        said = ""
        while "/scene" not in said or "/tf" not in said:
            said += str(line.recv(timeout=10))
        return said


def refused(address, **headers):
    """The status with which a websocket is refused."""
    with (
        pytest.raises(InvalidStatus) as raised,
        connect(address, subprotocols=["foxglove.sdk.v1"], additional_headers=headers),
    ):
        pass
    return raised.value.response.status_code


@pytest.mark.smoke
def test_a_run_is_served_while_it_goes():
    scenario = load_scenario("postcapture", ["duration=0.3"])
    lines, waits, answers = [], [], []

    def wait(time):
        waits.append(time)
        if len(waits) == 10:
            address = lines[0].split()[-1]
            answers.append(heard(address))
            bare, _, _ = address.rpartition("/")
            answers.extend(
                refused(bare + path, Origin=origin)
                for path in ("", "/", "/x", "/" + 22 * "A", "/?token=x")
                for origin in ("http://evil.example", "null", bare.replace("ws", "http"))
            )
            answers.append(refused(address, Host="evil.example"))

    record = watch(scenario, port=0, tell=lines.append, wait=wait)
    assert "ws://127.0.0.1:" in lines[0]
    assert "ffsm_drake" in answers[0]
    assert answers[1:] == 16 * [403]
    expected = simulate(scenario, check_stability=False)
    np.testing.assert_array_equal(record.dataset.position, expected.dataset.position)
    assert sum(waits) < 0.35
