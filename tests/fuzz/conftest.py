"""How many inputs are tried; see fuzz_inputs.py."""


def pytest_addoption(parser):
    parser.addoption(
        "--inputs", type=int, default=400, help="how many inputs of all kinds together"
    )
    parser.addoption("--fuzz-seed", type=int, default=0, help="another seed tries other inputs")
