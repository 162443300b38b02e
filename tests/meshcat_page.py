"""A stand-in for the browser: what the operator of a Meshcat page sends to its server."""

from pydrake.geometry import Meshcat


def click(meshcat: Meshcat, button: str) -> None:
    """The message (msgpack) that a click on a button sends."""

    def text(string: str) -> bytes:
        data = string.encode()
        return (bytes([0xA0 | len(data)]) if len(data) < 32 else bytes([0xD9, len(data)])) + data

    meshcat._InjectWebsocketMessage(b"\x82" + text("type") + text("button") + text("name") + text(button))
