"""Entries of ports as a port of their own."""

from collections.abc import Mapping, Sequence

from pydrake.systems.primitives import Selector, SelectorParams


def make_selector(
    inputs: Mapping[str, int], outputs: Mapping[str, Sequence[tuple[int, int]]]
) -> Selector:
    """Return a system with entries of its inputs as outputs.

    Args:
      inputs: size of each input by name.
      outputs: for each output by name, (input, place in it) of its entries.
    """
    params = SelectorParams()
    params.inputs = [
        SelectorParams.InputPortParams(name=name, size=size) for name, size in inputs.items()
    ]
    params.outputs = [
        SelectorParams.OutputPortParams(
            name=name,
            selections=[
                SelectorParams.OutputSelection(input_port_index=index, input_offset=offset)
                for index, offset in places
            ],
        )
        for name, places in outputs.items()
    ]
    return Selector(params)
